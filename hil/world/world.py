"""True states and poses of a simulated pass, of a scenario or the mission's orbits; camera and navigation read them."""

import dataclasses
import functools
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from flightsw.icd.frame import PoseTag
from flightsw.icd.mission import Mission, PoseSection, TargetAttitudeSection
from flightsw.pose import pose_tag, target_attitude
from hil.world.scenario import Scenario, Scene, load_scenario


@dataclass(frozen=True)
class World:
    """The truth of a pass, as functions of the time in UTC ns."""

    mission: Mission
    pose_at: Callable[[int], PoseTag]  # of the camera
    gcrs_to_body: Callable[[int], np.ndarray]  # [3, 3] attitude of the target


def load_world(mission: Mission, scenario: str = "") -> World:
    """Return the world of a scenario (a ready-made one or a YAML file), or of the mission's own orbits and attitude.

    Raises:
        ConfigError: no such scenario, or it is wrong.
    """
    if not scenario:
        return World(
            mission, functools.partial(pose_tag, mission), functools.partial(target_attitude, mission)
        )
    loaded = load_scenario(scenario)
    scene = Scene(loaded)
    return World(scenario_mission(mission, loaded), lambda ns: scene.state(ns).pose, scene.gcrs_to_body)


def scenario_mission(mission: Mission, scenario: Scenario) -> Mission:
    """Return the mission with a scenario's orbits, start, field of view and bracket times.

    It has no more brackets than the scenario, and its camera is in the chaser's centre of mass. The target's attitude
    is left out: flight receives it in the navigation states.
    """
    count = min(mission.bracket.count, scenario.brackets)
    spread = scenario.bracket_section(mission.bracket.exposure_times_ms, count)
    focal_px = mission.camera.width / 2 / np.tan(np.radians(scenario.fov_deg) / 2)
    at_centre = PoseSection()
    return dataclasses.replace(
        mission,
        orbit=dataclasses.replace(scenario.orbit, max_element_age_days=mission.orbit.max_element_age_days),
        target_attitude=TargetAttitudeSection(),
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
