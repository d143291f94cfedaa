"""Losses and image metrics against OpenCV, scikit-image and finite differences."""

import cv2
import numpy as np
import pytest
import scipy.stats
import torch
from hypothesis import given
from hypothesis import strategies as st
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from hil.sky.sensor import converted
from obbgs_core import compiled
from obbgs_core.losses import (
    charbonnier,
    fit_figures,
    likelihood_loss,
    likelihood_loss_reference,
    published_loss,
    published_loss_reference,
    sobel,
    sobel_edge_loss,
    ssim_map,
)
from obbgs_core.score.metrics import psnr_db, ssim
from obbgs_core.sensor import Sensor

needs_native = pytest.mark.skipif(compiled._rasterizer is None, reason="the compiled module is not installed")
PLAIN = Sensor(
    black_dn=0, white_dn=1, dn_per_radiance_s=1, electrons_per_dn=1, read_noise_dn=0
)  # dn is radiance
SENSORS = {
    "black level": Sensor(
        black_dn=64, white_dn=4095, dn_per_radiance_s=2e7, electrons_per_dn=4, read_noise_dn=8
    ),
    "clipped at zero": Sensor(
        black_dn=0, white_dn=1023, dn_per_radiance_s=5e6, electrons_per_dn=2.5, read_noise_dn=12
    ),
}


@pytest.fixture(params=["compiled", "missing"])
def either_module(request, monkeypatch) -> None:
    """Run a test with the compiled module and with the readable PyTorch that stands in for it."""
    if request.param == "missing":
        monkeypatch.setattr(compiled, "_rasterizer", None)
    elif compiled._rasterizer is None:
        pytest.skip("the compiled module is not installed")


def images(seed: int, channels: int = 3, dtype=torch.float64) -> tuple[torch.Tensor, torch.Tensor]:
    rng = np.random.default_rng(seed)
    a = cv2.GaussianBlur(rng.random((48, 64, channels)), (7, 7), 2).reshape(48, 64, channels)
    b = np.clip(a + 0.05 * rng.normal(size=a.shape), 0, 1)
    return torch.tensor(a, dtype=dtype), torch.tensor(b, dtype=dtype)


def test_sobel_matches_opencv():
    image = np.random.default_rng(7).random((48, 64))
    dx, dy = sobel(torch.from_numpy(image)[None, ..., None])
    for ours, order in ((dx, (1, 0)), (dy, (0, 1))):
        expected = cv2.Sobel(image, cv2.CV_64F, *order, ksize=3)[1:-1, 1:-1]
        np.testing.assert_allclose(
            ours[0, ..., 0].numpy(), expected, atol=1e-12
        )  # the same sums in another order


def test_ssim_matches_scikit_image():
    a, b = images(1)
    expected = structural_similarity(
        a.numpy(),
        b.numpy(),
        data_range=1.0,
        channel_axis=-1,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        win_size=11,
    )
    assert ssim(a, b) == pytest.approx(expected, abs=1e-6)


def test_psnr_matches_scikit_image():
    a, b = images(2)
    assert psnr_db(a, b) == pytest.approx(
        peak_signal_noise_ratio(a.numpy(), b.numpy(), data_range=1.0), abs=1e-9
    )
    assert psnr_db(a, a) == 120


def test_gradients_match_finite_differences():
    a, b = (i[None, :13, :14, :1].contiguous() for i in images(3))
    a.requires_grad_()
    assert torch.autograd.gradcheck(lambda x: ssim_map(x, b).mean(), a)
    assert torch.autograd.gradcheck(lambda x: sobel_edge_loss(x, b), a)
    assert torch.autograd.gradcheck(lambda x: charbonnier(30 * (x - b)), a)


def test_charbonnier_is_half_the_square_for_noise_and_linear_for_outliers():
    small = torch.tensor([0.01], dtype=torch.float64)
    assert charbonnier(small).item() == pytest.approx(0.5e-4, rel=1e-4)
    assert (
        charbonnier(torch.tensor([2000.0])) / charbonnier(torch.tensor([1000.0]))
    ).item() == pytest.approx(2, rel=1e-2)


