"""Masks of pictures in front of a plain screen, such as a blue one: what looks like the border is background."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import imagecodecs
import numpy as np
from scipy.ndimage import median_filter

from ground.formats.pictures.files import FormatError
from ground.formats.pictures.view import View, colours_of, read_image
from obbgs_base.files import write_whole

FITS = 5  # of the screen's plane to the border, each without what the last one found to be something else
FAR = 5.0  # deviations of the border beyond which a colour is another one
LEAST_DEVIATION = 0.004  # of full scale: about that of rounding to 8 bits
LARGEST_DEVIATION = 0.05  # of full scale: a border that scatters by more is not plain
LEAST_SHARE = 0.5  # of the border that shows the screen
SPECKLE_PX = 3


def with_screen_masks(views: Sequence[View], folder: Path) -> list[View]:
    """Return the views with masks that are written into a folder: white where a picture does not show the screen.

    A picture whose border says nothing, because the target fills it, has the screen of those of its exposure time.

    Raises:
        FormatError: a picture cannot be read, or no border of its exposure time is of one colour.
    """
    folder.mkdir(parents=True, exist_ok=True)
    screens = [_screen(_shares(view)) for view in views]
    masked = []
    for number, (view, screen) in enumerate(zip(views, screens, strict=True)):
        alike = [
            s for v, s in zip(views, screens, strict=True) if s and v.exposure_time_s == view.exposure_time_s
        ]
        if not alike:
            raise FormatError(
                f"{view.image}: its border is not of one colour, so no screen can be told from the target: give "
                "--masks a folder of masks"
            )
        planes, sigmas = (np.median(values, axis=0) for values in zip(*alike, strict=True))
        target = median_filter(_away(_shares(view), *(screen or (planes, sigmas))), size=SPECKLE_PX) > FAR
        masked.append(dataclasses.replace(view, mask=folder / f"{number:06d}.png"))
        write_whole(masked[-1].mask, bytes(imagecodecs.png_encode(255 * target.astype(np.uint8), level=1)))
    return masked


def _shares(view: View) -> np.ndarray:
    """Return a view's picture [H, W, C] as shares of full scale."""
    image = read_image(view)
    values = image[..., : colours_of(image)].astype(float)
    return values / (np.iinfo(image.dtype).max if image.dtype.kind == "u" else values.max() or 1.0)


def _away(image: np.ndarray, plane: np.ndarray, sigma: np.ndarray) -> np.ndarray:
    """Return how far each pixel [H, W] of an image [H, W, C] is from a screen in the colour that is furthest off."""
    return (np.abs(image - _places(image) @ plane) / sigma).max(axis=-1)


def _places(image: np.ndarray) -> np.ndarray:
    """Return 1 and the place in the picture, from -0.5 to 0.5, of each pixel [H, W, 3]."""
    height, width = image.shape[:2]
    y, x = np.mgrid[:height, :width]
    return np.stack([np.ones(x.shape), x / width - 0.5, y / height - 0.5], axis=-1)


def _screen(image: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the screen of an image [H, W, C] in 0..1; None if its border does not tell.

    It is a plane of its colours [3, C], because no lamp lights it evenly, through those pixels of the border that lie
    near it, and their deviations [C].
    """
    rim = np.zeros(image.shape[:2], bool)
    rim[[0, -1]] = rim[:, [0, -1]] = True
    border, where = image[rim], _places(image)[rim]
    near = np.abs(border - np.median(border, axis=0)).max(axis=-1) < FAR * LARGEST_DEVIATION
    plane, sigma = np.zeros((3, image.shape[2])), np.zeros(image.shape[2])
    for _ in range(FITS):
        if near.mean() < LEAST_SHARE:
            return None
        plane, *_ = np.linalg.lstsq(where[near], border[near], rcond=None)
        away = np.abs(border - where @ plane)
        sigma = np.maximum(1.4826 * np.median(away[near], axis=0), LEAST_DEVIATION)
        if sigma.max() > LARGEST_DEVIATION:
            return None
        near = (away / sigma).max(axis=-1) < FAR
    return (plane, sigma) if near.mean() >= LEAST_SHARE else None
