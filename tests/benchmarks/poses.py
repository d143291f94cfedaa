"""How well trainings recover from errors of navigation: passes of the simulator's scenarios about a rendered target.

The target is a model that was trained on a target of `tests.benchmarks.targets`; our renderer photographs it from the
true poses of a scenario, with sensor noise, and the tags err as each condition says. A scenario's Sun is left out.

    python -m tests.benchmarks.poses --quick --json
"""

import argparse
import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from flightsw.icd.quaternion import quat_to_matrix
from ground.cameras import exposed
from ground.scores import ScoredView, clean_scores, cloud_scores
from ground.truth import read_points
from hil.sky.sensor import converted
from hil.world.scenario import Scenario, Scene, load_scenario
from obbgs_base.navigation_errors import NominalMotion, SharedParameters, displaced_motion
from obbgs_core.frames import Navigation, TrainingFrame, cameras_of
from obbgs_core.io.ply import load_ply, save_ply
from obbgs_core.model.gaussians import Gaussians
from obbgs_core.model.motions import adjoints, rigid_motions
from obbgs_core.pose_corrections import with_estimate
from obbgs_core.render import render
from obbgs_core.score.poses import best_motion, pose_errors, seen_after, settled_poses, size_of
from obbgs_core.sensor import Sensor
from obbgs_core.train import train
from obbgs_core.train.config import MethodConfig
from obbgs_core.train.presets import preset
from obbgs_core.train.result import TrainResult
from tests.benchmarks import targets
from tests.benchmarks.rows import shown

SCENARIOS = ("fly-around", "tumbling", "v-bar")
SENSOR = Sensor(black_dn=64, white_dn=4095, dn_per_radiance_s=4e7, electrons_per_dn=4.0, read_noise_dn=2.0)
EXPOSURES_S = (5e-5, 1e-4, 2e-4)
FRAME_SPACING_S = 0.5
FILLS = 0.7  # of the field of view by the target's largest dimension at the mean range
HELD_OUT = 8  # every eighth bracket
CACHE = Path(__file__).parents[2] / "build" / "benchmarks"


@dataclass(frozen=True)
class Pass:
    """True frames of a pass with their geometry."""

    frames: list[TrainingFrame]  # exact poses
    motion: NominalMotion  # true
    radiance: torch.Tensor  # [F, H, W, C]
    alpha: torch.Tensor  # [F, H, W]
    cloud_m: np.ndarray
    size_m: float
    range_m: float
    span_s: float


def target_model(name: str, size_px: int, steps: int) -> Gaussians:
    """Return a model of a rendered target, largest dimension 2 m; it is trained once and kept below build/."""
    path = CACHE / f"{name}-{size_px}-{steps}.ply"
    if not path.exists():
        case = targets.load(name, size_px)
        path.parent.mkdir(parents=True, exist_ok=True)
        save_ply(
            train(
                case.training, case.sensor, preset("obbgs", {"steps": steps, "light.max_sh_degree": 0})
            ).gaussians,
            path,
        )
    return load_ply(path)


