"""What JPEG leaves of readings is predicted as libjpeg does it, and known to the likelihood and to the level of sky."""

import dataclasses
import io

import numpy as np
import pytest
import torch
from PIL import Image
from scipy.optimize import root_scalar
from scipy.stats import norm

from obbgs_core.batches import Batches
from obbgs_core.frames import TrainingFrame
from obbgs_core.jpeg import TO_RGB, JpegCoding, _DevianceResidual, _in_steps
from obbgs_core.losses import likelihood_loss
from obbgs_core.sensor import Sensor, clipped_moments
from obbgs_core.start.sky_level import levelled

SENSOR = Sensor(0.0, 255.0, 1.0, 1e9, 6.0)  # black is 0: half of the noise on empty sky is clipped
HEIGHT, WIDTH = 52, 72  # no multiple of a block


def stored(values: np.ndarray, **how) -> tuple[np.ndarray, JpegCoding]:
    """Return what comes back of values [H, W, C], and how they were coded."""
    file = io.BytesIO()
    Image.fromarray(values.squeeze()).save(file, "JPEG", **how)
    image = Image.open(file)
    coding = JpegCoding.of(image)
    assert coding is not None
    return np.asarray(image, np.float64).reshape(values.shape), coding


def readings(mean: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return readings of given means, with the sensor's noise, clipped."""
    noise = SENSOR.read_noise_dn * rng.standard_normal(mean.shape)
    return np.rint(mean + noise).clip(0, 255).astype(np.uint8)


def scene(channels: int) -> np.ndarray:
    """Return a picture [H, W, C] of waves, an even part and sharp edges."""
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    image = np.stack([90 + 50 * np.sin(x / (4 + c)) * np.cos(y / (6 - c)) for c in range(channels)], axis=-1)
    image[:20, :20], image[30:44, 10:30] = 100, 180
    return image


@pytest.mark.parametrize("how", [{"subsampling": 0}, {"subsampling": 1}, {"subsampling": 2}, {"grey": True}])
@pytest.mark.parametrize("quality", [60, 85, 95])
def test_mean_and_scatter_of_what_comes_back_are_those_of_libjpeg(quality, how):
    how = dict(how)
    rng, truth = np.random.default_rng(quality), scene(1 if how.pop("grey", False) else 3)
    drawn = [stored(readings(truth, rng), quality=quality, **how) for _ in range(100)]
    values, coding = np.stack([v for v, _ in drawn]), drawn[0][1]
    variance = torch.full((1, *truth.shape), SENSOR.read_noise_dn**2 + 1 / 12).double()
    mean, spread = coding.moments(torch.from_numpy(truth)[None], variance)
    error = values.mean(axis=0) - mean[0].numpy()
    by_chance = np.sqrt(values.var(axis=0).mean() / len(values))
    changed = np.sqrt(np.square(values.mean(axis=0) - truth).mean())
    # integer arithmetic and the rounding of what comes back leave a few tenths
    assert np.sqrt(np.square(error).mean()) < by_chance + 0.3
    assert changed > 1.2 * (by_chance + 0.3) or quality == 95 or truth.shape[2] == 1
    # errors of neighbouring chromas are alike, which is left out
    assert 0.8 < values.std(axis=0).mean() / spread.sqrt().mean().item() < 1.2


@pytest.mark.parametrize("how", [{"subsampling": 0}, {"subsampling": 1}, {"subsampling": 2}, {"grey": True}])
@pytest.mark.parametrize("quality", [60, 85, 95])
def test_what_was_coded_lies_within_half_a_step_of_every_coefficient_that_libjpeg_stored(quality, how):
    """Without noise and clipping, but for a DN of integer arithmetic; one brighter, or bluer, by two steps does not."""
    how = dict(how)
    truth = scene(1 if how.pop("grey", False) else 3)[:48, :64]  # whole blocks
    values, coding = stored(np.rint(truth).astype(np.uint8), quality=quality, **how)
    dn, mean = (torch.from_numpy(image)[None] for image in (values, np.rint(truth)))

    def shares_outside(picture: torch.Tensor) -> list[float]:
        residuals = coding.deviance_residuals(picture, torch.ones_like(picture), coding.stacked(dn))
        return [(of > 2).double().mean().item() for of in residuals]

    assert max(shares_outside(mean)) < 0.02
    brighter = mean + 2 * coding.luma[0] / 8
    assert shares_outside(brighter)[0] > 1 / 70  # the mean of each block is wrong
    if coding.chroma:
        bluer = mean + 2 * coding.chroma[0] / 8 * torch.tensor([0, TO_RGB[1][1], TO_RGB[2][1]])
        assert shares_outside(bluer)[1] > 1 / 140 and shares_outside(bluer)[0] < 0.02


def test_a_coefficient_is_as_likely_as_its_rounding():
    value, stored_at = torch.linspace(-6, 6, 49).double(), torch.tensor(1.0).double()
    for sigma in (0.05, 0.3, 1.0, 4.0):
        x = value.numpy()
        likelihood = norm.cdf((1.5 - x) / sigma) - norm.cdf((0.5 - x) / sigma)
        expected = -2 * np.log(likelihood.clip(1e-300) / (2 * norm.cdf(0.5 / sigma) - 1))
        found = _DevianceResidual.apply(value, torch.tensor(sigma).double(), stored_at).square().numpy()
        told = likelihood > 1e-12
        np.testing.assert_allclose(found[told], expected[told], rtol=1e-3, atol=1e-9)


@pytest.mark.parametrize("sigma", [0.05, 0.3, 1.0, 4.0])
def test_the_slope_of_a_coefficient_s_likelihood_is_that_of_finite_differences(sigma):
    value = torch.linspace(-5, 5, 40).double().requires_grad_()  # not at the very middle of a step
    others = torch.tensor(sigma).double().expand(40), torch.tensor(1.0).double().expand(40)
    assert torch.autograd.gradcheck(lambda v: _DevianceResidual.apply(v, *others), value, eps=1e-7, atol=1e-4)


def test_clipped_means_have_the_slope_of_finite_differences():
    mean = torch.linspace(-30, 290, 41).double().requires_grad_()
    sigma = torch.tensor(6.0).double()
    assert torch.autograd.gradcheck(lambda m: clipped_moments(m, sigma, 255.0)[0], mean)


def test_coefficients_are_those_of_the_file_also_where_values_were_clipped():
    """Dark blocks, of whose values many came back below black, were too bright by a step in the mean."""
    noisy = readings(np.zeros((64, 64, 1)), np.random.default_rng(0))
    values, coding = stored(noisy, quality=95)
    before, back = (torch.from_numpy(v).double() for v in (noisy, values))
    file, unaware = (_in_steps(coding._planes(of[None])[0], coding.luma)[0].round() for of in (before, back))
    error, unaware = ((of - file)[..., 0].mean() for of in (coding.coefficients(back)[0], unaware))
    assert unaware > 3 * error.abs()


@pytest.mark.parametrize("subsampling", [0, 1, 2])
def test_a_batch_has_the_coefficients_of_its_window(subsampling):
    noisy = readings(scene(3)[:48, :64], np.random.default_rng(1))
    values, coding = stored(noisy, quality=90, subsampling=subsampling)
    dn, K = torch.from_numpy(values).float(), torch.eye(3)
    frames = [TrainingFrame(dn, 1.0, torch.eye(4), K, number) for number in range(2)]
    windows = torch.tensor([[16, 0, 48, 32], [32, 16, 64, 48]])
    batches = Batches(frames, SENSOR.white_dn, windows=windows, jpeg=coding)
    stored_of, batch = coding.coefficients(dn), batches.batch([0, 1])
    assert batch.stored is not None and batch.dn.shape[1:3] == (32, 32)
    luma, chroma = batch.stored
    assert luma.dtype == chroma.dtype == torch.int16
    rows, columns = (2 // n for n in coding.averaged)
    assert torch.equal(luma[1], stored_of[0][:, 2:, 4:])
    assert torch.equal(chroma[1], stored_of[1][:, rows:, 2 * columns :])
    time_s, told = torch.ones(2, 1, 1, 1), dataclasses.replace(SENSOR, jpeg=coding)
    given, _ = likelihood_loss(batch.dn + 1, time_s, batch.dn, told, stored=batch.stored)
    found, _ = likelihood_loss(batch.dn + 1, time_s, batch.dn, told)
    assert abs(given / found - 1) < 0.02  # chromas at the edge of a window are interpolated from beyond it


@pytest.mark.parametrize("level_dn", [0.0, 3.0, 8.0, 60.0])
def test_the_likeliest_light_is_the_true_one_though_coding_smooths_what_was_clipped(level_dn):
    rng = np.random.default_rng(3)
    values, coding = stored(readings(np.full((160, 160, 3), level_dn), rng), quality=85)
    dn, time_s = torch.from_numpy(values).float()[None], torch.ones(1, 1, 1, 1)

    def found_dn(sensor: Sensor) -> float:
        def slope(light: float) -> float:  # as in a training, which does not follow the variance
            radiance = torch.full(dn.shape, light, requires_grad=True)
            loss, _ = likelihood_loss(radiance, time_s, dn, sensor, misfit=0.0)
            return torch.autograd.grad(loss, radiance)[0].sum().item()

        return root_scalar(slope, bracket=(-20, 90), xtol=0.01).root

    told = dataclasses.replace(SENSOR, jpeg=coding)
    # three deviations of a mean of so many readings, and a block's mean is rounded to steps of 5/8 DN
    near_dn = 3 * SENSOR.read_noise_dn * 2 / 160 + 0.3
    assert abs(found_dn(told) - level_dn) < near_dn
    if level_dn < SENSOR.read_noise_dn:
        assert found_dn(SENSOR) > level_dn + near_dn


@pytest.mark.parametrize("quality", [85, 95])
@pytest.mark.parametrize("level_dn", [0.0, 4.0])
def test_the_level_of_sky_is_that_before_coding(level_dn, quality):
    rng, frames, coding = np.random.default_rng(4), [], None
    truth = np.full((96, 96, 3), level_dn)
    truth[:30] += np.linspace(20, 150, 96)[None, :, None]
    for number in range(6):
        values, coding = stored(readings(truth, rng), quality=quality)
        frames.append(
            TrainingFrame(torch.from_numpy(values).float(), 1.0, torch.eye(4), torch.eye(3), number)
        )
    _, _, level = levelled(frames, dataclasses.replace(SENSOR, jpeg=coding))
    assert level.fits == (level_dn == 0)
    assert float((level.planes_dn[..., 0] - level_dn).abs().max()) < 0.1 * SENSOR.read_noise_dn


def test_a_saturated_picture_has_a_gradient_that_is_finite():
    values, coding = stored(np.full((32, 32, 3), 255, np.uint8), quality=85)
    light = torch.full((1, 32, 32, 3), 2000.0, requires_grad=True)
    dn, sensor = torch.from_numpy(values).float()[None], dataclasses.replace(SENSOR, jpeg=coding)
    loss, _ = likelihood_loss(light, torch.ones(1, 1, 1, 1), dn, sensor, edge_weight=0.05, misfit=0.1)
    assert torch.autograd.grad(loss, light)[0].isfinite().all()


def test_tables_that_are_none_are_refused():
    with pytest.raises(ValueError, match="64 quantisation steps"):
        JpegCoding((1,) * 63)
