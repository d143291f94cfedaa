"""The attitude of a target that nobody knows, found from a session's frames, and the session seen from its axes."""

import dataclasses
import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from flightsw.icd.quaternion import matrix_to_quat, quat_to_matrix
from ground.run.attitude_choice import chosen_by_training
from ground.session.cameras import sensor_of
from ground.session.folder import FrameRecord, Navigation, Session, SessionError
from ground.session.training_frames import training_frame
from obbgs_base.errors import reason
from obbgs_base.files import write_whole
from obbgs_core.attitude.estimate import estimate_motion
from obbgs_core.attitude.outlines import centred
from obbgs_core.attitude.target_motion import TargetMotion
from obbgs_core.frames import TrainingFrame
from obbgs_core.poses.estimate import PoseEstimate

FILE = "attitude.json"


@dataclass(frozen=True)
class FoundAttitude:
    """The motion that was found of a target, with the UTC time that it counts from."""

    epoch_utc_ns: int
    motion: TargetMotion

    def write(self, path: Path) -> None:
        """Write everything that `read` needs, and the facts for people, as JSON."""
        tree = {
            "epoch_utc_ns": self.epoch_utc_ns,
            "parameters": self.motion.parameters.tolist(),
            "covariance": self.motion.covariance.tolist(),
            "epoch_to_body": self.motion.epoch_to_body.tolist(),
            "disagreement": self.motion.disagreement,
            "views": self.motion.views,
            "facts": self.motion.facts(),
        }
        write_whole(path, (json.dumps(tree, indent=2) + "\n").encode())

    @staticmethod
    def read(path: Path) -> "FoundAttitude | None":
        """Return what was written; None where there is no such file.

        Raises:
            SessionError: the file is damaged.
        """
        if not path.exists():
            return None
        try:
            tree = json.loads(path.read_bytes())
            names = ("parameters", "covariance", "epoch_to_body")
            parameters, covariance, axes = (np.array(tree[name], dtype=np.float64) for name in names)
            size = len(parameters)
            if size not in (3, 8) or covariance.shape != (size, size) or axes.shape != (3, 3):
                raise ValueError(
                    f"expected 3 or 8 parameters with their covariance, got {tree['parameters']}"
                )
            motion = TargetMotion(
                parameters, covariance, axes, float(tree["disagreement"]), int(tree["views"])
            )
            return FoundAttitude(int(tree["epoch_utc_ns"]), motion)
        except (OSError, ValueError, LookupError, TypeError) as error:
            raise SessionError(f"{path} cannot be read: {reason(error)}; make the run again") from error


def find_attitude(
    session: Session,
    training: list[FrameRecord],
    on_progress: Callable[[str, float], None] = lambda what, share: None,
    should_stop: Callable[[], bool] = lambda: False,
) -> FoundAttitude:
    """Return the motion of a session's target from some of its frames; the epoch is the middle of their times.

    Raises:
        AttitudeUndetermined: the frames do not determine it; the message says why.
        SessionError: the tags do not say which attitude their poses assume.
        Interrupted: should_stop returned True.
    """
    times_ns = [record.mid_exposure_utc_ns for record in training]
    epoch_utc_ns = (min(times_ns) + max(times_ns)) // 2
    times_s = (np.array(times_ns) - epoch_utc_ns) / 1e9
    sensor, frames = sensor_of(session.camera), _in_inertial_axes(session, training)
    frames = centred(frames, sensor)

    def decide(motions: list[TargetMotion]) -> int | None:
        def on_share(share: float) -> None:
            on_progress("comparing rotations by short trainings", share)

        return chosen_by_training(frames, times_s, sensor, motions, on_share, should_stop)

    motion = estimate_motion(frames, times_s, sensor, on_progress, should_stop, decide=decide)
    return FoundAttitude(epoch_utc_ns, motion)


