"""The compiled rasterizer against the readable reference, and the reference against autograd's finite differences."""

import dataclasses

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from obbgs_core.model.cameras import Cameras
from obbgs_core.model.gaussians import Gaussians
from obbgs_core.model.rotations import multiply, quats_to_matrices
from obbgs_core.render import lit_from, native_kernels, project, render, sunlit_shares

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


def outputs_and_gradients(gaussians: Gaussians, cameras: Cameras, backend: str, sunlit=None):
    parameters = gaussians.parameters()
    if gaussians.shading != "lambert":
        parameters = {n: t for n, t in parameters.items() if n not in ("ambient", "psf_sigma_px")}
    leaves = {name: value.clone().requires_grad_() for name, value in parameters.items()}
    pose = cameras.world_to_camera.clone().requires_grad_()
    moved = dataclasses.replace(cameras, world_to_camera=pose)
    out = render(dataclasses.replace(gaussians, **leaves), moved, backend, sunlit=sunlit)
    g = torch.Generator().manual_seed(5)
    images = [out.radiance, out.alpha[..., None], out.depth[..., None]]
    loss = sum((i * torch.rand(i.shape, generator=g).to(i.dtype)).sum() for i in images)
    loss.backward()
    gradients = {
        n: t.grad for n, t in leaves.items() if t.grad is not None
    }  # not every footprint has a point spread
    return out, gradients | {"world_to_camera": pose.grad}


@needs_native
@pytest.mark.parametrize("kernel", native_kernels())
@pytest.mark.parametrize(("channels", "width", "height"), [(1, 64, 64), (3, 75, 41)])
def test_kernels_match_the_reference_in_values_and_gradients(kernel, channels, width, height):
    gaussians, cameras = random_gaussians(300, channels), looking_at_origin(2, width, height=height)
    truth, truth_gradients = outputs_and_gradients(gaussians, cameras, "reference")
    ours, our_gradients = outputs_and_gradients(gaussians, cameras, f"native-{kernel}")
    for name in ("radiance", "alpha", "depth"):
        # a contribution within rounding of the 1/255 cutoff may fall on either side: at most 4e-3 of a value there
        error = (getattr(ours, name) - getattr(truth, name)).abs()
        assert error.max() < 2e-2 and error.mean() < 1e-5, name
    assert (
        (ours.median_depth - truth.median_depth).abs() > 1e-4
    ).float().mean() < 1e-3  # T = 0.5 within rounding
    torch.testing.assert_close(ours.means2d, truth.means2d, rtol=0, atol=1e-4)
    assert ((ours.radii - truth.radii).abs() > 0).float().mean() < 1e-2  # whole pixels, rounded up
    for name, expected in truth_gradients.items():
        scale = expected.abs().max()
        # single pixels on the cutoff move a gradient by a thousandth of the largest; float32 sums by 1e-5
        assert (our_gradients[name] - expected).abs().max() < 5e-3 * scale, name
        assert (our_gradients[name] - expected).abs().mean() < 2e-4 * scale, name


@needs_native
@pytest.mark.parametrize(("sh_count", "channels"), [(1, 1), (4, 3), (9, 1), (16, 3)])
def test_native_gradients_match_the_reference_in_float64(sh_count, channels):
    double = random_gaussians(60, channels, seed=sh_count, dtype=torch.float64, sh_count=sh_count)
    double.log_scales += 1.0
    # flat tops: hardly a pixel lies within float32 rounding of the 1/255 cutoff
    single = Gaussians(**{name: value.float() for name, value in double.tensors().items()})
    double = Gaussians(**{name: value.double() for name, value in single.tensors().items()})
    cameras = looking_at_origin(3, 48)
    exact = Cameras(cameras.world_to_camera.double(), cameras.K.double(), 48, 48)
    _, expected = outputs_and_gradients(double, exact, "reference")
    _, ours = outputs_and_gradients(single, cameras, "native")
    for name, gradient in expected.items():
        torch.testing.assert_close(
            ours[name].double(), gradient, rtol=0, atol=2e-4 * float(gradient.abs().max()), msg=name
        )


