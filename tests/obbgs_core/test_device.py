"""The kernels of the GPU, run on this processor: against the reference, in a training, and compiled for two GPUs."""

import dataclasses
import importlib.util
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from obbgs_core.methods.presets import preset
from obbgs_core.model.cameras import Cameras
from obbgs_core.model.gaussians import Gaussians
from obbgs_core.render import backend_for, native_kernels, project, render
from obbgs_core.render.reference import MIN_ALPHA, MIN_TRANSMITTANCE
from obbgs_core.train.trainer import train
from tests.obbgs_core.test_render import (
    looking_at_origin,
    outputs_and_gradients,
    random_gaussians,
    under_the_sun,
)
from tests.scenes import QUICK, SENSOR, photographed, target

needs_warp = pytest.mark.skipif(
    importlib.util.find_spec("warp") is None, reason="warp-lang, of the extra gpu, is not installed"
)


@pytest.fixture(params=[True, False], ids=["blocks of threads", "single threads"])
def threads(request, monkeypatch):
    """As on a GPU, where the threads of a tile work together; or one after the other, as Warp has it by default."""
    import warp as wp

    monkeypatch.setattr(wp.config, "enable_cpu_blocks", request.param)


def exact(gaussians: Gaussians, cameras: Cameras) -> tuple[Gaussians, Cameras]:
    double = {name: value.double() for name, value in gaussians.parameters().items()}
    tensors = {n: t.double() for n, t in vars(cameras).items() if isinstance(t, torch.Tensor)}
    return dataclasses.replace(gaussians, **double), dataclasses.replace(cameras, **tensors)


def assert_the_same(ours, expected):
    (out, gradients), (truth, true_gradients) = ours, expected
    for name in ("radiance", "alpha"):
        torch.testing.assert_close(
            getattr(out, name).double(), getattr(truth, name), rtol=0, atol=1e-5, msg=name
        )
    torch.testing.assert_close(out.depth.double(), truth.depth, rtol=3e-5, atol=1e-5)
    for name, gradient in true_gradients.items():
        most = 1e-4 * float(gradient.abs().max())
        torch.testing.assert_close(gradients[name].double(), gradient, rtol=0, atol=most, msg=name)


@needs_warp
@pytest.mark.parametrize(
    ("shading", "sh_count", "channels", "footprint"),
    [
        ("view", 4, 3, "camera"),
        ("view", 16, 1, "kerbl"),
        ("view", 1, 3, "mip-splatting"),
        ("sun", 4, 1, "camera"),
        ("lambert", 1, 3, "camera"),
    ],
)
def test_images_and_gradients_are_those_of_the_reference(threads, shading, sh_count, channels, footprint):
    gaussians = random_gaussians(60, channels, seed=sh_count, sh_count=sh_count)
    gaussians = dataclasses.replace(gaussians, log_scales=gaussians.log_scales + 1, footprint=footprint)
    cameras, sunlit = looking_at_origin(3, 48, height=37), None
    if shading != "view":
        gaussians, cameras = under_the_sun(gaussians, cameras, shading)
        sunlit = (
            torch.rand(3, 60, generator=torch.Generator().manual_seed(2)) if shading == "lambert" else None
        )
    ours = outputs_and_gradients(gaussians, cameras, "warp", sunlit)
    assert_the_same(ours, outputs_and_gradients(*exact(gaussians, cameras), "reference", sunlit))


def on_an_edge(gaussians: Gaussians, cameras: Cameras) -> torch.Tensor:
    """Return the pixels [C, H, W] in which rounding decides whether a splat is drawn, or where a pixel is finished."""
    seen = project(gaussians, cameras)
    y, x = torch.meshgrid(torch.arange(cameras.height), torch.arange(cameras.width), indexing="ij")
    dx, dy = (
        (p + 0.5)[None, ..., None] - m
        for p, m in zip((x, y), seen.means2d[:, None, None].unbind(-1), strict=True)
    )
    a, b, c = seen.conics[:, None, None].unbind(-1)
    shares, drawn = seen.peak_shares[:, None, None], (seen.depths > 0)[:, None, None]
    alpha = gaussians.opacities * shares * torch.exp(-0.5 * (a * dx**2 + c * dy**2) - b * dx * dy)
    faint = ((alpha / (MIN_ALPHA * shares) - 1).abs() < 1e-3) & drawn
    through = torch.log1p(-alpha.clamp(max=0.99) * drawn).sum(dim=-1)
    finished = through < torch.log(torch.tensor(MIN_TRANSMITTANCE)) + 0.1
    return faint.any(dim=-1) | finished


