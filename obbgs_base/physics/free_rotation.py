"""The rotation of a rigid body on which no torque acts, and what the attitudes of some frames say of it."""

from dataclasses import dataclass

import numpy as np

STEADY = 1e-14  # torque over twice the energy up to which the rates do not change
# of the functions' parameter: a body this near its middle axis stays there for 35 rad
LEAST_COMPLEMENT = 1e-30
MEAN_ROUNDS = 10  # of the arithmetic-geometric mean, which doubles its digits in each
SAMPLES = 256  # in a period of the speed of precession


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
    rates = neighbour_rates(times, to_body)
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


def neighbour_rates(times_s: np.ndarray, to_body: np.ndarray) -> np.ndarray:
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

    Euler's equations without torque, in closed form: the rates are Jacobi's elliptic functions of time, and the body
    turns about the constant angular momentum at a speed that has their period, whose Fourier series is integrated. How
    long the body turns does not matter for the time that this takes.

    Args:
        rate_rad_s: [P, 3] at time 0, body axes.
        inertia: [P, 3] moments about the body axes; only ratios matter.

    Raises:
        ValueError: a moment is not positive.

    Source: Landau and Lifshitz, Mechanics, 1976, paragraph 37.
    """
    if not (inertia > 0).all():
        raise ValueError(
            f"expected positive moments of inertia, got {inertia.min():g}; inertia_ratios must be above -1"
        )
    turned = rotations(-rate_rad_s[:, None] * times_s[:, None])
    rates = np.repeat(rate_rad_s[:, None], len(times_s), axis=1)
    torque = np.linalg.norm(np.cross(inertia * rate_rad_s, rate_rad_s), axis=1)
    tumbles = torque > STEADY * (inertia * rate_rad_s**2).sum(axis=1)
    if tumbles.any():
        turned[tumbles], rates[tumbles] = _tumbling(times_s, rate_rad_s[tumbles], inertia[tumbles])
    return turned, rates


def stepped_rotation(
    times_s: np.ndarray, rate_rad_s: np.ndarray, inertia: np.ndarray, rate_steps: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the same as `free_rotation`, of bodies whose rates change at some times by what torques bring about.

    Args:
        rate_steps: [K, 4] times above 0 in order, s, and the changes of the rates then, rad/s, body axes.

    Raises:
        ValueError: a moment is not positive.
    """
    turned = np.empty((len(rate_rad_s), len(times_s), 3, 3))
    rates = np.empty(turned.shape[:3])
    so_far, begun_s = np.eye(3)[None, None], 0.0
    leg = np.searchsorted(rate_steps[:, 0], times_s, side="right")
    for k in range(len(rate_steps) + 1):
        here = np.flatnonzero(leg == k)
        ends_s = rate_steps[k : k + 1, 0]
        turns, at = free_rotation(np.append(times_s[here], ends_s) - begun_s, rate_rad_s, inertia)
        turns = turns @ so_far
        turned[:, here], rates[:, here] = turns[:, : len(here)], at[:, : len(here)]
        if len(ends_s):
            so_far, begun_s = turns[:, -1:], ends_s[0]
            rate_rad_s = at[:, -1] + rate_steps[k, 1:]
    return turned, rates


