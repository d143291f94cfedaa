"""A start from silhouettes: the visual hull that most long exposures agree on. Space is black, so light is target."""

import logging
import math
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from obbgs_core.sensor import Sensor

log = logging.getLogger(__name__)
BRIGHT_SIGMA = 5.0  # of a 3x3 mean; fainter pixels are sky
AGREEMENT = (
    0.92  # share of views that must see light where a voxel projects; the rest may look at shadowed faces
)
COARSE_VOXELS = 64  # along each axis of the first grid; two subdivisions follow
SUBDIVISIONS = 2


@dataclass(frozen=True)
class Silhouette:
    """Where one frame sees light: mask [H, W] bool."""

    mask: Tensor
    world_to_camera: Tensor
    K: Tensor


def silhouette(dn: Tensor, sensor: Sensor, world_to_camera: Tensor, K: Tensor, dilate_px: int) -> Silhouette:
    """Return the pixels of dn [H, W, C] that are brighter than noise, grown by `dilate_px` for pose errors."""
    signal = (dn.mean(dim=-1) - sensor.black_dn)[None, None]
    sigma = math.hypot(sensor.read_noise_dn, 0.3) / 3
    if sensor.black_dn < 2 * sensor.read_noise_dn:  # noise clipped at zero has a mean of its own
        signal = signal - 0.4 * sensor.read_noise_dn
    bright = (F.avg_pool2d(signal, 3, 1, 1) > BRIGHT_SIGMA * sigma).float()
    size = 2 * dilate_px + 1
    return Silhouette(F.max_pool2d(bright, size, 1, dilate_px)[0, 0] > 0, world_to_camera, K)


def radius_m(silhouettes: list[Silhouette]) -> float:
    """Return how far from the origin the target reaches, from the farthest light in each view; 0 when all are dark."""
    radii = []
    for s in silhouettes:
        rows, columns = torch.nonzero(s.mask, as_tuple=True)
        if len(rows) == 0:
            continue
        origin = s.world_to_camera[:3, 3]
        if origin[2] <= 0:
            continue
        x = (columns + 0.5 - s.K[0, 2]) / s.K[0, 0] - origin[0] / origin[2]
        y = (rows + 0.5 - s.K[1, 2]) / s.K[1, 1] - origin[1] / origin[2]
        radii.append(float(torch.quantile(torch.hypot(x, y), 0.998) * origin[2]))
    return 1.05 * max(radii, default=0.0)


def hull_points(silhouettes: list[Silhouette], radius: float) -> tuple[Tensor, float]:
    """Return surface points [M, 3] m of the visual hull, and the voxel size, m.

    The grid starts coarse and only what survives is subdivided. Empty when the views do not agree anywhere.
    """
    voxel_m = 2 * radius / COARSE_VOXELS
    axis = (torch.arange(COARSE_VOXELS) + 0.5) * voxel_m - radius
    points = torch.cartesian_prod(axis, axis, axis)
    for level in range(SUBDIVISIONS + 1):
        if level:
            offsets = torch.cartesian_prod(*(torch.tensor([-0.25, 0.25]),) * 3) * voxel_m
            points = (points[:, None] + offsets).reshape(-1, 3)
            voxel_m /= 2
        # a coarse voxel survives when light falls anywhere near its projection, a final one when at its centre
        points = points[agreement(silhouettes, points, 0.87 * voxel_m * (level < SUBDIVISIONS)) >= AGREEMENT]
        if len(points) == 0:
            break
    return points[_on_surface(points, voxel_m)], voxel_m


def agreement(silhouettes: list[Silhouette], points: Tensor, reach_m: float) -> Tensor:
    """Return the share [M] of views that see light within `reach_m` of each point; views that miss it do not vote."""
    votes, seen = torch.zeros(len(points)), torch.zeros(len(points))
    for s in silhouettes:
        p = points @ s.world_to_camera[:3, :3].T + s.world_to_camera[:3, 3]
        z = p[:, 2].clamp(min=1e-6)
        u, v = s.K[0, 0] * p[:, 0] / z + s.K[0, 2], s.K[1, 1] * p[:, 1] / z + s.K[1, 2]
        height, width = s.mask.shape
        inside = (p[:, 2] > 1e-6) & (u >= 0) & (v >= 0) & (u < width) & (v < height)
        mask = s.mask
        if reach_m > 0:
            pixels = math.ceil(float(s.K[0, 0]) * reach_m / max(float(s.world_to_camera[2, 3]), 1e-6))
            pixels = min(pixels, min(height, width) // 4)
            mask = F.max_pool2d(mask[None, None].float(), 2 * pixels + 1, 1, pixels)[0, 0] > 0
        lit = mask[v.long().clamp(0, height - 1), u.long().clamp(0, width - 1)]
        votes += (lit & inside).float()
        seen += inside.float()
    return torch.where(seen >= max(1, len(silhouettes) // 3), votes / seen.clamp(min=1), 0.0)


def _on_surface(points: Tensor, voxel_m: float) -> Tensor:
    """Return which voxels [M] lack at least one of their six neighbours."""
    if len(points) == 0:
        return torch.zeros(0, dtype=torch.bool)
    cell = torch.round((points - points.min(0).values) / voxel_m).long() + 1
    stride = int(cell.max()) + 2
    weights = torch.tensor([stride * stride, stride, 1])
    keys = torch.sort((cell * weights).sum(1)).values
    surface = torch.zeros(len(points), dtype=torch.bool)
    for axis in range(3):
        for side in (-1, 1):
            neighbour = (cell * weights).sum(1) + side * weights[axis]
            at = torch.searchsorted(keys, neighbour).clamp(max=len(keys) - 1)
            surface |= keys[at] != neighbour
    return surface
