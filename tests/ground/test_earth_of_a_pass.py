"""A real pass with the Earth behind the target: where it is, by skyfield, and that a training knows it."""

import dataclasses
import json
from datetime import UTC, datetime
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pycolmap
import pytest
import skyfield.api
import torch
from scipy.spatial.transform import Rotation
from skyfield.api import EarthSatellite
from typer.testing import CliRunner

from flightsw.icd.frame import Frame, encode_frame
from flightsw.icd.mission import Mission
from flightsw.icd.quaternion import matrix_to_quat, quat_to_matrix
from flightsw.icd.tle import position_gcrs_m
from flightsw.navigation.pose import pose_tag
from ground import cli
from ground.run.evaluate import evaluate
from ground.run.reconstruct import reconstruct
from ground.run.runs import Run
from ground.session.cameras import sensor_of
from ground.session.folder import Session, open_session
from ground.session.motion import rates
from ground.session.training_frames import frames_of, training_frame
from ground.session.writer import SessionWriter
from ground.show.report.poses import _of_earth, pose_history
from ground.show.viewer import viewer
from ground.show.viewer.source import Shown
from ground.show.viewer.splats import best_seen
from obbgs_base.physics.earth import camera_rays, earth_radiance
from obbgs_base.physics.navigation_errors import SIZE, SharedParameters
from obbgs_core.background import earth_pixels
from obbgs_core.model.cameras import Cameras
from obbgs_core.poses.estimate import PoseEstimate
from obbgs_core.render import render
from tests import scenes

SHOWS_IT_S, BESIDE_IT_S = 200, 800  # after the mission's start the Earth is behind the target, and is not
EXPOSURES_S = (2e-5, 5e-5)
OFF_PX = 6.0
TIMES = skyfield.api.load.timescale(builtin=True)


@pytest.fixture
def mission(small_mission) -> Mission:
    """Return the demo's mission with 48 pixels that look at the target."""
    camera = dataclasses.replace(small_mission.camera, cx_px=24.0, cy_px=24.0, fx_px=1800.0, fy_px=1800.0)
    return dataclasses.replace(small_mission, camera=camera)


def flown(mission, folder, times_s, earth: bool = True, target=None):
    """Write a session of frames at times after the start: a target, if any, in front of a black sky or the Earth."""
    writer, camera = SessionWriter(folder, mission), mission.camera
    for number, at_s in enumerate(times_s):
        utc_ns, exposure_s = mission.orbit.start_utc_ns + round(at_s * 1e9), EXPOSURES_S[number % 2]
        pose = pose_tag(mission, utc_ns)
        light, through = np.zeros((camera.height, camera.width)), 1.0
        if target is not None:
            K = torch.tensor(camera.K, dtype=torch.float32)
            w2c = torch.from_numpy(pose.world_to_camera).float()
            seen = render(target, Cameras(w2c[None], K[None], camera.width, camera.height))
            light, through = seen.radiance[0, ..., 0].numpy(), 1 - seen.alpha[0].numpy()
        if earth:
            light = light + through * light_of_earth(mission, utc_ns, pose)
        noise = np.random.default_rng(number).standard_normal(light.shape)
        dn = camera.black_dn + camera.dn_per_radiance_s * exposure_s * light + camera.read_noise_dn * noise
        dn = np.rint(dn).clip(0, camera.white_dn).astype(np.uint16)
        frame = Frame(
            number, number // 2, number % 2, 2, exposure_s, utc_ns, pose, dn, 12, camera.black_dn, 0
        )
        writer.add(frame, encode_frame(frame))
    writer.save({}, 0)
    return open_session(folder)


def light_of_earth(mission, utc_ns, pose) -> np.ndarray:
    """Return the Earth's light [H, W]."""
    rays = camera_rays(np.array(mission.camera.K), mission.camera.width, mission.camera.height)
    sun = pose.world_to_camera[:3, :3] @ pose.sun_dir_body
    return earth_radiance(rays, -by_skyfield(mission, utc_ns, pose), sun, 1e-3).mean(axis=2)


