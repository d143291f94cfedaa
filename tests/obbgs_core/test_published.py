"""The published methods keep their authors' rules: lengths, rates, degrees, pruning and resets."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from obbgs_core.frames import TrainingFrame, camera_extent_m
from obbgs_core.model.cameras import Cameras
from obbgs_core.model.gaussians import Gaussians
from obbgs_core.model.sh import from_radiance
from obbgs_core.render import render
from obbgs_core.sensor import Sensor
from obbgs_core.train.growth import Adam, Growth, densify, trainable
from obbgs_core.train.presets import preset
from obbgs_core.train.trainer import Trainer, _rates

SENSOR = Sensor(black_dn=0, white_dn=255, dn_per_radiance_s=2.55e6, electrons_per_dn=1e9, read_noise_dn=2)
SIZE_PX, RANGE_M = 40, 5.0
K = torch.tensor([[60.0, 0, SIZE_PX / 2], [0, 60.0, SIZE_PX / 2], [0, 0, 1]])


def ball(count: int = 40) -> Gaussians:
    rng = torch.Generator().manual_seed(0)
    return Gaussians(
        means=torch.randn(count, 3, generator=rng) * 0.4,
        quats=torch.randn(count, 4, generator=rng),
        log_scales=torch.full((count, 3), math.log(0.1)),
        opacity_logits=torch.full((count,), 2.0),
        sh=from_radiance(torch.full((count, 1, 1), 0.5)),
    )


@pytest.fixture(scope="module")
def frames() -> list[TrainingFrame]:
    """Twelve exposures of a ball of Gaussians, seen from all around at one range."""
    out = []
    for i, rotation in enumerate(Rotation.random(12, rng=np.random.default_rng(1)).as_matrix()):
        pose = torch.eye(4)
        pose[:3, :3], pose[2, 3] = torch.tensor(rotation, dtype=torch.float32), RANGE_M
        seen = render(ball(), Cameras(pose[None], K[None], SIZE_PX, SIZE_PX)).radiance[0]
        dn = SENSOR.expected_dn(seen, 1e-4).round().clamp(0, 255)
        out.append(TrainingFrame(dn, 1e-4, pose, K, i))
    return out


def quick(name: str, **changes):
    return preset(name, steps=60, start_count=300, **changes)


def test_lengths_are_multiples_of_the_cameras_extent(frames):
    centres = np.stack([np.linalg.inv(f.world_to_camera.double().numpy())[:3, 3] for f in frames])
    extent_m = 1.1 * np.linalg.norm(centres - centres.mean(axis=0), axis=1).max()
    assert camera_extent_m(frames) == pytest.approx(extent_m, rel=1e-6)
    published, ours = Trainer(frames, SENSOR, quick("3dgs")), Trainer(frames, SENSOR, quick("obbgs"))
    assert published.unit_m == pytest.approx(extent_m, rel=1e-6)
    assert ours.unit_m == ours.radius < extent_m
    for share, rate in ((0.0, 1.6e-4), (0.5, 1.6e-5), (1.0, 1.6e-6)):
        assert _rates(preset("3dgs"), share, extent_m, 16)["means"] == pytest.approx(rate * extent_m)


def test_the_start_is_grey_of_half_the_full_scale(frames):
    trainer = Trainer(frames, SENSOR, quick("3dgs"))
    colours = trainer.gaussians.sh
    assert (colours[:, 1:] == 0).all() and (colours[:, 0] == colours[0, 0]).all()
    torch.testing.assert_close(colours[0, 0], from_radiance(torch.tensor([0.5])))  # of 255 DN in 0.1 ms


def test_the_degree_rises_by_one_after_every_interval(frames):
    trainer = Trainer(frames, SENSOR, quick("3dgs", sh_interval=4, grow_until=0.0))
    for step in range(1, 14):
        trainer.step()
        moved = trainer.gaussians.sh.detach().abs().amax(dim=(0, 2)) > 0
        degree = min((step - 1) // 4, 3)
        assert moved[: (degree + 1) ** 2].all() and not moved[(degree + 1) ** 2 :].any(), step


def test_higher_degrees_move_at_a_twentieth_of_the_rate_as_two_groups_of_torchs_adam_do():
    model = trainable(replace(ball(), sh=torch.randn(40, 16, 1, generator=torch.Generator().manual_seed(2))))
    first, rest = (part.detach().clone().requires_grad_() for part in model.sh.split([1, 15], dim=1))
    lr = preset("3dgs").lr_sh
    oracle = torch.optim.Adam([{"params": [first], "lr": lr}, {"params": [rest], "lr": lr / 20}], eps=1e-15)
    adam = Adam(model)
    for step in range(5):
        gradient = torch.randn(40, 16, 1, generator=torch.Generator().manual_seed(step))
        model.sh.grad, first.grad, rest.grad = gradient.clone(), gradient[:, :1], gradient[:, 1:]
        adam.step(model, _rates(preset("3dgs"), 0.0, 1.0, 16))
        oracle.step()
    torch.testing.assert_close(
        model.sh.detach(), torch.cat([first, rest], dim=1).detach(), rtol=1e-5, atol=1e-6
    )


def test_what_is_large_in_space_or_in_a_picture_is_pruned_after_the_first_reset_of_the_opacities():
    config, unit_m = preset("3dgs"), 5.0
    model = ball(6)
    model.log_scales[1] = math.log(0.11 * unit_m)  # limit: 0.1 of the extent
    model.opacity_logits[2] = -6.0  # opacity 0.0025, limit 0.005
    for share, left in ((0.05, 5), (0.2, 3)):
        growth = Growth(6, config.pixel_weighted)
        growth.radius_px[3] = 21.0
        growth.radius_px[4] = 20.0
        now = trainable(model)
        kept = densify(now, Adam(now), growth, unit_m, config, share, torch.Generator().manual_seed(0))
        assert len(kept) == left


def test_the_records_of_growth_follow_the_gaussians_that_are_kept(frames):
    trainer = Trainer(frames, SENSOR, quick("jiang2025", grow_from=0.0, grow_interval=7, obb_interval=3))
    for _ in range(2):
        trainer.step()
    longest_px = trainer.growth.radius_px.clone()
    with torch.no_grad():
        trainer.gaussians.log_scales[:5] = math.nan
    trainer._drop_not_finite()
    assert trainer.removed_not_finite == 5 and torch.equal(trainer.growth.radius_px, longest_px[5:])
    for _ in range(8):  # past growth in the boxes and everywhere
        trainer.step()
    assert len(trainer.growth.radius_px) == len(trainer.gaussians)


def test_a_reset_of_the_opacities_forgets_their_moments(frames):
    trainer = Trainer(frames, SENSOR, quick("3dgs", opacity_reset_interval=5, grow_from=0.0))
    for _ in range(4):
        trainer.step()
    assert (trainer.adam.second["opacity_logits"] > 0).any()
    trainer.step()
    assert (trainer.gaussians.opacities <= 0.01 + 1e-6).all()
    assert not trainer.adam.first["opacity_logits"].any() and not trainer.adam.second["opacity_logits"].any()
    assert (trainer.adam.second["means"] > 0).any()


def test_pixel_gs_counts_gradients_near_the_camera_less(frames):
    plain, scaled = (
        Trainer(frames, SENSOR, quick("pixel-gs", grow_from=0.0, grow_until=1.0, depth_scale=scale))
        for scale in (0.0, 1.0)
    )
    for trainer in (plain, scaled):
        trainer.step()
    seen = plain.growth.weight > 0
    assert torch.equal(plain.growth.weight, scaled.growth.weight)  # both drew the same frame
    factor = (scaled.growth.gradient / plain.growth.gradient)[seen & (plain.growth.gradient > 0)]
    depth_m = RANGE_M + np.array([-1.0, 1.0]) * math.sqrt(3) * plain.radius  # the start fills a cube
    nearest, farthest = (depth_m / scaled.unit_m) ** 2
    assert nearest <= factor.min() < factor.max() <= min(1.0, farthest) + 1e-5
