"""How much of the true surface a model's mesh shows: python -m tests.benchmarks.mesh --session DIR --model model.ply

The mesh is written and read as `model.glb`; 100,000 points at random places of its area are compared with the truth of
a simulated session. `--json` prints the row for `results/mesh-400x400.jsonl`.
"""

import argparse
import tempfile
import time
from pathlib import Path

import torch

from compare.case import load_case
from ground.run.mesh_files import read_mesh_points, write_mesh
from ground.run.scores import cloud_scores
from ground.session.cameras import sensor_of
from ground.session.training_frames import split
from obbgs_core.frames import mean_exposure_s
from obbgs_core.io.ply import load_ply
from tests.benchmarks.rows import shown

POINTS = 100_000


def measure(folder: Path, model: Path) -> dict:
    """Return the row of one model and the session that it was trained on."""
    case, gaussians = load_case(folder), load_ply(model)
    if case.session is None or case.cloud_m is None:
        raise SystemExit(f"{folder} has no truth to compare a mesh with: take a simulated session")
    white = sensor_of(case.session.camera).full_scale_radiance(mean_exposure_s(case.training))
    with tempfile.TemporaryDirectory() as temporary:
        path = Path(temporary) / "model.glb"
        began = time.process_time()
        figures = write_mesh(gaussians, case.session, split(case.session)[0], path, white)
        seconds = time.process_time() - began
        points_m = read_mesh_points(path, POINTS)
    scores = cloud_scores({"_mesh": points_m}, case.cloud_m, case.units_per_m, case.shown)
    scored = {key: round(value, 5) for key, value in scores.items()}
    return {"target": case.name, "gaussians": len(gaussians)} | figures | scored | {"cpu_seconds": seconds}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--session", type=Path, required=True)
    parser.add_argument("--model", type=Path, required=True, help="a model.ply that was trained on it")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    print(shown(measure(arguments.session, arguments.model), "mesh", arguments.json))


if __name__ == "__main__":
    main()
