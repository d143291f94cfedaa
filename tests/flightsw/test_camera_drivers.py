"""Drivers that flight finds by their entry points, and the contract that it ships to test them: what it lets pass and
what not."""

import contextlib
import dataclasses
from pathlib import Path

import numpy as np
import pytest

from flightsw.cameras import open_camera
from flightsw.cameras.camera import Exposure
from flightsw.cameras.contract import CameraContract
from flightsw.cameras.skeleton import SkeletonCamera
from flightsw.icd.mission import load_mission
from hil.cameras.gige import GigeCameraServer
from hil.cameras.virtual import CameraServer

MISSION = load_mission(Path(__file__).parents[2] / "mission.yaml")
CAMERA = dataclasses.replace(MISSION.camera, width=48, height=40)
SIMULATED = dataclasses.replace(MISSION, camera=CAMERA)
RADIANCE = 0.3


def sky(pose: object) -> np.ndarray:
    return np.full((CAMERA.height, CAMERA.width, 1), RADIANCE)


@pytest.fixture
def installed(tmp_path, monkeypatch):
    """A package beside obbgs that brings drivers, as an installer leaves it: its name, version and entry points."""
    facts = tmp_path / "mine-1.0.dist-info"
    facts.mkdir()
    (facts / "METADATA").write_text("Metadata-Version: 2.1\nName: mine\nVersion: 1.0\n")
    (facts / "entry_points.txt").write_text(
        "[obbgs.cameras]\nmine = flightsw.cameras.skeleton:SkeletonCamera\nbroken = no_such_package:Camera\n"
    )
    monkeypatch.syspath_prepend(tmp_path)


class TestSkeleton(CameraContract):
    url, section = "mine://0", CAMERA

    @pytest.fixture(autouse=True)
    def found(self, installed):
        pass


class TestSkeletonInColour(TestSkeleton):
    section = dataclasses.replace(CAMERA, channels=3)


class TestNetworked(CameraContract):
    section, exposures_s, start_utc_ns = CAMERA, (5e-5, 1e-4, 2e-4), MISSION.orbit.start_utc_ns
    time_tolerance_s, can_be_taken_away = 1e-6, True

    @pytest.fixture(autouse=True)
    def socket(self, tmp_path):
        self.path = tmp_path / "camera.sock"

    @contextlib.contextmanager
    def device(self):
        with CameraServer(SIMULATED, sky, self.path) as server:
            self.url = server.url
            yield


@pytest.mark.usefixtures("the_only_camera_on_loopback")
class TestGige(CameraContract):
    section, exposures_s, start_utc_ns = CAMERA, (5e-5, 1e-4, 2e-4), MISSION.orbit.start_utc_ns
    time_tolerance_s, can_be_taken_away, url = 1e-6, True, "gige://127.0.0.1"

    @contextlib.contextmanager
    def device(self):
        with GigeCameraServer(SIMULATED, sky):
            yield


def changed(change):
    """Return a skeleton whose exposures are changed."""

    class Changed(SkeletonCamera):
        def expose(self, exposure_time_s, start_utc_ns):
            return change(super().expose(exposure_time_s, start_utc_ns))

    return Changed


def with_gain_of_its_own(exposure: Exposure) -> Exposure:
    return dataclasses.replace(exposure, dn=np.full_like(exposure.dn, 900))


def stamped_at_its_end(exposure: Exposure) -> Exposure:
    return dataclasses.replace(exposure, mid_exposure_utc_ns=exposure.mid_exposure_utc_ns + 10**9)


def in_eight_bits(exposure: Exposure) -> Exposure:
    return dataclasses.replace(exposure, dn=(exposure.dn >> 4).astype(np.uint8))


def of_another_size(exposure: Exposure) -> Exposure:
    return dataclasses.replace(exposure, dn=exposure.dn[:-1])


def with_another_exposure_time(exposure: Exposure) -> Exposure:
    return dataclasses.replace(exposure, exposure_time_s=2 * exposure.exposure_time_s)


@pytest.mark.parametrize(
    ("change", "test", "problem"),
    [
        (
            with_gain_of_its_own,
            "test_the_exposure_time_is_honoured_and_the_signal_grows_with_it",
            "DN per second",
        ),
        (
            with_another_exposure_time,
            "test_the_exposure_time_is_honoured_and_the_signal_grows_with_it",
            "asked for",
        ),
        (
            stamped_at_its_end,
            "test_the_stated_time_is_the_middle_of_the_exposure_in_whole_nanoseconds",
            "beside",
        ),
        (
            in_eight_bits,
            "test_a_picture_is_of_16_bit_numbers_in_the_missions_size_and_range",
            "expected uint16",
        ),
        (
            of_another_size,
            "test_a_picture_is_of_16_bit_numbers_in_the_missions_size_and_range",
            r"expected \(40, 48",
        ),
    ],
)
def test_the_contract_refuses_a_driver_that_breaks_it(installed, monkeypatch, change, test, problem):
    monkeypatch.setattr("flightsw.cameras.skeleton.SkeletonCamera", changed(change))
    with pytest.raises(AssertionError, match=problem):
        getattr(TestSkeleton(), test)()


def test_an_unknown_scheme_names_the_drivers_that_are_there(installed):
    with pytest.raises(
        ValueError, match=r"'v4l2:///dev/video0'; expected hil:.*, broken://, mine://; a package"
    ):
        open_camera("v4l2:///dev/video0", CAMERA)


def test_a_driver_that_cannot_be_loaded_is_named_with_the_reason(installed):
    with pytest.raises(
        ValueError, match="no_such_package:Camera cannot be loaded: No module named 'no_such_package'"
    ):
        open_camera("broken://0", CAMERA)
