"""Cameras behind one protocol; `open_camera` picks the driver by URL."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np


@dataclass(frozen=True)
class Exposure:
    """What a camera delivered."""

    dn: np.ndarray  # [H, W] or [H, W, 3] uint16, linear
    exposure_time_s: float
    mid_exposure_utc_ns: int


class Camera(Protocol):
    def expose(self, exposure_time_s: float, start_utc_ns: int) -> Exposure:
        """Open the shutter at a UTC time and return the exposure; CaptureError when the camera fails."""
        ...

    def close(self) -> None: ...


def open_camera(url: str) -> Camera:
    """Return the camera that a URL names.

    Raises:
        CaptureError: the camera does not answer.
        ValueError: no driver for this URL.
    """
    if url.startswith("hil://"):
        from flightsw.cameras.hil import HilCamera

        return HilCamera(url)
    raise ValueError(f"no camera driver for {url!r}; expected hil:///path/to/socket or hil://host:port")
