"""Lenses: OpenCV's distortion and skew, and the picture of a pinhole camera that a distorted picture is turned into.

Source: OpenCV's model, radial k1, k2, k3 and tangential p1, p2.
"""

import functools
import math
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.ndimage import map_coordinates

from flightsw.icd.config import require, require_counts
from ground.formats.pictures.files import MOST_PX

NO_DISTORTION = (0.0, 0.0, 0.0, 0.0, 0.0)
LEAST_COEFFICIENT = 1e-9
LARGEST_ZOOM = 4.0
ZOOM_STEPS = 30  # of a bisection


@dataclass(frozen=True)
class Intrinsics:
    """A pinhole camera with OpenCV's lens distortion, px, pixel centres at +0.5.

    skew_px: of pixels whose axes are not at right angles, the entry of row 1, column 2 of a pinhole matrix.
    """

    width: int
    height: int
    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
    distortion: tuple[float, ...] = NO_DISTORTION  # k1, k2, p1, p2, k3
    skew_px: float = 0.0

    def __post_init__(self):
        numbers = (*(value for row in self.K for value in row), *self.distortion, self.skew_px)
        if not (1 <= self.width <= MOST_PX and 1 <= self.height <= MOST_PX):
            raise ValueError(f"expected 1 to {MOST_PX} pixels a side, got {self.width}x{self.height}")
        if not (all(map(math.isfinite, numbers)) and self.fx_px > 0 and self.fy_px > 0):
            raise ValueError(f"expected finite intrinsics with positive focal lengths, got {self}")

    @property
    def K(self) -> list[list[float]]:
        """The 3x3 pinhole matrix, px, without skew."""
        return [[self.fx_px, 0.0, self.cx_px], [0.0, self.fy_px, self.cy_px], [0.0, 0.0, 1.0]]

    @property
    def is_pinhole(self) -> bool:
        """Whether there is neither distortion nor skew."""
        return not any(self.distortion) and not self.skew_px

    @property
    def largest_radius(self) -> float:
        """The tangent of the angle from the axis up to which the distortion grows; beyond, it would fold back."""
        k1, k2, _, _, k3 = self.distortion
        slope = np.array(
            [7 * k3, 5 * k2, 3 * k1, 1.0]
        )  # of the distorted radius, in the square of the radius
        roots = np.roots(np.where(np.abs(slope) < LEAST_COEFFICIENT, 0.0, slope))
        real = [root.real for root in roots if abs(root.imag) < 1e-9 and root.real > 0]
        return math.sqrt(min(real)) if real else math.inf


@dataclass(frozen=True, kw_only=True)
class StatedLens:
    """A lens as a file beside pictures states it besides its focal length fx_px, and what the times of these are of.

    fy_px: null: as fx_px. cx_px, cy_px: where the line of sight meets the pictures; null: their middle. distortion: k1,
    k2, p1, p2, k3 as of OpenCV.
    times: what the pictures' own times are of; those of a table, and DATE-AVG of FITS, are of the middle.
    """

    fy_px: float | None = None
    cx_px: float | None = None
    cy_px: float | None = None
    distortion: tuple[float, ...] = NO_DISTORTION
    times: Literal["start", "middle"] = "start"

    def check(self, fx_px: float | None, path: str) -> None:
        """Raise a ConfigError where a value cannot be; path names the file's root."""
        require_counts(self, path, distortion=len(NO_DISTORTION))
        for name, value in (("fx_px", fx_px), ("fy_px", self.fy_px)):
            require(value is None or value > 0, f"{path}.{name}", f"must be positive, got {value}")

    def lens(
        self, width: int, height: int, fx_px: float, found: tuple[float, float, float] | None = None
    ) -> Intrinsics:
        """Return the lens of a picture of this size, px.

        Args:
            found: fy, cx and cy as something else tells them, px, which count where they are not stated.
        """
        stated = (self.fy_px, self.cx_px, self.cy_px)
        found = found or (fx_px, width / 2, height / 2)
        fy_px, cx_px, cy_px = (float(f if s is None else s) for s, f in zip(stated, found, strict=True))
        return Intrinsics(width, height, fx_px, fy_px, cx_px, cy_px, self.distortion)


