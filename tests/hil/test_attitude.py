"""The target's rotation: conservation laws, closed forms, and the same conventions as flight."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flightsw.icd.mission import ConfigError, TargetAttitudeSection, load_mission
from flightsw.icd.quaternion import quat_to_matrix
from flightsw.navigation.orbit import propagate
from flightsw.navigation.pose import target_attitude
from hil.world.attitude import AttitudeSection, attitude, tumble

MISSION = load_mission(Path(__file__).parents[2] / "mission.yaml")
START_NS = MISSION.orbit.start_utc_ns
UPRIGHT = np.array([1.0, 0.0, 0.0, 0.0])


def gcrs_momentum(state: np.ndarray, inertia: np.ndarray) -> np.ndarray:
    return quat_to_matrix(state[:4] / np.linalg.norm(state[:4])) @ (inertia * state[4:])


@settings(max_examples=8)
@given(
    small=st.floats(0.5, 1.0),
    middle=st.floats(1.0, 1.4),
    rates=st.tuples(*[st.floats(-0.05, 0.05)] * 3).filter(lambda r: np.linalg.norm(r) > 1e-3),
)
def test_a_tumble_conserves_energy_and_the_vector_of_angular_momentum(small, middle, rates):
    inertia = np.array([middle, small + middle - 0.1, small])
    motion = tumble(inertia, np.array(rates), UPRIGHT, 600.0)
    first = motion(0.0)
    energy, momentum = (inertia * first[4:] ** 2).sum(), gcrs_momentum(first, inertia)
    for t in np.linspace(0, 600, 23):
        state = motion(t)
        assert (inertia * state[4:] ** 2).sum() == pytest.approx(energy, rel=1e-8)
        assert np.linalg.norm(gcrs_momentum(state, inertia) - momentum) < 1e-8 * np.linalg.norm(momentum)
        assert np.linalg.norm(state[:4]) == pytest.approx(1, abs=1e-8)


def test_a_symmetric_top_precesses_as_the_closed_form_says():
    inertia, rates = np.array([2.0, 2.0, 3.0]), np.array([0.02, 0.0, 0.05])
    motion = tumble(inertia, rates, UPRIGHT, 900.0)
    body_rate = (3.0 - 2.0) / 2.0 * rates[2]  # Goldstein, Classical Mechanics, 5.6
    momentum = inertia * rates
    axis, precession = momentum / np.linalg.norm(momentum), np.linalg.norm(momentum) / 2.0
    for t in (17.0, 333.0, 900.0):
        state = motion(t)
        expected = [0.02 * np.cos(body_rate * t), 0.02 * np.sin(body_rate * t), 0.05]
        np.testing.assert_allclose(state[4:], expected, atol=1e-9)
        # the figure axis precesses about the momentum vector (Rodrigues' formula)
        z, angle = np.array([0.0, 0.0, 1.0]), precession * t
        turned = (
            z * np.cos(angle) + np.cross(axis, z) * np.sin(angle) + axis * (axis @ z) * (1 - np.cos(angle))
        )
        figure_axis = quat_to_matrix(state[:4] / np.linalg.norm(state[:4])) @ z
        np.testing.assert_allclose(figure_axis, turned, atol=1e-8)


def test_rotation_about_the_intermediate_axis_turns_over_and_about_the_largest_does_not():
    for inertia, turns_over in (((1.0, 2.0, 2.6), True), ((1.0, 2.6, 2.0), False)):
        motion = tumble(np.array(inertia), np.radians([0.05, 1.2, 0.05]), UPRIGHT, 3600.0)
        rates = motion(np.linspace(0, 3600, 400))[5]
        assert (rates.min() < -0.9 * rates.max()) == turns_over


@pytest.mark.parametrize("mode", ["inertial", "spin"])
@pytest.mark.parametrize("axis", ["sun", (0.6, 0.0, 0.8)])
def test_inertial_and_spin_agree_with_flight(mode, axis):
    mission = dataclasses.replace(MISSION, target_attitude=TargetAttitudeSection(mode, axis, 233.0))
    ours = attitude(AttitudeSection(mode, axis, 233.0), mission.orbit.target_tle, START_NS, 1000.0)
    for seconds in (0, 100, 5000):
        utc_ns = START_NS + seconds * 10**9
        np.testing.assert_allclose(ours(utc_ns), target_attitude(mission, utc_ns), atol=1e-12)


def test_lvlh_faces_the_earth_and_flies_forward():
    tle = MISSION.orbit.target_tle
    at = attitude(AttitudeSection("lvlh"), tle, START_NS, 100.0)
    for minutes in (0, 20, 50):
        utc_ns = START_NS + minutes * 60 * 10**9
        state = propagate(tle, utc_ns)
        to_earth = at(utc_ns) @ (-state.position_m / np.linalg.norm(state.position_m))
        forward = at(utc_ns) @ (state.velocity_m_s / np.linalg.norm(state.velocity_m_s))
        np.testing.assert_allclose(to_earth, [0, 0, 1], atol=1e-12)
        assert forward[0] > 0.99999 and abs(forward[1]) < 1e-12


def test_a_tumble_is_refused_outside_its_time():
    section = AttitudeSection("tumble", rates_deg_s=(0.1, 1.0, 0.0), inertia=(1.0, 2.0, 2.5))
    at = attitude(section, MISSION.orbit.target_tle, START_NS, 60.0)
    np.testing.assert_allclose(at(START_NS + 60 * 10**9) @ at(START_NS + 60 * 10**9).T, np.eye(3), atol=1e-12)
    for outside_ns in (START_NS - 2 * 10**8, START_NS + 61 * 10**9):
        with pytest.raises(ValueError, match="the tumble is known from 0 to 60 s"):
            at(outside_ns)


def test_a_tumble_is_known_a_little_before_its_start():
    """Torque-free rotation runs backwards with the rates negated."""
    inertia, rates = np.array([1.0, 2.0, 2.6]), np.array([0.4, 1.2, -0.3])
    forwards = tumble(inertia, rates, np.array([1.0, 0, 0, 0]), 100.0)
    backwards = tumble(inertia, -rates, np.array([1.0, 0, 0, 0]), 100.0)
    np.testing.assert_allclose(forwards(-0.03)[:4], backwards(0.03)[:4], atol=1e-10)


@pytest.mark.parametrize(
    ("wrong", "key"),
    [
        ({"axis": (0.0, 0.0, 0.0)}, "axis"),
        ({"period_s": 0.0}, "period_s"),
        ({"rates_deg_s": (1.0,)}, "rates_deg_s"),
        ({"inertia": (1.0, 1.0, 2.5)}, "inertia"),
        ({"inertia": (1.0, -1.0, 1.0)}, "inertia"),
    ],
)
def test_an_impossible_attitude_is_named(wrong, key):
    with pytest.raises(ConfigError, match=f"scenario.attitude.{key}"):
        AttitudeSection(**wrong)
