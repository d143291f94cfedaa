"""Scenarios: the orbits, the target's attitude and the light at any time, and the true pose of each exposure."""

import functools
import hashlib
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from flightsw.capture.sequencer import plan
from flightsw.icd.config import MAX_YAML_BYTES, ConfigError, build, in_file, keys_below, parse_yaml
from flightsw.icd.frame import PoseTag
from flightsw.icd.mission import BracketSection, Mission, OrbitSection, PoseSection
from flightsw.icd.quaternion import matrix_to_quat
from flightsw.navigation.orbit import OrbitState, propagate, sun_direction_gcrs, sunlit_fraction
from flightsw.navigation.pose import look_along, pose_tag
from hil.world.attitude import Attitude, AttitudeSection, attitude
from hil.world.basilisk import BasiliskSection, Flown, flown
from hil.world.fly_around import Design, FlyAround, RelativeElements, design
from obbgs_base.files import read_bounded

SCENARIOS = Path(__file__).parent / "scenarios"
HORIZON_MARGIN_S = 3600.0  # a tumble is integrated so much further than the scenario lasts


@dataclass(frozen=True)
class TrueExposure:
    """An exposure's times and the true pose at its middle."""

    exposure_time_s: float
    mid_exposure_utc_ns: int
    pose: PoseTag


def true_exposures(mission: Mission, pose_at: Callable[[int], PoseTag] | None = None) -> list[TrueExposure]:
    """Return the exposures that the mission's bracket section plans, with the true pose at each mid-exposure.

    Args:
        pose_at: UTC ns to the true pose; by default the mission's own orbits and attitude.
    """
    pose_at = pose_at or functools.partial(pose_tag, mission)
    return [
        TrueExposure(shot.exposure_time_s, shot.mid_exposure_utc_ns, pose_at(shot.mid_exposure_utc_ns))
        for shot in plan(mission)
    ]


@dataclass(frozen=True)
class Scenario:
    """Orbits of target and chaser, the target's attitude, and the times of the brackets.

    The chaser's orbit is given in one of three ways: a TLE, relative elements at the start, or a fly-around.
    """

    description: str
    start_utc: str
    duration_s: float  # from the first bracket to the last
    brackets: int  # evenly spread over the duration; a caller may choose another number
    target_tle: tuple[str, ...]
    fov_deg: float  # of the image's width
    chaser_tle: tuple[str, ...] = ()
    relative_elements: RelativeElements | None = None
    fly_around: FlyAround | None = None
    attitude: AttitudeSection = field(default_factory=AttitudeSection)
    basilisk: BasiliskSection | None = None  # where given, Basilisk moves both from the start on
    sha256: str = ""  # of the file's bytes

    def __post_init__(self):
        given = [bool(self.chaser_tle), self.relative_elements is not None, self.fly_around is not None]
        if sum(given) != 1:
            raise ConfigError(
                "scenario",
                "expected exactly one of chaser_tle, relative_elements and fly_around, "
                f"got {sum(given)} of them",
            )
        with keys_below("scenario", "mission.orbit"):  # to validate them
            OrbitSection(self.target_tle, self.chaser_tle or self.target_tle, self.start_utc)
        for name, low, high in (
            ("duration_s", 1.0, 30 * 86_400.0),
            ("brackets", 1, 100_000),
            ("fov_deg", 1e-3, 120.0),
        ):
            if not low <= getattr(self, name) <= high:
                raise ConfigError(
                    f"scenario.{name}", f"expected {low:g} to {high:g}, got {getattr(self, name)}"
                )

    @functools.cached_property
    def design(self) -> Design | None:
        """The chaser's TLE made from relative elements or a fly-around; None if a TLE is given."""
        wanted = self.relative_elements or self.fly_around
        if wanted is None:
            return None
        start_utc_ns = OrbitSection(self.target_tle, self.target_tle, self.start_utc).start_utc_ns
        return design(self.target_tle, wanted, start_utc_ns, self.duration_s)

    @functools.cached_property
    def orbit(self) -> OrbitSection:
        """Both TLEs and the start, as a section of a mission."""
        chaser_tle = self.design.chaser_tle if self.design else self.chaser_tle
        return OrbitSection(self.target_tle, chaser_tle, self.start_utc)

    def bracket_section(
        self, exposure_times_ms: tuple[float, ...], count: int | None = None, tight: bool = True
    ) -> BracketSection:
        """Return `count` brackets (default: the scenario's) spread evenly over the duration.

        Args:
            tight: the exposures of a bracket are half a second apart, not spread over the time to the next.

        Raises:
            ConfigError: they do not fit into the duration.
        """
        count = count or self.brackets
        spacing_s = min(0.5, self.duration_s / (count * len(exposure_times_ms)))
        return BracketSection(
            exposure_times_ms=exposure_times_ms,
            frame_spacing_s=spacing_s if tight else None,
            interval_s=self.duration_s / (max(count - 1, 1) if tight else count),
            count=count,
        )