def under_the_sun(gaussians: Gaussians, cameras: Cameras, shading="sun") -> tuple[Gaussians, Cameras]:
    directions = torch.randn(len(cameras), 3, generator=torch.Generator().manual_seed(9))
    suns = torch.nn.functional.normalize(directions, dim=1).to(gaussians.means)
    ambient = torch.tensor(0.3 if shading == "lambert" else 0.0).to(gaussians.means)
    lit = dataclasses.replace(gaussians, shading=shading, ambient=ambient)
    return lit, dataclasses.replace(cameras, sun_dir=suns)


@needs_native
@pytest.mark.parametrize("kernel", native_kernels())
@pytest.mark.parametrize(
    ("shading", "sh_count", "channels"),
    [("sun", 4, 1), ("sun", 4, 3), ("sun", 9, 3), ("sun", 16, 1), ("lambert", 1, 1), ("lambert", 4, 3)],
)
def test_under_the_sun_kernels_match_the_reference_in_float64(kernel, shading, sh_count, channels):
    single = random_gaussians(60, channels, seed=sh_count, sh_count=sh_count)
    single.log_scales += 1.0  # flat tops, as above
    single, cameras = under_the_sun(single, looking_at_origin(3, 48), shading)
    sunlit = torch.rand(3, 60, generator=torch.Generator().manual_seed(2))
    parameters = single.parameters().items()
    double = dataclasses.replace(single, **{name: value.double() for name, value in parameters})
    exact = dataclasses.replace(
        cameras,
        world_to_camera=cameras.world_to_camera.double(),
        K=cameras.K.double(),
        sun_dir=cameras.sun_dir.double(),
    )
    truth, expected = outputs_and_gradients(double, exact, "reference", sunlit)
    ours, gradients = outputs_and_gradients(single, cameras, f"native-{kernel}", sunlit)
    for name in ("radiance", "alpha", "depth"):
        # float32 rounding; one contribution on the 1/255 cutoff may fall on either side
        error = (getattr(ours, name).double() - getattr(truth, name)).abs()
        assert error.max() < 2e-2 and error.mean() < 1e-5, name
    for name, gradient in expected.items():
        torch.testing.assert_close(
            gradients[name].double(), gradient, rtol=0, atol=2e-4 * float(gradient.abs().max()), msg=name
        )


@pytest.mark.parametrize(("shading", "sh_count"), [("sun", 4), ("lambert", 1), ("lambert", 4)])
def test_under_the_sun_the_reference_gradient_matches_finite_differences(shading, sh_count):
    gaussians = random_gaussians(4, 1, seed=3, dtype=torch.float64, sh_count=sh_count)
    gaussians.log_scales += 1.5  # wide and faint, as above
    gaussians.opacity_logits = torch.full_like(gaussians.opacity_logits, 0.5)
    gaussians, cameras = under_the_sun(gaussians, looking_at_origin(2, 5, dtype=torch.float64), shading)
    sunlit = torch.tensor([[0.2, 1.0, 0.0, 0.7], [1.0, 0.4, 0.6, 0.0]], dtype=torch.float64)

    def image(means, quats, log_scales, opacity_logits, sh, pose, ambient):
        moved = dataclasses.replace(cameras, world_to_camera=pose)
        model = Gaussians(means, quats, log_scales, opacity_logits, sh, shading, ambient)
        out = render(model, moved, "reference", sunlit=sunlit)
        return out.radiance, out.alpha, out.depth

    leaves = (*gaussians.tensors().values(), cameras.world_to_camera, gaussians.ambient)
    leaves = [t.clone().requires_grad_() for t in leaves]
    assert torch.autograd.gradcheck(image, leaves, eps=1e-6, atol=1e-5)


