"""Which part of a true surface the frames show at all: what was in view, and bright enough to rise above the noise."""

import math
from collections.abc import Sequence

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from obbgs_core.frames import TrainingFrame
from obbgs_core.sensor import Sensor, dark_reading

SHOWN_SIGMA = 5.0  # of the noise of the light of all frames together
FEWEST_VIEWS = 2  # one alone tells no depth
# of the surface facing a camera, at least: through emptier cells those behind would be seen
POINTS_PER_CELL = 2.0
SAME_DEPTH_CELLS = 3.0  # behind the nearest point of its cell, in widths of a cell, a point is still in view


def shown_points(points_m: np.ndarray, frames: Sequence[TrainingFrame], sensor: Sensor) -> np.ndarray:
    """Return which points [N] of a surface the frames show.

    A point is in view of a camera if no other point in its cell of the picture, or those around it, is clearly nearer.
    The readings of the frames that have it in view, at least two, are added up, weighted as for a radiance that is the
    same from all sides; the point is shown if the sum exceeds that of an unlit point by SHOWN_SIGMA deviations. What is
    shown less is dark or behind other parts. A wide face of such points may still be found, by what all of them read
    together.

    Args:
        points_m: [N, 3] m, body frame, evenly over the whole surface.
        frames: in front of a black sky, with true poses.
    """
    points = torch.from_numpy(np.ascontiguousarray(points_m, dtype=np.float32))
    dark_dn, sigma_dn = dark_reading(sensor)
    light, weight, views = torch.zeros(3, len(points))
    for frame in frames:
        signal = (frame.dn.mean(dim=-1) - dark_dn) / (sigma_dn / math.sqrt(frame.shape[2]))
        index, pixel = _in_view(points, frame)
        light[index] += frame.exposure_time_s * signal.flatten()[pixel]
        weight[index] += frame.exposure_time_s**2
        views[index] += 1
    return ((views >= FEWEST_VIEWS) & (light > SHOWN_SIGMA * weight.sqrt())).numpy()


def _in_view(points: Tensor, frame: TrainingFrame) -> tuple[Tensor, Tensor]:
    """Return the points [K] that a camera has in view, by their index, and the index [K] of the pixel of each."""
    pose, K, (height, width) = frame.world_to_camera, frame.K, frame.shape[:2]
    p = points @ pose[:3, :3].T + pose[:3, 3]
    z = p[:, 2]
    u, v = (K[i, i] * p[:, i] / z + K[i, 2] for i in (0, 1))
    inside = torch.nonzero((z > 0) & (u >= 0) & (v >= 0) & (u < width) & (v < height))[:, 0]
    if len(inside) == 0:
        return inside, inside
    u, v, z = u[inside], v[inside], z[inside]
    area_px = float((u.max() - u.min() + 1) * (v.max() - v.min() + 1))
    cell_px = max(1.0, math.sqrt(POINTS_PER_CELL * 2 * area_px / len(inside)))  # half of the points face away
    rows, columns = math.ceil(height / cell_px), math.ceil(width / cell_px)
    cell = (v / cell_px).long() * columns + (u / cell_px).long()
    nearest = torch.full((rows * columns,), torch.inf).scatter_reduce(0, cell, z, "amin")
    nearest = -F.max_pool2d(-nearest.reshape(1, rows, columns), 3, 1, 1).flatten()
    kept = z <= nearest[cell] + SAME_DEPTH_CELLS * cell_px * z / K[0, 0]
    return inside[kept], v[kept].long() * width + u[kept].long()
