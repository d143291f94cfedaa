"""The model's own error beside the noise: measured on simulated errors, its penalty as SciPy has it, its gradients."""

import math

import numpy as np
import pytest
import scipy.optimize
import torch
from hypothesis import given
from hypothesis import strategies as st

from obbgs_core.losses import cauchy, likelihood_loss
from obbgs_core.misfit import OWN, Compared, model_error, relative_misfit, stated_misfit
from obbgs_core.sensor import Sensor
from tests.obbgs_core.test_losses import (
    value_and_gradient,
)

SENSOR = Sensor(black_dn=10, white_dn=4095, dn_per_radiance_s=1e7, electrons_per_dn=4, read_noise_dn=5)
EXPOSURES_S = torch.full((1, 1, 1, 1), 1e-4)


def erring(share: float, seed: int, noise: bool = True) -> tuple[torch.Tensor, torch.Tensor]:
    """Return a prediction [1, 120, 90, 1] that errs by a share of the light, its own or another's, and readings."""
    g = torch.Generator().manual_seed(seed)
    radiance = 0.2 + 1.5 * torch.rand(1, 120, 90, 1, generator=g)
    expected = SENSOR.expected_dn(radiance, EXPOSURES_S)
    light_dn = expected - SENSOR.black_dn
    spread = (OWN * light_dn.square() + (1 - OWN) * light_dn.square().mean()).sqrt()
    dn = expected + share * spread * torch.randn(expected.shape, generator=g)
    if noise:
        dn = dn + SENSOR.variance_dn2(expected).sqrt() * torch.randn(expected.shape, generator=g)
    return radiance, dn


@given(st.floats(0.05, 0.3), st.integers(0, 1000))
def test_the_share_by_which_a_model_errs_is_found_beside_the_noise(share, seed):
    radiance, dn = erring(share, seed)
    assert relative_misfit(radiance, EXPOSURES_S, dn, SENSOR) == pytest.approx(share, rel=0.1)


def test_noise_alone_is_no_misfit_and_darkness_tells_nothing():
    radiance, dn = erring(0.0, 1)
    assert relative_misfit(radiance, EXPOSURES_S, dn, SENSOR) < 0.01
    assert math.isnan(relative_misfit(0 * radiance, EXPOSURES_S, 0 * dn, SENSOR))


@given(st.floats(0.05, 0.3), st.integers(0, 1000), st.booleans())
def test_the_share_with_which_errors_are_as_large_as_stated_is_found_on_the_target(share, seed, with_noise):
    radiance, dn = erring(share, seed, with_noise)
    on_target = torch.ones(radiance.shape[:3], dtype=torch.bool)
    on_target[:, ::3] = False
    dn[~on_target] = SENSOR.white_dn  # whatever is read elsewhere
    # in two parts of unlike sizes
    parts = [
        Compared(radiance[:, rows], on_target[:, rows], EXPOSURES_S, dn[:, rows])
        for rows in (slice(0, 50), slice(50, None))
    ]
    assert stated_misfit(parts, SENSOR) == pytest.approx(share, rel=0.1)


def test_no_share_is_stated_of_noise_of_nothing_or_of_errors_beyond_all_light():
    radiance, dn = erring(0.0, 1)
    on_target = torch.ones(radiance.shape[:3], dtype=torch.bool)
    quiet = SENSOR.expected_dn(radiance, EXPOSURES_S)
    assert stated_misfit([Compared(radiance, on_target, EXPOSURES_S, dn)], SENSOR) < 0.01
    assert stated_misfit([Compared(radiance, on_target, EXPOSURES_S, quiet)], SENSOR) == 0
    for light, counts in ((radiance, ~on_target), (1e-3 * radiance, on_target)):
        assert math.isnan(stated_misfit([Compared(light, counts, EXPOSURES_S, dn)], SENSOR))


def test_the_mean_of_several_pixels_has_less_noise_and_the_same_misfit():
    radiance, dn = erring(0.02, 1, noise=False)
    alone = relative_misfit(radiance, EXPOSURES_S, dn, SENSOR, averaged_pixels=1)
    assert alone < relative_misfit(radiance, EXPOSURES_S, dn, SENSOR, averaged_pixels=16) < 0.021


