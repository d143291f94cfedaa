"""The 3D filter of Mip-Splatting: its width, what it does to Gaussians, and that nothing of it is lost."""

import dataclasses

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from obbgs_core.frames import TrainingFrame, sampling_rates
from obbgs_core.methods.presets import preset
from obbgs_core.model.gaussians import Gaussians
from obbgs_core.published.growth import reset_opacities
from obbgs_core.published.smoothing import log_lowering, sampling_deviation_m, smoothed
from obbgs_core.train.trainer import Trainer
from tests.scenes import SENSOR, intrinsics, photographed, pose, random_gaussians, target


def frame(distance_m: float, focal_px: float) -> TrainingFrame:
    return TrainingFrame(torch.zeros(64, 64, 1), 1e-4, pose(np.eye(3), distance_m), intrinsics(64, focal_px))


def test_the_width_is_that_of_the_finest_picture_with_the_gaussian_in_view():
    """sqrt(0.2) px of the frame with the largest focal length over depth; 15 % outside an image is still in view."""
    frames = [frame(5.0, 100.0), frame(10.0, 400.0)]  # at the origin 20 and 40 px/m
    reach_m = (
        5.0 / 100 * 32
    )  # half of what the first frame shows at the origin; the second shows half as much
    means = torch.zeros(5, 3)
    means[1:4, :2] = reach_m * torch.tensor([[0.9, 0], [1.25, 0], [0, 1.35]])
    means[4, 2] = -6.0
    widths_m = sampling_deviation_m(means, frames, 0.2)
    rates = np.array([40.0, 20, 20, 20, 100])  # the fourth is in no view: the smallest rate of the others
    np.testing.assert_allclose(widths_m.numpy(), np.sqrt(0.2) / rates, rtol=1e-5)


def test_the_sampling_rate_is_that_of_points_projected_by_opencv():
    model = target(9, seed=2)
    frames = photographed(model, count=5)
    points = model.means.detach().median(dim=0).values[None]
    middle = points[0].double().numpy()
    scales = []
    for frame in frames:
        pose, K = frame.world_to_camera.double().numpy(), frame.K.double().numpy()
        beside = middle + 1e-3 * pose[0, :3]  # a millimetre along the camera's x axis
        rotation, shift_m = cv2.Rodrigues(pose[:3, :3])[0], pose[:3, 3]
        pixels, _ = cv2.projectPoints(np.stack([middle, beside]), rotation, shift_m, K, None)
        scales.append(1e3 * np.linalg.norm(pixels[1] - pixels[0]))
    # poses are in single precision
    assert sampling_rates(points, frames).item() == pytest.approx(max(scales), rel=1e-5)
    behind = [
        dataclasses.replace(f, world_to_camera=torch.diag(torch.tensor([1.0, 1, -1, 1])) @ f.world_to_camera)
        for f in frames
    ]
    assert sampling_rates(points, behind).item() == 0


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10_000), st.floats(1e-3, 0.3))
def test_a_smoothed_gaussian_is_its_convolution_with_a_round_one(seed, width_m):
    """Covariances add, and the integral of o exp(-d²/2), which is o sqrt(det) (2 pi)^1.5, stays the same."""
    model = random_gaussians(20, seed=seed)
    after = smoothed(model, torch.full((20,), width_m))
    before64, after64 = (
        dataclasses.replace(m, **{k: v.double() for k, v in m.tensors().items()}).covariances().numpy()
        for m in (model, after)
    )
    np.testing.assert_allclose(after64, before64 + width_m**2 * np.eye(3), rtol=1e-3, atol=1e-5)
    light = model.opacities.double() * torch.linalg.det(torch.from_numpy(before64)).sqrt()
    spread = after.opacities.double() * torch.linalg.det(torch.from_numpy(after64)).sqrt()
    np.testing.assert_allclose(spread.numpy(), light.numpy(), rtol=1e-3)
    assert torch.equal(after.sh, model.sh) and torch.equal(after.means, model.means)


