"""Conditions of the benchmark `poses` in which nobody knows the target's attitude: it is found from the frames alone.

The rotation starts in another attitude for each seed; 15 brackets a turn. Camera attitude and relative
position are exact, as is everything that `psnr_exact_db` is trained with.
"""

import dataclasses
import time
from pathlib import Path

import numpy as np
import torch

from hil.world.attitude import AttitudeSection
from hil.world.scenario import Scenario, load_scenario
from obbgs_base.physics.free_rotation import free_rotation
from obbgs_base.physics.navigation_errors import NominalMotion
from obbgs_core.attitude.estimate import AttitudeUndetermined, estimate_motion
from obbgs_core.attitude.target_motion import TargetMotion
from obbgs_core.frames import Navigation, TrainingFrame
from obbgs_core.methods.config import MethodConfig
from obbgs_core.train import train
from tests.benchmarks import passes, poses

BRACKETS, DURATION_S = 100, 1950.0  # 15 brackets a turn of 293 s
SPIN = AttitudeSection(mode="spin", period_s=293.0)
CONDITIONS = ("unknown_attitude_tumbling", "unknown_attitude_spin")


def scenario(condition: str, seed: int) -> Scenario:
    """Return the scenario `tumbling` as it is, or spinning, from another attitude, for a shorter time."""
    stock = load_scenario("tumbling")
    section = stock.attitude if condition == CONDITIONS[0] else SPIN
    axis = np.random.default_rng([seed, 19]).standard_normal(3)
    turned = dataclasses.replace(section, axis=tuple((axis / np.linalg.norm(axis)).tolist()))
    return dataclasses.replace(stock, duration_s=DURATION_S, attitude=turned)


def row(
    condition: str, target: int | Path, size_px: int, config: MethodConfig, seed: int
) -> dict[str, float | str]:
    """Return the scores of a condition, with those of exact poses and the errors of axis and rate."""
    seen = passes.photographed(target, scenario(condition, seed), BRACKETS, size_px, seed)
    exact_db = poses.scored(seen, "exact", config, seed)["psnr_clean_db"]
    began = time.process_time()
    trained, _ = poses.divided(seen)
    epoch_s = seen.motion.times_s[trained].mean()
    times_s = seen.motion.times_s - epoch_s
    try:
        found = estimate_motion([inertial(seen)[i] for i in trained], times_s[trained], passes.SENSOR)
    except AttitudeUndetermined as error:
        return {"psnr_exact_db": exact_db, "undetermined": str(error)}
    searched_s = time.process_time() - began
    frames = in_found_axes(seen, found, times_s)
    always = dataclasses.replace(config, poses=dataclasses.replace(config.poses, refine="always"))
    result = train([frames[i] for i in trained], passes.SENSOR, always, seed)
    cpu_s = time.process_time() - began  # of search and training
    assert result.pose_estimate is not None
    refined = found.refined(result.pose_estimate)
    figures = poses.scores(turned(seen, found.inertial_to_body(times_s)), frames, result)
    errors = {"": rotation_errors(refined, seen.motion, epoch_s)}
    errors["outlines_"] = rotation_errors(found, seen.motion, epoch_s)
    named = {f"{prefix}{key}": value for prefix, of in errors.items() for key, value in of.items()}
    seconds = {"search_seconds": searched_s, "cpu_seconds": cpu_s}
    return figures | named | {"psnr_exact_db": exact_db} | seconds


def inertial(seen: passes.Pass) -> list[TrainingFrame]:
    """Return the frames with poses and Suns relative to inertial axes."""
    still = np.tile(np.eye(3), (len(seen.frames), 1, 1))
    return in_axes(seen, still)


def in_found_axes(seen: passes.Pass, found: TargetMotion, times_s: np.ndarray) -> list[TrainingFrame]:
    """Return the frames in the target's axes as found, with how far its rotation may err."""
    attitudes = found.inertial_to_body(times_s)
    navigation = Navigation(found.sigmas(), rate_rad_s=found.rate_body_rad_s, inertia=found.moments)
    return [
        dataclasses.replace(
            f,
            navigation=navigation,
            time_s=float(time_s),
            inertial_to_body=torch.from_numpy(attitude),
        )
        for f, time_s, attitude in zip(in_axes(seen, attitudes), times_s, attitudes, strict=True)
    ]


def in_axes(seen: passes.Pass, attitudes: np.ndarray) -> list[TrainingFrame]:
    """Return the frames in the axes of a body with attitudes [N, 3, 3] (inertial to body), their Suns along."""
    poses_of = dataclasses.replace(seen.motion, inertial_to_body=attitudes).world_to_camera
    turns = torch.from_numpy(attitudes @ seen.motion.inertial_to_body.transpose(0, 2, 1)).float()
    return [
        dataclasses.replace(
            f,
            world_to_camera=torch.from_numpy(pose).float(),
            sun_dir=None if f.sun_dir is None else turn @ f.sun_dir,
        )
        for f, pose, turn in zip(seen.frames, poses_of, turns, strict=True)
    ]


def turned(seen: passes.Pass, attitudes: np.ndarray) -> passes.Pass:
    """Return the true pass in the axes that found attitudes [N, 3, 3] are given in: the turn that suits them best."""
    u, _, v = np.linalg.svd((attitudes @ seen.motion.inertial_to_body.transpose(0, 2, 1)).sum(axis=0))
    turn = u @ np.diag([1.0, 1.0, np.linalg.det(u @ v)]) @ v
    motion = dataclasses.replace(seen.motion, inertial_to_body=turn @ seen.motion.inertial_to_body)
    return dataclasses.replace(
        seen, frames=in_axes(seen, motion.inertial_to_body), motion=motion, cloud_m=seen.cloud_m @ turn.T
    )


def rotation_errors(motion: TargetMotion, true: NominalMotion, epoch_s: float) -> dict[str, float]:
    """Return the errors of the angular momentum's axis and of the rate at an epoch, with their stated deviations."""
    momentum = true.inertial_to_body[0].T @ (true.inertia * true.rate_rad_s)
    axis = momentum / np.linalg.norm(momentum)
    _, rates = free_rotation(np.array([epoch_s]), true.rate_rad_s[None], true.inertia[None])
    rate_deg_s = np.degrees(np.linalg.norm(rates[0, 0]))
    facts = motion.facts()
    found = np.array(facts["axis_inertial"])
    angle = np.arctan2(np.linalg.norm(np.cross(found, axis)), found @ axis)
    return {
        "axis_error_deg": float(np.degrees(angle)),
        "axis_sigma_deg": facts["axis_sigma_deg"],
        "rate_error_percent": float(100 * (facts["rate_deg_s"] / rate_deg_s - 1)),
        "rate_sigma_percent": float(100 * facts["rate_sigma_deg_s"] / rate_deg_s),
    }
