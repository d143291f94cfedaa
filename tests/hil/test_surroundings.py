"""What the simulated camera sees beside its target: by the orbit, in proportion, and behind it."""

import dataclasses
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from skyfield.api import EarthSatellite, wgs84

from flightsw.icd.mission import Mission, load_mission
from flightsw.navigation.pose import pose_tag
from hil.cameras.virtual import CameraServer
from hil.world.surroundings import PEDESTAL, SWING, Surroundings, gcrs_to_ground
from obbgs_base.physics.earth import THICK_CLOUD

SIZE_PX = 32
OVER_EARTH_S, OVER_SKY_S = 200, 800  # after the mission's start the Earth is behind the target, and is not


@pytest.fixture
def mission() -> Mission:
    whole = load_mission(Path(__file__).parents[2] / "mission.yaml")
    half = SIZE_PX / 2
    camera = dataclasses.replace(
        whole.camera, width=SIZE_PX, height=SIZE_PX, fx_px=800, fy_px=800, cx_px=half, cy_px=half
    )
    return dataclasses.replace(whole, camera=camera)


def half_covered(pose) -> np.ndarray:
    alpha = np.zeros((SIZE_PX, SIZE_PX), np.uint8)
    alpha[:, : SIZE_PX // 2] = 255
    return alpha


def seen(mission: Mission, at_s: float) -> np.ndarray:
    """Return the light [H, W] around a target that is black and covers the left half."""
    utc_ns = mission.orbit.start_utc_ns + at_s * 10**9
    nothing = np.zeros((SIZE_PX, SIZE_PX, 1))
    return Surroundings(mission, half_covered).light(nothing, pose_tag(mission, utc_ns), utc_ns)[..., 0]


def test_the_earth_is_behind_the_target_and_as_bright_as_sunlit_ground_and_cloud(mission):
    light = seen(mission, OVER_EARTH_S)
    assert light[:, : SIZE_PX // 2].max() < 0.01  # stray light alone
    behind = light[:, SIZE_PX // 2 :]
    assert behind.min() > 0.02 and behind.max() < THICK_CLOUD
    assert seen(mission, OVER_SKY_S).max() < 0.01


def test_the_ground_turns_as_skyfield_says(skyfield_oracle, mission):
    """By less than half a degree: precession and nutation are left out."""
    timescale, _ = skyfield_oracle
    utc_ns = mission.orbit.start_utc_ns
    time = timescale.from_datetime(datetime.fromtimestamp(utc_ns / 1e9, UTC))
    place = EarthSatellite(*mission.orbit.target_tle, ts=timescale).at(time)
    below = wgs84.subpoint_of(place)
    x, y, _ = gcrs_to_ground(utc_ns) @ place.xyz.m
    apart = np.degrees(np.arctan2(y, x)) - below.longitude.degrees
    assert abs((apart + 180) % 360 - 180) < 0.5


def test_the_dark_level_drifts_and_stays_near_the_calibrated_one(mission):
    around, start_ns = Surroundings(mission, half_covered), mission.orbit.start_utc_ns
    levels = [
        around.camera(start_ns + s * 10**9).black_dn - mission.camera.black_dn for s in range(0, 5400, 60)
    ]
    full = mission.camera.white_dn - mission.camera.black_dn
    assert (PEDESTAL - SWING) * full <= min(levels) < max(levels) <= (PEDESTAL + SWING) * full
    assert max(levels) - min(levels) > SWING * full


def test_a_camera_with_surroundings_reads_them(mission, tmp_path):
    nothing, readings = np.zeros((SIZE_PX, SIZE_PX, 1)), {}
    for name, around in (("black", None), ("real", Surroundings(mission, half_covered))):
        with CameraServer(mission, lambda pose: nothing, tmp_path / name, surroundings=around) as server:
            start_ns = mission.orbit.start_utc_ns + OVER_EARTH_S * 10**9
            request = f'{{"op": "expose", "exposure_time_s": 1e-4, "start_utc_ns": {start_ns}}}'
            header, pixels = server.answer(request.encode())
            assert header["ok"], header
            readings[name] = np.frombuffer(pixels, "<u2").reshape(SIZE_PX, SIZE_PX).astype(float)
    assert abs(readings["black"].mean() - mission.camera.black_dn) < 2
    earth_dn = readings["real"][:, SIZE_PX // 2 :].mean() - mission.camera.black_dn
    assert earth_dn > 0.02 * mission.camera.dn_per_radiance_s * 1e-4
