"""Growth goes on beyond the budget where frames could pay for more Gaussians and held-out brackets gain by them."""

import dataclasses

import pytest
import torch

from obbgs_core.batches import Batches
from obbgs_core.evidence.budget import as_many_again, fewer
from obbgs_core.evidence.gains import VIEWS
from obbgs_core.methods.presets import budget_changes, preset
from obbgs_core.render import render
from obbgs_core.train.trainer import Trainer, train
from tests.scenes import SENSOR, photographed, target

SMALL = {"steps": 150, "start.count": 60, "growth.gaussians_per_root_pixel": 0.5, "growth.interval": 6}


@pytest.fixture(scope="module")
def textured():
    """Frames of a body with fine texture all over, one a bracket."""
    body = target(600, seed=3)
    body = dataclasses.replace(body, log_scales=body.log_scales - 1.0)
    return [dataclasses.replace(f, bracket=i) for i, f in enumerate(photographed(body, count=30))]


def test_what_as_many_gaussians_again_could_gain_is_what_is_not_explained():
    frames = photographed(target(), count=12)
    assert len(frames) <= VIEWS
    batches = Batches(frames, SENSOR.white_dn)
    true = as_many_again(target(), batches, SENSOR)
    assert not true.justifies
    wrong = dataclasses.replace(target(), sh=target().sh + 0.02)
    squares = 0.0
    for i, frame in enumerate(frames):
        batch = batches.batch([i])
        expected = SENSOR.expected_dn(render(wrong, batch.cameras).radiance, frame.exposure_time_s)
        variance = SENSOR.variance_dn2(expected)
        lit = (expected - SENSOR.black_dn > variance.sqrt()) & (expected < 0.9 * SENSOR.white_dn)
        squares += float((((batch.dn - expected) / variance.sqrt())[lit].clamp(-3, 3).square() - 1).sum())
    assert float(as_many_again(wrong, batches, SENSOR).gain) == pytest.approx(0.5 * squares, rel=0.1)


def test_brackets_must_gain_by_more_than_chance():
    before = torch.tensor([0.1, -0.2, 0.3, 0.0])
    assert fewer(before, before - 0.05).justifies
    assert not fewer(before, before + 0.05).justifies
    assert not fewer(before, before - torch.tensor([0.5, -0.4, 0.1, -0.1])).justifies


def test_growth_goes_on_where_frames_show_more_than_the_budget_allows(textured, tmp_path):
    config = preset("obbgs", SMALL)
    trainer = Trainer(textured, SENSOR, config)
    allowed, kept = trainer.setup.config.growth.max_gaussians, tmp_path / "checkpoint"
    while not trainer.stop_reason():
        before = trainer.state.steps_done
        trainer.step()
        if trainer.state.steps_done < before and not kept.exists():
            assert trainer.state.order.validation_brackets
            trainer.save(kept)
    result = trainer.result("")
    assert len(result.gaussians) > 1.5 * allowed and len(result.history) > config.steps
    assert not trainer.state.order.validation_brackets  # they are trained on in the end
    assert "as many Gaussians again could gain" in result.growth
    again = train(textured, SENSOR, config, checkpoint=kept)  # from where growth was prolonged first
    assert torch.equal(again.gaussians.means, result.gaussians.means)


def test_a_budget_that_is_asked_for_holds(textured):
    config = preset("obbgs", budget_changes(preset("obbgs"), SMALL, 80))
    result = train(textured, SENSOR, config)
    assert len(result.history) == config.steps and max(info.gaussians for info in result.history) <= 80
