"""Small trainings of every method and mode, and a digest of each: python -m tests.benchmarks.golden_runs [NAME ...]

A change that is said to move code only leaves every digest as it was: run this before and after it, on one machine and
with one thread. Digests are compared with nothing that is committed, because other processors round otherwise.
"""

import argparse
import dataclasses
import hashlib
import os
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import torch

from obbgs_core.frames import TrainingFrame
from obbgs_core.methods.presets import preset
from obbgs_core.train.result import TrainResult
from obbgs_core.train.trainer import Trainer
from tests.ground import test_moving_sun as sunlit
from tests.obbgs_core import test_pose_estimation as orbit
from tests.scenes import SENSOR, photographed, tagged, target

SMALL = {"steps": 120, "start.count": 400, "growth.max_gaussians": 900}
# the published schedules in a hundredth of their steps
PUBLISHED = SMALL | {"growth.interval": 6, "published.opacity_reset_interval": 40, "growth.begin": 0.1}
MANY_EXPECTED = {"sparse.dropout": 0.0}


def trained(frames: list[TrainingFrame], method: str, sensor=SENSOR, **changes) -> Trainer:
    """Return a whole training."""
    trainer = Trainer(frames, sensor, preset(method, SMALL | changes), seed=3)
    return to_the_end(trainer)


def to_the_end(trainer: Trainer) -> Trainer:
    while not trainer.stop_reason():
        trainer.step()
    return trainer


def published(method: str, **changes) -> Trainer:
    frames = photographed(target(), 18)
    return to_the_end(Trainer(frames, SENSOR, preset(method, PUBLISHED | changes), seed=3))


def multi_view() -> Trainer:
    return published("mvgs", **{"published.coarse": ((1 / 4, 6, 0.1), (1 / 2, 4, 0.1)), "frames_per_step": 3})


def before_grey() -> Trainer:
    frames = [
        dataclasses.replace(f, dn=(f.dn + 400).clamp(max=SENSOR.white_dn), background=0.05)
        for f in photographed(target(), 18, exposures_s=(1e-4,))
    ]
    return to_the_end(Trainer(frames, SENSOR, preset("3dgs+exposure", PUBLISHED), seed=3))


def moving_sun(steps: int, **changes) -> Trainer:
    frames = sunlit.photographed(sunlit.views(24), bodies=sunlit.TOGETHER)
    return trained(frames, "obbgs", sunlit.SENSOR, steps=steps, **changes)


def highlights() -> Trainer:
    """A still Sun, and albedos that turn with the view."""
    shiny = target()
    rng = torch.Generator().manual_seed(5)
    shiny.sh = torch.cat([shiny.sh, 0.3 * torch.randn(len(shiny), 8, 1, generator=rng)], dim=1)
    sun = torch.tensor([0.0, 0.6, 0.8]).expand(36, 3)
    return trained(photographed(shiny, 36, suns=sun), "obbgs", steps=1000)


def refined(refine: str, wrong: bool = True, sigma_rad: float = 0.02) -> Trainer:
    return trained(tagged(photographed(target(), 36), wrong, sigma_rad), "obbgs", **{"poses.refine": refine})


def navigated() -> Trainer:
    true, motion = orbit.a_pass()
    frames = orbit.tagged(true, orbit.displaced_motion(motion, orbit.ERRORS))
    return trained(frames, "obbgs", orbit.SENSOR, **{"poses.refine": "auto"})


def joined(refine: str, moving: bool) -> Trainer:
    """Frames that join twice, a training that is killed between, and one that begins again of all of them."""
    if moving:
        frames, sensor = sunlit.photographed(sunlit.views(36)), sunlit.SENSOR
    else:
        frames, sensor = tagged(photographed(target(), 42), True, 0.01), SENSOR
    config = preset("obbgs", SMALL | MANY_EXPECTED | {"poses.refine": refine})
    trainer = Trainer(frames[:12], sensor, config, seed=3)
    trainer.withhold()
    for first, last in ((12, 24), (24, len(frames))):
        for _ in range(30):
            trainer.step()
        trainer.join(frames[first:last])
        trainer = resumed(trainer, frames[:last], sensor)
    for _ in range(70):
        trainer.step()
    trainer.end_joining()
    for _ in range(20):
        trainer.step()
    return to_the_end(resumed(trainer, frames, sensor))