def by_skyfield(mission, utc_ns, pose) -> np.ndarray:
    """Return where the Earth's centre is: [3] m from the camera, in its axes."""
    time = TIMES.from_datetime(datetime.fromtimestamp(utc_ns / 1e9, UTC))
    target_m = EarthSatellite(*mission.orbit.target_tle, ts=TIMES).at(time).xyz.m
    in_body_m = -(quat_to_matrix(pose.quat_inertial_to_body) @ target_m) - pose.position_body_m
    return pose.world_to_camera[:3, :3] @ in_body_m


def test_the_earths_centre_is_where_skyfield_has_it(mission, tmp_path):
    session = flown(mission, tmp_path / "session", [SHOWS_IT_S, SHOWS_IT_S + 27])
    for record in session.frames:
        frame = training_frame(session, record)
        assert frame.earth_m is not None and earth_pixels(frame).all()
        true_m = by_skyfield(mission, record.mid_exposure_utc_ns, record)
        np.testing.assert_allclose(
            frame.earth_m.numpy(), true_m, atol=30.0
        )  # of 6,900 km: 0.2 seconds of arc


def test_no_earth_is_in_frames_that_look_away_from_it_or_do_not_show_it(mission, tmp_path):
    assert frames_of(flown(mission, tmp_path / "beside", [BESIDE_IT_S]))[0].earth_m is None
    # a simulator's black sky, and a night side as dark
    assert frames_of(flown(mission, tmp_path / "black", [SHOWS_IT_S], earth=False))[0].earth_m is None
    seen = flown(mission, tmp_path / "seen", [SHOWS_IT_S])
    nobody_knows = dataclasses.replace(seen.frames[0], quat_inertial_to_body=None)
    assert training_frame(seen, nobody_knows).earth_m is None


def test_a_frame_may_state_the_targets_place_itself(mission, tmp_path):
    session = flown(mission, tmp_path / "session", [SHOWS_IT_S])
    record, without = session.frames[0], dataclasses.replace(session, tles={})
    assert training_frame(without, record).earth_m is None
    place_m = position_gcrs_m(mission.orbit.target_tle, record.mid_exposure_utc_ns)
    stated = dataclasses.replace(record, target_position_m=place_m)
    assert torch.equal(training_frame(without, stated).earth_m, training_frame(session, record).earth_m)


def opaque_target():
    small = scenes.target()
    return dataclasses.replace(
        small,
        means=1.5 * small.means,
        log_scales=small.log_scales + np.log(1.5),
        opacity_logits=small.opacity_logits + 4,
    )