def sgp4_orbits(orbit: OrbitSection, utc_ns: int) -> tuple[OrbitState, OrbitState]:
    """Return the states of target and chaser that their elements give at a time.

    Raises:
        OrbitError: an orbit cannot be propagated so far.
    """
    return propagate(orbit.target_tle, utc_ns), propagate(orbit.chaser_tle, utc_ns)


@dataclass(frozen=True)
class SceneState:
    """The geometry and the light at one time; directions are unit vectors in the target's body frame."""

    utc_ns: int
    target: OrbitState
    chaser: OrbitState
    pose: PoseTag  # the true camera: looks at the target, image y against the chaser's orbit normal
    gcrs_to_camera: np.ndarray  # [3, 3]
    earth_dir_body: np.ndarray  # [3] to the Earth's centre
    relative_rtn_m: np.ndarray  # [3] chaser minus target in the target's RTN frame
    range_m: float
    phase_angle_rad: float  # at the target, between the Sun and the chaser
    sunlit: float  # visible fraction of the Sun's disc, at the target


class Scene:
    """A scenario's state at any time from its start on; `orbits_at` gives the states of target and chaser.

    Raises:
        ModuleNotFoundError: the scenario asks for Basilisk, which is not installed.
    """

    def __init__(self, scenario: Scenario):
        self.scenario = scenario
        self.orbit = scenario.orbit
        self.orbits_at = functools.partial(sgp4_orbits, self.orbit)
        if scenario.basilisk is not None:
            self.orbits_at = self._flown(scenario.basilisk, scenario.attitude).orbits_at
        self.gcrs_to_body = self.attitude_of(scenario.attitude)
        sigma = PoseSection()  # the tag's stated uncertainty; the pose itself is exact
        variances = [sigma.sigma_position_m**2, np.radians(sigma.sigma_attitude_deg) ** 2]
        self._covariance = np.diag(np.repeat(variances, 3))

    def attitude_of(self, section: AttitudeSection) -> Attitude:
        """Return the attitude as a function of time that a target of this orbit and start would have."""
        if self.scenario.basilisk is not None:
            return self._flown(self.scenario.basilisk, section).gcrs_to_body
        return attitude(section, self.orbit.target_tle, self.orbit.start_utc_ns, self._horizon_s)

    @property
    def _horizon_s(self) -> float:
        return self.scenario.duration_s + HORIZON_MARGIN_S

    def _flown(self, section: BasiliskSection, start: AttitudeSection) -> Flown:
        return flown(section, start, self.orbit, self._horizon_s)

    def state(self, utc_ns: int) -> SceneState:
        """Return the geometry and the light at a time.

        Raises:
            OrbitError: an orbit cannot be propagated so far, or the time is outside the ephemeris.
            ValueError: the camera's roll is undefined, or a tumble is not known at that time.
        """
        target, chaser = self.orbits_at(utc_ns)
        relative_m = chaser.position_m - target.position_m
        gcrs_to_camera = look_along(-relative_m, down=-np.cross(chaser.position_m, chaser.velocity_m_s))
        gcrs_to_body = self.gcrs_to_body(utc_ns)
        sun = sun_direction_gcrs(utc_ns)
        range_m = float(np.linalg.norm(relative_m))
        sunlit = sunlit_fraction(target.position_m, utc_ns)
        radial = target.position_m / np.linalg.norm(target.position_m)
        normal = np.cross(target.position_m, target.velocity_m_s)
        normal /= np.linalg.norm(normal)
        pose = PoseTag(
            quat_body_to_camera=matrix_to_quat(gcrs_to_camera @ gcrs_to_body.T),
            position_body_m=gcrs_to_body @ relative_m,
            covariance=self._covariance,
            sun_dir_body=gcrs_to_body @ sun,
            in_eclipse=sunlit < 0.5,
            valid=True,
            source="truth",
            quat_inertial_to_body=matrix_to_quat(gcrs_to_body),
        )
        return SceneState(
            utc_ns=utc_ns,
            target=target,
            chaser=chaser,
            pose=pose,
            gcrs_to_camera=gcrs_to_camera,
            earth_dir_body=gcrs_to_body @ -radial,
            relative_rtn_m=np.stack([radial, np.cross(normal, radial), normal]) @ relative_m,
            range_m=range_m,
            phase_angle_rad=float(np.arccos(np.clip(relative_m @ sun / range_m, -1, 1))),
            sunlit=sunlit,
        )


