"""How far the truth of the rendered targets is from light without noise: what PSNR a perfect model could show.

The targets were rendered with 16 light paths a pixel and denoised. Some of their views are rendered again with other
light paths, and with 256: against those, the truth itself is scored as a model would be. Blender is needed; what is
rendered already is kept:

    python -m tests.benchmarks.truth_floor --mesh ../shared/models/obr-st/TDRS.glb --kept floor TDRS --json
"""

import argparse
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from ground.run.scores import ScoredView, clean_scores
from ground.session.cameras import exposed
from hil.sky.blender import Worker
from tests.benchmarks.rendered import ask_for_view
from tests.benchmarks.rows import shown
from tests.benchmarks.targets import FOLDER, LARGEST_DIMENSION, expose

KINDS = {
    "16 paths": (16, 0),
    "16 other paths": (16, 1),
    "256 paths": (256, 2),
}  # light paths a pixel, and their seed
SIZES = (400, 200, 100)
DATA_FROM_MESH = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # the data have glTF's y upwards as z


def rendered_views(mesh: Path, name: str, numbers: list[int], kept: Path) -> dict[str, list[Tensor]]:
    """Return radiance [400, 400, 3] of some views of a target, rendered in each of `KINDS`."""
    with np.load(FOLDER / f"{name}_400.npz") as arrays:
        poses, K, sun = arrays["world_to_camera"], arrays["K"], arrays["sun_dir"]
    kept.mkdir(parents=True, exist_ok=True)
    views: dict[str, list[Tensor]] = {}
    for kind, (samples, seed) in KINDS.items():
        worker: Worker | None = None
        for number in numbers:
            path, part = kept / f"{name}-{samples}-{seed}-{number}.npz", kept / "part.npz"
            if not path.exists():
                worker = worker or Worker(mesh, samples=samples)
                pose = poses[number].copy()
                pose[:3, :3] = pose[:3, :3] @ DATA_FROM_MESH
                pose[:3, 3] *= worker.facts["largest_dimension_m"] / LARGEST_DIMENSION
                ask_for_view(worker, pose, DATA_FROM_MESH.T @ sun, K, 400, 3, part, seed)
                part.rename(path)
                print(f"{name}, {kind}: view {number}", flush=True)
            with np.load(path) as picture:
                views.setdefault(kind, []).append(torch.from_numpy(picture["radiance"].astype(np.float32)))
        if worker is not None:
            worker.close()
    return views


def floor(name: str, size: int, numbers: list[int], views: dict[str, list[Tensor]]) -> dict[str, float]:
    """Return the scores of the truth of a target, and of its views rendered again, against those of 256 paths."""
    target = expose(name, size)
    views = views | {"the data": [target.views[i].radiance for i in numbers]}

    def pictures(kind: str) -> list[Tensor]:
        small = [F.adaptive_avg_pool2d(light.movedim(-1, 0), size).movedim(0, -1) for light in views[kind]]
        times = [target.views[i].frame.exposure_time_s for i in numbers]
        return [exposed(light, target.sensor, time_s) for light, time_s in zip(small, times, strict=True)]

    figures: dict[str, float] = {}
    coverage = [target.views[i].alpha for i in numbers]
    for key, a, b in (
        ("perfect", "256 paths", "16 paths"),  # a model of light without noise against a truth with it
        ("other", "16 other paths", "16 paths"),
        ("data", "the data", "16 paths"),  # infinite if they are rendered as the data were
    ):
        scored = [ScoredView(*each, 1.0) for each in zip(pictures(a), pictures(b), coverage, strict=True)]
        scores = clean_scores(scored)
        figures[f"psnr_{key}_db"] = scores["psnr_clean_db"]
        figures[f"psnr_{key}_foreground_db"] = scores["psnr_clean_foreground_db"]
    return {key: round(value, 3) for key, value in figures.items()}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("name", help="of the target")
    parser.add_argument("--mesh", type=Path, required=True, help="that it was rendered from")
    parser.add_argument("--views", type=int, default=20, help="how many, evenly over all")
    parser.add_argument("--kept", type=Path, required=True, help="folder for the pictures")
    parser.add_argument("--json", action="store_true", help="print rows with their origin")
    arguments = parser.parse_args()
    numbers = np.linspace(0, 119, arguments.views).round().astype(int).tolist()
    views = rendered_views(arguments.mesh, arguments.name, numbers, arguments.kept)
    for size in SIZES:
        row = {"target": f"{arguments.name}-{size}", "views": len(numbers)}
        print(shown(row | floor(arguments.name, size, numbers, views), "truth_floor", arguments.json))


if __name__ == "__main__":
    main()
