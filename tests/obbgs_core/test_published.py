"""The published methods keep their authors' rules: lengths, rates, degrees, pruning and resets."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from obbgs_core.frames import TrainingFrame, camera_extent_m
from obbgs_core.methods.presets import preset
from obbgs_core.model.cameras import Cameras
from obbgs_core.model.gaussians import Gaussians
from obbgs_core.model.sh import from_radiance, radiance
from obbgs_core.render import render
from obbgs_core.sensor import Sensor
from obbgs_core.train.adam import Adam, learning_rates
from obbgs_core.train.growth import Growth, OpacityResets
from obbgs_core.train.trainer import Trainer
from tests import scenes

SENSOR = Sensor(black_dn=0, white_dn=255, dn_per_radiance_s=2.55e6, electrons_per_dn=1e9, read_noise_dn=2)
SIZE_PX, RANGE_M = 40, 5.0
K = scenes.intrinsics(SIZE_PX, 60.0)


def ball(count: int = 40) -> Gaussians:
    return scenes.ball(count, 0.4, math.log(0.1), float(from_radiance(torch.tensor(0.5))))


@pytest.fixture(scope="module")
def frames() -> list[TrainingFrame]:
    """Twelve exposures of a ball of Gaussians, seen from all around at one range."""
    out = []
    for i, rotation in enumerate(Rotation.random(12, rng=np.random.default_rng(1)).as_matrix()):
        pose = scenes.pose(rotation, RANGE_M)
        seen = render(ball(), Cameras(pose[None], K[None], SIZE_PX, SIZE_PX)).radiance[0]
        dn = SENSOR.expected_dn(seen, 1e-4).round().clamp(0, 255)
        out.append(TrainingFrame(dn, 1e-4, pose, K, i))
    return out


def quick(name: str, changes: dict | None = None):
    return preset(name, {"steps": 60, "start.count": 300} | (changes or {}))


def test_lengths_are_multiples_of_the_cameras_extent(frames):
    centres = np.stack([np.linalg.inv(f.world_to_camera.double().numpy())[:3, 3] for f in frames])
    extent_m = 1.1 * np.linalg.norm(centres - centres.mean(axis=0), axis=1).max()
    assert camera_extent_m(frames) == pytest.approx(extent_m, rel=1e-6)
    published, ours = Trainer(frames, SENSOR, quick("3dgs")), Trainer(frames, SENSOR, quick("obbgs"))
    assert published.setup.unit_m == pytest.approx(extent_m, rel=1e-6)
    assert ours.setup.unit_m == ours.setup.radius_m < extent_m
    for share, rate in ((0.0, 1.6e-4), (0.5, 1.6e-5), (1.0, 1.6e-6)):
        assert learning_rates(preset("3dgs").rates, share, extent_m, 16)["means"] == pytest.approx(
            rate * extent_m
        )


def test_the_start_is_that_of_the_authors_on_pictures_without_a_point_cloud(frames):
    """100,000 points at random, colours RGB = 0.5 + 0.2820948 u / 255 (their SH2RGB(u / 255)), opacity 0.1."""
    assert preset("3dgs").start.count == 100_000
    start = Trainer(frames, SENSOR, quick("3dgs")).state.gaussians
    start = start.detach()
    assert (start.sh[:, 1:] == 0).all()
    noise = (
        (radiance(start.sh[:, :1], torch.zeros(300, 3)) - 0.5) * 255 / 0.28209479
    )  # 255 DN in 0.1 ms are 1
    assert noise.min() == pytest.approx(0, abs=0.05) and noise.max() == pytest.approx(1, abs=0.05)
    torch.testing.assert_close(start.opacities, torch.full((300,), 0.1))
    points = start.means.detach().double().numpy()
    squares = np.sort(((points[:, None] - points[None]) ** 2).sum(-1), axis=1)[:, 1:4]
    np.testing.assert_allclose(start.scales[:, 0].numpy(), np.sqrt(squares.mean(1)), rtol=1e-4)
    assert (start.scales == start.scales[:, :1]).all()


def test_rates_of_colours_are_for_pictures_from_0_to_1(frames):
    """Whatever radiance saturates a pixel: scenes that are darker by a factor move by as much less."""
    longer = [replace(f, exposure_time_s=4 * f.exposure_time_s) for f in frames]
    moved = []
    for given in (frames, longer):
        trainer = Trainer(given, SENSOR, quick("3dgs"))
        before = trainer.state.gaussians.sh.detach().clone()
        trainer.step()
        moved.append((trainer.state.gaussians.sh.detach() - before)[:, 0].abs().max())
    assert moved[0] == pytest.approx(0.0025, rel=1e-3) and moved[1] == pytest.approx(0.0025 / 4, rel=1e-3)


def test_the_degree_rises_by_one_after_every_interval(frames):
    trainer = Trainer(frames, SENSOR, quick("3dgs", {"published.sh_interval": 4, "growth.end": 0.0}))
    for step in range(1, 14):
        trainer.step()
        moved = trainer.state.gaussians.sh.detach().abs().amax(dim=(0, 2)) > 0
        degree = min(step // 4, 3)  # their oneupSHdegree comes before the rendering
        assert moved[: (degree + 1) ** 2].all() and not moved[(degree + 1) ** 2 :].any(), step


def test_higher_degrees_move_at_a_twentieth_of_the_rate_as_two_groups_of_torchs_adam_do():
    model = replace(ball(), sh=torch.randn(40, 16, 1, generator=torch.Generator().manual_seed(2))).trainable()
    first, rest = (part.detach().clone().requires_grad_() for part in model.sh.split([1, 15], dim=1))
    lr = preset("3dgs").rates.sh
    oracle = torch.optim.Adam([{"params": [first], "lr": lr}, {"params": [rest], "lr": lr / 20}], eps=1e-15)
    adam = Adam(model)
    for step in range(5):
        gradient = torch.randn(40, 16, 1, generator=torch.Generator().manual_seed(step))
        model.sh.grad, first.grad, rest.grad = gradient.clone(), gradient[:, :1], gradient[:, 1:]
        adam.step(model, learning_rates(preset("3dgs").rates, 0.0, 1.0, 16))
        oracle.step()
    torch.testing.assert_close(
        model.sh.detach(), torch.cat([first, rest], dim=1).detach(), rtol=1e-5, atol=1e-6
    )


def test_what_is_large_is_pruned_after_the_first_reset_of_the_opacities(frames):
    trainer = Trainer(frames, SENSOR, preset("3dgs", {"start.count": 6}))
    model = ball(6)
    model.log_scales[1] = math.log(0.11 * trainer.setup.unit_m)  # limit: 0.1 of the extent
    model.opacity_logits[2] = -6.0  # opacity 0.0025, limit 0.005
    trainer.state.gaussians = model.trainable()
    for share, left in ((0.05, 5), (0.2, 4)):
        trainer.state.steps_done = round(share * 30_000) - 1
        now = scenes.now_of(trainer)
        assert Growth.of(6).due(now) and len(Growth.of(6).decide(now).model) == left


def test_the_records_of_growth_follow_the_gaussians_that_are_kept(frames):
    trainer = Trainer(
        frames,
        SENSOR,
        quick("jiang2025", {"growth.begin": 0.0, "growth.interval": 7, "growth.obb_interval": 3}),
    )
    for _ in range(2):
        trainer.step()
    before = trainer.state.growth.gradient.clone()
    with torch.no_grad():
        trainer.state.gaussians.log_scales[:5] = math.nan
    trainer.state.drop_not_finite(trainer.setup)
    assert trainer.state.removed_not_finite == 5
    assert torch.equal(trainer.state.growth.gradient, before[5:])
    for _ in range(8):  # past growth in the boxes and everywhere
        trainer.step()
    assert len(trainer.state.growth.gradient) == len(trainer.state.gaussians)


def test_densifications_and_resets_come_when_the_authors_have_them(frames):
    """if iteration < 15000: every 100 after 500; and every 3000 a reset; sizes count after the first reset."""
    config = preset("3dgs")
    now = range(1, config.steps + 1)
    growing = [
        i for i in now if i % config.growth.interval == 0 and Growth.is_growing(config, config.moment(i - 1))
    ]
    assert growing == [i for i in range(0, 15_000, 100) if i > 500]
    recorded = [i for i in now if Growth.is_recorded(config, config.moment(i - 1))]
    assert recorded == list(range(1, 15_000))
    trainer, resets = Trainer(frames, SENSOR, preset("3dgs", {"start.count": 6})), []
    for i in range(500, 30_000, 500):
        trainer.state.steps_done = i - 1
        resets += [i] if OpacityResets().due(scenes.now_of(trainer)) else []
    assert resets == [3000, 6000, 9000, 12_000]
    assert next(i for i in growing if (i - 1) / config.steps >= config.published.prune_size_from) == 3100


def test_a_view_counts_where_the_gaussian_reaches_the_picture_and_gradients_are_per_half_width_and_height():
    wide = Cameras(scenes.pose(np.eye(3), RANGE_M)[None], K[None], width=60, height=SIZE_PX)
    model = ball(4)
    model.means = torch.tensor(
        [[0.0, 0, 0], [3.4, 0, 0], [4.5, 0, 0], [0, 0, 1.0]]
    )  # in the picture, at its edge, beyond it, in it
    model.opacity_logits[3] = -8.0  # fainter than 1/255: it adds to no pixel, but reaches the picture
    model = model.trainable()
    rendered = render(model, wide)
    means2d = rendered.means2d.detach()[0]
    (rendered.radiance[..., 0] * torch.linspace(0, 1, 60)).sum().backward()
    growth = Growth.of(4)
    growth.add(rendered, (30.0, 20.0), pixel_weighted=False)
    assert growth.weight.tolist() == [1, 1, 0, 1] and means2d[2, 0] - 3 * 60 * 0.1 / RANGE_M > 60
    gradient = rendered.screen.means2d[0][0]
    assert growth.gradient[0] == pytest.approx(math.hypot(30 * gradient[0], 20 * gradient[1]), rel=1e-5)


def test_a_reset_of_the_opacities_forgets_their_moments(frames):
    trainer = Trainer(
        frames, SENSOR, quick("3dgs", {"published.opacity_reset_interval": 5, "growth.begin": 0.0})
    )
    for _ in range(4):
        trainer.step()
    assert (trainer.state.adam.second["opacity_logits"] > 0).any()
    trainer.step()
    assert (trainer.state.gaussians.opacities <= 0.01 + 1e-6).all()
    assert (
        not trainer.state.adam.first["opacity_logits"].any()
        and not trainer.state.adam.second["opacity_logits"].any()
    )
    assert (trainer.state.adam.second["means"] > 0).any()


@pytest.mark.parametrize(("background", "reset"), [(0.0, False), (1.0, True)])
def test_in_front_of_a_background_opacities_are_reset_where_growth_begins(frames, background, reset):
    """white_background and iteration == densify_from_iter, in the authors' train.py."""
    given = [replace(f, background=background) for f in frames]
    trainer = Trainer(given, SENSOR, quick("3dgs", {"growth.begin": 0.1}))
    for step in range(1, 8):
        trainer.step()
        first = trainer.state.adam.first["opacity_logits"]
        assert first.any() != (reset and step == 6)
    assert (
        trainer.state.gaussians.opacities < 0.06
    ).all() == reset  # a step at a rate of 0.05 after 0.01; 0.1 before


def test_pixel_gs_counts_gradients_near_the_camera_less(frames):
    plain, scaled = (
        Trainer(
            frames,
            SENSOR,
            quick("pixel-gs", {"growth.begin": 0.0, "growth.end": 1.0, "published.depth_scale": scale}),
        )
        for scale in (0.0, 1.0)
    )
    for trainer in (plain, scaled):
        trainer.step()
    seen = plain.state.growth.weight > 0
    assert torch.equal(plain.state.growth.weight, scaled.state.growth.weight)  # both drew the same frame
    factor = (scaled.state.growth.gradient / plain.state.growth.gradient)[
        seen & (plain.state.growth.gradient > 0)
    ]
    depth_m = RANGE_M + np.array([-1.0, 1.0]) * math.sqrt(3) * plain.setup.radius_m  # the start fills a cube
    nearest, farthest = (depth_m / scaled.setup.unit_m) ** 2
    assert nearest <= factor.min() < factor.max() <= min(1.0, farthest) + 1e-5
