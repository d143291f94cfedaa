"""Servers of the simulator that fail, or that another would displace: clients are answered, and it is reported."""

import os
import socket
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
from obbgs_base.locks import one_command_in
from tests.commands import call


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


def test_a_second_camera_does_not_take_the_place_of_one_that_serves(small_mission, tmp_path):
    place = f"hil://{tmp_path / 'camera.sock'}"
    with CameraServer(small_mission, failing_once(), place) as server:
        with pytest.raises(OSError, match=r"camera\.sock is in use: another simulated camera serves there"):
            CameraServer(small_mission, failing_once(), place)
        open_camera(server.url, small_mission.camera).close()
    assert not (tmp_path / "camera.sock").exists()


def test_a_camera_takes_the_place_of_one_that_was_killed_and_leaves_the_socket_of_another(
    small_mission, tmp_path
):
    path = tmp_path / "camera.sock"
    with socket.socket(socket.AF_UNIX) as killed:
        killed.bind(str(path))
        killed.listen()
    with CameraServer(small_mission, failing_once(), path) as first:
        open_camera(first.url, small_mission.camera).close()
        path.unlink()  # by hand: then nobody can know of the first
        second = CameraServer(small_mission, failing_once(), path)
    with second:
        open_camera(second.url, small_mission.camera).close()
    assert not path.exists()


def test_a_second_camera_does_not_replace_what_flight_reads_for_the_first(small_mission, tmp_path):
    with one_command_in(tmp_path / "scenario", "hil"):
        camera = ("camera", "--mission", tmp_path / "small.yaml", "--scenario", "v-bar")
        done = call("hil", *camera, "--out", tmp_path / "scenario")
        assert done.returncode == 1 and "another hil command works in" in done.stderr
        assert [path.name for path in (tmp_path / "scenario").iterdir()] == ["lock"]


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


@pytest.mark.parametrize("place", ["hil://{tmp}/none/camera.sock", "hil://192.0.2.1:9"])
def test_an_address_that_cannot_be_served_at_is_named(small_mission, tmp_path, place):
    listen = place.format(tmp=tmp_path)
    with pytest.raises(OSError) as refused:
        CameraServer(small_mission, failing_once(), listen)
    assert refused.value.filename == listen and refused.value.strerror
