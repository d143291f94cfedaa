"""What is true in a simulated pass, and what flight is told of it: a mission file and a navigation stream."""

import dataclasses
import functools
import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import yaml
from scipy.spatial.transform import Rotation

from flightsw.icd.frame import PoseTag
from flightsw.icd.mission import Mission, NavigationSection, PoseSection, TargetAttitudeSection
from flightsw.icd.quaternion import matrix_to_quat, quat_to_matrix
from flightsw.orbit import propagate
from flightsw.pose import look_along, pose_tag, target_attitude
from hil.world.scenario import Scenario, Sky, load_scenario

NS = 1_000_000_000
MARGIN_S = 10.0  # navigation goes on so long after the last exposure
CORRELATION_S = 60.0  # of navigation errors: a filter's do not jump from state to state


@dataclass(frozen=True)
class World:
    """The truth of a pass; times are UTC ns."""

    mission: Mission
    pose_at: Callable[[int], PoseTag]  # the true camera
    gcrs_to_body: Callable[[int], np.ndarray]  # [3, 3] the target's attitude


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
    sky = Sky(loaded)
    return World(scenario_mission(mission, loaded), lambda ns: sky.state(ns).pose, sky.gcrs_to_body)


def scenario_mission(mission: Mission, scenario: Scenario) -> Mission:
    """Return the mission flown in a scenario: its orbits, start, field of view and spread of brackets.

    Never more brackets than the scenario has. The scenario's camera stands in the chaser's centre of mass. How the
    target turns is left out: flight has it from navigation.
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


def write_flight_inputs(world: World, folder: Path, noise_seed: int | None = None) -> Path:
    """Write the world's mission and a navigation stream for it, and return the mission file.

    The states are those of a filter that knows both orbits, the chaser's attitude and the target's, twice in the
    mission's `max_gap_s`. With a seed they carry errors of the mission's sigmas, correlated over a minute.
    """
    folder.mkdir(parents=True, exist_ok=True)
    stream, path = folder.resolve() / "navigation.jsonl", folder / "mission.yaml"
    section = dataclasses.replace(world.mission.navigation, source=f"file://{stream}")
    stream.write_text("".join(json.dumps(state) + "\n" for state in _states(world, section, noise_seed)))
    tree = dataclasses.asdict(dataclasses.replace(world.mission, navigation=section))
    del tree["sha256"]  # of the file itself
    path.write_text(yaml.safe_dump(tree, sort_keys=False))
    return path


def _states(world: World, section: NavigationSection, noise_seed: int | None):
    """Yield the navigation states of a pass (flightsw/navigation.py), first-order Gauss-Markov errors included."""
    mission, bracket = world.mission, world.mission.bracket
    chaser_to_camera = quat_to_matrix(np.array(mission.pose.quat_chaser_to_camera))
    sigmas = np.repeat([mission.pose.sigma_position_m, np.radians(mission.pose.sigma_attitude_deg)], 3)
    rng = np.random.default_rng(noise_seed)
    step_s = section.max_gap_s / 2
    kept = np.exp(-step_s / CORRELATION_S)
    error = np.zeros(6) if noise_seed is None else sigmas * rng.standard_normal(6)
    frames = 16 if bracket.auto else len(bracket.exposure_times_ms)
    pass_s = (bracket.count - 1) * bracket.interval_s + frames * bracket.frame_spacing_s + MARGIN_S
    for number in range(int(np.ceil(pass_s / step_s)) + 1):
        utc_ns = mission.orbit.start_utc_ns + round(number * step_s * NS)
        target = propagate(mission.orbit.target_tle, utc_ns)
        chaser = propagate(mission.orbit.chaser_tle, utc_ns)
        relative_m = chaser.position_m - target.position_m
        gcrs_to_camera = look_along(-relative_m, down=-np.cross(chaser.position_m, chaser.velocity_m_s))
        gcrs_to_body = world.gcrs_to_body(utc_ns)
        # the tag's two errors, independent as its covariance says: position (body), rotation (camera)
        seen_body_m = gcrs_to_body @ relative_m + error[:3]
        turn = Rotation.from_rotvec(error[3:]).as_matrix()
        believed_to_body = gcrs_to_body @ gcrs_to_camera.T @ turn.T @ gcrs_to_camera
        yield {
            "utc_ns": utc_ns,
            "target": {
                "position_m": target.position_m.tolist(),
                "velocity_m_s": target.velocity_m_s.tolist(),
                "quat_gcrs_to_body": matrix_to_quat(believed_to_body).tolist(),
            },
            "chaser": {
                "position_m": (target.position_m + believed_to_body.T @ seen_body_m).tolist(),
                "velocity_m_s": chaser.velocity_m_s.tolist(),
                "quat_gcrs_to_chaser": matrix_to_quat(chaser_to_camera.T @ gcrs_to_camera).tolist(),
            },
        }
        if noise_seed is not None:
            error = kept * error + np.sqrt(1 - kept**2) * sigmas * rng.standard_normal(6)
