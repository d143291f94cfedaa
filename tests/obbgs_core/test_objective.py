"""What is added to the loss of the images."""

import dataclasses

import pytest
import torch

from obbgs_core.render import render
from obbgs_core.train.batches import Batches
from obbgs_core.train.objective import MOVING_SUN_SKY, LossSettings, priors
from tests.scenes import SENSOR, photographed, target

SKY = LossSettings(kind="likelihood", sky_weight=3.0)


@pytest.mark.parametrize(("shading", "share"), [("view", 1), ("sun", MOVING_SUN_SKY)])
def test_opacity_before_empty_sky_costs_less_where_darkness_may_be_shade(shading, share):
    model, frame = target(40), photographed(target(40), 1)[0]
    empty = torch.zeros(frame.dn.shape[:2], dtype=torch.bool)
    empty[:, ::2] = True
    batch = Batches([frame], SENSOR.white_dn, {0: empty}).batch([0], 1.0)
    rendered = render(model, batch.cameras)
    expected = 3.0 * share * (rendered.alpha[0] * empty).mean().item()
    found = priors(dataclasses.replace(model, shading=shading), rendered, batch, 1.0, SKY)
    assert found.item() == pytest.approx(expected, rel=1e-5) and expected > 0.01
