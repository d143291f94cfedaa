"""The exponent of a camera's response is told by frames of several exposure times beside a model."""

import dataclasses

import numpy as np
import pytest
import torch

from obbgs_core.batches import Batches
from obbgs_core.evidence import response as evidence
from obbgs_core.evidence.response import LEAST, LEAST_DRIFT, Response
from obbgs_core.frames import TrainingFrame
from obbgs_core.losses import likelihood_loss
from obbgs_core.model.gaussians import Gaussians
from obbgs_core.model.sh import from_radiance, radiance
from obbgs_core.sensor import Sensor
from tests.scenes import EXPOSURES_S, SENSOR, photographed, target

FULL_SCALE_DN = SENSOR.white_dn - SENSOR.black_dn


def bent(dn: torch.Tensor, exponent: float) -> torch.Tensor:
    """Return readings to a power, full scale as 1."""
    share = ((dn - SENSOR.black_dn) / FULL_SCALE_DN).clamp(min=0)
    return SENSOR.black_dn + FULL_SCALE_DN * share**exponent


def in_brackets(frames: list[TrainingFrame], size: int | None) -> list[TrainingFrame]:
    """Return frames in brackets of a size; None: each by itself."""
    return [dataclasses.replace(f, bracket=None if size is None else i // size) for i, f in enumerate(frames)]


@pytest.mark.parametrize("size", [3, None])
@pytest.mark.parametrize("exponent", [0.85, 1.0, 1.15])
def test_the_exponent_is_found_and_a_linear_camera_stays_linear(exponent, size):
    model = target()
    frames = [
        dataclasses.replace(f, dn=bent(f.dn, exponent))
        for f in in_brackets(photographed(model, count=36 if size else 60), size)
    ]
    batches, response = Batches(frames, SENSOR.white_dn), Response()
    changed = response.decide(model, batches, SENSOR)
    assert changed == (exponent != 1)
    for _ in range(2):  # as often as in a training
        response.decide(model, batches, dataclasses.replace(SENSOR, response=response.exponent))
    assert response.exponent == pytest.approx(exponent, abs=LEAST)  # what is taken for linear may be as wrong
    assert response.error < 0.02


def wrong(model: Gaussians, contrast: float, size: float = 1.0) -> Gaussians:
    """Return Gaussians whose radiances differ by more or less from a mean, and whose sizes are others."""
    value = radiance(model.sh, torch.tensor([[0.0, 0.0, 1.0]]).expand(len(model.sh), 3))[:, None]
    sh = from_radiance(0.35 + contrast * (value - 0.35))
    return dataclasses.replace(model, sh=sh, log_scales=model.log_scales + np.log(size))


@pytest.mark.parametrize("bracket", [3, None])
@pytest.mark.parametrize(("contrast", "size"), [(1, 1.3), (0.7, 1.3), (1.4, 1), (0.4, 1)])
def test_a_model_that_is_wrong_is_no_evidence_against_a_linear_camera(contrast, size, bracket):
    """A training in its first steps has one: too soft, dark faces too bright or bright ones too dark."""
    frames, model = in_brackets(photographed(target(), count=54), bracket), wrong(target(), contrast, size)
    assert not Response().decide(model, Batches(frames, SENSOR.white_dn), SENSOR)


@pytest.mark.parametrize("drift", [0.0, 0.15])
@pytest.mark.parametrize("wrong_by", [(1.0, 1.0, 1.0), (1.12, 1.0, 1.15), (1.0, 1.2, 0.9)])
@pytest.mark.parametrize("size", [3, None])
def test_exposure_times_that_are_wrong_by_setting_or_drift_are_found(size, wrong_by, drift):
    model, count = target(), 60
    along = np.linspace(-0.5, 0.5, count)
    tagged_s = np.resize(EXPOSURES_S, count)
    true = np.resize(wrong_by, count) / np.median(wrong_by) * np.exp(drift * along)
    frames = [
        dataclasses.replace(f, exposure_time_s=float(tagged))
        for f, tagged in zip(
            photographed(model, count, exposures_s=(tagged_s * true).tolist()), tagged_s, strict=True
        )
    ]
    frames, response = in_brackets(frames, size), Response()
    batches = Batches(frames, SENSOR.white_dn)
    for _ in range(2):
        response.decide(model, batches.exposed(response.gains(frames)), SENSOR)
    assert response.exponent == 1
    gains = response.gains(frames)
    assert (gains is None) == (drift == 0 and len(set(wrong_by)) == 1)
    np.testing.assert_allclose(gains or np.ones(count), true, rtol=0.01)
    exposed = batches.exposed(gains).batch([7]).exposure_time_s.item()
    assert exposed == pytest.approx(tagged_s[7] * true[7], rel=0.01)


@pytest.mark.parametrize("rising", [False, True])
def test_a_drift_is_not_told_from_light_that_turns_with_views_which_rise_along_the_pass(rising):
    model, count = target(), 60
    tagged_s = np.resize(EXPOSURES_S, count)
    true_s = tagged_s * np.exp(0.2 * np.linspace(-0.5, 0.5, count))
    poses = [f.world_to_camera for f in photographed(model, count)]
    heights = [float(p[:3, 3] @ p[:3, 2]) for p in poses]
    order = np.argsort(heights) if rising else np.arange(count)
    frames = photographed(model, count, exposures_s=true_s[np.argsort(order)].tolist())
    frames = [
        dataclasses.replace(frames[i], exposure_time_s=float(tagged))
        for i, tagged in zip(order, tagged_s, strict=True)
    ]
    response = Response()
    found = response.decide(model, Batches(in_brackets(frames, None), SENSOR.white_dn), SENSOR)
    assert found != rising and response.is_as_stated == rising
    assert rising or response.drift == pytest.approx(0.2, abs=0.01)


def test_a_drift_as_small_as_a_model_errs_along_a_pass_is_not_taken():
    model, along = target(), np.linspace(-0.5, 0.5, 60)
    tagged_s = np.resize(EXPOSURES_S, 60)
    true_s = tagged_s * np.exp(LEAST_DRIFT / 2 * along)
    frames = [
        dataclasses.replace(f, exposure_time_s=float(tagged))
        for f, tagged in zip(photographed(model, 60, exposures_s=true_s.tolist()), tagged_s, strict=True)
    ]
    response = Response()
    assert not response.decide(model, Batches(in_brackets(frames, None), SENSOR.white_dn), SENSOR)
    assert response.is_as_stated


def test_a_tenth_of_the_pass_that_compares_nothing_does_not_hide_what_the_others_tell():
    model = target()
    exposures_s = np.resize(EXPOSURES_S, 60)
    exposures_s[:6] = EXPOSURES_S[1]  # of a part that has no other exposure time to compare with
    frames = [
        dataclasses.replace(f, dn=bent(f.dn, 0.85))
        for f in photographed(model, 60, exposures_s=exposures_s.tolist())
    ]
    response = Response()
    assert response.decide(model, Batches(in_brackets(frames, None), SENSOR.white_dn), SENSOR)
    assert response.exponent == pytest.approx(0.85, abs=LEAST)


def test_frames_of_one_exposure_time_tell_nothing():
    model = target()
    frames = photographed(model, count=36, exposures_s=(1e-4,))
    response = Response()
    assert not response.decide(model, Batches(frames, SENSOR.white_dn), SENSOR)
    assert response.exponent == 1 and np.isnan(response.error)


@pytest.mark.parametrize("count", [36, 60])
def test_readings_that_do_not_follow_exposure_times_are_no_response(count):
    model = target()
    frames = [
        dataclasses.replace(f, exposure_time_s=f.exposure_time_s * (1, 2, 1.5)[i % 3])
        for i, f in enumerate(photographed(model, count=count, exposures_s=(1e-4,)))
    ]
    response = Response()
    assert not response.decide(model, Batches(frames, SENSOR.white_dn), SENSOR)
    assert response.exponent == 1


def test_exposures_that_a_camera_chose_by_what_it_saw_tell_nothing(monkeypatch):
    """A model with too little contrast shows dark sides, which were exposed for longer, too bright."""
    model = target()
    lit = model.means[:, 0] > 0
    model.sh = from_radiance(torch.where(lit, 0.6, 0.15)[:, None, None])
    seen = [float(f.dn.mean()) for f in photographed(model, 90, exposures_s=(1e-4,))]
    brighter_than = np.argsort(np.argsort(seen))
    exposures_s = np.array([1.4e-4, 1e-4, 0.7e-4])[brighter_than * 3 // 90]
    frames = photographed(model, 90, exposures_s=exposures_s.tolist())
    given = wrong(model, 0.7), Batches(frames, SENSOR.white_dn), SENSOR
    response = Response()
    assert not response.decide(*given) and response.exponent == 1
    monkeypatch.setattr(evidence, "MOST_CHOSEN", 1.0)  # it would have been taken for one
    assert Response().decide(*given)


def test_the_loss_is_that_of_readings_to_the_power_and_its_gradient_reaches_the_light():
    sensor = Sensor(10.0, 255.0, 2.45e6, 1e9, 2.0, response=0.8)
    light = torch.linspace(0.05, 0.9, 64).view(1, 8, 8, 1).double().requires_grad_()
    time_s = torch.full((1, 1, 1, 1), 1e-4).double()
    expected = 10 + 245 * (light.detach() * 245 / 245) ** 0.8
    torch.testing.assert_close(sensor.expected_dn(light.detach(), time_s), expected)
    dn = expected + 5

    def loss(values: torch.Tensor) -> torch.Tensor:
        return likelihood_loss(values, time_s, dn, sensor)[0]

    (gradient,) = torch.autograd.grad(loss(light), light)
    linear = dataclasses.replace(sensor, response=1.0)
    bent_light = (light.detach() ** 0.8).requires_grad_()
    (by_bent,) = torch.autograd.grad(likelihood_loss(bent_light, time_s, dn, linear)[0], bent_light)
    torch.testing.assert_close(gradient, by_bent * 0.8 * light.detach() ** -0.2)
