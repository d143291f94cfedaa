"""The image model against simulated sensors and its own invariances."""

import dataclasses

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.ndimage import uniform_filter

from obbgs_core.errors import ReconstructionError
from obbgs_core.methods.presets import preset
from obbgs_core.sensor import Sensor, clipped_mean, dark_reading, noise_excess
from obbgs_core.start.sky_level import UNSMOOTHED
from obbgs_core.train.setup import prepare
from obbgs_core.train.trainer import Trainer
from tests import scenes

SENSOR = Sensor(black_dn=64, white_dn=4095, dn_per_radiance_s=2e7, electrons_per_dn=4, read_noise_dn=8)
radiances = st.floats(0, 50)


@given(radiances, st.floats(1e-5, 1e-3), st.floats(1.0, 4.0))
def test_a_longer_exposure_never_darkens(radiance, exposure_s, factor):
    shorter = SENSOR.expected_dn(torch.tensor(radiance), exposure_s)
    assert SENSOR.expected_dn(torch.tensor(radiance), exposure_s * factor) >= shorter


@given(radiances, st.floats(1e-5, 1e-3), st.floats(0.1, 10.0))
def test_radiance_up_and_time_down_leaves_the_reading(radiance, exposure_s, factor):
    a = SENSOR.expected_dn(torch.tensor(radiance, dtype=torch.float64), exposure_s)
    b = SENSOR.expected_dn(torch.tensor(radiance * factor, dtype=torch.float64), exposure_s / factor)
    torch.testing.assert_close(a, b)


@pytest.mark.parametrize("radiance", [0.0, 0.01, 0.5, 1.8])
def test_the_residual_of_a_true_prediction_has_mean_0_and_variance_1(radiance):
    rng = np.random.default_rng(3)
    signal = 2e7 * 1e-4 * radiance
    dn = 64 + rng.poisson(signal * 4, 200_000) / 4 + rng.normal(0, 8, 200_000)
    dn = torch.tensor(np.clip(np.rint(dn), 0, 4095))
    residual = SENSOR.normalised_residual(torch.tensor(radiance, dtype=torch.float64), 1e-4, dn)
    assert abs(residual.mean()) < 0.01  # 200,000 samples: the error of the mean is 0.002
    assert residual.var().item() == pytest.approx(1, abs=0.02)


def test_a_saturated_reading_censors_brighter_predictions_only():
    dn = torch.full((2,), 4095.0)
    residual = SENSOR.normalised_residual(torch.tensor([5.0, 0.5]), 1e-4, dn)
    assert residual[0] == 0 and residual[1] < -50


def test_saturated_pixels_keep_a_gradient_upwards():
    radiance = torch.tensor([0.5], requires_grad=True)
    SENSOR.normalised_residual(radiance, 1e-4, torch.tensor([4095.0])).square().sum().backward()
    assert radiance.grad is not None and radiance.grad[0] < 0


@pytest.mark.parametrize("mean", [-3.0, 0.0, 0.5, 20.0])
def test_the_mean_of_a_clipped_normal_matches_sampling(mean):
    samples = np.maximum(np.random.default_rng(0).normal(mean, 2.0, 2_000_000), 0)
    ours = clipped_mean(torch.tensor(mean, dtype=torch.float64), torch.tensor(2.0, dtype=torch.float64))
    assert ours.item() == pytest.approx(samples.mean(), abs=0.01)


def test_the_stabilised_scale_has_unit_noise_everywhere():
    rng = np.random.default_rng(1)
    for signal in (50.0, 400.0, 3000.0):
        dn = 64 + rng.poisson(signal * 4, 100_000) / 4 + rng.normal(0, 8, 100_000)
        assert SENSOR.stabilised(torch.tensor(dn)).std().item() == pytest.approx(1, abs=0.03)


def test_an_impossible_sensor_is_refused():
    with pytest.raises(ValueError, match="ordered and positive"):
        Sensor(100, 50, 1, 1, 1)


@pytest.mark.parametrize("electrons_per_dn", [0.5, 4.0, 1e9])
def test_the_stabilised_scale_keeps_its_digits_however_small_the_shot_noise(electrons_per_dn):
    sensor = Sensor(64.0, 4095.0, 1e6, electrons_per_dn, 8.0)
    dn = torch.linspace(64, 4095, 50)
    floor = 3 / 8 + (8.0 * electrons_per_dn) ** 2
    exact = 2 * (((dn.double() - 64) * electrons_per_dn + floor).sqrt() - floor**0.5)
    torch.testing.assert_close(sensor.stabilised(dn).double(), exact, rtol=1e-5, atol=1e-5)


