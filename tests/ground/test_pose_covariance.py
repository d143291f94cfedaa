"""A pose tag's covariance on its way from the navigation filter to the training, rotated into the right frame."""

import dataclasses
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from flightsw.errors import NavigationError
from flightsw.icd.frame import PoseTag
from flightsw.icd.mission import load_mission
from flightsw.icd.quaternion import matrix_to_quat, quat_to_matrix
from flightsw.navigation.pose import navigation_tag
from flightsw.navigation.stream import RelativePose, SatelliteStates, interpolate, parse_state
from ground.session.folder import Navigation, open_session
from ground.session.training_frames import frames_of, motion_covariance, tag_covariance, training_frame
from obbgs_base.physics.free_rotation import free_rotation
from obbgs_base.physics.navigation_errors import SharedParameters, displaced
from obbgs_core.frames import alike, usable
from obbgs_core.model.pose_covariance import flaw
from obbgs_core.poses.corrections import PoseCorrections, motion_of

ROOT = Path(__file__).parents[2]
GOLDEN = ROOT / "tests" / "golden" / "session"
MISSION = load_mission(ROOT / "mission.yaml")
START_NS = MISSION.orbit.start_utc_ns


def random_tag(rng: np.random.Generator) -> PoseTag:
    quat = matrix_to_quat(Rotation.random(rng=rng).as_matrix())
    return PoseTag(quat, rng.normal(size=3) * 100, np.zeros((6, 6)), np.array([0.0, 0, 1]), False, True)


@given(st.integers(0, 10_000))
def test_the_motion_of_a_tags_errors_makes_the_tagged_pose_the_true_one(seed):
    """One error at a time: its outer product is a covariance, and the motion's must be that of the motion found."""
    rng = np.random.default_rng(seed)
    true, small = random_tag(rng), 1e-5
    position_m, rotation_rad = rng.normal(size=3) * small, rng.normal(size=3) * small
    # as flightsw says (icd/README.md): position minus the true one, and R_tag = exp(a) R_true
    turned = Rotation.from_rotvec(rotation_rad).as_matrix() @ quat_to_matrix(true.quat_body_to_camera)
    tag = dataclasses.replace(
        true, quat_body_to_camera=matrix_to_quat(turned), position_body_m=true.position_body_m + position_m
    )
    motion = true.world_to_camera @ np.linalg.inv(tag.world_to_camera)
    found = np.concatenate([Rotation.from_matrix(motion[:3, :3]).as_rotvec(), motion[:3, 3]])
    error = np.concatenate([position_m, rotation_rad])
    covariance = motion_covariance(np.outer(error, error), tag.world_to_camera[:3, :3])
    # an error of some 1e-5 squared is what the first order misses of it; rounding of 300 m is a billionth of it
    np.testing.assert_allclose(covariance, np.outer(found, found), atol=1e-3 * small**2)


def test_errors_drawn_from_a_tags_covariance_are_as_large_as_the_corrections_say():
    """Motions drawn with the tag's errors, in units of their covariance, are white."""
    rng = np.random.default_rng(1)
    root = np.diag([0.03, 0.02, 0.05, 1e-3, 2e-3, 3e-3]) @ rng.normal(size=(6, 6))
    tag, count = random_tag(rng), 2000
    covariance = motion_covariance(root @ root.T, tag.world_to_camera[:3, :3])
    drawn = []
    for _ in range(count):
        error = root @ rng.normal(size=6)
        turn = Rotation.from_rotvec(-error[3:]).as_matrix() @ quat_to_matrix(tag.quat_body_to_camera)
        position_m = tag.position_body_m - error[:3]
        true = dataclasses.replace(tag, quat_body_to_camera=matrix_to_quat(turn), position_body_m=position_m)
        motion = true.world_to_camera @ np.linalg.inv(tag.world_to_camera)
        drawn.append(np.concatenate([Rotation.from_matrix(motion[:3, :3]).as_rotvec(), motion[:3, 3]]))
    unit = np.linalg.solve(np.linalg.cholesky(covariance), np.array(drawn).T)
    five_sigma = 5 * np.sqrt(2 / count)  # of a variance that is estimated from so many
    np.testing.assert_allclose(unit @ unit.T / count, np.eye(6), atol=five_sigma)


