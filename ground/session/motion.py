"""How the target moves in front of the camera while the shutter is open: from the pose tags before and after."""

import bisect

import numpy as np
import torch

from ground.session.folder import FrameRecord, Session
from obbgs_core.model.motions import motion_vectors

APART_S = 0.2  # tags nearer to one another tell the rate no better than they err
MOST_TURN_RAD = 1.0  # between two tags; after more, the motion in between is not known
NEAR = 16  # frames before and after, by number, among which the next ones in time are looked for
SHOWN_PX = 0.2  # less movement during an exposure is left out


def rates(session: Session, record: FrameRecord) -> torch.Tensor | None:
    """Return the target's rates [6] at a frame, as `TrainingFrame.rates`: rad/s and m/s in the camera's axes.

    None comes back for imported pictures, whose cameras may have stood still for each of them; where no tag is near
    enough; and where nothing that the picture shows at the target's distance moves by more than 0.2 px.
    """
    if session.frames_imported is not None or not record.pose_valid:
        return None
    before, after = (_neighbour(session, record, sign) or record for sign in (-1, 1))
    interval_s = (after.mid_exposure_utc_ns - before.mid_exposure_utc_ns) / 1e9
    if not interval_s:
        return None
    motion = after.world_to_camera.astype(float) @ np.linalg.inv(before.world_to_camera.astype(float))
    twist = motion_vectors(torch.from_numpy(motion)[None])[0] / interval_s
    if float(twist[:3].norm()) * interval_s > MOST_TURN_RAD:
        return None
    return twist.float() if _moved_px(session, record, twist.numpy()) > SHOWN_PX else None


def _neighbour(session: Session, record: FrameRecord, sign: int) -> FrameRecord | None:
    """Return the frame with a pose that was taken next before (-1) or after (1) another."""

    def apart_s(other: FrameRecord) -> float:
        return sign * (other.mid_exposure_utc_ns - record.mid_exposure_utc_ns) / 1e9

    place = bisect.bisect_left(session.frames, record.id, key=lambda other: other.id)
    near = session.frames[max(0, place - NEAR) : place + NEAR + 1]
    posed = [other for other in near if other.pose_valid and apart_s(other) >= APART_S]
    return min(posed, key=apart_s, default=None)


def _moved_px(session: Session, record: FrameRecord, twist: np.ndarray) -> float:
    """Return how far a target that fills the picture moves in it during the exposure, at most, px."""
    K, centre = session.K(record).astype(float), record.world_to_camera[:3, 3].astype(float)
    size = np.array([session.camera.width / K[0, 0], session.camera.height / K[1, 1], 0]) / 2
    size[2] = size[:2].min()
    points = centre + centre[2] * np.concatenate([np.diag(size), -np.diag(size), np.zeros((1, 3))])
    points = points[points[:, 2] > 0]
    speed = np.cross(twist[:3], points) + twist[3:]
    across = (speed[:, :2] - points[:, :2] / points[:, 2:] * speed[:, 2:]) / points[:, 2:]
    moved = np.linalg.norm(across * np.diag(K)[:2], axis=1) * record.exposure_time_s
    return float(moved.max(initial=0.0))