@pytest.mark.parametrize("backend", ["reference", *(["native"] if native_kernels() else [])])
def test_under_one_sun_a_model_is_the_constant_one_that_it_is_baked_into(backend):
    gaussians, cameras = under_the_sun(random_gaussians(100), looking_at_origin(2, 40))
    for c in range(2):
        suns = cameras.sun_dir[c].expand(2, 3)
        lit = render(gaussians, dataclasses.replace(cameras, sun_dir=suns), backend).radiance
        baked = lit_from(gaussians, cameras.sun_dir[c])
        assert baked.sh.shape[1] == 1
        plain = dataclasses.replace(cameras, sun_dir=None)
        torch.testing.assert_close(render(baked, plain, backend).radiance, lit, rtol=0, atol=1e-5)
    with pytest.raises(ValueError, match="give sun_dir"):
        lit_from(gaussians, None)


def test_lamberts_cosine_is_what_degree_one_under_the_sun_means():
    albedo, normal = 2.0, np.array([0.0, 0.6, 0.8])
    wide = Gaussians(  # covers the whole picture, so that every pixel shows its radiance
        torch.zeros(1, 3),
        torch.tensor([[1.0, 0, 0, 0]]),
        torch.full((1, 3), 3.0),
        torch.tensor([9.0]),
        torch.zeros(1, 4, 1),
        "sun",
    )
    wide.sh[0, 1:, 0] = torch.tensor(-albedo * normal[[1, 2, 0]] / 0.4886025119029199 * [1, -1, 1])
    rng = np.random.default_rng(0)
    for sun in rng.normal(size=(20, 3)):
        sun /= np.linalg.norm(sun)
        lit = dataclasses.replace(
            looking_at_origin(1, 9), sun_dir=torch.tensor(sun, dtype=torch.float32)[None]
        )
        out = render(wide, lit)
        seen = float(out.radiance[0, 4, 4, 0] / out.alpha[0, 4, 4])
        # softplus lies above max(0, .) by at most ln 2 / 10, at the terminator
        assert -1e-4 < seen - albedo * max(0.0, float(normal @ sun)) < 0.0694


def plate(half_m: float, spacing_m: float, height_m: float = 0.0) -> Gaussians:
    """Return a square opaque plate of discs in the plane z = height_m."""
    line = torch.arange(-half_m, half_m + spacing_m / 2, spacing_m)
    x, y = torch.meshgrid(line, line, indexing="ij")
    means = torch.stack([x.flatten(), y.flatten(), torch.full((x.numel(),), height_m)], dim=1)
    log_scales = torch.tensor([0.6 * spacing_m, 0.6 * spacing_m, 1e-4]).log().expand(len(means), 3)
    quats = torch.tensor([1.0, 0, 0, 0]).expand(len(means), 4)
    return Gaussians(means, quats, log_scales, torch.full((len(means),), 6.0), torch.ones(len(means), 1, 1))


@pytest.mark.parametrize("backend", ["reference", *(["native"] if native_kernels() else [])])
def test_a_plates_shadow_on_another_lies_where_geometry_puts_it(backend):
    ground, roof = plate(1.0, 0.08), plate(0.32, 0.08, 0.8)
    both = Gaussians.concatenate([ground, roof])
    suns = torch.tensor([[0.0, 0.0, 1.0], [0.5, 0.2, 1.0], [0.1, 0.0, -1.0]])
    suns = torch.nn.functional.normalize(suns, dim=1)
    shares = sunlit_shares(both, torch.cat([suns, suns[1:2]]), backend)
    assert torch.equal(shares[1], shares[3]) and shares.shape == (4, len(both))
    for sun, share in zip(suns, shares, strict=False):
        above, other = (roof, ground) if sun[2] > 0 else (ground, roof)
        lit, shaded = (share[len(ground) :], share[: len(ground)])[:: 1 if sun[2] > 0 else -1]
        assert (lit > 0.9999).all()  # what is nearer to the Sun: no plate shades itself
        rise_m = above.means[0, 2] - other.means[0, 2]
        met = (
            other.means[:, :2] + rise_m / sun[2] * sun[:2]
        )  # where the ray to the Sun crosses the upper plate
        half_m = 0.32 if above is roof else 1.0
        inside_m = half_m - met.abs().amax(dim=1)  # of its edge
        assert (shaded[inside_m > 0.05] < 1e-4).all() and (shaded[inside_m < -0.15] > 0.9999).all()
        assert (inside_m > 0.05).sum() > 25


