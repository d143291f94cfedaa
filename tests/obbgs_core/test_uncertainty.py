"""What a model states of its own errors, against autograd, SciPy and draws of what it assumes."""

import dataclasses

import numpy as np
import pytest
import torch
from scipy import stats

from obbgs_core.frames import cameras_of
from obbgs_core.model.gaussians import Gaussians
from obbgs_core.render import render
from obbgs_core.score.uncertainty import (
    Calibration,
    Readings,
    calibrated,
    parameter_deviations,
    rendered_deviation,
)
from tests import scenes


@pytest.fixture(scope="module")
def few() -> Gaussians:
    return scenes.target(4)


def test_the_information_is_that_of_the_whole_jacobian(few):
    """The mean over many random signs is the diagonal of JᵀWJ, each row of J by its own backward pass."""
    frame = scenes.photographed(few, 1, size_px=16, focal_px=32.0)[0]
    leaves = few.trainable()
    radiance = render(leaves, cameras_of([frame])).radiance.flatten()
    prediction = scenes.SENSOR.predicted(radiance.detach(), frame.exposure_time_s)
    gain = scenes.SENSOR.dn_per_radiance_s * frame.exposure_time_s
    expected = torch.zeros_like(few.opacity_logits)
    for value, sigma in zip(radiance, prediction.sigma_dn, strict=True):
        (slope,) = torch.autograd.grad(value, leaves.opacity_logits, retain_graph=True)
        expected += (slope * gain / sigma) ** 2
    repeats = 300
    found = parameter_deviations(few, [frame] * repeats, scenes.SENSOR)["opacity_logits"]
    # the prior is one more of the repeated frames' information
    torch.testing.assert_close(found, (repeats * expected + 0.5**-2).rsqrt(), rtol=0.2, atol=0)


def test_what_no_frame_sees_is_as_uncertain_as_the_prior_and_what_is_seen_is_less(few):
    behind = dataclasses.replace(few, means=few.means + torch.tensor([0.0, 0.0, 100.0]))
    both = Gaussians.concatenate([few, behind])
    frames = [f for f in scenes.photographed(few, 12) if f.world_to_camera[2, 2].abs() < 0.9]
    found = parameter_deviations(both, frames, scenes.SENSOR)
    seen, unseen = found["opacity_logits"][:4], found["opacity_logits"][4:]
    assert (unseen == 0.5).all() and (seen < 0.25).all()
    largest = both.scales[4:].max(dim=1).values
    torch.testing.assert_close(found["means"][4:], largest[:, None].expand(4, 3))


def test_the_rendered_deviation_is_that_of_the_drawn_models_and_repeats(few):
    camera = cameras_of(scenes.photographed(few, 1))
    exact = {name: torch.zeros_like(value) for name, value in few.tensors().items()}
    assert rendered_deviation(few, exact, [camera])[0].max() < 1e-6
    colour = exact | {"sh": torch.full_like(few.sh, 0.01)}
    once, again = (rendered_deviation(few, colour, [camera])[0] for _ in range(2))
    assert torch.equal(once, again) and once.max() > 1e-3
    assert rendered_deviation(few, colour, [camera], seed=1)[0].ne(once).any()


@pytest.mark.parametrize(("scale", "degrees"), [(0.5, 3.0), (3.0, 10.0)])
def test_a_calibration_finds_what_the_errors_were_drawn_with(scale, degrees):
    rng = np.random.default_rng(0)
    deviation, noise = rng.uniform(1, 20, 20_000), rng.uniform(1, 4, 20_000)
    error = scale * deviation * stats.t.rvs(degrees, size=20_000, random_state=rng)
    dn = 500 + error + noise * rng.standard_normal(20_000)
    columns = (torch.from_numpy(values) for values in (dn, np.full(20_000, 500.0), deviation, noise))
    found = calibrated(Readings(*columns))
    held = np.abs(error) <= found.half_width(torch.from_numpy(deviation)).numpy()
    assert held.mean() == pytest.approx(0.9, abs=0.02)
    read = found.half_width_read(torch.from_numpy(deviation), torch.from_numpy(noise)).numpy()
    assert (np.abs(dn - 500) <= read).mean() == pytest.approx(0.9, abs=0.02)
    assert found.scale == pytest.approx(scale, rel=0.15)


def test_without_noise_both_intervals_are_those_of_scipy():
    stated, deviation = Calibration(2.0, 5.0), torch.tensor([0.5, 4.0])
    expected = 2 * deviation.numpy() * stats.t.ppf(0.95, 5)
    np.testing.assert_allclose(stated.half_width(deviation), expected, rtol=1e-6)
    # a mean over 24 normal distributions
    np.testing.assert_allclose(stated.half_width_read(deviation, torch.zeros(2)), expected, rtol=0.02)
    wider = stated.half_width_read(deviation, torch.full((2,), 5.0))
    assert (wider > torch.from_numpy(expected)).all()


def test_no_reading_calibrates_nothing():
    none = torch.zeros(0)
    with pytest.raises(ValueError, match="no held-out reading lies on the target"):
        calibrated(Readings(none, none, none, none))
