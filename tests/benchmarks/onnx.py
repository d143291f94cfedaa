"""Time, memory and agreement of the exported renderer on one core of onnxruntime: python -m tests.benchmarks.onnx

Rows are balls of Gaussians, the last one matt under Suns that move, or the model of a run with `--model model.ply`.
Time and memory are those of a process of its own that holds only numpy and onnxruntime, as on board, bound to one core.
"""

import argparse
import dataclasses
import json
import math
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

# torch and our library are imported where they are used: the process that is measured imports this module too

WIDTH = 256
VIEWS = 20
FOCAL_PX = 1.3 * WIDTH
EXPOSURE_S = 1e-4


def run_on_one_core(model: str, folder: str) -> None:
    """Render the views in `folder`, leave the outputs there and print the figures: the process that is measured."""
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    import onnxruntime

    views = np.load(Path(folder) / "views.npz")
    bare_mb = _peak_mb()
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    session = onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])
    outputs: dict[str, list] = {"image": [], "alpha": [], "depth": []}
    wall_ms, cpu_ms = [], []
    takes_sun = "sun_dir" in [each.name for each in session.get_inputs()]
    for i in [0, *range(VIEWS)]:  # the first is to warm up
        feed = {
            "world_to_camera": views["poses"][i],
            "K": views["K"],
            "exposure_time_s": views["exposure_time_s"],
        }
        if takes_sun:
            feed["sun_dir"] = views["suns"][i]
        wall, cpu = time.perf_counter(), time.process_time()
        rendered = session.run(list(outputs), feed)
        wall_ms.append(1e3 * (time.perf_counter() - wall))
        cpu_ms.append(1e3 * (time.process_time() - cpu))
        for images, image in zip(outputs.values(), rendered, strict=True):
            images.append(image)
    peak_mb = _peak_mb()
    image, alpha, depth = (np.stack(images[1:]) for images in outputs.values())
    np.savez(Path(folder) / "outputs.npz", image=image, alpha=alpha, depth=depth)
    figures = {
        "ms": round(statistics.median(wall_ms[1:]), 1),
        "ms_max": round(max(wall_ms[1:]), 1),
        "cpu_ms": round(statistics.median(cpu_ms[1:]), 1),
        "process_mb": round(peak_mb),
        "over_bare_runtime_mb": round(peak_mb - bare_mb),
    }
    print(json.dumps(figures))


def _peak_mb() -> float:
    """Return this process's largest resident memory; getrusage would count the parent that it was forked from."""
    status = Path("/proc/self/status").read_text()
    return int(status.partition("VmHWM:")[2].split()[0]) / 1024


def random_poses(distance: float, seed: int = 0) -> np.ndarray:
    """Return world_to_camera [VIEWS, 4, 4] of cameras turned at random that see the origin."""
    rng = np.random.default_rng(seed)
    poses = np.tile(np.eye(4), (VIEWS, 1, 1))
    for pose in poses:
        turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
        pose[:3, :3] = turn * np.sign(np.linalg.det(turn))
        pose[2, 3] = distance
    return poses.astype(np.float32)


