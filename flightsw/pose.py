"""The camera's pose in the target's body frame at mid-exposure, with its covariance and the light."""

import functools

import numpy as np

from flightsw.errors import OrbitError
from flightsw.icd.frame import PoseTag, matrix_to_quat
from flightsw.icd.mission import Mission
from flightsw.orbit import in_eclipse, propagate, sun_direction_gcrs


def pose_tag(mission: Mission, utc_ns: int) -> PoseTag:
    """Return the pose of a camera that points at the target, from both orbits and the target's attitude.

    Camera +z looks at the target's reference point; camera +y is as near to minus the chaser's orbit normal as that
    allows. The tag is marked invalid, not refused, when the elements are older than the mission allows.

    Raises:
        OrbitError: an orbit cannot be propagated, the time is outside the ephemeris, or the camera's roll is
            undefined: chaser and target coincide, or the target is exactly along the chaser's orbit normal.
    """
    target = propagate(mission.orbit.target_tle, utc_ns)
    chaser = propagate(mission.orbit.chaser_tle, utc_ns)
    line_of_sight = target.position_m - chaser.position_m
    orbit_normal = np.cross(chaser.position_m, chaser.velocity_m_s)
    try:
        gcrs_to_camera = look_along(line_of_sight, down=-orbit_normal)
    except ValueError as error:
        raise OrbitError(f"the camera cannot point at the target {line_of_sight} m away: {error}") from error
    gcrs_to_body = target_attitude(mission, utc_ns)
    age_days = max(abs(target.element_age_days), abs(chaser.element_age_days))
    sigma_rad = np.radians(mission.pose.sigma_attitude_deg)
    variances = np.repeat([mission.pose.sigma_position_m**2, sigma_rad**2], 3)
    return PoseTag(
        quat_body_to_camera=matrix_to_quat(gcrs_to_camera @ gcrs_to_body.T),
        position_body_m=gcrs_to_body @ -line_of_sight,
        covariance=np.diag(variances),
        sun_dir_body=gcrs_to_body @ sun_direction_gcrs(utc_ns),
        in_eclipse=in_eclipse(target.position_m, utc_ns),
        valid=age_days <= mission.orbit.max_element_age_days,
        source="sgp4",
    )


def target_attitude(mission: Mission, utc_ns: int) -> np.ndarray:
    """Return gcrs_to_body [3, 3]: body +z on the mission's axis, turned about it in `spin` mode."""
    gcrs_to_start = _attitude_at_start(mission)
    if mission.target_attitude.mode == "inertial":
        return gcrs_to_start
    turn = 2 * np.pi * (utc_ns - mission.orbit.start_utc_ns) * 1e-9 / mission.target_attitude.period_s
    c, s = np.cos(turn), np.sin(turn)
    return np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]]) @ gcrs_to_start


@functools.lru_cache(maxsize=4)
def _attitude_at_start(mission: Mission) -> np.ndarray:
    axis = mission.target_attitude.axis
    z = sun_direction_gcrs(mission.orbit.start_utc_ns) if axis == "sun" else np.array(axis, dtype=float)
    helper = np.array([0.0, 0.0, 1.0]) if abs(z[2]) < 0.9 * np.linalg.norm(z) else np.array([1.0, 0.0, 0.0])
    # look_along gives x, y, z rows of a right-handed frame whose z is the axis: the same construction serves a body
    return look_along(z, down=helper)


def look_along(direction: np.ndarray, down: np.ndarray) -> np.ndarray:
    """Return the rotation [3, 3] into a frame with z along `direction` and y as near to `down` as possible.

    Raises:
        ValueError: the two are parallel or zero, so that y is not defined.
    """
    z = direction / max(float(np.linalg.norm(direction)), 1e-300)
    y = down - (down @ z) * z
    length = np.linalg.norm(y)
    if not length > 1e-9 * np.linalg.norm(down):
        raise ValueError("direction and down are parallel or zero: the roll about the direction is undefined")
    y = y / length
    return np.stack([np.cross(y, z), y, z])
