"""How well silhouettes agree under a motion: the share of their light that the hull of all of them covers.

Source: Hernandez, Schmitt and Cipolla, Silhouette coherence for camera calibration under circular motion, 2007.
"""

import torch
import torch.nn.functional as F
from torch import Tensor

from obbgs_core.attitude.views import Views

# share of the views that see no light at a point of the target, by which its occupancy falls to 1/e
FORGIVEN = 0.05
FILL = 0.85  # spacing of the points, in cells


def grid_points(spacing: float) -> Tensor:
    """Return points [V, 3] on a cubic grid inside the unit ball."""
    ticks = torch.arange(-1 + spacing / 2, 1, spacing)
    points = torch.stack(torch.meshgrid(ticks, ticks, ticks, indexing="ij"), dim=-1).reshape(-1, 3)
    return points[points.norm(dim=1) <= 1].contiguous()


def coherences(views: Views, attitudes: Tensor, points: Tensor) -> Tensor:
    """Return the share [B] of the light of all views that the hull covers, for each of B candidate motions.

    Args:
        attitudes: [B, N, 3, 3] inertial to body axes at each view.
        points: [V, 3] in radii of the target, at most a cell apart.
    """
    count, n = len(attitudes), views.lit.shape[-1]
    cells, occupancy = _occupied(views, attitudes, points)
    covered = torch.zeros(count, len(views), n * n)
    covered.scatter_reduce_(2, cells, occupancy[:, None].expand(-1, len(views), -1), "amax")
    lit = views.lit.flatten(1)
    return torch.minimum(covered, lit).sum(dim=(1, 2)) / lit.sum()


def hull_axes(views: Views, attitudes: Tensor) -> Tensor:
    """Return the principal axes of the hull, the columns of [3, 3], body frame, under one motion [N, 3, 3]."""
    points = grid_points(FILL * views.cell)
    _, occupancy = _occupied(views, attitudes[None], points)
    return torch.linalg.eigh((points * occupancy[0, :, None]).T @ points).eigenvectors


def _occupied(views: Views, attitudes: Tensor, points: Tensor) -> tuple[Tensor, Tensor]:
    """Return the cells [B, N, V] that points project to, and their occupancies [B, V], 0 to 1."""
    n = views.lit.shape[-1]
    R, t = views.world_to_camera[:, :3, :3], views.world_to_camera[:, :3, 3]
    to_camera = R @ attitudes.transpose(-1, -2)  # [B, N, 3, 3]
    p = to_camera @ points.T + t[:, :, None]  # [B, N, 3, V]
    u, v = ((views.scale[:, None] * p[:, :, i] / p[:, :, 2]) + views.centre[:, i, None] for i in (0, 1))
    cells = v.long().clamp(0, n - 1) * n + u.long().clamp(0, n - 1)  # [B, N, V]
    offset = torch.arange(len(views))[:, None] * n * n
    near = F.max_pool2d(views.open, 3, 1, 1)  # light anywhere near
    seen = near.flatten()[(cells + offset).flatten()].view_as(u)
    return cells, torch.exp(-(1 - seen).mean(dim=1) / FORGIVEN)
