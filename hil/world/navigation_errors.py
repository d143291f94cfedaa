"""The errors of a simulated navigation solution: drawn here, of distributions and by a motion of the simulator's own.

The estimator on the ground has another model (Clohessy and Wiltshire's state transition, normal distributions), so that
what it finds is not merely its own assumption. Sizes are those of a cooperative chaser with a star tracker and relative
navigation by angles: the range, along the track, is what such a filter knows worst.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from flightsw.icd.pose_sections import NavigationErrorsSection
from hil.world.fly_around import RelativeElements, linear_motion

ALONG_TRACK = 0.02  # of the range
OTHER_ELEMENTS = 0.002  # of the range, each: eccentricity and inclination vectors
# of the range: the difference of semi-major axes, 0.2 % of the range along the track in an orbit
DRIFT = 0.0002
SPIN_RATE = 0.002  # relative
BORESIGHT_DEG = 0.1
CLOCK_S = 0.02
# about each axis of the camera, independent from bracket to bracket, or from exposure to exposure if far apart
NOISE_DEG = 0.02
LOW, HIGH = 0.5, 1.5  # the shared errors are uniform between these shares of their sizes, of either sign
RMS = float(np.sqrt((LOW**2 + LOW * HIGH + HIGH**2) / 3))  # of that distribution


@dataclass(frozen=True)
class NavigationErrors:
    """What one pass errs by; tags are true poses changed by it.

    Attributes:
        elements: relative orbital elements (m) of the estimated minus the true chaser.
        spin_rate: by what share the target's estimated rate is too large.
        boresight_rad: [3] rotation vector about the camera's axes that follows the true attitude of the camera.
        clock_s: by how much the frames are exposed later than the states that carry their times.
        noise_rad: [3] standard deviations about the camera's axes, of what differs from bracket to bracket.
    """

    elements: RelativeElements
    spin_rate: float
    boresight_rad: np.ndarray
    clock_s: float
    noise_rad: np.ndarray

    def position_rtn_m(self, latitude_rad: float, elapsed_s: float, mean_motion_rad_s: float) -> np.ndarray:
        """Return the error [3] of the relative position in the target's radial, transverse and normal axes.

        Args:
            latitude_rad: the target's argument of latitude.
        """
        return linear_motion(
            self.elements, np.array([latitude_rad]), np.array([elapsed_s]), mean_motion_rad_s
        )[0]

    def described(self) -> dict[str, str | float]:
        """Return what was drawn, for the report."""
        elements = ", ".join(
            f"{name.removesuffix('_m')} {value:.2f}" for name, value in vars(self.elements).items()
        )
        boresight = ", ".join(f"{value:.4f}" for value in np.degrees(self.boresight_rad))
        return {
            "orbit_error_m": elements,
            "spin_rate_error_percent": round(100 * self.spin_rate, 4),
            "boresight_error_deg": boresight,
            "clock_error_s": round(self.clock_s, 5),
            "noise_deg": NOISE_DEG,
        }


def draw(range_m: float, seed: int) -> NavigationErrors:
    """Return the errors of a pass; every size is drawn anew, the boresight's direction is even over the sphere."""
    rng = np.random.default_rng(seed)

    def signed(size: float) -> float:
        return float(size * rng.uniform(LOW, HIGH) * rng.choice((-1, 1)))

    direction = rng.standard_normal(3)
    return NavigationErrors(
        elements=RelativeElements(
            da_m=signed(DRIFT * range_m),
            dlambda_m=signed(ALONG_TRACK * range_m),
            **{name: signed(OTHER_ELEMENTS * range_m) for name in ("dex_m", "dey_m", "dix_m", "diy_m")},
        ),
        spin_rate=signed(SPIN_RATE),
        boresight_rad=direction / np.linalg.norm(direction) * signed(np.radians(BORESIGHT_DEG)),
        clock_s=signed(CLOCK_S),
        noise_rad=np.full(3, np.radians(NOISE_DEG)),
    )


def stated_sigmas(
    range_m: float, rate_deg_s: np.ndarray, mean_motion_rad_s: float
) -> NavigationErrorsSection:
    """Return what an honest filter states: the standard deviations of what `draw` draws, at the start of the pass.

    Args:
        rate_deg_s: [3] the target's true rate, body axes.
    """
    n, e, a = mean_motion_rad_s, RMS * OTHER_ELEMENTS * range_m, RMS * DRIFT * range_m
    along = RMS * ALONG_TRACK * range_m
    # each element's part in the linear motion; at an unknown phase its root mean square
    position_m = (float(np.hypot(a, e)), float(np.hypot(along, 2 * e)), e)
    velocity_m_s = (n * e, float(n * np.hypot(1.5 * a, 2 * e)), n * e)
    return NavigationErrorsSection(
        position_m=position_m,
        velocity_m_s=velocity_m_s,
        rate_deg_s=tuple(float(v) for v in RMS * SPIN_RATE * np.abs(rate_deg_s)),
        boresight_deg=RMS * BORESIGHT_DEG / float(np.sqrt(3)),
        clock_s=RMS * CLOCK_S,
    )


def turned(rotation: np.ndarray, vector_rad: np.ndarray) -> np.ndarray:
    """Return the rotation [3, 3] followed by a rotation vector [3]."""
    return Rotation.from_rotvec(vector_rad).as_matrix() @ rotation
