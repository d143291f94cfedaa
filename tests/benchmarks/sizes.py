"""How seconds, memory and PSNR grow with the pictures: python -m tests.benchmarks.sizes 1000 --json

The frames are grey ones of 12 bits of a target in tests.benchmarks.targets' folder, 105 to train on and 15 held out.
Its views of 400 pixels are made larger bilinearly, so that they show nothing finer than those; each pixel has noise of
its own: read noise of 8 digital numbers, and that of 4 electrons in each. The peak of memory is that of the process,
with the frames.
"""

import argparse
import math
import resource
import time

import numpy as np
import torch
import torch.nn.functional as F

from obbgs_core.frames import TrainingFrame, cameras_of
from obbgs_core.methods.presets import preset
from obbgs_core.render import render
from obbgs_core.sensor import Sensor
from obbgs_core.train import train
from tests.benchmarks.rows import shown
from tests.benchmarks.targets import BRACKET_S, FOLDER, HELD_OUT, MID_SIGNAL

BLACK_DN, WHITE_DN, ELECTRONS_PER_DN, READ_NOISE_DN = 64.0, 4095.0, 4.0, 8.0


class Views:
    """The views of a target in one colour, made larger one at a time, and the sensor that takes them."""

    def __init__(self, name: str, side_px: int):
        with np.load(FOLDER / f"{name}_400.npz") as arrays:
            self._radiance = torch.from_numpy(arrays["radiance"].astype(np.float32)).mean(-1)
            covered = torch.from_numpy(arrays["alpha"]) >= 230
            self._poses = torch.from_numpy(arrays["world_to_camera"].astype(np.float32))
            K = torch.from_numpy(arrays["K"].astype(np.float32))
        self.side_px, factor = side_px, side_px / self._radiance.shape[1]
        self._K = K * torch.tensor([[factor], [factor], [1.0]])
        bright = float(np.percentile(self._radiance[covered].numpy(), 97))
        gain = MID_SIGNAL * (WHITE_DN - BLACK_DN) / (bright * BRACKET_S[1])
        self.sensor = Sensor(BLACK_DN, WHITE_DN, gain, ELECTRONS_PER_DN, READ_NOISE_DN)

    def __len__(self) -> int:
        return len(self._radiance)

    def radiance(self, number: int) -> torch.Tensor:
        """Return a view's radiance [H, W, 1]."""
        sized = (self.side_px, self.side_px)
        small = self._radiance[number][None, None]
        return F.interpolate(small, sized, mode="bilinear", align_corners=False)[0].movedim(0, -1)

    def frame(self, number: int) -> TrainingFrame:
        """Return a view as the sensor takes it."""
        exposure_s = BRACKET_S[number % len(BRACKET_S)]
        expected = self.sensor.expected_dn(self.radiance(number), exposure_s)
        noise = torch.randn(expected.shape, generator=torch.Generator().manual_seed(number))
        dn = (expected + self.sensor.variance_dn2(expected).sqrt() * noise).round().clamp(0, WHITE_DN)
        return TrainingFrame(dn, exposure_s, self._poses[number], self._K, number)


def measured(name: str, side_px: int, seed: int) -> dict:
    """Train `obbgs` on a target and return the row."""
    views = Views(name, side_px)
    held_out = range(HELD_OUT - 1, len(views), HELD_OUT)
    frames = [views.frame(number) for number in range(len(views)) if number not in held_out]
    row = {"method": "obbgs", "target": name, "seed": seed, "size_px": side_px, "peak_gb_frames": peak_gb()}
    cpu, clock = time.process_time(), time.perf_counter()
    result = train(frames, views.sensor, preset("obbgs"), seed)
    row |= {
        "seconds": time.perf_counter() - clock,
        "cpu_seconds": time.process_time() - cpu,
        "peak_gb": peak_gb(),
    }
    del frames
    scores = [psnr_db(views, number, result.gaussians) for number in held_out]
    return row | {"gaussians": len(result.gaussians), "psnr_clean_db": sum(scores) / len(scores)}


def psnr_db(views: Views, number: int, gaussians) -> float:
    """Return the PSNR of a model's noiseless exposure of a view, of the range between black and full scale, clipped."""
    frame, span = views.frame(number), WHITE_DN - BLACK_DN
    radiance = render(gaussians, cameras_of([frame])).radiance[0]
    signals = [
        ((views.sensor.expected_dn(light, frame.exposure_time_s) - BLACK_DN) / span).clamp(0, 1)
        for light in (radiance, views.radiance(number))
    ]
    return -10 * math.log10(float((signals[0] - signals[1]).square().mean()))


def peak_gb() -> float:
    """Return the largest resident memory of this process so far, 10^9 bytes."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e9


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("side", type=int, help="pixels along a side")
    parser.add_argument("--target", default="TDRS")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", action="store_true", help="print rows as JSON lines")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    row = measured(arguments.target, arguments.side, arguments.seed)
    print(shown(row, "sizes", arguments.json), flush=True)


if __name__ == "__main__":
    main()
