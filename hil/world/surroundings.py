"""What a camera in orbit sees beside its target: the Earth, stars and the Sun's stray light; how its dark level drifts.

Everything follows from the orbit and the time, in proportion to the target by published albedos and magnitudes
(`obbgs_base.physics.earth`, `obbgs_base.physics.stars`).
"""

import dataclasses
import functools
import math
from collections.abc import Callable

import numpy as np
from scipy.ndimage import zoom

from flightsw.icd.frame import PoseTag
from flightsw.icd.mission import CameraSection, Mission
from flightsw.icd.quaternion import quat_to_matrix
from flightsw.icd.reference_frames import julian_date
from flightsw.navigation.orbit import OrbitState, sunlit_fraction
from hil.world.scenario import sgp4_orbits
from obbgs_base.physics.earth import camera_rays, earth_radiance, sees_earth, stray_light
from obbgs_base.physics.stars import star_radiance

# The dark level above the calibrated one, as a share of full scale: a mean, and how it swings with the temperature
PEDESTAL, SWING = 0.0005, 0.0005
SWING_S = 5400.0  # an orbit
COARSE = 2  # pixels along a side of a cell in which the Earth is drawn


class Surroundings:
    """The sky of a mission's pass.

    Args:
        alpha: gives how much of each pixel the target covers, [H, W] uint8, for a true pose.
        orbits_at: UTC ns to the states of target and chaser; by default the mission's own.
    """

    def __init__(
        self,
        mission: Mission,
        alpha: Callable[[PoseTag], np.ndarray],
        orbits_at: Callable[[int], tuple[OrbitState, OrbitState]] | None = None,
    ):
        self._mission, self._alpha = mission, alpha
        self._orbits_at = orbits_at or functools.partial(sgp4_orbits, mission.orbit)
        camera = mission.camera
        self._rays = camera_rays(np.array(camera.K), camera.width, camera.height)
        K = np.diag([1 / COARSE, 1 / COARSE, 1.0]) @ np.array(camera.K)
        self._coarse_rays = camera_rays(K, -(-camera.width // COARSE), -(-camera.height // COARSE))

    def light(self, radiance: np.ndarray, pose: PoseTag, utc_ns: int) -> np.ndarray:
        """Return a target's radiance [H, W, C] with that of everything else in the picture.

        Raises:
            OrbitError: the target's orbit cannot be propagated, or the time is outside the ephemeris.
        """
        camera, channels = self._mission.camera, radiance.shape[2]
        assert pose.quat_inertial_to_body is not None  # of a true pose
        to_body = quat_to_matrix(pose.quat_inertial_to_body)
        to_camera = pose.world_to_camera[:3, :3] @ to_body
        from_earth_m = self._orbits_at(utc_ns)[0].position_m
        from_earth_m = from_earth_m + to_body.T @ pose.position_body_m
        sun = pose.world_to_camera[:3, :3] @ pose.sun_dir_body
        position_m = to_camera @ from_earth_m
        hidden = sees_earth(self._rays, position_m)
        behind = np.zeros((camera.height, camera.width, channels))
        behind += np.where(
            hidden, 0, star_radiance(to_camera, np.array(camera.K), camera.width, camera.height)
        )[..., None]
        if hidden.any():
            to_ground = gcrs_to_ground(utc_ns) @ to_camera.T
            seen = earth_radiance(self._coarse_rays, position_m, sun, COARSE / camera.K[0][0], to_ground)
            fine = zoom(seen, (COARSE, COARSE, 1), order=1, mode="nearest", grid_mode=True)
            seen = np.array(fine)[: camera.height, : camera.width]
            behind += seen if channels == 3 else seen.mean(axis=2, keepdims=True)
        sunlit = sunlit_fraction(from_earth_m, utc_ns)
        stray = sunlit * stray_light(self._rays, sun)[..., None]
        return radiance + (1 - self._alpha(pose)[..., None] / 255) * behind + stray

    def camera(self, utc_ns: int) -> CameraSection:
        """Return the mission's camera with the dark level that it really has at a time."""
        camera = self._mission.camera
        elapsed_s = (utc_ns - self._mission.orbit.start_utc_ns) * 1e-9
        share = PEDESTAL + SWING * math.sin(2 * math.pi * elapsed_s / SWING_S)
        return dataclasses.replace(
            camera, black_dn=camera.black_dn + share * (camera.white_dn - camera.black_dn)
        )


def seen(
    mission: Mission,
    target: Callable[[PoseTag], np.ndarray],
    surroundings: Surroundings | None,
    pose: PoseTag,
    utc_ns: int,
) -> tuple[np.ndarray, CameraSection]:
    """Return the radiance [H, W, C] that a camera has before it at a time, and the camera as it then is.

    Args:
        target: gives the target's radiance for a true pose.
        surroundings: what else is in the picture; None: a black sky.
    """
    radiance = target(pose)
    if surroundings is None:
        return radiance, mission.camera
    return surroundings.light(radiance, pose, utc_ns), surroundings.camera(utc_ns)


def gcrs_to_ground(utc_ns: int) -> np.ndarray:
    """Return the rotation [3, 3] from GCRS to axes that turn with the Earth, without precession, nutation, UT1 - UTC.

    That is half a degree, and the ground that is drawn is no map.

    Source: IERS Conventions 2010, 5.15 (Earth rotation angle).
    """
    days, rest = julian_date(utc_ns)
    days -= 2_451_545.0
    turns = (0.7790572732640 + 0.00273781191135448 * (days + rest) + days % 1 + rest) % 1
    c, s = math.cos(2 * math.pi * turns), math.sin(2 * math.pi * turns)
    return np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
