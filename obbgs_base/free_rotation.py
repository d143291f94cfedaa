"""The rotation of a rigid body on which no torque acts, and what the attitudes of some frames say of it."""

from dataclasses import dataclass

import numpy as np

LARGEST_TURN_RAD = 0.06  # of a Runge-Kutta step: it errs by less than 1e-8 rad


@dataclass(frozen=True)
class Turning:
    """How a body turns through the attitudes of some frames.

    at_epoch: [3, 3] inertial_to_body at time 0; rates_rad_s: [N, 3] body axes; integral_s: [N, 3, 3] that of
    inertial_to_body from time 0 on. A constant change d of the rate, inertial axes, turns the body by integral · d
    about its own axes.
    """

    at_epoch: np.ndarray
    rates_rad_s: np.ndarray
    integral_s: np.ndarray


def turning_of(times_s: np.ndarray, inertial_to_body: np.ndarray) -> Turning:
    """Return how a body turns whose attitudes [N, 3, 3] are known at some times [N], s, in any order.

    The rate at a frame is that to its nearest neighbour in time; from it the attitude is continued half-way to the next
    frames, and to time 0.
    """
    order = np.argsort(times_s, kind="stable")
    times, to_body = times_s[order], inertial_to_body[order]
    rates = _neighbour_rates(times, to_body)
    # from time 0 to the first frame, then half of each interval by either of its ends
    first = _integrals(rates[:1], -times[:1]) @ to_body[:1]
    half_s = np.diff(times) / 2
    forward = _integrals(rates[:-1], half_s) @ to_body[:-1]
    backward = _integrals(rates[1:], -half_s) @ to_body[1:]
    sums = np.cumsum(np.concatenate([-first, forward - backward]), axis=0)
    found, unsorted = np.empty_like(sums), np.empty_like(rates)
    found[order], unsorted[order] = sums, rates
    return Turning(rotations(rates[0] * times[0]) @ to_body[0], unsorted, found)


def _integrals(rates: np.ndarray, spans_s: np.ndarray) -> np.ndarray:
    """Return the integrals [N, 3, 3] of the rotation by constant rates [N, 3], body axes, over spans [N], s."""
    vectors = rates * spans_s[:, None]
    angle = np.linalg.norm(vectors, axis=1)[:, None, None]
    cross = cross_matrices(vectors)
    versine = 0.5 * np.sinc(angle / (2 * np.pi)) ** 2  # (1 - cos a) / a²
    third = np.where(angle > 1e-3, (angle - np.sin(angle)) / np.maximum(angle, 1e-3) ** 3, 1 / 6)
    return spans_s[:, None, None] * (np.eye(3) - versine * cross + third * cross @ cross)


def _neighbour_rates(times_s: np.ndarray, to_body: np.ndarray) -> np.ndarray:
    """Return the rate [N, 3] rad/s, body axes, between each frame and its nearest neighbour, times in order."""
    spans_s = np.diff(times_s)
    turns = to_body[1:] @ to_body[:-1].swapaxes(-1, -2)
    skew = (turns.swapaxes(-1, -2) - turns) / 2
    axes = np.stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]], axis=1)
    sines = np.linalg.norm(axes, axis=1)
    angles = np.arctan2(sines, (np.trace(turns, axis1=1, axis2=2) - 1) / 2)
    scale = np.where(sines > 1e-9, angles / np.maximum(sines, 1e-9), 1.0)
    rates = np.where(spans_s[:, None] > 0, axes * (scale / np.maximum(spans_s, 1e-9))[:, None], 0.0)
    if len(rates) == 0:
        return np.zeros((len(times_s), 3))
    spans_s = np.where(spans_s > 0, spans_s, np.inf)  # two frames of one time say nothing
    next_is_nearer = np.append(spans_s, np.inf) <= np.append(np.inf, spans_s)
    return np.where(next_is_nearer[:, None], np.append(rates, rates[-1:], 0), np.append(rates[:1], rates, 0))


