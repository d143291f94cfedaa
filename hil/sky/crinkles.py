"""Crinkled foil as heights over a plane: flat facets between sharp folds, a pattern that repeats without a seam.

Only NumPy and the standard library are imported: this runs in Blender's own Python too.
"""

import numpy as np

TILE_M = 1.0  # side of the square that repeats
TILE_PX = 256
FOLDS = 10  # families of parallel folds
MOST_FOLDS = 5  # of one family across the tile and along it: facets are about a decimetre wide
SLOPE = 0.42  # root of the mean squared slope: normals lean by 23 degrees
SEED = 5


def heights_m() -> np.ndarray:
    """Return heights [TILE_PX, TILE_PX] m over the tile, rows along its second axis.

    A sum of triangular waves is piecewise plane. Their wave vectors are whole numbers of folds a tile, so that the
    pattern repeats.
    """
    rng = np.random.default_rng(SEED)
    y, x = (np.mgrid[:TILE_PX, :TILE_PX] + 0.5) / TILE_PX
    total = np.zeros((TILE_PX, TILE_PX))
    for _ in range(FOLDS):
        kx, ky = rng.integers(-MOST_FOLDS, MOST_FOLDS + 1, size=2)
        phase = rng.random()
        folds = np.hypot(kx, ky)
        if folds:
            wave = np.abs(
                (kx * x + ky * y + phase) % 1 - 0.5
            )  # slope 1 in the direction of the wave, over `folds`
            total += wave / folds
    dx, dy = (np.roll(total, -1, axis) - total for axis in (1, 0))
    slope = np.sqrt(np.mean(dx**2 + dy**2)) * TILE_PX / TILE_M
    return total * SLOPE / slope


def normal_map() -> np.ndarray:
    """Return the normals of the heights as glTF stores them, [TILE_PX, TILE_PX, 3] uint8: 0.5 + normal / 2, y upwards.

    Row 0 is the top of the picture, where glTF's second texture coordinate is 0: it grows downwards, with the rows.
    """
    heights = heights_m()
    pixel_m = TILE_M / TILE_PX
    along_u, along_v = ((np.roll(heights, -1, a) - np.roll(heights, 1, a)) / (2 * pixel_m) for a in (1, 0))
    normals = np.stack([-along_u, along_v, np.ones_like(heights)], axis=2)  # y points against v
    normals /= np.linalg.norm(normals, axis=2, keepdims=True)
    return np.round(255 * (0.5 + normals / 2)).astype(np.uint8)
