"""How well trainings recover from errors of navigation: passes of the simulator's scenarios about a rendered target.

The target is a spacecraft of textured boxes that is cast ray by ray (`tests.benchmarks.passes`) from the true poses of
a scenario, with sensor noise, and the tags err as each condition says. A scenario's Sun is left out. Meshes are
rendered by Blender, with the Sun.

    python -m tests.benchmarks.poses --quick --json
    python -m tests.benchmarks.poses --quick --json --targets Aura.glb --conditions unknown_attitude_tumbling
"""

import argparse
import dataclasses
import itertools
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from ground.run.scores import ScoredView, clean_scores, cloud_scores
from ground.session.cameras import exposed
from hil.world.scenario import load_scenario
from obbgs_base.physics.navigation_errors import (
    NominalMotion,
    SharedParameters,
    displaced,
    displaced_motion,
    jacobian,
)
from obbgs_core.frames import Navigation, TrainingFrame, cameras_of
from obbgs_core.methods.config import MethodConfig
from obbgs_core.methods.presets import preset
from obbgs_core.model.motions import adjoints, motion_vectors, rigid_motions
from obbgs_core.poses.corrections import with_estimate
from obbgs_core.poses.estimate import PoseEstimate
from obbgs_core.poses.gauge import best_motion, seen_after, size_of
from obbgs_core.render import render
from obbgs_core.score.poses import pose_errors, settled_poses
from obbgs_core.train import train
from obbgs_core.train.result import TrainResult
from tests.benchmarks.passes import SENSOR, Pass, photographed
from tests.benchmarks.rows import shown
from tests.benchmarks.targets import LARGEST_DIMENSION

SCENARIOS = ("fly-around", "tumbling", "v-bar")
BY_BASILISK = ("fly-around-disturbed", "tumbling-disturbed", "v-bar-drag")  # need the extra basilisk
TARGETS_HELP = "seeds of bodies of boxes, or meshes, which Blender renders under the scenario's Sun"
FACTORS = {"correlated_1": 1.0, "correlated_3": 3.0, "correlated_10": 10.0}


def shared_errors(seen: Pass, factor: float, seed: int) -> tuple[SharedParameters, SharedParameters]:
    """Return errors of boresight, relative orbit, rate and clock, times a factor, and their stated deviations."""
    rng = np.random.default_rng([seed, 16])

    def drawn(length: float) -> np.ndarray:
        direction = rng.standard_normal(3)
        return length * direction / np.linalg.norm(direction)

    boresight, position = np.radians(0.3), 0.02 * seen.range_m
    rate, clock = np.radians(1.0) / seen.span_s, 0.05
    velocity = position * seen.motion.mean_motion_rad_s
    errors = SharedParameters(
        position_m=factor * drawn(position),
        velocity_m_s=factor * drawn(0.3 * velocity),
        rate_rad_s=factor * drawn(rate),
        boresight_rad=factor * drawn(boresight),
        clock_s=np.array([factor * rng.choice([-clock, clock])]),
    )
    sigmas = SharedParameters(
        position_m=np.full(3, factor * position),
        velocity_m_s=np.full(3, factor * velocity),
        rate_rad_s=np.full(3, factor * rate),
        boresight_rad=np.full(3, factor * boresight),
        clock_s=np.array([factor * clock]),
    )
    return errors, sigmas


def correlated(seen: Pass, factor: float, seed: int) -> list[TrainingFrame]:
    """Return the frames with tags that err together (`shared_errors`), and a little by themselves."""
    errors, sigmas = shared_errors(seen, factor, seed)
    tagged = displaced_motion(seen.motion, errors)
    return with_tags(seen, tagged, sigmas, own_deg=0.01, own_m=5e-5 * seen.range_m, seed=seed)


def errors_in_deviations(
    seen: Pass, errors: SharedParameters, estimate: PoseEstimate
) -> dict[str, float | list[float]]:
    """Return how far the estimated shared parameters are from the true ones, in the deviations that are stated.

    The true ones lead from the tags' poses back to the true poses, but for each bracket's own errors.
    """
    tagged, true = displaced_motion(seen.motion, errors), torch.from_numpy(seen.motion.world_to_camera)
    prior, at = estimate.shared_prior.vector(), -errors.vector()
    free = prior > 0
    for _ in range(3):
        now = torch.from_numpy(displaced(tagged, at))
        left = motion_vectors(true @ torch.linalg.inv(now)).numpy()
        scale = np.repeat([1, seen.range_m], 3)[:, None]
        columns = (jacobian(tagged, SharedParameters.of(at)) * prior / scale)[:, :, free]
        change, *_ = np.linalg.lstsq(columns.reshape(-1, columns.shape[2]), (left / scale[:, 0]).ravel())
        at[free] += prior[free] * change
    off = ((estimate.shared.vector() - at) / estimate.shared_posterior.vector().clip(1e-300))[free]
    return {"deviations": off.round(2).tolist(), "within_3_deviations": float(np.mean(np.abs(off) < 3))}