def test_what_a_bracket_is_corrected_by_is_the_whole_covariance_of_all_its_tags(tmp_path):
    shutil.copytree(GOLDEN, tmp_path / "session")
    rng = np.random.default_rng(0)
    lines, covariances = [], []
    for line in (GOLDEN / "frames.jsonl").read_text().splitlines()[:3]:
        root = np.diag([0.03, 0.02, 0.05, 1e-3, 2e-3, 3e-3]) @ rng.normal(size=(6, 6))
        covariances.append(root @ root.T)
        lines.append(json.dumps(json.loads(line) | {"covariance": covariances[-1].tolist()}))
    (tmp_path / "session" / "frames.jsonl").write_text("\n".join(lines) + "\n")
    session = open_session(tmp_path / "session")
    assert len({record.bracket for record in session.frames}) == 1
    found = (
        PoseCorrections([training_frame(session, record) for record in session.frames])
        .whitening.root[0]
        .numpy()
    )
    expected = np.mean(
        [
            motion_covariance(covariance, record.world_to_camera[:3, :3])
            for covariance, record in zip(covariances, session.frames, strict=True)
        ],
        axis=0,
    )
    scale = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(
        found @ found.T / np.outer(scale, scale), expected / np.outer(scale, scale), atol=1e-5
    )
    assert np.abs(np.tril(expected / np.outer(scale, scale), -1)).max() > 0.3, "these tags are correlated"


def state(covariance: np.ndarray, utc_ns: int, relative: bool, seed: int) -> RelativePose | SatelliteStates:
    """Return what flight makes of a filter's line.

    Raises:
        NavigationError: flight refuses it.
    """
    rng = np.random.default_rng(seed)
    entry: dict = {"utc_ns": utc_ns, "covariance": covariance.tolist()}
    if relative:
        tag = random_tag(rng)
        entry |= {
            "quat_body_to_camera": tag.quat_body_to_camera.tolist(),
            "position_body_m": [1.0, 2.0, 50.0],
        }
    else:
        orbit_m, velocity_m_s = np.array([7e6, 0.0, 0.0]), [0.0, 7.5e3, 0.0]
        entry["target"] = {"position_m": orbit_m.tolist(), "velocity_m_s": velocity_m_s}
        entry["chaser"] = {
            "position_m": (orbit_m + rng.normal(size=3) * 100).tolist(),
            "velocity_m_s": velocity_m_s,
        }
    return parse_state(json.dumps(entry).encode())


@given(
    st.integers(0, 10_000),
    st.integers(0, 6),
    st.floats(-14, 0),  # decades by which the matrix misses being a covariance
    st.tuples(st.floats(-6, 3), st.floats(-6, 3)),  # decades of the two vectors' deviations
    st.booleans(),
)
def test_what_flight_sends_is_always_a_covariance_to_the_ground(seed, rank, miss, decades, relative):
    rng = np.random.default_rng(seed)
    states = []
    for k in range(2):
        deviations = np.repeat(10.0 ** np.array(decades), 3)
        factor = rng.normal(size=(6, rank))
        matrix = factor @ factor.T
        matrix = matrix + 10.0**miss * np.abs(matrix).max() * rng.normal(size=(6, 6))
        try:
            states.append(
                state(matrix * np.outer(deviations, deviations), START_NS + k * 10**9, relative, seed + k)
            )
        except NavigationError:
            assume(False)
    tag = navigation_tag(MISSION, interpolate(*states, START_NS + 3 * 10**8))
    covariance = motion_covariance(tag.covariance, tag.world_to_camera[:3, :3])
    assert not flaw(torch.from_numpy(covariance))


