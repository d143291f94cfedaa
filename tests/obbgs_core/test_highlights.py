"""Highlights: their shape against published formulas, gradients, files, and when a training has them."""

import dataclasses
import math

import numpy as np
import onnxruntime
import pytest
import torch
import torch.nn.functional as F
from hypothesis import given, settings
from hypothesis import strategies as st

from obbgs_core.evidence import Evidence
from obbgs_core.evidence.highlights import Lobes, first_lobes
from obbgs_core.frames import cameras_of
from obbgs_core.io.onnx import export_onnx
from obbgs_core.io.ply import display_sh, load_ply, save_ply
from obbgs_core.io.spz import load_spz, save_spz
from obbgs_core.methods.presets import preset
from obbgs_core.model.cameras import Cameras
from obbgs_core.model.gaussians import Gaussians
from obbgs_core.render import lit_from, native_kernels, render
from obbgs_core.render.highlights import highlights_along, lobe, shortest_axes
from obbgs_core.render.lighting import radiance_along
from obbgs_core.train import selection
from obbgs_core.train.adam import Adam
from obbgs_core.train.growth import Growth
from obbgs_core.train.trainer import Trainer
from tests import ply_by_trimesh
from tests.obbgs_core.test_render import (
    looking_at_origin,
    outputs_and_gradients,
    random_gaussians,
    under_the_sun,
)
from tests.scenes import SENSOR, ball, decide, photographed, target
from tests.scenes import random_gaussians as any_gaussians

needs_native = pytest.mark.skipif(not native_kernels(), reason="the compiled rasterizer is not installed")
# static: of the view, with lobes under a Sun that is known and stands still; normals: Lambert's, with lobes along them
SHADINGS = [
    ("view", 1, 1),
    ("view", 4, 3),
    ("static", 4, 3),
    ("sun", 4, 3),
    ("lambert", 4, 3),
    ("normals", 1, 3),
]
STATIC_SUN = torch.tensor([-0.48, 0.6, -0.64])
SHINY = {"steps": 120, "start.count": 150, "growth.max_gaussians": 200}


def shining(
    gaussians: Gaussians, alpha: float = 0.4, peak: float = 0.8, seed: int = 3, own_axes: bool = True
) -> Gaussians:
    """Return the Gaussians with random lobes of one material, of random axes or along their normals."""
    g = torch.Generator().manual_seed(seed)
    lobes = torch.randn(len(gaussians), 4, generator=g).to(gaussians.means)
    lobes[:, 3] *= 0.3
    gloss = torch.tensor([alpha, *torch.linspace(1, 0.6, gaussians.sh.shape[2]).mul(peak).tolist()]).log()
    return dataclasses.replace(
        gaussians, lobes=lobes if own_axes else lobes[:, 3:], gloss=gloss.to(gaussians.means)
    )


def lit(gaussians: Gaussians, cameras: Cameras, shading: str) -> tuple[Gaussians, Cameras]:
    """Return both under the illumination that a shading of `SHADINGS` needs."""
    if shading == "static":
        return dataclasses.replace(gaussians, static_sun=STATIC_SUN.to(gaussians.means)), cameras
    if shading == "view":
        return gaussians, cameras
    return under_the_sun(gaussians, cameras, "lambert" if shading == "normals" else shading)


@given(st.floats(0.02, 1.0), st.floats(0.0, math.pi / 2 - 0.01))
def test_a_lobe_is_the_ggx_distribution_over_its_peak(alpha, angle):
    """Walter et al. 2007, equation 33, by the tangent; a view at twice the angle from the mirrored Sun sees it too."""

    def ggx(t: float) -> float:
        return alpha**2 / (math.pi * math.cos(t) ** 4 * (alpha**2 + math.tan(t) ** 2) ** 2)

    for cosine, half_vector in ((math.cos(angle), True), (math.cos(2 * angle), False)):
        at, roughness = torch.tensor([cosine, alpha], dtype=torch.float64)
        seen = lobe(at, roughness, half_vector)
        assert float(seen) == pytest.approx(ggx(angle) / ggx(0.0), rel=1e-6, abs=1e-9)


