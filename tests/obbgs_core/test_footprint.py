"""A pixel's footprint: exact gradients, and the same light at every distance and image scale."""

import dataclasses
import math
from typing import get_args

import pytest
import torch

from obbgs_core.errors import ReconstructionError
from obbgs_core.methods.presets import preset
from obbgs_core.model.cameras import Cameras
from obbgs_core.model.footprint import PIXEL_PX2, footprint_px2
from obbgs_core.model.gaussians import DEFAULT_PSF_SIGMA_PX, Footprint, Gaussians
from obbgs_core.render import native_kernels, project, render
from obbgs_core.train.trainer import Trainer
from tests import scenes
from tests.obbgs_core.test_render import looking_at_origin, random_gaussians

needs_native = pytest.mark.skipif(not native_kernels(), reason="the compiled rasterizer is not installed")


def gradients(gaussians: Gaussians, cameras: Cameras, backend: str) -> dict[str, torch.Tensor | None]:
    """Return the gradients of a loss of all images by the model, the poses and the optics' point spread."""
    leaves = {name: value.clone().requires_grad_() for name, value in gaussians.tensors().items()}
    pose = cameras.world_to_camera.clone().requires_grad_()
    leaves["psf_sigma_px"] = torch.tensor(0.4, dtype=pose.dtype, requires_grad=True)
    moved = dataclasses.replace(cameras, world_to_camera=pose)
    out = render(dataclasses.replace(gaussians, **leaves), moved, backend)
    generator = torch.Generator().manual_seed(5)
    images = [out.radiance, out.alpha, out.depth]
    sum((i * torch.rand(i.shape, generator=generator).to(i)).sum() for i in images).backward()
    found = {name: leaf.grad for name, leaf in leaves.items()}
    return found | {"world_to_camera": pose.grad}


@needs_native
@pytest.mark.parametrize("kernel", native_kernels())
@pytest.mark.parametrize("footprint", get_args(Footprint))
def test_native_gradients_match_autograd_on_the_reference(kernel, footprint):
    # flat tops: hardly a pixel lies within float32 rounding of the 1/255 cutoff
    double = random_gaussians(60, seed=4, dtype=torch.float64)
    double.log_scales += 1.0
    single = Gaussians(**{n: v.float() for n, v in double.tensors().items()}, footprint=footprint)
    double = Gaussians(**{n: v.double() for n, v in single.tensors().items()}, footprint=footprint)
    cameras = looking_at_origin(3, 48)
    poses, K = cameras.world_to_camera.double(), cameras.K.double()
    expected = gradients(double, dataclasses.replace(cameras, world_to_camera=poses, K=K), "reference")
    ours = gradients(single, cameras, f"native-{kernel}")
    assert (expected["psf_sigma_px"] is None) == (ours["psf_sigma_px"] is None) == (footprint != "camera")
    for name, gradient in expected.items():
        if gradient is not None:
            error = (ours[name] - gradient).abs().max()  # pyright: ignore[reportOptionalOperand]
            assert error < 1e-4 * gradient.abs().max(), name


def boom(distance_m: float, focal_px: float = 100.0) -> tuple[Gaussians, Cameras]:
    """Return a faint rod, its sigmas 35 px and 0.35 px at 1 m, tilted so that it lies between pixels in all ways."""
    half = 0.17
    gaussians = Gaussians(
        means=torch.tensor([[0.013, -0.021, 0.0]]),
        quats=torch.tensor([[math.cos(half), 0.0, 0.0, math.sin(half)]]),
        log_scales=torch.tensor([[0.35, 0.0035, 0.0035]]).log(),
        opacity_logits=torch.tensor([0.7]).logit(),
        sh=torch.full((1, 1, 1), 3.0),
        footprint="camera",
    )
    pose = torch.eye(4)
    pose[2, 3] = distance_m
    K = torch.tensor([[focal_px, 0, 160], [0, focal_px, 160], [0, 0, 1]])
    return gaussians, Cameras(pose[None], K[None], 320, 320)


@pytest.mark.parametrize("backend", ["reference", *(f"native-{kernel}" for kernel in native_kernels())])
def test_a_boom_thinner_than_a_pixel_gives_the_same_light_at_every_distance(backend):
    light = []
    for distance_m in (1, 2, 4, 8):
        gaussians, cameras = boom(distance_m)
        light.append(distance_m**2 * render(gaussians, cameras, backend).radiance.sum().item())
    # the integral of opacity times radiance over the image plane at 1 m, where one pixel is a hundredth of a metre;
    # what falls short of it lies beyond the cutoff at an alpha of 1/255
    radiance = render(*boom(1), backend).radiance.max().item() / render(*boom(1), backend).alpha.max().item()
    exact = radiance * 0.7 * 2 * math.pi * 35 * 0.35
    assert all(abs(each / light[0] - 1) < 0.02 for each in light), light
    assert all(abs(each / exact - 1) < 0.03 for each in light), (light, exact)


def test_kept_peaks_make_a_distant_boom_too_bright():
    """What the lowered peak is for: with 0.3 px² and the peak kept the same boom is more than five times too bright."""
    light = []
    for distance_m in (1, 8):
        gaussians, cameras = boom(distance_m)
        kerbl = dataclasses.replace(gaussians, footprint="kerbl")
        light.append(distance_m**2 * render(kerbl, cameras, "reference").radiance.sum().item())
    assert light[1] > 5 * light[0]


