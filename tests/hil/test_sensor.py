"""The simulated sensor: the methods that characterise real cameras recover the parameters that were put in."""

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flightsw.icd.mission import load_mission
from hil.sky.motion import image_velocity, smear
from hil.sky.sensor import PRESETS, SensorModel, bloom, clean_dn, demosaic, expose, ideal, read_out
from obbgs_base.physics.stars import catalogue, star_radiance

MISSION = load_mission(Path(__file__).parents[1] / "golden" / "mission.yaml")


def flat(sensor: SensorModel, level: float, exposure_time_s: float, seed: int, size: int = 400) -> np.ndarray:
    shape = (size, size, sensor.channels)
    return read_out(sensor, np.full(shape, level), exposure_time_s, np.random.default_rng(seed)).astype(float)


@pytest.mark.parametrize(
    "sensor",
    [
        dataclasses.replace(PRESETS["spacecam"], vignetting=0.0, exposure_error=0.0, psf_sigma_px=0.0),
        SensorModel(quantum_efficiency=0.3, electrons_per_dn=1.5, bit_depth=14, read_noise_e=6.0, prnu=0.02),
        ideal(MISSION.camera),
    ],
)
def test_photon_transfer_recovers_gain_read_noise_and_sensitivity_within_3_percent(sensor):
    """Janesick's method: the difference of two equal flat fields has no fixed pattern and twice their variance."""
    time_s = 1e-4
    full_e = min(sensor.full_well_e, (sensor.white_dn - sensor.black_dn) * sensor.electrons_per_dn)
    brightest = 0.8 * full_e / (sensor.photons_per_radiance_s * sensor.quantum_efficiency * time_s)
    levels = np.linspace(0, brightest, 10)
    means, variances = [], []
    for index, level in enumerate(levels):
        a, b = (flat(sensor, level, time_s, 2 * index + i) for i in (0, 1))
        means.append((a.mean() + b.mean()) / 2)
        variances.append((a - b).var() / 2 - 1 / 12)  # rounding
    means, variances = np.array(means), np.array(variances)
    slope = np.polyfit(means, variances, 1)[0]
    assert 1 / slope == pytest.approx(sensor.electrons_per_dn, rel=0.03)
    read_noise_e = np.sqrt(variances[0]) * sensor.electrons_per_dn
    assert read_noise_e == pytest.approx(sensor.read_noise_e, rel=0.03)
    # linearity: a line through the means, and the light's gain as its slope
    slope, offset = np.polyfit(levels * time_s, means, 1)
    assert slope == pytest.approx(sensor.dn_per_radiance_s, rel=0.01)
    residual = means - (offset + slope * levels * time_s)
    assert np.abs(residual).max() < 2e-3 * (means[-1] - means[0])


def test_the_fixed_pattern_is_what_stays_when_frames_are_averaged():
    sensor = SensorModel(prnu=0.02, dsnu_e=40.0, read_noise_e=4.0, photons_per_radiance_s=1e8)
    mean = np.mean([flat(sensor, 1.0, 8e-5, seed, 200) for seed in range(40)], axis=0)
    dark = np.mean([flat(sensor, 0.0, 8e-5, seed, 200) for seed in range(40)], axis=0)
    assert dark.std() == pytest.approx(40.0 / 4, rel=0.03)
    assert (mean - dark).std() / (mean - dark).mean() == pytest.approx(0.02, rel=0.05)
    other = dataclasses.replace(sensor, seed=1)
    assert abs(np.corrcoef(dark.ravel(), flat(other, 0.0, 8e-5, 0, 200).ravel())[0, 1]) < 0.02


def test_dark_current_and_hot_pixels_grow_with_time_and_not_with_light():
    sensor = SensorModel(dark_e_s=2000.0, hot_pixels=0.01, read_noise_e=2.0, photons_per_radiance_s=1e4)
    short, long = (np.median(flat(sensor, 0.0, t, 1)) - 64 for t in (0.1, 0.4))
    assert short == pytest.approx(50, abs=1) and long == pytest.approx(200, abs=2)
    hot = flat(sensor, 0.0, 0.1, 3) > 64 + 50 + 40
    assert 0.008 < hot.mean() < 0.011
    assert (hot & (flat(sensor, 0.0, 0.1, 4) > 64 + 50 + 40)).sum() > 0.9 * hot.sum()  # the same ones again


def test_the_sensor_clips_at_full_scale_and_counts_exposure_time():
    camera = MISSION.camera
    radiance = np.full((50, 50, 1), 1.0)
    assert (expose(radiance, 1e-3, camera, np.random.default_rng(0)) == camera.white_dn).all()
    assert clean_dn(radiance, 1e-3, camera).max() == camera.white_dn
    short, long = (clean_dn(radiance, t, camera) - camera.black_dn for t in (2e-5, 4e-5))
    np.testing.assert_allclose(2 * short, long)


