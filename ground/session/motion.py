"""How the target moves in front of the camera while the shutter is open: from the pose tags before and after."""

import bisect

import numpy as np
import torch

from ground.session.folder import FrameRecord, Session
from obbgs_core.model.motions import motion_vectors

APART_S = 0.2  # tags nearer to one another tell the rate no better than they err
MOST_TURN_RAD = 1.0  # between two tags; after more, the motion in between is not known
NEAR = 16  # frames before and after, by number, among which the next ones in time are looked for


def rates(session: Session, record: FrameRecord) -> torch.Tensor | None:
    """Return the target's rates [6] at a frame, as `TrainingFrame.rates`: rad/s and m/s in the camera's axes.

    None comes back for imported pictures that state no attitude of the target, whose cameras may have stood still for
    each of them, and where no tag is near enough.
    """
    imported = session.frames_imported is not None and record.quat_inertial_to_body is None
    if imported or not record.pose_valid:
        return None
    before, after = (_neighbour(session, record, sign) or record for sign in (-1, 1))
    interval_s = (after.mid_exposure_utc_ns - before.mid_exposure_utc_ns) / 1e9
    if not interval_s:
        return None
    motion = after.world_to_camera.astype(float) @ np.linalg.inv(before.world_to_camera.astype(float))
    twist = motion_vectors(torch.from_numpy(motion)[None])[0] / interval_s
    if float(twist[:3].norm()) * interval_s > MOST_TURN_RAD:
        return None
    return twist.float()


def _neighbour(session: Session, record: FrameRecord, sign: int) -> FrameRecord | None:
    """Return the frame with a pose that was taken next before (-1) or after (1) another."""

    def apart_s(other: FrameRecord) -> float:
        return sign * (other.mid_exposure_utc_ns - record.mid_exposure_utc_ns) / 1e9

    place = bisect.bisect_left(session.frames, record.id, key=lambda other: other.id)
    near = session.frames[max(0, place - NEAR) : place + NEAR + 1]
    posed = [other for other in near if other.pose_valid and apart_s(other) >= APART_S]
    return min(posed, key=apart_s, default=None)