@pytest.mark.parametrize("factor", [2, 4])
def test_images_at_a_smaller_scale_are_those_of_averaged_pixels(factor):
    """A reduced picture holds means of blocks of pixels; the model, rendered at that scale, must show the same."""
    gaussians = random_gaussians(40, 1, seed=3, sh_count=1)
    gaussians = dataclasses.replace(gaussians, opacity_logits=torch.full((40,), -2.0), footprint="camera")
    cameras = dataclasses.replace(looking_at_origin(2, 96), psf_sigma_px=0.8)
    full = render(gaussians, cameras).radiance.movedim(-1, 1)
    blocks = torch.nn.functional.avg_pool2d(full, factor).movedim(1, -1)
    small = render(gaussians, cameras.scaled(1 / factor)).radiance
    assert abs(small.sum() / blocks.sum() - 1) < 0.02
    # a Gaussian of the variance of a square differs from it by a few percent of a thin Gaussian's light
    assert (small - blocks).square().mean().sqrt() < 0.03 * blocks.max()


def test_the_footprint_is_that_of_pixel_and_optics_at_every_scale():
    gaussians = dataclasses.replace(random_gaussians(2), footprint="camera", psf_sigma_px=torch.tensor(0.4))
    unknown = looking_at_origin(3, 64)
    calibrated = dataclasses.replace(unknown, psf_sigma_px=0.8)
    for footprint, cameras, variance_px2 in (
        ("camera", calibrated, PIXEL_PX2 + 0.64),
        ("camera", calibrated.scaled(0.25), PIXEL_PX2 + 0.04),
        ("camera", unknown, PIXEL_PX2 + 0.16),
        ("camera", unknown.scaled(0.5).scaled(0.5), PIXEL_PX2 + 0.01),
        ("kerbl", calibrated.scaled(0.25), 0.3),
        ("mip-splatting", calibrated, 0.1),
    ):
        found = footprint_px2(dataclasses.replace(gaussians, footprint=footprint), cameras)
        torch.testing.assert_close(found, torch.full((3,), variance_px2))


def test_widening_keeps_a_gaussians_integral():
    gaussians = dataclasses.replace(random_gaussians(50, dtype=torch.float64), footprint="camera")
    cameras = looking_at_origin(2, 64, dtype=torch.float64)
    narrow = project(gaussians, dataclasses.replace(cameras, psf_sigma_px=0.1))
    wide = project(gaussians, dataclasses.replace(cameras, psf_sigma_px=3.0))
    areas = []
    for each in (narrow, wide):
        conics = each.conics
        areas.append(each.peak_shares / (conics[..., 0] * conics[..., 2] - conics[..., 1] ** 2).sqrt())
    torch.testing.assert_close(areas[0], areas[1])


@pytest.mark.parametrize("backend", ["reference", *(f"native-{kernel}" for kernel in native_kernels())])
def test_a_gaussian_without_width_is_not_drawn_and_has_no_gradient(backend):
    gaussians = dataclasses.replace(random_gaussians(8, sh_count=1), footprint="camera")
    gaussians.log_scales[:4] = -200.0
    found = gradients(gaussians, looking_at_origin(1, 32), backend)
    for name, gradient in found.items():
        assert gradient is not None and gradient.isfinite().all(), name
    assert not found["means"][:4].any() and found["means"][4:].any()  # pyright: ignore[reportOptionalSubscript]


def test_an_unknown_footprint_is_refused():
    with pytest.raises(ValueError, match="footprint must be one of kerbl, mip-splatting, camera"):
        dataclasses.replace(random_gaussians(2), footprint="gauss")  # pyright: ignore[reportArgumentType]


def test_the_point_spread_is_found_from_pictures_alone():
    gaussians = dataclasses.replace(random_gaussians(60, 1, sh_count=1), footprint="camera")
    cameras = looking_at_origin(3, 48)
    seen = render(gaussians, dataclasses.replace(cameras, psf_sigma_px=0.8)).radiance
    estimate = torch.tensor(0.26, requires_grad=True)
    optimiser = torch.optim.Adam([estimate], lr=0.05)
    model = dataclasses.replace(gaussians, psf_sigma_px=estimate)
    for _ in range(120):
        optimiser.zero_grad()
        (render(model, cameras).radiance - seen).square().sum().backward()
        optimiser.step()
    assert abs(estimate.item() - 0.8) < 0.01


@pytest.mark.parametrize("calibrated", [True, False])
def test_training_learns_the_point_spread_only_where_it_is_not_calibrated(calibrated):
    frames = scenes.photographed(scenes.target(), count=6, size_px=32)
    if calibrated:
        frames = [dataclasses.replace(frame, psf_sigma_px=0.5) for frame in frames]
    trainer = Trainer(frames, scenes.SENSOR, preset("obbgs", {"steps": 20, "start.count": 100}))
    for _ in range(5):
        trainer.step()
    moved = trainer.state.gaussians.psf_sigma_px.item() != pytest.approx(DEFAULT_PSF_SIGMA_PX)
    assert moved == (not calibrated)


def test_frames_of_different_optics_are_refused():
    frames = scenes.photographed(scenes.target(), count=4, size_px=32)
    frames[2] = dataclasses.replace(frames[2], psf_sigma_px=0.5)
    with pytest.raises(ReconstructionError, match="one psf_sigma_px"):
        Trainer(frames, scenes.SENSOR, preset("obbgs"))
