"""Sessions of a few small pictures with their truth, for tests of comparisons."""

from pathlib import Path

import numpy as np
import torch

from obbgs_core.frames import TrainingFrame, cameras_of
from obbgs_core.render import render
from tests import scenes
from tests.benchmarks.targets import Target, View, write

SIZE_PX, FOCAL_PX, VIEWS = 40, 80.0, 24


def small_session(folder: Path, seed: int = 0, views: int = VIEWS) -> Path:
    """Write a session of 40x40 pixels in three exposure times, every eighth view held out, and return its folder."""
    gaussians = scenes.target(seed=seed)
    made = []
    for frame in scenes.photographed(gaussians, views, seed, SIZE_PX, FOCAL_PX):
        rendered = render(gaussians, cameras_of([frame]))
        # as the truth keeps it: half precision, 8 bits of coverage
        made.append(View(_sized(frame), rendered.radiance[0].half().float(), rendered.alpha[0]))
    cloud = (
        np.random.default_rng(seed).normal(size=(500, 3)) * 0.05
        + np.repeat(gaussians.means.numpy(), 9, 0)[:500]
    )
    write(Target(folder.name, scenes.SENSOR, made, cloud), folder)
    return folder


def _sized(frame: TrainingFrame) -> TrainingFrame:
    assert tuple(frame.dn.shape) == (SIZE_PX, SIZE_PX, 1) and torch.isfinite(frame.dn).all()
    return frame
