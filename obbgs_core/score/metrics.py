"""Metrics of images and of point clouds, the clouds in units in which the target's largest dimension is 2."""

import math
from collections.abc import Iterable

import numpy as np
from scipy.spatial import KDTree
from torch import Tensor

from obbgs_core.losses import SSIM_WINDOW, ssim_map

COMPLETENESS_RADIUS = 0.01  # in the units above
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
    for name, points in (("cloud", cloud), ("truth", truth)):
        if points.ndim != 2 or points.shape[1] != 3 or len(points) == 0 or not np.isfinite(points).all():
            raise ValueError(f"{name} must be finite points [N, 3] with N > 0, got shape {points.shape}")
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