def read_out(radiance: torch.Tensor, exposures_s: torch.Tensor, sensor: Sensor, seed: int) -> torch.Tensor:
    """Return what the sensor reads of a radiance: the noise of our own model through the simulator's converter."""
    expected = sensor.expected_dn(radiance.double(), exposures_s)
    sigma_dn = (sensor.variance_dn2(expected) - 1 / 12).sqrt().numpy()  # rounding adds its own twelfth
    dn = converted(expected.numpy(), sigma_dn, sensor.white_dn, np.random.default_rng(seed))
    return torch.from_numpy(dn.astype(np.float32))


def bracket(sensor: Sensor, height: int = 47, width: int = 53, channels: int = 3, seed: int = 0):
    """Return radiance, exposures and noisy readings of three frames: a third sky, some saturated, some far off."""
    g = torch.Generator().manual_seed(seed)
    exposures_s = torch.tensor([0.5e-4, 1e-4, 2e-4]).view(-1, 1, 1, 1)
    radiance = 2.2 * torch.rand(3, height, width, channels, generator=g)
    radiance[:, : height // 3] = 0
    dn = read_out(radiance, exposures_s, sensor, seed)
    error = torch.where(torch.rand(radiance.shape, generator=g) > 0.05, 0.02, 1.0)
    return radiance * (1 + error * torch.randn(radiance.shape, generator=g)), exposures_s, dn


def value_and_gradient(loss, images: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    images = images.clone().requires_grad_()
    value = loss(images)
    value.backward()
    assert images.grad is not None
    return value.detach(), images.grad


def assert_gradients_agree(ours: torch.Tensor, truth: torch.Tensor) -> None:
    """Float32 against float64: a few roundings of the largest gradient."""
    assert (ours.double() - truth).abs().max() <= 1e-5 * truth.abs().max()


@needs_native
@pytest.mark.parametrize("sensor", SENSORS.values(), ids=SENSORS)
@pytest.mark.parametrize(("channels", "averaged_pixels"), [(1, 1), (3, 16)])
@pytest.mark.parametrize(("edge_weight", "misfit"), [(0.0, 0.0), (0.05, 0.0), (0.05, 0.2)])
def test_the_compiled_likelihood_is_the_readable_one(sensor, channels, averaged_pixels, edge_weight, misfit):
    radiance, exposures_s, dn = bracket(sensor, channels=channels)
    assert (dn == sensor.white_dn).float().mean() > 0.05 and (radiance < 0).any()
    settings = (sensor, averaged_pixels, edge_weight, misfit)
    loss, gradient = value_and_gradient(lambda r: likelihood_loss(r, exposures_s, dn, *settings)[0], radiance)
    truth, true_gradient = value_and_gradient(
        lambda r: likelihood_loss_reference(r, exposures_s.double(), dn.double(), *settings)[0],
        radiance.double(),
    )
    assert loss.item() == pytest.approx(truth.item(), rel=1e-6)
    assert_gradients_agree(gradient, true_gradient)
    halved, _ = likelihood_loss(radiance, exposures_s, dn, *settings, factor=0.5)
    assert halved.item() == pytest.approx(0.5 * loss.item(), rel=1e-6)
    residual = likelihood_loss(radiance, exposures_s, dn, *settings)[1]
    _, true_residual = likelihood_loss_reference(
        radiance.double(), exposures_s.double(), dn.double(), *settings
    )
    torch.testing.assert_close(residual.double(), true_residual, rtol=1e-5, atol=1e-4)  # 4095 DN in float32


@needs_native
def test_the_error_of_a_large_picture_is_taken_of_the_same_samples():
    sensor = SENSORS["black level"]
    radiance, exposures_s, dn = bracket(sensor, height=170, width=130)
    losses = [
        f(radiance, exposures_s, dn, sensor, misfit=0.2)[0]
        for f in (likelihood_loss, likelihood_loss_reference)
    ]
    assert losses[0].item() == pytest.approx(losses[1].item(), rel=1e-5)


@needs_native
@pytest.mark.parametrize("edge_weight", [0.0, 0.05])
@pytest.mark.parametrize("averaged_pixels", [1, 4])
def test_where_nothing_is_drawn_may_be_left_out(edge_weight, averaged_pixels):
    sensor = SENSORS["clipped at zero"]
    radiance, exposures_s, dn = bracket(sensor, channels=3)
    drawn = torch.zeros(radiance.shape[:3])
    drawn[0, 3:20, 7:19], drawn[1, 30, 52], drawn[1, 46, 0] = 0.5, 1e-6, 1.0  # nothing in the third
    settings = (sensor, averaged_pixels, edge_weight, 0.2)
    (whole, gradient), (part, of_part) = (
        value_and_gradient(lambda r, d=d: likelihood_loss(r, exposures_s, dn, *settings, d)[0], radiance)
        for d in (None, drawn)
    )
    assert torch.equal(of_part[drawn > 0], gradient[drawn > 0])  # bit for bit
    assert of_part[2].abs().max() == 0 and 0 < part < whole
    residual = likelihood_loss(radiance, exposures_s, dn, *settings, drawn)[1]
    assert torch.equal(
        residual[drawn > 0], likelihood_loss(radiance, exposures_s, dn, *settings)[1][drawn > 0]
    )
    assert residual[2].abs().max() == 0


@needs_native
def test_the_compiled_likelihood_follows_the_clipped_normal_far_below_zero():
    sensor = SENSORS["clipped at zero"]
    radiance = torch.linspace(-0.5, 0.5, 3 * 1000).view(1, 3, 1000, 1)  # -21 to 9 sigma
    exposures_s, dn = torch.full((1, 1, 1, 1), 1e-3), torch.zeros_like(radiance)
    loss, gradient = value_and_gradient(lambda r: likelihood_loss(r, exposures_s, dn, sensor)[0], radiance)
    truth, true_gradient = value_and_gradient(
        lambda r: likelihood_loss(r, exposures_s.double(), dn.double(), sensor)[0], radiance.double()
    )
    assert loss.item() == pytest.approx(truth.item(), rel=1e-6)
    assert_gradients_agree(gradient, true_gradient)


@needs_native
@pytest.mark.parametrize("weights", [(0.0, 0.0), (1.0, 0.0), (0.0, 1.0), (0.2, 0.2), (0.2, 0.2, False)])
@pytest.mark.parametrize(("height", "width", "channels"), [(95, 41, 3), (40, 64, 1), (3, 3, 1), (5, 20, 3)])
def test_the_compiled_published_loss_is_the_readable_one(weights, height, width, channels):
    g = torch.Generator().manual_seed(height)
    sensor, exposures_s = SENSORS["black level"], torch.tensor([1e-4, 4e-4]).view(-1, 1, 1, 1)
    radiance = torch.rand(2, height, width, channels, generator=g)  # half of it saturates at 0.4 ms
    dn = 64 + 4031 * torch.rand(radiance.shape, generator=g)
    ours, gradient = value_and_gradient(
        lambda r: published_loss(r, exposures_s, dn, sensor, *weights)[0], radiance
    )
    expected, true_gradient = value_and_gradient(
        lambda r: published_loss_reference(r, exposures_s.double(), dn.double(), sensor, *weights)[0],
        radiance.double(),
    )
    assert ours.item() == pytest.approx(expected.item(), rel=1e-6)
    assert_gradients_agree(gradient, true_gradient)
    _, residual = published_loss(radiance, exposures_s, dn, sensor, *weights)
    _, true_residual = published_loss_reference(radiance, exposures_s, dn, sensor, *weights)
    torch.testing.assert_close(residual, true_residual, rtol=0, atol=1e-6)


def test_the_published_loss_holds_scikit_images_ssim():
    a, b = (torch.zeros(1, 80, 96, 3) for _ in range(2))
    for padded, image in zip((a, b), images(5, dtype=torch.float32), strict=True):
        padded[0, 16:-16, 16:-16] = image  # a black border: there zero padding and reflection are the same
    expected = structural_similarity(
        a[0].double().numpy(),
        b[0].double().numpy(),
        data_range=1.0,
        channel_axis=-1,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        full=True,  # the map itself: its mean would leave the borders out
    )[-1]
    loss, _ = published_loss(a, torch.ones(1, 1, 1, 1), b, PLAIN, ssim_weight=1.0)
    assert loss.item() == pytest.approx(1 - np.mean(expected), abs=1e-6)


@needs_native
def test_losses_do_not_depend_on_the_number_of_threads(use_threads):
    sensor = SENSORS["black level"]
    radiance, exposures_s, dn = bracket(sensor, height=150)
    results = []
    for threads in (1, 2, 5):
        use_threads(threads)
        results.append(
            (
                *value_and_gradient(
                    lambda r: likelihood_loss(r, exposures_s, dn, sensor, 1, 0.1)[0], radiance
                ),
                *value_and_gradient(
                    lambda r: published_loss(r, exposures_s, dn, sensor, 0.2, 0.2)[0], radiance
                ),
            )
        )
    for other in results[1:]:
        assert all(torch.equal(ours, first) for ours, first in zip(other, results[0], strict=True))


def test_the_loss_of_a_step_is_the_mean_of_its_frames():
    sensor = SENSORS["black level"]
    radiance, exposures_s, dn = bracket(sensor)
    for loss in (likelihood_loss, published_loss):
        together, _ = loss(radiance, exposures_s, dn, sensor, 1, 0.1)
        alone = [
            loss(r[None], t[None], d[None], sensor, 1, 0.1)[0]
            for r, t, d in zip(radiance, exposures_s, dn, strict=True)
        ]
        assert together.item() == pytest.approx(torch.stack(alone).mean().item(), rel=1e-6)


def test_a_prediction_that_is_not_finite_makes_the_loss_not_finite():
    sensor = SENSORS["black level"]
    radiance, exposures_s, dn = bracket(sensor)
    for bad in (float("nan"), float("inf")):
        radiance[1, 20, 20, 0] = bad
        assert not torch.isfinite(likelihood_loss(radiance, exposures_s, dn, sensor)[0])
        assert not torch.isfinite(published_loss(radiance, exposures_s, dn, sensor)[0])


def test_images_that_do_not_match_are_refused():
    sensor = SENSORS["black level"]
    radiance, exposures_s, dn = bracket(sensor)
    for loss in (likelihood_loss, published_loss):
        with pytest.raises(ValueError, match="radiance and dn must both be"):
            loss(radiance, exposures_s, dn[:, 1:], sensor)
        with pytest.raises(ValueError, match=r"exposure_time_s must be \[3, 1, 1, 1\], got \[2, 1, 1, 1\]"):
            loss(radiance, exposures_s[:2], dn, sensor)
        with pytest.raises(ValueError, match="H, W >= 3"):
            loss(radiance[:, :2], exposures_s, dn[:, :2], sensor)


def test_the_figures_of_a_fit_are_chi2_on_the_target_and_psnr(either_module):
    sensor = SENSORS["black level"]
    radiance, exposures_s, dn = bracket(sensor, height=24, width=30)
    alpha = torch.rand(radiance.shape[:3], generator=torch.Generator().manual_seed(1)) * 0.1
    alpha[:, :10] = 0
    chi2, fit_psnr_db, misfit = fit_figures(radiance, alpha, exposures_s, dn, sensor, averaged_pixels=4)
    seen = np.minimum(64 + 2e7 * exposures_s.numpy() * radiance.numpy(), 4095) / 4095
    assert fit_psnr_db == pytest.approx(
        peak_signal_noise_ratio(dn.numpy() / 4095, seen.astype(np.float32), data_range=1.0), abs=1e-4
    )
    expected = 64 + 2e7 * (exposures_s * radiance).double().numpy()
    noise = np.maximum(expected - 64, 0) / 4 + 64 + 1 / 12
    z, step = np.linspace(-8, 8, 1601, retstep=True)
    readings = np.clip(expected[..., None] + np.sqrt(noise)[..., None] * z, 0, 4095)
    weights = step * scipy.stats.norm.pdf(z)
    mean = readings @ weights
    variance = (readings - mean[..., None]) ** 2 @ weights
    on_target = (alpha.numpy() > 0.05)[..., None] & (
        dn.numpy() < 4095
    )  # of four pixels some may be saturated
    squares = 4 * (dn.numpy() - mean) ** 2 / noise
    assert chi2 == pytest.approx(squares[on_target].sum() / (variance / noise)[on_target].sum(), rel=1e-4)
    light, of_four = expected - 64, noise / 4
    lit = (light > 2 * np.sqrt(of_four)) & (dn.numpy() < 4095)
    excess = ((expected - dn.numpy()) ** 2 - of_four)[lit].sum()
    assert misfit == pytest.approx(np.sqrt(max(excess, 0) / (light[lit] ** 2).sum()), rel=1e-3)
    no_target = fit_figures(radiance, torch.zeros_like(alpha), exposures_s, dn, sensor)
    assert np.isnan(no_target[0]) and no_target[1] == fit_psnr_db


@pytest.mark.parametrize("sensor", SENSORS.values(), ids=SENSORS)
def test_chi2_of_the_true_radiance_is_1_at_every_exposure(sensor, either_module):
    alpha = torch.ones(1, 300, 200)
    for exposure_s in (1e-5, 5e-5, 1e-4, 2e-4, 1e-3):
        exposures_s = torch.full((1, 1, 1, 1), exposure_s)
        brightest = min(2.5, 1.5 * sensor.white_dn / (sensor.dn_per_radiance_s * exposure_s))
        radiance = torch.linspace(0, brightest, 200).view(1, 1, 200, 1).repeat(1, 300, 1, 1)
        dn = read_out(radiance, exposures_s, sensor, seed=round(1e6 * exposure_s))
        chi2, *_ = fit_figures(radiance, alpha, exposures_s, dn, sensor)
        assert chi2 == pytest.approx(1, abs=0.03), exposure_s  # of 40,000 readings it deviates by 0.007


def test_a_reading_at_a_clip_has_the_probability_of_lying_beyond_it():
    sensor, time_s = SENSORS["clipped at zero"], 1e-4
    expected = np.linspace(-40, 1100, 115)
    sigma = np.sqrt(np.maximum(expected, 0) / 2.5 + 144 + 1 / 12)
    radiance = torch.tensor(expected / (5e6 * time_s))
    for dn, log_likelihood in (
        (0.0, scipy.stats.norm.logcdf((0.5 - expected) / sigma)),
        (1023.0, scipy.stats.norm.logsf((1022.5 - expected) / sigma)),
        (300.0, scipy.stats.norm.logpdf((300 - expected) / sigma) + 0.5 * np.log(2 * np.pi)),
    ):
        residual = sensor.deviance_residual(radiance, time_s, torch.full_like(radiance, dn)).numpy()
        np.testing.assert_allclose(-0.5 * residual**2, log_likelihood, rtol=1e-9, atol=1e-14)
        assert (np.sign(residual) == {0.0: 1, 1023.0: -1, 300.0: np.sign(expected - 300)}[dn]).all()


def test_a_saturated_reading_does_not_pull_a_brighter_prediction_down(either_module):
    sensor, exposures_s = SENSORS["black level"], torch.full((1, 1, 1, 1), 1e-4)
    radiance = torch.full((1, 12, 12, 1), 9.0)  # 18,064 DN
    for loss in (likelihood_loss, published_loss):
        value, gradient = value_and_gradient(
            lambda r, f=loss: f(r, exposures_s, torch.full_like(radiance, 4095.0), sensor)[0], radiance
        )
        assert value.abs() < 1e-6 and gradient.abs().max() < 1e-6


@needs_native
def test_a_row_without_clipped_readings_gives_what_it_gives_among_others():
    sensor, exposures_s = SENSORS["black level"], torch.full((1, 1, 1, 1), 1e-4)
    radiance = torch.rand(1, 6, 53, 3, generator=torch.Generator().manual_seed(3))
    dn = read_out(radiance, exposures_s, sensor, seed=3)
    assert dn.min() > 0 and dn.max() < sensor.white_dn
    clipped = dn.clone()
    clipped[0, :, 0, 0] = sensor.white_dn  # one reading of every row: the loop for clipped rows takes them
    plain, residual = likelihood_loss(radiance, exposures_s, dn, sensor)
    among, residual_among = likelihood_loss(radiance, exposures_s, clipped, sensor)
    assert torch.equal(residual[:, :, 1:], residual_among[:, :, 1:]) and plain != among
    _, gradient = value_and_gradient(lambda r: likelihood_loss(r, exposures_s, dn, sensor)[0], radiance)
    _, gradient_among = value_and_gradient(
        lambda r: likelihood_loss(r, exposures_s, clipped, sensor)[0], radiance
    )
    assert torch.equal(gradient[:, :, 1:], gradient_among[:, :, 1:])


def ends_of_a_pass(sensor: Sensor, seed: int, height: int, width: int, channels: int):
    """Yield what a frame may show at the ends of a pass: nothing, all saturated, or one pixel lit; DN [1, H, W, C]."""
    rng = np.random.default_rng(seed)
    dark = np.clip(
        np.rint(rng.normal(sensor.black_dn, sensor.read_noise_dn, (1, height, width, channels))), 0, None
    )
    one_lit = dark.copy()
    one_lit[0, rng.integers(height), rng.integers(width)] = sensor.white_dn
    for dn in (np.zeros_like(dark), dark, np.full_like(dark, sensor.white_dn), one_lit):
        yield torch.from_numpy(dn.astype(np.float32))


@given(
    st.integers(0, 10_000),
    st.sampled_from(sorted(SENSORS)),
    st.integers(3, 24),
    st.integers(3, 24),
    st.sampled_from([1, 3]),
    st.sampled_from([1, 4, 16]),
    st.sampled_from([0.0, 1e-3, 1.0, 1e4]),
)
def test_at_the_ends_of_a_pass_losses_and_their_gradients_are_finite_and_those_of_the_readable_ones(
    seed, name, height, width, channels, averaged_pixels, brightness
):
    sensor, exposures_s = SENSORS[name], torch.full((1, 1, 1, 1), 1e-4)
    light = torch.rand(1, height, width, channels, generator=torch.Generator().manual_seed(seed))
    cases = (
        (likelihood_loss, likelihood_loss_reference, (sensor, averaged_pixels)),
        (likelihood_loss, likelihood_loss_reference, (sensor, averaged_pixels, 0.05)),
        (published_loss, published_loss_reference, (sensor, 0.2, 0.2)),
    )
    for dn in ends_of_a_pass(sensor, seed, height, width, channels):
        for smooth, (ours, readable, settings) in zip((True, False, False), cases, strict=True):

            def value(radiance, loss, dn=dn, settings=settings):
                return loss(radiance, exposures_s.to(radiance), dn.to(radiance), *settings)[0]

            loss, gradient = value_and_gradient(lambda r, f=ours: value(r, f), brightness * light)
            truth, true_gradient = value_and_gradient(
                lambda r, f=readable: value(r, f), (brightness * light).double()
            )
            assert torch.isfinite(loss) and torch.isfinite(gradient).all()
            assert loss >= -1e-6  # SSIM of equal images is 1 up to rounding
            assert loss.item() == pytest.approx(truth.item(), rel=1e-5, abs=1e-6)
            if (
                smooth
            ):  # absolute values have no slope where the prediction is exactly right, as it is in the dark
                error = (gradient.double() - true_gradient).abs().max()
                assert error <= 1e-4 * true_gradient.abs().max() + 1e-12


@given(st.integers(0, 10_000), st.sampled_from(sorted(SENSORS)), st.sampled_from([1, 4]))
def test_at_the_ends_of_a_pass_a_better_prediction_has_a_smaller_loss(seed, name, averaged_pixels):
    sensor, exposures_s = SENSORS[name], torch.full((1, 1, 1, 1), 1e-4)
    full_scale = (sensor.white_dn - sensor.black_dn) / (sensor.dn_per_radiance_s * 1e-4)
    _, dark, saturated, one_lit = ends_of_a_pass(sensor, seed, 12, 15, 1)

    def likelihood(radiance: torch.Tensor, dn: torch.Tensor) -> float:
        return likelihood_loss(radiance, exposures_s, dn, sensor, averaged_pixels)[0].item()

    black, bright = torch.zeros(dark.shape), torch.full(dark.shape, 2 * full_scale)
    assert likelihood(black, dark) < likelihood(bright, dark)
    assert likelihood(bright, saturated) < likelihood(0.25 * bright, saturated) < likelihood(black, saturated)
    # a saturated reading says only "at least so much": ten times more is no worse
    assert likelihood(10 * bright, saturated) == pytest.approx(likelihood(bright, saturated), abs=1e-4)
    right = torch.where(one_lit >= sensor.white_dn, bright, black)
    assert likelihood(right, one_lit) < likelihood(black, one_lit) < likelihood(bright, one_lit)
    for dn, radiance in ((dark, black), (saturated, bright), (one_lit, right)):
        for alpha in (0.0, 1.0):  # of no target there is no chi²
            chi2, psnr_db, _ = fit_figures(radiance, torch.full(dn.shape[:3], alpha), exposures_s, dn, sensor)
            assert np.isnan(chi2) if alpha == 0 else not np.isinf(chi2)
            assert np.isfinite(psnr_db)
