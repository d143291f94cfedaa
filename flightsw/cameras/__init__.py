"""Cameras behind one protocol; `open_camera` picks the driver by URL."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from flightsw.icd.mission import CameraSection


@dataclass(frozen=True)
class Exposure:
    """What a camera delivered."""

    dn: np.ndarray  # [H, W] or [H, W, 3] uint16, linear
    exposure_time_s: float
    mid_exposure_utc_ns: int


class Camera(Protocol):
    @property
    def waits(self) -> bool:
        """Whether exposures must be asked for when their time has come, as of a camera in our own time."""
        ...

    @property
    def packets_lost(self) -> int:
        """Packets of pictures that never came over the camera's own link."""
        ...

    def expose(self, exposure_time_s: float, start_utc_ns: int) -> Exposure:
        """Open the shutter at a UTC time and return the exposure.

        A camera that was lost is opened again first.

        Raises:
            CameraLost: it does not answer.
            CaptureError: it answers, but not with a picture.
        """
        ...

    def open(self) -> None:
        """Open the camera unless it is open; CameraLost when it does not answer."""
        ...

    def close(self) -> None: ...


def open_camera(url: str, section: CameraSection) -> Camera:
    """Return the camera that a URL names; `section` is what the mission expects of it.

    Raises:
        CaptureError: the camera does not answer, or cannot be what the mission expects.
        ValueError: no driver for this URL.
    """
    if url.startswith("hil://"):
        from flightsw.cameras.hil import HilCamera

        return HilCamera(url)
    if url.startswith("gige://"):
        from flightsw.cameras.gige import GigeCamera

        return GigeCamera(url, section)
    raise ValueError(
        f"no camera driver for {url!r}; expected hil:///path/to/socket, hil://host:port or gige://<device id or IP>"
    )
