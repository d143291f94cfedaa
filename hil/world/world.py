"""True states and poses of a simulated pass, of a scenario or the mission's orbits; camera and navigation read them."""

import dataclasses
import functools
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from flightsw.icd.frame import Attitude as Knowledge
from flightsw.icd.frame import PoseTag
from flightsw.icd.mission import Mission, PoseSection, TargetAttitudeSection
from flightsw.navigation.orbit import OrbitState
from flightsw.navigation.pose import pose_tag, target_attitude
from hil.world.attitude import Attitude
from hil.world.scenario import Scenario, Scene, load_scenario, sgp4_orbits


@dataclass(frozen=True)
class World:
    """The truth of a pass, as functions of the time in UTC ns."""

    mission: Mission  # what flight is given: it may know less of the target's attitude than this world does
    pose_at: Callable[[int], PoseTag]  # of the camera
    orbits_at: Callable[[int], tuple[OrbitState, OrbitState]]  # of target and chaser
    attitude_if: Callable[
        [float], Attitude
    ]  # of the target, if its rate at the start were larger by this share

    @functools.cached_property
    def gcrs_to_body(self) -> Attitude:
        """The target's attitude [3, 3] as a function of UTC ns."""
        return self.attitude_if(0.0)


def load_world(mission: Mission, scenario: str = "") -> World:
    """Return the world of a scenario (a ready-made one or a YAML file), or of the mission's own orbits and attitude.

    Raises:
        ConfigError: no such scenario, or it is wrong.
    """
    if not scenario:
        known = dataclasses.replace(mission.target_attitude, knowledge="known")
        true_mission = dataclasses.replace(mission, target_attitude=known)

        def spinning(share: float) -> Attitude:
            section = dataclasses.replace(known, period_s=known.period_s / (1 + share))
            return functools.partial(
                target_attitude, dataclasses.replace(true_mission, target_attitude=section)
            )

        orbits_at = functools.partial(sgp4_orbits, mission.orbit)
        return World(mission, functools.partial(pose_tag, true_mission), orbits_at, spinning)
    loaded = load_scenario(scenario)
    scene, section = Scene(loaded), loaded.attitude

    def turning(share: float) -> Attitude:
        rates = tuple(rate * (1 + share) for rate in section.rates_deg_s)
        faster = dataclasses.replace(section, rates_deg_s=rates, period_s=section.period_s / (1 + share))
        return scene.attitude_of(faster)

    return World(scenario_mission(mission, loaded), lambda ns: scene.state(ns).pose, scene.orbits_at, turning)


def told(mission: Mission, knowledge: Knowledge | None) -> Mission:
    """Return the mission of a flight that knows so much of the target's attitude; None: what the mission says."""
    if knowledge is None:
        return mission
    section = dataclasses.replace(mission.target_attitude, knowledge=knowledge)
    return dataclasses.replace(mission, target_attitude=section)


def scenario_mission(mission: Mission, scenario: Scenario) -> Mission:
    """Return the mission with a scenario's orbits, start, field of view and bracket times.

    It has no more brackets than the scenario, and its camera is in the chaser's centre of mass. The target's attitude
    is left out: flight receives it in the navigation states, if at all.
    """
    count = min(mission.bracket.count, scenario.brackets)
    tight = mission.bracket.frame_spacing_s is not None
    spread = scenario.bracket_section(mission.bracket.exposure_times_ms, count, tight)
    focal_px = mission.camera.width / 2 / np.tan(np.radians(scenario.fov_deg) / 2)
    at_centre = PoseSection()
    return dataclasses.replace(
        mission,
        orbit=dataclasses.replace(scenario.orbit, max_element_age_days=mission.orbit.max_element_age_days),
        target_attitude=TargetAttitudeSection(knowledge=mission.target_attitude.knowledge),
        camera=dataclasses.replace(mission.camera, fx_px=float(focal_px), fy_px=float(focal_px)),
        bracket=dataclasses.replace(
            mission.bracket,
            frame_spacing_s=spread.frame_spacing_s,
            interval_s=spread.interval_s,
            count=spread.count,
        ),
        pose=dataclasses.replace(
            mission.pose,
            quat_chaser_to_camera=at_centre.quat_chaser_to_camera,
            camera_position_m=at_centre.camera_position_m,
        ),
    )
