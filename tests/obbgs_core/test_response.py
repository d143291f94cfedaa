"""The exponent of a camera's response is told by frames of several exposure times beside a model."""

import dataclasses

import numpy as np
import pytest
import torch

from obbgs_core.batches import Batches
from obbgs_core.losses import likelihood_loss
from obbgs_core.model.sh import from_radiance, radiance
from obbgs_core.sensor import Sensor
from obbgs_core.train.response import LEAST, Response
from tests.scenes import SENSOR, photographed, target

FULL_SCALE_DN = SENSOR.white_dn - SENSOR.black_dn


def bent(dn: torch.Tensor, exponent: float) -> torch.Tensor:
    """Return readings to a power, full scale as 1."""
    share = ((dn - SENSOR.black_dn) / FULL_SCALE_DN).clamp(min=0)
    return SENSOR.black_dn + FULL_SCALE_DN * share**exponent


@pytest.mark.parametrize("exponent", [0.85, 1.0, 1.15])
def test_the_exponent_is_found_and_a_linear_camera_stays_linear(exponent):
    model = target()
    frames = [
        dataclasses.replace(f, dn=bent(f.dn, exponent), bracket=i // 3)
        for i, f in enumerate(photographed(model, count=36))
    ]
    batches, response = Batches(frames, SENSOR.white_dn), Response()
    changed = response.decide(model, batches, SENSOR)
    assert changed == (exponent != 1)
    for _ in range(2):  # as often as in a training
        response.decide(model, batches, dataclasses.replace(SENSOR, response=response.exponent))
    assert response.exponent == pytest.approx(exponent, abs=LEAST)  # what is taken for linear may be as wrong
    assert response.error < 0.02


@pytest.mark.parametrize(("contrast", "size"), [(1, 1.3), (0.7, 1.3), (1.4, 1), (0.4, 1)])
def test_a_model_that_is_wrong_is_no_evidence_against_a_linear_camera(contrast, size):
    """A training in its first steps has one: too soft, dark faces too bright or bright ones too dark."""
    frames = [dataclasses.replace(f, bracket=i // 3) for i, f in enumerate(photographed(target(), count=54))]
    model = target()
    value = radiance(model.sh, torch.tensor([[0.0, 0.0, 1.0]]).expand(len(model.sh), 3))[:, None]
    model.sh = from_radiance(0.35 + contrast * (value - 0.35))
    model.log_scales = model.log_scales + np.log(size)
    assert not Response().decide(model, Batches(frames, SENSOR.white_dn), SENSOR)


def test_frames_of_one_exposure_time_tell_nothing():
    model = target()
    frames = photographed(model, count=36, exposures_s=(1e-4,))
    response = Response()
    assert not response.decide(model, Batches(frames, SENSOR.white_dn), SENSOR)
    assert response.exponent == 1 and np.isnan(response.error)


def test_exposures_that_a_camera_chose_by_what_it_saw_tell_nothing():
    # it saw less light from some sides than the model shows there, and exposed for longer until readings were the same
    model = target()
    frames = [
        dataclasses.replace(f, exposure_time_s=f.exposure_time_s * (1, 2, 1.5)[i % 3])
        for i, f in enumerate(photographed(model, count=36, exposures_s=(1e-4,)))
    ]
    response = Response()
    assert not response.decide(model, Batches(frames, SENSOR.white_dn), SENSOR)
    assert response.exponent == 1


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