def with_tags(
    seen: Pass, tagged: NominalMotion, sigmas: SharedParameters, own_deg: float, own_m: float, seed: int
) -> list[TrainingFrame]:
    """Return the frames with the poses of a motion, each bracket with errors of its own, and what the tags state."""
    navigation = Navigation(
        sigmas, tagged.mean_motion_rad_s, tagged.inertial_to_rtn, tagged.rate_rad_s, tagged.inertia
    )
    sigma = torch.tensor([np.radians(own_deg)] * 3 + [own_m] * 3, dtype=torch.float64)
    rng = np.random.default_rng([seed, 17])
    count = max(f.bracket or 0 for f in seen.frames) + 1
    own = rigid_motions(torch.from_numpy(rng.standard_normal((count, 6))) * sigma)
    poses = torch.from_numpy(tagged.world_to_camera)
    return [
        dataclasses.replace(
            f,
            world_to_camera=(own[f.bracket] @ poses[i]).float(),
            pose_covariance=torch.diag(sigma**2),
            navigation=navigation,
            time_s=float(tagged.times_s[i]),
            inertial_to_body=torch.from_numpy(tagged.inertial_to_body[i]),
        )
        for i, f in enumerate(seen.frames)
    ]


def stated(seen: Pass, degrees: float) -> list[TrainingFrame]:
    """Return the frames with exact poses whose tags state an error: degrees, and 1.67 % of the size a degree."""
    sigma = torch.tensor([np.radians(degrees)] * 3 + [degrees / 60 * seen.size_m] * 3, dtype=torch.float64)
    return [dataclasses.replace(f, pose_covariance=torch.diag(sigma**2)) for f in seen.frames]


def independent(seen: Pass, degrees: float, seed: int) -> list[TrainingFrame]:
    """Return the frames with each bracket's target turned at random about its origin, and tags that state it."""
    rng, frames = np.random.default_rng([seed, 18]), []
    turns = torch.from_numpy(np.radians(degrees) * rng.standard_normal((len(seen.frames), 3)))
    for f in seen.frames:
        by_turn = adjoints(f.world_to_camera[None].double())[0][:, :3]  # of the body about its origin
        motion = rigid_motions((by_turn @ turns[f.bracket or 0])[None])[0].float()
        covariance = np.radians(degrees) ** 2 * by_turn @ by_turn.T
        pose = motion @ f.world_to_camera
        frames.append(dataclasses.replace(f, world_to_camera=pose, pose_covariance=covariance))
    return frames


def focal(seen: Pass, percent: float) -> list[TrainingFrame]:
    """Return the frames with exact poses and a focal length that is stated too long."""
    lens = seen.frames[0].K.clone()
    lens[[0, 1], [0, 1]] *= 1 + percent / 100
    return [dataclasses.replace(f, K=lens) for f in seen.frames]


CONDITIONS: dict[str, Callable[[Pass, int], list[TrainingFrame]]] = {
    "exact": lambda seen, seed: seen.frames,
    "stated_0.1": lambda seen, seed: stated(seen, 0.1),
    "stated_0.3": lambda seen, seed: stated(seen, 0.3),
    "stated_1": lambda seen, seed: stated(seen, 1.0),
    "stated_3": lambda seen, seed: stated(seen, 3.0),
    "focal_2": lambda seen, seed: focal(seen, 2.0),
    **{
        name: lambda seen, seed, factor=factor: correlated(seen, factor, seed)
        for name, factor in FACTORS.items()
    },
    "independent_0.1": lambda seen, seed: independent(seen, 0.1, seed),
    "independent_0.3": lambda seen, seed: independent(seen, 0.3, seed),
    "independent_1": lambda seen, seed: independent(seen, 1.0, seed),
}


def scored(seen: Pass, condition: str, config: MethodConfig, seed: int) -> dict:
    """Return the scores of a training on all brackets but every eighth, on which it is scored."""
    trained, _ = divided(seen)
    frames = CONDITIONS[condition](seen, seed)
    began = time.process_time()
    result = train([frames[i] for i in trained], SENSOR, config, seed)
    figures = {"cpu_seconds": time.process_time() - began} | scores(seen, frames, result)
    if condition in FACTORS and result.pose_estimate is not None:
        errors, _ = shared_errors(seen, FACTORS[condition], seed)
        figures |= errors_in_deviations(seen, errors, result.pose_estimate)
    return figures


def divided(seen: Pass) -> tuple[list[int], list[int]]:
    """Return the indices of the frames for training and of those that are held out."""
    held_out = set(seen.held_out)
    return [i for i in range(len(seen.frames)) if i not in held_out], seen.held_out