def measure(gaussians, distance: float) -> dict:
    """Return one row: time and memory on one core, and the lowest PSNR of any view against `render`.

    parity_db is against float32 and 20 views; parity_float64_db is one view against the reference in float64, and
    render_float64_db is the same for our own float32: what the number format itself costs.
    """
    import torch

    from obbgs_core.io.onnx import export_onnx
    from obbgs_core.model.cameras import Cameras
    from obbgs_core.render import render
    from obbgs_core.score.metrics import psnr_db
    from obbgs_core.sensor import Sensor

    poses, suns = random_poses(distance), random_poses(0.0, seed=1)[:, 2, :3].copy()
    K = np.array([[FOCAL_PX, 0, WIDTH / 2], [0, FOCAL_PX, WIDTH / 2], [0, 0, 1]], dtype=np.float32)
    matrices = torch.tensor(K).expand(VIEWS, 3, 3)
    cameras = Cameras(torch.tensor(poses), matrices, WIDTH, WIDTH, sun_dir=torch.tensor(suns))
    ours = render(gaussians, cameras)
    full_scale = float(ours.radiance[ours.radiance > 0].quantile(0.99))
    sensor = Sensor(64, 4095, 4031 / (full_scale * EXPOSURE_S), electrons_per_dn=4, read_noise_dn=8)

    def image(radiance: torch.Tensor) -> torch.Tensor:
        return (sensor.expected_dn(radiance, EXPOSURE_S) / sensor.white_dn).clamp(0, 1)

    with tempfile.TemporaryDirectory() as folder:
        exported = export_onnx(gaussians, sensor, Path(folder) / "m.onnx", WIDTH, WIDTH, [EXPOSURE_S])
        exposure_time_s = np.float32(EXPOSURE_S)
        np.savez(Path(folder) / "views.npz", poses=poses, suns=suns, K=K, exposure_time_s=exposure_time_s)
        code = "import sys; from tests.benchmarks.onnx import run_on_one_core; run_on_one_core(*sys.argv[1:])"
        command = [sys.executable, "-c", code, str(exported.path), folder]
        figures = json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
        with np.load(Path(folder) / "outputs.npz") as arrays:
            images, alphas, depths = (torch.tensor(arrays[name]) for name in ("image", "alpha", "depth"))
    parameters = gaussians.parameters().items()
    double = dataclasses.replace(gaussians, **{name: value.double() for name, value in parameters})
    first = dataclasses.replace(
        cameras.one(0), world_to_camera=cameras.world_to_camera[:1].double(), K=cameras.K[:1].double()
    )
    exact = image(render(double, first, "reference").radiance[0])
    own = image(ours.radiance)
    covered = ours.alpha > 0.5
    return {
        "gaussians": len(gaussians),
        "width": WIDTH,
        "shading": gaussians.shading,
        **figures,
        "file_mb": round(exported.size_bytes / 1e6, 2),
        "parity_db": round(min(psnr_db(a, b) for a, b in zip(images, own, strict=True)), 1),
        "parity_float64_db": round(psnr_db(images[0], exact), 1),
        "render_float64_db": round(psnr_db(own[0], exact), 1),
        "alpha_max_error": round(float((alphas - ours.alpha).abs().max()), 5),
        "depth_mean_error_m": round(float((depths - ours.depth)[covered].abs().mean()), 7),
        "covered": round(float(covered.float().mean()), 3),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", action="store_true", help="one JSON object a row")
    parser.add_argument("--model", type=Path, help="measure this model.ply of a run")
    arguments = parser.parse_args()

    import torch

    from obbgs_core.errors import ReconstructionError
    from obbgs_core.io.ply import load_ply
    from tests.benchmarks.rasterizer import scene
    from tests.benchmarks.rows import shown

    if arguments.model:
        try:
            gaussians = load_ply(arguments.model)
        except (OSError, ReconstructionError) as error:
            parser.error(str(error))
        radius = float((gaussians.means - gaussians.means.median(dim=0).values).norm(dim=1).quantile(0.99))
        gaussians.means = gaussians.means - gaussians.means.median(dim=0).values
        cases = [(gaussians, 3 * radius)]
    else:
        cases = [(scene(count), 3.0) for count in (1000, 5000, 20_000)]
        cases.append((scene(5000), 200.0))  # a few pixels: every Gaussian in one tile
        matt = dataclasses.replace(scene(5000), shading="lambert", ambient=torch.tensor(0.05))
        cases.append((matt, 3.0))  # casts shadows first
    for gaussians, distance in cases:
        row = measure(gaussians, distance)
        if math.isnan(row["parity_db"]):
            raise SystemExit("the exported renderer gives NaN")
        print(shown(row, "onnx", arguments.json), flush=True)


if __name__ == "__main__":
    main()
