"""Every method and variant trains: to better than its start, the same again, and the same after an interruption."""

import numpy as np
import pytest
import torch

from obbgs_core.frames import cameras_of
from obbgs_core.methods.presets import PRESETS, preset
from obbgs_core.model import obb
from obbgs_core.model.cameras import Cameras
from obbgs_core.published.multi_view import corner_rays, crossing_boxes, inside, threshold_factor
from obbgs_core.render import render
from obbgs_core.score.metrics import psnr_db
from obbgs_core.train.trainer import Trainer
from tests.scenes import SENSOR, intrinsics, photographed, pose, target

STEPS = 40
QUICK = {"steps": STEPS, "start.count": 250, "growth.max_gaussians": 400}
SOON = {"growth.begin": 0.1, "growth.interval": 8, "rates.sh": 0.02}  # published methods grow after 500 steps
# each variant once
VARIED = ("3dgs+exposure", "obbgs+blind", "3dgs+affine", "obbgs+random", "3dgs+exposure+hull+mask+l1+fast")


@pytest.fixture(scope="module")
def frames():
    return photographed(target(), 21, size_px=32, focal_px=65.0)


def quick(name: str):
    if name.startswith("obbgs"):
        return preset(name, QUICK)
    boxes = 3 if preset(name).growth.obb_interval else 0
    return preset(name, QUICK | SOON | {"growth.obb_interval": boxes})


def held_out_db(trainer: Trainer, frames) -> float:
    images = [
        trainer.exposing.image(
            render(trainer.gaussians, cameras_of([f])).radiance[0], SENSOR, f.exposure_time_s
        )
        for f in frames
    ]
    return sum(psnr_db(image, f.dn / SENSOR.white_dn) for image, f in zip(images, frames, strict=True)) / len(
        frames
    )


@pytest.mark.parametrize("name", [*PRESETS, *VARIED, "mip-splatting+exposure+hull"])
def test_a_method_improves_on_its_start_and_repeats_bit_for_bit_also_after_an_interruption(
    frames, tmp_path, name
):
    training, held_out = frames[3:], frames[:3]
    whole = Trainer(training, SENSOR, quick(name), seed=5)
    start_db = held_out_db(whole, held_out)
    while not whole.stop_reason():
        whole.step()
    assert held_out_db(whole, held_out) > start_db + 0.5
    first = Trainer(training, SENSOR, quick(name), seed=5)
    for _ in range(23):
        first.step()
    first.save(tmp_path / "c")
    resumed = Trainer(training, SENSOR, quick(name), seed=5)
    assert resumed.resume(tmp_path / "c")
    while not resumed.stop_reason():
        resumed.step()
    assert len(resumed.state.history) == STEPS
    for key, tensor in whole.gaussians.tensors().items():
        assert torch.equal(tensor, getattr(resumed.gaussians, key)), key
    assert all(torch.equal(value, resumed.exposing.maps[key]) for key, value in whole.exposing.maps.items())


def test_a_training_is_past_growth_when_nothing_is_added_any_more(frames):
    trainer, past = Trainer(frames, SENSOR, quick("3dgs")), []
    while not trainer.stop_reason():
        counts = len(trainer.state.gaussians)
        past.append(trainer.is_past_growth)
        trainer.step()
        assert not past[-1] or len(trainer.state.gaussians) == counts
    assert past == [False] * 20 + [True] * 20


def test_mvgs_goes_through_its_authors_four_trainings():
    """Their run_360.py: 3,000 iterations with 48, 24 and 12 views at 1/8, 1/4 and 1/2, then 30,000 with 8 views."""
    config = preset("mvgs")
    moments = [config.moment(done) for done in range(config.steps)]
    stages = [(m.image_scale, m.frames) for m in moments if m.step == 1]
    assert stages == [(1 / 8, 48), (1 / 4, 24), (1 / 2, 12), (1.0, 8)]
    assert [i for i, m in enumerate(moments) if m.step == 1] == [0, 3000, 6000, 9000]
    assert all(m.share == pytest.approx((m.step - 1) / 30_000) for m in moments)
    assert config.steps_until(0.5) == 9000 + 15_000
    assert [preset("3dgs").moment(i).step for i in (0, 29_999)] == [1, 30_000]


