"""The compiled rasterizer against the readable reference, and the reference against autograd's finite differences."""

import numpy as np
import pytest
import torch

from obbgs_core.cameras import Cameras
from obbgs_core.gaussians import Gaussians
from obbgs_core.render import native_kernels, project, render
from obbgs_core.rotations import multiply, quats_to_matrices

needs_native = pytest.mark.skipif(not native_kernels(), reason="the compiled rasterizer is not installed")


def random_gaussians(
    count: int, channels: int = 3, seed: int = 0, dtype=torch.float32, sh_count: int = 4
) -> Gaussians:
    g = torch.Generator().manual_seed(seed)
    return Gaussians(
        means=torch.randn(count, 3, generator=g, dtype=dtype) * 0.5,
        quats=torch.randn(count, 4, generator=g, dtype=dtype),
        log_scales=torch.rand(count, 3, generator=g, dtype=dtype) * 2 - 4,
        opacity_logits=torch.randn(count, generator=g, dtype=dtype) * 2,
        sh=torch.rand(count, sh_count, channels, generator=g, dtype=dtype) - 0.2,
    )


def looking_at_origin(
    count: int, size: int, dtype=torch.float32, height: int | None = None, seed: int = 1
) -> Cameras:
    rng = np.random.default_rng(seed)
    poses = []
    for _ in range(count):
        z = rng.normal(size=3)
        z /= np.linalg.norm(z)
        x = np.cross(z, rng.normal(size=3))
        x /= np.linalg.norm(x)
        pose = np.eye(4)
        pose[:3, :3] = np.stack([x, np.cross(z, x), z])
        pose[2, 3] = 4.0
        poses.append(pose)
    K = np.array([[1.2 * size, 0, size / 2 - 0.7], [0, 1.1 * size, size / 2 + 1.3], [0, 0, 1]])
    return Cameras(
        torch.tensor(np.array(poses), dtype=dtype),
        torch.tensor(np.array([K] * count), dtype=dtype),
        size,
        height or size,
    )


def outputs_and_gradients(gaussians: Gaussians, cameras: Cameras, backend: str, normals: bool = False):
    leaves = {name: value.clone().requires_grad_() for name, value in gaussians.tensors().items()}
    pose = cameras.world_to_camera.clone().requires_grad_()
    moved = Cameras(pose, cameras.K, cameras.width, cameras.height, cameras.near_m)
    out = render(Gaussians(**leaves), moved, backend, normals=normals)
    g = torch.Generator().manual_seed(5)
    images = [out.radiance, out.alpha[..., None], out.depth[..., None]] + ([out.normals] if normals else [])
    loss = sum((i * torch.rand(i.shape, generator=g).to(i.dtype)).sum() for i in images)
    loss.backward()
    return out, {**{n: t.grad for n, t in leaves.items()}, "world_to_camera": pose.grad}


@needs_native
@pytest.mark.parametrize("kernel", native_kernels())
@pytest.mark.parametrize(("channels", "width", "height"), [(1, 64, 64), (3, 75, 41)])
def test_kernels_match_the_reference_in_values_and_gradients(kernel, channels, width, height):
    gaussians, cameras = random_gaussians(300, channels), looking_at_origin(2, width, height=height)
    truth, truth_gradients = outputs_and_gradients(gaussians, cameras, "reference", normals=True)
    ours, our_gradients = outputs_and_gradients(gaussians, cameras, f"native-{kernel}", normals=True)
    for name in ("radiance", "alpha", "depth", "normals"):
        # a contribution within rounding of the 1/255 cutoff may fall on either side: at most 4e-3 of a value there
        error = (getattr(ours, name) - getattr(truth, name)).abs()
        assert error.max() < 2e-2 and error.mean() < 1e-5, name
    for name, expected in truth_gradients.items():
        scale = expected.abs().max()
        # single pixels on the cutoff move a gradient by a thousandth of the largest; float32 sums by 1e-5
        assert (our_gradients[name] - expected).abs().max() < 5e-3 * scale, name
        assert (our_gradients[name] - expected).abs().mean() < 2e-4 * scale, name


@needs_native
def test_all_kernels_agree_and_repeat_bit_for_bit():
    gaussians, cameras = random_gaussians(500), looking_at_origin(1, 96)
    images = {k: render(gaussians, cameras, f"native-{k}").radiance for k in native_kernels()}
    first = outputs_and_gradients(gaussians, cameras, "native")
    again = outputs_and_gradients(gaussians, cameras, "native")
    assert torch.equal(first[0].radiance, again[0].radiance)
    for name in first[1]:
        assert torch.equal(first[1][name], again[1][name])
    for name, image in images.items():
        # fused and separate multiply-adds differ by rounding, amplified by a cutoff pixel at most
        assert (image - images["portable"]).abs().mean() < 1e-6, name


