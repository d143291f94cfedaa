"""The sRGB curve between light and display values, both from 0 to 1.

Source: IEC 61966-2-1.
"""

import numpy as np


def from_srgb(value: np.ndarray) -> np.ndarray:
    """Return the light that sRGB-coded values stand for."""
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)


def to_srgb(light: np.ndarray) -> np.ndarray:
    """Return the sRGB-coded values of light."""
    light = np.clip(light, 0, None)
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
