"""Motion during the exposure: pictures of a moving target against the mean of many pictures of it standing still."""

import dataclasses

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from obbgs_core.model.cameras import Cameras
from obbgs_core.render import native_kernels, render
from tests.scenes import SIZE_PX, intrinsics, pose, target

BACKENDS = ["reference", *(f"native-{kernel}" for kernel in native_kernels())]
STEPS = 41


def cameras(motion: Tensor | None) -> Cameras:
    poses = torch.stack([pose(np.eye(3)), pose(Rotation.from_euler("xyz", [0.5, 0.3, 1.0]).as_matrix())])
    given = None if motion is None else motion.expand(2, 6)
    K = intrinsics().expand(2, 3, 3)
    return Cameras(poses, K, SIZE_PX, SIZE_PX, psf_sigma_px=0.4, motion=given)


def mean_over_exposure(model, still: Cameras, motion: Tensor, backend: str) -> Tensor:
    """Return the mean picture of the target at many moments of the exposure, turned and shifted by each."""
    total = 0
    for share in (np.arange(STEPS) + 0.5) / STEPS - 0.5:
        moved = torch.eye(4)
        turn = Rotation.from_rotvec(share * motion[:3].double().numpy())
        moved[:3, :3] = torch.tensor(turn.as_matrix(), dtype=torch.float32)
        moved[:3, 3] = share * motion[3:]
        at_moment = dataclasses.replace(still, world_to_camera=moved @ still.world_to_camera)
        total = total + render(model, at_moment, backend).radiance
    return total / STEPS


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize(
    "motion",
    [
        [0.0, 2.0 / 130, 0.0, 0.0, 0.0, 0.0],  # 2 px sideways, as of a camera that turns
        [0.0, 0.0, 0.12, 0.0, 0.0, 0.0],  # about the optical axis: 2 px at 17 px from the middle
        [0.0, 0.0, 0.0, 0.1, 0.05, 0.3],
    ],
)
def test_a_moving_target_looks_like_the_mean_over_its_exposure(motion, backend):
    model = dataclasses.replace(target(), footprint="camera")
    given = torch.tensor(motion)
    still = cameras(None)
    truth = mean_over_exposure(model, still, given, backend)
    blurred = render(model, cameras(given), backend).radiance
    stood = render(model, still, backend).radiance
    assert (blurred - truth).square().mean() < 0.002 * (stood - truth).square().mean()


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_target_that_stands_still_is_drawn_as_without_a_motion(backend):
    model = dataclasses.replace(target(), footprint="camera")
    still, plain = (render(model, cameras(motion), backend) for motion in (torch.zeros(6), None))
    for name, expected in vars(plain).items():
        if isinstance(expected, Tensor):
            torch.testing.assert_close(getattr(still, name), expected, rtol=1e-6, atol=1e-6)


def test_screen_gradients_are_those_of_all_moments_of_a_camera():
    model = dataclasses.replace(target(), footprint="camera")
    leaf = dataclasses.replace(model, means=model.means.clone().requires_grad_())
    seen = [render(leaf, cameras(motion)) for motion in (torch.zeros(6), None)]
    for rendered in seen:
        rendered.radiance.square().sum().backward()
    still, plain = (rendered.screen for rendered in seen)
    assert list(still.means2d) == list(plain.means2d) == [0, 1] == list(still.pixels)
    for camera, expected in plain.means2d.items():
        torch.testing.assert_close(still.means2d[camera], expected, rtol=1e-3, atol=1e-5)
        assert torch.equal(still.pixels[camera], plain.pixels[camera])


@pytest.mark.parametrize("backend", BACKENDS[1:])
@pytest.mark.parametrize("footprint", ["camera", "kerbl"])
def test_gradients_of_a_moving_target_match_autograd_on_the_reference(footprint, backend):
    given = torch.tensor([0.01, 0.02, 0.05, 0.02, -0.03, 0.1])
    model = dataclasses.replace(target(), footprint=footprint)

    def gradients(backend: str, dtype: torch.dtype) -> dict[str, Tensor]:
        names = [name for name in model.parameters() if name not in ("ambient", "psf_sigma_px")]
        leaves = {name: model.parameters()[name].detach().to(dtype).requires_grad_() for name in names}
        seen = cameras(given.to(dtype))
        world_to_camera = seen.world_to_camera.to(dtype).requires_grad_()
        seen = dataclasses.replace(seen, world_to_camera=world_to_camera, K=seen.K.to(dtype))
        weights = torch.rand(2, SIZE_PX, SIZE_PX, 1, generator=torch.Generator().manual_seed(3))
        (render(dataclasses.replace(model, **leaves), seen, backend).radiance * weights).sum().backward()
        return {name: leaf.grad for name, leaf in leaves.items()} | {"pose": world_to_camera.grad}

    expected = gradients("reference", torch.float64)
    for name, ours in gradients(backend, torch.float32).items():
        largest = float(expected[name].abs().max())
        torch.testing.assert_close(ours.double(), expected[name], rtol=0, atol=1e-2 * largest, msg=name)
