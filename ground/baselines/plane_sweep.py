"""Plane-sweep multi-view stereo with known poses: depths at which neighbouring pictures correlate.

Source: Collins, A space-sweep approach to true multi-image matching, 1996; several directions of planes as in Gallup
et al., Real-time plane-sweeping stereo with multiple sweeping directions, 2007; the fusion is in `depth_maps.py`.
"""

import math
from dataclasses import asdict, dataclass, field

import torch
import torch.nn.functional as F
from torch import Tensor

from ground.baselines.depth_maps import DepthMap, FusionSettings, reconstruct_by_depth_maps
from ground.baselines.reconstruction import Reconstruction, Work
from ground.baselines.stereo_views import (
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
FLAT = 1e-10  # a variance below this, full scale 1, is no texture
PIXELS_AT_ONCE = 200_000  # keeps the arrays of a pass in the processor's cache


@dataclass(frozen=True)
class SweepSettings:
    """How depths are found."""

    window_px: int = 7  # odd; windows of this width are correlated
    sources: int = 8  # views with which each is matched
    kept: int = (
        3  # the best correlations of each pixel and plane are averaged: in the others it may be hidden
    )
    plane_px: float = 1.0  # from plane to plane a point moves so far in the picture of the widest baseline
    tilts_deg: tuple[float, ...] = (0.0, 45.0)  # of the planes; each but 0 in four directions
    fusion: FusionSettings = field(default_factory=lambda: FusionSettings(least_confidence=0.5))


def reconstruct_mvs(
    frames: list[TrainingFrame],
    sensor: Sensor,
    work: Work,
    one_exposure: bool = True,
    settings: SweepSettings | None = None,
) -> Reconstruction:
    """Return the fused point cloud of depth maps by correlation.

    Args:
        one_exposure: frames are divided by their exposure times, and windows with saturated pixels are left out; if
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
    near_m, far_m = depth_range_m(view, views.radius_m)
    others = [views.views[j] for j in sources]
    for normal in _normals(settings.tilts_deg):
        planes = _planes(view, others, normal, views.radius_m, settings.plane_px)
        score = _scores(view, grid, others, normal, planes, settings)
        value, inverse_offset = _peak(score, planes)
        along = (pixel_rays(grid[0], grid[1], view.K) @ normal).float()
        depth = 1 / (inverse_offset * along).clamp(min=1e-9)
        # a tilted plane also meets rays outside the range
        better = (depth >= near_m) & (depth <= far_m) & (value > best[crop]) & view.lit[crop]
        depth_m[crop] = torch.where(better, depth, depth_m[crop])
        best[crop] = torch.where(better, value, best[crop])
    return DepthMap(depth_m, best)


def _bounds(lit: Tensor) -> tuple[tuple[int, int], tuple[int, int]]:
    """Return first and last row and column, exclusive, of the lit pixels."""
    rows, columns = torch.nonzero(lit.any(dim=1)), torch.nonzero(lit.any(dim=0))
    return (int(rows.min()), int(rows.max()) + 1), (int(columns.min()), int(columns.max()) + 1)


def _normals(tilts_deg: tuple[float, ...]) -> list[Tensor]:
    """Return the unit normals [3] of the planes, in the camera's frame."""
    normals = []
    for tilt in map(math.radians, tilts_deg):
        for quarter in range(4 if tilt else 1):
            around = quarter * math.pi / 2 + math.pi / 4
            x, y = math.sin(tilt) * math.cos(around), math.sin(tilt) * math.sin(around)
            normals.append(torch.tensor([x, y, math.cos(tilt)], dtype=torch.float64))
    return normals


def _planes(view: View, others: list[View], normal: Tensor, radius_m: float, plane_px: float) -> Tensor:
    """Return the inverse offsets [D] 1/m of planes normal·X = offset through the sphere that the target can fill.

    They are even in the inverse offset, in which the image of a point moves nearly evenly.
    """
    middle_m = float(normal @ view.world_to_camera[:3, 3])
    near_m, far_m = max(middle_m - radius_m, 0.02 * abs(middle_m)), middle_m + radius_m
    # disparity is focal length times baseline over depth, and a depth on the axis is the offset over normal[2]
    widest = max(float(other.K[0, 0] * (view.centre - other.centre).norm()) for other in others)
    shift_px = widest * float(normal[2]) * (1 / near_m - 1 / far_m)
    count = max(3, math.ceil(shift_px / plane_px) + 1)
    return torch.linspace(1 / far_m, 1 / near_m, count)


def _scores(
    view: View,
    grid: tuple[Tensor, ...],
    others: list[View],
    normal: Tensor,
    planes: Tensor,
    settings: SweepSettings,
) -> Tensor:
    """Return the mean [D, h, w] of the best correlations of pixels with the neighbours at each plane."""
    half = settings.window_px // 2
    rows, columns = (torch.arange(int(g.min()) - half, int(g.max()) + half + 1) for g in grid)
    rows, columns = torch.meshgrid(rows, columns, indexing="ij")
    rays = pixel_rays(rows, columns, view.K)
    image = F.pad(comparable(view), (half,) * 4, value=torch.nan)[rows + half, columns + half]
    along = (rays @ normal).float()
    sources = [(comparable(other), homography_terms(rays, view, other)) for other in others]
    scores = torch.empty(len(planes), *grid[0].shape)
    at_once = max(1, PIXELS_AT_ONCE // rays[..., 0].numel())
    for first in range(0, len(planes), at_once):
        chosen = slice(first, first + at_once)
        inverse_depths = planes[chosen, None, None] * along
        kept = [torch.full_like(scores[chosen], NOTHING) for _ in range(min(settings.kept, len(others)))]
        for source, (turned, moved) in sources:
            warped = warp(source[None], turned, moved, inverse_depths)[:, 0]
            score = correlation(image, warped, settings.window_px).nan_to_num_(NOTHING)
            for k, other_score in enumerate(kept):  # the best first
                kept[k], score = torch.maximum(other_score, score), torch.minimum(other_score, score)
        scores[chosen] = torch.stack(kept).mean(dim=0)
    return scores


def comparable(view: View) -> Tensor:
    """Return the mean of a view's channels [H, W], not a number at saturated pixels and on the border."""
    image = torch.where(view.saturated, torch.nan, view.image.mean(dim=0))
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
    """Return an image [C, H, W] as seen along another camera's rays at inverse depths [D, h, w], 1/m: [D, C, h, w].

    Values are bilinear, and those of the border outside the image. The gradient flows to the image.

    Args:
        turned, moved: the terms of `homography_terms`.
    """
    z = (turned[..., 2] + moved[2] * inverse_depths).clamp(min=1e-6)  # behind the camera: far outside
    place = torch.empty(*inverse_depths.shape, 2)
    for axis in range(2):
        place[..., axis] = (turned[..., axis] + moved[axis] * inverse_depths) / z
    stack = image.expand(len(place), *image.shape)
    return F.grid_sample(stack, place, "bilinear", "border", align_corners=False)


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
    both = variance_a.clamp(min=FLAT) * variance_b.clamp(min=FLAT)
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
    """Return the best score [h, w] and its inverse offset, 1/m, at the top of a parabola through three planes."""
    value, index = score.max(dim=0)
    inner = index.clamp(1, len(planes) - 2)
    before, at, after = (score.gather(0, (inner + k)[None])[0] for k in (-1, 0, 1))
    bend = (2 * at - before - after).clamp(min=1e-6)
    # at the ends of the range, and beside planes that cannot be compared, the best plane is taken as it is
    known = (index == inner) & (before > NOTHING) & (after > NOTHING)
    shift = torch.where(known, (0.5 * (after - before) / bend).clamp(-0.5, 0.5), 0.0)
    return value, planes[index] + shift * (planes[1] - planes[0])
