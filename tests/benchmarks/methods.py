"""Every method on the rendered targets, in the same run: python -m tests.benchmarks.methods

Each row is one training: clean held-out PSNR, geometry, size and seconds of training alone (measuring stops the clock).
`--curve` adds the clean PSNR and Chamfer distance on the way, `--chart FILE` draws them against seconds. Published
methods are blind to exposure, as published; `NAME+exposure` gives them the exposure and the sensor's gain. `black` and
`mean` are images that nothing was trained for, `untrained` are the Gaussians that `obbgs` starts from.
"""

import argparse
import json
import math
from pathlib import Path

import torch

from obbgs_core.train.presets import PRESETS, preset
from obbgs_core.train.trainer import Trainer
from tests import baselines
from tests.benchmarks import targets
from tests.benchmarks.rows import shown

WITHOUT_TRAINING = {"black": baselines.black, "mean": baselines.mean_image}
CURVE_STEPS = (0.02, 0.05, 0.1, 0.2, 0.35, 0.5, 0.7)  # shares of the steps


def configure(name: str, steps_share: float, changes: dict | None = None):
    """Return the configuration of a method or variant with its steps scaled."""
    return preset(name, {"steps": max(1, round(preset(name).steps * steps_share))} | (changes or {}))


def measure(
    config, target: targets.Target, seed: int, curve: bool = False, time_limit_s: float = math.inf
) -> dict:
    """Return a row: what the method reached on the target, and on the way if asked."""
    trainer = Trainer(target.training, target.sensor, config, seed)
    marks = {round(share * config.steps) for share in CURVE_STEPS} if curve else set()
    way = []
    while not (reason := trainer.stop_reason(time_limit_s)):
        info = trainer.step()
        if info.step in marks:
            gaussians = trainer.gaussians
            clean = targets.clean_psnr_db(gaussians, target, trainer.setup.reference_exposure_s)
            chamfer = targets.cloud_distances(gaussians.means.double().numpy(), target.cloud)["chamfer"]
            way.append((round(info.seconds, 2), round(clean, 3), round(chamfer, 5)))
    result = trainer.result(reason)
    row = {
        "target": target.name,
        "seed": seed,
        "gaussians": len(result.gaussians),
        "steps": trainer.state.steps_done,
    }
    row |= {"seconds": round(result.seconds, 2), "start": result.start, "stop": result.stop_reason}
    row |= {"appearance": result.appearance, "growth": result.growth}
    row |= {"poses": result.poses}
    row |= targets.image_figures(result.gaussians, target, result.reference_exposure_s)
    row |= targets.cloud_figures(result.gaussians, target, seed)
    row = {key: round(value, 5) if isinstance(value, float) else value for key, value in row.items()}
    if curve:
        row["curve"] = [*way, (row["seconds"], row["psnr_clean_db"], row["chamfer"])]
    return row


def measure_named(name: str, target: targets.Target, share: float, seed: int, curve: bool) -> dict:
    """Return the row of `METHOD`, `METHOD+exposure` or of what is not trained: `black`, `mean`, `untrained`."""
    if name in WITHOUT_TRAINING:
        score = WITHOUT_TRAINING[name](target)
        figures = {"psnr_clean_db": score.clean_db, "psnr_foreground_db": score.foreground_db}
        return {"target": target.name} | {key: round(value, 5) for key, value in figures.items()}
    if name == "untrained":
        return measure(configure("obbgs", share), target, seed, time_limit_s=0.0)
    return measure(configure(name, share), target, seed, curve)


def draw(rows: list[dict], path: Path) -> None:
    """Draw clean PSNR and Chamfer distance against seconds, one line a training, as PNG or SVG by the file's name."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 4.2), layout="constrained")
    axes = figure.subplots(1, 2)
    colours: dict[str, str] = {}
    for row in rows:
        seconds, psnr_db, chamfer = zip(*row["curve"], strict=True)
        label = None if row["method"] in colours else row["method"]
        colour = colours.setdefault(row["method"], f"C{len(colours)}")
        for axis, values in zip(axes, (psnr_db, chamfer), strict=True):
            axis.plot(seconds, values, marker=".", color=colour, label=label)
    for axis, title in zip(axes, ("clean held-out PSNR, dB", "Chamfer distance of the centres"), strict=True):
        axis.set(xscale="log", xlabel="seconds of training", title=title)
        axis.grid(alpha=0.3)
    axes[1].set_yscale("log")
    axes[0].legend()
    figure.savefig(path, dpi=110)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--json", action="store_true", help="one JSON object a row")
    parser.add_argument(
        "--methods", default="3dgs,pixel-gs,mvgs,jiang2025,obbgs", help="comma-separated, or all"
    )
    parser.add_argument("--targets", default="all", help="comma-separated names, or all")
    parser.add_argument("--seeds", type=int, default=1, help="trainings of each, seeds 0, 1, ...")
    parser.add_argument("--size", type=int, default=400, help="pixels along a side: 400, 200 or 100")
    parser.add_argument("--steps-share", type=float, default=1.0, help="of each method's own steps")
    parser.add_argument("--published-share", type=float, help="the same for all methods but obbgs")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--curve", action="store_true", help="measure on the way")
    parser.add_argument("--chart", type=Path, help="draw the curves into this file, PNG or SVG")
    parser.add_argument(
        "--rows",
        type=Path,
        nargs="+",
        help="draw what --curve --json printed into these files; train nothing",
    )
    arguments = parser.parse_args()
    if arguments.rows:
        if arguments.chart is None:
            parser.error("--rows needs --chart FILE")
        if absent := [str(path) for path in arguments.rows if not path.is_file()]:
            parser.error(f"no such file: {', '.join(absent)}")
        lines = [line for path in arguments.rows for line in path.read_text().splitlines()]
        rows = [row for row in map(json.loads, lines) if "curve" in row]
        if not rows:
            parser.error("no row of these files has a curve; print them with --curve --json")
        draw(rows, arguments.chart)
        return
    torch.set_num_threads(arguments.threads)
    names = arguments.methods.split(",")
    if arguments.methods == "all":
        names = [*PRESETS, *(f"{name}+exposure" for name in PRESETS if not PRESETS[name].exposure_aware)]
    rows = []
    for target_name in targets.names() if arguments.targets == "all" else arguments.targets.split(","):
        target = targets.load(target_name, arguments.size)
        for name in names:
            share = arguments.steps_share
            if not name.startswith("obbgs") and arguments.published_share is not None:
                share = arguments.published_share
            for seed in range(arguments.seeds):
                curve = arguments.curve or arguments.chart is not None
                figures = measure_named(name, target, share, seed, curve)
                row = {"method": name, "size": arguments.size, "steps_share": share} | figures
                rows.append(row)
                print(shown(row, "methods", arguments.json), flush=True)
    if arguments.chart is not None:
        draw([row for row in rows if "curve" in row], arguments.chart)


if __name__ == "__main__":
    main()
