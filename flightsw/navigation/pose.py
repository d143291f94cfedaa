"""The camera's pose in the target's body frame at mid-exposure, with its covariance and the light."""

import functools
import logging

import numpy as np

from flightsw.errors import NavigationError, OrbitError
from flightsw.icd.frame import PoseTag
from flightsw.icd.mission import Mission
from flightsw.icd.quaternion import matrix_to_quat, quat_to_matrix
from flightsw.navigation.messages import SCHEME, MessageNavigation
from flightsw.navigation.orbit import in_eclipse, propagate, sun_direction_gcrs
from flightsw.navigation.stream import NavigationStream, RelativePose, SatelliteStates

log = logging.getLogger(__name__)


class PoseTagger:
    """Tags exposures by the mission's navigation source, and counts the tags that cannot be trusted."""

    def __init__(self, mission: Mission):
        self.stale_elements = 0  # pose given, but marked invalid
        self.outside_ephemeris = 0  # no pose: the orbit or the Sun cannot be computed for that time
        self.navigation_gaps = 0  # no pose: the stream has no state near enough
        self._mission = mission
        self.navigation = open_navigation(mission)

    def close(self) -> None:
        if self.navigation is not None:
            self.navigation.close()

    def __call__(self, utc_ns: int) -> PoseTag:
        """Return the tag for one mid-exposure; when nothing is known it says so, with source `none`, never a guess."""
        try:
            if self.navigation is not None:
                return navigation_tag(self._mission, self.navigation.at(utc_ns))
            tag = pose_tag(self._mission, utc_ns)
        except NavigationError as error:
            self.navigation_gaps += 1
            log.warning("no pose: %s", error)
            return unknown_pose()
        except OrbitError as error:
            self.outside_ephemeris += 1
            log.warning("no pose: %s", error)
            return unknown_pose()
        self.stale_elements += not tag.valid
        return tag


def open_navigation(mission: Mission) -> NavigationStream | MessageNavigation | None:
    """Return the mission's source of navigation states; None where poses come from the two-line elements.

    Raises:
        NavigationError: a file is not there, or not valid.
    """
    section = mission.navigation
    if section.source == "sgp4":
        return None
    if section.source.startswith(SCHEME):
        return MessageNavigation(section.source, mission.orbit.target_tle)
    return NavigationStream(section)


def unknown_pose() -> PoseTag:
    """Return the tag of a frame whose pose is not known: invalid, source `none`, every number zero, no rotation."""
    zero = np.zeros(3)
    return PoseTag(np.array([1.0, 0, 0, 0]), zero, np.zeros((6, 6)), zero, False, False, "none")


def pose_tag(mission: Mission, utc_ns: int) -> PoseTag:
    """Return the pose of a camera that points at the target, from both orbits by SGP4 and the target's attitude.

    Camera +z looks at the target's reference point; camera +y is as near to minus the chaser's orbit normal as that
    allows. The tag is marked invalid, not refused, when the elements are older than the mission allows.

    Raises:
        OrbitError: an orbit cannot be propagated, the time is outside the ephemeris, or the camera's roll is
            undefined: chaser and target coincide, or the target is exactly along the chaser's orbit normal.
    """
    target = propagate(mission.orbit.target_tle, utc_ns)
    chaser = propagate(mission.orbit.chaser_tle, utc_ns)
    states = SatelliteStates(
        utc_ns,
        target.position_m,
        target.velocity_m_s,
        chaser.position_m,
        chaser.velocity_m_s,
        quat_gcrs_to_body=None,
        quat_gcrs_to_chaser=None,
        covariance=None,
    )
    age_days = max(abs(target.element_age_days), abs(chaser.element_age_days))
    return _tag_of_states(mission, states, age_days <= mission.orbit.max_element_age_days, "sgp4")