def _in_inertial_axes(session: Session, records: list[FrameRecord]) -> list[TrainingFrame]:
    """Return frames with poses in inertial axes; how the target turns is neither in them nor in what may err."""
    stated = session.navigation
    orbit = dataclasses.replace(
        stated.sigmas, attitude_rad=np.zeros(3), rate_rad_s=np.zeros(3), inertia_ratios=np.zeros(2)
    )
    resting = dataclasses.replace(stated, rate_rad_s=(0.0, 0.0, 0.0), sigmas=orbit)
    at_rest = dataclasses.replace(session, navigation=resting)
    return [
        dataclasses.replace(
            training_frame(
                at_rest,
                dataclasses.replace(
                    _turned(r, _assumed(session, r).T), quat_inertial_to_body=np.array([1.0, 0, 0, 0])
                ),
            ),
            inertial_to_body=None,
        )
        for r in records
    ]


def in_body_axes(session: Session, found: FoundAttitude) -> Session:
    """Return a session with all poses and Sun directions in the axes of its target, as they were found.

    Its navigation says how far attitude, rate and inertia ratios may err, so that a training refines them.
    """
    times_s = np.array([(r.mid_exposure_utc_ns - found.epoch_utc_ns) / 1e9 for r in session.frames])
    records = []
    for record, attitude in zip(session.frames, found.motion.inertial_to_body(times_s), strict=True):
        turned = _turned(record, attitude @ _assumed(session, record).T)
        records.append(dataclasses.replace(turned, quat_inertial_to_body=matrix_to_quat(attitude)))
    navigation = _navigation(session.navigation, found)
    return dataclasses.replace(session, frames=tuple(records), navigation=navigation, attitude_estimated=True)


def refined_motion(found: FoundAttitude, session: Session, estimate: PoseEstimate | None) -> TargetMotion:
    """Return the motion from the epoch that `found` counts from, as a training on a session in its axes refined it."""
    if estimate is None:
        return found.motion
    shift_s = (session.navigation.epoch_utc_ns - found.epoch_utc_ns) / 1e9
    return found.motion.at_epoch(shift_s).refined(estimate).at_epoch(-shift_s)


def _navigation(stated: Navigation, found: FoundAttitude) -> Navigation:
    """Return what tags state of their shared errors, with the target's rotation and its deviations as found.

    The epoch is that of the tags where they state how the orbit errs from there on.
    """
    orbit_errs = stated.sigmas.position_m.any() or stated.sigmas.velocity_m_s.any()
    epoch_utc_ns = stated.epoch_utc_ns if orbit_errs else found.epoch_utc_ns
    motion = found.motion.at_epoch((epoch_utc_ns - found.epoch_utc_ns) / 1e9)
    sigmas = motion.sigmas()
    return dataclasses.replace(
        stated,
        epoch_utc_ns=epoch_utc_ns,
        rate_rad_s=tuple(motion.rate_body_rad_s.tolist()),
        inertia=tuple(motion.moments.tolist()),
        sigmas=dataclasses.replace(
            stated.sigmas,
            attitude_rad=sigmas.attitude_rad,
            rate_rad_s=sigmas.rate_rad_s,
            inertia_ratios=sigmas.inertia_ratios,
        ),
    )


def _assumed(session: Session, record: FrameRecord) -> np.ndarray:
    """Return the rotation [3, 3] from inertial axes to those that a record's pose is given in.

    Raises:
        SessionError: the tag does not say it.
    """
    if record.quat_inertial_to_body is not None:
        return quat_to_matrix(record.quat_inertial_to_body)
    if session.navigation.attitude == "unknown":
        return np.eye(3)
    raise SessionError(
        f"frame {record.id} does not say which attitude of the target its pose assumes (quat_inertial_to_body in "
        "frames.jsonl), so that its pose in inertial axes is not known: reconstruct it with --attitude tagged"
    )


def _turned(record: FrameRecord, turn: np.ndarray) -> FrameRecord:
    """Return a record with what is in body axes given in those that a rotation [3, 3] about the origin leads to."""
    pose, covariance = record.world_to_camera.copy(), record.covariance.copy()
    pose[:3, :3] = pose[:3, :3] @ turn.T
    whole = np.eye(6)
    whole[:3, :3] = turn
    return dataclasses.replace(
        record,
        world_to_camera=pose,
        quat_body_to_camera=matrix_to_quat(pose[:3, :3]),
        position_body_m=turn @ record.position_body_m,
        covariance=whole @ covariance @ whole.T,
        sun_dir_body=turn @ record.sun_dir_body,
    )
