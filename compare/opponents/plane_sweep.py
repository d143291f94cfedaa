"""Plane-sweep multi-view stereo with known poses: depths at which neighbouring pictures correlate.

Source: Collins, A space-sweep approach to true multi-image matching, 1996; the fusion is in `depth_maps.py`.
"""

import math
from dataclasses import asdict, dataclass, field

import torch
import torch.nn.functional as F
from torch import Tensor

from compare.opponents.depth_maps import DepthMap, FusionSettings, reconstruct_by_depth_maps
from compare.opponents.reconstruction import Reconstruction, Work
from compare.opponents.stereo_views import (
    View,
    Views,
    depth_range_m,
    neighbours,
    pixel_rays,
    prepare,
    relative,
)
from obbgs_core.frames import TrainingFrame
from obbgs_core.sensor import Sensor

NOTHING = -1.0  # the correlation where a window cannot be compared
FLAT = 1e-6  # a variance below this times 1 + mean², full scale 1, is no texture: rounding alone has up to half of it
PIXELS_AT_ONCE = 200_000  # keeps the arrays of a pass in the processor's cache


@dataclass(frozen=True)
class SweepSettings:
    """How depths are found."""

    window_px: int = 7  # odd; windows of this width are correlated
    sources: int = 6  # views with which each is matched
    # the best correlations of each pixel and plane are averaged: in the others it may be hidden
    kept: int = 3
    plane_px: float = 1.0  # from plane to plane a point moves so far in the picture of the widest baseline
    fusion: FusionSettings = field(default_factory=lambda: FusionSettings(least_confidence=0.2))


def reconstruct_mvs(
    frames: list[TrainingFrame],
    sensor: Sensor,
    work: Work,
    one_exposure: bool = True,
    settings: SweepSettings | None = None,
) -> Reconstruction:
    """Return the fused point cloud of depth maps by correlation.

    Args:
        one_exposure: frames are divided by their exposure times, and a pair is clipped where one of it saturates; if
            false, the readings are matched as they are.

    Raises:
        TooFewFrames, ReconstructionError: the frames do not fit together, or are black.
        Interrupted: `work.should_stop` returned true; the depth maps that are done are kept in `work.folder`.
    """
    settings = settings or SweepSettings()
    views = prepare(frames, sensor, one_exposure)
    pairs = neighbours(views, settings.sources)
    return reconstruct_by_depth_maps(
        views,
        lambda i: sweep(views, i, pairs[i], settings),
        settings.fusion,
        f"plane sweep {asdict(settings)}",
        work,
        {"frames_used": len(views.views), "frames_dark": len(frames) - len(views.views)},
    )


@torch.no_grad()
def sweep(views: Views, reference: int, sources: list[int], settings: SweepSettings) -> DepthMap:
    """Return the depth at which each lit pixel of one view correlates best with its neighbours."""
    view = views.views[reference]
    depth_m, best = torch.zeros(view.lit.shape), torch.zeros(view.lit.shape)
    if not sources or not view.lit.any():
        return DepthMap(depth_m, best)
    rows, columns = _bounds(view.lit)
    crop = (slice(*rows), slice(*columns))
    grid = torch.meshgrid(torch.arange(*rows), torch.arange(*columns), indexing="ij")
    others = [views.views[j] for j in sources]
    planes = inverse_depths(view, others, views.radius_m, settings.plane_px)
    value, inverse_depth = _peak(_scores(view, grid, others, planes, settings), planes)
    found = view.lit[crop] & (value > 0)
    depth_m[crop] = torch.where(found, 1 / inverse_depth, 0.0)
    best[crop] = torch.where(found, value, 0.0)
    return DepthMap(depth_m, best)


def _bounds(lit: Tensor) -> tuple[tuple[int, int], tuple[int, int]]:
    """Return first and last row and column, exclusive, of the lit pixels."""
    rows, columns = torch.nonzero(lit.any(dim=1)), torch.nonzero(lit.any(dim=0))
    return (int(rows.min()), int(rows.max()) + 1), (int(columns.min()), int(columns.max()) + 1)


def inverse_depths(view: View, others: list[View], radius_m: float, plane_px: float) -> Tensor:
    """Return the inverse depths [D] 1/m of planes through the sphere that the target can fill.

    Disparity is focal length times baseline over depth, so that planes even in it move a point evenly.
    """
    near_m, far_m = depth_range_m(view, radius_m)
    widest = max(float(other.K[0, 0] * (view.centre - other.centre).norm()) for other in others)
    count = max(3, math.ceil(widest * (1 / near_m - 1 / far_m) / plane_px) + 1)
    return torch.linspace(1 / far_m, 1 / near_m, count)


