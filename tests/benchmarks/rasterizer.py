"""Milliseconds of the rasterizer by Gaussians, pixels, backend and threads: python -m tests.benchmarks.rasterizer

Times are medians over repeats of `render` and of the whole gradient to the model; `mean_ms` and `fastest_ms` are of
both together, the latter disturbed least by other work on the machine. Kernels take turns, and so do one and two
threads; `over_best_kernel` is the fastest time over that of the machine's best kernel. `reference_ms` is the plain
PyTorch backend on the same Gaussians, measured on a window of the image and scaled by the pixels: its cost is the same
for each. `bytes` is the kernels' own memory.
"""

import argparse
import itertools
import multiprocessing
import statistics
import time
from collections.abc import Sequence

import torch

from obbgs_core.model.cameras import Cameras
from obbgs_core.model.gaussians import Gaussians
from obbgs_core.render import Rendered, native_kernels, render
from tests.benchmarks.rows import shown

REPEATS = 25
# Gaussians times pixels that the reference is measured on: seconds and about a gigabyte
REFERENCE_PAIRS = 8_000_000
DISTANCE = 3.0


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


def camera(width: int, distance: float = DISTANCE, window: int | None = None) -> Cameras:
    """Return a camera of width x width pixels, or only the `window` x `window` in its middle."""
    pose = torch.eye(4)[None].clone()
    pose[0, 2, 3] = distance
    size = window or width
    K = torch.tensor([[[1.3 * width, 0, size / 2], [0, 1.3 * width, size / 2], [0, 0, 1.0]]])
    return Cameras(pose, K, size, size)


def once(gaussians: Gaussians, cameras: Cameras, backend: str):
    """Return the rendered frame and the milliseconds of its forward and backward passes."""
    leaves = {name: value.clone().requires_grad_() for name, value in gaussians.tensors().items()}
    began = time.perf_counter()
    out = render(Gaussians(**leaves), cameras, backend)
    rendered = time.perf_counter()
    out.radiance.sum().backward()
    return out, 1e3 * (rendered - began), 1e3 * (time.perf_counter() - rendered)


def measure_reference(count: int, width: int) -> float:
    """Return the milliseconds, forward and backward, of the reference backend on one thread."""
    torch.set_num_threads(1)
    window = min(width, max(1, int((REFERENCE_PAIRS / count) ** 0.5)))
    _, forward_ms, backward_ms = once(scene(count), camera(width, window=window), "reference")
    return (forward_ms + backward_ms) * width**2 / window**2


def measure(
    backends: Sequence[str], count: int, width: int, threads: Sequence[int] = (1,), distance: float = DISTANCE
) -> list[dict]:
    """Return a row for each backend and number of threads, in turns, so that other work slows all of them alike."""
    gaussians, cameras, rows = scene(count), camera(width, distance), []
    turns = list(itertools.product(backends, threads))
    times: dict[tuple[str, int], list[tuple[float, float]]] = {turn: [] for turn in turns}
    drawn: dict[tuple[str, int], Rendered] = {}
    for repeat in range(REPEATS + 2):
        for backend, number in turns:
            torch.set_num_threads(number)
            drawn[backend, number], forward_ms, backward_ms = once(gaussians, cameras, backend)
            if repeat > 1:
                times[backend, number].append((forward_ms, backward_ms))
    for (backend, number), both in times.items():
        out = drawn[backend, number]
        covered = float((out.alpha > 0).float().mean())
        row = {
            "backend": backend,
            "target": f"{count:,} Gaussians, {width}x{width} pixels, {covered:.0%} covered, threads: {number}",
            "gaussians": count,
            "width": width,
            "forward_ms": round(statistics.median(f for f, _ in both), 2),
            "backward_ms": round(statistics.median(b for _, b in both), 2),
            "threads": number,
            "mean_ms": round(statistics.mean(f + b for f, b in both), 2),
            "fastest_ms": round(min(f + b for f, b in both), 2),
            "bytes": out.radiance.grad_fn.rasterization.bytes,  # pyright: ignore
            "covered": round(covered, 3),
        }
        rows.append(row)
    return rows


def chart(path: str) -> None:
    """Write an HTML page: cost against pixels and against Gaussians, one thread, best kernel."""
    from plotly.subplots import make_subplots

    native = ("native",)
    by_width = [measure(native, 20_000, width)[0] for width in (100, 200, 400, 800, 1600)]
    by_count = [measure(native, count, 400)[0] for count in (2000, 5000, 20_000, 50_000, 100_000, 200_000)]
    titles = ("20,000 Gaussians", "400 x 400 pixels")
    figure = make_subplots(cols=2, subplot_titles=titles, shared_yaxes=True)
    sides = [
        (by_width, [row["width"] ** 2 for row in by_width]),
        (by_count, [r["gaussians"] for r in by_count]),
    ]
    for column, (rows, x) in enumerate(sides, start=1):
        for name, color in (("forward_ms", "#1f77b4"), ("backward_ms", "#d62728")):
            figure.add_scatter(
                x=x,
                y=[row[name] for row in rows],
                name=name.removesuffix("_ms"),
                line_color=color,
                showlegend=column == 1,
                row=1,
                col=column,
            )
    figure.update_xaxes(type="log", title_text="pixels", col=1)
    figure.update_xaxes(type="log", title_text="Gaussians", col=2)
    figure.update_yaxes(type="log")
    figure.update_yaxes(title_text="ms, one thread", col=1)
    figure.write_html(path)


def spin() -> None:
    while True:
        pass


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--json", action="store_true", help="one JSON object a row")
    parser.add_argument("--quick", action="store_true", help="only the smallest size, every kernel")
    parser.add_argument("--chart", metavar="FILE.html", help="only draw cost against pixels and Gaussians")
    parser.add_argument("--busy", type=int, default=0, metavar="N", help="with N other processes that spin")
    arguments = parser.parse_args()
    others = [multiprocessing.Process(target=spin, daemon=True) for _ in range(arguments.busy)]
    for other in others:
        other.start()
    if arguments.chart:
        return chart(arguments.chart)
    every = [(3000, 200), *itertools.product((20_000, 100_000), (400, 800))]
    sizes = [(2000, 100)] if arguments.quick else every
    kernels = [f"native-{kernel}" for kernel in native_kernels()]
    for count, width in sizes:
        reference_ms = round(measure_reference(count, width))
        rows = measure(kernels, count, width)
        best_ms = next(row["fastest_ms"] for row in rows if row["backend"] == kernels[0])
        for row in rows:
            row["over_best_kernel"] = round(row["fastest_ms"] / best_ms, 2)
        if not arguments.quick:
            rows += measure(("native",), count, width, (1, 2))
        if (count, width) == (20_000, 800):  # the object covers a tenth of the pixels
            rows += measure(("native",), count, width, distance=2.7 * DISTANCE)
        for row in rows:
            row["reference_ms"] = reference_ms
            print(shown(row, "rasterizer", arguments.json), flush=True)


if __name__ == "__main__":
    main()
