"""What flight is given of a simulated pass: a mission file and a stream of navigation states, with errors or exact."""

import dataclasses
import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import yaml
from scipy.spatial.transform import Rotation

from flightsw.icd.config import MAX_YAML_BYTES, ConfigError, parse_yaml
from flightsw.icd.mission import Mission, NavigationSection
from flightsw.icd.quaternion import matrix_to_quat, quat_to_matrix
from flightsw.icd.tle import orbit_axes
from flightsw.navigation.orbit import OrbitState
from flightsw.navigation.pose import look_along
from hil.world.navigation_errors import NOISE_DEG, NavigationErrors, draw, stated_sigmas, turned
from hil.world.world import World
from obbgs_base.files import read_bounded, write_whole

NS = 1_000_000_000
MARGIN_S = 10.0  # the states end so long after the last exposure


@dataclass(frozen=True)
class FlightInputs:
    """What was written for flight: the mission file, and what its navigation errs by; None: by nothing."""

    mission_path: Path
    errors: NavigationErrors | None


def write_flight_inputs(world: World, folder: Path, seed: int | None) -> FlightInputs:
    """Write the world's mission with its navigation states into a folder.

    Each state holds both orbits and the chaser's attitude, and the target's as far as the mission says that it is
    known; two of them come in the mission's `max_gap_s`. With a seed they have random errors
    (`hil.world.navigation_errors`), and the mission file states their standard deviations.

    Raises:
        ConfigError: the folder holds a mission.yaml that this did not write.
    """
    folder.mkdir(parents=True, exist_ok=True)
    stream, path = folder.resolve() / "navigation.jsonl", folder / "mission.yaml"
    source = f"file://{stream}"
    if path.exists() and not _reads(path, source):
        problem = f"is not of an earlier run, whose navigation.source is {source}, and would be written over"
        raise ConfigError(str(path), f"{problem}: choose another folder")
    section = dataclasses.replace(world.mission.navigation, source=source)
    mission, errors = dataclasses.replace(world.mission, navigation=section), None
    if seed is not None:
        start_ns = mission.orbit.start_utc_ns
        range_m = float(np.linalg.norm(world.pose_at(start_ns).position_body_m))
        errors = draw(range_m, seed)
        mean_motion_rad_s, _ = orbit_axes(mission.orbit.target_tle, start_ns)
        stated = stated_sigmas(range_m, _rate_deg_s(world, start_ns), mean_motion_rad_s)
        pose = dataclasses.replace(mission.pose, sigma_attitude_deg=NOISE_DEG)
        mission = dataclasses.replace(mission, pose=pose, navigation_errors=stated)
    states = "".join(json.dumps(state) + "\n" for state in _states(world, section, errors, seed))
    write_whole(stream, states.encode())
    tree = dataclasses.asdict(mission)
    del tree["sha256"]  # of the file itself
    write_whole(path, yaml.safe_dump(tree, sort_keys=False).encode())
    return FlightInputs(path, errors)


def _reads(path: Path, source: str) -> bool:
    """Return whether a mission file has this navigation source."""
    try:
        return parse_yaml(read_bounded(path, MAX_YAML_BYTES), "mission")["navigation"]["source"] == source
    except (ConfigError, KeyError, TypeError):
        return False


def _rate_deg_s(world: World, utc_ns: int) -> np.ndarray:
    """Return the target's rate [3] about its body axes."""
    step_s = 0.5
    later = world.gcrs_to_body(utc_ns + round(step_s * NS))
    turn = Rotation.from_matrix(later @ world.gcrs_to_body(utc_ns).T)
    rate_deg_s = -np.degrees(turn.as_rotvec()) / step_s
    return np.where(np.abs(rate_deg_s) > 1e-9, rate_deg_s, 0.0)  # less is rounding


