"""Where the milliseconds of a training step go, part by part: python -m tests.benchmarks.step [--json]"""

import argparse
import functools
import itertools
import statistics
import time
from collections import defaultdict
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from unittest.mock import patch

import numpy as np
import torch
from torch import Tensor

from hil.sky.sensor import converted
from obbgs_core.frames import TrainingFrame
from obbgs_core.methods.presets import preset
from obbgs_core.model.cameras import Cameras
from obbgs_core.model.gaussians import Gaussians
from obbgs_core.render import render
from obbgs_core.sensor import Sensor
from obbgs_core.start.initialisation import StartSettings
from obbgs_core.train import fit, growth, setup, trainer
from obbgs_core.train.adam import Adam
from obbgs_core.train.trainer import Trainer
from tests.benchmarks.rasterizer import camera, scene
from tests.benchmarks.rows import shown

GAUSSIANS, WIDTH_PX = 20_000, 400
EXPOSURES_S = (0.5e-4, 1e-4, 2e-4)
WARM_UP_STEPS = 10
SENSOR = Sensor(black_dn=64, white_dn=4095, dn_per_radiance_s=2e7, electrons_per_dn=4, read_noise_dn=8)
# what a step calls besides the rasterizer and backward; drawing frames, priors and bookkeeping are the rest
PARTS = {
    "loss_forward": [(trainer, "image_loss")],
    "adam": [(Adam, "step")],
    "growth": [(growth.Growth, "observe"), (Trainer, "_decide")],
    "figures": [(fit.Fit, "observe")],
}
COLUMNS = (
    "rasterizer_forward",
    "rasterizer_backward",
    "loss_forward",
    "loss_backward",
    "adam",
    "growth",
    "figures",
)


class _Stamp(torch.autograd.Function):
    """The identity; its backward notes when the gradient of the loss has reached the image."""

    @staticmethod
    def forward(ctx, image, clock):
        ctx.clock = clock
        return image.view_as(image)

    @staticmethod
    def backward(ctx, *gradients):
        ctx.clock.append(time.perf_counter())
        return gradients[0], None


class StepClock:
    """Milliseconds of every step of a training, by part."""

    def __init__(self):
        self.steps: list[dict[str, float]] = []
        self.current: dict[str, float] = defaultdict(float)
        self.image_gradient_at: list[float] = []

    def timed(self, part: str, function):
        @functools.wraps(function)
        def wrapper(*args, **kwargs):
            began = time.perf_counter()
            try:
                return function(*args, **kwargs)
            finally:
                self.current[part] += 1e3 * (time.perf_counter() - began)

        return wrapper

    def render(self, *args, **kwargs):
        began = time.perf_counter()
        rendered = render(*args, **kwargs)
        self.current["rasterizer_forward"] += 1e3 * (time.perf_counter() - began)
        rendered.radiance = _Stamp.apply(rendered.radiance, self.image_gradient_at)
        return rendered

    def backward(self, loss: Tensor) -> None:
        began = time.perf_counter()
        torch.autograd.backward(loss)
        done, reached = time.perf_counter(), self.image_gradient_at.pop()
        self.current["loss_backward"] += 1e3 * (reached - began)
        self.current["rasterizer_backward"] += 1e3 * (done - reached)

    def time(self, step: Callable) -> None:
        began = time.perf_counter()
        step()
        self.current["step"] = 1e3 * (time.perf_counter() - began)
        self.steps.append(dict(self.current))
        self.current.clear()


