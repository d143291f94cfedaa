"""A session of a target of unknown attitude: seen from axes that were found, trained, and scored against the truth."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

from flightsw.icd.quaternion import matrix_to_quat
from ground import attitude
from ground.attitude import FoundAttitude, in_body_axes
from ground.evaluate import evaluate
from ground.reconstruct import reconstruct
from ground.session import Session, SessionError, open_session
from ground.truth import Truth
from obbgs_core.attitude.estimate import AttitudeUndetermined, TargetMotion
from obbgs_core.attitude.motion import at_epoch, attitudes
from tests import scenes
from tests.small_sessions import small_session

PARAMETERS = np.array([0.1, -0.2, 0.3, 0.2, -0.1, 0.4, 0.1, 0.0])  # at time 0 of the frames
EPOCH_S = 12.0


def found() -> FoundAttitude:
    """Return the true motion for another epoch, in axes of its own."""
    turn = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
    motion = TargetMotion(at_epoch(PARAMETERS, EPOCH_S), np.eye(8) * 1e-8, turn, 0.02, 24)
    return FoundAttitude(round(EPOCH_S * 1e9), motion)


def tumbling_session(folder: Path) -> Session:
    """Write a session whose target tumbles, with poses and Sun in inertial axes, and return it."""
    small_session(folder)
    records = [json.loads(line) for line in (folder / "frames.jsonl").read_text().splitlines()]
    times_s = np.array([record["mid_exposure_utc_ns"] / 1e9 for record in records])
    for record, inertial_to_body in zip(records, attitudes(PARAMETERS[None], times_s)[0], strict=True):
        pose = np.array(record["world_to_camera"])
        pose[:3, :3] = pose[:3, :3] @ inertial_to_body
        record["world_to_camera"] = pose.tolist()
        record["quat_body_to_camera"] = matrix_to_quat(pose[:3, :3]).tolist()
        record["position_body_m"] = (inertial_to_body.T @ record["position_body_m"]).tolist()
        record["sun_dir_body"] = inertial_to_body[2].tolist()  # body +z points to the Sun
    (folder / "frames.jsonl").write_text("".join(json.dumps(record) + "\n" for record in records))
    header = json.loads((folder / "session.json").read_text())
    header["navigation"] = {"attitude": "unknown"}
    (folder / "session.json").write_text(json.dumps(header))
    return open_session(folder)


def test_poses_and_truth_are_turned_into_the_axes_that_were_found(tmp_path):
    session = tumbling_session(tmp_path / "session")
    true = {r.id: np.array(r.world_to_camera) for r in open_session(small_session(tmp_path / "true")).frames}
    turned = in_body_axes(session, found())
    assert turned.attitude_estimated and not session.attitude_estimated
    truth, turns = Truth(turned), []
    for record in turned.frames:
        turns.append(record.world_to_camera[:3, :3].T @ true[record.id][:3, :3])
        np.testing.assert_allclose(turns[-1], turns[0], atol=1e-6)  # the integration's error
        np.testing.assert_allclose(record.position_body_m, turns[0] @ _centre(true[record.id]), atol=1e-5)
        np.testing.assert_allclose(record.sun_dir_body, turns[0][:, 2], atol=1e-6)
        np.testing.assert_allclose(truth.posed(record).world_to_camera, record.world_to_camera, atol=1e-6)
    np.testing.assert_allclose(truth.cloud_m, Truth(session).cloud_m @ turns[0].T, atol=1e-6)


def _centre(pose: np.ndarray) -> np.ndarray:
    return -pose[:3, :3].T @ pose[:3, 3]


def test_a_found_attitude_is_read_as_it_was_written(tmp_path):
    path = tmp_path / attitude.FILE
    assert FoundAttitude.read(path) is None
    found().write(path)
    again = FoundAttitude.read(path)
    assert again is not None and again.epoch_utc_ns == found().epoch_utc_ns
    np.testing.assert_array_equal(again.motion.parameters, found().motion.parameters)
    assert again.motion.facts() == found().motion.facts()
    path.write_text(path.read_text().replace('"covariance"', '"covarianse"'))
    with pytest.raises(SessionError, match="make the run again"):
        FoundAttitude.read(path)


def test_an_interrupted_run_goes_on_with_the_attitude_that_it_found(tmp_path):
    session = tumbling_session(tmp_path / "session")
    part = session.path / "runs" / ".first.part"
    part.mkdir(parents=True)
    found().write(part / attitude.FILE)  # as the search leaves it before the training
    run = reconstruct(session.path, "first", changes={**scenes.QUICK, "steps": 150})
    figures = evaluate(session.path, "first")
    facts = json.loads((run / "metrics.json").read_text())["attitude"]
    assert facts["kind"] == "tumble" and len(facts["inertia_ratios"]) == 2
    assert facts == figures["attitude"]
    known = small_session(tmp_path / "known")
    reconstruct(known, "first", changes={**scenes.QUICK, "steps": 150})
    expected = evaluate(known, "first")
    # the same frames in other axes of the body: the trainings differ by rounding and by the grid of the hull
    assert abs(figures["psnr_clean_db"] - expected["psnr_clean_db"]) < 1.5
    assert figures["chamfer"] < 1.3 * expected["chamfer"]


def test_frames_that_do_not_determine_the_attitude_leave_no_run(tmp_path):
    session = tumbling_session(tmp_path / "session")  # 21 brackets are for training
    with pytest.raises(AttitudeUndetermined, match="at least 26 are needed"):
        reconstruct(session.path, "first", changes=scenes.QUICK)
    assert list((session.path / "runs").iterdir()) == []


def test_tags_that_do_not_state_the_attitude_they_assume_give_no_inertial_poses(tmp_path):
    session = open_session(small_session(tmp_path / "session"))
    with pytest.raises(SessionError, match="--attitude tagged"):
        reconstruct(session.path, "first", changes=scenes.QUICK, attitude="unknown")
    stated = tuple(
        dataclasses.replace(r, quat_inertial_to_body=np.array([1.0, 0, 0, 0])) for r in session.frames
    )
    in_body_axes(dataclasses.replace(session, frames=stated), found())
