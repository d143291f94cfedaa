"""The silhouettes of a pass, small and of one scale, as the search for the attitude compares them."""

from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from obbgs_core.start.hull import Silhouette

MARGIN = 1.1  # a picture's half width, in radii of the target


@dataclass(frozen=True)
class Views:
    """Silhouettes of N frames as pictures of n x n cells around the target's projected centre.

    lit: [N, n, n] share of each cell that certainly is light, 0 to 1.
    open: [N, n, n] share of each cell that may be light, 0 to 1; 1 where the camera does not look.
    world_to_camera: [N, 4, 4], body axes taken as inertial axes; lengths in radii of the target.
    scale, centre: [N], [N, 2] cells = scale · (x / z, y / z) + centre.
    times_s: [N] from the reference epoch.
    cell: width of a cell at the target, in radii.
    """

    lit: Tensor
    open: Tensor
    world_to_camera: Tensor
    scale: Tensor
    centre: Tensor
    times_s: np.ndarray
    cell: float

    def __len__(self) -> int:
        return len(self.lit)

    def some(self, indices: np.ndarray) -> "Views":
        """Return some of the views, with times from the same epoch."""
        chosen = torch.from_numpy(indices)
        return Views(
            self.lit[chosen],
            self.open[chosen],
            self.world_to_camera[chosen],
            self.scale[chosen],
            self.centre[chosen],
            self.times_s[indices],
            self.cell,
        )


def views(outlines: list[Silhouette], times_s: np.ndarray, radius_m: float, cells: int) -> Views:
    """Return silhouettes resampled to pictures of cells x cells.

    Args:
        outlines: one for each frame, with poses relative to inertial axes.
        times_s: [N] of the frames from the reference epoch.
        radius_m: of the target.
    """
    lit, near, scales, centres, poses = [], [], [], [], []
    cell_m = 2 * MARGIN * radius_m / cells
    offsets = (torch.arange(cells) + 0.5) * cell_m - MARGIN * radius_m
    for outline in outlines:
        x, y, z = outline.world_to_camera[:3, 3].tolist()
        K, (height, width) = outline.K, outline.certain.shape
        rows = K[1, 1] * (offsets + y) / z + K[1, 2]
        columns = K[0, 0] * (offsets + x) / z + K[0, 2]
        window = max(1, round(cell_m * float(K[0, 0]) / z))
        grid = torch.stack(
            torch.broadcast_tensors(columns[None, :] * 2 / width - 1, rows[:, None] * 2 / height - 1), dim=-1
        )[None]
        lit.append(_sampled(_mean(outline.certain, window), grid))
        near.append(1 - _sampled(1 - _mean(outline.likely, window), grid))
        poses.append(outline.world_to_camera)
        scales.append(z / cell_m)
        centres.append([cells / 2 - x / cell_m, cells / 2 - y / cell_m])
    world_to_camera = torch.stack(poses).clone()
    world_to_camera[:, :3, 3] /= radius_m
    return Views(
        torch.stack(lit),
        torch.stack(near),
        world_to_camera,
        torch.tensor(scales),
        torch.tensor(centres),
        times_s,
        cell_m / radius_m,
    )


def _mean(mask: Tensor, window: int) -> Tensor:
    """Return the mean of about window x window pixels around each pixel [1, 1, H, W], of those inside the picture."""
    odd = window // 2 * 2 + 1
    return F.avg_pool2d(mask.float()[None, None], odd, 1, odd // 2, count_include_pad=False)


def _sampled(image: Tensor, grid: Tensor) -> Tensor:
    return F.grid_sample(image, grid, align_corners=False)[0, 0]