@given(st.integers(0, 10_000))
def test_what_a_tag_states_of_a_motion_is_the_motions_covariance_again(seed):
    rng = np.random.default_rng(seed)
    factor, turn = rng.normal(size=(6, 6)), Rotation.random(rng=rng).as_matrix()
    covariance = factor @ factor.T
    there_and_back = motion_covariance(tag_covariance(covariance, turn), turn)
    np.testing.assert_allclose(there_and_back, covariance, atol=1e-12)


@pytest.mark.parametrize(
    "apart_s, correlation_s, corrections", [(0.5, 0, 2), (4.9, 0, 2), (9, 0, 6), (9, 8, 6), (9, 30, 2)]
)
def test_frames_share_a_correction_where_their_tags_err_alike(tmp_path, apart_s, correlation_s, corrections):
    """Within seconds they do; further apart as the tags' correlation time says."""
    shutil.copytree(GOLDEN, tmp_path / "session")
    lines = [json.loads(line) for line in (GOLDEN / "frames.jsonl").read_text().splitlines()[:6]]
    lines = [
        line | {"mid_exposure_utc_ns": round((27 * (i // 3) + apart_s * (i % 3)) * 1e9)}
        for i, line in enumerate(lines)
    ]
    (tmp_path / "session" / "frames.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    header = json.loads((GOLDEN / "session.json").read_text())
    header["navigation"] = {"correlation_time_s": correlation_s}
    (tmp_path / "session" / "session.json").write_text(json.dumps(header))
    session = open_session(tmp_path / "session")
    assert [record.bracket_index for record in session.frames] == [0, 1, 2] * 2
    assert session.frame_spacing_s == pytest.approx(apart_s)
    frames = frames_of(session, session.frames)
    assert len(PoseCorrections(frames).value) == corrections
    assert len({frame.bracket for frame in frames}) == 2
    without_one = dataclasses.replace(
        session, frames=session.frames[:1] + session.frames[2:]
    )  # lost on the link
    assert len(PoseCorrections(frames_of(without_one, without_one.frames)).value) == min(corrections, 5)


def test_an_error_of_the_rate_turns_a_tumbling_target_as_no_torque_does(tmp_path):
    """Also where navigation states attitudes only: they tell how the body turns, however few are known at first."""
    rate, inertia, error = (
        np.radians([0.8, 0.1, 0.9]),
        np.array([0.45, 0.82, 1.0]),
        np.array([3e-5, -1e-5, 2e-5]),
    )
    session, times_s = open_session(GOLDEN), 54.0 * np.arange(48)
    assumed, true = (free_rotation(times_s, w[None], inertia[None])[0][0] for w in (rate, rate + error))
    records = tuple(
        dataclasses.replace(r, mid_exposure_utc_ns=round(s * 1e9), quat_inertial_to_body=matrix_to_quat(a))
        for r, s, a in zip(session.frames, times_s, assumed, strict=True)
    )
    navigation = Navigation(sigmas=SharedParameters(rate_rad_s=np.full(3, 3e-5)))
    session = dataclasses.replace(session, frames=records, navigation=navigation)
    frames = frames_of(session, session.frames)
    moved = displaced(motion_of(frames), SharedParameters(rate_rad_s=error))[:, :3, :3]
    tagged = np.stack([f.world_to_camera.double().numpy() for f in frames])[:, :3, :3]
    np.testing.assert_allclose(moved, tagged @ assumed @ true.swapaxes(1, 2), atol=1e-3)
    assert np.abs(moved - tagged).max() > 0.05

    first = dataclasses.replace(session, frames=records[:5])
    assert not first.rotation[0].any()
    joined = alike([*frames_of(first, first.frames), *frames[5:]])
    usable(joined, exposure_aware=True)  # which refuses frames that state several navigations
    assert all((f.navigation.rate_rad_s == session.rotation[0]).all() for f in joined if f.navigation)