def test_a_unit_of_radiance_far_from_full_scale_and_an_origin_far_from_the_target_are_told():
    frames = scenes.photographed(scenes.target(), 13, size_px=40, focal_px=70.0)
    config = preset("obbgs", {"steps": 2})
    usual, _ = prepare(frames, scenes.SENSOR, config, 0)
    assert "full scale" not in usual.start
    strong = dataclasses.replace(scenes.SENSOR, dn_per_radiance_s=scenes.SENSOR.dn_per_radiance_s / 1000)
    unusual, _ = prepare(frames, strong, config, 0)
    assert "full scale is a radiance of" in unusual.start and "times the gain" in unusual.start
    far = torch.eye(4)
    far[0, 3] = -100.0
    shifted = [dataclasses.replace(f, world_to_camera=f.world_to_camera @ far) for f in frames]
    with pytest.raises(ReconstructionError, match=r"axes lies .*: poses must have it in the target"):
        prepare(shifted, scenes.SENSOR, config, 0)


@pytest.mark.parametrize("black_dn", [0, 64])
@pytest.mark.parametrize("channels", [1, 3])
def test_the_scatter_of_empty_sky_says_by_how_much_stated_noise_is_too_small(black_dn, channels):
    rng = np.random.default_rng(7)
    signal = np.zeros((128, 120, channels))
    signal[20:90, 30:80] = rng.uniform(0, 3000, (70, 50, channels))  # the target, with the strongest texture
    read = np.clip(np.round(black_dn + signal + rng.normal(0, 8, signal.shape)), 0, 4095)
    dn = torch.from_numpy(read.astype(np.float32))
    for stated, expected in ((8.0, 1.0), (4.0, 2.0), (16.0, 0.5)):
        sensor = dataclasses.replace(SENSOR, black_dn=black_dn, read_noise_dn=stated)
        excess, farther = noise_excess(dn, sensor, dark_reading(sensor)[0])
        assert excess == pytest.approx(expected, rel=0.12)
        assert farther < UNSMOOTHED - 0.03
    smoothed = torch.from_numpy(uniform_filter(read, (2, 2, 1)).astype(np.float32))
    assert noise_excess(smoothed, sensor, dark_reading(sensor)[0])[1] > UNSMOOTHED + 0.1
    assert (
        noise_excess(torch.from_numpy(black_dn + signal).float(), sensor, dark_reading(sensor)[0])[1]
        == torch.inf
    )
    # where the target fills the picture nothing is learnt of the noise, and where it nearly does, not from the target
    assert noise_excess(dn[20:90, 30:80], sensor, black_dn) == (1.0, torch.inf)
    exact = dataclasses.replace(SENSOR, black_dn=black_dn, read_noise_dn=8.0)
    cut = dn[4:90, 14:80]  # a quarter of it is empty
    assert noise_excess(cut, exact, dark_reading(exact)[0])[0] == pytest.approx(1, rel=0.15)


@pytest.mark.parametrize(("stated_dn", "changed"), [(3.0, False), (1.0, True), (6.0, True)])
def test_a_training_takes_the_noise_that_empty_sky_shows(stated_dn, changed, caplog):
    frames = scenes.photographed(scenes.target(40), 18)
    stated = dataclasses.replace(scenes.SENSOR, read_noise_dn=stated_dn)
    trainer = Trainer(frames[:12], stated, preset("obbgs", {"steps": 10}))
    trainer.join(frames[12:])  # what was said of the first frames is said of all
    setup = trainer.setup
    assert ("read noise taken as" in setup.start) == ("read noise taken as" in caplog.text) == changed
    if changed:
        assert setup.sensor.read_noise_dn == pytest.approx(scenes.SENSOR.read_noise_dn, rel=0.15)
    else:
        assert setup.sensor == stated


def test_pictures_that_were_smoothed_do_not_say_how_much_noise_there_was():
    frames = [
        dataclasses.replace(f, dn=torch.from_numpy(uniform_filter(f.dn.numpy(), (2, 2, 1))))
        for f in scenes.photographed(scenes.target(40), 12)
    ]
    setup = Trainer(frames, scenes.SENSOR, preset("obbgs", {"steps": 10})).setup
    assert setup.sensor == scenes.SENSOR and "read noise" not in setup.start
