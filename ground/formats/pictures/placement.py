"""Moves the origin of imported poses into the target, about which a reconstruction starts.

Data sets may have it anywhere: COLMAP's models of scenes that cameras face from one side have it among the cameras.
"""

import dataclasses
import logging
from collections.abc import Sequence

import numpy as np

from ground.formats.pictures.files import FormatError
from ground.formats.pictures.view import View
from ground.formats.pictures.views import PoseSigmas, read_grey

log = logging.getLogger(__name__)
IN_SIGHT = 0.5  # share of the pictures that show the origin where it can stay
# mean square of the sine between lines of sight, across every direction; less tells no distance
LEAST_SPREAD = 1e-4
STATED_ERROR_PX = 1.0  # by which a stated camera's turn and its place may each move the picture of the target


def placed(views: Sequence[View]) -> tuple[list[View], np.ndarray | None]:
    """Return the views with their origin in the target, and where that is in the axes given; None if it stays.

    It stays where half of the pictures show it. Otherwise it goes to the point that is nearest to the lines of sight
    through the middles of what departs from each picture's border, if they meet and it lies in front of all cameras.

    Raises:
        FormatError: there is no picture, or one cannot be read.
    """
    if not views:
        raise FormatError("the data set has no pictures")
    if _in_sight(views, np.zeros(3)) >= IN_SIGHT:
        return list(views), None
    across, towards = np.zeros((3, 3)), np.zeros(3)
    for view in views:
        if (ray := _line_of_sight(view)) is None:
            continue
        rotation = view.world_to_camera[:3, :3]
        direction = rotation.T @ (ray / np.linalg.norm(ray))
        projection = np.eye(3) - np.outer(direction, direction)
        across += projection
        towards += projection @ (-rotation.T @ view.world_to_camera[:3, 3])
    if np.linalg.eigvalsh(across)[0] > LEAST_SPREAD * len(views):
        origin = np.linalg.solve(across, towards)
        if _in_sight(views, origin) >= IN_SIGHT:
            log.warning(
                "the poses have their origin out of the pictures' sight: it is moved to (%.4g, %.4g, %.4g), into the "
                "target; session.json says so",
                *origin,
            )
            return [_moved(view, origin) for view in views], origin
    log.warning(
        "the poses have their origin out of the pictures' sight, and the pictures do not tell where the target is: "
        "reconstruction expects it about the origin"
    )
    return list(views), None


def _in_sight(views: Sequence[View], point: np.ndarray) -> float:
    """Return the share of the views that have a point [3] in their picture."""
    count = 0
    for view in views:
        seen = view.world_to_camera[:3, :3] @ point + view.world_to_camera[:3, 3]
        if seen[2] > 0:
            u, v, _ = np.array(view.intrinsics.K) @ (seen / seen[2])
            count += 0 <= u < view.intrinsics.width and 0 <= v < view.intrinsics.height
    return count / len(views)


def _line_of_sight(view: View) -> np.ndarray | None:
    """Return the ray [3] in camera axes to the middle of what departs from the border; None of an even picture."""
    grey = read_grey(view)
    border = np.concatenate([grey[0], grey[-1], grey[:, 0], grey[:, -1]])
    departure = np.abs(grey - np.median(border))
    departure[departure < 0.1 * departure.max()] = 0
    if not departure.any():
        return None
    v, u = (np.average(axis, weights=departure) for axis in np.mgrid[0.5 : len(grey), 0.5 : grey.shape[1]])
    return np.linalg.solve(np.array(view.intrinsics.K), [u, v, 1.0])


def _moved(view: View, origin: np.ndarray) -> View:
    pose = view.world_to_camera.copy()
    pose[:3, 3] += pose[:3, :3] @ origin
    return dataclasses.replace(view, world_to_camera=pose)


def with_stated_errors(views: Sequence[View]) -> list[View]:
    """Return the views with covariances of their poses: where none is stated, that of an error of about a pixel.

    Cameras of calibrated rigs and of structure from motion err by as much; trainings test whether these do. Poses about
    a target of unknown attitude state none.
    """
    return [v if v.covariance is not None or not v.attitude_known else _with_stated_error(v) for v in views]


def _with_stated_error(view: View) -> View:
    rotation_rad = STATED_ERROR_PX / view.intrinsics.fx_px
    range_m = float(np.linalg.norm(view.world_to_camera[:3, 3]))
    return dataclasses.replace(view, covariance=PoseSigmas(rotation_rad, rotation_rad * range_m).covariance)