@settings(max_examples=30)
@given(st.integers(0, 10**6))
def test_a_mirror_is_brightest_where_the_law_of_reflection_says(seed):
    rng = np.random.default_rng(seed)
    normal, camera = rng.normal(size=(2, 3))
    normal /= np.linalg.norm(normal)
    camera *= np.sign(normal @ camera) / np.linalg.norm(camera)
    sun = 2 * (normal @ camera) * normal - camera  # the angle of incidence is that of reflection
    black = ball(1, 0.0, 0.0, coefficient=-9.0)
    mirror = dataclasses.replace(
        black,
        shading="sun",
        lobes=torch.tensor([[*(3.0 * normal), 0.5]]).float(),
        gloss=torch.tensor([0.2, 2.0]).log(),
    )
    turned = camera + 0.3 * rng.normal(size=3)
    known = torch.tensor(sun).float()
    still = dataclasses.replace(mirror, shading="view", static_sun=known)
    for towards, brightest in ((camera, True), (turned / np.linalg.norm(turned), False)):
        light = radiance_along(mirror, torch.tensor(-towards).float()[None], known)
        assert torch.equal(radiance_along(still, torch.tensor(-towards).float()[None]), light)
        peak = 2.0 * math.exp(0.5)
        assert (
            float(light) == pytest.approx(peak, rel=1e-4) if brightest else float(light) <= peak * (1 + 1e-4)
        )


@needs_native
@pytest.mark.parametrize("kernel", native_kernels())
@pytest.mark.parametrize(("shading", "sh_count", "channels"), SHADINGS)
def test_kernels_match_the_reference_in_float64(kernel, shading, sh_count, channels):
    single = random_gaussians(60, channels, seed=sh_count, sh_count=sh_count)
    single.log_scales += 1.0  # flat tops: hardly a pixel lies within float32 rounding of the 1/255 cutoff
    cameras = looking_at_origin(3, 48)
    single, cameras = lit(single, cameras, shading)
    single = shining(single, own_axes=shading != "normals")
    shadowed = single.shading == "lambert"
    sunlit = torch.rand(3, 60, generator=torch.Generator().manual_seed(2)) if shadowed else None
    double = dataclasses.replace(
        single, **{name: value.double() for name, value in single.parameters().items()}
    )
    exact = dataclasses.replace(
        cameras, world_to_camera=cameras.world_to_camera.double(), K=cameras.K.double()
    )
    truth, expected = outputs_and_gradients(double, exact, "reference", sunlit)
    ours, gradients = outputs_and_gradients(single, cameras, f"native-{kernel}", sunlit)
    error = (ours.radiance.double() - truth.radiance).abs()
    assert error.max() < 2e-2 and error.mean() < 1e-5
    assert {"lobes", "gloss", "means", "world_to_camera"} <= set(expected)
    for name, gradient in expected.items():
        found = gradients[name]
        assert gradient is not None and found is not None
        within = 1e-4 * float(gradient.abs().max())
        torch.testing.assert_close(found.double(), gradient, rtol=0, atol=within, msg=name)


@pytest.mark.parametrize(
    ("shading", "sh_count"), [("view", 1), ("static", 1), ("sun", 4), ("lambert", 4), ("normals", 1)]
)
def test_the_reference_gradient_matches_finite_differences(shading, sh_count):
    gaussians = random_gaussians(3, 1, seed=3, dtype=torch.float64, sh_count=sh_count)
    gaussians.log_scales += 1.5  # wide and faint: no pixel near the cutoff
    gaussians.opacity_logits = torch.full_like(gaussians.opacity_logits, 0.5)
    cameras = looking_at_origin(2, 4, dtype=torch.float64)
    gaussians, cameras = lit(gaussians, cameras, shading)
    gaussians = shining(gaussians, own_axes=shading != "normals")
    sunlit = torch.tensor([[0.2, 1.0, 0.7], [1.0, 0.4, 0.6]], dtype=torch.float64)

    def image(means, quats, lobes, gloss, pose):
        model = dataclasses.replace(gaussians, means=means, quats=quats, lobes=lobes, gloss=gloss)
        moved = dataclasses.replace(cameras, world_to_camera=pose)
        return render(model, moved, "reference", sunlit=shadows).radiance

    shadows = sunlit if gaussians.shading == "lambert" else None
    leaves = (gaussians.means, gaussians.quats, gaussians.lobes, gaussians.gloss, cameras.world_to_camera)
    assert torch.autograd.gradcheck(image, [t.clone().requires_grad_() for t in leaves], eps=1e-6, atol=1e-5)


def test_a_lobe_that_is_not_finite_leaves_the_others_as_they_are():
    gaussians, cameras = shining(random_gaussians(50)), looking_at_origin(1, 32)
    broken = dataclasses.replace(gaussians, lobes=gaussians.lobes.clone())
    broken.lobes[7, 0] = math.nan
    assert render(broken, cameras).radiance.isfinite().all()
    assert not dataclasses.replace(broken).select(torch.tensor([7])).lobes.isfinite().all()


