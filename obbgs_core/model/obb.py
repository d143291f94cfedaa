"""Oriented bounding boxes around the Gaussians behind an image's worst tile (Jiang et al. 2025, section 3.4.2)."""

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

TILE_ROWS, TILE_COLUMNS = 20, 40  # px, the paper's window and stride
FEWEST = 4  # Gaussians for a box with a volume
SURFACE_MARGIN = 0.02  # of the depth: Gaussians this far behind the visible surface still belong to it


@dataclass(frozen=True)
class Obb:
    """Centre [3] m, axes [3, 3] (columns, orthonormal), half_extents [3] m."""

    centre: Tensor
    axes: Tensor
    half_extents: Tensor

    def contains(self, points: Tensor) -> Tensor:
        """Return which points [N, 3] lie inside or on the box, as bool [N]."""
        local = (points - self.centre) @ self.axes
        return (local.abs() <= self.half_extents * (1 + 1e-5) + 1e-9).all(dim=-1)


def fit(points: Tensor, centre: Literal["middle", "mean"] = "middle") -> Obb:
    """Return the box of points [N, 3] along the eigenvectors of their covariance (1/(n-1)).

    Args:
        centre: the middle of the extremes, around which the box is tight, or the mean, as published: then points of a
            skewed set lie outside.

    Raises:
        ValueError: fewer than two points.
    """
    if len(points) < 2:
        raise ValueError(f"a box needs at least 2 points, got {len(points)}")
    mean = points.mean(dim=0)
    _, axes = torch.linalg.eigh(torch.cov(points.T))
    local = (points - mean) @ axes
    low, high = local.min(dim=0).values, local.max(dim=0).values
    middle = mean + axes @ ((low + high) / 2)
    return Obb(middle if centre == "middle" else mean, axes, (high - low) / 2)


def worst_tile(residual: Tensor) -> tuple[int, int]:
    """Return the top row and left column, px, of the whole tile with the largest mean |residual|, of [H, W, C]."""
    height, width, _ = residual.shape
    rows, columns = min(TILE_ROWS, height), min(TILE_COLUMNS, width)
    down, across = height // rows, width // columns
    tiles = residual[: down * rows, : across * columns].reshape(down, rows, across, -1)
    index = int(tiles.abs().sum(dim=(1, 3)).argmax())
    return index // across * rows, index % across * columns


def behind_tile(
    means: Tensor, means2d: Tensor, depth: Tensor, world_to_camera: Tensor, tile: tuple[int, int]
) -> Tensor:
    """Return which Gaussians [N] lie in the frustum of the tile, no deeper than the visible surface.

    Args:
        means: [N, 3] m; means2d: [N, 2] px; depth: [H, W] m, 0 where nothing is.
    """
    top, left = tile
    z = means @ world_to_camera[2, :3] + world_to_camera[2, 3]
    seen = depth[top : top + TILE_ROWS, left : left + TILE_COLUMNS]
    farthest = (seen.max() * (1 + SURFACE_MARGIN)).item()
    x, y = means2d.unbind(-1)
    inside = (x >= left) & (x < left + TILE_COLUMNS) & (y >= top) & (y < top + TILE_ROWS)
    return inside & (z > 0) & (z <= farthest)
