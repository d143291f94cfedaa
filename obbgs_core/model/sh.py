"""Spherical harmonics up to degree 3, and the radiance they stand for."""

import math

import torch
import torch.nn.functional as F
from torch import Tensor

C0 = 0.28209479177387814
FIT_DIRECTIONS = 64  # four for each coefficient of degree 3
SOFTNESS = 10.0  # softplus(x, beta=10) differs from max(x, 0) by at most 0.07, at zero


def radiance(sh: Tensor, directions: Tensor) -> Tensor:
    """Return scene-linear radiance [N, C] seen along unit directions [N, 3] (camera to Gaussian).

    Unbounded above, softly bounded by 0 below, so that a dark Gaussian keeps a gradient.

    Args:
        sh: [N, K, C] with K = 1, 4, 9 or 16.
    """
    basis = sh_basis(directions, sh.shape[1])
    return softplus((basis[:, :, None] * sh).sum(dim=1))


def softplus(x: Tensor) -> Tensor:
    """Return max(x, 0), softly."""
    return F.softplus(x, beta=SOFTNESS)


def from_radiance(value: Tensor) -> Tensor:
    """Return the degree-0 coefficient whose radiance is `value` (at least 1e-4)."""
    value = value.clamp(min=1e-4)
    return (value + torch.log(-torch.expm1(-SOFTNESS * value)) / SOFTNESS) / C0


def fit(count: int) -> tuple[Tensor, Tensor]:
    """Return directions [D, 3] spread over the sphere, and the matrix [K, D] from values there to coefficients."""
    if count == 1:
        return torch.tensor([[0.0, 0.0, 1.0]]), torch.tensor([[1 / C0]])
    i = torch.arange(FIT_DIRECTIONS, dtype=torch.float64)
    z = 1 - (2 * i + 1) / FIT_DIRECTIONS
    angle = math.pi * (1 + math.sqrt(5)) * i  # a Fibonacci lattice
    reach = (1 - z * z).sqrt()
    directions = torch.stack([reach * angle.cos(), reach * angle.sin(), z], dim=1)
    return directions.float(), torch.linalg.pinv(sh_basis(directions, count)).float()


def sh_basis(d: Tensor, count: int) -> Tensor:
    """Return the first `count` real spherical harmonics [N, count] at unit directions [N, 3], in 3DGS order and signs.

    Raises:
        ValueError: count is not 1, 4, 9 or 16.
    """
    if count not in (1, 4, 9, 16):
        raise ValueError(f"expected 1, 4, 9 or 16 coefficients, got {count}")
    x, y, z = d.unbind(-1)
    basis = [torch.full_like(x, C0)]
    if count > 1:
        c1 = 0.4886025119029199
        basis += [-c1 * y, c1 * z, -c1 * x]
    if count > 4:
        basis += [
            1.0925484305920792 * x * y,
            -1.0925484305920792 * y * z,
            0.31539156525252005 * (2 * z * z - x * x - y * y),
            -1.0925484305920792 * x * z,
            0.5462742152960396 * (x * x - y * y),
        ]
    if count > 9:
        basis += [
            -0.5900435899266435 * y * (3 * x * x - y * y),
            2.890611442640554 * x * y * z,
            -0.4570457994644658 * y * (4 * z * z - x * x - y * y),
            0.3731763325901154 * z * (2 * z * z - 3 * x * x - 3 * y * y),
            -0.4570457994644658 * x * (4 * z * z - x * x - y * y),
            1.445305721320277 * z * (x * x - y * y),
            -0.5900435899266435 * x * (x * x - 3 * y * y),
        ]
    return torch.stack(basis, dim=-1)