@needs_warp
@settings(max_examples=40, deadline=None)
@given(
    count=st.integers(0, 12),
    width=st.integers(1, 40),
    height=st.integers(1, 40),
    larger=st.floats(-2, 3),
    range_m=st.floats(0.5, 8),
    footprint=st.sampled_from(["kerbl", "mip-splatting", "camera"]),
    seed=st.integers(0, 10**6),
)
def test_small_scenes_of_any_kind_are_those_of_the_reference(
    count, width, height, larger, range_m, footprint, seed
):
    gaussians = random_gaussians(count, 1, seed=seed, sh_count=1)
    gaussians = dataclasses.replace(gaussians, log_scales=gaussians.log_scales + larger, footprint=footprint)
    cameras = looking_at_origin(2, width, height=height, seed=seed)
    cameras.world_to_camera[:, 2, 3] = range_m
    double = exact(gaussians, cameras)
    truth = render(*double, "reference")
    out = render(gaussians, cameras, "warp")
    clear = ~on_an_edge(*double)
    for name in ("radiance", "alpha"):
        ours, expected = (getattr(each, name)[clear].double() for each in (out, truth))
        torch.testing.assert_close(ours, expected, rtol=1e-5, atol=1e-5, msg=name)


@needs_warp
@pytest.mark.skipif(not native_kernels(), reason="the compiled rasterizer is not installed")
def test_pixels_and_screen_gradients_are_those_of_the_compiled_kernels(threads):
    gaussians = random_gaussians(60, 3)
    gaussians.log_scales += 1
    cameras = looking_at_origin(2, 48)
    (ours, _), (theirs, _) = (outputs_and_gradients(gaussians, cameras, name) for name in ("warp", "native"))
    torch.testing.assert_close(ours.radii, theirs.radii)
    torch.testing.assert_close(ours.means2d, theirs.means2d, rtol=0, atol=1e-4)
    for camera in range(2):
        counted = ours.screen.pixels[camera], theirs.screen.pixels[camera]
        torch.testing.assert_close(*counted, rtol=0, atol=1)  # one may lie on a cutoff
        gradients = [out.screen.means2d[camera] for out in (ours, theirs)]
        torch.testing.assert_close(*gradients, rtol=0, atol=1e-4 * float(gradients[1].abs().max()))


@needs_warp
def test_a_training_ends_as_well_as_by_the_compiled_kernels():
    frames, quick = photographed(target()), QUICK | {"start.count": 100, "growth.max_gaussians": 150}
    errors = {}
    for device in ("cpu", "warp"):
        model = train(frames, SENSOR, preset("obbgs", quick | {"device": device}), seed=1).gaussians
        assert model.means.device.type == "cpu"
        seen = [render(model, Cameras(f.world_to_camera[None], f.K[None], *f.shape[1::-1])) for f in frames]
        expected = [
            SENSOR.expected_dn(s.radiance[0], f.exposure_time_s) for s, f in zip(seen, frames, strict=True)
        ]
        errors[device] = sum((e - f.dn).square().mean() for e, f in zip(expected, frames, strict=True))
    assert abs(10 * torch.log10(errors["warp"] / errors["cpu"])) < 1


@needs_warp
def test_a_training_never_mixes_tensors_of_the_device_with_those_in_main_memory():
    """What a GPU would refuse, a device that only PyTorch takes for another one refuses, too."""
    methods = ["obbgs", "3dgs+affine", "mvgs"]
    command = [sys.executable, "-m", "tests.second_device", *methods]
    done = subprocess.run(command, cwd=Path(__file__).parents[2], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]
    refused, *trained = done.stdout.splitlines()
    assert "two devices" in refused and trained == [f"{method} 10" for method in methods]


@needs_warp
def test_the_kernels_compile_for_gpus_without_a_driver(tmp_path):
    import warp as wp

    wp.config.log_level = wp.LOG_WARNING
    wp.init()
    from obbgs_core.render import device_kernels

    made = wp.compile_aot_module(device_kernels, arch=[80, 90], module_dir=tmp_path, use_ptx=False)
    assert [path.suffixes[-2:] for path in made] == [[".sm80", ".cubin"], [".sm90", ".cubin"]]
    for path in made:
        code = path.read_bytes()
        assert code[:4] == b"\x7fELF" and int.from_bytes(code[18:20], "little") == 190  # EM_CUDA
        for name in ("count_tiles", "list_tiles", "composite", "composite_backward", "add_up"):
            assert name.encode() in code


def test_what_a_device_lacks_is_said_in_one_line(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert backend_for("cpu") == backend_for("auto") == "auto"
    with pytest.raises(
        ValueError, match=r"^device=cuda cannot be used: PyTorch finds no CUDA device; device=cpu always can$"
    ):
        backend_for("cuda")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setitem(sys.modules, "warp", None)
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    assert backend_for("auto") == "auto"
    with pytest.raises(ValueError, match="warp-lang is not installed"):
        backend_for("cuda")
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: object())
    assert backend_for("auto") == backend_for("cuda") == "cuda"
