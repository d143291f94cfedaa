"""How much memory a training takes on large pictures: the peak of the process, stage by stage.

The frames are those of a small pass (`tests.benchmarks.passes`), each pixel a block of pixels of the sensor, with noise
of its own, in the middle third of pictures that are black elsewhere as flight sends them. A few places are taken again
and again: what frames show matters to no figure of this benchmark.

    python -m tests.benchmarks.memory --frames 360 --json
"""

import argparse
import dataclasses
import math
import resource
import time

import numpy as np
import torch

from hil.world.scenario import load_scenario
from obbgs_core.frames import TrainingFrame
from obbgs_core.methods.presets import preset
from obbgs_core.train.trainer import Trainer
from tests.benchmarks.passes import SENSOR, photographed
from tests.benchmarks.rows import shown

BRACKETS = 4  # that are made
SMALL_PX = 128


def frames_of(count: int, width: int, height: int) -> list[TrainingFrame]:
    """Return so many frames whose target fills a third of the picture's pixels."""
    factor = round(math.sqrt(width * height / 3) / SMALL_PX)
    side = factor * SMALL_PX
    top, left = (height - side) // 2, (width - side) // 2
    small = photographed(0, load_scenario("fly-around"), BRACKETS, SMALL_PX, seed=0)
    rng, made = np.random.default_rng(0), []
    noise = rng.standard_normal((2 * side, 2 * side, 1), dtype=np.float32)
    for number in range(count):
        frame, radiance = (given[number % len(small.frames)] for given in (small.frames, small.radiance))
        expected = SENSOR.expected_dn(radiance, frame.exposure_time_s)
        sigma = SENSOR.variance_dn2(expected).sqrt()
        block, sigma = (values.numpy().repeat(factor, 0).repeat(factor, 1) for values in (expected, sigma))
        y, x = rng.integers(0, side, 2)
        noisy = block + sigma * noise[y : y + side, x : x + side]
        dn = np.full((height, width, 1), SENSOR.black_dn, dtype=np.float32)
        dn[top : top + side, left : left + side] = noisy.round().clip(0, SENSOR.white_dn)
        K = frame.K * factor
        K[:, 2] = torch.tensor([left, top, 0.0]) + K[:, 2] * torch.tensor([1.0, 1.0, 0.0])
        K[2, 2] = 1.0
        made.append(dataclasses.replace(frame, dn=torch.from_numpy(dn), K=K, id=number, bracket=number // 3))
    return made


def peak_gb() -> float:
    """Return the largest resident memory of this process so far, 10^9 bytes."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e9


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--frames", type=int, default=360)
    parser.add_argument("--width", type=int, default=4096)
    parser.add_argument("--height", type=int, default=3072)
    parser.add_argument("--steps", type=int, default=5, help="of training; more take no more memory")
    parser.add_argument("--json", action="store_true", help="print rows as JSON lines")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    began, row = time.process_time(), {"condition": f"{arguments.frames} frames", "steps": arguments.steps}
    row |= {"target": f"{arguments.width}x{arguments.height}", "peak_gb_imports": peak_gb()}
    frames = frames_of(arguments.frames, arguments.width, arguments.height)
    row["peak_gb_frames"] = peak_gb()
    trainer = Trainer(frames, SENSOR, preset("obbgs"), seed=0)
    row["peak_gb_start"] = peak_gb()
    for _ in range(arguments.steps):
        trainer.step()
    row |= {"peak_gb": peak_gb(), "cpu_seconds": time.process_time() - began}
    print(shown(row, "memory", arguments.json), flush=True)


if __name__ == "__main__":
    main()
