"""Motion blur and rolling shutter: the image velocity of each pixel, and the picture averaged along it.

One rendered view is warped in the image plane. That is exact for a surface that stays in view while the shutter is
open; what is uncovered or hidden behind an edge in that time is not modelled.
"""

import numpy as np
from scipy.ndimage import distance_transform_edt, map_coordinates

NEGLIGIBLE_PX = 0.02  # smaller movements are left out
STEP_PX = 0.5  # between the shifted copies that are averaged


def image_velocity(
    depth: np.ndarray, K: np.ndarray, before: np.ndarray, after: np.ndarray, interval_s: float
) -> np.ndarray:
    """Return how fast the point seen by each pixel moves in the image, [H, W, 2] px/s (x, y).

    Background pixels take the velocity of the nearest pixel of the target, whose light may be blurred into them.

    Args:
        depth: [H, W] planar, m, at the middle of the interval; inf where nothing is seen.
        before, after: [4, 4] world_to_camera at the interval's ends.
    """
    seen = np.isfinite(depth)
    velocity = np.zeros((*depth.shape, 2))
    if not seen.any():
        return velocity
    rows, columns = np.nonzero(seen)
    z = depth[seen].astype(np.float64)
    pixels = np.stack([columns + 0.5, rows + 0.5, np.ones(len(z))])
    in_camera = np.linalg.solve(K, pixels) * z  # [3, N] at mid-interval
    to_middle = _half_way(before, after)
    points = to_middle[:3, :3].T @ (in_camera - to_middle[:3, 3:])
    moved = _project(K, after, points) - _project(K, before, points)
    velocity[seen] = moved.T / interval_s
    nearest = distance_transform_edt(~seen, return_distances=False, return_indices=True)
    assert nearest is not None
    return velocity[nearest[0], nearest[1]]


def smear(
    radiance: np.ndarray, velocity_px_s: np.ndarray, exposure_time_s: float, line_time_s: float = 0.0
) -> np.ndarray:
    """Return the mean radiance [H, W, C] over an exposure centred on the picture's time.

    Args:
        radiance: [H, W, C] at mid-exposure of the middle row.
        velocity_px_s: [H, W, 2].
        line_time_s: of a rolling shutter, whose row r opens (r - H/2) line times after the middle row; 0 for none.
    """
    height, width = radiance.shape[:2]
    fastest_px_s = float(np.abs(velocity_px_s).max())
    if fastest_px_s * (exposure_time_s + height * line_time_s) < NEGLIGIBLE_PX:
        return radiance
    copies = max(1, int(np.ceil(fastest_px_s * exposure_time_s / STEP_PX)))
    open_s = ((np.arange(copies) + 0.5) / copies - 0.5) * exposure_time_s
    delay_s = (np.arange(height) + 0.5 - height / 2) * line_time_s
    rows, columns = np.mgrid[0.0:height, 0.0:width]
    total = np.zeros(radiance.shape)
    for moment_s in open_s:
        offset = velocity_px_s * (moment_s + delay_s)[:, None, None]
        source = np.stack([rows - offset[..., 1], columns - offset[..., 0]])
        for channel in range(radiance.shape[2]):
            total[..., channel] += map_coordinates(
                radiance[..., channel].astype(np.float64), source, order=3, mode="constant"
            )
    return np.maximum(total / copies, 0)  # cubic splines undershoot beside bright edges


def _project(K: np.ndarray, world_to_camera: np.ndarray, points: np.ndarray) -> np.ndarray:
    image = K @ (world_to_camera[:3, :3] @ points + world_to_camera[:3, 3:])
    return image[:2] / image[2]


def _half_way(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Return the pose halfway between two similar ones: their mean, its rotation made orthonormal again."""
    middle = (before + after) / 2
    u, _, vt = np.linalg.svd(middle[:3, :3])
    middle[:3, :3] = u @ vt
    return middle