def test_reference_gradient_matches_finite_differences():
    gaussians = random_gaussians(4, 1, seed=3, dtype=torch.float64)
    gaussians.log_scales += 1.5  # wide and faint: far from the 1/255 cutoff and from the 0.99 clamp
    gaussians.opacity_logits = torch.full_like(gaussians.opacity_logits, 0.5)
    cameras = looking_at_origin(1, 5, dtype=torch.float64)

    def image(means, quats, log_scales, opacity_logits, sh, pose):
        moved = Cameras(pose, cameras.K, 5, 5)
        out = render(Gaussians(means, quats, log_scales, opacity_logits, sh), moved, "reference")
        return out.radiance, out.alpha, out.depth

    leaves = [t.clone().requires_grad_() for t in (*gaussians.tensors().values(), cameras.world_to_camera)]
    assert torch.autograd.gradcheck(image, leaves, eps=1e-6, atol=1e-5)


@pytest.mark.parametrize("backend", ["reference", *(["native"] if native_kernels() else [])])
def test_rotating_scene_and_camera_together_leaves_the_image(backend):
    gaussians, cameras = random_gaussians(100, 1, sh_count=1), looking_at_origin(1, 40)
    quat = torch.nn.functional.normalize(torch.tensor([0.3, -0.5, 0.7, 0.2]), dim=0)
    turn = torch.eye(4)
    turn[:3, :3] = quats_to_matrices(quat)
    turned = Gaussians(
        gaussians.means @ turn[:3, :3].T,
        multiply(quat.expand(100, 4), gaussians.quats),
        gaussians.log_scales,
        gaussians.opacity_logits,
        gaussians.sh,
    )
    moved = Cameras(cameras.world_to_camera @ turn.T, cameras.K, 40, 40)
    a, b = render(gaussians, cameras, backend).radiance, render(turned, moved, backend).radiance
    assert (a - b).abs().mean() < 1e-5 and (a - b).abs().max() < 2e-2  # float32 rounding; one cutoff pixel


def test_order_of_gaussians_does_not_matter():
    gaussians, cameras = random_gaussians(200), looking_at_origin(1, 48)
    shuffled = gaussians.select(torch.randperm(200, generator=torch.Generator().manual_seed(2)))
    a, b = render(gaussians, cameras).radiance, render(shuffled, cameras).radiance
    torch.testing.assert_close(a, b, rtol=0, atol=1e-6)


@pytest.mark.parametrize("backend", ["reference", *(["native"] if native_kernels() else [])])
def test_gaussians_behind_the_camera_or_not_finite_are_not_drawn_and_give_no_nan(backend):
    gaussians, cameras = random_gaussians(6), looking_at_origin(1, 32)
    centre = cameras.centres[0]
    gaussians.means[0] = centre
    gaussians.means[1] = 2 * centre
    gaussians.means[2] = float("nan")
    gaussians.quats[3] = 0.0
    gaussians.log_scales[4] = 200.0
    out, gradients = outputs_and_gradients(gaussians, cameras, backend)
    assert (out.radii[0, :3] == 0).all() and out.radii[0, 4] == 0
    assert torch.isfinite(out.radiance).all() and torch.isfinite(out.depth).all()
    for name in ("means", "sh", "opacity_logits"):
        assert (gradients[name][:2] == 0).all(), name
    assert all(
        torch.isfinite(gradients[n][[0, 1, 3, 5]]).all()
        for n in ("means", "log_scales", "sh", "opacity_logits")
    )


def test_an_empty_model_is_a_black_sky():
    out = render(random_gaussians(1).select(torch.tensor([], dtype=torch.long)), looking_at_origin(2, 16))
    assert (out.radiance == 0).all() and (out.alpha == 0).all() and (out.depth == 0).all()


@needs_native
def test_screen_gradients_equal_the_gradient_of_the_projected_means():
    gaussians, cameras = random_gaussians(50, 1), looking_at_origin(1, 32)
    leaves = {n: t.clone().requires_grad_() for n, t in gaussians.tensors().items()}
    out = render(Gaussians(**leaves), cameras, "native")
    out.means2d.retain_grad()
    out.radiance.square().sum().backward()
    torch.testing.assert_close(out.screen.means2d[0], out.means2d.grad[0])
    assert ((out.screen.pixels[0] > 0) <= (out.radii[0] > 0)).all()


def test_projection_matches_opencv():
    cv2 = pytest.importorskip("cv2")
    gaussians, cameras = (
        random_gaussians(20, dtype=torch.float64),
        looking_at_origin(1, 64, dtype=torch.float64),
    )
    W, K = cameras.world_to_camera[0].numpy(), cameras.K[0].numpy()
    expected, _ = cv2.projectPoints(gaussians.means.numpy(), cv2.Rodrigues(W[:3, :3])[0], W[:3, 3], K, None)
    np.testing.assert_allclose(project(gaussians, cameras).means2d[0].numpy(), expected[:, 0], atol=1e-9)


def test_unknown_backend_is_refused():
    with pytest.raises(ValueError, match="backend must be"):
        render(random_gaussians(1), looking_at_origin(1, 8), "magic")
