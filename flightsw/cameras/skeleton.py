"""The skeleton of a camera driver, to be copied: a camera of your own at mine://0, found by its entry point.

In the pyproject.toml of your package, which flight finds once it is installed beside obbgs:

    [project.entry-points."obbgs.cameras"]
    mine = "my_package.my_camera:SkeletonCamera"

What stands between `open` and `close` here plays an evenly lit wall; put your camera's own library in its place, and
let `flightsw.cameras.contract` test it.
"""

import time

import numpy as np

from flightsw.cameras.camera import Exposure
from flightsw.clock import utc_ns
from flightsw.errors import CameraLost, CaptureError
from flightsw.icd.mission import CameraSection

NS = 1_000_000_000
DN_PER_S = 10_000.0  # of the wall
LARGEST_PX = 8192
LATE_S = 0.5  # an exposure that is asked for so long after its time is not taken


class SkeletonCamera:
    """One camera, exposed when it is asked; opened again after it was lost.

    Args:
        url: as it stands behind --camera, such as mine://0.
        section: what the mission expects: size, channels, bit depth and black level.

    Raises:
        CameraLost: the camera does not answer, or cannot be what the mission expects.
        ValueError: the URL is no such camera's.
    """

    has_own_clock = False  # flight asks for each exposure when its time has come
    packets_lost = 0  # count here what your camera's link loses

    def __init__(self, url: str, section: CameraSection):
        self._url, self._section, self._is_open = url, section, False
        self.open()

    def open(self) -> None:
        """Open the camera unless it is open, set its size, and switch off whatever it would choose by itself."""
        section = self._section
        if max(section.width, section.height) > LARGEST_PX:
            raise CameraLost(f"{self._url} has {LARGEST_PX} px a side, the mission {section.width}")
        self._is_open = True

    def close(self) -> None:
        """Give the camera back if it is open."""
        self._is_open = False

    def expose(self, exposure_time_s: float, start_utc_ns: int) -> Exposure:
        """Return one exposure, with the exposure time and the moment that it really had.

        Raises:
            CameraLost: the camera does not answer; it is opened again at the next exposure.
            CaptureError: it answers, but not with this picture.
        """
        self.open()
        opened_utc_ns = utc_ns()
        if opened_utc_ns - start_utc_ns > LATE_S * NS:
            raise CaptureError(f"the exposure was due {(opened_utc_ns - start_utc_ns) / NS:.1f} s ago")
        time.sleep(exposure_time_s)
        section = self._section
        shape = (section.height, section.width) + ((3,) if section.channels == 3 else ())
        dn = min(section.black_dn + DN_PER_S * exposure_time_s, section.white_dn)
        return Exposure(
            np.full(shape, round(dn), np.uint16),
            exposure_time_s,
            opened_utc_ns + round(exposure_time_s * NS / 2),
        )
