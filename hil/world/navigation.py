"""What flight is given of a simulated pass: a mission file and a stream of navigation states, with errors or exact."""

import dataclasses
import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import yaml
from scipy.spatial.transform import Rotation

from flightsw.icd.mission import NavigationSection
from flightsw.icd.quaternion import matrix_to_quat, quat_to_matrix
from flightsw.orbit import propagate
from flightsw.pose import look_along
from hil.world.world import World

NS = 1_000_000_000
MARGIN_S = 10.0  # the states end so long after the last exposure
CORRELATION_S = 60.0  # of navigation errors: those of a filter change slowly from state to state


def write_flight_inputs(world: World, folder: Path, noise_seed: int | None = None) -> Path:
    """Write the world's mission with its navigation states into a folder, and return the path of the mission file.

    Each state holds both orbits and both attitudes; two of them come in the mission's `max_gap_s`. With a seed they
    have random errors with the mission's sigmas, correlated over a minute.
    """
    folder.mkdir(parents=True, exist_ok=True)
    stream, path = folder.resolve() / "navigation.jsonl", folder / "mission.yaml"
    section = dataclasses.replace(world.mission.navigation, source=f"file://{stream}")
    stream.write_text("".join(json.dumps(state) + "\n" for state in _states(world, section, noise_seed)))
    tree = dataclasses.asdict(dataclasses.replace(world.mission, navigation=section))
    del tree["sha256"]  # of the file itself
    path.write_text(yaml.safe_dump(tree, sort_keys=False))
    return path


def _states(world: World, section: NavigationSection, noise_seed: int | None) -> Iterator[dict]:
    """Yield the navigation states of a pass, in the format that flightsw/navigation.py reads.

    Errors are a first-order Gauss-Markov process (Gelb, Applied Optimal Estimation, 1974) in position and rotation.
    """
    mission, bracket = world.mission, world.mission.bracket
    chaser_to_camera = quat_to_matrix(np.array(mission.pose.quat_chaser_to_camera))
    sigmas = np.repeat([mission.pose.sigma_position_m, np.radians(mission.pose.sigma_attitude_deg)], 3)
    rng = np.random.default_rng(noise_seed)
    step_s = section.max_gap_s / 2
    correlation = np.exp(-step_s / CORRELATION_S)  # of the errors of one state and the next
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
        # Independent errors, in the frames of the tag's covariance: position in body axes, rotation in camera axes.
        estimated_body_m = gcrs_to_body @ relative_m + error[:3]
        turn = Rotation.from_rotvec(error[3:]).as_matrix()
        estimated_gcrs_to_body = gcrs_to_body @ gcrs_to_camera.T @ turn.T @ gcrs_to_camera
        yield {
            "utc_ns": utc_ns,
            "target": {
                "position_m": target.position_m.tolist(),
                "velocity_m_s": target.velocity_m_s.tolist(),
                "quat_gcrs_to_body": matrix_to_quat(estimated_gcrs_to_body).tolist(),
            },
            "chaser": {
                "position_m": (target.position_m + estimated_gcrs_to_body.T @ estimated_body_m).tolist(),
                "velocity_m_s": chaser.velocity_m_s.tolist(),
                "quat_gcrs_to_chaser": matrix_to_quat(chaser_to_camera.T @ gcrs_to_camera).tolist(),
            },
        }
        if noise_seed is not None:
            error = correlation * error + np.sqrt(1 - correlation**2) * sigmas * rng.standard_normal(6)
