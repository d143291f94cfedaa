"""Which rotation known attitudes of a body are those of: a torque-free one, or pieces of it where torques act."""

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from obbgs_base.physics.free_rotation import free_rotation, neighbour_rates, rotations

FIRST, GROWTH = 6, 3  # attitudes that are fitted first, and how many times as many in each further round
LAST = 48  # are fitted in the last round; more say no more of a rotation that is free
CLOSE = 0.25  # of the mean time between attitudes: of those that are closer, one is fitted where torques act
STEPS = np.array(
    [1e-6] * 3 + [1e-8] * 3 + [1e-5] * 2
)  # of the differences: rad, rad/s, logarithms of moments
SCALES = np.array([1e-2] * 3 + [1e-3] * 3 + [1e-1] * 2)  # of the search, in the same units
SPIN, TUMBLE = 6, 8  # numbers of parameters
EQUAL = np.ones(3)  # moments of inertia
WIDEST = 3.0  # logarithm of a moment over another, at most


def fitted_rotation(
    times_s: np.ndarray, inertial_to_body: np.ndarray, within_rad: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """Return the rate [3] at time 0, rad/s, body axes, a body's moments of inertia [3], and steps of its rate [K, 4].

    The rotation is fitted to attitudes [N, 3, 3] at times [N], s, in any order: a spin about an axis that stands still,
    and where that does not fit, a tumble about principal axes that are the body's. Neighbours in time must be less
    than half a turn apart near the first frame; elsewhere the motion so far says how many turns a gap holds. Where a
    torque acts, rotations by the same moments fit six attitudes each, and the rate changes from one to the next; the
    steps are those of `stepped_rotation`. None: there are fewer than six attitudes, or their root mean square distance
    from every such rotation is above `within_rad`: the torque is large, the axes are others, or the attitudes err.
    """
    order = np.argsort(times_s, kind="stable")
    times, to_body = times_s[order], inertial_to_body[order]
    if len(times) < FIRST:
        return None
    return _as_one(times, to_body, within_rad) or _in_pieces(times, to_body, within_rad)


def _as_one(
    times_s: np.ndarray, to_body: np.ndarray, within_rad: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """Return rate, moments and no steps of the one rotation that fits all attitudes."""
    start = np.concatenate([np.zeros(3), neighbour_rates(times_s, to_body)[0]])
    last = min(len(times_s), LAST)
    for size in (SPIN, TUMBLE):
        found = np.concatenate([start, np.zeros(size - SPIN)])
        count = FIRST
        while True:
            found, left_rad = _fit(times_s[:count], to_body[:count], found, EQUAL)
            if left_rad > within_rad or count == last:
                break
            count = min(GROWTH * count, last)
        if left_rad <= within_rad and _rms(_distances(times_s, to_body, found[None], EQUAL)) <= within_rad:
            inertia = _inertia(found[None], EQUAL)[0]
            return _rates(-times_s[:1], found, EQUAL)[0], inertia, np.zeros((0, 4))
    return None


def _in_pieces(
    times_s: np.ndarray, to_body: np.ndarray, within_rad: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """Return rate, moments and steps of rotations of six attitudes each; the last of one is the first of the next."""
    apart_s = CLOSE * (times_s[-1] - times_s[0]) / (len(times_s) - 1)
    kept = [0]
    for i in range(1, len(times_s)):
        if times_s[i] - times_s[kept[-1]] > apart_s:
            kept.append(i)
    times, attitudes = times_s[kept], to_body[kept]
    if len(kept) < FIRST or times[0] < 0:
        return None
    start = np.concatenate([np.zeros(3), neighbour_rates(times, attitudes)[0]])
    inertia, legs = EQUAL, _legs(times, attitudes, start, EQUAL, within_rad)
    if legs is None:
        free = _legs(times, attitudes, np.append(start, [0.0, 0.0]), EQUAL, within_rad)
        if free is None:
            return None
        found, _ = free
        inertia = _inertia(np.median(found, axis=0)[None], EQUAL)[0]
        legs = _legs(times, attitudes, found[0, :SPIN], inertia, within_rad)
        if legs is None:
            return None
    found, starts = legs
    begins_s = times[: len(kept) - FIRST + 1 : FIRST - 1]
    steps = np.column_stack([begins_s, (found - starts)[:, 3:6]])[1:]
    return _rates(-times[:1], found[0], inertia)[0], inertia, steps


def _legs(
    times_s: np.ndarray, to_body: np.ndarray, start: np.ndarray, moments: np.ndarray, within_rad: float
) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the parameters [K, 6 or 8] of the rotations that fit six attitudes each; None where one does not fit.

    Beside them are those [K, 6 or 8] that the rotation before says, with which each search begins.
    """
    legs, starts = [], []
    for first in range(0, len(times_s) - FIRST + 1, FIRST - 1):
        here = slice(first, first + FIRST)
        found, left_rad = _fit(times_s[here], to_body[here], start, moments)
        if left_rad > within_rad:
            return None
        legs.append(found)
        starts.append(start)
        leg_s = times_s[here][-1:] - times_s[first]
        start = np.concatenate([np.zeros(3), _rates(leg_s, found, moments)[0], found[SPIN:]])
    return np.array(legs), np.array(starts)


def _rates(spans_s: np.ndarray, found: np.ndarray, moments: np.ndarray) -> np.ndarray:
    """Return the rates [N, 3] of a rotation after so long [N]."""
    return free_rotation(spans_s, found[None, 3:6], _inertia(found[None], moments))[1][0]


def _fit(
    times_s: np.ndarray, to_body: np.ndarray, start: np.ndarray, moments: np.ndarray
) -> tuple[np.ndarray, float]:
    """Return the parameters of the rotation from the first frame on that fits best, and what is left, rad."""
    size = len(start)

    def slopes(parameters: np.ndarray) -> np.ndarray:
        steps = np.diag(STEPS[:size])
        sides = _distances(
            times_s, to_body, np.concatenate([parameters + steps, parameters - steps]), moments
        )
        return ((sides[:size] - sides[size:]) / (2 * STEPS[:size, None])).T

    def left(parameters: np.ndarray) -> np.ndarray:
        return _distances(times_s, to_body, parameters[None], moments)[0]

    bounds = np.array([np.inf] * SPIN + [WIDEST] * (size - SPIN))
    solution = least_squares(left, start, slopes, bounds=(-bounds, bounds), x_scale=SCALES[:size])  # pyright: ignore
    return solution.x, _rms(solution.fun)


def _distances(
    times_s: np.ndarray, to_body: np.ndarray, parameters: np.ndarray, moments: np.ndarray
) -> np.ndarray:
    """Return the rotation vectors [P, 3 N] from the attitudes of P rotations to those known."""
    turned, _ = free_rotation(times_s - times_s[0], parameters[:, 3:6], _inertia(parameters, moments))
    at = turned @ (rotations(parameters[:, :3]) @ to_body[0])[:, None]
    apart = to_body.swapaxes(-1, -2) @ at
    return Rotation.from_matrix(apart.reshape(-1, 3, 3)).as_rotvec().reshape(len(parameters), -1)


def _rms(vectors: np.ndarray) -> float:
    """Return the root mean square length of vectors whose components follow each other."""
    return float(np.sqrt(3 * np.mean(np.square(vectors))))


def _inertia(parameters: np.ndarray, moments: np.ndarray) -> np.ndarray:
    """Return the moments [P, 3] of parameters [P, 6 or 8], which change given ones [3]."""
    changed = np.repeat(moments[None], len(parameters), axis=0)
    changed[:, : parameters.shape[1] - SPIN] *= np.exp(parameters[:, SPIN:])
    return changed
