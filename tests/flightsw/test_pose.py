"""The pose tag: where the camera looks, how the target turns, and the quaternions of the wire."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from flightsw.errors import NavigationError
from flightsw.icd.mission import Mission, load_mission
from flightsw.icd.quaternion import matrix_to_quat, quat_to_matrix
from flightsw.navigation.orbit import propagate, sun_direction_gcrs
from flightsw.navigation.pose import look_along, navigation_tag, pose_tag, target_attitude
from flightsw.navigation.stream import RelativePose, SatelliteStates

MISSION = load_mission(Path(__file__).parents[2] / "mission.yaml")
START_NS = MISSION.orbit.start_utc_ns


@given(st.integers(0, 1100))
def test_the_camera_looks_at_the_target(seconds):
    tag = pose_tag(MISSION, START_NS + seconds * 1_000_000_000)
    target_in_camera = tag.world_to_camera @ [0, 0, 0, 1]
    range_m = np.linalg.norm(tag.position_body_m)
    # float64 at 7000 km leaves a micrometre
    np.testing.assert_allclose(target_in_camera, [0, 0, range_m, 1], atol=1e-5)
    assert 190 < range_m < 450 and tag.valid and not tag.in_eclipse


def test_the_sun_stands_still_in_a_target_that_spins_about_it():
    tags = [pose_tag(MISSION, START_NS + t * 1_000_000_000) for t in (0, 300, 900)]
    for tag in tags:
        # the Sun moves 0.04 degrees a quarter of an hour along the ecliptic
        assert np.degrees(np.arccos(min(1.0, tag.sun_dir_body[2]))) < 0.02


def test_the_target_turns_once_in_its_period():
    period_ns = round(MISSION.target_attitude.period_s * 1e9)
    start = target_attitude(MISSION, START_NS)
    np.testing.assert_allclose(target_attitude(MISSION, START_NS + period_ns), start, atol=1e-9)
    quarter = target_attitude(MISSION, START_NS + period_ns // 4) @ start.T
    np.testing.assert_allclose(quarter, [[0, 1, 0], [-1, 0, 0], [0, 0, 1]], atol=1e-9)
    inertial = dataclasses.replace(
        MISSION, target_attitude=dataclasses.replace(MISSION.target_attitude, mode="inertial")
    )
    np.testing.assert_array_equal(
        target_attitude(inertial, START_NS + 10**12), target_attitude(inertial, START_NS)
    )


def knowing(knowledge: str, **section) -> Mission:
    attitude = dataclasses.replace(MISSION.target_attitude, knowledge=knowledge)
    return dataclasses.replace(MISSION, target_attitude=attitude, **section)


@pytest.mark.parametrize("knowledge", ["known", "rate_only"])
def test_a_tag_states_the_attitude_that_it_assumes_and_how_well_it_is_known(knowledge):
    mission = knowing(knowledge, pose=dataclasses.replace(MISSION.pose, correlation_time_s=40.0))
    tag = pose_tag(mission, START_NS + 10**11)
    assert (tag.attitude, tag.correlation_time_s) == (knowledge, 40.0)
    assumed = Rotation.from_quat(np.asarray(tag.quat_inertial_to_body), scalar_first=True)
    relative_m = propagate_both(START_NS + 10**11)
    np.testing.assert_allclose(assumed.apply(relative_m), tag.position_body_m, atol=1e-6)
    np.testing.assert_allclose(
        assumed.apply(sun_direction_gcrs(START_NS + 10**11)), tag.sun_dir_body, atol=1e-12
    )


def test_without_the_target_s_attitude_pose_and_sun_are_in_inertial_axes():
    utc_ns = START_NS + 10**11
    tag = pose_tag(knowing("unknown"), utc_ns)
    assert tag.attitude == "unknown" and tag.valid
    np.testing.assert_allclose(tag.quat_inertial_to_body, [1, 0, 0, 0], atol=1e-12)
    np.testing.assert_allclose(tag.position_body_m, propagate_both(utc_ns), atol=1e-6)
    np.testing.assert_allclose(tag.sun_dir_body, sun_direction_gcrs(utc_ns), atol=1e-12)
    np.testing.assert_allclose(
        (tag.world_to_camera @ [0, 0, 0, 1])[:2], 0, atol=1e-5
    )  # it still looks at the target


def test_states_of_navigation_say_nothing_of_an_attitude_that_the_mission_calls_unknown():
    target, chaser = (
        propagate(tle, START_NS) for tle in (MISSION.orbit.target_tle, MISSION.orbit.chaser_tle)
    )
    vectors = (target.position_m, target.velocity_m_s, chaser.position_m, chaser.velocity_m_s)
    states = SatelliteStates(START_NS, *vectors, np.array([0.6, 0, 0.8, 0]), None, None)
    np.testing.assert_allclose(
        navigation_tag(MISSION, states).quat_inertial_to_body, [0.6, 0, 0.8, 0], atol=1e-12
    )
    tag = navigation_tag(knowing("unknown"), states)
    np.testing.assert_allclose(tag.position_body_m, propagate_both(START_NS), atol=1e-6)
    in_body_axes = RelativePose(
        START_NS, np.array([1.0, 0, 0, 0]), np.array([0, 0, -400.0]), np.zeros((6, 6))
    )
    with pytest.raises(NavigationError, match="send the states of both satellites"):
        navigation_tag(knowing("unknown"), in_body_axes)


def propagate_both(utc_ns: int) -> np.ndarray:
    """Return the chaser's position relative to the target, GCRS."""
    target, chaser = (propagate(tle, utc_ns) for tle in (MISSION.orbit.target_tle, MISSION.orbit.chaser_tle))
    return chaser.position_m - target.position_m


def test_stale_elements_are_flagged_not_invented():
    assert not pose_tag(MISSION, START_NS + 8 * 86_400 * 10**9).valid


def test_covariance_carries_the_missions_sigmas():
    covariance = pose_tag(MISSION, START_NS).covariance
    np.testing.assert_allclose(np.sqrt(np.diag(covariance))[:3], MISSION.pose.sigma_position_m)
    np.testing.assert_allclose(np.degrees(np.sqrt(np.diag(covariance))[3:]), MISSION.pose.sigma_attitude_deg)


@given(st.integers(0, 2**32 - 1))
def test_quaternions_match_scipy_and_survive_the_round_trip(seed):
    rotation = Rotation.random(rng=np.random.default_rng(seed))
    quat = matrix_to_quat(rotation.as_matrix())
    expected = rotation.as_quat(scalar_first=True, canonical=True)
    np.testing.assert_allclose(quat, expected if expected[0] * quat[0] >= 0 else -expected, atol=1e-7)
    np.testing.assert_allclose(quat_to_matrix(quat), rotation.as_matrix(), atol=1e-12)


def test_quaternions_of_half_turns_are_stable():
    for axis in np.eye(3):
        half_turn = Rotation.from_rotvec(np.pi * axis).as_matrix()
        np.testing.assert_allclose(quat_to_matrix(matrix_to_quat(half_turn)), half_turn, atol=1e-12)


def test_a_view_straight_down_has_no_roll():
    with pytest.raises(ValueError, match="parallel"):
        look_along(np.array([0.0, 0, 1]), down=np.array([0.0, 0, -2]))
