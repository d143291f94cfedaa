"""How a target rotates, as it was found: attitudes, figures for people, and what a training needs to refine it."""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from obbgs_base.physics.free_rotation import rotations
from obbgs_base.physics.navigation_errors import SIZE, SharedParameters
from obbgs_core.attitude.motion import (
    SPIN,
    TUMBLE,
    at_epoch,
    attitudes,
    inertia,
    of_principal,
    principal,
)
from obbgs_core.poses.estimate import PoseEstimate

ROTATIONAL = slice(6, 6 + TUMBLE)  # attitude, rate and inertia ratios among the shared parameters
# deviations that a training leaves at least, as a share of those before it: it states them for a model without error
LEAST_LEFT = 0.4
OWN_AXES_RAD = 0.1  # how far a refinement may turn the principal axes where equal moments leave them open


@dataclass(frozen=True)
class TargetMotion:
    """How a target rotates, in its own axes.

    parameters: [3] of a steady spin or [8] of a tumble at time 0, in the inertial axes (`obbgs_core.attitude.motion`).
    covariance: of the parameters.
    epoch_to_body: [3, 3] rotation from the inertial axes at time 0 to the target's axes: of a spin, z is along the
        angular velocity; of a tumble they are the principal axes by rising moment.
    disagreement: of the outlines, as a share of what unrelated motions leave.
    views: number of outlines that were compared.
    """

    parameters: np.ndarray
    covariance: np.ndarray
    epoch_to_body: np.ndarray
    disagreement: float
    views: int

    @property
    def tumbles(self) -> bool:
        """Whether the angular velocity changes, as that of a torque-free body of unequal moments does."""
        return len(self.parameters) == TUMBLE

    def inertial_to_body(self, times_s: np.ndarray) -> np.ndarray:
        """Return the attitudes [N, 3, 3] at times from the epoch."""
        return self.epoch_to_body @ attitudes(self.parameters[None], times_s)[0]

    def summary(self) -> str:
        """Return the motion in a few words."""
        facts = self.facts()
        axis = ", ".join(f"{x:.3f}" for x in facts["axis_inertial"])
        share = facts["rate_sigma_deg_s"] / facts["rate_deg_s"]
        turning = f"{facts['kind']}, once in {facts['period_s']:.1f} s (± {share:.2%}) about ({axis})"
        return f"{turning} ± {facts['axis_sigma_deg']:.2f} degrees, from {self.views} outlines"

    def facts(self) -> dict:
        """Return spin axis, rate and inertia ratios with standard deviations, in degrees, for a report.

        The axis is that of the angular momentum, which stands still in inertial axes; of a spin it is the axis of
        rotation. The rate is that at time 0.
        """

        def derived(parameters: np.ndarray) -> np.ndarray:
            momentum = inertia(parameters) @ parameters[:SPIN]
            rate = np.degrees(parameters[:SPIN])
            ratios = principal(parameters).moments[:2] if self.tumbles else np.zeros(0)
            return np.concatenate([momentum / np.linalg.norm(momentum), [np.linalg.norm(rate)], rate, ratios])

        value = derived(self.parameters)
        sigma = np.sqrt(np.diag(_carried(derived, self.parameters, self.covariance)))
        return {
            "kind": "tumble" if self.tumbles else "spin",
            "axis_inertial": value[:3].round(6).tolist(),
            "axis_sigma_deg": float(np.degrees(np.linalg.norm(sigma[:3]))),
            "rate_deg_s": float(value[3]),
            "rate_sigma_deg_s": float(sigma[3]),
            "period_s": float(360 / value[3]),
            "rate_inertial_deg_s": value[4:7].tolist(),
            "rate_inertial_sigma_deg_s": sigma[4:7].tolist(),
            "inertia_ratios": value[7:].tolist(),
            "inertia_ratios_sigma": sigma[7:].tolist(),
            "outlines_compared": self.views,
            "disagreement": self.disagreement,
        }

    @property
    def rate_body_rad_s(self) -> np.ndarray:
        """The angular velocity [3] at time 0, target axes."""
        return self.epoch_to_body @ self.parameters[:SPIN]

    @property
    def moments(self) -> np.ndarray:
        """The moments of inertia [3] about the target's axes, the largest 1; equal ones of a spin."""
        return principal(self.parameters).moments if self.tumbles else np.ones(3)

    def at_epoch(self, epoch_s: float) -> "TargetMotion":
        """Return the same motion with time 0 at another time, s from the present time 0."""
        return dataclasses.replace(
            self,
            parameters=at_epoch(self.parameters, epoch_s),
            covariance=_carried(lambda p: at_epoch(p, epoch_s), self.parameters, self.covariance),
            epoch_to_body=self.inertial_to_body(np.array([epoch_s]))[0],
        )

    def sigmas(self) -> SharedParameters:
        """Return the standard deviations of attitude, rate and inertia ratios at time 0, target axes.

        A spin's attitude at time 0 is a definition of the axes, and so are principal axes of equal moments: those are
        held, so that the deviations do not grow without bound.
        """
        J = self._by_changes(np.zeros(TUMBLE))
        scale = np.sqrt(np.maximum(np.diag(self.covariance), 1e-300))
        correlation = self.covariance / np.outer(scale, scale) + 1e-9 * np.eye(len(scale))
        rows = J / scale[:, None]
        held = (
            np.concatenate([np.full(3, OWN_AXES_RAD**-2), np.zeros(len(rows) - 3)]) if self.tumbles else 0.0
        )
        information = rows.T @ np.linalg.solve(correlation, rows) + np.diag(np.broadcast_to(held, len(rows)))
        found = np.zeros(SIZE)
        found[ROTATIONAL][self._estimated] = np.sqrt(np.diag(np.linalg.inv(information)))
        return SharedParameters.of(found)

    def refined(self, estimate: PoseEstimate) -> "TargetMotion":
        """Return the motion as a training with `sigmas` for its prior refined it, which has its epoch at time 0.

        In no direction are its deviations less than `LEAST_LEFT` of those before.
        """
        at = estimate.shared.vector()[ROTATIONAL]
        prior = estimate.shared_prior.vector()[ROTATIONAL][self._estimated]
        rows = np.arange(SIZE)[ROTATIONAL][self._estimated]
        left = (1 - LEAST_LEFT**2) * estimate.shared_covariance[np.ix_(rows, rows)]
        left = left + LEAST_LEFT**2 * np.diag(prior**2)
        J = self._by_changes(at)
        return dataclasses.replace(
            self,
            parameters=self._changed_parameters(at),
            covariance=J @ left @ J.T,
            epoch_to_body=rotations(at[:3]) @ self.epoch_to_body,
        )

    @property
    def _estimated(self) -> np.ndarray:
        """Which of attitude [3], rate [3] and inertia ratios [2] a training may change."""
        return np.arange(TUMBLE) if self.tumbles else np.arange(3, 3 + SPIN)

    def _changed_parameters(self, at: np.ndarray) -> np.ndarray:
        axes = rotations(at[:3]) @ self.epoch_to_body
        rate = axes.T @ (self.rate_body_rad_s + at[3:6])
        if not self.tumbles:
            return rate
        return of_principal(rate, self.moments * np.append(1 + at[6:], 1.0), axes.T)

    def _by_changes(self, at: np.ndarray) -> np.ndarray:
        """Return the derivatives of the parameters by what a training may change, by central differences."""
        steps = np.concatenate(
            [np.full(3, 1e-5), np.full(3, 1e-5 * np.linalg.norm(self.rate_body_rad_s)), [1e-5] * 2]
        )
        sides = [
            (self._changed_parameters(at + d) - self._changed_parameters(at - d)) / (2 * d.sum())
            for d in np.diag(steps)[self._estimated]
        ]
        return np.stack(sides, axis=1)


def _carried(
    function: Callable[[np.ndarray], np.ndarray], at: np.ndarray, covariance: np.ndarray
) -> np.ndarray:
    """Return the covariance of a function of parameters, to first order."""
    small = 1e-2 * np.maximum(np.sqrt(np.diag(covariance)), 1e-12)
    J = np.stack([(function(at + d) - function(at - d)) / (2 * d.sum()) for d in np.diag(small)], axis=1)
    return J @ covariance @ J.T