def scores(seen: Pass, frames: list[TrainingFrame], result: TrainResult) -> dict[str, float | str]:
    """Return the scores on held-out brackets of a training on the others of `frames`."""
    trained, held_out = divided(seen)
    true, radius_m = torch.stack([f.world_to_camera for f in seen.frames]), seen.size_m / 2
    found, tags = result.pose_estimate, [frames[i] for i in held_out]
    estimated = torch.stack([frames[i].world_to_camera for i in trained])
    if found is not None:
        estimated, tags, trained = (
            torch.from_numpy(found.estimated),
            with_estimate(tags, found),
            found.frame_ids,  # without those that were left out
        )
    motion = best_motion(estimated, true[trained], radius_m)
    similarity = best_motion(estimated, true[trained], radius_m, with_size=True)
    focal_px = seen.frames[0].K[0, 0].item()
    errors, sized = (
        pose_errors(estimated, true[trained], m, radius_m, focal_px) for m in (motion, similarity)
    )
    settled = settled_poses(result.gaussians, tags, SENSOR) if found is not None else true[held_out]

    def clean_db(poses: torch.Tensor) -> float:
        views = []
        for i, pose in zip(held_out, poses, strict=True):
            frame = dataclasses.replace(seen.frames[i], world_to_camera=pose, K=frames[i].K)
            with torch.no_grad():
                radiance = render(result.gaussians, cameras_of([frame])).radiance[0]
            pair = (exposed(r, SENSOR, frame.exposure_time_s) for r in (radiance, seen.radiance[i]))
            views.append(ScoredView(*pair, seen.alpha[i], frame.exposure_time_s))
        return clean_scores(views)["psnr_clean_db"]

    means = result.gaussians.means.double().numpy() @ motion[:3, :3].numpy().T + motion[:3, 3].numpy()
    cloud = cloud_scores({"": means}, seen.cloud_m, LARGEST_DIMENSION / seen.size_m)
    return {
        "psnr_clean_db": clean_db(seen_after(true[held_out].double(), motion).float()),
        "psnr_similarity_db": clean_db(seen_after(true[held_out].double(), similarity).float()),
        "psnr_settled_db": clean_db(settled),
        "chamfer": cloud["chamfer"],
        "pose_error_deg": errors.rotation_deg,
        "pose_error_range": errors.range_share,
        "pose_error_px": errors.pixels,
        "similarity_pose_error_deg": sized.rotation_deg,
        "similarity_pose_error_range": sized.range_share,
        "similarity_pose_error_px": sized.pixels,
        "size_error_percent": 100 * (1 / size_of(similarity) - 1),
        "chi2": result.history[-1].chi2,
        "gaussians": len(result.gaussians),
        "seconds": result.seconds,
        "poses": result.poses,
    }


def target_of(argument: str) -> int | Path:
    """Return the seed of a body or the path of a mesh.

    Raises:
        argparse.ArgumentTypeError: it is neither a number nor a file.
    """
    if argument.isdigit():
        return int(argument)
    if not Path(argument).is_file():
        raise argparse.ArgumentTypeError(
            f"expected the seed of a body or the file of a mesh, got {argument!r}"
        )
    return Path(argument)


def main() -> None:
    from tests.benchmarks import unknown_attitude  # which builds on this module

    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--quick", action="store_true", help="one seed, 100x100 pixels, 49 brackets, 600 steps"
    )
    parser.add_argument(
        "--targets", nargs="+", type=target_of, default=[0], help=f"{TARGETS_HELP}; default: 0"
    )
    names = (*SCENARIOS, *BY_BASILISK)
    parser.add_argument("--scenarios", nargs="+", choices=names, help="default: the first three")
    known = [*CONDITIONS, *unknown_attitude.CONDITIONS]
    parser.add_argument("--conditions", nargs="+", choices=known, help="default: all")
    parser.add_argument("--seeds", nargs="+", type=int, help="default: 0 to 4, or 0 with --quick")
    parser.add_argument("--json", action="store_true", help="print rows as JSON lines")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    size_px, brackets, seeds = (100, 49, [0]) if arguments.quick else (200, 121, range(5))
    config = preset("obbgs", {"steps": 600} if arguments.quick else {})
    conditions = arguments.conditions or known
    seeds = arguments.seeds or seeds

    def show(condition: str, scenario: str, target: int | Path, seed: int, figures: dict) -> None:
        name = target.stem if isinstance(target, Path) else f"boxes-{target}"
        row = {"condition": condition, "scenario": scenario, "target": name, "seed": seed}
        if not arguments.quick:
            row["size_px"] = size_px
        print(shown(row | figures, "poses", arguments.json), flush=True)

    for target, scenario, seed in itertools.product(
        arguments.targets, arguments.scenarios or SCENARIOS, seeds
    ):
        chosen = [condition for condition in CONDITIONS if condition in conditions]
        if arguments.quick and not arguments.conditions and scenario != SCENARIOS[0]:
            chosen = ["correlated_1"]
        if not chosen:
            continue
        seen = photographed(target, load_scenario(scenario), brackets, size_px, seed)
        exact_db = float("nan")
        for condition in dict.fromkeys(["exact", *chosen]):
            figures = scored(seen, condition, config, seed)
            if condition == "exact":
                exact_db = figures["psnr_clean_db"]
            show(condition, scenario, target, seed, figures | {"psnr_exact_db": exact_db})
    for target, seed in itertools.product(arguments.targets, seeds):
        for condition in (c for c in unknown_attitude.CONDITIONS if c in conditions):
            figures = unknown_attitude.row(condition, target, size_px, config, seed)
            show(condition, "tumbling", target, seed, figures)


if __name__ == "__main__":
    main()
