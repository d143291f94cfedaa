"""Gaussians on the image plane: the affine (EWA) projection."""

import dataclasses
from dataclasses import dataclass

import torch
from torch import Tensor

from obbgs_core.model.cameras import Cameras
from obbgs_core.model.footprint import footprint_px2, lowers_peak
from obbgs_core.model.gaussians import Gaussians

FOV_MARGIN = 1.3  # the affine approximation is clamped this far outside the image (Kerbl et al. 2023)
RADIUS_SIGMAS = 3  # of the longer axis
# A Gaussian whose peak falls to less than this share is not drawn: fainter than one step of a 12-bit sensor.
MIN_PEAK_SHARE = 1 / 4096


@dataclass
class Projected:
    """Gaussians on each image plane."""

    means2d: Tensor  # [C, N, 2] px
    conics: Tensor  # [C, N, 3] px⁻² (xx, xy, yy): inverse of the widened 2D covariance
    factors: Tensor  # [C, N, 3] px⁻¹ (xx, xy, yy): L of the conic LᵀL, with a 0 below its diagonal
    peak_shares: Tensor  # [C, N] of the opacity, at the projected mean: below 1 where the peak is lowered
    depths: Tensor  # [C, N] m; 0 where the Gaussian is not drawn
    radii: Tensor  # [C, N] px, three sigma of the longer axis, rounded up; 0 where the Gaussian is not drawn


def project(gaussians: Gaussians, cameras: Cameras) -> Projected:
    """Project Gaussians onto each image plane by the local affine (EWA) approximation.

    The covariance is widened by what a pixel averages over, its footprint. Unless the footprint is `kerbl`, opacities
    fall by the root of the ratio of the determinants before and after, so that the integral over the image is kept.
    Gaussians nearer than `cameras.near_m`, or not finite, get depth and radius 0 and no gradient, never NaN.

    Source: Zwicker et al., EWA Volume Splatting, 2001; the lowered peak: Yu et al., Mip-Splatting, 2024.
    """
    gaussians, finite = with_zeros_for_invalid(gaussians)
    R, t = cameras.world_to_camera[:, :3, :3], cameras.world_to_camera[:, :3, 3]
    p = torch.einsum("cij,nj->cni", R, gaussians.means) + t[:, None]  # [C, N, 3]
    drawn = finite & (p[..., 2] > cameras.near_m) & torch.isfinite(p).all(dim=-1)
    z = torch.where(drawn, p[..., 2], torch.ones_like(p[..., 2]))
    fx, fy = cameras.K[:, 0, 0, None], cameras.K[:, 1, 1, None]
    cx, cy = cameras.K[:, 0, 2, None], cameras.K[:, 1, 2, None]
    x, y = torch.where(drawn, p[..., 0], 0) / z, torch.where(drawn, p[..., 1], 0) / z
    means2d = torch.stack([fx * x + cx, fy * y + cy], dim=-1)

    limit_x = FOV_MARGIN * torch.maximum(cx, cameras.width - cx) / fx
    limit_y = FOV_MARGIN * torch.maximum(cy, cameras.height - cy) / fy
    x = torch.maximum(torch.minimum(x, limit_x), -limit_x)
    y = torch.maximum(torch.minimum(y, limit_y), -limit_y)
    zero = torch.zeros_like(z)
    J = torch.stack([fx / z, zero, -fx * x / z, zero, fy / z, -fy * y / z], dim=-1).unflatten(-1, (2, 3))
    M = J @ (R[:, None] @ gaussians.axes[None])  # [C, N, 2, 3]; Sigma' = M M^T
    footprint = footprint_px2(gaussians, cameras)[:, None]
    xx = (M[..., 0, :] ** 2).sum(-1) + footprint
    xy = (M[..., 0, :] * M[..., 1, :]).sum(-1)
    yy = (M[..., 1, :] ** 2).sum(-1) + footprint
    # the determinant of M Mᵀ as a square, and that of the widened covariance as a sum: nothing cancels
    narrow = torch.linalg.cross(M[..., 0, :], M[..., 1, :]).square().sum(-1)
    determinant = narrow + footprint * (xx + yy - footprint)
    drawn = drawn & torch.isfinite(determinant) & (determinant > 0)
    determinant = torch.where(drawn, determinant, torch.ones_like(determinant))
    conics = torch.stack([yy, -xy, xx], dim=-1) / determinant[..., None]
    conics = torch.where(drawn[..., None], conics, torch.zeros_like(conics))
    tall = torch.where(drawn, yy, torch.ones_like(yy))
    root = (tall / determinant).sqrt()
    factors = torch.stack([root, -xy / tall * root, tall.rsqrt()], dim=-1)
    factors = torch.where(drawn[..., None], factors, torch.zeros_like(factors))
    shares = torch.ones_like(z)
    if lowers_peak(gaussians):  # the root has no derivative at 0
        shares = (torch.where(narrow > 0, narrow, 1) / determinant).sqrt()
        drawn = drawn & (narrow > 0) & (shares >= MIN_PEAK_SHARE)
    with torch.no_grad():
        middle = (xx + yy) / 2
        largest_eigenvalue = middle + (middle**2 - determinant).clamp(min=0.1).sqrt()
        radii = torch.where(drawn, RADIUS_SIGMAS * largest_eigenvalue.sqrt(), 0.0).ceil()
    depths = torch.where(drawn, z, torch.zeros_like(z))
    return Projected(means2d, conics, factors, shares, depths, radii)


def with_zeros_for_invalid(gaussians: Gaussians) -> tuple[Gaussians, Tensor]:
    """Return the Gaussians, all zeros in place of those that hold NaN or infinity, and which [N] are finite."""
    numbers = (gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, gaussians.sh)
    finite = torch.stack(
        [torch.isfinite(t).reshape(len(t), t.shape[1:].numel()).all(dim=1) for t in numbers]
    ).all(dim=0)
    tensors = {
        name: torch.where(finite.reshape(-1, *[1] * (t.ndim - 1)), t, torch.zeros_like(t))
        for name, t in gaussians.tensors().items()
    }
    return dataclasses.replace(gaussians, **tensors), finite