def test_lamberts_law_needs_the_sun():
    gaussians, cameras = under_the_sun(random_gaussians(5, sh_count=1), looking_at_origin(2, 16), "lambert")
    with pytest.raises(ValueError, match=r"give Cameras\(sun_dir"):
        render(gaussians, dataclasses.replace(cameras, sun_dir=None))
    lost = dataclasses.replace(gaussians, means=gaussians.means * torch.tensor(float("nan")))
    assert render(lost, cameras).radiance.isfinite().all()
    assert render(gaussians.select(torch.tensor([], dtype=torch.long)), cameras).radiance.sum() == 0


def test_light_on_a_plate_obeys_lamberts_law_on_both_sides():
    wall = dataclasses.replace(plate(1.0, 0.05), shading="lambert", ambient=torch.tensor(0.1))
    albedo = float(torch.nn.functional.softplus(0.28209479177387814 * 10 * torch.tensor(1.0))) / 10
    above, below = (looking_at_origin(1, 31) for _ in range(2))
    above.world_to_camera[0] = torch.tensor([[1.0, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 4], [0, 0, 0, 1]])
    below.world_to_camera[0] = torch.tensor([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 4], [0, 0, 0, 1]])
    for cosine in (1.0, 0.7, 0.3, -0.3, -1.0):
        sun = torch.tensor([[(1 - cosine**2) ** 0.5, 0.0, cosine]])
        for camera, towards in ((above, cosine), (below, -cosine)):
            out = render(wall, dataclasses.replace(camera, sun_dir=sun))
            seen = float(out.radiance[0, 15, 15, 0] / out.alpha[0, 15, 15]) / albedo - 0.1
            # softplus lies above max(0, .) by at most ln 2 / 10, at the terminator
            assert -1e-3 < seen - max(0.0, towards) < 0.006, (cosine, towards)


@pytest.mark.parametrize("backend", ["reference", *(["native"] if native_kernels() else [])])
def test_a_model_under_the_sun_needs_to_know_where_it_is(backend):
    gaussians, cameras = under_the_sun(random_gaussians(3), looking_at_origin(2, 16))
    with pytest.raises(ValueError, match=r"give Cameras\(sun_dir"):
        render(gaussians, dataclasses.replace(cameras, sun_dir=None), backend)
    with pytest.raises(ValueError, match=r"sun_dir must be \[2, 3\], got \[3\]"):
        dataclasses.replace(cameras, sun_dir=cameras.sun_dir[0])
    with pytest.raises(ValueError, match="shading must be one of view, sun, lambert, got 'moon'"):
        dataclasses.replace(gaussians, shading="moon")


@needs_native
def test_gradients_of_projected_means_reach_the_model_as_in_the_reference():
    gaussians, cameras = random_gaussians(40, 1, sh_count=1), looking_at_origin(2, 32)
    weights = torch.rand(2, 40, 2, generator=torch.Generator().manual_seed(1))
    gradients = {}
    for backend in ("native", "reference"):
        leaves = {n: t.clone().requires_grad_() for n, t in gaussians.tensors().items()}
        pose = cameras.world_to_camera.clone().requires_grad_()
        out = render(Gaussians(**leaves), Cameras(pose, cameras.K, 32, 32), backend)
        ((out.means2d * weights).sum() + out.radiance.sum()).backward()
        gradients[backend] = (leaves["means"].grad, pose.grad)
    for ours, expected in zip(gradients["native"], gradients["reference"], strict=True):
        torch.testing.assert_close(ours, expected, rtol=1e-4, atol=1e-4 * float(expected.abs().max()))