def photographed(
    model: Gaussians, cloud: np.ndarray, scenario: Scenario, brackets: int, size_px: int, seed: int
) -> Pass:
    """Return the frames of a scenario's first brackets as they are spread over its whole duration, with exact poses."""
    scene, start_ns = Scene(scenario), scenario.orbit.start_utc_ns
    times_s = np.repeat(np.linspace(0, scenario.duration_s, brackets), len(EXPOSURES_S))
    times_s += np.tile(np.arange(len(EXPOSURES_S)) * FRAME_SPACING_S, brackets)
    states = [scene.state(start_ns + round(t * 1e9)) for t in times_s]
    target, section = states[0].target, scenario.attitude
    radial = target.position_m / np.linalg.norm(target.position_m)
    normal = np.cross(target.position_m, target.velocity_m_s)
    mean_motion = np.linalg.norm(normal) / (target.position_m @ target.position_m)
    normal /= np.linalg.norm(normal)
    tumbles = section.mode == "tumble"
    motion = NominalMotion(
        times_s,
        np.array([s.chaser.position_m - s.target.position_m for s in states]),
        np.array([s.gcrs_to_camera for s in states]),
        np.array([scene.gcrs_to_body(s.utc_ns) for s in states]),
        float(mean_motion),
        np.stack([radial, np.cross(normal, radial), normal]),
        np.radians(section.rates_deg_s) if tumbles else np.array([0, 0, 2 * np.pi / section.period_s]),
        np.array(section.inertia),
    )
    np.testing.assert_allclose(
        motion.world_to_camera[-1][:3, :3], quat_to_matrix(states[-1].pose.quat_body_to_camera), atol=1e-9
    )
    range_m = float(np.mean([s.range_m for s in states]))
    focal_px = size_px / 2 / np.tan(np.radians(scenario.fov_deg) / 2)
    scale = FILLS * size_px * range_m / focal_px / targets.LARGEST_DIMENSION
    model = dataclasses.replace(model, means=model.means * scale, log_scales=model.log_scales + np.log(scale))
    K = torch.tensor([[focal_px, 0, size_px / 2], [0, focal_px, size_px / 2], [0, 0, 1]]).float()
    blank = torch.zeros(size_px, size_px, model.sh.shape[2])
    frames = [
        TrainingFrame(blank, EXPOSURES_S[i % 3], torch.from_numpy(pose).float(), K, i, i // 3)
        for i, pose in enumerate(motion.world_to_camera)
    ]
    rng, radiance, alpha = np.random.default_rng(seed), [], []
    for frame in frames:
        with torch.no_grad():
            rendered = render(model, cameras_of([frame]))
        radiance.append(rendered.radiance[0])
        alpha.append(rendered.alpha[0])
    lit = torch.cat([r.mean(-1)[a > 0.9] for r, a in zip(radiance, alpha, strict=True)])
    white = (
        np.percentile(lit.numpy(), 97) / targets.MID_SIGNAL
    )  # radiance at full scale of the middle exposure
    unit = SENSOR.full_scale_radiance(EXPOSURES_S[1]) / white
    radiance = torch.stack(radiance) * unit
    for i, frame in enumerate(frames):
        expected = SENSOR.expected_dn(radiance[i], frame.exposure_time_s)
        sigma = SENSOR.variance_dn2(expected).sqrt().numpy()
        dn = torch.from_numpy(converted(expected.numpy(), sigma, SENSOR.white_dn, rng).astype(np.float32))
        frames[i] = dataclasses.replace(frame, dn=dn)
    size_m = targets.LARGEST_DIMENSION * scale
    return Pass(
        frames, motion, radiance, torch.stack(alpha), cloud * scale, size_m, range_m, scenario.duration_s
    )


def correlated(seen: Pass, factor: float, seed: int) -> list[TrainingFrame]:
    """Return the frames with tags that err together: boresight, relative orbit, rate and clock, times a factor."""
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
    tagged = displaced_motion(seen.motion, errors)
    return with_tags(seen, tagged, sigmas, own_deg=0.01, own_m=5e-5 * seen.range_m, seed=seed)


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


CONDITIONS: dict[str, Callable[[Pass, int], list[TrainingFrame]]] = {
    "exact": lambda seen, seed: seen.frames,
    "stated_0.1": lambda seen, seed: stated(seen, 0.1),
    "stated_0.3": lambda seen, seed: stated(seen, 0.3),
    "stated_1": lambda seen, seed: stated(seen, 1.0),
    "stated_3": lambda seen, seed: stated(seen, 3.0),
    "correlated_1": lambda seen, seed: correlated(seen, 1.0, seed),
    "correlated_3": lambda seen, seed: correlated(seen, 3.0, seed),
    "correlated_10": lambda seen, seed: correlated(seen, 10.0, seed),
    "independent_0.1": lambda seen, seed: independent(seen, 0.1, seed),
    "independent_0.3": lambda seen, seed: independent(seen, 0.3, seed),
    "independent_1": lambda seen, seed: independent(seen, 1.0, seed),
}


def scored(
    seen: Pass, frames: list[TrainingFrame], config: MethodConfig, seed: int
) -> dict[str, float | str]:
    """Return the scores of a training on all brackets but every eighth, on which it is scored."""
    trained, _ = divided(seen)
    return scores(seen, frames, train([frames[i] for i in trained], SENSOR, config, seed))


def divided(seen: Pass) -> tuple[list[int], list[int]]:
    """Return the indices of the frames for training and of those that are held out."""
    held_out = [i for i, f in enumerate(seen.frames) if (f.bracket or 0) % HELD_OUT == HELD_OUT - 1]
    return [i for i in range(len(seen.frames)) if i not in set(held_out)], held_out


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
            frame = dataclasses.replace(seen.frames[i], world_to_camera=pose)
            with torch.no_grad():
                radiance = render(result.gaussians, cameras_of([frame])).radiance[0]
            pair = (exposed(r, SENSOR, frame.exposure_time_s) for r in (radiance, seen.radiance[i]))
            views.append(ScoredView(*pair, seen.alpha[i], frame.exposure_time_s))
        return clean_scores(views)["psnr_clean_db"]

    means = result.gaussians.means.double().numpy() @ motion[:3, :3].numpy().T + motion[:3, 3].numpy()
    cloud = cloud_scores({"": means}, seen.cloud_m, targets.LARGEST_DIMENSION / seen.size_m)
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


def main() -> None:
    from tests.benchmarks import unknown_attitude  # which builds on this module

    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--quick", action="store_true", help="one seed, 100x100 pixels, 49 brackets, 600 steps"
    )
    parser.add_argument("--target", default="TDRS", choices=targets.names(), help="default: %(default)s")
    parser.add_argument("--run", type=Path, help="a run folder whose model is the target instead")
    parser.add_argument("--scenarios", nargs="+", choices=SCENARIOS, help="default: all, one with --quick")
    known = [*CONDITIONS, *unknown_attitude.CONDITIONS]
    parser.add_argument("--conditions", nargs="+", choices=known, help="default: all")
    parser.add_argument("--seeds", nargs="+", type=int, help="default: 0 to 4, or 0 with --quick")
    parser.add_argument("--json", action="store_true", help="print rows as JSON lines")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    size_px, brackets, steps, seeds = (100, 49, 600, [0]) if arguments.quick else (200, 121, 1500, range(5))
    name, model, cloud = target(arguments.target, arguments.run, size_px)
    config = preset("obbgs", {"steps": steps, "light.max_sh_degree": 0})
    conditions = arguments.conditions or known

    def show(condition: str, scenario: str, seed: int, figures: dict) -> None:
        row = {"condition": condition, "scenario": scenario, "target": name, "seed": seed}
        print(shown(row | figures, "poses", arguments.json), flush=True)

    for seed in seeds if arguments.seeds is None else arguments.seeds:
        for scenario in arguments.scenarios or SCENARIOS:
            chosen = [condition for condition in CONDITIONS if condition in conditions]
            if arguments.quick and not arguments.conditions and scenario != SCENARIOS[0]:
                chosen = ["correlated_1"]
            if not chosen:
                continue
            seen = photographed(model, cloud, load_scenario(scenario), brackets, size_px, seed)
            exact_db = float("nan")
            for condition in dict.fromkeys(["exact", *chosen]):
                figures = scored(seen, CONDITIONS[condition](seen, seed), config, seed)
                if condition == "exact":
                    exact_db = figures["psnr_clean_db"]
                show(condition, scenario, seed, figures | {"psnr_exact_db": exact_db})
        for condition in (c for c in unknown_attitude.CONDITIONS if c in conditions):
            figures = unknown_attitude.row(condition, model, cloud, size_px, config, seed)
            show(condition, "tumbling", seed, figures)


def target(name: str, run: Path | None, size_px: int) -> tuple[str, Gaussians, np.ndarray]:
    """Return name, model and surface points of the target, largest dimension 2 m: a rendered one, or a run's model."""
    if run is None:
        return name, target_model(name, size_px, 600), targets.expose(name, size_px).cloud
    cloud, model = read_points(run / "surface.ply"), load_ply(run / "model.ply")
    scale = targets.LARGEST_DIMENSION / np.ptp(cloud, axis=0).max()
    model = dataclasses.replace(model, means=model.means * scale, log_scales=model.log_scales + np.log(scale))
    return run.name, model, cloud * scale


if __name__ == "__main__":
    main()