def test_highlights_without_their_material_are_refused():
    with pytest.raises(ValueError, match=r"lobes must be \[5, 1 or 4\] with gloss \[2\], or both empty"):
        dataclasses.replace(random_gaussians(5, channels=1), lobes=torch.zeros(5, 4))


@pytest.mark.parametrize(("shading", "sh_count", "channels"), SHADINGS)
def test_a_model_survives_a_ply_and_viewers_see_its_highlights_as_harmonics(
    tmp_path, shading, sh_count, channels
):
    gaussians = shining(any_gaussians(40, sh_count, channels), own_axes=shading != "normals")
    sun = torch.tensor([0.0, 0.6, 0.8])
    if shading == "static":
        gaussians = dataclasses.replace(gaussians, static_sun=STATIC_SUN)
    else:
        gaussians = dataclasses.replace(gaussians, shading="lambert" if shading == "normals" else shading)
    save_ply(gaussians, tmp_path / "m.ply", 1.5, sun)
    again = load_ply(tmp_path / "m.ply")
    for name, value in gaussians.tensors().items():
        assert torch.equal(getattr(again, name), value), name
    torch.testing.assert_close(again.gloss, gaussians.gloss, rtol=0, atol=1e-6)
    assert torch.equal(again.static_sun, gaussians.static_sun)
    vertex = ply_by_trimesh.read(tmp_path / "m.ply")
    baked = display_sh(lit_from(gaussians, sun), 1.5)
    assert baked.shape[1] == 16
    np.testing.assert_allclose(np.asarray(vertex["f_dc_0"]), baked[:, 0, 0].numpy(), atol=1e-6)
    np.testing.assert_allclose(np.asarray(vertex["f_rest_44"]), baked[:, 15, 2].numpy(), atol=1e-6)


def test_baked_highlights_are_brighter_on_their_side_and_spz_holds_them(tmp_path):
    gaussians = shining(any_gaussians(60, 1, 1), alpha=0.5)
    gaussians = dataclasses.replace(gaussians, sh=torch.full((60, 1, 1), 1.5), lobes=gaussians.lobes * 1.0)
    axis = F.normalize(gaussians.lobes[:, :3], dim=1)
    save_spz(gaussians, tmp_path / "m.spz", 2.0)
    for model in (lit_from(gaussians, None), load_spz(tmp_path / "m.spz")):
        assert not model.has_highlights and model.sh.shape[1] == 16
        facing, away = (radiance_along(model, direction).mean() for direction in (-axis, axis))
        assert facing > 1.3 * away  # the lobes themselves are 2.9 times as bright as what is between them


@pytest.mark.parametrize(("shading", "sh_count", "channels"), SHADINGS)
def test_onnxruntime_agrees_with_our_renderer(tmp_path, shading, sh_count, channels):
    gaussians = random_gaussians(200, channels, sh_count=sh_count)
    gaussians.log_scales += 0.5
    cameras = looking_at_origin(3, 48)
    gaussians, cameras = lit(gaussians, cameras, shading)
    gaussians = dataclasses.replace(
        shining(gaussians, alpha=0.2, own_axes=shading != "normals"), footprint="camera"
    )
    export_onnx(gaussians, SENSOR, tmp_path / "m.onnx", 48, 48, [1e-4])
    session = onnxruntime.InferenceSession(str(tmp_path / "m.onnx"), providers=["CPUExecutionProvider"])
    for c in range(3):
        camera = cameras.one(c)
        ours = SENSOR.expected_dn(render(gaussians, camera).radiance[0], 1e-4) / SENSOR.white_dn
        feed = {
            "world_to_camera": camera.world_to_camera[0].numpy(),
            "K": camera.K[0].numpy(),
            "exposure_time_s": np.array(1e-4, dtype=np.float32),
        }
        feed |= {} if camera.sun_dir is None else {"sun_dir": camera.sun_dir[0].numpy()}
        image = torch.from_numpy(np.asarray(session.run(["image"], feed)[0]))
        matt = SENSOR.expected_dn(render(gaussians.matt(), camera).radiance[0], 1e-4) / SENSOR.white_dn
        assert (ours - matt).abs().max() > 0.05  # there is something to agree on
        assert -10 * math.log10(float((image - ours.clamp(0, 1)).square().mean()) + 1e-12) > 60


@pytest.fixture(scope="module")
def shiny_frames():
    return photographed(shining(target(30), alpha=0.3, peak=4.0), 90, size_px=32, focal_px=65.0)


