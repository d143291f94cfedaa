"""The target's attitude: the rotation from GCRS to its body frame as a function of time."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.integrate import OdeSolution, solve_ivp

from flightsw.icd.mission import ConfigError
from flightsw.icd.quaternion import matrix_to_quat, quat_to_matrix
from flightsw.navigation.orbit import propagate, sun_direction_gcrs
from flightsw.navigation.pose import look_along

Attitude = Callable[[int], np.ndarray]  # UTC ns to gcrs_to_body [3, 3]


@dataclass(frozen=True)
class AttitudeSection:
    """The attitude of a scenario's target.

    Modes:
        inertial: body +z points along `axis`, and the target does not rotate.
        spin: body +z points along `axis`, and the target rotates about it once in `period_s`.
        lvlh: body x points forward, y against the orbit normal, z to the Earth's centre.
        tumble: torque-free rotation that starts in the inertial attitude with the angular velocity `rates_deg_s`.
    """

    mode: Literal["inertial", "lvlh", "spin", "tumble"] = "inertial"
    axis: Literal["sun"] | tuple[float, ...] = "sun"  # the Sun's direction at the start, or a GCRS vector
    period_s: float = 600.0
    rates_deg_s: tuple[float, ...] = (0.0, 0.0, 0.0)  # about body x, y, z at the start
    inertia: tuple[float, ...] = (1.0, 1.0, 1.0)  # principal moments about body x, y, z; only ratios matter

    def __post_init__(self):
        path = "scenario.attitude"
        if not isinstance(self.axis, str) and (len(self.axis) != 3 or not np.linalg.norm(self.axis) > 0):
            raise ConfigError(
                f"{path}.axis", f"expected 'sun' or 3 numbers that are not all 0, got {self.axis}"
            )
        if not self.period_s > 0:
            raise ConfigError(f"{path}.period_s", f"must be positive, got {self.period_s}")
        if len(self.rates_deg_s) != 3:
            raise ConfigError(f"{path}.rates_deg_s", f"expected 3 numbers, got {len(self.rates_deg_s)}")
        moments = sorted(self.inertia)
        if len(moments) != 3 or not (moments[0] > 0 and moments[0] + moments[1] >= moments[2]):
            raise ConfigError(
                f"{path}.inertia",
                f"expected 3 positive moments, none above the sum of the others, got {list(self.inertia)}",
            )


def attitude(
    section: AttitudeSection, target_tle: tuple[str, ...], start_utc_ns: int, horizon_s: float
) -> Attitude:
    """Return the target's attitude as a function of time.

    A tumble is integrated from the start to `horizon_s` later, and known from a tenth of a second before; outside, the
    function raises ValueError. The other modes are known at any time.
    """
    if section.mode == "lvlh":
        return lambda utc_ns: _gcrs_to_lvlh(target_tle, utc_ns)
    gcrs_to_start = _body_axes_at_start(section, start_utc_ns)
    if section.mode == "inertial":
        return lambda utc_ns: gcrs_to_start
    if section.mode == "spin":

        def spinning(utc_ns: int) -> np.ndarray:
            turn = 2 * np.pi * (utc_ns - start_utc_ns) * 1e-9 / section.period_s
            c, s = np.cos(turn), np.sin(turn)
            return np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]]) @ gcrs_to_start

        return spinning
    motion = tumble(
        np.array(section.inertia), np.radians(section.rates_deg_s), matrix_to_quat(gcrs_to_start.T), horizon_s
    )

    def tumbling(utc_ns: int) -> np.ndarray:
        elapsed_s = (utc_ns - start_utc_ns) / 1e9
        # before the start the polynomial of the integrator's first step goes on; a test checks how good that is
        if not -0.1 <= elapsed_s <= horizon_s:
            raise ValueError(
                f"the tumble is known from 0 to {horizon_s:g} s after the start, not {elapsed_s:g} s"
            )
        quat_body_to_gcrs = motion(elapsed_s)[:4]
        return quat_to_matrix(quat_body_to_gcrs / np.linalg.norm(quat_body_to_gcrs)).T

    return tumbling


def motion_at_start(
    section: AttitudeSection, target_tle: tuple[str, ...], start_utc_ns: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return gcrs_to_body [3, 3] and the target's angular velocity [3], rad/s about its body axes, at the start."""
    gcrs_to_body = attitude(section, target_tle, start_utc_ns, horizon_s=1.0)(start_utc_ns)
    rates_rad_s = {
        "inertial": np.zeros(3),
        "spin": np.array([0.0, 0.0, 2 * np.pi / section.period_s]),
        "tumble": np.radians(section.rates_deg_s),
    }
    if section.mode != "lvlh":
        return gcrs_to_body, rates_rad_s[section.mode]
    state = propagate(target_tle, start_utc_ns)
    momentum = np.cross(state.position_m, state.velocity_m_s)
    return gcrs_to_body, gcrs_to_body @ momentum / (state.position_m @ state.position_m)


def tumble(
    inertia: np.ndarray, rates_rad_s: np.ndarray, quat_body_to_gcrs: np.ndarray, horizon_s: float
) -> OdeSolution:
    """Return a rigid body's torque-free rotation: a function of s to quat_body_to_gcrs [4] and rates [3] rad/s, joined.

    Args:
        inertia: [3] principal moments about the body axes.
        rates_rad_s: [3] angular velocity at the start, body axes.
        quat_body_to_gcrs: [4] at the start.

    Source: Euler's equations, I dω/dt = Iω x ω, and dq/dt = q (0, ω) / 2 with quaternion multiplication (Markley and
    Crassidis, Fundamentals of Spacecraft Attitude Determination and Control, 2014).
    """

    a, b, c = inertia.tolist()

    def derivative(_: float, state: np.ndarray) -> list[float]:  # called ten thousand times: no arrays
        w, x, y, z, p, q, r = state.tolist()
        return [
            0.5 * (-x * p - y * q - z * r),
            0.5 * (w * p + y * r - z * q),
            0.5 * (w * q + z * p - x * r),
            0.5 * (w * r + x * q - y * p),
            ((b * q) * r - (c * r) * q) / a,
            ((c * r) * p - (a * p) * r) / b,
            ((a * p) * q - (b * q) * p) / c,
        ]

    start = np.concatenate([quat_body_to_gcrs, rates_rad_s])
    # The dense output is of lower order than the steps; with steps this short its error stays below 1e-8 rad.
    rate = max(float(np.linalg.norm(rates_rad_s)), 1e-9)
    solved = solve_ivp(
        derivative,
        (0.0, horizon_s),
        start,
        method="DOP853",
        rtol=1e-11,
        atol=1e-12,
        max_step=0.25 / rate,
        dense_output=True,
    )
    assert solved.success and solved.sol is not None  # smooth equations with a bounded solution
    return solved.sol


def _body_axes_at_start(section: AttitudeSection, start_utc_ns: int) -> np.ndarray:
    z = sun_direction_gcrs(start_utc_ns) if isinstance(section.axis, str) else np.array(section.axis)
    helper = np.array([0.0, 0.0, 1.0]) if abs(z[2]) < 0.9 * np.linalg.norm(z) else np.array([1.0, 0.0, 0.0])
    return look_along(z, down=helper)


def _gcrs_to_lvlh(target_tle: tuple[str, ...], utc_ns: int) -> np.ndarray:
    state = propagate(target_tle, utc_ns)
    return look_along(-state.position_m, down=-np.cross(state.position_m, state.velocity_m_s))
