"""From a session's frames to those of a training: which are used, which are held out for testing, in what form."""

import dataclasses
import logging
from collections.abc import Callable, Sequence

import numpy as np
import torch

from flightsw.icd.quaternion import quat_to_matrix
from ground.session.cameras import sun_direction
from ground.session.earth import earth_m
from ground.session.folder import SPLITS, FrameRecord, Session, SessionError
from ground.session.motion import rates
from obbgs_base.errors import counted
from obbgs_core.compiled import each
from obbgs_core.frames import Navigation, TrainingFrame

log = logging.getLogger(__name__)
SHOWN_PX = 0.2  # a target that moves by less during an exposure is taken as standing still
TEST_INTERVAL = 8  # every eighth bracket is held out


def told_before(warning: str) -> None:
    """Take a warning that somebody was told already; for `on_warning`."""


def split(
    session: Session, on_warning: Callable[[str], None] = log.warning
) -> tuple[list[FrameRecord], list[FrameRecord]]:
    """Return the training frames and the held-out test frames of a session.

    Where the frames state their splits, those of `test` are held out, or those of `val` where there is no test frame;
    otherwise the frames of `val` are in neither list. Where nothing but `train` is stated, and where no split is, every
    eighth bracket is held out as a whole (`is_held_out`); where that is none, the last one; a single bracket is all for
    training. Frames that are not `usable` are in neither list, nor are those whose picture is damaged: `on_warning` is
    called with what is left out.

    Raises:
        SessionError: no frame is left, or none that is for training; or a picture cannot be read.
    """
    frames = usable(session.frames)
    if not frames:
        eclipsed = sum(r.in_eclipse for r in session.frames)
        raise SessionError(
            f"none of {counted(len(session.frames), 'frame')} can be used: "
            f"{eclipsed} in eclipse, the others without a valid "
            "pose"
        )
    if len(frames) < len(session.frames):
        count = len(session.frames) - len(frames)
        on_warning(
            f"left out: {count} of {counted(len(session.frames), 'frame')}, in eclipse, or without a valid pose or "
            "the Sun's direction"
        )
    frames = whole(session, frames, on_warning)
    stated = {name: [r for r in frames if r.split == name] for name in SPLITS}
    if any(stated.values()) and not stated["train"]:
        raise SessionError(
            f"none of {counted(len(frames), 'usable frame')} is in the split train: import the training pictures too"
        )
    if held_out := stated["test"] or stated["val"]:
        return stated["train"], held_out
    brackets = sorted({r.bracket for r in frames})
    chosen = {r.bracket for r in frames if is_held_out(r)}
    if not chosen and len(brackets) > 1:
        chosen = {brackets[-1]}
    return [r for r in frames if r.bracket not in chosen], [r for r in frames if r.bracket in chosen]


def whole(
    session: Session, records: Sequence[FrameRecord], on_warning: Callable[[str], None] = log.warning
) -> list[FrameRecord]:
    """Return the frames whose pictures are not damaged; a warning names the others.

    Raises:
        SessionError: a picture cannot be read.
    """
    damaged = {record.id for record in records if not session.is_whole(record)}
    if damaged:
        one = len(damaged) == 1
        what = "the picture of 1 frame is" if one else f"the pictures of {len(damaged):,} frames are"
        on_warning(
            f"{what} damaged and left out: {', '.join(map(str, sorted(damaged)))}; "
            "`ground uplink resend` asks for what is still on board"
        )
    return [record for record in records if record.id not in damaged]


def usable(records: Sequence[FrameRecord]) -> list[FrameRecord]:
    """Return the frames whose pose is valid and that were not taken in eclipse.

    Where the first of them knows the Sun's direction, those that do not are left out as well: a model whose radiance
    turns with the Sun can be compared with none of them. More frames after these change nothing of what is returned.
    """
    posed = [record for record in records if record.pose_valid and not record.in_eclipse]
    if not posed or sun_direction(posed[0]) is None:
        return posed
    return [record for record in posed if sun_direction(record) is not None]


def is_held_out(record: FrameRecord) -> bool:
    """Return whether a frame is of every eighth bracket, by the bracket's number: it does not matter what else came."""
    return record.bracket % TEST_INTERVAL == TEST_INTERVAL - 1