def _trainer(frames, changes=None) -> Trainer:
    """Return a training that starts from the true shapes without their highlights."""
    trainer = Trainer(frames, SENSOR, preset("obbgs", SHINY | (changes or {})), seed=2)
    start = dataclasses.replace(target(30), footprint="camera").trainable()
    trainer.state.gaussians, trainer.state.adam, trainer.state.growth = start, Adam(start), Growth.of(30)
    return trainer


def _trained(frames, changes=None) -> Trainer:
    trainer = _trainer(frames, changes)
    while not trainer.stop_reason():
        trainer.step()
    return trainer


@pytest.fixture
def tested_early(monkeypatch):
    monkeypatch.setattr(selection, "FEWEST_STEPS", 10)


@pytest.mark.usefixtures("tested_early")
def test_highlights_are_found_and_explain_views_that_were_not_trained_on(shiny_frames, tmp_path):
    held_out, training = shiny_frames[::6], [f for i, f in enumerate(shiny_frames) if i % 6]
    shiny, matt = _trained(training), _trained(training, {"light.highlights": False})
    appearance = shiny.result("").appearance
    assert shiny.gaussians.has_highlights and "with highlights of roughness" in appearance
    assert "on frames that they are not fitted to" in appearance
    assert not matt.gaussians.has_highlights and "highlight" not in matt.result("").appearance
    errors = [_squared_error(trainer.gaussians, held_out) for trainer in (shiny, matt)]
    assert errors[0] < 0.9 * errors[1]  # 0.39 was seen
    first = _trainer(training)
    for _ in range(40):
        first.step()
    first.save(tmp_path / "c")
    resumed = Trainer(training, SENSOR, preset("obbgs", SHINY), seed=2)
    assert resumed.resume(tmp_path / "c") and resumed.state.gaussians.has_highlights
    while not resumed.stop_reason():
        resumed.step()
    for name, value in shiny.gaussians.parameters().items():
        assert torch.equal(value, getattr(resumed.gaussians, name)), name


def _squared_error(gaussians: Gaussians, frames) -> float:
    total = 0.0
    for f in frames:
        camera = Cameras(f.world_to_camera[None], f.K[None], 32, 32)
        expected = SENSOR.expected_dn(render(gaussians, camera).radiance[0], f.exposure_time_s)
        total += float((expected.clamp(max=SENSOR.white_dn) - f.dn).square().mean())
    return total


@pytest.mark.parametrize("shiny", [True, False])
def test_the_true_shapes_get_highlights_where_the_frames_show_them(shiny_frames, shiny):
    frames = shiny_frames if shiny else photographed(target(30), 90, size_px=32, focal_px=65.0)
    trainer = _trainer(frames)
    before, random = trainer.state.gaussians, trainer.state.rng.get_state()
    decide(trainer, trainer.state.highlights)
    after = trainer.state.gaussians
    assert after.has_highlights == shiny and trainer.state.highlights.reason
    assert torch.equal(
        trainer.state.rng.get_state(), random
    )  # a matt target is trained as if there were no test
    if not shiny:
        assert after is before
        return
    truth = shining(target(30))
    cosine = (F.normalize(after.lobes[:, :3], dim=1) * F.normalize(truth.lobes[:, :3], dim=1)).sum(dim=1)
    bright = after.lobes[:, 3] > -1
    # 0.91 was seen: 10 degrees lie between the axes that are tried, and what is hidden by others is guessed
    assert bright.sum() > 8 and cosine[bright].median() > 0.8


@pytest.mark.parametrize("moves", [False, True])
def test_under_a_told_sun_that_stands_still_an_axis_is_the_normal_of_a_mirror(moves):
    truth = dataclasses.replace(shining(target(30), alpha=0.3, peak=4.0), static_sun=STATIC_SUN)
    truth.lobes[:, :3] *= torch.sign(truth.lobes[:, :3] @ STATIC_SUN)[
        :, None
    ]  # others send its image nowhere
    frames = photographed(truth, 90, size_px=32, focal_px=65.0)
    other = torch.tensor([0.0, 0.6, 0.8]) if moves else STATIC_SUN
    frames = [dataclasses.replace(f, sun_dir=other if i == 50 else STATIC_SUN) for i, f in enumerate(frames)]
    trainer = _trainer(frames)
    decide(trainer, trainer.state.highlights)
    after = trainer.state.gaussians
    assert after.has_highlights
    assert (
        torch.equal(after.static_sun, STATIC_SUN[:0])
        if moves
        else torch.allclose(after.static_sun, STATIC_SUN)
    )
    if not moves:
        cosine = (F.normalize(after.lobes[:, :3], dim=1) * F.normalize(truth.lobes[:, :3], dim=1)).sum(dim=1)
        assert cosine.abs().median() > 0.8  # 0.98 was seen; a mirror has two sides
        means = torch.tensor([[0.3, 0.1, 0.0]])
        joining = first_lobes(means, frames[7], after)
        brightest = highlights_along(
            dataclasses.replace(after.select(torch.tensor([0])), means=means, lobes=joining),
            F.normalize(means - cameras_of(frames[7:8]).centres[0], dim=1),
            None,
            None,
        )
        # along the half vector, it shows its peak to the camera of the frame
        torch.testing.assert_close(brightest, 0.05 * after.gloss[1:].exp()[None])


