"""Milliseconds of the rasterizer by Gaussians, pixels, backend and threads: python -m tests.benchmarks.rasterizer"""

import argparse
import json
import statistics
import time

import torch

from obbgs_core.cameras import Cameras
from obbgs_core.gaussians import Gaussians
from obbgs_core.render import native_kernels, render

REPEATS = 7


def scene(count: int, seed: int = 0) -> Gaussians:
    """Return `count` Gaussians in a ball of radius 1, smaller the more there are, so that they cover it alike."""
    g = torch.Generator().manual_seed(seed)
    direction = torch.nn.functional.normalize(torch.randn(count, 3, generator=g), dim=1)
    size = 0.6 * count ** (-1 / 3)
    return Gaussians(
        means=direction * torch.rand(count, 1, generator=g) ** (1 / 3),
        quats=torch.randn(count, 4, generator=g),
        log_scales=torch.log(size * (0.3 + torch.rand(count, 3, generator=g))),
        opacity_logits=torch.randn(count, generator=g),
        sh=torch.rand(count, 1, 3, generator=g),
    )


def camera(width: int, distance: float = 3.0) -> Cameras:
    pose = torch.eye(4)[None].clone()
    pose[0, 2, 3] = distance
    focal = 1.3 * width
    K = torch.tensor([[[focal, 0, width / 2], [0, focal, width / 2], [0, 0, 1.0]]])
    return Cameras(pose, K, width, width)


def measure(backend: str, count: int, width: int, threads: int, distance: float = 3.0) -> dict:
    """Return the median forward and backward milliseconds of rendering and of its whole gradient."""
    torch.set_num_threads(threads)
    leaves = {n: t.requires_grad_() for n, t in scene(count).tensors().items()}
    cameras, forward_ms, backward_ms = camera(width, distance), [], []
    for repeat in range(REPEATS + 2 if backend != "reference" else 2):
        began = time.perf_counter()
        image = render(Gaussians(**leaves), cameras, backend).radiance
        rendered = time.perf_counter()
        image.sum().backward()
        done = time.perf_counter()
        if repeat > 1 or (backend == "reference" and repeat):
            forward_ms.append(1e3 * (rendered - began))
            backward_ms.append(1e3 * (done - rendered))
    return {
        "backend": backend,
        "gaussians": count,
        "width": width,
        "forward_ms": round(statistics.median(forward_ms), 2),
        "backward_ms": round(statistics.median(backward_ms), 2),
        "threads": threads,
        "covered": round(float((image > 0).any(-1).float().mean()), 3),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", action="store_true", help="one JSON object a row")
    parser.add_argument("--quick", action="store_true", help="only the smallest size")
    arguments = parser.parse_args()
    cases = [("reference", 2000, 100, 1, 3.0)] + [
        (f"native-{k}", 2000, 100, 1, 3.0) for k in native_kernels()
    ]
    if not arguments.quick:
        for count in (20_000, 100_000):
            cases += [("native", count, width, threads, 3.0) for width in (400, 800) for threads in (1, 2)]
        cases.append(("native", 20_000, 800, 1, 9.0))  # the object covers a tenth of the pixels
    for case in cases:
        row = measure(*case)
        print(
            json.dumps(row) if arguments.json else "  ".join(f"{k} {v}" for k, v in row.items()), flush=True
        )


if __name__ == "__main__":
    main()
