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

    Raises:
        FormatError: a picture cannot be read, or its border is not of one colour.
    """
    folder.mkdir(parents=True, exist_ok=True)
    masked = []
    for number, view in enumerate(views):
        image = read_image(view)
        values = image[..., : colours_of(image)].astype(float)
        full_scale = np.iinfo(image.dtype).max if image.dtype.kind == "u" else values.max()
        target = _differs(values / full_scale, view)
        mask = imagecodecs.png_encode(255 * target.astype(np.uint8), level=1)
        masked.append(dataclasses.replace(view, mask=folder / f"{number:06d}.png"))
        write_whole(masked[-1].mask, bytes(mask))
    return masked


def _differs(image: np.ndarray, view: View) -> np.ndarray:
    """Return which pixels [H, W] of an image [H, W, C] in 0..1 do not show the screen.

    The screen's colour is a plane over the picture, because no lamp lights it evenly, through those pixels of the
    border that lie near it.
    """
    height, width = image.shape[:2]
    y, x = np.mgrid[:height, :width]
    where = np.stack([np.ones(x.shape), x / width - 0.5, y / height - 0.5], axis=-1)
    rim = np.zeros((height, width), bool)
    rim[[0, -1]] = rim[:, [0, -1]] = True
    near = rim & (np.abs(image - np.median(image[rim], axis=0)).max(axis=-1) < FAR * LARGEST_DEVIATION)
    away = np.zeros(rim.shape)
    for _ in range(FITS):
        sigma = np.full(image.shape[2], np.inf)
        if near.sum() >= LEAST_SHARE * rim.sum():
            plane, *_ = np.linalg.lstsq(where[near], image[near], rcond=None)
            away = np.abs(image - where @ plane)
            sigma = np.maximum(1.4826 * np.median(away[near], axis=0), LEAST_DEVIATION)
        if sigma.max() > LARGEST_DEVIATION:
            raise FormatError(
                f"{view.image}: its border is not of one colour, so no screen can be told from the target: give "
                "--masks a folder of masks"
            )
        away = (away / sigma).max(axis=-1)
        near = rim & (away < FAR)
    return median_filter(away, size=SPECKLE_PX) > FAR
