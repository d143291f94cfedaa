"""What a session or a run says of orbit and attitudes, as navigation data messages of CCSDS (NDM).

    target.aem     the target's attitude and rate
    chaser.oem     the camera's path about the target, with covariance
    chaser.aem     the camera's attitude
    camera.yaml    its lens

`ground import --format ndm` and a mission's `navigation.source` read them again.
"""

from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import yaml

from flightsw.icd.ndm.write import Object, write_aem, write_oem
from flightsw.icd.quaternion import matrix_to_quat, quat_to_matrix
from ground.run.estimated_poses import read_estimate, refined_session
from ground.run.runs import Run
from ground.session.folder import FrameRecord, Session, SessionError
from ground.session.training_frames import frames_of, motion_covariance, usable
from obbgs_base.files import write_whole
from obbgs_base.physics.free_rotation import stepped_rotation, turning_of
from obbgs_base.physics.navigation_errors import (
    DIFFERENCES,
    LENGTHS,
    NominalMotion,
    SharedParameters,
    displaced_motion,
)
from obbgs_core.poses.corrections import motion_of
from obbgs_core.poses.estimate import PoseEstimate

NS = 1_000_000_000
CAMERA_FRAME = "CAMERA"
BODY_FRAME = "SC_BODY_1"
ABOUT_INERTIAL = ("position_m", "velocity_m_s", "clock_s")  # shared parameters that move the camera's path


def export_ndm(session: Session, out: Path, run: Run | None = None) -> dict[str, int]:
    """Write the messages of a session's poses, of a run as it refined them, and return the number of their rows.

    A pose says where the camera is in the body's axes, and its tag how these lay in inertial ones. A run corrects both:
    the target's attitude by the shared parameters that turn it, the camera by all others.

    Raises:
        SessionError: the tags do not say which attitude of the target they assume, or there are no two brackets.
    """
    posed = session if run is None else refined_session(run)
    estimate = None if run is None else read_estimate(run.folder)
    tagged = {record.id: record for record in session.frames}
    records = sorted(usable(posed.frames), key=lambda record: record.mid_exposure_utc_ns)
    records = [
        r
        for i, r in enumerate(records)
        if i == 0 or r.mid_exposure_utc_ns > records[i - 1].mid_exposure_utc_ns
    ]
    unknown = [r.id for r in records if r.quat_inertial_to_body is None]
    if unknown or (session.navigation.attitude == "unknown" and run is None):
        raise SessionError(
            f"{session.path}: its tags do not say how the target's axes lay in inertial ones; export a run that found "
            "the attitude, or a session whose tags say it"
        )
    brackets = {record.bracket for record in records}
    if len(brackets) < 2:
        raise SessionError(
            f"{session.path}: expected at least two brackets, whose way is an orbit, got {len(brackets)}"
        )
    to_body, rates = _attitudes(session, [tagged[r.id] for r in records], estimate)
    to_camera = np.stack([r.world_to_camera[:3, :3] for r in records]) @ to_body
    positions_m = np.stack([t.T @ r.position_body_m for t, r in zip(to_body, records, strict=True)])
    own = _position_covariances(session, [tagged[r.id] for r in records], records, to_camera, estimate)
    velocities, covariances = _with_velocities(records, positions_m, own, session.frames_err_alone)
    times, now_ns = [r.mid_exposure_utc_ns for r in records], round(datetime.now(UTC).timestamp()) * NS
    target, chaser = _objects(session)
    quats = [np.stack([matrix_to_quat(matrix) for matrix in turns]) for turns in (to_body, to_camera)]
    files = {
        "target.aem": write_aem(target, BODY_FRAME, times, quats[0], rates, now_ns),
        "chaser.oem": write_oem(chaser, target.name, times, positions_m, velocities, covariances, now_ns),
        "chaser.aem": write_aem(chaser, CAMERA_FRAME, times, quats[1], None, now_ns),
        "camera.yaml": _camera_yaml(session),
    }
    out.mkdir(parents=True, exist_ok=True)
    for name, content in files.items():
        write_whole(out / name, content)
    return {"attitudes": len(times), "states": len(times)}


def _attitudes(
    session: Session, records: list[FrameRecord], estimate: PoseEstimate | None
) -> tuple[np.ndarray, np.ndarray]:
    """Return inertial_to_body [N, 3, 3] of tagged records as an estimate corrects them, and rates [N, 3] rad/s."""
    times_s = np.array([(r.mid_exposure_utc_ns - session.navigation.epoch_utc_ns) / 1e9 for r in records])
    to_body = np.stack(
        [quat_to_matrix(r.quat_inertial_to_body) for r in records if r.quat_inertial_to_body is not None]
    )
    motion = _motion(session, records)
    if motion is not None and estimate is not None:
        motion = displaced_motion(motion, estimate.shared)
        to_body = motion.inertial_to_body
    if motion is not None and motion.rate_rad_s.any():
        rate, inertia = motion.rate_rad_s[None], motion.inertia[None]
        return to_body, stepped_rotation(times_s, rate, inertia, motion.rate_steps)[1][0]
    return to_body, turning_of(times_s, to_body).rates_rad_s


