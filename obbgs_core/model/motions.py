"""Rigid motions as six numbers: a rotation vector (rad) and a shift (m), both at once, in front of a pose [4, 4].

They are the exponential coordinates of the motion (Barfoot and Furgale 2014). A turn about a far point stays a turn
about that point at any angle, and the motion that undoes another has its numbers with the other sign; a rotation that
is followed by a shift would have neither.
"""

import torch
from torch import Tensor

SMALLEST_TURN_RAD = 1e-9  # a rotation vector below has the skew part of its matrix for it
SERIES_BELOW_RAD = 1e-2  # of angle: the series of `motion_vectors` errs by less than 1e-11 there


def rigid_motions(xi: Tensor) -> Tensor:
    """Return the motions [B, 4, 4] of rotation vectors (rad) and shifts (m) [B, 6], at any angle."""
    unit = (
        xi[:, 3:].detach().norm(dim=1)[:, None, None].clamp(min=1)
    )  # so that rounding follows the angle alone
    generator = torch.zeros(len(xi), 4, 4, dtype=xi.dtype)
    generator[:, :3, :3] = cross_matrices(xi[:, :3])
    generator[:, :3, 3:] = xi[:, 3:, None] / unit
    motion = torch.matrix_exp(generator)
    return torch.cat(
        [motion[:, :, :3], torch.cat([unit * motion[:, :3, 3:], motion[:, 3:, 3:]], dim=1)], dim=2
    )


def motion_vectors(motions: Tensor) -> Tensor:
    """Return the rotation vectors and shifts [B, 6] of rigid motions [B, 4, 4] that turn by less than half a turn."""
    R = motions[:, :3, :3]
    skew = (R - R.mT) / 2
    axis = torch.stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]], dim=1)  # sin a times the unit axis
    sine = axis.norm(dim=1, keepdim=True)
    cosine = (R.diagonal(dim1=1, dim2=2).sum(1, keepdim=True) - 1) / 2
    angle = torch.atan2(sine, cosine)
    turn = torch.where(sine > SMALLEST_TURN_RAD, axis * angle / sine.clamp(min=SMALLEST_TURN_RAD), axis)
    half = angle / 2
    series, safe = 1 / 12 + angle.square() / 720, half.clamp(min=SERIES_BELOW_RAD / 2)
    second = torch.where(angle < SERIES_BELOW_RAD, series, (1 - safe / safe.tan()) / (2 * safe) ** 2)
    cross, place = cross_matrices(turn), motions[:, :3, 3:]
    shift = place - cross @ place / 2 + second[..., None] * cross @ cross @ place
    return torch.cat([turn, shift[..., 0]], dim=1)


def adjoints(poses: Tensor) -> Tensor:
    """Return [B, 6, 6] that take a small motion of the body to the same one in front of poses [B, 4, 4].

    A rotation w and a shift v, body axes, are the rotation R w and the shift R v + t x (R w) in the camera's.
    """
    R, t = poses[:, :3, :3], poses[:, :3, 3]
    found = torch.zeros(len(poses), 6, 6, dtype=poses.dtype)
    found[:, :3, :3] = R
    found[:, 3:, 3:] = R
    found[:, 3:, :3] = cross_matrices(t) @ R
    return found


def point_flow(points: Tensor, K: Tensor) -> Tensor:
    """Return how the pixels of points [n, 3] m, camera axes, move [n, 2, 6] px with a motion; K [n, 3, 3]."""
    x, y, z = points[:, 0] / points[:, 2], points[:, 1] / points[:, 2], points[:, 2]
    zero = torch.zeros_like(x)
    along_x = torch.stack([-x * y, 1 + x * x, -y, 1 / z, zero, -x / z], dim=-1)
    along_y = torch.stack([-1 - y * y, x * y, x, zero, 1 / z, -y / z], dim=-1)
    return K[:, [0, 1], [0, 1], None] * torch.stack([along_x, along_y], dim=1)


def cross_matrices(v: Tensor) -> Tensor:
    """Return [..., 3, 3] with cross(v) @ x = v x x."""
    x, y, z = v.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).unflatten(-1, (3, 3))