@needs_native
def test_all_kernels_agree():
    gaussians, cameras = random_gaussians(500), looking_at_origin(2, 96)
    truth, truth_gradients = outputs_and_gradients(gaussians, cameras, "native-portable")
    for kernel in native_kernels():
        out, gradients = outputs_and_gradients(gaussians, cameras, f"native-{kernel}")
        for name in ("radiance", "alpha", "median_depth"):
            assert (getattr(out, name) - getattr(truth, name)).abs().max() < 1e-5, (kernel, name)
        # the depth is a sum divided by alpha, whose rounding weighs most where alpha is small
        assert ((out.depth - truth.depth) * truth.alpha).abs().max() < 1e-5, kernel
        # float32 sums of thousands of pixels, in other orders and from places rounded otherwise
        for name, expected in truth_gradients.items():
            assert (gradients[name] - expected).abs().max() < 1e-4 * expected.abs().max(), (kernel, name)


@needs_native
def test_results_repeat_bit_for_bit_with_any_number_of_threads(use_threads):
    gaussians, cameras = random_gaussians(1500), looking_at_origin(3, 96)
    results = []
    for threads in (1, 1, 2, 5):
        use_threads(threads)
        out, gradients = outputs_and_gradients(gaussians, cameras, "native")
        results.append([out.radiance, out.depth, out.screen.means2d[2], *gradients.values()])
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))


@needs_native
@settings(max_examples=60)
@given(
    st.tuples(st.floats(-1.5, 1.5), st.floats(-1.5, 1.5), st.floats(-1.0, 1.0)),
    st.tuples(*[st.floats(-1, 1)] * 4),
    st.tuples(*[st.floats(-7, 1)] * 3),
    st.floats(-7, 9),
)
def test_one_gaussian_of_any_shape_covers_the_pixels_it_covers_in_the_reference(
    mean, quat, log_scales, logit
):
    gaussian = Gaussians(
        torch.tensor([mean]),
        torch.tensor([quat]),
        torch.tensor([log_scales]),
        torch.tensor([logit]),
        torch.full((1, 1, 1), 2.0),
    )
    cameras = looking_at_origin(1, 150, height=110)
    ours, truth = render(gaussian, cameras, "native").alpha, render(gaussian, cameras, "reference").alpha
    lost = (ours - truth).abs()
    # long thin Gaussians amplify the float32 rounding of the conic in the reference; a lost block would show as 1/255
    assert (lost > 1e-3).float().mean() <= 1e-3 and lost.mean() < 1e-4


@needs_native
@pytest.mark.parametrize("kernel", native_kernels())
@pytest.mark.parametrize("sideways_m", [0.0, 5e7, -5e7])
def test_a_gaussian_that_reaches_beyond_two_to_the_31_pixels_is_drawn_as_in_the_reference(kernel, sideways_m):
    cameras = looking_at_origin(1, 150, height=110)
    cameras.world_to_camera[0, :3, :3] = torch.eye(3)  # so that its depth is exact
    small, huge = random_gaussians(2).select(torch.tensor([0])), random_gaussians(2).select(torch.tensor([1]))
    small.log_scales += 3.0
    huge.means[0] = torch.tensor([sideways_m, 0.1, 0.2])
    huge.log_scales[:] = float(np.log(5e7))
    huge.opacity_logits[:] = 1.0
    both = Gaussians.concatenate([small, huge])
    ours, truth = render(both, cameras, f"native-{kernel}"), render(both, cameras, "reference")
    assert truth.alpha.min() > 0.2 and truth.radii[0, 1] > 2**31
    for name in ("radiance", "alpha", "depth"):
        torch.testing.assert_close(getattr(ours, name), getattr(truth, name), rtol=1e-4, atol=1e-4, msg=name)