def _motion(session: Session, records: list[FrameRecord]) -> NominalMotion | None:
    """Return the motion that tags assume; None where they share no errors."""
    frames = frames_of(session, records)
    return None if frames[0].navigation is None else motion_of(frames)


def _position_covariances(
    session: Session,
    tagged: list[FrameRecord],
    records: list[FrameRecord],
    to_camera: np.ndarray,
    estimate: PoseEstimate | None,
) -> np.ndarray:
    """Return the covariances [N, 3, 3] of the camera's positions relative to the target, inertial axes, m2.

    How the target is turned is not known exactly either, but does not move the camera in inertial axes.
    """
    own = np.stack([motion_covariance(r.covariance, r.world_to_camera[:3, :3])[3:, 3:] for r in tagged])
    if estimate is not None:
        row_of = dict(zip(estimate.frame_ids, estimate.brackets, strict=True))
        for place, record in enumerate(records):
            if record.id in row_of:
                own[place] = np.diag(estimate.own_posterior[row_of[record.id], 3:] ** 2)
    own = to_camera.swapaxes(1, 2) @ own @ to_camera
    motion = _motion(session, tagged)
    if motion is None:
        return own
    shared = SharedParameters() if estimate is None else estimate.shared
    covariance = np.diag(session.navigation.sigmas.vector() ** 2)
    if estimate is not None:
        covariance = estimate.shared_covariance
    columns = np.zeros((len(records), 3, sum(LENGTHS.values())))
    place = 0
    for name, length in LENGTHS.items():
        for index in range(length if name in ABOUT_INERTIAL else 0):
            step = np.zeros(columns.shape[2])
            step[place + index] = DIFFERENCES[name]
            sides = [
                displaced_motion(motion, SharedParameters.of(shared.vector() + s)) for s in (step, -step)
            ]
            columns[:, :, place + index] = (sides[0].position_m - sides[1].position_m) / (
                2 * DIFFERENCES[name]
            )
        place += length
    return own + columns @ covariance @ columns.swapaxes(1, 2)


def _with_velocities(
    records: list[FrameRecord], positions_m: np.ndarray, covariances: np.ndarray, alone: bool = False
) -> tuple[np.ndarray, np.ndarray]:
    """Return velocities [N, 3] m/s, and covariances [N, 6, 6] with theirs.

    A velocity is the slope, at the frame's time, of the parabola through its bracket and the two nearest ones, of which
    each counts as the mean of its frames: those share their error, unless each errs `alone`.
    """
    times_s = np.array([r.mid_exposure_utc_ns - records[0].mid_exposure_utc_ns for r in records]) / 1e9
    groups = [r.id if alone else r.bracket for r in records]
    of_bracket = np.unique(groups, return_inverse=True)[1]
    count = of_bracket.max() + 1
    means = np.stack([(of_bracket == b) / (of_bracket == b).sum() for b in range(count)])  # [B, N]
    at_s, places = means @ times_s, means @ positions_m
    doubts = np.einsum("bn,nij->bij", means, covariances)
    velocities, found = np.zeros_like(positions_m), np.zeros((len(records), 6, 6))
    for row, own in enumerate(of_bracket):
        near = np.sort(np.argsort(np.abs(at_s - at_s[own]), kind="stable")[: min(3, count)])
        span = at_s[near] - at_s[own]
        powers = np.vander(span, increasing=True)
        ahead = times_s[row] - at_s[own]
        slope = np.arange(len(near)) * np.append(0.0, ahead ** np.arange(len(near) - 1))
        weights = np.linalg.solve(powers.T, slope)
        velocities[row] = weights @ places[near]
        own_weight = weights[np.flatnonzero(near == own)[0]]
        found[row, :3, :3] = covariances[row]
        found[row, 3:, 3:] = np.einsum("b,bij->ij", weights**2, doubts[near])
        found[row, 3:, :3] = found[row, :3, 3:] = own_weight * covariances[row]
    return velocities, found


def _objects(session: Session) -> tuple[Object, Object]:
    """Return target and chaser, with the designators of their two-line elements where the session has them."""
    found = []
    for role in ("target", "chaser"):
        lines = session.tles.get(role)
        code = lines[0][9:17].strip() if lines else ""
        century = "19" if code[:2] >= "57" else "20"
        identifier = (
            f"{century}{code[:2]}-{code[2:]}" if len(code) >= 6 and code[:5].isdecimal() else "UNKNOWN"
        )
        found.append(Object(role.upper(), identifier))
    return found[0], found[1]


def _camera_yaml(session: Session) -> bytes:
    camera = session.camera
    keys = {name: getattr(camera, name) for name in ("fx_px", "fy_px", "cx_px", "cy_px")}
    return yaml.safe_dump({**keys, "times": "middle"}, sort_keys=False).encode()
