"""Spherical harmonics up to degree 3, and the radiance that their coefficients describe."""

import math

import torch
import torch.nn.functional as F
from torch import Tensor

# Normalisation of the real spherical harmonics, named after the first monomial that they stand before.
C0 = 0.28209479177387814
C1 = 0.4886025119029199
C2_XY, C2_ZZ, C2_XX_YY = 1.0925484305920792, 0.31539156525252005, 0.5462742152960396
C3_YXX, C3_XYZ, C3_YZZ = 0.5900435899266435, 2.890611442640554, 0.4570457994644658
C3_ZZZ, C3_ZXX = 0.3731763325901154, 1.445305721320277
FIT_DIRECTIONS = 64  # four times as many as the coefficients up to degree 3
SOFTNESS = 10.0  # softplus(x, beta=10) differs from max(x, 0) by at most 0.07, at zero


def radiance(sh: Tensor, directions: Tensor) -> Tensor:
    """Return scene-linear radiance [N, C] along unit directions [N, 3] (camera to Gaussian).

    The softplus keeps it above 0 and leaves dark Gaussians a gradient; there is no upper bound.

    Args:
        sh: [N, K, C] with K = 1, 4, 9 or 16.
    """
    basis = sh_basis(directions, sh.shape[1])
    return softplus((basis[:, :, None] * sh).sum(dim=1))


def softplus(x: Tensor) -> Tensor:
    """Return a smooth max(x, 0)."""
    return F.softplus(x, beta=SOFTNESS)


def from_radiance(value: Tensor) -> Tensor:
    """Return the coefficient of degree 0 whose radiance is `value`, or 1e-4 where that is less."""
    value = value.clamp(min=1e-4)
    return (value + torch.log(-torch.expm1(-SOFTNESS * value)) / SOFTNESS) / C0


def fit(count: int) -> tuple[Tensor, Tensor]:
    """Return directions [D, 3] spread over the sphere, and the matrix [K, D] of a least-squares fit to values there."""
    if count == 1:
        return torch.tensor([[0.0, 0.0, 1.0]]), torch.tensor([[1 / C0]])
    i = torch.arange(FIT_DIRECTIONS, dtype=torch.float64)
    z = 1 - (2 * i + 1) / FIT_DIRECTIONS
    angle = math.pi * (1 + math.sqrt(5)) * i  # Fibonacci lattice
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
        basis += [-C1 * y, C1 * z, -C1 * x]
    if count > 4:
        basis += [
            C2_XY * x * y,
            -C2_XY * y * z,
            C2_ZZ * (2 * z * z - x * x - y * y),
            -C2_XY * x * z,
            C2_XX_YY * (x * x - y * y),
        ]
    if count > 9:
        basis += [
            -C3_YXX * y * (3 * x * x - y * y),
            C3_XYZ * x * y * z,
            -C3_YZZ * y * (4 * z * z - x * x - y * y),
            C3_ZZZ * z * (2 * z * z - 3 * x * x - 3 * y * y),
            -C3_YZZ * x * (4 * z * z - x * x - y * y),
            C3_ZXX * z * (x * x - y * y),
            -C3_YXX * x * (x * x - 3 * y * y),
        ]
    return torch.stack(basis, dim=-1)
