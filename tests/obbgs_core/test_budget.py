"""Growth goes on beyond the budget where frames could pay for more Gaussians and held-out brackets gain by them."""

import dataclasses

import pytest
import torch
from torch import Tensor

from obbgs_core.batches import Batches
from obbgs_core.evidence.budget import as_many_again, fewer
from obbgs_core.evidence.gains import VIEWS
from obbgs_core.frames import TrainingFrame
from obbgs_core.methods.presets import budget_changes, limited, preset
from obbgs_core.render import render
from obbgs_core.start.texture import textured_pixels
from obbgs_core.train.trainer import Trainer, train
from tests.scenes import SENSOR, photographed, target

SMALL = {"steps": 150, "start.count": 60, "growth.gaussians_per_root_pixel": 0.5, "growth.interval": 6}


@pytest.fixture(scope="module")
def textured():
    """Frames of a body with fine texture all over, one a bracket."""
    body = target(600, seed=3)
    body = dataclasses.replace(body, log_scales=body.log_scales - 1.0)
    return [dataclasses.replace(f, bracket=i) for i, f in enumerate(photographed(body, count=30))]


def test_what_as_many_gaussians_again_could_gain_is_a_quarter_of_what_is_not_explained():
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
    assert float(as_many_again(wrong, batches, SENSOR).gain) == pytest.approx(0.25 * 0.5 * squares, rel=0.1)


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


def pictures_of(squares_px: int, noise: float) -> tuple[list[TrainingFrame], dict[int, Tensor]]:
    """Return frames of a disc of radius 40 px with a checkerboard of so many pixels on it, and where it is."""
    rows, columns = torch.meshgrid(torch.arange(100), torch.arange(100), indexing="ij")
    disc = (rows - 50) ** 2 + (columns - 50) ** 2 < 40**2
    bright = 1 + 0.3 * ((rows // squares_px + columns // squares_px) % 2)
    rng, frames = torch.Generator().manual_seed(0), []
    for seen in photographed(target(5), count=3, size_px=100):
        dn = SENSOR.black_dn + 0.3 * (SENSOR.white_dn - SENSOR.black_dn) * bright * disc
        dn = dn + noise * SENSOR.variance_dn2(dn).sqrt() * torch.randn(100, 100, generator=rng)
        frames.append(dataclasses.replace(seen, dn=dn[..., None]))
    return frames, dict.fromkeys(range(3), disc)


def test_texture_all_over_is_counted_in_pixels_and_faces_with_edges_or_noise_have_none():
    fine, disc = pictures_of(1, noise=0.0)
    assert textured_pixels(fine, disc, SENSOR) == pytest.approx(torch.pi * 39**2, rel=0.02)
    assert textured_pixels(pictures_of(2, noise=1.0)[0], disc, SENSOR) > 4_000
    assert textured_pixels(pictures_of(25, noise=0.0)[0], disc, SENSOR) == 0  # four edges a face
    assert textured_pixels(pictures_of(100, noise=1.0)[0], disc, SENSOR) == 0


@pytest.mark.parametrize(
    ("changes", "textured", "first", "most"),
    [
        ({}, 0, 3_000, 10_000),
        ({}, 2_900, 3_000, 10_000),  # as many first Gaussians as ever see to them
        ({}, 14_000, 14_000, 60_000),  # two for each pixel of the target
        ({"growth.gaussians_per_root_pixel": 0.0}, 14_000, 3_000, 10_000),  # as was asked for
        ({"start.count": 200}, 14_000, 200, 10_000),
        ({"growth.max_gaussians": 8_000}, 14_000, 3_000, 8_000),
    ],
)
def test_a_body_with_texture_all_over_begins_with_a_gaussian_for_each_pixel_that_shows_it(
    changes, textured, first, most
):
    config, shown, budget = limited(preset("obbgs", changes), [30_000] * 40, textured)
    assert (config.start.count, config.growth.max_gaussians) == (first, most)
    assert shown == (60_000 if config.growth.gaussians_per_root_pixel else 0)
    assert ("texture" in budget) == (first > 3_000)
    # a relief glints; a degree that was asked for stays, as that of few frames does
    assert config.light.max_sh_degree == (3 if first > 3_000 else 2)
    lower = limited(preset("obbgs", changes | {"light.max_sh_degree": 1}), [30_000] * 40, textured)[0]
    assert lower.light.max_sh_degree == 1