def _scores(
    view: View,
    grid: tuple[Tensor, ...],
    others: list[View],
    planes: Tensor,
    settings: SweepSettings,
) -> Tensor:
    """Return the mean [D, h, w] of the best correlations of pixels with the neighbours at each plane."""
    half = settings.window_px // 2
    rows, columns = (torch.arange(int(g.min()) - half, int(g.max()) + half + 1) for g in grid)
    rows, columns = torch.meshgrid(rows, columns, indexing="ij")
    rays = pixel_rays(rows, columns, view.K)
    pairs = []
    for other in others:
        most = min(view.full_scale, other.full_scale)
        image = F.pad(comparable(view, most), (half,) * 4, value=torch.nan)[rows + half, columns + half]
        pairs.append((image, comparable(other, most), *homography_terms(rays, view, other)))
    scores = torch.empty(len(planes), *grid[0].shape)
    at_once = max(1, PIXELS_AT_ONCE // rays[..., 0].numel())
    for first in range(0, len(planes), at_once):
        chosen = slice(first, first + at_once)
        layers = planes[chosen, None, None].expand(-1, *rows.shape)
        kept = [torch.full_like(scores[chosen], NOTHING) for _ in range(min(settings.kept, len(others)))]
        for image, source, turned, moved in pairs:
            warped = warp(source[None], turned, moved, layers)[0]
            score = correlation(image, warped, settings.window_px).nan_to_num_(NOTHING)
            for k, other_score in enumerate(kept):  # the best first
                kept[k], score = torch.maximum(other_score, score), torch.minimum(other_score, score)
        scores[chosen] = torch.stack(kept).mean(dim=0)
    return scores


def comparable(view: View, most: float) -> Tensor:
    """Return the mean of a view's channels [H, W], clipped where either of two views saturates; NaN on the border."""
    image = view.image.clamp(max=most).mean(dim=0)
    return F.pad(image[1:-1, 1:-1], (1, 1, 1, 1), value=torch.nan)


def homography_terms(rays: Tensor, reference: View, source: View) -> tuple[Tensor, Tensor]:
    """Return a [h, w, 3] and b [3] such that a + b / depth projects points on the reference's rays into the source.

    The first two coordinates over the third are -1 at the source's left or upper edge and 1 at its right or lower.
    """
    R, t = relative(reference, source)
    height, width = source.lit.shape
    from_px = torch.tensor([[2 / width, 0, -1], [0, 2 / height, -1], [0, 0, 1]], dtype=source.K.dtype)
    P = from_px @ source.K
    return (rays @ (P @ R).T).float(), (P @ t).float()


def warp(image: Tensor, turned: Tensor, moved: Tensor, inverse_depths: Tensor) -> Tensor:
    """Return an image [C, H, W] as seen along another camera's rays at inverse depths [D, h, w], 1/m: [C, D, h, w].

    Values are bilinear, and those of the border outside the image. The gradient flows to the image.

    Args:
        turned, moved: the terms of `homography_terms`.
    """
    z = (turned[..., 2] + moved[2] * inverse_depths).clamp(min=1e-6)  # behind the camera: far outside
    place = torch.empty(*inverse_depths.shape, 2)
    for axis in range(2):
        place[..., axis] = (turned[..., axis] + moved[axis] * inverse_depths) / z
    # all planes as one tall grid: the image need not be repeated for each
    rows = place.flatten(0, 1)[None]
    warped = F.grid_sample(image[None], rows, "bilinear", "border", align_corners=False)[0]
    return warped.unflatten(1, inverse_depths.shape[:2])


def correlation(a: Tensor, b: Tensor, window_px: int) -> Tensor:
    """Return the normalised cross-correlation of all windows within a [h, w] and b [D, h, w].

    Returns:
        [D, h - window_px + 1, w - window_px + 1]; 0 for a window without texture, not a number for one that holds such.
    """
    count = window_px**2
    a = a[None]
    mean_a, mean_b = _sums(a, window_px) / count, _sums(b, window_px) / count
    covariance = _sums(a * b, window_px) / count - mean_a * mean_b
    variance_a = _sums(a * a, window_px) / count - mean_a**2
    variance_b = _sums(b * b, window_px) / count - mean_b**2
    both = torch.maximum(variance_a, FLAT * (1 + mean_a**2)) * torch.maximum(
        variance_b, FLAT * (1 + mean_b**2)
    )
    return (covariance / both.sqrt()).clamp(-1, 1)


def _sums(images: Tensor, window_px: int) -> Tensor:
    """Return the sum over each window within images [D, h, w]; shifted additions are far faster than pooling here."""
    for axis in (2, 1):
        size = images.shape[axis] - window_px + 1
        total = images.narrow(axis, 0, size).clone()
        for k in range(1, window_px):
            total += images.narrow(axis, k, size)
        images = total
    return images


def _peak(score: Tensor, planes: Tensor) -> tuple[Tensor, Tensor]:
    """Return the best score [h, w] and its inverse depth, 1/m, at the top of a parabola through three planes."""
    value, index = score.max(dim=0)
    inner = index.clamp(1, len(planes) - 2)
    before, at, after = (score.gather(0, (inner + k)[None])[0] for k in (-1, 0, 1))
    bend = (2 * at - before - after).clamp(min=1e-6)
    # at the ends of the range, and beside planes that cannot be compared, the best plane is taken as it is
    known = (index == inner) & (before > NOTHING) & (after > NOTHING)
    shift = torch.where(known, (0.5 * (after - before) / bend).clamp(-0.5, 0.5), 0.0)
    return value, planes[index] + shift * (planes[1] - planes[0])
