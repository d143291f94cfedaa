"""A background that is not black: in rendering, its gradients, silhouettes, training and the exported renderer."""

import dataclasses

import numpy as np
import onnxruntime
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from obbgs_core.errors import ReconstructionError
from obbgs_core.io.onnx import export_onnx
from obbgs_core.methods.presets import preset
from obbgs_core.model import sh
from obbgs_core.model.cameras import Cameras
from obbgs_core.render import native_kernels, render
from obbgs_core.sensor import Sensor
from obbgs_core.start import hull
from obbgs_core.start.initialisation import silhouettes
from obbgs_core.train.result import StepInfo
from obbgs_core.train.trainer import Trainer
from tests.scenes import QUICK, SENSOR, intrinsics, photographed, pose, random_gaussians, target

SIZE_PX = 40
BACKENDS = ["reference", *(f"native-{kernel}" for kernel in native_kernels())]


def camera(background: float, dtype=torch.float32) -> Cameras:
    K = intrinsics(SIZE_PX, 80.0)
    return Cameras(
        pose(np.eye(3))[None].to(dtype), K[None].to(dtype), SIZE_PX, SIZE_PX, background=background
    )


@settings(max_examples=20, deadline=None)
@given(radiance=st.floats(0.01, 5.0), seed=st.integers(0, 1000), backend=st.sampled_from(BACKENDS))
def test_gaussians_of_the_background_s_radiance_cannot_be_seen(radiance, seed, backend):
    model = target(seed=seed)
    model.sh = sh.from_radiance(torch.tensor(radiance)).expand(len(model), 1, 1).contiguous()
    seen = render(model, camera(radiance), backend)
    assert seen.alpha.max() > 0.5
    torch.testing.assert_close(seen.radiance, torch.full_like(seen.radiance, radiance), rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("backend", BACKENDS)
def test_the_background_shines_through_by_what_is_not_covered(backend):
    model = random_gaussians(200, 4, 3)
    black, white = render(model, camera(0.0), backend), render(model, camera(2.0), backend)
    expected = black.radiance + 2.0 * (1 - black.alpha[..., None])
    torch.testing.assert_close(white.radiance, expected)
    for name in ("alpha", "depth", "median_depth"):
        assert torch.equal(getattr(black, name), getattr(white, name))


def test_gradients_through_the_background_are_those_of_finite_differences():
    model = target(4)
    weights = torch.rand(1, SIZE_PX, SIZE_PX, 1, generator=torch.Generator().manual_seed(0)).double()
    leaves = {name: value.double() for name, value in model.tensors().items()}

    def loss(**changed) -> torch.Tensor:
        seen = render(
            dataclasses.replace(model, **(leaves | changed)), camera(1.5, torch.float64), "reference"
        )
        return (seen.radiance * weights).sum()

    for name in ("opacity_logits", "sh"):
        # of few, fairly opaque Gaussians whose contributions change without crossing the cutoff of 1/255
        value = leaves[name].clone().requires_grad_()
        (ours,) = torch.autograd.grad(loss(**{name: value}), value)
        for index in range(len(model)):
            step = torch.zeros_like(leaves[name])
            step.view(len(model), -1)[index, 0] = 1e-6
            slope = (loss(**{name: leaves[name] + step}) - loss(**{name: leaves[name] - step})) / 2e-6
            assert float(ours.view(len(model), -1)[index, 0]) == pytest.approx(
                float(slope), rel=1e-4, abs=1e-6
            )


@pytest.mark.skipif(not native_kernels(), reason="no compiled kernels on this machine")
def test_native_gradients_with_a_background_are_those_of_the_reference():
    gradients = {}
    for backend in ("reference", "native"):
        model = target().trainable()
        seen = render(model, camera(1.5), backend)
        (seen.radiance * torch.linspace(0, 1, SIZE_PX)[None, None, :, None]).sum().backward()
        gradients[backend] = {name: value.grad for name, value in model.tensors().items()}
    for name, expected in gradients["reference"].items():
        # single pixels on the cutoff move a gradient by a thousandth of the largest
        assert (gradients["native"][name] - expected).abs().max() < 5e-3 * expected.abs().max(), name


def test_a_dark_target_on_white_has_the_outline_of_a_light_one_on_black():
    sensor = Sensor(black_dn=0, white_dn=255, dn_per_radiance_s=255, electrons_per_dn=1e3, read_noise_dn=2)
    light = torch.zeros(64, 64, 3)
    light[20:44, 16:50] = (
        torch.randint(100, 256, (24, 34, 3), generator=torch.Generator().manual_seed(0)) * 1.0
    )
    on_white = hull.light(255 - light, sensor, 1.0, 1.0)
    assert torch.equal(on_white, light)
    assert hull.light(light, sensor, 0.0, 1.0) is light
    outline = hull.silhouette(on_white, sensor, pose(np.eye(3)), intrinsics())
    assert outline.certain[22:42, 18:48].all() and outline.sky[:10].all()


def dark_target():
    """A scene whose Gaussians are darker than the background of `frames_on_white`."""
    rng = torch.Generator().manual_seed(0)
    return dataclasses.replace(
        target(), sh=sh.from_radiance(0.05 + 0.2 * torch.rand(60, 1, 1, generator=rng))
    )


def frames_on_white():
    """Frames of a dark scene in front of a background at full scale of the longest exposure, without noise."""
    frames = []
    scene = dark_target()
    white = (SENSOR.white_dn - SENSOR.black_dn) / (SENSOR.dn_per_radiance_s * 2e-4)
    for f in photographed(target(), 12, size_px=32, focal_px=65.0):
        cameras = Cameras(f.world_to_camera[None], f.K[None], 32, 32, background=white)
        expected = SENSOR.expected_dn(render(scene, cameras).radiance[0], f.exposure_time_s)
        frames.append(dataclasses.replace(f, dn=expected.clamp(max=SENSOR.white_dn), background=white))
    return frames


@pytest.mark.parametrize("method", ["obbgs", "3dgs"])
def test_a_training_learns_a_target_on_white_and_repeats_itself(method):
    frames = frames_on_white()
    changes = QUICK | {"steps": 150} | ({"exposure_aware": True} if method == "3dgs" else {})
    first, again = (Trainer(frames, SENSOR, preset(method, changes), seed=3) for _ in range(2))
    infos = [first.step() for _ in range(150)]
    assert infos[:20] == [dataclasses.replace(again.step(), **_clock(info)) for info in infos[:20]]
    early, late = (np.mean([info.psnr_db for info in part]) for part in (infos[:10], infos[-10:]))
    assert late > early + 2  # dB


def _clock(info: StepInfo) -> dict[str, float]:
    return {"seconds": info.seconds, "seconds_left": info.seconds_left}


def test_outlines_on_white_are_those_on_black():
    on_white = silhouettes(frames_on_white(), SENSOR)
    for outline in on_white.values():
        seen = render(target(), Cameras(outline.world_to_camera[None], outline.K[None], 32, 32)).alpha[0]
        # nearly every pixel that the target covers, and none outside but by half of a 9x9 window
        assert (outline.likely & (seen > 0.5)).sum() > 0.9 * (seen > 0.5).sum()
        near = torch.nn.functional.max_pool2d(seen[None], 9, 1, 4)[0]
        assert not (outline.certain & (near < 0.01)).any()


def test_a_background_belongs_to_the_identity_of_a_training():
    frames = photographed(target(), 6, size_px=32, focal_px=65.0)
    config = preset("3dgs", QUICK)
    black = Trainer(frames, SENSOR, config).setup.digest
    grey = [dataclasses.replace(f, background=1e-3) for f in frames]
    assert Trainer(grey, SENSOR, config).setup.digest != black


@pytest.mark.parametrize("wrong", [-1.0, float("nan"), float("inf")])
def test_backgrounds_that_are_no_radiance_are_refused(wrong):
    with pytest.raises(ValueError, match="background"):
        camera(wrong)
    frames = photographed(target(), 4, size_px=32, focal_px=65.0)
    with pytest.raises(ReconstructionError, match="background"):
        Trainer([dataclasses.replace(f, background=wrong) for f in frames], SENSOR, preset("obbgs"))
    with pytest.raises(ReconstructionError, match="one background"):
        Trainer([dataclasses.replace(frames[0], background=1.0), *frames[1:]], SENSOR, preset("obbgs"))


def test_the_exported_renderer_has_the_background(tmp_path):
    model = random_gaussians(300, 4, 3)
    path = tmp_path / "model.onnx"
    export_onnx(model, SENSOR, path, SIZE_PX, SIZE_PX, [1e-4], background=0.5)
    cameras = camera(0.5)
    feed = {"world_to_camera": cameras.world_to_camera[0].numpy(), "K": cameras.K[0].numpy()}
    runtime = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    (image,) = runtime.run(["image"], feed | {"exposure_time_s": np.array(1e-4, dtype=np.float32)})
    ours = SENSOR.expected_dn(render(model, cameras).radiance[0], 1e-4) / SENSOR.white_dn
    # pixels on the cutoff of 1/255 may differ
    assert np.sqrt(np.mean((image - ours.clamp(0, 1).numpy()) ** 2)) < 10 ** (-50 / 20)
