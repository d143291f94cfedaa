"""Cameras behind one protocol; `open_camera` picks the driver by URL.

Drivers of others are found by entry points of the group `obbgs.cameras`: the name is the URL's scheme, the value is
called with the URL and the mission's section `camera` and returns a `Camera`. skeleton.py is one to begin with,
contract.py tests it.
"""

from collections.abc import Callable
from importlib.metadata import entry_points

from flightsw.cameras.camera import Camera
from flightsw.icd.mission import CameraSection

GROUP = "obbgs.cameras"


def open_camera(url: str, section: CameraSection) -> Camera:
    """Return the camera that a URL names; `section` is what the mission expects of it.

    Raises:
        CaptureError: the camera does not answer, or cannot be what the mission expects.
        ValueError: no driver for this URL, or one that cannot be loaded.
    """
    return driver_of(url)(url, section)


def driver_of(url: str) -> Callable[[str, CameraSection], Camera]:
    """Return what opens the camera that a URL names.

    Raises:
        ValueError: no driver for this URL, or one that cannot be loaded.
    """
    scheme, separator, _ = url.partition("://")
    if scheme == "hil" and separator:
        from flightsw.cameras.networked import NetworkedCamera

        return lambda url, section: NetworkedCamera(url)
    if scheme == "gige" and separator:
        from flightsw.cameras.gige import GigeCamera

        return GigeCamera
    installed = entry_points(group=GROUP)
    for found in installed.select(name=scheme):
        try:
            return found.load()
        except Exception as error:  # of whatever the driver imports
            raise ValueError(f"the camera driver {found.value} cannot be loaded: {error}") from error
    others = "".join(f", {name}://" for name in sorted(installed.names))
    raise ValueError(
        f"no camera driver for {url!r}; expected hil:///path/to/socket, hil://host:port, gige://<device id or IP>"
        f"{others}; a package with an entry point of the group {GROUP} adds one"
    )