def test_gradients_pass_the_filter():
    model = random_gaussians(4).detach()
    inputs = [model.log_scales.double().requires_grad_(), model.opacity_logits.double().requires_grad_()]

    def filtered(log_scales, opacity_logits):
        given = Gaussians(model.means, model.quats, log_scales, opacity_logits, model.sh)
        after = smoothed(given, torch.tensor([0.01, 0.05, 0.1, 0.4], dtype=torch.float64))
        return after.log_scales, after.opacity_logits

    assert torch.autograd.gradcheck(filtered, inputs)


def test_extremes_stay_finite():
    model = random_gaussians(4)
    model.log_scales[:] = torch.tensor([-20.0, -20, 3, 3])[:, None]
    model.opacity_logits[:] = torch.tensor([-30.0, 30, -30, 30])
    model = model.trainable()
    after = smoothed(model, torch.full((4,), 0.01))
    (after.log_scales.sum() + after.opacity_logits.sum()).backward()
    for tensor in (after.log_scales, after.opacity_logits, model.log_scales.grad, model.opacity_logits.grad):
        assert tensor is not None and tensor.isfinite().all()


def test_opacities_are_reset_as_they_are_rendered():
    model = random_gaussians(50)
    model.opacity_logits[::7] = -6.0
    model, widths_m = model.trainable(), torch.full((50,), 0.03)
    seen = smoothed(model, widths_m).opacities.detach()
    model = reset_opacities(model, log_lowering(model, widths_m).detach())
    torch.testing.assert_close(
        smoothed(model, widths_m).opacities, seen.clamp(max=0.01), rtol=1e-4, atol=1e-7
    )
    assert (seen > 0.01).any() and (seen < 0.01).any()


def test_the_finished_model_holds_the_filter_and_the_filter_follows_the_gaussians():
    frames = photographed(target(), 12, size_px=32, focal_px=65.0)
    changes = {
        "steps": 40,
        "start.count": 200,
        "growth.begin": 0.1,
        "growth.interval": 6,
        "published.opacity_reset_interval": 9,
    }
    trainer = Trainer(frames, SENSOR, preset("mip-splatting", changes))
    known = []
    while not trainer.stop_reason():
        trainer.step()
        known.append(trainer.state.deviation_m)
        assert len(known[-1]) == len(trainer.state.gaussians)
    changed_at = [i + 2 for i in range(39) if known[i] is not known[i + 1]]
    assert changed_at == [
        6,
        12,
        18,
        24,
        30,
    ]  # at growth, and every interval after it, but not in the last one
    result = trainer.result("").gaussians
    widths_m = known[-1]
    raw = trainer.state.gaussians.detach()
    torch.testing.assert_close(
        result.scales, (raw.scales**2 + widths_m[:, None] ** 2).sqrt(), rtol=1e-5, atol=0
    )
    ratio = (raw.scales / result.scales).prod(dim=1)
    torch.testing.assert_close(result.opacities, raw.opacities * ratio, rtol=1e-4, atol=1e-7)


def test_gaussians_that_are_not_finite_leave_with_their_filter():
    frames = photographed(target(), 12, size_px=32, focal_px=65.0)
    trainer = Trainer(frames, SENSOR, preset("mip-splatting", {"steps": 40, "start.count": 200}))
    trainer.step()
    widths_m = trainer.state.deviation_m
    assert widths_m is not None
    with torch.no_grad():
        trainer.state.gaussians.means[7] = torch.nan
    assert len(trainer.result("").gaussians) == 199
    assert trainer.state.deviation_m is not None
    assert torch.equal(trainer.state.deviation_m, torch.cat([widths_m[:7], widths_m[8:]]))


@pytest.mark.parametrize("value", [-0.1, float("nan")])
def test_a_filter_without_a_width_is_refused(value):
    with pytest.raises(ValueError, match="smoothing_px2 must be 0 or more"):
        preset("mip-splatting", {"published.smoothing_px2": value})