def _states(
    world: World, section: NavigationSection, errors: NavigationErrors | None, seed: int | None
) -> Iterator[dict]:
    """Yield the navigation states of a pass, in the format that flightsw/navigation/stream.py reads.

    The camera really points at the target; what errs is where navigation believes the chaser, the camera's axes and the
    target's to be, and at what time.
    """
    mission, start_ns = world.mission, world.mission.orbit.start_utc_ns
    chaser_to_camera = quat_to_matrix(np.array(mission.pose.quat_chaser_to_camera))
    gcrs_to_body = world.attitude_if(errors.spin_rate if errors else 0.0)
    knowledge = mission.target_attitude.knowledge
    # nobody told the filter the body's axes: it chose those that were inertial at the start
    free_axes = gcrs_to_body(start_ns).T if knowledge == "rate_only" else np.eye(3)
    step_s = section.max_gap_s / 2
    noise = _noise(mission, errors, seed)
    for number in range(int(np.ceil(_pass_s(mission) / step_s)) + 1):
        utc_ns = start_ns + round(number * step_s * NS)
        true_ns = utc_ns - round(errors.clock_s * NS) if errors else utc_ns
        target, chaser = world.orbits_at(true_ns)
        relative_m = chaser.position_m - target.position_m
        gcrs_to_camera = look_along(-relative_m, down=-np.cross(chaser.position_m, chaser.velocity_m_s))
        if errors:
            relative_m = relative_m + _position_error_m(errors, mission, target, true_ns)
            drawn = noise[round(number * step_s / _noise_spacing_s(mission))]
            gcrs_to_camera = turned(turned(gcrs_to_camera, errors.boresight_rad), drawn)
        state = {
            "utc_ns": utc_ns,
            "target": {
                "position_m": target.position_m.tolist(),
                "velocity_m_s": target.velocity_m_s.tolist(),
            },
            "chaser": {
                "position_m": (target.position_m + relative_m).tolist(),
                "velocity_m_s": chaser.velocity_m_s.tolist(),
                "quat_gcrs_to_chaser": matrix_to_quat(chaser_to_camera.T @ gcrs_to_camera).tolist(),
            },
        }
        if knowledge != "unknown":
            attitude = free_axes @ gcrs_to_body(true_ns)
            state["target"]["quat_gcrs_to_body"] = matrix_to_quat(attitude).tolist()
        yield state


def _pass_s(mission: Mission) -> float:
    bracket = mission.bracket
    frames = 16 if bracket.auto else len(bracket.exposure_times_ms)
    return (bracket.count - 1) * bracket.interval_s + frames * bracket.spacing_s(frames) + MARGIN_S


def _noise_spacing_s(mission: Mission) -> float:
    """Return how long the noise stays the same: from one bracket to the next, or exposure where they are spread."""
    bracket = mission.bracket
    return bracket.interval_s if bracket.frame_spacing_s is not None else bracket.spacing_s()


def _noise(mission: Mission, errors: NavigationErrors | None, seed: int | None) -> np.ndarray:
    """Return rotation vectors [N, 3] of the noise; the states half a spacing around an exposure share one."""
    count = int(_pass_s(mission) / _noise_spacing_s(mission)) + 2
    if errors is None:
        return np.zeros((count, 3))
    rng = np.random.default_rng([seed or 0, 1])  # another stream than that of the shared errors
    return errors.noise_rad * rng.standard_normal((count, 3))


def _position_error_m(
    errors: NavigationErrors, mission: Mission, target: OrbitState, utc_ns: int
) -> np.ndarray:
    """Return the error [3] of the chaser's position at a time, GCRS."""
    radial = target.position_m / np.linalg.norm(target.position_m)
    normal = np.cross(target.position_m, target.velocity_m_s)
    normal /= np.linalg.norm(normal)
    node = np.cross([0.0, 0.0, 1.0], normal)
    latitude_rad = np.arctan2(np.cross(node, radial) @ normal, node @ radial)
    mean_motion_rad_s, _ = orbit_axes(mission.orbit.target_tle, utc_ns)
    elapsed_s = (utc_ns - mission.orbit.start_utc_ns) / NS
    error_rtn_m = errors.position_rtn_m(float(latitude_rad), elapsed_s, mean_motion_rad_s)
    return np.stack([radial, np.cross(normal, radial), normal], axis=1) @ error_rtn_m