def resumed(trainer: Trainer, frames: list[TrainingFrame], sensor) -> Trainer:
    """Return a training that goes on from a checkpoint of another."""
    with tempfile.TemporaryDirectory() as folder:
        trainer.save(Path(folder) / "checkpoint")
        other = Trainer(frames, sensor, trainer.setup.asked, seed=3)
        assert other.resume(Path(folder) / "checkpoint")
    return other


RUNS: dict[str, Callable[[], Trainer]] = {
    "3dgs": lambda: published("3dgs"),
    "3dgs+affine": lambda: published("3dgs+affine"),
    "3dgs+exposure+hull": lambda: published("3dgs+exposure+hull"),
    "3dgs-grey": before_grey,
    "pixel-gs": lambda: published("pixel-gs"),
    "mvgs": multi_view,
    "mip-splatting": lambda: published("mip-splatting"),
    "jiang2025": lambda: published("jiang2025"),
    "obbgs": lambda: trained(photographed(target(), 54), "obbgs"),
    "obbgs+blind": lambda: trained(photographed(target(), 54), "obbgs+blind"),
    "few": lambda: trained(photographed(target(), 8), "obbgs"),
    "sun": lambda: moving_sun(240),
    "sun-highlights": lambda: moving_sun(1000, **{"growth.max_gaussians": 600}),
    "highlights": highlights,
    "poses-never": lambda: refined("never"),
    "poses-auto": lambda: refined("auto"),
    "poses-doubted": lambda: refined("auto", wrong=False),
    "poses-hold": lambda: refined("auto", wrong=False, sigma_rad=0.001),
    "poses-always": lambda: refined("always"),
    "navigation": navigated,
    "joined": lambda: joined("never", False),
    "joined-auto": lambda: joined("auto", False),
    "joined-always": lambda: joined("always", False),
    "joined-sun": lambda: joined("never", True),
}


def digest(result: TrainResult) -> str:
    """Return a digest of everything that a training computed, and none of its words."""
    seen = hashlib.sha256()
    for name, tensor in result.gaussians.tensors().items():
        seen.update(name.encode() + tensor.numpy().tobytes())
    for name in ("lobes", "gloss", "ambient", "psf_sigma_px", "static_sun"):
        seen.update(getattr(result.gaussians, name).numpy().tobytes())
    for info in result.history:
        told = (info.step, info.steps, info.loss, info.psnr_db, info.chi2, info.gaussians)
        seen.update(repr(told).encode())
    figures = (result.misfit, result.unseen_factor, result.misfit_frames, result.removed_outliers)
    seen.update(repr((figures, result.removed_not_finite, result.dark_frames)).encode())
    for exposure_s, colours in result.exposing.maps.items():
        seen.update(repr(exposure_s).encode() + colours.numpy().tobytes())
    if result.pose_estimate is not None:
        seen.update(repr(result.pose_estimate.tree()).encode())
    return seen.hexdigest()[:16]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", help=f"of {', '.join(RUNS)}; none: all")
    torch.set_num_threads(1)
    for name in parser.parse_args().names or RUNS:
        began = time.monotonic()
        trainer = RUNS[name]()
        result = trainer.result("")
        words = "; ".join((result.start, result.budget, result.appearance, result.growth, result.poses))
        told = hashlib.sha256(words.encode()).hexdigest()[:8]
        spent = f"{time.monotonic() - began:.1f} s" if "GOLDEN_TIMES" in os.environ else ""
        print(name, digest(result), told, len(result.gaussians), spent, flush=True)
        if "GOLDEN_WORDS" in os.environ:
            print("   ", words)


if __name__ == "__main__":
    main()
