"""Metrics of images and of point clouds, the clouds in units in which the target's largest dimension is 2."""

import math
from collections.abc import Iterable

import numpy as np
import torch
from scipy.spatial import KDTree
from torch import Tensor

from obbgs_core.losses import SSIM_WINDOW, ssim_map

COMPLETENESS_RADIUS = 0.01  # in the units above
# within which a point of one surface finds the other, by the figures' names
F_RADII = {"01": 0.01, "02": 0.02}
EVEN_CELL = 0.005  # of the grid that makes two surfaces equally dense: half of the smaller radius
MU = 5000.0  # of the mu-law by which HDR pictures are compared
# Of two dense surfaces some way apart, scipy's default tree takes four times as long for the same distances.
TREE = {"leafsize": 32, "compact_nodes": False, "balanced_tree": False}


def psnr_db(a: Tensor, b: Tensor) -> float:
    """Return the peak signal-to-noise ratio of two images in 0..1; capped at 120 dB for identical ones."""
    return -10 * math.log10(max((a.double() - b.double()).square().mean().item(), 1e-12))


def foreground_psnr_db(views: Iterable[tuple[Tensor, Tensor, Tensor]]) -> float:
    """Return the mean PSNR of views over their foreground: the pixels of which the target covers any part.

    Args:
        views: image [H, W, C] and truth [H, W, C] in 0..1, and the target's coverage [H, W] of each pixel in 0..1.

    Returns:
        dB; views in which the target covers no pixel are left out, and the mean of none is NaN.
    """
    values = [psnr_db(image[on], truth[on]) for image, truth, coverage in views if (on := coverage > 0).any()]
    return math.fsum(values) / len(values) if values else math.nan


def mu_law(radiance: Tensor) -> Tensor:
    """Return log(1 + 5000 x) / log(5001) of radiance x in 0..1, as tone-mapped PSNR of HDR pictures takes it.

    Source: Kalantari and Ramamoorthi, Deep High Dynamic Range Imaging of Dynamic Scenes, 2017.
    """
    return torch.log1p(MU * radiance.clamp(0, 1)) / math.log1p(MU)


def ssim(a: Tensor, b: Tensor) -> float:
    """Return the mean SSIM of images [H, W, C] in 0..1, Gaussian window, without a border of half a window."""
    border = SSIM_WINDOW // 2
    return ssim_map(a[None], b[None])[..., border:-border, border:-border].mean().item()


def cloud_distances(
    cloud: np.ndarray, truth: np.ndarray, shown: np.ndarray | None = None
) -> dict[str, float]:
    """Return the distances between two clouds [N, 3], [M, 3], in their units.

    chamfer: the mean of the two directions' mean nearest-neighbour distances. hausdorff: the same of the largest ones.
    accuracy: mean distance cloud to truth. completeness: percentage of true points within 0.01 of the cloud.
    completeness_shown: the same of those true points that are `shown` [M], where any are.

    Raises:
        ValueError: a cloud is empty or not finite.
    """
    _check_cloud("cloud", cloud)
    _check_cloud("truth", truth)
    to_truth, _ = KDTree(truth, **TREE).query(cloud)
    to_cloud, _ = KDTree(cloud, **TREE).query(truth)
    is_found = to_cloud < COMPLETENESS_RADIUS
    figures = {
        "chamfer": 0.5 * float(to_truth.mean()) + 0.5 * float(to_cloud.mean()),
        "hausdorff": 0.5 * float(to_truth.max()) + 0.5 * float(to_cloud.max()),
        "accuracy": float(to_truth.mean()),
        "completeness": 100 * float(is_found.mean()),
    }
    if shown is not None and shown.any():
        figures["completeness_shown"] = 100 * float(is_found[shown].mean())
    return figures


def surface_scores(points: np.ndarray, truth: np.ndarray) -> dict[str, float]:
    """Return how well points [N, 3] on a model's surface agree with those of the true one [M, 3], in their units.

    Both are thinned to one point in each cell of a grid first, so that no part of a surface counts more because more
    points lie on it. Within 0.01 and 0.02 (`_01`, `_02`), in per cent: precision, how many of the model's points lie so
    near to the truth; recall, how many of the true points so near to the model; f, their harmonic mean. chamfer: the
    mean of the two directions' mean distances.

    Source: Knapitsch et al., Tanks and Temples, 2017.

    Raises:
        ValueError: a cloud is empty or not finite.
    """
    _check_cloud("points", points)
    _check_cloud("truth", truth)
    points, truth = even(points), even(truth)
    to_truth, _ = KDTree(truth, **TREE).query(points)
    to_model, _ = KDTree(points, **TREE).query(truth)
    figures = {"chamfer": 0.5 * float(to_truth.mean()) + 0.5 * float(to_model.mean())}
    for name, radius in F_RADII.items():
        precision, recall = (100 * float((distance < radius).mean()) for distance in (to_truth, to_model))
        both = precision + recall
        figures[f"precision_{name}"], figures[f"recall_{name}"] = precision, recall
        figures[f"f_{name}"] = 2 * precision * recall / both if both else 0.0
    return figures


def even(points: np.ndarray, cell: float = EVEN_CELL) -> np.ndarray:
    """Return one of the points [N, 3] in each cell of a cubic grid: the one nearest to the middle of its cell."""
    place = points / cell
    cells = np.floor(place)
    from_middle = np.square(place - cells - 0.5).sum(axis=1)
    order = np.argsort(from_middle, kind="stable")
    _, first = np.unique(cells[order].astype(np.int64), axis=0, return_index=True)
    return points[order[first]]


def _check_cloud(name: str, points: np.ndarray) -> None:
    if points.ndim != 2 or points.shape[1] != 3 or len(points) == 0 or not np.isfinite(points).all():
        raise ValueError(f"{name} must be finite points [N, 3] with N > 0, got shape {points.shape}")
