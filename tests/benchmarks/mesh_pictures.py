"""Pictures of a mesh by Blender for a simulated pass, under the scenario's Sun; for the benchmark `poses`."""

import tempfile
from pathlib import Path

import numpy as np

from hil.sky.blender import Worker
from tests.benchmarks.rendered import ask_for_view, shown_points


def pictures(
    mesh: Path, size_m: float, poses: np.ndarray, suns: np.ndarray, K: np.ndarray, size_px: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return radiance [F, H, W], coverage [F, H, W] and points [M, 3] m on the surface that some of the views see.

    Args:
        size_m: the largest dimension that the mesh is given.
        poses: [F, 4, 4] body to camera, m; suns: [F, 3] towards the Sun, unit, body frame; K: [3, 3] px.
    """
    worker, light, alpha = Worker(mesh), [], []
    try:
        own = worker.facts["largest_dimension_m"] / size_m
        scaled = poses.copy()
        scaled[:, :3, 3] *= own
        with tempfile.TemporaryDirectory() as folder:
            out = Path(folder) / "picture.npz"
            for pose, sun in zip(scaled, suns, strict=True):
                ask_for_view(worker, pose, sun, K, size_px, 1, out)
                with np.load(out) as picture:
                    light.append(picture["radiance"][..., 0].astype(float))
                    alpha.append(picture["alpha"] / 255)
            points = shown_points(worker, scaled, Path(folder))
    finally:
        worker.close()
    return np.stack(light), np.stack(alpha), points / own
