"""Which torque-free rotation known attitudes of a body are those of."""

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from obbgs_base.physics.free_rotation import free_rotation, neighbour_rates, rotations

FIRST, GROWTH = 6, 3  # frames that are fitted first, and how many times as many in each further round
STEPS = np.array(
    [1e-6] * 3 + [1e-8] * 3 + [1e-5] * 2
)  # of the differences: rad, rad/s, logarithms of moments
SCALES = np.array([1e-2] * 3 + [1e-3] * 3 + [1e-1] * 2)  # of the search, in the same units
SPIN, TUMBLE = 6, 8  # numbers of parameters
WIDEST = 3.0  # logarithm of a moment over another, at most


def fitted_rotation(
    times_s: np.ndarray, inertial_to_body: np.ndarray, within_rad: float
) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the rate [3] at time 0, rad/s, body axes, and the moments of inertia [3] of a body that turns freely.

    The rotation is fitted to attitudes [N, 3, 3] at times [N], s, in any order: a spin about an axis that stands still,
    and where that does not fit, a tumble about principal axes that are the body's. Neighbours in time must be less
    than half a turn apart near the first frame; elsewhere the motion so far says how many turns a gap holds. None:
    there are fewer than six attitudes, or their root mean square distance from every such rotation is above
    `within_rad`: a torque acts, the axes are others, or the attitudes err.
    """
    order = np.argsort(times_s, kind="stable")
    times, to_body = times_s[order], inertial_to_body[order]
    if len(times) < FIRST:
        return None
    start = np.concatenate([np.zeros(3), neighbour_rates(times, to_body)[0]])
    for size in (SPIN, TUMBLE):
        found = np.concatenate([start, np.zeros(size - SPIN)])
        count = FIRST
        while True:
            found, left_rad = _fit(times[:count], to_body[:count], found)
            if left_rad > within_rad or count == len(times):
                break
            count = min(GROWTH * count, len(times))
        if left_rad <= within_rad:
            rate, inertia = found[3:6], _inertia(found[None])
            return free_rotation(-times[:1], rate[None], inertia)[1][0, 0], inertia[0]
    return None


def _fit(times_s: np.ndarray, to_body: np.ndarray, start: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the parameters of the rotation from the first frame on that fits best, and what is left, rad."""
    size = len(start)

    def distances(parameters: np.ndarray) -> np.ndarray:
        """Return the rotation vectors [P, 3 N] from the attitudes of P rotations to those known."""
        rates, inertia = parameters[:, 3:6], _inertia(parameters)
        turned, _ = free_rotation(times_s - times_s[0], rates, inertia)
        at = turned @ (rotations(parameters[:, :3]) @ to_body[0])[:, None]
        apart = to_body.swapaxes(-1, -2) @ at
        return Rotation.from_matrix(apart.reshape(-1, 3, 3)).as_rotvec().reshape(len(parameters), -1)

    def slopes(parameters: np.ndarray) -> np.ndarray:
        steps = np.diag(STEPS[:size])
        sides = distances(np.concatenate([parameters + steps, parameters - steps]))
        return ((sides[:size] - sides[size:]) / (2 * STEPS[:size, None])).T

    def left(parameters: np.ndarray) -> np.ndarray:
        return distances(parameters[None])[0]

    bounds = np.array([np.inf] * SPIN + [WIDEST] * (size - SPIN))
    solution = least_squares(left, start, slopes, bounds=(-bounds, bounds), x_scale=SCALES[:size])  # pyright: ignore
    return solution.x, float(np.sqrt(3 * np.mean(np.square(solution.fun))))


def _inertia(parameters: np.ndarray) -> np.ndarray:
    """Return the moments [P, 3] of parameters [P, 6 or 8]."""
    moments = np.ones((len(parameters), 3))
    moments[:, : parameters.shape[1] - SPIN] = np.exp(parameters[:, SPIN:])
    return moments