def navigation_tag(mission: Mission, state: SatelliteStates | RelativePose) -> PoseTag:
    """Return the tag of a navigation state at its own time.

    A relative pose says nothing about the Earth and the Sun: their directions come from the target's elements and the
    mission's attitude of the target.

    Raises:
        OrbitError: as `pose_tag`.
        NavigationError: a pose in body axes of a target whose attitude the mission calls unknown.
    """
    if isinstance(state, SatelliteStates):
        return _tag_of_states(mission, state, True, "navigation")
    if mission.target_attitude.knowledge == "unknown":
        raise NavigationError(
            "navigation gives poses in the target's body axes, but mission.target_attitude.knowledge is unknown: "
            "send the states of both satellites, or say what is known of the attitude"
        )
    gcrs_to_body = target_attitude(mission, state.utc_ns)
    return PoseTag(
        quat_body_to_camera=state.quat_body_to_camera,
        position_body_m=state.position_body_m,
        covariance=state.covariance,
        sun_dir_body=gcrs_to_body @ sun_direction_gcrs(state.utc_ns),
        in_eclipse=in_eclipse(propagate(mission.orbit.target_tle, state.utc_ns).position_m, state.utc_ns),
        valid=True,
        source="navigation",
        attitude=mission.target_attitude.knowledge,
        quat_inertial_to_body=matrix_to_quat(gcrs_to_body),
        correlation_time_s=mission.pose.correlation_time_s,
    )


def _tag_of_states(mission: Mission, states: SatelliteStates, valid: bool, source: str) -> PoseTag:
    knowledge = mission.target_attitude.knowledge
    if states.quat_gcrs_to_body is None or knowledge == "unknown":
        gcrs_to_body = target_attitude(mission, states.utc_ns)
    else:
        gcrs_to_body = quat_to_matrix(states.quat_gcrs_to_body)
    chaser_to_camera = quat_to_matrix(np.array(mission.pose.quat_chaser_to_camera))
    if states.quat_gcrs_to_chaser is None:
        gcrs_to_camera = _pointing(states)
        gcrs_to_chaser = chaser_to_camera.T @ gcrs_to_camera
    else:
        gcrs_to_chaser = quat_to_matrix(states.quat_gcrs_to_chaser)
        gcrs_to_camera = chaser_to_camera @ gcrs_to_chaser
    offset_m = gcrs_to_chaser.T @ np.array(mission.pose.camera_position_m)
    sigma_rad = np.radians(mission.pose.sigma_attitude_deg)
    covariance = np.diag(np.repeat([mission.pose.sigma_position_m**2, sigma_rad**2], 3))
    if states.covariance is not None:
        covariance[:3, :3] = gcrs_to_body @ states.covariance[:3, :3] @ gcrs_to_body.T
    return PoseTag(
        quat_body_to_camera=matrix_to_quat(gcrs_to_camera @ gcrs_to_body.T),
        position_body_m=gcrs_to_body @ (states.chaser_position_m + offset_m - states.target_position_m),
        covariance=covariance,
        sun_dir_body=gcrs_to_body @ sun_direction_gcrs(states.utc_ns),
        in_eclipse=in_eclipse(states.target_position_m, states.utc_ns),
        valid=valid,
        source=source,
        attitude=knowledge,
        quat_inertial_to_body=matrix_to_quat(gcrs_to_body),
        correlation_time_s=mission.pose.correlation_time_s,
    )


def _pointing(states: SatelliteStates) -> np.ndarray:
    """Return gcrs_to_camera [3, 3] of a chaser that keeps its camera on the target."""
    line_of_sight = states.target_position_m - states.chaser_position_m
    orbit_normal = np.cross(states.chaser_position_m, states.chaser_velocity_m_s)
    try:
        return look_along(line_of_sight, down=-orbit_normal)
    except ValueError as error:
        raise OrbitError(
            f"the camera cannot point at the target {np.linalg.norm(line_of_sight):.3g} m away: {error}; are these the "
            "elements of two spacecraft?"
        ) from error


def target_attitude(mission: Mission, utc_ns: int) -> np.ndarray:
    """Return gcrs_to_body [3, 3]: body +z on the mission's axis, turned about it in `spin` mode.

    Where the mission calls the attitude unknown it is the identity: inertial axes stand for the body's.
    """
    if mission.target_attitude.knowledge == "unknown":
        return np.eye(3)
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
    distance = float(np.linalg.norm(direction))
    if not distance:
        raise ValueError("the direction has no length")
    z = direction / distance
    y = down - (down @ z) * z
    length = np.linalg.norm(y)
    if not length > 1e-9 * np.linalg.norm(down):
        raise ValueError("direction and down are parallel or zero: the roll about the direction is undefined")
    y = y / length
    return np.stack([np.cross(y, z), y, z])