def free_rotation(
    times_s: np.ndarray, rate_rad_s: np.ndarray, inertia: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return how far P bodies have turned since time 0 [P, N, 3, 3] and their rates [P, N, 3] rad/s, body axes.

    Euler's equations without torque; a fourth-order Runge-Kutta method where the moments of inertia differ.

    Args:
        rate_rad_s: [P, 3] at time 0, body axes.
        inertia: [P, 3] moments about the body axes; only ratios matter.

    Raises:
        ValueError: a moment is not positive.
    """
    if not (inertia > 0).all():
        raise ValueError(
            f"expected positive moments of inertia, got {inertia.min():g}; inertia_ratios must be above -1"
        )
    if np.allclose(inertia, inertia[:, :1], rtol=1e-14, atol=0):  # no torque acts on the rates
        turned = rotations(-rate_rad_s[:, None] * times_s[:, None])
        return turned, np.broadcast_to(rate_rad_s[:, None], (*turned.shape[:2], 3))
    turned = np.empty((len(rate_rad_s), len(times_s), 3, 3))
    rates = np.empty((len(rate_rad_s), len(times_s), 3))
    order = np.argsort(times_s, kind="stable")
    later = times_s[order] >= 0
    for indices in (order[later], order[~later][::-1]):
        quats, now, at_s = np.tile([1.0, 0, 0, 0], (len(rate_rad_s), 1)), rate_rad_s, 0.0
        for index in indices:
            span_s = float(times_s[index] - at_s)
            steps = int(np.ceil(abs(span_s) * np.linalg.norm(now, axis=1).max() / LARGEST_TURN_RAD))
            for _ in range(steps):
                quats, now = _runge_kutta(quats, now, inertia, span_s / steps)
            at_s = float(times_s[index])
            turned[:, index], rates[:, index] = _from_quats(quats), now
    return turned, rates


def _runge_kutta(
    quats: np.ndarray, rates: np.ndarray, inertia: np.ndarray, step_s: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return body-to-start quaternions [P, 4] and rates [P, 3] a step later, by the fourth-order method."""

    def slopes(state: np.ndarray) -> np.ndarray:
        w, x, y, z, p, q, r = state.T
        a, b, c = inertia.T
        return np.stack(
            [
                0.5 * (-x * p - y * q - z * r),
                0.5 * (w * p + y * r - z * q),
                0.5 * (w * q + z * p - x * r),
                0.5 * (w * r + x * q - y * p),
                (b - c) / a * q * r,
                (c - a) / b * r * p,
                (a - b) / c * p * q,
            ],
            axis=1,
        )

    state = np.concatenate([quats, rates], axis=1)
    k1 = slopes(state)
    k2 = slopes(state + step_s / 2 * k1)
    k3 = slopes(state + step_s / 2 * k2)
    k4 = slopes(state + step_s * k3)
    state = state + step_s / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    quats = state[:, :4] / np.linalg.norm(state[:, :4], axis=1, keepdims=True)
    return quats, state[:, 4:]


def _from_quats(quats: np.ndarray) -> np.ndarray:
    """Return start-to-body rotations [P, 3, 3] of body-to-start quaternions [P, 4]."""
    w, cross = quats[:, :1, None], cross_matrices(quats[:, 1:])
    return (np.eye(3) + 2 * w * cross + 2 * cross @ cross).swapaxes(-1, -2)


def rotations(vectors: np.ndarray) -> np.ndarray:
    """Return the rotation matrices [..., 3, 3] of rotation vectors [..., 3], rad, at any angle (Rodrigues)."""
    angle = np.linalg.norm(vectors, axis=-1)[..., None, None]
    cross = cross_matrices(vectors)
    versine = 0.5 * np.sinc(angle / (2 * np.pi)) ** 2  # (1 - cos a) / a²
    return np.eye(3) + np.sinc(angle / np.pi) * cross + versine * cross @ cross


def cross_matrices(vectors: np.ndarray) -> np.ndarray:
    """Return [..., 3, 3] of vectors [..., 3], with cross @ x the cross product of vector and x."""
    x, y, z = np.moveaxis(vectors, -1, 0)
    zero = np.zeros_like(x)
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(*x.shape, 3, 3)