def frames(distance: float) -> list[TrainingFrame]:
    """Return twelve noisy frames of the rasterizer benchmark's scene, seen along +z and turned about y."""
    rng = np.random.default_rng(0)
    truth, front = scene(GAUSSIANS), camera(WIDTH_PX, distance)
    out = []
    for index in range(12):
        angle = torch.tensor(index * torch.pi / 6)
        pose = front.world_to_camera[0].clone()
        pose[0, 0] = pose[2, 2] = angle.cos()
        pose[0, 2], pose[2, 0] = angle.sin(), -angle.sin()
        exposure_s = EXPOSURES_S[index % 3]
        with torch.no_grad():
            seen = render(truth, Cameras(pose[None], front.K, WIDTH_PX, WIDTH_PX)).radiance[0]
            expected = SENSOR.expected_dn(seen, exposure_s)
        sigma_dn = SENSOR.variance_dn2(expected).sqrt().numpy()
        dn = torch.from_numpy(converted(expected.numpy(), sigma_dn, SENSOR.white_dn, rng).astype(np.float32))
        out.append(TrainingFrame(dn, exposure_s, pose, front.K[0], index))
    return out


def first_gaussians(
    _frames, _outlines, _sensor, _settings: StartSettings, sh_degree: int, _rng, _grey: bool = False
) -> tuple[Gaussians, float, str]:
    """Return the frames' own Gaussians, with as many colour coefficients as the method has, and their radius, m."""
    truth = scene(GAUSSIANS)
    coefficients = torch.zeros(GAUSSIANS, (sh_degree + 1) ** 2, 3)
    coefficients[:, :1] = truth.sh
    return replace(truth, sh=coefficients).trainable(), 1.0, "the truth"


def measure(name: str, threads: int, distance: float, steps: int) -> dict:
    """Return the median milliseconds of each part of a step; growth, which is rare and dear, by its mean.

    The preset is held at 20,000 Gaussians and full images, and grows from the first step on: every step is a dear one.
    """
    torch.set_num_threads(threads)
    changes = {
        "steps": WARM_UP_STEPS + steps,
        "growth.max_gaussians": GAUSSIANS,
        "growth.begin": 0.0,
        "growth.end": 1.0,
        "growth.prune_opacity": 0.0,
        "parsimony.prune_at": (),
    }
    config = preset(name, changes)
    data, clock = frames(distance), StepClock()
    with ExitStack() as patches:
        patches.enter_context(patch.object(setup, "first_gaussians", first_gaussians))
        patches.enter_context(patch.object(trainer, "render", clock.render))
        patches.enter_context(patch.object(Tensor, "backward", lambda loss: clock.backward(loss)))
        for part, functions in PARTS.items():
            for owner, function in functions:
                timed = clock.timed(part, getattr(owner, function))
                patches.enter_context(patch.object(owner, function, timed))
        training = Trainer(data, SENSOR, config)
        for _ in range(config.steps):
            clock.time(training.step)
    rows = clock.steps[WARM_UP_STEPS:]
    parts = {p: statistics.median(row.get(p, 0.0) for row in rows) for p in COLUMNS}
    parts["growth"] = statistics.mean(row.get("growth", 0.0) for row in rows)
    parts["rest"] = statistics.median(row["step"] - sum(row.get(p, 0.0) for p in COLUMNS) for row in rows)
    rasterizer = parts["rasterizer_forward"] + parts["rasterizer_backward"]
    step = sum(parts.values())
    return {
        "method": name,
        "condition": f"target {distance:g} m away, {threads} thread" + ("s" if threads > 1 else ""),
        "gaussians": GAUSSIANS,
        "width": WIDTH_PX,
        "frames": config.frames_per_step,
        "distance": distance,
        "threads": threads,
        **{f"{part}_ms": round(ms, 2) for part, ms in parts.items()},
        "step_ms": round(step, 1),
        "step_over_rasterizer": round(step / rasterizer, 2),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", action="store_true", help="one JSON object a row")
    parser.add_argument("--steps", type=int, default=120, help="measured steps of each preset")
    arguments = parser.parse_args()
    cases = itertools.product(
        (3.0, 9.0), (1, 2), ("obbgs", "jiang2025")
    )  # from 9 m the object fills 7 % of the pixels
    for distance, threads, name in cases:
        row = measure(name, threads, distance, arguments.steps)
        print(shown(row, "step", arguments.json), flush=True)


if __name__ == "__main__":
    main()
