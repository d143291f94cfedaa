"""Stars behind the target, not a catalogue: random positions, with the number and brightness of the real sky's."""

import functools

import numpy as np

FAINTEST_MAGNITUDE = 9.0
SUN_MAGNITUDE = -26.74
SUN_IRRADIANCE = np.pi  # in the renderer's unit: a white Lambert plate facing the Sun has radiance 1


@functools.cache
def catalogue() -> tuple[np.ndarray, np.ndarray]:
    """Return stars brighter than magnitude 9: directions [N, 3] in GCRS and irradiances [N] in the renderer's unit.

    As on the real sky 5,000 are brighter than magnitude 6, and their number grows as 10^(0.51 m) with the magnitude m
    (Allen's Astrophysical Quantities). Positions are random, with a fixed seed.
    """
    rng = np.random.default_rng(20260721)
    count = round(5000 * 10 ** (0.51 * (FAINTEST_MAGNITUDE - 6)))
    directions = rng.standard_normal((count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    magnitudes = FAINTEST_MAGNITUDE + np.log10(rng.random(count)) / 0.51
    return directions, star_irradiance(magnitudes)


def star_irradiance(magnitude):
    """Return the irradiance of stars of a visual magnitude, a number or an array, in the renderer's unit."""
    return SUN_IRRADIANCE * 10 ** (-0.4 * (magnitude - SUN_MAGNITUDE))


def star_radiance(gcrs_to_camera: np.ndarray, K: np.ndarray, width: int, height: int) -> np.ndarray:
    """Return the stars' radiance [H, W], the light of each star in one pixel; the sensor's PSF spreads it later."""
    directions, irradiances = catalogue()
    in_camera = directions @ gcrs_to_camera.T
    ahead = in_camera[:, 2] > 1e-6
    image = in_camera[ahead] @ np.asarray(K).T
    column, row = np.floor(image[:, :2] / image[:, 2:]).T
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    radiance = np.zeros((height, width))
    pixel_sr = 1 / (K[0][0] * K[1][1])
    place = (row[inside].astype(int), column[inside].astype(int))
    np.add.at(radiance, place, irradiances[ahead][inside] / pixel_sr)
    return radiance
