"""Which places of a design the frames would show, if it were built so: in front of some camera, and in the Sun."""

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from obbgs_core.inspect.cad import Samples

LEAST_COSINE, LEAST_SUN_COSINE = (
    0.25,
    0.15,
)  # of view and Sun to the surface: what lies flatter is hardly seen or lit
DEPTH_PX = 3.0  # behind the nearest surface by more than so many pixels: hidden
SUNS_APART = 0.9962  # cosine of 5 degrees: directions of the Sun nearer to each other throw the same shadows


@dataclass(frozen=True)
class Views:
    """Frames: world_to_camera [C, 4, 4], K [C, 3, 3] px, image size, and suns [C, 3], unit vectors; None: unknown."""

    world_to_camera: np.ndarray
    K: np.ndarray
    width: int
    height: int
    suns: np.ndarray | None = None


def views_showing(design: Samples, views: Views, pixel_m: float) -> np.ndarray:
    """Return how many views [N] show each sample of a design: unhidden by the rest of it, and lit on the side seen.

    Either side of a triangle may be the outer one. Without directions to the Sun everything counts as lit.

    Args:
        design: in the body's axes, m, its points not much farther apart than a pixel is wide.
        pixel_m: the width of a pixel at the body.
    """
    count = np.zeros(len(design.points), dtype=np.int64)
    shadows: list[tuple[np.ndarray, np.ndarray]] = []
    for c, pose in enumerate(views.world_to_camera):
        at = design.points @ pose[:3, :3].T + pose[:3, 3]
        z = np.maximum(at[:, 2], 1e-9)
        image = at @ views.K[c].T
        place = image[:, :2] / z[:, None]
        inside = (
            (at[:, 2] > pixel_m)
            & (place >= 0).all(axis=1)
            & (place < [views.width, views.height]).all(axis=1)
        )
        cosine = -(design.normals @ pose[:3, :3].T * at).sum(axis=1) / np.linalg.norm(at, axis=1).clip(1e-9)
        seen = inside & (np.abs(cosine) > LEAST_COSINE)
        seen &= _foremost(place, z, inside, DEPTH_PX * pixel_m)
        if views.suns is not None:
            sun = views.suns[c]
            shadow = next((lit for towards, lit in shadows if towards @ sun > SUNS_APART), None)
            if shadow is None:
                shadow = _in_the_sun(design, sun, pixel_m)
                shadows.append((sun, shadow))
            seen &= shadow * np.sign(cosine) > 0
        count += seen
    return count


def _in_the_sun(design: Samples, sun: np.ndarray, pixel_m: float) -> np.ndarray:
    """Return of each sample [N] which side the Sun shines on: 1, that of its normal, -1, the other, 0, neither."""
    across = np.linalg.svd(sun[None])[2][1:]  # two axes across the Sun's rays
    place = design.points @ across.T / pixel_m
    lit = _foremost(
        place - place.min(axis=0), -design.points @ sun, np.ones(len(place), dtype=bool), DEPTH_PX * pixel_m
    )
    cosine = design.normals @ sun
    return np.sign(cosine) * (lit & (np.abs(cosine) > LEAST_SUN_COSINE))


def _foremost(place: np.ndarray, depth: np.ndarray, inside: np.ndarray, tolerance: float) -> np.ndarray:
    """Return which points [N] lie within a tolerance of the least depth in their pixel and its eight neighbours."""
    cell = np.where(inside[:, None], place, 0).astype(np.int64)
    shape = cell.max(axis=0) + 1
    nearest = np.full(shape, np.inf)
    np.minimum.at(nearest, tuple(cell[inside].T), depth[inside])
    nearest = ndimage.minimum_filter(nearest, 3, mode="nearest")
    return inside & (depth <= nearest[tuple(cell.T)] + tolerance)