def test_the_earth_stays_where_the_tag_has_it_when_another_pose_was_found(mission, tmp_path):
    """Once the target's attitude is corrected, the pose no longer goes with the attitude that the tag assumes."""
    session = flown(mission, tmp_path / "session", [SHOWS_IT_S], True, opaque_target())
    record, turn = session.frames[0], np.eye(4)
    turn[:3, :3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    placed = dataclasses.replace(record, world_to_camera=record.world_to_camera @ turn)
    run = Run(tmp_path, session, [], [record], sensor_of(session.camera), opaque_target(), None, {})
    tagged = training_frame(session, record)
    seen = run.without_sky_level(placed)
    assert torch.equal(seen.earth_m, tagged.earth_m)
    assert not torch.equal(seen.world_to_camera, tagged.world_to_camera)


def test_the_viewer_counts_no_earth_as_error_and_begins_where_none_is_seen(mission, tmp_path):
    """The model is the truth, so that without the Earth hardly anything is left of the error."""
    times_s = [SHOWS_IT_S, SHOWS_IT_S, BESIDE_IT_S, BESIDE_IT_S]
    session, target = flown(mission, tmp_path / "session", times_s, True, opaque_target()), opaque_target()
    shown = Shown("A", session, sensor_of(session.camera), target, None, session, None)
    width = session.camera.width
    compared = viewer._compared(SimpleNamespace(shown=shown), session.frames[1])  # pyright: ignore[reportArgumentType]
    frame, error = compared[:, :width], compared[:, 2 * width :]
    assert frame[0].mean() > 40 and error.mean() < 10
    assert best_seen(shown, EXPOSURES_S[1]).id == 3


def test_the_report_looks_for_a_target_in_front_of_the_earth_where_its_pose_was_found(mission, tmp_path):
    """The model is the truth; tags place it 20 px beside itself."""
    target, count = opaque_target(), 4
    session = flown(mission, tmp_path / "session", [SHOWS_IT_S + n for n in range(count)], True, target)
    true = np.array([record.world_to_camera for record in session.frames])
    aside = np.eye(4)
    aside[0, 3] = 20 / 1800 * true[0, 2, 3]
    tagged = [dataclasses.replace(r, world_to_camera=aside @ r.world_to_camera) for r in session.frames]
    sigmas = SharedParameters(boresight_rad=np.full(3, 0.02))
    session = dataclasses.replace(
        session, frames=tuple(tagged), navigation=dataclasses.replace(session.navigation, sigmas=sigmas)
    )
    none = np.zeros((count, 6))
    estimate = PoseEstimate(
        frame_ids=[record.id for record in tagged],
        brackets=list(range(count)),
        tagged=np.array([record.world_to_camera for record in tagged]),
        estimated=true,
        shared=SharedParameters(),
        shared_prior=sigmas,
        shared_posterior=sigmas,
        shared_covariance=np.zeros((SIZE, SIZE)),
        **dict.fromkeys(("own", "own_prior", "own_posterior"), none),
    )
    run = Run(session.path, session, tagged, [], sensor_of(session.camera), target, None, {})
    history = pose_history(run, estimate)
    assert all(frame.earth_m is not None for frame in frames_of(session))
    assert (history.chi2_estimated < 0.02 * history.chi2_tagged).all()
    assert "All of these frames have the Earth in view" in _of_earth(run, history.frame_ids[:2], "frame")
    assert _of_earth(run, [], "frame") == ""


def test_a_pass_with_the_earth_makes_a_model_like_that_of_a_black_sky(mission, tmp_path):
    """Scored on what is left of the held-out frames without the Earth, which those in front of it have for the most."""
    target, psnr_db = opaque_target(), {}
    for name, earth in (("black", False), ("earth", True)):
        times_s = [44.0 * (n // 2) + n % 2 for n in range(48)]
        session = flown(mission, tmp_path / name, times_s, earth, target)
        count = sum(frame.earth_m is not None for frame in frames_of(session))
        assert (8 < count < 40) if earth else count == 0, count
        reconstruct(session.path, "run", "obbgs", scenes.QUICK | {"steps": 60})
        psnr_db[name] = evaluate(session.path, "run")["psnr_noisy_db"]
    assert psnr_db["earth"] > psnr_db["black"] - 3, psnr_db


@pytest.mark.parametrize("format_", ["nerf", "nerfstudio", "colmap"])
def test_the_earth_stays_behind_frames_that_are_exported_and_imported(mission, tmp_path, format_):
    session = flown(mission, tmp_path / "session", [SHOWS_IT_S, SHOWS_IT_S + 27])
    again = passed_on(session.path, tmp_path, format_)
    for was, now in zip(frames_of(session), frames_of(again), strict=True):
        assert was.earth_m is not None and now.earth_m is not None
        np.testing.assert_allclose(now.earth_m.numpy(), was.earth_m.numpy(), atol=30.0)  # of 6,900 km
    for was, now in zip(session.frames, again.frames, strict=True):
        blur = rates(session, was)
        assert blur is not None and blur.abs().max() > 1e-4
        np.testing.assert_allclose(rates(again, now), blur, atol=1e-6)


def test_the_earth_is_where_it_was_for_a_colmap_model_that_other_software_turned(mission, tmp_path):
    session = flown(mission, tmp_path / "session", [SHOWS_IT_S, SHOWS_IT_S + 27])
    called("export", session.path, "--format", "colmap", "--out", tmp_path / "out")
    model = pycolmap.Reconstruction(str(tmp_path / "out" / "sparse" / "0"))
    turn = Rotation.from_rotvec([0.3, -1.0, 0.5])
    model.transform(pycolmap.Sim3d(1.0, pycolmap.Rotation3d(turn.as_quat()), np.array([0.1, 0.2, 0.3])))
    model.write(str(tmp_path / "out" / "sparse" / "0"))
    called("import", "--format", "colmap", "--from", tmp_path / "out", "--session", tmp_path / "again")
    for was, now in zip(session.frames, open_session(tmp_path / "again").frames, strict=True):
        assert not np.allclose(now.world_to_camera, was.world_to_camera, atol=0.1)
        in_camera = now.world_to_camera[:3, :3] @ now.sun_dir_body
        np.testing.assert_allclose(in_camera, was.world_to_camera[:3, :3] @ was.sun_dir_body, atol=1e-6)
        places = [
            training_frame(open_session(path), r).earth_m
            for path, r in ((session.path, was), (tmp_path / "again", now))
        ]
        np.testing.assert_allclose(places[1], places[0], atol=30.0)


def test_a_refined_pass_with_the_earth_is_trained_the_same_after_export_and_import(mission, tmp_path):
    """Tags are 6 pixels off; the exported poses are those that the training found, with the Earth where it was."""
    times_s = [44.0 * (n // 2) + n % 2 for n in range(48)]
    session = flown(mission, tmp_path / "session", times_s, True, opaque_target())
    turned_aside(session.path, OFF_PX / mission.camera.fx_px)
    with pytest.MonkeyPatch.context() as patch:
        scenes.move_poses_in(patch, 2)
        reconstruct(session.path, "run", "obbgs", scenes.QUICK | {"steps": 60})
        first = evaluate(session.path, "run")
        assert first["poses"].startswith("refined")
        again = passed_on(session.path / "runs" / "run", tmp_path, "colmap")
        reconstruct(again.path, "run", "obbgs", scenes.QUICK | {"steps": 60})
    assert sum(frame.earth_m is not None for frame in frames_of(again)) > 8
    second = evaluate(again.path, "run")
    assert second["psnr_noisy_db"] > first["psnr_noisy_db"] - 0.3


def turned_aside(folder: Path, turn_rad: float) -> None:
    """Turn the camera of all tags of a session by an angle, and let it state errors of that size."""
    turn, lines = np.eye(4), [json.loads(line) for line in (folder / "frames.jsonl").read_text().splitlines()]
    turn[:3, :3] = Rotation.from_rotvec([turn_rad, -turn_rad, 0]).as_matrix()
    for line in lines:
        pose = turn @ np.array(line["world_to_camera"])
        line["world_to_camera"] = pose.tolist()
        line["quat_body_to_camera"] = matrix_to_quat(pose[:3, :3]).tolist()
        del line["crc32"]
    header = json.loads((folder / "session.json").read_text())
    del header["crc32"]
    header["navigation"]["sigmas"]["boresight_rad"] = [turn_rad] * 3
    for name, text in (
        ("frames.jsonl", "".join(json.dumps(line) + "\n" for line in lines)),
        ("session.json", json.dumps(header)),
    ):
        (folder / f"{name}.copy").unlink()
        (folder / name).write_text(text)


def passed_on(source: Path, folder: Path, format_: str) -> Session:
    """Return the session that comes of a session's or run's export and its import."""
    out, again = folder / "out", folder / "again"
    called("export", source, "--format", format_, "--out", out)
    called("import", "--format", format_, "--from", out, "--session", again, "--poses", "stated")
    return open_session(again)


def called(*arguments) -> None:
    """Call a command of `ground`."""
    done = CliRunner().invoke(cli.app, list(map(str, arguments)), catch_exceptions=False)
    assert done.exit_code == 0, done.output
