"""Where training holds and where it cannot: python -m tests.benchmarks.stability

Each row changes one condition of one target. `ok` is a model whose clean PSNR is at least 1 dB above each baseline
without training (a black image, the mean image of the training frames, the Gaussians that the training starts from),
or a named error that says why there is none; a NaN, a crash, or a model that is no better is a failure, and the command
ends with 1.
"""

import argparse
import dataclasses
import sys
from pathlib import Path

import numpy as np
import torch

from ground.session import SessionError
from hil.sky.sensor import converted
from obbgs_core.errors import ReconstructionError
from obbgs_core.frames import TrainingFrame
from obbgs_core.train.config import MethodConfig
from obbgs_core.train.poses import rigid_motions
from tests import baselines
from tests.benchmarks import targets
from tests.benchmarks.methods import configure, measure
from tests.benchmarks.rows import shown

BASE_S = 5e-5
MARGIN_DB = 1.0  # above the best baseline; seeds of one condition scatter by 0.3 dB


def bracket(*ratios: float) -> dict:
    return {"bracket_s": tuple(BASE_S * ratio for ratio in ratios)}


LOADS: dict[str, dict] = {
    "as the paper": {},
    **{
        f"ratios {':'.join(map(str, r))}": bracket(*r)
        for r in ((1, 1, 1), (1, 4, 16), (1, 8, 64), (1, 16, 256))
    },
    **{f"noise x{factor:g}": {"sigma": factor * targets.PAPER_SIGMA} for factor in (0.5, 2, 4)},
    **{f"{count} frames": {"frames": count} for count in (12, 24, 48)},
}
POSE_ERRORS_DEG = (0.05, 0.1, 0.3, 1.0)
EXPOSURE_ERRORS = (0.01, 0.03, 0.1)  # of ln(exposure time), frame by frame
LOST_PERCENT = (10, 30, 50, 70)


def with_pose_error(target: targets.Target, degrees: float, seed: int) -> targets.Target:
    """Return the target with every training pose turned at random about each axis, and tagged as that uncertain."""
    rng = torch.Generator().manual_seed(seed)
    sigma = torch.tensor([np.radians(degrees)] * 3 + [1e-6] * 3, dtype=torch.float32)
    covariance, frames = torch.diag(sigma.double() ** 2), []
    for frame in target.training:
        error = rigid_motions(torch.randn(1, 6, generator=rng) * sigma)[0]
        frames.append(
            dataclasses.replace(
                frame, world_to_camera=error @ frame.world_to_camera, pose_covariance=covariance
            )
        )
    return dataclasses.replace(target, training=frames)


def keep(target: targets.Target, wanted) -> targets.Target:
    """Return the target with only the training frames (index, frame) that are wanted."""
    return dataclasses.replace(target, training=[f for i, f in enumerate(target.training) if wanted(i, f)])


def in_eclipse(target: targets.Target, first: float, last: float) -> targets.Target:
    """Return the target with a stretch of its frames black but for noise."""
    rng, count = np.random.default_rng(0), len(target.training)

    def dark(frame: TrainingFrame) -> TrainingFrame:
        unlit = np.full(tuple(frame.dn.shape), target.sensor.black_dn)
        dn = converted(unlit, target.sensor.read_noise_dn, target.sensor.white_dn, rng)
        return dataclasses.replace(frame, dn=torch.from_numpy(dn.astype(np.float32)))

    frames = [dark(f) if first <= i / count < last else f for i, f in enumerate(target.training)]
    return dataclasses.replace(target, training=frames)


def exceeds(psnr_clean_db: float, *baselines_db: float) -> bool:
    """Tell whether a model is better than every baseline by more than chance; NaN is not."""
    return bool(psnr_clean_db >= max(baselines_db) + MARGIN_DB)


def baselines_of(target: targets.Target, config: MethodConfig, seed: int) -> dict[str, float]:
    """Return the clean PSNR of each baseline without training, by the names of a row.

    Raises:
        ReconstructionError: the frames allow no start.
    """
    return {
        "mean_image_db": round(baselines.mean_image(target).clean_db, 3),
        "black_db": round(baselines.black(target).clean_db, 3),
        "untrained_db": round(baselines.untrained(target, config, seed).clean_db, 3),
    }


def cases(name: str, size: int, seeds: int):
    """Yield (condition, target, changes of the method, seed)."""
    for condition, load in LOADS.items():
        yield condition, targets.load(name, size, **load), {}, 0
    plain = targets.load(name, size)
    for seed in range(1, seeds):
        yield f"seed {seed}", plain, {}, seed
    for degrees in POSE_ERRORS_DEG:
        wrong = with_pose_error(plain, degrees, 0)
        yield f"pose error {degrees:g} deg", wrong, {"poses.refine": "never"}, 0
        yield f"pose error {degrees:g} deg, refined by validation", wrong, {"poses.refine": "auto"}, 0
    for error in EXPOSURE_ERRORS:
        wrong = targets.load(name, size, exposure_error=error)
        yield f"exposure error {error:.0%}", wrong, {}, 0
    rng = np.random.default_rng(0)
    for percent in LOST_PERCENT:
        lost = set(rng.permutation(len(plain.training))[: len(plain.training) * percent // 100].tolist())
        yield f"{percent} % of frames lost", keep(plain, lambda i, f, lost=lost: i not in lost), {}, 0
    for exposure_s in targets.BRACKET_S:
        rest = keep(plain, lambda i, f, exposure_s=exposure_s: f.exposure_time_s != exposure_s)
        yield f"{exposure_s * 1e3:g} ms missing", rest, {}, 0
    yield "eclipse in mid-session", in_eclipse(plain, 0.4, 0.7), {}, 0
    yield "random start", plain, {"start.kind": "random", "start.count": 20_000}, 0
    yield "two frames", keep(plain, lambda i, f: i < 2), {}, 0
    yield "all frames black", in_eclipse(plain, 0.0, 1.0), {}, 0


def moving_sun(target: targets.Target):
    """Yield a target whose Sun moves, with each way that the model may take it."""
    yield "moving Sun, held static", target, {"light.sun_span_deg": 0.0}, 0
    yield "moving Sun, linear", target, {"light.sun_shading": "linear"}, 0
    yield "moving Sun", target, {}, 0


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--json", action="store_true", help="one JSON object a row")
    parser.add_argument("--target", default="TDRS")
    parser.add_argument("--size", type=int, default=200)
    parser.add_argument("--steps-share", type=float, default=0.5)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument(
        "--session",
        type=Path,
        metavar="DIR",
        help="only a moving Sun: a session of `hil dataset` with its truth",
    )
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    failures = 0
    rows = cases(arguments.target, arguments.size, arguments.seeds)
    if arguments.session:
        try:
            rows = moving_sun(targets.from_session(arguments.session))
        except SessionError as error:
            parser.error(str(error))
    for condition, target, changes, seed in rows:
        row: dict = {"condition": condition}
        try:
            config = configure("obbgs", arguments.steps_share, changes)
            row |= measure(config, target, seed)
            row |= (without_training := baselines_of(target, config, seed))
            row["ok"] = exceeds(row["psnr_clean_db"], *without_training.values())
        except ReconstructionError as error:
            row |= {"error": f"{type(error).__name__}: {error}", "ok": True}
        failures += not row["ok"]
        print(shown(row, "stability", arguments.json), flush=True)
    sys.exit(1 if failures else 0)


if __name__ == "__main__":
    main()
