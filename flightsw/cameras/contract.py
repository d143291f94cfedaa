"""The contract of camera drivers as tests: whoever writes a driver lets pytest run them on it.

    from flightsw.cameras.contract import CameraContract

    class TestMyCamera(CameraContract):
        url = "mine://0"
        section = load_mission("mission.yaml").camera

The tests need the camera, or a program that plays it, in front of something that is lit evenly and does not change.
They import no test library: pytest finds them by their names.
"""

import contextlib
import time
import unittest
from collections.abc import Iterator

import numpy as np

from flightsw.cameras import open_camera
from flightsw.cameras.camera import Camera, Exposure
from flightsw.errors import CameraLost
from flightsw.icd.mission import CameraSection

NS = 1_000_000_000


class CameraContract:
    """What the protocol `Camera` promises, as tests of the camera at `url`.

    section: what the mission expects of the camera.
    exposures_s: shortest first, none of them saturated in front of what the camera sees; the last one bright.
    start_utc_ns: of the first exposure of a camera with its own clock, Unix ns.
    time_tolerance_s: of the stated time of an exposure.
    signal_tolerance: relative, of the signal's growth with the exposure time.
    """

    url: str
    section: CameraSection
    exposures_s: tuple[float, ...] = (0.01, 0.02, 0.04)
    start_utc_ns: int = 0
    time_tolerance_s: float = 0.5
    signal_tolerance: float = 0.1

    @contextlib.contextmanager
    def device(self) -> Iterator[None]:
        """Keep the device connected within the context; a driver whose device tests can take away overrides this."""
        yield

    can_be_taken_away = False  # whether the device is gone outside of `device`

    @contextlib.contextmanager
    def opened(self) -> Iterator[Camera]:
        """Give the open camera, and close it."""
        with self.device():
            camera = open_camera(self.url, self.section)
            try:
                yield camera
            finally:
                camera.close()

    def exposed(self, camera: Camera, exposure_time_s: float) -> tuple[Exposure, int]:
        """Return an exposure and the time at which it was asked to begin, Unix ns."""
        start_ns = self.start_utc_ns if camera.has_own_clock else time.time_ns()
        return camera.expose(exposure_time_s, start_ns), start_ns

    def test_a_picture_is_of_16_bit_numbers_in_the_missions_size_and_range(self):
        shape = (self.section.height, self.section.width) + ((3,) if self.section.channels == 3 else ())
        with self.opened() as camera:
            dn = self.exposed(camera, self.exposures_s[0])[0].dn
        assert dn.dtype == np.uint16, f"expected uint16, got {dn.dtype}"
        assert dn.shape == shape, f"expected {shape}, got {dn.shape}"
        assert dn.max() <= self.section.white_dn, f"{dn.max()} DN is beyond {self.section.white_dn:g}"

    def test_the_exposure_time_is_honoured_and_the_signal_grows_with_it(self):
        """Gain, exposure and white balance that the camera chooses by itself break this."""
        with self.opened() as camera:
            exposures = [self.exposed(camera, time_s)[0] for time_s in self.exposures_s]
        for asked_s, exposure in zip(self.exposures_s, exposures, strict=True):
            stated_s = exposure.exposure_time_s
            assert abs(stated_s - asked_s) <= 0.1 * asked_s, f"asked for {asked_s} s, got {stated_s} s"
        rates = [(e.dn.mean() - self.section.black_dn) / e.exposure_time_s for e in exposures]
        assert rates[-1] > 0, "the longest exposure is not brighter than black"
        for rate in rates:
            assert abs(rate / rates[-1] - 1) <= self.signal_tolerance, f"DN per second differ: {rates}"

    def test_the_stated_time_is_the_middle_of_the_exposure_in_whole_nanoseconds(self):
        with self.opened() as camera:
            for time_s in self.exposures_s:
                exposure, start_ns = self.exposed(camera, time_s)
                assert type(exposure.mid_exposure_utc_ns) is int
                beside_s = (exposure.mid_exposure_utc_ns - start_ns) / NS - exposure.exposure_time_s / 2
                assert abs(beside_s) <= self.time_tolerance_s, f"stated {beside_s:+.3f} s beside the exposure"

    def test_open_and_close_may_be_repeated_and_an_exposure_opens_the_camera(self):
        with self.opened() as camera:
            camera.open()
            camera.open()
            self.exposed(camera, self.exposures_s[0])
            camera.close()
            camera.close()
            self.exposed(camera, self.exposures_s[0])
            assert type(camera.packets_lost) is int and camera.packets_lost >= 0

    def test_a_camera_that_is_away_is_lost_and_used_again_when_it_is_back(self):
        if not self.can_be_taken_away:
            raise unittest.SkipTest("the tests cannot take this device away")
        with self.device():
            camera = open_camera(self.url, self.section)
            self.exposed(camera, self.exposures_s[0])
            camera.close()
        for name, use in (
            ("open", camera.open),
            ("expose", lambda: self.exposed(camera, self.exposures_s[0])),
            ("open_camera", lambda: open_camera(self.url, self.section)),
        ):
            try:
                use()
            except CameraLost:
                continue
            raise AssertionError(f"expected CameraLost of {name} without the device")
        with self.device():
            self.exposed(camera, self.exposures_s[0])
            camera.close()