@pytest.mark.parametrize(
    "coarse", [((0.5, 2),), ((2.0, 2, 0.1),), ((0.5, 0, 0.1),), ((0.5, 2, 0.5), (0.5, 2, 0.5))]
)
def test_coarse_stages_that_no_training_can_have_are_refused(coarse):
    with pytest.raises(ValueError, match="coarse must be triples of an image scale"):
        preset("mvgs", {"published.coarse": coarse})


def cameras(*positions: tuple[float, float, float]) -> Cameras:
    """Return 80x80 cameras at positions, all looking at the origin."""
    poses = []
    for position in positions:
        forward = -np.array(position) / np.linalg.norm(position)
        right = np.cross([0.1, 0.9, 0.2], forward)
        right /= np.linalg.norm(right)
        poses.append(
            pose(np.stack([right, np.cross(forward, right), forward]), float(np.linalg.norm(position)))
        )
    return Cameras(torch.stack(poses), intrinsics(80, 100.0).expand(len(positions), 3, 3), 80, 80)


def test_boxes_lie_where_the_rays_of_the_worst_tiles_are_nearest_to_each_other():
    views = cameras((4.0, 0, 0), (0, 0.5, 4.0), (-1, 3.0, -2))
    residual = torch.zeros(3, 80, 80, 1)
    tiles = [(20, 40), (40, 0), (60, 40)]
    for image, (row, column) in zip(residual, tiles, strict=True):
        image[row : row + 20, column : column + 40] = -1.0
    boxes = crossing_boxes(views, residual).double().numpy()
    assert boxes.shape == (3, 2, 3)
    origins, K = views.centres.double().numpy(), views.K[0].double().numpy()
    for box, (i, j) in zip(boxes, ((0, 1), (0, 2), (1, 2)), strict=True):
        middles = []
        for down, across in ((0, 0), (0, 40), (20, 0), (20, 40)):
            rays = []
            for c in (i, j):
                pixel = np.array([tiles[c][1] + across + 0.5, tiles[c][0] + down + 0.5, 1])
                rays.append(views.world_to_camera[c, :3, :3].double().numpy().T @ np.linalg.solve(K, pixel))
            along, *_ = np.linalg.lstsq(
                np.stack([rays[0], -rays[1]], axis=1), origins[j] - origins[i], rcond=None
            )
            middles.append((origins[i] + along[0] * rays[0] + origins[j] + along[1] * rays[1]) / 2)
        np.testing.assert_allclose(box, [np.min(middles, axis=0), np.max(middles, axis=0)], atol=1e-4)
    assert torch.equal(corner_rays(views, 0, residual[0].abs()).norm(dim=1).round(decimals=5), torch.ones(4))


def test_parallel_rays_have_no_crossing_and_boxes_hold_what_is_strictly_inside():
    twice = cameras((4.0, 0, 0), (4.0, 0, 0))
    assert crossing_boxes(twice, torch.ones(2, 80, 80, 1)).shape == (0, 2, 3)
    boxes = torch.tensor([[[0.0, 0, 0], [1, 1, 1]], [[2.0, 2, 2], [3, 3, 3]]])
    points = torch.tensor([[0.5, 0.5, 0.5], [1.0, 0.5, 0.5], [2.5, 2.5, 2.1], [1.5, 1.5, 1.5]])
    assert inside(points, boxes).tolist() == [True, False, True, False]
    assert not inside(points, boxes[:0]).any()


def test_the_threshold_of_growth_is_halved_where_views_are_far_apart():
    """Their rule: unit directions of two cameras from the origin differ by more than 1, that is by over 60 degrees."""

    def turned(degrees: float) -> tuple[float, float, float]:
        return 3 * np.cos(np.radians(degrees)), 3 * np.sin(np.radians(degrees)), 0.0

    assert threshold_factor(cameras(turned(0), turned(59), turned(30))) == 1
    assert threshold_factor(cameras(turned(0), turned(61), turned(30))) == 0.5


def test_a_box_may_be_centred_on_the_mean_as_published():
    points = torch.tensor([[0.0, 0, 0], [1, 0.2, 0], [2, 0, 0.1], [9, 0.1, 0.3]])
    tight, published = obb.fit(points), obb.fit(points, "mean")
    torch.testing.assert_close(published.centre, points.mean(dim=0))
    assert torch.equal(tight.half_extents, published.half_extents) and torch.equal(tight.axes, published.axes)
    assert tight.contains(points).all() and not published.contains(points).all()
