"""What the Camera protocol promises, kept by every camera: the one behind a socket and the one on GigE Vision."""

import dataclasses
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from flightsw.cameras import open_camera
from flightsw.cameras.camera import Camera
from flightsw.errors import CameraLost, CaptureError
from flightsw.icd.mission import Mission, load_mission
from hil.cameras.gige import GigeCameraServer
from hil.cameras.virtual import CameraServer

MISSION = load_mission(Path(__file__).parents[2] / "mission.yaml")
START_NS = MISSION.orbit.start_utc_ns
SIZE_PX = 48
RADIANCE = 0.3


class Bench:
    """One kind of camera and the server that plays its device, in front of an even plate."""

    def __init__(self, kind: str, socket: Path):
        self._kind, self._socket = kind, socket
        self.failures: list[Exception] = []  # of the next exposures

    def mission(self, channels: int = 1) -> Mission:
        camera = dataclasses.replace(MISSION.camera, width=SIZE_PX, height=SIZE_PX - 8, channels=channels)
        return dataclasses.replace(MISSION, camera=camera)

    def serve(self, mission: Mission) -> CameraServer | GigeCameraServer:
        camera = mission.camera

        def sky(pose: object) -> np.ndarray:
            if self.failures:
                raise self.failures.pop()
            return np.full((camera.height, camera.width, camera.channels), RADIANCE)

        if self._kind == "gige":
            return GigeCameraServer(mission, sky)
        return CameraServer(mission, sky, self._socket)


@pytest.fixture(params=["networked", "gige"])
def bench(request, tmp_path) -> Bench:
    if request.param == "gige":
        request.getfixturevalue("the_only_camera_on_loopback")
    return Bench(request.param, tmp_path / "camera.sock")


@pytest.fixture
def camera(bench) -> Iterator[Camera]:
    """An open camera, closed again at the end."""
    mission = bench.mission()
    with bench.serve(mission) as server:
        opened: Camera = open_camera(server.url, mission.camera)
        yield opened
        opened.close()


def test_the_exposure_time_is_honoured_and_the_signal_follows_it(camera):
    for exposure_s in (5e-5, 1e-4, 2e-4):
        exposure = camera.expose(exposure_s, START_NS)
        assert exposure.exposure_time_s == pytest.approx(exposure_s, abs=1e-9)
        expected_dn = RADIANCE * MISSION.camera.dn_per_radiance_s * exposure_s
        two_percent = 0.02  # the mean of 1920 pixels with 4 % of noise each, and rounding
        assert exposure.dn.mean() - MISSION.camera.black_dn == pytest.approx(expected_dn, rel=two_percent)


def test_the_time_is_that_of_mid_exposure_in_integer_nanoseconds(camera):
    assert camera.has_own_clock
    for start_ns in (START_NS, START_NS + 27_000_000_123, START_NS + 1_000_000_000):
        exposure = camera.expose(2e-4, start_ns)
        assert isinstance(exposure.mid_exposure_utc_ns, int)
        assert exposure.mid_exposure_utc_ns == start_ns + 100_000


@pytest.mark.parametrize("channels", [1, 3])
def test_pixels_are_16_bit_numbers_of_the_missions_size_up_to_full_scale(bench, channels):
    mission = bench.mission(channels)
    shape = (SIZE_PX - 8, SIZE_PX) + ((3,) if channels == 3 else ())
    with bench.serve(mission) as server:
        camera = open_camera(server.url, mission.camera)
        dn = camera.expose(1e-4, START_NS).dn
        saturated_dn = camera.expose(1e-2, START_NS).dn
        camera.close()
    assert dn.dtype == np.uint16 and dn.shape == shape
    assert dn.min() > 0 and dn.max() < mission.camera.white_dn
    assert (saturated_dn == mission.camera.white_dn).all()


def test_a_failed_exposure_is_a_capture_error_and_the_next_one_succeeds(bench, camera, monkeypatch):
    monkeypatch.setattr("flightsw.cameras.gige.OWN_CLOCK_ANSWER_S", 1.0)
    bench.failures.append(ZeroDivisionError("a defect"))
    with pytest.raises(CaptureError) as caught:
        camera.expose(1e-4, START_NS)
    assert not isinstance(caught.value, CameraLost)  # the camera itself still answers
    monkeypatch.undo()
    assert camera.expose(1e-4, START_NS).dn.shape == (SIZE_PX - 8, SIZE_PX)


def test_open_and_close_may_be_repeated_and_an_exposure_opens_the_camera_again(camera):
    camera.open()
    camera.open()
    camera.expose(1e-4, START_NS)
    camera.close()
    camera.close()
    assert camera.expose(1e-4, START_NS).exposure_time_s == pytest.approx(1e-4)
    assert camera.packets_lost == 0


def test_a_camera_that_does_not_answer_is_lost_and_opens_again_when_it_is_back(bench):
    mission = bench.mission()
    with bench.serve(mission) as server:
        url = server.url
        camera = open_camera(url, mission.camera)
        camera.expose(1e-4, START_NS)
        camera.close()
    with pytest.raises(CameraLost):
        camera.open()
    with pytest.raises(CameraLost):
        camera.expose(1e-4, START_NS)
    with pytest.raises(CameraLost):
        open_camera(url, mission.camera)
    with bench.serve(mission):
        assert camera.expose(1e-4, START_NS).dn.shape == (SIZE_PX - 8, SIZE_PX)
        camera.close()
