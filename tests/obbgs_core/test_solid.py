"""What certainly shows light is taken for opaque: dark faces do not become bright dust."""

import dataclasses
import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy import ndimage

from obbgs_core import preset
from obbgs_core.batches import Batches
from obbgs_core.frames import cameras_of
from obbgs_core.methods.config import LossSettings
from obbgs_core.model.gaussians import Gaussians
from obbgs_core.model.sh import from_radiance
from obbgs_core.render import render
from obbgs_core.start.hull import Silhouette
from obbgs_core.train.objective import priors
from obbgs_core.train.trainer import Trainer
from tests.scenes import QUICK, SENSOR, photographed, target

FAINT = 1e-3  # radiance, which reads 2.7 deviations of the noise in a pixel of the longest exposure


def half_dark() -> tuple[Gaussians, torch.Tensor]:
    """Return an opaque bar of Gaussians of which one half is in shadow, and which of them are."""
    axes = (torch.linspace(-1.2, 1.2, 25), torch.linspace(-0.4, 0.4, 9), torch.linspace(-0.4, 0.4, 9))
    means = torch.cartesian_prod(*axes)
    dark = means[:, 0] > 0
    light = torch.where(dark, FAINT, 0.3)[:, None, None]
    quats = torch.tensor([[1.0, 0, 0, 0]]).repeat(len(means), 1)
    log_scales = torch.full((len(means), 3), 0.06).log()
    return Gaussians(means, quats, log_scales, torch.full((len(means),), 2.0), from_radiance(light)), dark


@given(st.integers(0, 1000), st.integers(0, 3), st.integers(0, 3))
def test_solid_pixels_are_those_with_certain_light_around(seed, grown_px, more_px):
    rng = torch.Generator().manual_seed(seed)
    blocks = torch.rand(6, 8, generator=rng) < 0.6
    mask = blocks.repeat_interleave(6, 0).repeat_interleave(6, 1)
    outline = Silhouette(mask, mask, ~mask, torch.eye(4), torch.eye(3)).dilated(grown_px).dilated(more_px)
    size = 2 * (1 + grown_px + more_px) + 1
    # beyond the picture's border nothing is known, and nothing counts against a pixel
    eroded = ndimage.binary_erosion(mask.numpy(), torch.ones(size, size).numpy(), border_value=1)
    assert torch.equal(outline.solid, torch.from_numpy(eroded))


def test_shares_of_solid_pixels_are_averaged_with_the_picture():
    frames = photographed(target(5), 3, size_px=64)
    solid = torch.zeros(64, 64, dtype=torch.bool)
    solid[:30] = True
    batch = Batches(frames, SENSOR.white_dn, solid={1: solid}).batch([1, 2], 0.25)
    assert batch.sky is None and batch.solid is not None
    assert (batch.solid[0, :7] == 1).all() and (batch.solid[0, 7] == 0.5).all()
    assert not batch.solid[0, 8:].any() and not batch.solid[1].any()  # of frame 2 no silhouette is known


def solid_prior(weight: float) -> LossSettings:
    """Return the settings with this prior alone."""
    return LossSettings(gloss_weight=0, normal_weight=0, flat_weight=0, sky_weight=0, solid_weight=weight)


def test_the_prior_makes_what_shows_light_more_opaque_and_nothing_else():
    model, frames = target(40).trainable(), photographed(target(40), 1)
    left = torch.zeros(64, 64, dtype=torch.bool)
    left[:, :32] = True
    batch = Batches(frames, SENSOR.white_dn, solid={0: left}).batch([0])
    rendered = render(model, cameras_of(frames))
    value = priors(model, rendered, batch, 1.0, solid_prior(2.0))
    expected = 2.0 * (1 - rendered.alpha.detach()[0, :, :32]).sum() / 64**2
    torch.testing.assert_close(value.detach(), expected)
    value.backward()
    gradient = model.opacity_logits.grad
    assert gradient is not None and (gradient <= 1e-9).all()
    right = rendered.means2d[0][:, 0] - rendered.radii[0] > 32  # drawn on the other half alone
    assert right.any() and not gradient[right].any()
    assert priors(model, rendered, batch, 1.0, solid_prior(0.0)) == 0


def test_dust_that_shines_like_a_dark_face_becomes_opaque():
    """Dust of two per cent explains as much light as an opaque face that is darker; the prior decides between them.

    Nothing is pruned, since the dust that is put in would be.
    """
    truth, dark = half_dark()
    frames, views = photographed(truth, 48), photographed(truth, 6, seed=5)
    face, through = truth.select(torch.nonzero(dark)[:, 0]), {}
    for weight in (0.0, 1.0):
        changes = {"steps": 300, "loss.solid_weight": weight, "parsimony.prune_at": ()}
        trainer = Trainer(frames, SENSOR, preset("obbgs", changes))
        with torch.no_grad():
            model = trainer.state.gaussians
            model.opacity_logits[model.means[:, 0] > 0] = math.log(0.02 / 0.98)
        for _ in range(300):
            trainer.step()
        let_through = []
        for view in views:
            cameras = cameras_of([view])
            covered = render(face, cameras).alpha[0] > 0.98
            let_through.append((1 - render(trainer.gaussians, cameras).alpha[0])[covered].mean())
        through[weight] = float(torch.stack(let_through).mean())
    assert through[1.0] < 0.7 * through[0.0]  # 0.05 and 0.12


@pytest.mark.parametrize("moving", [False, True])
def test_where_the_sun_moves_frames_tell_themselves(moving):
    suns = torch.tensor([[1.0, 0.0, 0.0]]).repeat(24, 1)
    if moving:
        suns[12:] = torch.tensor([0.0, 1.0, 0.0])
    trainer = Trainer(photographed(target(), 24, suns=suns), SENSOR, preset("obbgs", QUICK))
    assert trainer.setup.sun_moves == moving
    batch = trainer.setup.batches.batch([0, 1, 2])
    assert batch.sky is not None and (batch.solid is None) == moving


@pytest.mark.parametrize("background", [0.0, 0.3])
def test_in_front_of_another_background_than_black_nothing_is_solid(background):
    frames = [dataclasses.replace(f, background=background) for f in photographed(target(), 24)]
    batch = Trainer(frames, SENSOR, preset("obbgs", QUICK)).setup.batches.batch([0, 1, 2])
    assert (batch.solid is None) == bool(background)


def test_published_methods_do_not_know_it():
    assert preset("3dgs").loss.solid_weight == 0 < preset("obbgs").loss.solid_weight
