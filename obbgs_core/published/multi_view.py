"""Growth between several views of a step: where rays of their worst tiles cross (Du et al., MVGS, 2024)."""

import itertools

import torch
from torch import Tensor

from obbgs_core.model import obb
from obbgs_core.model.cameras import Cameras

PARALLEL = 1e-6  # sine of the angle below which two rays do not cross
FAR_APART = 1.0  # distance of two cameras' unit directions from the origin, from where on views are distinct
DISTINCT_VIEWS = 0.5  # factor on the threshold of growth where two views of a step are


def threshold_factor(cameras: Cameras) -> float:
    """Return the factor on the threshold of growth: lower where two cameras of a step are far apart."""
    directions = torch.nn.functional.normalize(cameras.centres.detach(), dim=1)
    return DISTINCT_VIEWS if (torch.cdist(directions, directions) > FAR_APART).any() else 1.0


@torch.no_grad()
def crossing_boxes(cameras: Cameras, residual: Tensor) -> Tensor:
    """Return boxes [P, 2, 3] (lowest and highest corner, m) around where the worst tiles of two views cross.

    The rays through corresponding corners of the tiles do not meet in general; the middle of the points at which they
    are nearest stands for their crossing. Pairs of views with parallel rays have no box.

    Args:
        residual: [C, H, W, channels] of the cameras' images.
    """
    origins = cameras.centres
    directions = torch.stack([corner_rays(cameras, i, residual[i]) for i in range(len(cameras))])
    boxes = []
    for i, j in itertools.combinations(range(len(cameras)), 2):
        normal = torch.linalg.cross(directions[i], directions[j])
        square = normal.square().sum(dim=1, keepdim=True)
        if bool((square < PARALLEL**2).any()):
            continue
        between = (origins[j] - origins[i]).expand(4, 3)
        along_i = (torch.linalg.cross(between, directions[j]) * normal).sum(dim=1, keepdim=True) / square
        along_j = (torch.linalg.cross(between, directions[i]) * normal).sum(dim=1, keepdim=True) / square
        middles = (origins[i] + along_i * directions[i] + origins[j] + along_j * directions[j]) / 2
        boxes.append(torch.stack([middles.amin(dim=0), middles.amax(dim=0)]))
    return torch.stack(boxes) if boxes else torch.zeros(0, 2, 3)


def corner_rays(cameras: Cameras, index: int, residual: Tensor) -> Tensor:
    """Return unit directions [4, 3], body frame, through the corners of the worst tile of a residual [H, W, C]."""
    top, left = obb.worst_tile(residual)
    rows = torch.tensor([top, top, top + obb.TILE_ROWS, top + obb.TILE_ROWS]) + 0.5
    columns = torch.tensor([left, left + obb.TILE_COLUMNS, left, left + obb.TILE_COLUMNS]) + 0.5
    K, R = cameras.K[index], cameras.world_to_camera[index, :3, :3]
    x, y = (columns - K[0, 2]) / K[0, 0], (rows - K[1, 2]) / K[1, 1]
    return torch.nn.functional.normalize(torch.stack([x, y, torch.ones(4)], dim=1) @ R, dim=1)


def inside(points: Tensor, boxes: Tensor) -> Tensor:
    """Return which points [N, 3] lie in one of boxes [P, 2, 3], as bool [N]."""
    within = torch.zeros(len(points), dtype=torch.bool)
    for low, high in boxes:
        within |= ((points > low) & (points < high)).all(dim=1)
    return within
