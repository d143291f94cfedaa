"""Pictures for people: frames and model images in screen brightness, errors in colour, cropping to the target."""

import numpy as np
import torch

from obbgs_core.sensor import Sensor

ERROR_FULL_SCALE = 0.1  # of full scale: this error and larger ones are shown white


def tone(image: np.ndarray, sensor: Sensor, encoding: str = "linear") -> np.ndarray:
    """Return an image [H, W, C] (fractions of full scale) for the screen, as bytes [H, W, 3].

    Brightness is the square root of the signal above black, of display values (encoding `srgb`) the signal itself; full
    scale is white.
    """
    black = sensor.black_dn / sensor.white_dn
    shown = np.clip((image - black) / (1 - black), 0, 1)
    if encoding == "linear":
        shown = np.sqrt(shown)
    return np.broadcast_to((255 * shown).round().astype(np.uint8), (*image.shape[:2], 3))


def heat(error: np.ndarray) -> np.ndarray:
    """Return errors [H, W, 1] of 0 to 1 as black, red, yellow and white, as bytes [H, W, 3]."""
    shown = np.clip(3 * error - np.array([0.0, 1.0, 2.0]), 0, 1)
    return (255 * shown).round().astype(np.uint8)


def bounding_box(mask: torch.Tensor, margin_px: int) -> tuple[slice, slice]:
    """Return the rows and columns around a mask [H, W] with a margin; the whole image when it is empty."""
    rows, columns = torch.nonzero(mask.any(dim=1))[:, 0], torch.nonzero(mask.any(dim=0))[:, 0]
    if len(rows) == 0:
        return slice(None), slice(None)
    top, left = max(0, int(rows[0]) - margin_px), max(0, int(columns[0]) - margin_px)
    return slice(top, int(rows[-1]) + margin_px + 1), slice(left, int(columns[-1]) + margin_px + 1)