@pytest.mark.parametrize("bit_depth", range(8, 17))
def test_every_bit_depth_reaches_its_full_scale_and_no_further(bit_depth):
    sensor = SensorModel(bit_depth=bit_depth, black_dn=4.0, photons_per_radiance_s=1e9)
    assert flat(sensor, 1.0, 10.0, 0, 8).max() == (1 << bit_depth) - 1
    assert flat(sensor, 0.0, 1.0, 0, 8).min() == 4


def test_the_full_well_clips_before_the_converter():
    sensor = SensorModel(full_well_e=8000.0, electrons_per_dn=4.0, black_dn=64.0)
    assert flat(sensor, 1e3, 1e-3, 0, 8).max() == 64 + 2000 < sensor.white_dn


@settings(max_examples=30)
@given(row=st.integers(40, 60), times=st.floats(1.0, 30.0), ambient=st.floats(0, 900))
def test_blooming_conserves_charge_and_stays_in_its_column(row, times, ambient):
    well_e = 1000.0
    electrons = np.full((101, 5, 1), ambient)
    electrons[row, 2] = times * well_e
    spread = bloom(electrons.copy(), well_e)
    if (times - 1) * well_e / 2 < 35 * (well_e - ambient):  # it does not reach an edge
        assert spread.sum() == pytest.approx(electrons.sum())
    assert spread.max() <= well_e
    np.testing.assert_array_equal(spread[:, [0, 1, 3, 4]], electrons[:, [0, 1, 3, 4]])
    above, below = spread[:row, 2, 0] - ambient, spread[row + 1 :, 2, 0] - ambient
    assert above.sum() == pytest.approx(below.sum(), abs=1e-6) or spread[[0, -1], 2].max() > ambient


def test_vignetting_takes_the_corners_and_the_lens_blurs_without_losing_light():
    sensor = SensorModel(vignetting=0.4, electrons_per_dn=1e4, photons_per_radiance_s=1e12, bit_depth=16)
    image = flat(sensor, 1.0, 5e-4, 0, 101) - 64
    assert image[0, 0] / image[50, 50] == pytest.approx(0.6, abs=0.01)
    assert image[50, 0] / image[50, 50] == pytest.approx(0.8, abs=0.01)
    point = np.zeros((41, 41, 1))
    point[20, 20] = 1.0
    blurred = SensorModel(psf_sigma_px=1.5, electrons_per_dn=1e6, photons_per_radiance_s=1e14, bit_depth=16)
    spot = read_out(blurred, point, 6e-4, np.random.default_rng(0))[..., 0].astype(float) - 64
    offsets = np.arange(41) - 20
    assert spot.sum() == pytest.approx(6e4, rel=0.01)
    assert math.sqrt((spot.sum(0) * offsets**2).sum() / spot.sum()) == pytest.approx(1.5, rel=0.05)


def test_the_exposure_time_error_is_of_the_size_asked_for():
    sensor = SensorModel(exposure_error=0.02, electrons_per_dn=1e4, photons_per_radiance_s=1e12)
    means = [flat(sensor, 1.0, 2e-5, seed, 16).mean() - 64 for seed in range(400)]
    assert np.std(means) / np.mean(means) == pytest.approx(0.02, rel=0.15)  # 400 draws know it to 3.5 %


def test_a_bayer_sensor_sees_one_colour_a_pixel_and_gives_flat_colours_back():
    rng = np.random.default_rng(0)
    colours = np.broadcast_to([0.2, 0.5, 0.9], (32, 48, 3))
    sensor = SensorModel(colour="bayer", electrons_per_dn=1e6, photons_per_radiance_s=1e13, bit_depth=16)
    dn = read_out(sensor, colours, 5e-3, rng)
    expected = 64 + sensor.dn_per_radiance_s * 5e-3 * np.array([0.2, 0.5, 0.9])
    assert dn.shape == (32, 48, 3)
    np.testing.assert_allclose(dn.reshape(-1, 3).astype(float), np.tile(expected, (32 * 48, 1)), atol=2.5)
    mosaic = rng.integers(0, 4096, (16, 16))
    interpolated = demosaic(mosaic)
    np.testing.assert_array_equal(interpolated[0::2, 0::2, 0], mosaic[0::2, 0::2])  # what was measured stays
    np.testing.assert_array_equal(interpolated[1::2, 1::2, 2], mosaic[1::2, 1::2])
    np.testing.assert_array_equal(interpolated[0::2, 1::2, 1], mosaic[0::2, 1::2])


def test_radiance_of_the_wrong_kind_is_refused():
    with pytest.raises(ValueError, match=r"mono sensor takes radiance \[H, W, 1\], got \[4, 4, 3\]"):
        read_out(SensorModel(), np.zeros((4, 4, 3)), 1e-3, np.random.default_rng(0))


