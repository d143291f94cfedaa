"""Fixtures that several tests of the simulator share."""

import fcntl
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from flightsw.cameras.aravis import aravis
from flightsw.errors import CaptureError


@pytest.fixture
def the_only_camera_on_loopback() -> Iterator[None]:
    """GigE Vision has one port, 3956: two test runs on one machine take turns."""
    try:
        aravis()
    except CaptureError as error:
        pytest.skip(str(error))
    with open(Path(tempfile.gettempdir()) / "obbgs-gige-test.lock", "wb") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield
