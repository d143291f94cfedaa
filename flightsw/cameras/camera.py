"""The protocol `Camera` that every camera driver fulfils, and the `Exposure` that it returns."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np


@dataclass(frozen=True)
class Exposure:
    """What a camera delivered."""

    dn: np.ndarray  # [H, W] or [H, W, 3] uint16, linear
    exposure_time_s: float
    mid_exposure_utc_ns: int


OWN_CLOCK_ANSWER_S = 120.0  # that a camera with a clock of its own may take for a picture


class Camera(Protocol):
    """What every camera promises."""

    @property
    def has_own_clock(self) -> bool:
        """Whether the camera sets its clock to the time of each exposure, which may then be requested at any moment.

        Without one, the caller must request each exposure when its time has come.
        """
        ...

    @property
    def packets_lost(self) -> int:
        """Packets of pictures that never came over the camera's own link."""
        ...

    def expose(self, exposure_time_s: float, start_utc_ns: int) -> Exposure:
        """Open the shutter at a UTC time, Unix nanoseconds, and return the exposure.

        A camera that was lost is opened again first.

        Raises:
            CameraLost: it does not answer.
            CaptureError: it answers, but not with a picture.
        """
        ...

    def open(self) -> None:
        """Open the camera unless it is open.

        Raises:
            CameraLost: it does not answer.
        """
        ...

    def close(self) -> None:
        """Close the camera if it is open; `open` and `expose` open it again."""
        ...
