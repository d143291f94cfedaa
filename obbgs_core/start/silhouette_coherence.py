"""How well silhouettes and poses agree with one another, and poses at which they agree best."""

import dataclasses
import logging
import math

import numpy as np
import torch
from scipy.optimize import minimize
from torch import Tensor

from obbgs_core.frames import TrainingFrame
from obbgs_core.model.motions import point_flow
from obbgs_core.poses.corrections import PoseCorrections
from obbgs_core.start import hull

log = logging.getLogger(__name__)
DIRECTIONS = 3  # at most, of the shared parameters, in which the most coherent hull is searched
FEWEST_PX = 1.0  # root mean square motion of the image, per deviation, that makes a direction worth it
VIEWS = 24  # about so many silhouettes, spread evenly, by which the search compares hulls
TRIALS = 40  # hulls of a search
FIRST_STEP, LAST_STEP = 0.5, 0.05  # deviations


def coherence(
    outlines: dict[int, hull.Silhouette], reached: dict[int, hull.Silhouette] | None = None
) -> float:
    """Return the coherence of the hull of silhouettes, grown or as they are, with the silhouettes as they are."""
    carving = list((reached or outlines).values())
    radius = hull.radius_m(list(outlines.values()))
    if radius == 0:
        return 0.0
    points, voxel_m = hull.hull_points(carving, radius)
    return hull.coherence(list(outlines.values()), points, voxel_m)


def seen_from(outlines: dict[int, hull.Silhouette], poses: PoseCorrections) -> dict[int, hull.Silhouette]:
    """Return silhouettes of some frames, by index, with the poses that corrections give these frames."""
    at = poses.corrected(list(outlines))
    return {
        i: dataclasses.replace(o, world_to_camera=p) for (i, o), p in zip(outlines.items(), at, strict=True)
    }


def most_coherent(
    frames: list[TrainingFrame], outlines: dict[int, hull.Silhouette], poses: PoseCorrections
) -> PoseCorrections:
    """Return poses of a more coherent hull, moved along what the silhouettes' centres leave open.

    What was gathered of the centres gives the shared parameters a covariance. Searched are the directions in it, at
    most three, that change the pictures by most in other ways than a motion of the whole body does, by the method of
    Nelder and Mead, which needs no derivatives.

    Source: Hernandez, Schmitt and Cipolla, Silhouette coherence for camera calibration under circular motion, 2007.

    Args:
        outlines: silhouettes of some of the frames, by index.
        poses: aligned by the silhouettes' centres, with what was gathered of these.

    Returns:
        Other corrections, or `poses` itself where the centres leave nothing open.
    """
    directions = _open_directions(frames, outlines, poses)  # [S, D]
    count = directions.shape[1]
    if count == 0:
        return poses
    compared = {i: outlines[i] for i in list(outlines)[:: max(1, len(outlines) // VIEWS)]}

    def moved(by: np.ndarray) -> PoseCorrections:
        return poses.changed(frames, directions @ torch.from_numpy(by))

    def incoherence(by: np.ndarray) -> float:
        return 1 - coherence(seen_from(compared, moved(by)))

    corners = np.concatenate([np.zeros((1, count)), FIRST_STEP * np.eye(count)])
    options = {"initial_simplex": corners, "maxfev": TRIALS, "xatol": LAST_STEP, "fatol": math.inf}
    found = minimize(incoherence, corners[0], method="Nelder-Mead", options=options)
    log.info(
        "moved by %s deviations of what the silhouettes' centres leave open",
        np.array2string(found.x, precision=2),
    )
    return moved(found.x)


def _open_directions(
    frames: list[TrainingFrame], outlines: dict[int, hull.Silhouette], poses: PoseCorrections
) -> Tensor:
    """Return directions [S, D] of the shared parameters, in prior deviations, a posterior deviation long each."""
    covariance, _ = poses.left_open()
    radius_m = hull.radius_m(list(seen_from(outlines, poses).values()))
    points = radius_m * torch.cat([torch.eye(3), -torch.eye(3)]).double()
    at = poses.corrected(list(range(len(frames)))).double()
    seen = points @ at[:, :3, :3].mT + at[:, None, :3, 3]
    ahead = (seen[..., 2] > 0).all(dim=1)  # poses that err may have the target beside or behind the camera
    K = torch.stack([frame.K for frame in frames]).double()[ahead]
    flow = torch.cat([point_flow(point, K) for point in seen[ahead].unbind(1)], dim=1)  # [A, 2 * 6, 6] px
    motions = poses.by_shared[ahead], poses.body_motions()[ahead]
    by_shared, by_body = ((flow @ motion).flatten(0, 1) for motion in motions)
    body, _ = torch.linalg.qr(by_body)
    root = torch.linalg.cholesky(covariance)
    by_deviation = by_shared @ root
    _, size_px, directions = torch.linalg.svd(
        by_deviation - body @ (body.T @ by_deviation), full_matrices=False
    )
    searched = size_px[:DIRECTIONS] / math.sqrt(len(by_deviation)) > FEWEST_PX
    return root @ directions[:DIRECTIONS][searched].T
