"""Pictures with times and CCSDS messages become a session and a model; what was found leaves as messages."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits

from flightsw.icd.ndm.formation import Formation
from flightsw.icd.ndm.write import Object, write_aem, write_oem
from flightsw.icd.quaternion import matrix_to_quat, quat_to_matrix
from flightsw.icd.tle import orbit_axes
from flightsw.navigation.orbit import propagate, sun_direction_gcrs
from flightsw.navigation.pose import target_attitude
from ground import predicted_image
from ground.formats.pictures.files import read_header
from ground.run.estimated_poses import write_estimate
from ground.run.navigation_messages import export_ndm
from ground.run.runs import open_run
from ground.session.folder import open_session
from ground.session.training_frames import training_frame
from obbgs_base.physics.navigation_errors import SharedParameters, displaced_motion
from obbgs_core.poses.corrections import motion_of
from obbgs_core.poses.estimate import PoseEstimate
from tests.golden_pass import (
    GRID_NS,
    MISSION,
    POSITION_M,
    SESSION,
    TAKEN_NS,
    check_poses,
    gcrs_to_cameras,
    ground,
    imported_from,
    write_pictures,
)

ANGLE_RAD = 1e-9
LAGRANGE = ("LAGRANGE", 9)
NAMES = {"target": Object("TARGET", "2007-026A"), "chaser": Object("CHASER", "2010-030A")}


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """A small pass as someone may have it: TIFFs of 16 bits, a table, and messages of both orbits and attitudes."""
    folder = tmp_path_factory.mktemp("pass")
    write_pictures(folder)
    taken, grid = TAKEN_NS, GRID_NS
    for role, name in NAMES.items():
        states = [propagate(getattr(MISSION.orbit, f"{role}_tle"), t) for t in grid]
        positions, velocities = (
            np.stack([getattr(s, key) for s in states]) for key in ("position_m", "velocity_m_s")
        )
        content = write_oem(name, "EARTH", grid, positions, velocities, None, grid[0], LAGRANGE)
        (folder / f"{role}.oem").write_bytes(content)
    attitudes = np.stack([matrix_to_quat(target_attitude(MISSION, t)) for t in grid])
    rates = np.tile([0, 0, 2 * np.pi / MISSION.target_attitude.period_s], (len(grid), 1))
    (folder / "target.aem").write_bytes(
        write_aem(NAMES["target"], "SC_BODY_1", grid, attitudes, rates, grid[0])
    )
    pointing = [matrix_to_quat(camera) for camera in gcrs_to_cameras()]
    (folder / "chaser.aem").write_bytes(
        write_aem(NAMES["chaser"], "CAMERA", taken, np.stack(pointing), None, taken[0])
    )
    (folder / "camera.yaml").write_text("fx_px: 1900.0\n")
    return folder


@pytest.fixture(scope="module")
def imported(folder, tmp_path_factory) -> Path:
    return imported_from(folder, "ndm", tmp_path_factory.mktemp("imported") / "session")


def test_an_import_has_the_poses_that_flight_tags(imported):
    session = open_session(imported)
    check_poses(session, ANGLE_RAD)
    for ours, flight in zip(session.frames, SESSION.frames, strict=True):
        assert ours.in_eclipse == flight.in_eclipse
        assert ours.exposure_time_s == pytest.approx(flight.exposure_time_s)


def test_one_import_and_one_reconstruct_make_a_model(imported):
    options = ["--set", "steps=60", "--set", "start.count=300", "--set", "growth.max_gaussians=400"]
    done = ground("reconstruct", "--session", imported, "--name", "run", *options)
    assert done.exit_code == 0, done.output
    run = open_run(imported, "run")
    longest = [record for record in run.session.frames if record.bracket_index == 2]
    own, others = [], []
    for record, other in zip(longest, [*longest[5:], *longest[:5]], strict=True):
        expected = predicted_image(run.gaussians, run.session, record, run.sensor, record.exposure_time_s)
        pictures = [run.session.dn(frame).ravel() for frame in (record, other)]
        likenesses = [np.corrcoef(expected.numpy().ravel(), picture)[0, 1] for picture in pictures]
        own.append(likenesses[0])
        others.append(likenesses[1])
    assert np.mean(own) > 0.8 and np.mean(others) < 0.6  # 0.92 and 0.46


def test_without_the_target_s_attitude_it_is_unknown(folder, tmp_path):
    for path in folder.iterdir():
        if path.name != "target.aem":
            (tmp_path / path.name).symlink_to(path)
    options = ("--exposures", folder / "table.csv", "--session", tmp_path / "s")
    done = ground("import", "--format", "ndm", "--from", tmp_path, *options)
    assert done.exit_code == 0, done.output
    session = open_session(tmp_path / "s")
    assert session.navigation.attitude == "unknown"
    first = session.frames[0]
    np.testing.assert_allclose(
        first.sun_dir_body, sun_direction_gcrs(first.mid_exposure_utc_ns), rtol=0, atol=3e-4
    )


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda f: (f / "camera.yaml").write_text("fx: 3"), r"camera\.yaml: camera\.fx: unknown key"),
        (lambda f: (f / "chaser.aem").unlink(), "chaser.aem is missing, which says where the camera looks"),
        (
            lambda f: (f / "camera.yaml").unlink(),
            r"camera\.yaml: No such file or directory; expected camera\.yaml",
        ),
        (lambda f: late(f), "the message covers"),
        (lambda f: (f / "table.csv").write_text("name,iso\nshot_000.tif,100\n"), "states no time"),
        (
            lambda f: (f / "table.csv").write_text("name,mid_exposure_utc\nshot_000.tif,noon\n"),
            "expected a time such",
        ),
    ],
)
def test_what_is_missing_is_said_in_a_line(folder, tmp_path, change, said):
    (tmp_path / "images").mkdir()
    (tmp_path / "images" / "shot_000.tif").write_bytes((folder / "images" / "shot_000.tif").read_bytes())
    lines = (folder / "table.csv").read_text().splitlines()
    (tmp_path / "table.csv").write_text("\n".join(lines[:2]) + "\n")
    for path in folder.glob("*.*em"):
        (tmp_path / path.name).write_bytes(path.read_bytes())
    (tmp_path / "camera.yaml").write_text("fx_px: 1900.0\n")
    change(tmp_path)
    options = ("--exposures", tmp_path / "table.csv", "--session", tmp_path / "s")
    done = ground("import", "--format", "ndm", "--from", tmp_path, *options)
    assert done.exit_code in (1, 2) and isinstance(done.exception, Exception)
    with pytest.raises(type(done.exception), match=said):
        raise done.exception
    assert not (tmp_path / "s").exists()


def late(folder: Path) -> None:
    text = (folder / "table.csv").read_text()
    (folder / "table.csv").write_text(text.replace("2026-07-21", "2026-07-22"))


def test_times_of_headers_are_of_the_beginning_unless_they_say_otherwise(tmp_path):
    header = fits.Header({"EXPTIME": 0.5, "DATE-OBS": "2026-07-21T10:52:30.25"})
    path = tmp_path / "a.fits"
    for more, expected in (
        ({}, (1_784_631_150_250_000_000, None)),
        ({"DATE-AVG": "2026-07-21T10:52:30.5"}, (1_784_631_150_250_000_000, 1_784_631_150_500_000_000)),
        ({"TIMESYS": "TT"}, (None, None)),
    ):
        fits.writeto(path, np.zeros((4, 4), np.uint16), fits.Header({**header, **more}), overwrite=True)
        light = read_header(path).light
        assert (light.taken_utc_ns, light.middle_utc_ns) == expected


def test_an_export_of_a_session_comes_back(imported, tmp_path):
    done = ground("export", imported, "--format", "ndm", "--out", tmp_path / "out")
    assert done.exit_code == 0, done.output
    files = {path.name: path.read_bytes() for path in (tmp_path / "out").iterdir()}
    assert set(files) == {"target.aem", "chaser.oem", "chaser.aem", "camera.yaml"}
    formation, session = Formation.of(files), open_session(imported)
    assert formation.chaser.centre == "TARGET"
    for record in session.frames:
        found = formation.at(record.mid_exposure_utc_ns)
        body, camera = quat_to_matrix(found.quat_gcrs_to_body), quat_to_matrix(found.quat_gcrs_to_chaser)
        np.testing.assert_allclose(
            body @ found.chaser_from_target_m, record.position_body_m, rtol=0, atol=POSITION_M
        )
        turn = camera @ body.T @ record.world_to_camera[:3, :3].T
        assert np.linalg.norm(turn - turn.T) / 2**1.5 < ANGLE_RAD
    # rates and velocities are those of the pass
    middle = session.frames[20].mid_exposure_utc_ns
    target, chaser = (propagate(tle, middle) for tle in (MISSION.orbit.target_tle, MISSION.orbit.chaser_tle))
    velocity = formation.at(middle).chaser_velocity_m_s
    np.testing.assert_allclose(velocity, chaser.velocity_m_s - target.velocity_m_s, rtol=0, atol=0.01)
    row = files["target.aem"].decode().split("DATA_START\n")[1].splitlines()[5].split()
    np.testing.assert_allclose(
        np.array(row[5:], float), [0, 0, 360 / MISSION.target_attitude.period_s], atol=1e-5
    )


def test_what_a_run_found_leaves_as_messages(imported, tmp_path):
    """A run that shifted the orbit and turned the target: the messages have both, with what is left in doubt."""
    run = open_run(imported, "run")
    records = list(run.session.frames)
    epoch_ns = records[0].mid_exposure_utc_ns
    sigmas = SharedParameters(
        position_m=np.full(3, 0.5), velocity_m_s=np.full(3, 1e-4), attitude_rad=np.full(3, 0.02)
    )
    mean_motion, to_rtn = orbit_axes(MISSION.orbit.target_tle, epoch_ns)
    navigation = dataclasses.replace(
        run.session.navigation,
        epoch_utc_ns=epoch_ns,
        mean_motion_rad_s=mean_motion,
        quat_inertial_to_rtn=tuple(matrix_to_quat(to_rtn).tolist()),
        sigmas=sigmas,
    )
    session = dataclasses.replace(run.session, navigation=navigation)
    frames = [training_frame(session, record) for record in records]
    found = SharedParameters(
        position_m=np.array([0.4, -0.3, 0.2]), attitude_rad=np.array([0.01, -0.02, 0.015])
    )
    moved = displaced_motion(motion_of(frames), found)
    own = np.zeros((len(records), 6))
    estimate = PoseEstimate(
        frame_ids=[record.id for record in records],
        brackets=list(range(len(records))),
        tagged=np.stack([record.world_to_camera for record in records]),
        estimated=moved.world_to_camera,
        shared=found,
        shared_prior=sigmas,
        shared_posterior=sigmas,
        shared_covariance=np.diag(SharedParameters(position_m=np.array([0.1, 0.2, 0.3])).vector() ** 2),
        own=own,
        own_prior=own,
        own_posterior=own,
    )
    write_estimate(tmp_path, estimate)
    metrics = {**run.metrics, "scored_frames": "training"}
    run = dataclasses.replace(run, folder=tmp_path, session=session, training=records, metrics=metrics)
    export_ndm(session, tmp_path / "out", run)
    formation = Formation.of({path.name: path.read_bytes() for path in (tmp_path / "out").glob("*em")})
    for place in (0, 10, len(records) - 1):
        state = formation.at(records[place].mid_exposure_utc_ns)
        np.testing.assert_allclose(
            state.chaser_from_target_m, moved.position_m[place], rtol=0, atol=POSITION_M
        )
        turn = quat_to_matrix(state.quat_gcrs_to_body) @ moved.inertial_to_body[place].T
        # training frames hold attitudes and poses in single precision
        assert np.linalg.norm(turn - turn.T) / 2**1.5 < 1e-6
    first = formation.at(epoch_ns).covariance
    assert first is not None
    expected = to_rtn.T @ np.diag([0.01, 0.04, 0.09]) @ to_rtn
    np.testing.assert_allclose(first[:3, :3], expected, rtol=0, atol=1e-4)