def describe(scenario: Scenario) -> dict:
    """Return a scenario's range, phase angle, eclipses and motion of the Sun in body axes over its brackets.

    For a designed chaser also how closely its TLE follows the linear solution that it was designed with.
    """
    scene, start_ns = Scene(scenario), scenario.orbit.start_utc_ns
    times_s = np.linspace(0.0, scenario.duration_s, scenario.brackets)
    states = [scene.state(start_ns + round(t * 1e9)) for t in times_s]
    ranges = [state.range_m for state in states]
    phases = [math.degrees(state.phase_angle_rad) for state in states]
    suns = np.array([state.pose.sun_dir_body for state in states])
    facts = {
        "description": scenario.description,
        "brackets": len(states),
        "duration_s": scenario.duration_s,
        "range_m": [round(min(ranges), 1), round(max(ranges), 1)],
        "phase_angle_deg": [round(min(phases), 1), round(max(phases), 1)],
        "brackets_in_eclipse": sum(state.pose.in_eclipse for state in states),
        "sun_moves_deg": round(float(np.degrees(np.arccos(np.clip(suns @ suns[0], -1, 1)).max())), 2),
        "chaser_tle": list(scene.orbit.chaser_tle),
    }
    made = scenario.design
    if made is not None:
        facts |= {
            name: round(getattr(made, name), 3)
            for name in ("error_rms_m", "error_max_m", "unrounded_error_max_m", "drift_error_m_per_orbit")
        }
    return facts


def ready_made(name: str | Path, folder: Path, what: str) -> tuple[Path, bytes]:
    """Return the path and content of a YAML file: by its name in a folder of ready-made ones, or by its own path.

    Args:
        what: what the file holds, for the message.

    Raises:
        ConfigError: it cannot be read; the message lists the ready-made ones.
    """
    path = folder / f"{name}.yaml"
    if not path.is_file():
        path = Path(name)
    try:
        return path, read_bounded(path, MAX_YAML_BYTES)
    except OSError as error:
        names = ", ".join(sorted(p.stem for p in folder.glob("*.yaml")))
        raise ConfigError(str(name), f"no such {what}: expected a YAML file or one of {names}") from error


def load_scenario(name: str | Path) -> Scenario:
    """Return a ready-made scenario by its name, or the one in a YAML file.

    Raises:
        ConfigError: no such scenario, or the file is wrong; the message names the file and the key's path.
    """
    path, content = ready_made(name, SCENARIOS, "scenario")
    with in_file(path):
        tree = parse_yaml(content, "scenario")
        return build(Scenario, tree, "scenario", sha256=hashlib.sha256(content).hexdigest())
