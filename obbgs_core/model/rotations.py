"""Quaternions w, x, y, z and rotation matrices in torch; differentiable, batched."""

import torch
from torch import Tensor


def unit(quats: Tensor) -> Tensor:
    """Return quaternions [..., 4] scaled to length 1; a zero one becomes the identity."""
    length = quats.norm(dim=-1, keepdim=True)
    identity = torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=quats.dtype, device=quats.device)
    return torch.where(length > 1e-12, quats / length.clamp(min=1e-12), identity)


def quats_to_matrices(quats: Tensor) -> Tensor:
    """Return rotations [..., 3, 3] of quaternions [..., 4]; they need not be unit, a zero one gives the identity."""
    w, x, y, z = unit(quats).unbind(-1)
    rows = [
        1 - 2 * (y * y + z * z),
        2 * (x * y - w * z),
        2 * (x * z + w * y),
        2 * (x * y + w * z),
        1 - 2 * (x * x + z * z),
        2 * (y * z - w * x),
        2 * (x * z - w * y),
        2 * (y * z + w * x),
        1 - 2 * (x * x + y * y),
    ]
    return torch.stack(rows, dim=-1).reshape(*quats.shape[:-1], 3, 3)


def multiply(a: Tensor, b: Tensor) -> Tensor:
    """Return the Hamilton product [..., 4] of quaternions: first b, then a."""
    aw, ax, ay, az = a.unbind(-1)
    bw, bx, by, bz = b.unbind(-1)
    return torch.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        dim=-1,
    )


def from_rotation_vectors(vectors: Tensor) -> Tensor:
    """Return unit quaternions [..., 4] of rotation vectors [..., 3], rad."""
    half = vectors.norm(dim=-1, keepdim=True) / 2
    return torch.cat([half.cos(), 0.5 * vectors * torch.sinc(half / torch.pi)], dim=-1)
