"""A session of a target of unknown attitude: seen from axes that were found, trained, and scored against the truth."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from flightsw.icd.quaternion import matrix_to_quat
from ground import cli
from ground.run import attitude
from ground.run.attitude import FoundAttitude, in_body_axes, refined_motion
from ground.run.attitude_choice import chosen_by_training
from ground.run.evaluate import evaluate
from ground.run.live.reconstruct import reconstruct_live
from ground.run.reconstruct import reconstruct
from ground.run.runs import open_run
from ground.session.cameras import sensor_of
from ground.session.folder import Navigation, Session, SessionError, open_session
from ground.session.training_frames import training_frame
from ground.session.truth import Truth
from ground.show.report.attitude import attitude_section
from ground.show.sizes import with_deviation
from obbgs_base.errors import Interrupted
from obbgs_base.physics.navigation_errors import SharedParameters, displaced
from obbgs_core.attitude.estimate import AttitudeUndetermined
from obbgs_core.attitude.motion import at_epoch, attitudes, principal
from obbgs_core.attitude.search import mirrored
from obbgs_core.attitude.target_motion import TargetMotion
from obbgs_core.poses.corrections import motion_of
from obbgs_core.poses.estimate import PoseEstimate
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


def test_commands_that_cannot_find_an_attitude_say_who_can(tmp_path):
    folder = tumbling_session(tmp_path / "session").path
    for command in (
        ["compare", str(folder), "--methods", "black", "--out", str(tmp_path / "c")],
        ["export", str(folder), "--out", str(tmp_path / "e")],
    ):
        done = CliRunner().invoke(cli.app, command, env={"COLUMNS": "200"})
        assert done.exit_code == 1, done.output
        assert "`ground reconstruct` finds the attitude" in str(done.exception)
    assert not (tmp_path / "e").exists()
    with pytest.raises(SessionError, match="`ground reconstruct` finds the attitude"):
        reconstruct_live(folder, idle_timeout_s=0.0)


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


def test_a_training_may_change_what_was_found_into_the_truth(tmp_path):
    """The session in found axes states a rotation whose shared parameters lead to the true poses."""
    true = in_principal_axes(PARAMETERS)
    errors = np.array([1e-3, -8e-4, 5e-4, 2e-3, -5e-3, 2e-3, 5e-3, -2e-3])
    wrong = in_principal_axes(PARAMETERS + errors)
    session = tumbling_session(tmp_path / "session")
    orbit_errs = Navigation(
        attitude="unknown", epoch_utc_ns=10**9, sigmas=SharedParameters(position_m=[1.0] * 3)
    )
    wanted = in_body_axes(session, FoundAttitude(0, true))
    for navigation in (session.navigation, orbit_errs):  # the epoch of the orbit's errors is the tags'
        stated = dataclasses.replace(session, navigation=navigation)
        turned = in_body_axes(stated, FoundAttitude(0, wrong))
        assert (turned.navigation.sigmas.position_m == navigation.sigmas.position_m).all()
        frames = [training_frame(turned, record) for record in turned.frames]
        at = turned.navigation.epoch_utc_ns / 1e9
        right, found_wrong = true.at_epoch(at), wrong.at_epoch(at)
        change = SharedParameters(
            attitude_rad=Rotation.from_matrix(right.epoch_to_body @ found_wrong.epoch_to_body.T).as_rotvec(),
            rate_rad_s=right.rate_body_rad_s - found_wrong.rate_body_rad_s,
            inertia_ratios=(true.moments / wrong.moments)[:2] - 1,
        )
        poses = displaced(motion_of(frames), change)
        for pose, record in zip(poses, wanted.frames, strict=True):
            np.testing.assert_allclose(pose, record.world_to_camera, atol=2e-5)  # tags are float32
        estimate = one_estimate(change, turned.navigation.sigmas)
        refined = refined_motion(FoundAttitude(0, wrong), turned, estimate)
        np.testing.assert_allclose(refined.parameters, true.parameters, atol=1e-6)


def in_principal_axes(parameters: np.ndarray) -> TargetMotion:
    sigmas = np.concatenate([np.full(3, 1e-3), np.full(5, 5e-3)])
    return TargetMotion(parameters, np.diag(sigmas**2), principal(parameters).axes.T, 0.02, 24)


def one_estimate(change: SharedParameters, sigmas: SharedParameters) -> PoseEstimate:
    none = np.zeros((0, 6))
    covariance = np.diag(sigmas.vector() ** 2) / 100
    poses = np.zeros((0, 4, 4))
    return PoseEstimate([], [], poses, poses, change, sigmas, sigmas, covariance, none, none, none)


def test_an_interrupted_run_goes_on_with_the_attitude_that_it_found(tmp_path):
    session = tumbling_session(tmp_path / "session")
    part = session.path / "runs" / ".first.part"
    part.mkdir(parents=True)
    found().write(part / attitude.FILE)  # as the search leaves it before the training
    run = reconstruct(session.path, "first", changes={**scenes.QUICK, "steps": 150})
    figures = evaluate(session.path, "first")
    metrics = json.loads((run / "metrics.json").read_text())
    facts = metrics["attitude"]
    assert facts["kind"] == "tumble" and len(facts["inertia_ratios"]) == 2
    assert facts == figures["attitude"] and metrics["attitude_from_outlines"] == found().motion.facts()
    assert metrics["poses"] == "refined"
    known = small_session(tmp_path / "known")
    reconstruct(known, "first", changes={**scenes.QUICK, "steps": 150})
    expected = evaluate(known, "first")
    # the same frames in other axes of the body, on another grid of the hull, and with poses that may move
    assert figures["psnr_clean_db"] > expected["psnr_clean_db"] - 1.5
    assert figures["chamfer"] < 1.3 * expected["chamfer"]
    page = attitude_section(open_run(session.path, "first"))
    rate = with_deviation(facts["rate_deg_s"], facts["rate_sigma_deg_s"])
    assert "refined together with the model" in page and f"{rate} deg/s" in page
    assert attitude_section(open_run(known, "first")) == ""


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


def test_short_trainings_tell_a_motion_from_that_of_the_mirrored_target(tmp_path):
    session = tumbling_session(tmp_path / "session")
    frames = [training_frame(session, record) for record in session.frames]
    times_s = np.array([record.mid_exposure_utc_ns / 1e9 for record in session.frames])
    true = in_principal_axes(PARAMETERS)
    to_inertial = frames[0].world_to_camera[:3, :3].double().numpy().T
    mirror = in_principal_axes(mirrored(PARAMETERS[None], to_inertial)[0])
    arguments = (frames, times_s, sensor_of(session.camera))
    assert (
        chosen_by_training(*arguments, [mirror, true]) == 1
    )  # by 5.3 standard errors, where 3 are asked for
    assert chosen_by_training(*arguments, [true, true]) is None  # one motion is not better than itself
    with pytest.raises(Interrupted):
        chosen_by_training(*arguments, [true, mirror], should_stop=lambda: True)
