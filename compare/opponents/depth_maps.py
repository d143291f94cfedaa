"""From depth maps to a point cloud: maps made one after the other, checked against each other, and fused."""

import hashlib
import io
import pickle
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from compare.opponents.reconstruction import Reconstruction, Work
from compare.opponents.stereo_views import View, Views, neighbours, pixel_rays
from obbgs_base.errors import Interrupted
from obbgs_base.files import write_whole

BYTES_A_POINT = 12  # three floats of 32 bits


@dataclass(frozen=True)
class DepthMap:
    """Depths of one view's pixels, m, and how well the views agree on each; both [H, W], 0 where there is none."""

    depth_m: Tensor
    confidence: Tensor


@dataclass(frozen=True)
class FusionSettings:
    """When a depth becomes a point; the tests are those of Yao et al., MVSNet, 2018."""

    least_confidence: float
    neighbours: int = 10  # views that each depth is compared with
    agreeing_views: int = 3  # at least so many others must agree
    reprojection_px: float = 1.0  # largest error of going to the other view's surface and back
    relative_depth: float = 0.01  # largest difference of depth, as a share of it


def reconstruct_by_depth_maps(
    views: Views,
    estimate: Callable[[int], DepthMap],
    fusion: FusionSettings,
    method: str,
    work: Work,
    figures: dict[str, object],
) -> Reconstruction:
    """Return the fused points of a depth map for each view, or nothing with the reason.

    Args:
        estimate: from the index of a view to its depth map.
        method: everything that decides the maps besides the views; a kept map of another method is not used.
        figures: further columns of the row.

    Raises:
        Interrupted: `work.should_stop` returned true; the maps that are done are kept in `work.folder`.
    """
    key = hashlib.sha256(f"{views.digest} {method}".encode()).hexdigest()[:16]
    maps: list[DepthMap] = []
    seconds = 0.0
    for i in range(len(views.views)):
        path = None if work.folder is None else work.folder / f"depth-{key}-{i:04d}.pt"
        kept = _load(path) if path is not None else None
        if kept is None:
            started = time.monotonic()
            done = estimate(i)
            kept = done, time.monotonic() - started
            if path is not None:
                _save(path, *kept)
        maps.append(kept[0])
        seconds += kept[1]
        so_far = list(maps)
        spent = seconds
        work.on_step(
            len(maps) / (len(views.views) + 1),
            spent,
            lambda _, so_far=so_far, spent=spent: _fused(views, so_far, fusion, spent, figures),
        )
        if work.should_stop():
            where = "nothing is kept" if work.folder is None else f"they are kept in {work.folder}"
            raise Interrupted(f"stopped after {len(maps)} of {len(views.views)} depth maps; {where}")
    return _fused(views, maps, fusion, seconds, figures)


def _save(path: Path, depths: DepthMap, seconds: float) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    content = io.BytesIO()
    torch.save(
        {"depth_m": depths.depth_m, "confidence": depths.confidence, "seconds": seconds},
        content,
    )
    write_whole(path, content.getvalue())


def _load(path: Path) -> tuple[DepthMap, float] | None:
    """Return a kept depth map and the seconds that it took, or nothing where there is none that can be read."""
    if not path.is_file():
        return None
    try:
        kept = torch.load(path, weights_only=True)
        return DepthMap(kept["depth_m"], kept["confidence"]), float(kept["seconds"])
    except (RuntimeError, pickle.UnpicklingError, KeyError, EOFError, TypeError):  # it is made again
        return None


def _fused(
    views: Views, maps: list[DepthMap], fusion: FusionSettings, seconds: float, figures: dict[str, object]
) -> Reconstruction:
    started = time.monotonic()
    points, candidates = fuse(views, maps, fusion)
    seconds += time.monotonic() - started
    rejected = 1 - len(points) / max(1, candidates)
    figures = figures | {"points": len(points), "depth_maps": len(maps), "rejected_share": rejected}
    if len(points) == 0:
        reason = f"no depth of {len(maps)} maps was confirmed by {fusion.agreeing_views} other views"
        return Reconstruction(points, points, None, 0, seconds, {**figures, "failed": reason})
    return Reconstruction(points, points, None, BYTES_A_POINT * len(points), seconds, figures)


def fuse(views: Views, maps: list[DepthMap], fusion: FusionSettings) -> tuple[Tensor, int]:
    """Return the points [N, 3] m, body frame, of the depths that enough other views confirm.

    Each confident depth is projected into the neighbouring views; the depth that is found there is projected back. The
    views agree where it comes back to the same pixel and depth; the point has the mean of the agreeing depths.

    Args:
        maps: of the first views, one each.

    Returns:
        The points, and the number of depths from which they were chosen.
    """
    pairs = neighbours(views, fusion.neighbours)
    clouds, candidates = [torch.zeros(0, 3)], 0
    for i, depths in enumerate(maps):
        view = views.views[i]
        rows, columns = torch.nonzero(depths.depth_m > 0, as_tuple=True)
        candidates += len(rows)
        sure = depths.confidence[rows, columns] >= fusion.least_confidence
        rows, columns = rows[sure], columns[sure]
        depth_m = depths.depth_m[rows, columns].double()
        rays = pixel_rays(rows, columns, view.K)
        total_m, agreeing = depth_m.clone(), torch.zeros(len(rows), dtype=torch.long)
        for j in (j for j in pairs[i] if j < len(maps)):
            sure_there = torch.where(maps[j].confidence >= fusion.least_confidence, maps[j].depth_m, 0)
            back_m, error_px = _there_and_back(view, views.views[j], sure_there, rays, depth_m)
            same = (error_px < fusion.reprojection_px) & (
                (back_m - depth_m).abs() < fusion.relative_depth * depth_m
            )
            agreeing += same
            total_m += torch.where(same, back_m, 0)
        chosen = agreeing >= fusion.agreeing_views
        p = (total_m / (agreeing + 1))[:, None] * rays
        points = (p - view.world_to_camera[:3, 3]) @ view.world_to_camera[:3, :3]
        clouds.append(points[chosen].float())
    return torch.cat(clouds), candidates


def _there_and_back(
    view: View, other: View, other_depth_m: Tensor, rays: Tensor, depth_m: Tensor
) -> tuple[Tensor, Tensor]:
    """Return the depth [P] m and the distance [P] px at which points come back from the other view's surface.

    The distance is infinite where the other view has no depth.
    """
    pose = other.world_to_camera @ torch.linalg.inv(view.world_to_camera)
    there = (depth_m[:, None] * rays) @ pose[:3, :3].T + pose[:3, 3]
    ray = there / there[:, 2:].clamp(min=1e-9)
    uv = (ray @ other.K.T)[:, :2]
    height, width = other_depth_m.shape
    column, row = uv.floor().unbind(dim=1)
    seen = (there[:, 2] > 0) & (column >= 0) & (row >= 0) & (column < width) & (row < height)
    index = torch.where(seen, row * width + column, 0).long()
    found_m = torch.where(seen, other_depth_m.flatten()[index], 0).double()
    back = (found_m[:, None] * ray - pose[:3, 3]) @ pose[:3, :3]
    moved = (back / back[:, 2:].clamp(min=1e-9) - rays) @ view.K.T
    error_px = torch.where(found_m > 0, moved[:, :2].norm(dim=1), torch.inf)
    return back[:, 2], error_px
