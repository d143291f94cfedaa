"""Servers of the simulator whose thread or rendering fails: clients are answered, and a dead server is reported."""

import os
import threading

import numpy as np
import pytest

from flightsw.cameras import open_camera
from flightsw.errors import CaptureError
from hil.cameras.virtual import CameraServer
from hil.links.virtual_can import VirtualCan
from hil.links.virtual_link import VirtualLink, run_link
from hil.links.virtual_serial import VirtualSerial
from hil.watched import ServerError, WatchedThread


def failing_once():
    """Return a scene whose first rendering runs out of memory."""
    failures = [MemoryError("one picture too many")]

    def sky(pose) -> np.ndarray:
        if failures:
            raise failures.pop()
        return np.full((48, 48, 1), 0.1)

    return sky


def test_a_failure_in_rendering_is_answered_and_counted(small_mission):
    with CameraServer(small_mission, failing_once(), "hil://127.0.0.1:0") as server:
        camera = open_camera(server.url, small_mission.camera)
        with pytest.raises(CaptureError, match=r"the camera refused: the simulated sky failed: MemoryError"):
            camera.expose(1e-4, small_mission.orbit.start_utc_ns)
        assert camera.expose(1e-4, small_mission.orbit.start_utc_ns).dn.shape == (48, 48)
        camera.close()
        assert (server.failures, server.exposures) == (1, 1)


def test_a_camera_server_whose_thread_failed_is_an_error_for_its_user(small_mission):
    def fail() -> None:
        raise OSError("no more descriptors")

    with (
        pytest.raises(ServerError, match="the camera server has ended: OSError"),
        CameraServer(small_mission, failing_once(), "hil://127.0.0.1:0") as server,
    ):
        server._server.service_actions = fail  # called between two polls of the socket
        server._thread.join(30)
        with pytest.raises(ServerError):
            server.check()


@pytest.mark.parametrize("make", [lambda: VirtualSerial(921_600), VirtualCan], ids=["serial", "CAN"])
def test_a_link_whose_thread_failed_is_an_error(make):
    def pull_the_plug(line: VirtualLink) -> None:
        os.close(line._masters[0])

    with pytest.raises(ServerError, match=r"the simulated link .* has ended: OSError"):
        run_link(make(), pull_the_plug)


def test_a_thread_that_ends_well_is_no_error():
    done = threading.Event()
    thread = WatchedThread("worker", done.set)
    thread.start()
    thread.join(30)
    thread.check()
    assert done.is_set()