def frames_of(session: Session, records: Sequence[FrameRecord] | None = None) -> list[TrainingFrame]:
    """Return frames of a session with their pictures, poses and calibration, as `obbgs_core.train.train` takes them.

    Args:
        records: frames of `session.frames`, such as those of `split`; None: all that are `usable`.

    Raises:
        MissingFrames, SessionCorrupt: a picture cannot be read.
    """
    records = usable(session.frames) if records is None else records
    return list(each(lambda record: training_frame(session, record), records))


def training_frame(session: Session, record: FrameRecord, tagged: FrameRecord | None = None) -> TrainingFrame:
    """Return a frame with its picture, pose and calibration in the library's form.

    Args:
        tagged: the same as it was tagged, where `record` has another pose. The Earth is where the tag has it, in which
            the pose and the attitude that it assumes err alike; None: `record`.

    Raises:
        MissingFrames, SessionCorrupt: its picture cannot be read.
    """
    dn, assumed = session.dn(record).astype(np.float32), record.quat_inertial_to_body
    earth = earth_m(session, tagged or record, dn)
    frame = TrainingFrame(
        dn=torch.from_numpy(dn.reshape(*dn.shape[:2], session.camera.channels)),
        exposure_time_s=record.exposure_time_s,
        world_to_camera=torch.tensor(record.world_to_camera, dtype=torch.float32),
        K=torch.from_numpy(session.K(record)),
        id=record.id,
        bracket=record.bracket,
        own_pose=session.frames_err_alone,
        pose_covariance=torch.from_numpy(
            motion_covariance(record.covariance, record.world_to_camera[:3, :3])
        ),
        sun_dir=sun_direction(record),
        background=session.background,
        psf_sigma_px=session.camera.psf_sigma_px,
        navigation=navigation_of(session),
        time_s=(record.mid_exposure_utc_ns - session.navigation.epoch_utc_ns) / 1e9,
        inertial_to_body=None if assumed is None else torch.from_numpy(quat_to_matrix(assumed)),
        earth_m=None if earth is None else torch.from_numpy(earth).float(),
        rates=rates(session, record),
    )
    return frame if frame.moved_px > SHOWN_PX else dataclasses.replace(frame, rates=None)


def navigation_of(session: Session) -> Navigation | None:
    """Return what the pose tags of a session share of their errors; None where they share none."""
    stated = session.navigation
    if not stated.sigmas.vector().any():
        return None
    to_rtn = quat_to_matrix(np.array(stated.quat_inertial_to_rtn))
    return Navigation(stated.sigmas, stated.mean_motion_rad_s, to_rtn, *session.rotation)


def motion_covariance(tag_covariance: np.ndarray, body_to_camera: np.ndarray) -> np.ndarray:
    """Return the covariance [6, 6] of the correcting motion that turns a tagged pose into the true one.

    The motion multiplies world_to_camera from the left: a rotation vector (rad), then a shift (m), both along the
    camera's axes. `tag_covariance` is of the tag's errors: tagged minus true position dp (m, body), and the rotation
    vector a (rad, camera) in R_tag = exp(a) R_true. As t = -R p, the motion is the rotation -a and the shift
    t_true - exp(-a) t_tag = R_true dp, to first order R_tag dp. The rotation is about the camera's centre and does not
    move it, so no term that grows with the range couples rotation and shift. The two have opposite signs, which also
    changes the sign of the correlation between position and rotation.

    Args:
        tag_covariance: [6, 6], position (m, body), then rotation vector (rad, camera).
        body_to_camera: rotation matrix [3, 3] of the tagged pose.
    """
    motion_by_tag = np.zeros((6, 6))
    motion_by_tag[:3, 3:] = -np.eye(3)
    motion_by_tag[3:, :3] = body_to_camera
    return motion_by_tag @ tag_covariance @ motion_by_tag.T


def tag_covariance(covariance: np.ndarray, body_to_camera: np.ndarray) -> np.ndarray:
    """Return the covariance [6, 6] that a tag states of whose pose's correcting motion one is given.

    It is the inverse of `motion_covariance`.
    """
    tag_by_motion = np.zeros((6, 6))
    tag_by_motion[:3, 3:] = body_to_camera.T
    tag_by_motion[3:, :3] = -np.eye(3)
    return tag_by_motion @ covariance @ tag_by_motion.T