def test_under_a_moving_sun_lobes_that_other_brackets_do_not_confirm_lie_along_the_normals():
    truth = dataclasses.replace(target(30), shading="sun", footprint="camera")
    rng = torch.Generator().manual_seed(4)
    suns = F.normalize(torch.randn(90, 3, generator=rng), dim=1)
    frames = photographed(truth, 90, size_px=32, focal_px=65.0, suns=suns)
    trainer = _trainer(frames, {"light.sun_shading": "linear"})
    trainer.state.gaussians = dataclasses.replace(trainer.state.gaussians, shading="sun").trainable()
    decide(trainer, trainer.state.highlights)
    after = trainer.state.gaussians
    assert after.lobes.shape == (30, 1) and "along the normals" in trainer.state.highlights.reason
    weights = after.lobes.detach().exp().mean()
    for _ in range(10):
        trainer.step()
    assert trainer.gaussians.lobes.exp().mean() < weights  # nothing glints here, so the prior dims them
    joining = first_lobes(torch.zeros(2, 3), frames[0], trainer.gaussians)
    assert torch.equal(joining, torch.full((2, 1), 0.05).log())


@settings(max_examples=30)
@given(st.integers(0, 10**6))
def test_a_lobe_along_the_normal_is_one_whose_axis_is_the_shortest_on_either_side(seed):
    rng = torch.Generator().manual_seed(seed)
    thin = dataclasses.replace(any_gaussians(6, 4, seed=seed), shading="sun")
    thin = shining(thin, own_axes=False)
    for side in (1.0, -1.0):
        axed = dataclasses.replace(thin, lobes=torch.cat([side * shortest_axes(thin), thin.lobes], dim=1))
        directions, sun = (F.normalize(torch.randn(n, 3, generator=rng), dim=1) for n in (6, 1))
        ours, theirs = (radiance_along(model, directions, sun[0]) for model in (thin, axed))
        torch.testing.assert_close(ours, theirs)
        assert not torch.equal(ours, radiance_along(thin.matt(), directions, sun[0]))


def test_short_trainings_do_not_test_for_highlights(shiny_frames):
    trainer = _trained(shiny_frames)
    assert not trainer.gaussians.has_highlights and not trainer.state.highlights.reason


@pytest.mark.usefixtures("tested_early")
def test_frames_that_join_bring_gaussians_with_faint_lobes(shiny_frames):
    trainer = Trainer(shiny_frames[:45], SENSOR, preset("obbgs", SHINY), seed=2)
    for _ in range(30):
        trainer.step()
    assert trainer.state.gaussians.has_highlights
    trainer.join(shiny_frames[45:])
    trainer.step()
    assert trainer.state.gaussians.lobes.shape == (len(trainer.gaussians), 4)
    assert trainer.state.gaussians.lobes.isfinite().all()


@pytest.mark.usefixtures("tested_early")
def test_highlights_that_few_frames_do_not_show_are_found_when_more_have_joined(shiny_frames):
    trainer = _trainer(shiny_frames[:6])
    for _ in range(40):
        trainer.step()
    assert not trainer.gaussians.has_highlights and trainer.state.highlights.frames == 6
    trainer.join(shiny_frames[6:8])
    trainer.step()
    assert trainer.state.highlights.frames == 6  # too few more to ask again
    trainer.join(shiny_frames[8:])
    trainer.step()
    assert trainer.state.highlights.frames == 90 and trainer.gaussians.has_highlights


def test_what_was_tried_is_not_told_as_what_the_model_has():
    """Lobes along the normals are given in its place, and nobody said what these gain."""
    told = str(Lobes(None, Evidence(torch.tensor(-0.1), 0.0, 1.0), -279.0))
    assert told.startswith("highlights along axes of their own would gain -279 nats")