def test_the_penalty_is_that_of_scipy():
    residuals = np.random.default_rng(0).normal(size=50) * 10
    solved = scipy.optimize.least_squares(lambda x: residuals + 0 * x, [0.0], loss="cauchy", f_scale=3.0)
    assert cauchy(torch.from_numpy(residuals)).item() * 50 == pytest.approx(solved.cost, rel=1e-12)


def test_residuals_over_both_errors_have_unit_variance():
    radiance, dn = erring(0.2, 3)
    _, residual = likelihood_loss(radiance, EXPOSURES_S, dn, SENSOR, misfit=0.2)
    unclipped = residual[dn < SENSOR.white_dn]
    assert unclipped.square().mean().item() == pytest.approx(1, rel=0.1)


def test_a_glint_loses_its_pull_as_it_grows():
    radiance = torch.full((1, 8, 8, 1), 0.5)
    pulls = []
    for glint in (0.6, 1.0, 2.0):
        dn = SENSOR.expected_dn(radiance, EXPOSURES_S).clone()
        dn[0, 4, 4] = SENSOR.black_dn + 1000 * glint
        _, gradient = value_and_gradient(
            lambda r, dn=dn: likelihood_loss(r, EXPOSURES_S, dn, SENSOR, misfit=0.05)[0], radiance
        )
        pulls.append(-gradient[0, 4, 4].item())
    assert pulls[0] > pulls[1] > pulls[2] > 0


@pytest.mark.parametrize("averaged_pixels", [1, 4])
def test_the_error_is_spread_over_a_picture_as_the_formula_says(averaged_pixels):
    rng = np.random.default_rng(1)
    radiance = np.where(rng.random((2, 40, 30, 1)) < 0.5, 0, rng.uniform(0.3, 1.2, (2, 40, 30, 1)))
    times_s = np.array([1e-4, 2e-4]).reshape(2, 1, 1, 1)
    seen, exposures_s = torch.from_numpy(radiance), torch.from_numpy(times_s)
    error = model_error(seen, exposures_s, SENSOR, averaged_pixels, misfit=0.3)
    light_dn = 1e7 * times_s * radiance
    noise = light_dn / 4 + 5**2 + 1 / 12
    lit, floors = radiance > 0, error.floor_dn2.numpy()
    for i in range(2):  # over the lit pixels of each picture, the squared share of the light
        both = (error.by_light * light_dn[i] ** 2 + floors[i])[lit[i]]
        assert both.sum() == pytest.approx(averaged_pixels * 0.09 * (light_dn[i] ** 2).sum())
    assert floors[1] == pytest.approx(
        floors[0] * (light_dn[1][lit[1]] ** 2).mean() / (light_dn[0][lit[0]] ** 2).mean()
    )
    inflated = np.sqrt(1 + (error.by_light * light_dn**2 + floors.reshape(2, 1, 1, 1)) / noise)
    assert error.weight == pytest.approx(inflated[lit].mean())


def test_a_model_that_is_far_off_pulls_as_hard_against_the_priors_as_without_the_misfit():
    """What a training has yet to learn is taken for misfit: the pull must not vanish with it."""
    radiance = torch.full((1, 30, 30, 1), 0.3)
    dn = SENSOR.expected_dn(3 * radiance, EXPOSURES_S)
    misfit = relative_misfit(radiance, EXPOSURES_S, dn, SENSOR)
    assert misfit == pytest.approx(2, rel=1e-3)
    pulls = [
        value_and_gradient(lambda r, k=k: likelihood_loss(r, EXPOSURES_S, dn, SENSOR, misfit=k)[0], radiance)[
            1
        ].mean()
        for k in (None, misfit)
    ]
    assert (
        0.4 < (pulls[1] / pulls[0]).item() < 1
    )  # one deviation of both errors, against two of the noise at most


def test_a_dark_prediction_has_no_misfit_and_the_loss_is_finite():
    radiance = torch.zeros(1, 8, 8, 1)
    dn = torch.full_like(radiance, 500.0)
    error = model_error(radiance, EXPOSURES_S, SENSOR, 1, misfit=0.5)
    assert error.floor_dn2.item() == 0 and error.weight == 1
    assert torch.isfinite(likelihood_loss(radiance, EXPOSURES_S, dn, SENSOR, misfit=0.5)[0])
