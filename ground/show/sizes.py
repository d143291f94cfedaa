"""How large a model is, and how sure that is: the error of its scale, and whether its unit is known."""

import math

import numpy as np

from flightsw.icd.quaternion import quat_to_matrix
from ground.session.folder import FrameRecord, Session
from ground.session.spread import evenly_spread
from ground.session.training_frames import training_frame
from obbgs_base.physics.navigation_errors import SharedParameters, jacobian
from obbgs_core.poses.corrections import motion_of
from obbgs_core.poses.estimate import PoseEstimate

YEAR_2000_NS = 946_684_800 * 10**9
MOST_DECIMALS = 8
FRAMES = 60  # at most, over which the size's deviation is worked out


def states_time(session: Session, record: FrameRecord) -> bool:
    """Return whether a frame's time is its own: pictures are imported in many formats that state none."""
    return session.frames_imported is None or record.mid_exposure_utc_ns > YEAR_2000_NS


def with_deviation(value: float, deviation: float) -> str:
    """Return a value and its deviation in words, both to the second digit of the deviation: 0.254 ± 0.099."""
    if not (math.isfinite(value) and math.isfinite(deviation)) or deviation <= 0:
        return f"{value:z.4g} ± {deviation:.2g}"
    decimals = max(0, 1 - math.floor(math.log10(float(f"{deviation:.1e}"))))
    if decimals > MOST_DECIMALS:  # a row of zeros is no number that a person reads, and too wide for a phone
        return f"{value:z.1e} ± {deviation:.1e}"
    return f"{value:z.{decimals}f} ± {deviation:.{decimals}f}"


def states_scale(session: Session) -> bool:
    """Return whether the poses are in metres: those of a link are, and those that were exported from one."""
    return session.frames_imported is None or all(states_time(session, record) for record in session.frames)


def size_deviation(session: Session, estimate: PoseEstimate | None) -> float:
    """Return the standard deviation of the model's size as a share of it, by what the poses say of their ranges.

    A model is as large as the ranges of its frames: the deviation is that of their mean relative error along the line
    of sight. Errors that all frames share do not average out, those of single brackets do, and those in between as
    their correlation time says. 0: the poses are stated to be exact.

    Args:
        session: with the poses of its tags.
        estimate: what the training found of them, None where it left them.
    """
    last = list({record.bracket: record for record in session.frames if record.pose_valid}.values())
    if estimate is not None:
        known = set(estimate.frame_ids)
        last = [record for record in last if record.id in known] or last
    records = evenly_spread(last, FRAMES)
    ranges_m = np.array([np.linalg.norm(record.position_body_m) for record in records])
    if estimate is not None:
        row_of = dict(zip(estimate.frame_ids, estimate.brackets, strict=True))
        rows = [row_of[record.id] for record in records if record.id in row_of]
        variance = (estimate.own_posterior[rows, 5] / ranges_m[: len(rows)]) ** 2
        own = float(variance.sum()) / max(1, len(rows)) ** 2
        shared, covariance = estimate.shared, estimate.shared_covariance
    else:
        own = _own_variance(session, records, ranges_m)
        shared, covariance = SharedParameters(), np.diag(session.navigation.sigmas.vector() ** 2)
    frames = [training_frame(session, record) for record in records]
    if frames[0].navigation is None:
        return own**0.5
    rows = jacobian(motion_of(frames), shared)[:, 5, :] / ranges_m[:, None]
    mean = rows.mean(axis=0)
    return float(own + mean @ covariance @ mean) ** 0.5


def _own_variance(session: Session, records: list[FrameRecord], ranges_m: np.ndarray) -> float:
    """Return the variance of the mean relative error along the line of sight that the tags' covariances state."""
    forward = np.stack([quat_to_matrix(record.quat_body_to_camera)[2] for record in records])
    stated = np.stack([record.covariance[:3, :3] for record in records])
    deviations = np.sqrt(np.maximum(np.einsum("ni,nij,nj->n", forward, stated, forward), 0)) / ranges_m
    times_s = np.array([record.mid_exposure_utc_ns for record in records]) / 1e9
    apart_s = np.abs(times_s[:, None] - times_s)
    if session.navigation.correlation_time_s > 0:
        correlation = np.exp(-apart_s / session.navigation.correlation_time_s)
    else:
        correlation = np.eye(len(records))
    return float(deviations @ correlation @ deviations) / len(records) ** 2
