"""Sections of the mission file: the target's attitude, the tags' poses and navigation, and how far they can err."""

import math
import re
from dataclasses import dataclass
from typing import Literal

import numpy as np

from flightsw.icd.config import require, require_counts, require_unit_quaternion
from flightsw.icd.frame import Attitude
from obbgs_base.physics.navigation_errors import LENGTHS, SharedParameters

# errors beyond which a value says nothing, in the units of the mission file
MOST = {
    "attitude_deg": (180.0, " degrees"),
    "boresight_deg": (180.0, " degrees"),
    "inertia_ratios": (1.0, ", a share of the ratios: write 1 % as 0.01"),
    "focal": (0.5, ", a share of the focal length: write 1 % as 0.01"),
}


@dataclass(frozen=True)
class TargetAttitudeSection:
    """How the target turns: body +z stays on `axis` (GCRS), body x, y turn about it in `spin` mode.

    `knowledge` goes into each tag. rate_only: the target turns so, or as navigation says, but the axes at the start are
    a guess. unknown: neither this section nor navigation says anything of the attitude, and poses are in GCRS axes.
    """

    mode: Literal["inertial", "spin"] = "inertial"
    axis: Literal["sun"] | tuple[float, ...] = "sun"
    period_s: float = 600.0
    knowledge: Attitude = "known"

    def __post_init__(self):
        path = "mission.target_attitude"
        if not isinstance(self.axis, str):
            require(len(self.axis) == 3, f"{path}.axis", f"expected 3 numbers, got {len(self.axis)}")
            require(
                abs(math.hypot(*self.axis) - 1) < 1e-3,
                f"{path}.axis",
                f"expected a unit vector, got length {math.hypot(*self.axis):.4f}",
            )
        require(
            0.1 <= self.period_s <= 1e9, f"{path}.period_s", f"expected 0.1 to 1e9 s, got {self.period_s}"
        )


@dataclass(frozen=True)
class PoseSection:
    """Uncertainty of the tags, and how the camera is mounted on the chaser.

    The sigmas are of the errors that differ from bracket to bracket; those that a whole pass shares have a section of
    their own, `navigation_errors`.
    """

    sigma_position_m: float = 0.02
    sigma_attitude_deg: float = 0.01
    correlation_time_s: float = 0.0  # of these errors; 0: independent from bracket to bracket
    quat_chaser_to_camera: tuple[float, ...] = (1.0, 0.0, 0.0, 0.0)  # w, x, y, z
    camera_position_m: tuple[float, ...] = (0.0, 0.0, 0.0)  # in the chaser's frame, from its centre of mass

    def __post_init__(self):
        path = "mission.pose"
        require_counts(self, path, quat_chaser_to_camera=4, camera_position_m=3)
        require_unit_quaternion(self.quat_chaser_to_camera, f"{path}.quat_chaser_to_camera")
        for name in ("sigma_position_m", "sigma_attitude_deg", "correlation_time_s"):
            require(
                getattr(self, name) >= 0,
                f"mission.pose.{name}",
                f"must not be negative, got {getattr(self, name)}",
            )


@dataclass(frozen=True)
class NavigationSection:
    """Where the pose comes from: two-line elements, states as JSON lines (flightsw/navigation/stream.py), or messages.

    ndm:///folder holds CCSDS messages of both satellites (flightsw/navigation/messages.py), which say themselves how
    they are interpolated.
    """

    source: str = "sgp4"  # or file:///path, tcp://host:port, ndm:///folder
    max_gap_s: float = 2.0  # no pose is interpolated between states further apart; not of messages
    wait_s: float = 2.0  # for a state that has not arrived yet

    def __post_init__(self):
        path = "mission.navigation"
        require(
            self.source == "sgp4"
            or re.fullmatch(r"(file|ndm):///.+|tcp://[^:/]+:\d{1,5}", self.source) is not None,
            f"{path}.source",
            f"expected sgp4, file:///path, tcp://host:port or ndm:///folder, got {self.source!r}",
        )
        require(
            0 < self.max_gap_s <= 3600,
            f"{path}.max_gap_s",
            f"expected more than 0 s, 3600 s at most, got {self.max_gap_s}",
        )
        require(0 <= self.wait_s <= 60, f"{path}.wait_s", f"expected 0 to 60 s, got {self.wait_s}")


@dataclass(frozen=True)
class NavigationErrorsSection:
    """One-sigma values of the errors that all frames of a pass share; the ground estimates what is not 0.

    A number stands for all axes, a list for each of them. The fields are those of `SharedParameters`: position and
    velocity of the camera relative to the target at the start, along radial, transverse and normal axes; the target's
    attitude and rate at the start, about its body axes; the boresight, about the camera's axes.
    """

    position_m: float | tuple[float, ...] = 0.0
    velocity_m_s: float | tuple[float, ...] = 0.0
    attitude_deg: float | tuple[float, ...] = 0.0
    rate_deg_s: float | tuple[float, ...] = 0.0
    inertia_ratios: float | tuple[float, ...] = 0.0  # relative, of moments about body x, y over that about z
    boresight_deg: float | tuple[float, ...] = 0.0
    clock_s: float = 0.0
    focal: float = 0.0  # relative, of the focal length

    def __post_init__(self):
        for name, length in zip(self.__dataclass_fields__, LENGTHS.values(), strict=True):
            path, value = f"mission.navigation_errors.{name}", getattr(self, name)
            values = value if isinstance(value, tuple) else (value,)
            expected = "expected 1 number" if length == 1 else f"expected 1 or {length} numbers"
            require(len(values) in (1, length), path, f"{expected}, got {len(values)}")
            require(min(values) >= 0, path, f"must not be negative, got {min(values):g}")
            most, unit = MOST.get(name, (math.inf, ""))
            require(max(values) <= most, path, f"expected 0 to {most:g}{unit}, got {max(values):g}")

    @property
    def sigmas(self) -> SharedParameters:
        """The standard deviations in radians."""
        parameters = {}
        for (name, length), given in zip(LENGTHS.items(), self.__dataclass_fields__, strict=True):
            values = np.broadcast_to(getattr(self, given), (length,))
            parameters[name] = np.radians(values) if "_rad" in name else values
        return SharedParameters(**parameters)
