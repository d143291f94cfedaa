"""Growth by sampling, as in 3DGS-MCMC: what copies look like together, who is moved, and who is shaken."""

import math

import pytest
import torch
from scipy.integrate import quad

from obbgs_core.published import mcmc
from tests.scenes import random_gaussians


@pytest.mark.parametrize(("opacity", "copies"), [(0.3, 2), (0.8, 3), (0.99, 5)])
def test_copies_together_are_as_opaque_in_the_middle_and_cover_as_much(opacity, copies):
    each, shrink = (x.item() for x in mcmc.shared(torch.tensor([opacity]), torch.tensor([copies])))
    assert (1 - each) ** copies == pytest.approx(1 - opacity, abs=1e-5)
    together, _ = quad(lambda x: 1 - (1 - each * math.exp(-0.5 * (x / shrink) ** 2)) ** copies, -9, 9)
    alone, _ = quad(lambda x: opacity * math.exp(-0.5 * x * x), -9, 9)
    assert together == pytest.approx(alone, rel=1e-4)


def test_what_has_faded_is_moved_to_others_and_a_twentieth_is_added_within_the_budget():
    gaussians = random_gaussians(200)
    gaussians.opacity_logits[:] = 1.0
    gaussians.opacity_logits[:40] = -8.0
    grown, kept = mcmc.relocated(gaussians, 1000, torch.Generator().manual_seed(0))
    assert len(grown) == 210 and kept.min() >= 40
    assert torch.equal(grown.means[: len(kept)], gaussians.means[kept])
    places = {tuple(mean) for mean in gaussians.means[40:].tolist()}
    assert {
        tuple(mean) for mean in grown.means.tolist()
    } == places  # every living place is still there, none else
    assert (grown.opacities > mcmc.DEAD_OPACITY / 2).all()
    assert len(mcmc.relocated(gaussians, 204, torch.Generator().manual_seed(0))[0]) == 204


def test_only_faint_ones_are_shaken_within_their_shape():
    gaussians = random_gaussians(300)
    gaussians.opacity_logits[:] = -8.0
    gaussians.opacity_logits[:150] = 3.0
    gaussians.log_scales[:, 2] = -20.0  # flat discs
    before = gaussians.means.clone()
    mcmc.shake(gaussians, 1e-4, torch.Generator().manual_seed(0))
    moved = gaussians.means - before
    assert moved[:150].abs().max() < 1e-6 < moved[150:].abs().max()
    normals = gaussians.axes[150:, :, 2]
    assert (moved[150:] * normals).sum(dim=1).abs().max() < 1e-4 * moved[150:].norm(dim=1).max()