@functools.lru_cache
def pinhole_of(lens: Intrinsics) -> Intrinsics:
    """Return the pinhole camera of the same size and principal point all of whose pixels the lens has seen.

    It has the lens's focal lengths, or longer ones where the corrected picture would have a border that nobody saw.

    Raises:
        ValueError: that would take more than four times the focal lengths.
    """
    plain = replace(lens, distortion=NO_DISTORTION, skew_px=0.0)
    if lens.is_pinhole:
        return plain
    x, y = np.arange(lens.width) + 0.5, np.arange(lens.height) + 0.5
    border_x = np.concatenate([x, x, np.full(lens.height, x[0]), np.full(lens.height, x[-1])])
    border_y = np.concatenate([np.full(lens.width, y[0]), np.full(lens.width, y[-1]), y, y])

    def zoomed(zoom: float) -> Intrinsics:
        return replace(plain, fx_px=zoom * lens.fx_px, fy_px=zoom * lens.fy_px)

    def sees_all(zoom: float) -> bool:
        return bool(_source(border_x, border_y, zoomed(zoom), lens)[2].all())

    if sees_all(1.0):
        return plain
    low, high = 1.0, LARGEST_ZOOM
    if not sees_all(high):
        raise ValueError(f"the lens's coefficients {lens.distortion} fold the picture's middle onto itself")
    for _ in range(ZOOM_STEPS):
        middle = (low + high) / 2
        low, high = (low, middle) if sees_all(middle) else (middle, high)
    y, x = np.mgrid[0.5 : lens.height, 0.5 : lens.width]
    if not _source(x, y, zoomed(high), lens)[2].all():
        raise ValueError(f"the lens's coefficients {lens.distortion} leave holes inside the picture")
    return zoomed(high)


def undistort(
    image: np.ndarray, lens: Intrinsics, empty: float = 0.0, seen_by: Intrinsics | None = None
) -> np.ndarray:
    """Return the picture [H, W, C] that a pinhole camera would take; `empty` where the lens has seen nothing.

    Args:
        seen_by: the pinhole camera; None: one with the same K.
    """
    if lens.is_pinhole and seen_by is None:
        return image
    camera = seen_by or replace(lens, distortion=NO_DISTORTION, skew_px=0.0)
    if camera == lens:
        return image
    y, x = np.mgrid[0.5 : camera.height, 0.5 : camera.width]
    source_x, source_y, seen = _source(x, y, camera, lens)
    at = np.stack([np.where(seen, source_y, 0.5) - 0.5, np.where(seen, source_x, 0.5) - 0.5])
    channels = [
        np.where(seen, map_coordinates(image[..., c].astype(np.float64), at, order=1, mode="nearest"), empty)
        for c in range(image.shape[2])
    ]
    return np.stack(channels, axis=2)


def _source(
    x_px: np.ndarray, y_px: np.ndarray, camera: Intrinsics, lens: Intrinsics
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return where in the lens's picture a pinhole camera's pixels come from, px, and whether the lens saw them."""
    k1, k2, p1, p2, k3 = lens.distortion
    x, y = (x_px - camera.cx_px) / camera.fx_px, (y_px - camera.cy_px) / camera.fy_px
    r2 = x**2 + y**2
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    bent_x = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x**2)
    bent_y = y * radial + p1 * (r2 + 2 * y**2) + 2 * p2 * x * y
    source_x = bent_x * lens.fx_px + bent_y * lens.skew_px + lens.cx_px
    source_y = bent_y * lens.fy_px + lens.cy_px
    seen = (r2 < lens.largest_radius**2) & (source_x >= 0) & (source_x <= lens.width)
    return source_x, source_y, seen & (source_y >= 0) & (source_y <= lens.height)
