"""Cameras behind one protocol; `open_camera` picks the driver by URL."""

from flightsw.cameras.camera import Camera
from flightsw.icd.mission import CameraSection


def open_camera(url: str, section: CameraSection) -> Camera:
    """Return the camera that a URL names; `section` is what the mission expects of it.

    Raises:
        CaptureError: the camera does not answer, or cannot be what the mission expects.
        ValueError: no driver for this URL.
    """
    if url.startswith("hil://"):
        from flightsw.cameras.networked import NetworkedCamera

        return NetworkedCamera(url)
    if url.startswith("gige://"):
        from flightsw.cameras.gige import GigeCamera

        return GigeCamera(url, section)
    raise ValueError(
        f"no camera driver for {url!r}; expected hil:///path/to/socket, hil://host:port or gige://<device id or IP>"
    )