@needs_native
def test_a_graph_can_be_differentiated_twice_but_not_after_its_model_changed():
    gaussians, cameras = random_gaussians(50, 1), looking_at_origin(1, 32)
    leaves = {n: t.clone().requires_grad_() for n, t in gaussians.tensors().items()}
    loss = render(Gaussians(**leaves), cameras, "native").radiance.sum()
    (first,) = torch.autograd.grad(loss, leaves["means"], retain_graph=True)
    (second,) = torch.autograd.grad(loss, leaves["means"], retain_graph=True)
    assert torch.equal(first, second) and first.abs().max() > 0
    with torch.no_grad():
        leaves["means"] += 1.0
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        loss.backward()


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
    gaussians, cameras = random_gaussians(12), looking_at_origin(1, 32)
    sound = outputs_and_gradients(gaussians.select(torch.arange(9, 12)), cameras, backend)
    gaussians.means[0] = cameras.centres[0]
    gaussians.means[1] = 2 * cameras.centres[0]
    gaussians.means[2] = float("nan")
    gaussians.means[3, 1] = float("inf")
    gaussians.quats[4, 2] = float("nan")
    gaussians.log_scales[5, 0] = float("nan")
    gaussians.log_scales[6] = 200.0
    gaussians.opacity_logits[7] = float("nan")
    gaussians.sh[8, 1, 0] = float("nan")
    out, gradients = outputs_and_gradients(gaussians, cameras, backend)
    assert (out.radii[0, :8] == 0).all() and (out.radii[0, 9:] > 0).all()
    for name in ("radiance", "alpha", "depth", "median_depth"):
        torch.testing.assert_close(getattr(out, name), getattr(sound[0], name), msg=name)
    for name, gradient in gradients.items():
        expected = sound[1][name]
        if name == "world_to_camera":
            torch.testing.assert_close(gradient, expected, msg=name)
        else:
            torch.testing.assert_close(gradient[9:], expected, msg=name)
            assert (gradient[:9] == 0).all(), name


@pytest.mark.parametrize("backend", ["reference", *(["native"] if native_kernels() else [])])
def test_a_zero_quaternion_is_the_identity(backend):
    gaussians, cameras = random_gaussians(3), looking_at_origin(1, 32)
    gaussians.quats[:] = 0.0
    out, gradients = outputs_and_gradients(gaussians, cameras, backend)
    gaussians.quats[:, 0] = 1.0
    torch.testing.assert_close(out.radiance, render(gaussians, cameras, backend).radiance)
    assert (gradients["quats"] == 0).all()


def test_an_empty_model_is_a_black_sky():
    out = render(random_gaussians(1).select(torch.tensor([], dtype=torch.long)), looking_at_origin(2, 16))
    assert (out.radiance == 0).all() and (out.alpha == 0).all() and (out.depth == 0).all()


@needs_native
def test_screen_gradients_equal_the_gradient_of_the_projected_means():
    gaussians, cameras = random_gaussians(50, 1), looking_at_origin(2, 32)
    leaves = {n: t.clone().requires_grad_() for n, t in gaussians.tensors().items()}
    truth = render(Gaussians(**leaves), cameras, "reference")
    truth.means2d.retain_grad()
    truth.radiance.square().sum().backward()
    ours = render(Gaussians(**leaves), cameras, "native")
    ours.radiance.square().sum().backward()
    for camera in range(2):
        expected = truth.means2d.grad[camera]
        torch.testing.assert_close(
            ours.screen.means2d[camera], expected, rtol=1e-3, atol=1e-4 * float(expected.abs().max())
        )
        assert ((ours.screen.pixels[camera] > 0) <= (ours.radii[camera] > 0)).all()


@needs_native
def test_pixels_touched_are_counted_exactly():
    gaussians, cameras = random_gaussians(1, 1, sh_count=1), looking_at_origin(1, 64)
    leaves = {n: t.clone().requires_grad_() for n, t in gaussians.tensors().items()}
    out = render(Gaussians(**leaves), cameras, "native")
    out.alpha.sum().backward()
    assert float(out.screen.pixels[0][0]) == int((out.alpha > 0).sum()) > 0


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
