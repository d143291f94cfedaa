"""What few frames need: Gaussians left out of each step, and empty space that counts more."""

import pytest
import torch

from obbgs_core import preset
from obbgs_core.frames import cameras_of
from obbgs_core.methods.config import FEW, MANY, few_share
from obbgs_core.render import render
from obbgs_core.train import train
from obbgs_core.train.objective import dropped
from obbgs_core.train.trainer import Trainer
from tests.scenes import QUICK, SENSOR, photographed, target


def test_few_frames_are_few_in_part_and_many_are_not():
    shares = [few_share(n) for n in range(3, MANY + 10)]
    assert shares[: FEW - 2] == [1.0] * (FEW - 2) and shares == sorted(shares, reverse=True)
    assert few_share(MANY) == few_share(1000) == 0
    assert few_share((FEW + MANY) // 2) == pytest.approx(0.5)


def test_many_frames_change_no_setting_and_few_change_them_once():
    config = preset("obbgs")
    assert config.for_frames(MANY) == config
    few = config.for_frames(FEW)
    trainers = [Trainer(photographed(target(), n), SENSOR, preset("obbgs", QUICK)) for n in (FEW, MANY)]
    assert [one.setup.dropout for one in trainers] == [config.sparse.dropout, 0] and config.sparse.dropout > 0
    assert few.light.max_sh_degree == 1 < config.light.max_sh_degree
    assert few.for_frames(FEW) == few
    assert preset("3dgs").for_frames(3) == preset("3dgs")


def test_what_is_left_is_more_opaque_by_as_much_as_is_missing():
    """In the mean over many draws opacities stay as they are, and about the share is missing in each."""
    model = target(200)
    model.opacity_logits = torch.logit(torch.linspace(0.05, 0.7, len(model)))
    rng = torch.Generator().manual_seed(3)
    draws = torch.stack([dropped(model, 0.25, rng).opacities for _ in range(4000)])
    missing = (draws < 1e-4).float().mean(dim=0)
    # 5 deviations of a mean of 4000 draws
    assert (missing - 0.25).abs().max() < 5 * (0.25 * 0.75 / 4000) ** 0.5
    spread = model.opacities * (0.25 / 0.75 / 4000) ** 0.5
    assert ((draws.mean(dim=0) - model.opacities).abs() < 5 * spread + 1e-4).all()


def test_a_gaussian_that_is_left_out_is_not_drawn_and_has_no_gradient():
    model = target(60)
    model.opacity_logits = torch.linspace(0.3, 0.9, 60).logit()  # half of them would be more than opaque
    model, frame = model.trainable(), photographed(target(60), 1)[0]
    part = dropped(model, 0.5, torch.Generator().manual_seed(0))
    out = part.opacities.detach() < 1e-4
    assert 10 < int(out.sum()) < 50
    cameras = cameras_of([frame])
    kept = part.detach().select(torch.nonzero(~out)[:, 0])
    image = render(part, cameras).radiance
    torch.testing.assert_close(image.detach(), render(kept, cameras).radiance, rtol=1e-5, atol=1e-7)
    image.sum().backward()
    assert not model.opacity_logits.grad[out].any()
    seen = kept.means.shape[0] - int((model.opacity_logits.grad[~out] == 0).sum())
    assert seen > len(kept) / 2


def test_a_training_of_few_frames_repeats_bit_for_bit():
    frames = photographed(target(60), 6)
    config = preset("obbgs", QUICK)
    first, second = (train(frames, SENSOR, config, seed=1) for _ in range(2))
    assert first.config.sparse.dropout > 0 and len(frames) < MANY
    torch.testing.assert_close(first.gaussians.means, second.gaussians.means, rtol=0, atol=0)