def _tumbling(
    times_s: np.ndarray, rate_rad_s: np.ndarray, inertia: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return turns and rates as `free_rotation`, of bodies whose rates change. Shapes are [P, 1] and [P, N]."""
    # Axes in the order of their moments a, b, c, rising or falling: so that the rate about the last keeps its sign.
    order = np.argsort(inertia, axis=1)
    excess = _excess(rate_rad_s, inertia, order)[0][:, 0]
    order[excess < 0] = order[excess < 0, ::-1]
    excess, (a, b, c), (p, q, r) = _excess(rate_rad_s, inertia, order)
    first2 = a * p**2 + b * (c - b) / (c - a) * q**2  # (2 E c - L²) / (c - a), E the energy, L the momentum
    last2 = c * r**2 + b * (b - a) / (c - a) * q**2  # (L² - 2 E a) / (c - a)
    largest = np.sqrt(first2 / a), np.sqrt(first2 / b * (c - a) / (c - b)), np.sqrt(last2 / c)
    left_handed = (order[:, 1:2] - order[:, :1]) % 3 == 2
    way = np.where(left_handed, -1, 1) * np.sign((c - a) * r)
    speed = way * np.sqrt((c - b) * (c - a) / (a * b) * last2 / c)  # rad/s of the functions' argument
    means = _means(np.maximum(np.abs(excess / ((c - b) * last2)), LEAST_COMPLEMENT))
    half = np.pi / means[-1][0]  # period of the squares: twice the complete elliptic integral
    start = _argument(np.arctan2(q / largest[1], p / largest[0]), means)
    at = start + speed * times_s
    sine, cosine, slope = _jacobi(at, means)
    sorted_rates = np.stack([largest[0] * cosine, largest[1] * sine, np.sign(r) * largest[2] * slope], axis=2)
    rates = np.empty_like(sorted_rates)
    np.put_along_axis(rates, np.broadcast_to(order[:, None], rates.shape), sorted_rates, axis=2)

    # how fast a body axis turns about the angular momentum, over a period, and its integral by its Fourier series; of
    # the first axis and the last, that which stays farther away from the momentum
    sine, cosine, slope = _jacobi(half * np.arange(SAMPLES) / SAMPLES, means)
    parts = np.stack(
        [a * (largest[0] * cosine) ** 2, b * (largest[1] * sine) ** 2, c * (largest[2] * slope) ** 2]
    )
    squares = parts * np.stack([a, b, c])  # [3, P, samples] of the momentum about each axis
    is_last = (squares[:2].sum(axis=0).min(axis=1) > squares[1:].sum(axis=0).min(axis=1))[:, None]
    others = np.stack([is_last, np.ones_like(is_last), ~is_last])
    momentum = np.linalg.norm(inertia * rate_rad_s, axis=1, keepdims=True)
    speeds = momentum * (parts * others).sum(axis=0) / (squares * others).sum(axis=0)
    series = np.fft.rfft(speeds, axis=1).real[:, None, : SAMPLES // 2] / SAMPLES
    series[..., 1:] *= 2
    turns = (
        np.arange(SAMPLES // 2) * (speed * times_s / half)[..., None]
    )  # [P, N, harmonics] of each since time 0
    middle = np.arange(SAMPLES // 2) * ((start + at) / half)[..., None]  # twice their mean phase, in turns
    angle = times_s * (series * np.sinc(turns) * np.cos(np.pi * middle)).sum(axis=2)

    axis = np.eye(3)[np.where(is_last, order[:, 2:], order[:, :1])]
    about = np.zeros((*angle.shape, 3))
    about[..., 2] = -angle
    frames = _momentum_frames(inertia[:, None] * rates, axis)
    return frames @ rotations(about) @ _momentum_frames((inertia * rate_rad_s)[:, None], axis).swapaxes(
        2, 3
    ), rates


def _excess(
    rates: np.ndarray, inertia: np.ndarray, order: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return L² - 2 E b [P, 1], without cancellation, and the moments and rates [3, P, 1] in an order of the axes."""
    a, b, c = moments = np.take_along_axis(inertia, order, axis=1).T[..., None]
    p, _, r = ordered = np.take_along_axis(rates, order, axis=1).T[..., None]
    return a * (a - b) * p**2 + c * (c - b) * r**2, moments, ordered


def _momentum_frames(momentum: np.ndarray, axis: np.ndarray) -> np.ndarray:
    """Return [P, N, 3, 3], in body axes the columns: an axis across the momentum [P, N, 3], their cross product, it."""
    z = momentum / np.linalg.norm(momentum, axis=-1, keepdims=True)
    x = axis - (axis * z).sum(axis=-1, keepdims=True) * z
    x = x / np.linalg.norm(x, axis=-1, keepdims=True)
    return np.stack([x, np.cross(z, x), z], axis=-1)


def _means(complement: np.ndarray) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Return a, b and c of each round of the arithmetic-geometric mean of a complementary parameter 1 - m [P, 1].

    Source: Abramowitz and Stegun, Handbook of Mathematical Functions, 1964, 17.6.
    """
    a, b, c = np.ones_like(complement), np.sqrt(complement), np.sqrt(1 - complement.clip(max=1))
    rounds = [(a, b, c)]
    for _ in range(MEAN_ROUNDS):
        a, b, c = (a + b) / 2, np.sqrt(a * b), (a - b) / 2
        rounds.append((a, b, c))
    return rounds


def _argument(amplitude: np.ndarray, means: list[tuple[np.ndarray, np.ndarray, np.ndarray]]) -> np.ndarray:
    """Return the incomplete elliptic integral of the first kind of an amplitude (17.6.8)."""
    for a, b, _ in means[:-1]:
        whole = np.round(amplitude / np.pi) * np.pi
        amplitude = (
            amplitude + whole + np.arctan2(b * np.sin(amplitude - whole), a * np.cos(amplitude - whole))
        )
    return amplitude / (2**MEAN_ROUNDS * means[-1][0])


def _jacobi(
    argument: np.ndarray, means: list[tuple[np.ndarray, np.ndarray, np.ndarray]]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return Jacobi's elliptic functions sn, cn and dn [P, N] of arguments [P, N] (16.4)."""
    whole = 2 * np.pi / means[-1][0]  # their period
    amplitude = 2**MEAN_ROUNDS * means[-1][0] * (argument - np.round(argument / whole) * whole)
    for a, _, c in means[:0:-1]:
        amplitude = (amplitude + np.arcsin(c / a * np.sin(amplitude))) / 2
    sine, cosine = np.sin(amplitude), np.cos(amplitude)
    return sine, cosine, np.sqrt(cosine**2 + means[0][1] ** 2 * sine**2)


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
