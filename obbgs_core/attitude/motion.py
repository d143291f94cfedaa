"""The free rotation of a rigid body, with few parameters: from an angular velocity and an inertia to attitudes.

The body axes are defined as the inertial axes at the reference epoch, time 0, so that the attitude at that epoch is
the identity and no parameter. A steady spin has three parameters, the angular velocity at the epoch (rad/s). A
torque-free tumble has five more: the logarithm of the second moments of the body's mass, a symmetric matrix without
trace, as only ratios of moments show in the motion. Any such matrix belongs to a body that can exist.
"""

from dataclasses import dataclass

import numpy as np

from obbgs_base.physics.free_rotation import free_rotation, rotations

SPIN, TUMBLE = 3, 8  # numbers of parameters
# an orthonormal basis [5, 3, 3] of the symmetric matrices without trace
_SHAPES = np.zeros((5, 3, 3))
_SHAPES[0] = np.diag([1.0, -1.0, 0.0]) / np.sqrt(2)
_SHAPES[1] = np.diag([1.0, 1.0, -2.0]) / np.sqrt(6)
for _index, (_i, _j) in enumerate(((0, 1), (0, 2), (1, 2)), start=2):
    _SHAPES[_index, _i, _j] = _SHAPES[_index, _j, _i] = 1 / np.sqrt(2)


@dataclass(frozen=True)
class Principal:
    """Principal moments [3], the largest 1, in rising order, and their axes, the columns of [3, 3], body frame."""

    moments: np.ndarray
    axes: np.ndarray


def inertia(parameters: np.ndarray) -> np.ndarray:
    """Return inertia matrices [..., 3, 3], of trace 1, of parameters [..., 8]; of a spin [..., 3] that of a ball."""
    if parameters.shape[-1] == SPIN:
        return np.broadcast_to(np.eye(3) / 3, (*parameters.shape[:-1], 3, 3)).copy()
    values, axes = np.linalg.eigh(np.einsum("...k,kij->...ij", parameters[..., SPIN:], _SHAPES))
    mass = np.exp(values - values.max(axis=-1, keepdims=True))
    mass /= 2 * mass.sum(axis=-1, keepdims=True)
    moments = mass.sum(axis=-1, keepdims=True) - mass
    return np.einsum("...ik,...k,...jk->...ij", axes, moments, axes)


def principal(parameters: np.ndarray) -> Principal:
    """Return the principal moments and axes of parameters [8]."""
    moments, axes = np.linalg.eigh(inertia(parameters))
    return Principal(moments / moments[2], axes * np.sign(np.linalg.det(axes)))


def of_principal(rate_rad_s: np.ndarray, moments: np.ndarray, axes: np.ndarray) -> np.ndarray:
    """Return the parameters [8] of a rate and of principal moments [3] about axes, the columns of [3, 3], body frame.

    Moments of which one exceeds the sum of the others, as no body has them, are taken for the nearest that can be.
    """
    mass = np.maximum(moments.sum() / 2 - moments, 1e-3 * moments.sum())
    logarithm = axes @ np.diag(np.log(mass) - np.log(mass).mean()) @ axes.T
    return np.concatenate([rate_rad_s, np.einsum("kij,ij->k", _SHAPES, logarithm)])


def attitudes(parameters: np.ndarray, times_s: np.ndarray) -> np.ndarray:
    """Return how motions [B, 3 or 8] have turned at times [N] from the epoch: inertial to body axes [B, N, 3, 3]."""
    if parameters.shape[-1] == SPIN:
        return rotations(-parameters[:, None, :] * times_s[None, :, None])
    moments, axes = np.linalg.eigh(inertia(parameters))
    axes = axes * np.sign(np.linalg.det(axes))[:, None, None]
    turned, _ = free_rotation(times_s, np.einsum("bji,bj->bi", axes, parameters[:, :SPIN]), moments)
    return axes[:, None] @ turned @ axes[:, None].swapaxes(-1, -2)


def at_epoch(parameters: np.ndarray, epoch_s: float) -> np.ndarray:
    """Return the parameters [3 or 8] of the same motion for a reference epoch `epoch_s` later, or earlier if negative.

    The body axes become the inertial axes at the new epoch; the angular momentum stands still in inertial axes.
    """
    if len(parameters) == SPIN:
        return parameters.copy()
    body = attitudes(parameters[None], np.array([epoch_s]))[0, 0]
    moments = inertia(parameters)
    rate = np.linalg.solve(body.T @ moments @ body, moments @ parameters[:SPIN])
    return np.concatenate([rate, turned(parameters, body.T)[SPIN:]])


def turned(parameters: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """Return the parameters [3 or 8] of a motion after target and motion are turned by a rotation [3, 3]."""
    shape = np.einsum("k,kij->ij", parameters[SPIN:], _SHAPES[: len(parameters) - SPIN])
    coefficients = np.einsum("kij,ij->k", _SHAPES, rotation @ shape @ rotation.T)
    return np.concatenate([rotation @ parameters[:SPIN], coefficients[: len(parameters) - SPIN]])
