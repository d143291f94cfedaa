"""The pass of tests/golden as other tools have it: pictures with times, a table, and what its cameras looked at."""

from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import tifffile
from click.testing import Result
from typer.testing import CliRunner

from flightsw.icd.mission import load_mission
from flightsw.icd.quaternion import quat_to_matrix
from flightsw.navigation.pose import pose_tag, target_attitude
from ground import cli
from ground.session.folder import Session, open_session

GOLDEN = Path(__file__).parent / "golden"
MISSION = load_mission(GOLDEN / "mission.yaml")
SESSION = open_session(GOLDEN / "session")
NS = 1_000_000_000
TAKEN_NS = [record.mid_exposure_utc_ns for record in SESSION.frames]
GRID_NS = list(range(TAKEN_NS[0] - 60 * NS, TAKEN_NS[-1] + 60 * NS, 10 * NS))
POSITION_M = 1e-3


def ground(*arguments: object) -> Result:
    return CliRunner().invoke(cli.app, [str(a) for a in arguments])


def utc(time_ns: int) -> str:
    seconds, ns = divmod(time_ns, NS)
    return datetime.fromtimestamp(seconds, UTC).strftime("%Y-%m-%dT%H:%M:%S") + f".{ns:09}"


def write_pictures(folder: Path) -> None:
    """Write TIFFs of 16 bits and a table of their exposure times."""
    (folder / "images").mkdir()
    rows = ["name,exposure_time_s,mid_exposure_utc"]
    for record in SESSION.frames:
        # full scale of 12 bits, without the black level, as calibrated pictures are
        dn = np.clip(SESSION.dn(record).astype(float) - 64.0, 0, None) / (4095 - 64) * 65535
        name = f"shot_{record.id:03}.tif"
        tifffile.imwrite(folder / "images" / name, np.rint(dn).astype(np.uint16))
        rows.append(f"{name},{record.exposure_time_s!r},{utc(record.mid_exposure_utc_ns)}")
    (folder / "table.csv").write_text("\n".join(rows) + "\n")


def gcrs_to_cameras() -> np.ndarray:
    """Return the rotations [N, 3, 3] from GCRS to the camera at each frame."""
    return np.stack(
        [
            quat_to_matrix(pose_tag(MISSION, t).quat_body_to_camera) @ target_attitude(MISSION, t)
            for t in TAKEN_NS
        ]
    )


def imported_from(folder: Path, format_: str, session: Path) -> Path:
    options = ("--poses", "stated", "--exposures", folder / "table.csv")
    done = ground("import", "--format", format_, "--from", folder, "--session", session, *options)
    assert done.exit_code == 0, done.output
    return session


def check_poses(session: Session, angle_rad: float) -> None:
    """Check that a session has the frames of the pass in the poses that flight tags."""
    assert len(session.frames) == len(SESSION.frames) and session.navigation.attitude == "known"
    for ours, flight in zip(session.frames, SESSION.frames, strict=True):
        tag = pose_tag(MISSION, flight.mid_exposure_utc_ns)
        assert (ours.bracket, ours.bracket_index) == (flight.bracket, flight.bracket_index)
        assert ours.mid_exposure_utc_ns == flight.mid_exposure_utc_ns
        np.testing.assert_allclose(ours.position_body_m, tag.position_body_m, rtol=0, atol=POSITION_M)
        turn = ours.world_to_camera[:3, :3] @ quat_to_matrix(tag.quat_body_to_camera).T
        assert np.linalg.norm(turn - turn.T) / 2**1.5 < angle_rad
        assert tag.sun_dir_body @ ours.sun_dir_body > np.cos(np.radians(0.02))
        assert ours.quat_inertial_to_body is not None