def test_the_paper_preset_is_gaussian_noise_of_2_5_percent_on_8_bits():
    sensor = PRESETS["paper"].with_gain(2e6)
    for level in (0.3, 0.6):
        noise = flat(sensor, level, 2e-4, 1)
        assert noise.std() == pytest.approx(0.025 * 255, rel=0.01)  # the same however bright: no shot noise
        assert noise.mean() == pytest.approx(level * 400, rel=1e-3)
    assert sensor.white_dn == 255 and flat(sensor, 1e3, 1.0, 0, 8).max() == 255


def test_a_sensor_and_its_calibration_agree():
    for sensor in PRESETS.values():
        camera = sensor.camera_section(64, 48, 500.0)
        again = ideal(camera)
        assert again.dn_per_radiance_s == pytest.approx(sensor.dn_per_radiance_s)
        assert again.read_noise_e == pytest.approx(sensor.read_noise_e)
        assert again.psf_sigma_px == pytest.approx(sensor.psf_sigma_px, abs=1e-6)
        assert sensor.with_gain(123.0).dn_per_radiance_s == pytest.approx(123.0)


K = np.array([[1000.0, 0, 32], [0, 1000.0, 32], [0, 0, 1]])


def moved(x_m: float) -> np.ndarray:
    pose = np.eye(4)
    pose[0, 3] = x_m
    return pose


def test_the_image_velocity_of_a_plane_is_focal_length_times_speed_over_depth():
    depth = np.full((64, 64), np.inf)
    depth[20:40, 20:40] = 50.0
    velocity = image_velocity(depth, K, moved(-0.1), moved(0.1), 2.0)
    np.testing.assert_allclose(velocity[..., 0], 1000 * 0.1 / 50)  # beyond the plane: its nearest pixel's
    np.testing.assert_allclose(velocity[..., 1], 0, atol=1e-9)
    assert not image_velocity(np.full((4, 4), np.inf), K, moved(0), moved(1), 1.0).any()


def test_motion_blur_spreads_a_point_along_its_path_and_keeps_its_light():
    picture = np.zeros((21, 41, 1))
    picture[10, 20] = 1.0
    velocity = np.broadcast_to([80.0, 0.0], (21, 41, 2))
    blurred = smear(picture, velocity, 0.1)[..., 0]
    assert blurred.sum() == pytest.approx(1, rel=0.03)  # the splines' small negative parts are cut
    assert 8 <= (blurred[10] > 0.05).sum() <= 9 and blurred[10].max() < 0.2  # 8 px
    assert smear(picture, velocity, 1e-6) is picture  # nothing to see


def test_a_rolling_shutter_slants_a_moving_column():
    picture = np.zeros((40, 60, 1))
    picture[:, 30] = 1.0
    velocity = np.broadcast_to([100.0, 0.0], (40, 60, 2))
    leaning = smear(picture, velocity, 1e-6, line_time_s=5e-3)[..., 0]
    centres = leaning @ np.arange(60) / leaning.sum(1)
    np.testing.assert_allclose(centres, 30 + 0.5 * (np.arange(40) + 0.5 - 20), atol=0.05)  # px


def test_stars_are_as_many_and_as_bright_as_on_the_sky():
    directions, irradiances = catalogue()
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1)
    magnitudes = -26.74 - 2.5 * np.log10(irradiances / np.pi)
    assert (magnitudes < 6).sum() == pytest.approx(5000, rel=0.05) and magnitudes.max() < 9.001
    wide = np.array([[64.0, 0, 32], [0, 64.0, 32], [0, 0, 1]])
    picture = star_radiance(np.eye(3), wide, 64, 64)
    seen = directions[:, 2] > 1e-6
    place = directions[seen] @ wide.T
    u, v = (place[:, :2] / place[:, 2:]).T
    inside = (u >= 0) & (u < 64) & (v >= 0) & (v < 64)
    assert inside.sum() > 1000
    assert picture.sum() / 64**2 == pytest.approx(irradiances[seen][inside].sum())  # radiance x solid angle


@settings(max_examples=20)
@given(level=st.floats(0, 2), factor=st.sampled_from([1, 2, 4, 8]), seed=st.integers(0, 99))
def test_a_longer_exposure_never_darkens_and_is_the_same_as_a_brighter_scene(level, factor, seed):
    sensor = dataclasses.replace(PRESETS["spacecam"], prnu=0.0, dark_e_s=0.0, hot_pixels=0.0)
    short, long = (flat(sensor, level, t, seed, 24) for t in (1e-4, factor * 1e-4))
    assert long.mean() >= short.mean() - 3  # the noise of this mean is 25 DN / 24
    np.testing.assert_array_equal(flat(sensor, level * factor, 1e-4, seed, 24), long)  # powers of 2: exact
