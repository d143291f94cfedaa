"""Image losses: robust likelihood, L1, SSIM and Sobel edges. Images are [B, H, W, C].

`likelihood_loss`, `published_loss` and `fit_figures` run in our C++ (render/kernels) on float32 CPU tensors,
value and gradient in one sweep. The readable PyTorch beside them is the reference in tests, and runs everywhere else.
"""

import dataclasses
import math
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.autograd.function import once_differentiable

from obbgs_core import compiled
from obbgs_core.jpeg import FULL_SCALE, JpegCoding
from obbgs_core.misfit import OWN, error_of, misfit_of, model_error, sampling_stride
from obbgs_core.sensor import Sensor

SSIM_WINDOW, SSIM_SIGMA = 11, 1.5  # Wang et al. 2004
SSIM_C1, SSIM_C2 = 0.01**2, 0.03**2
ON_TARGET_ALPHA = 0.05  # pixels with more alpha than this count as target in the figures of a fit


class Fit(NamedTuple):
    """How well a step's frames fit, see `fit_figures`; NaN where nothing is seen."""

    chi2: float
    psnr_db: float
    misfit: float  # a share of the light


def likelihood_loss(
    radiance: Tensor,
    exposure_time_s: Tensor,
    dn: Tensor,
    sensor: Sensor,
    averaged_pixels: int = 1,
    edge_weight: float = 0.0,
    misfit: float | None = None,
    drawn: Tensor | None = None,
    factor: float = 1.0,
    stored: list[Tensor] | None = None,
) -> tuple[Tensor, Tensor]:
    """Return the robust negative log likelihood of readings plus weighted edges, and the normalised residual.

    Edges are compared after `Sensor.stabilised`, where noise is the same everywhere, with the prediction clamped at
    full scale.

    Args:
        radiance: predicted [B, H, W, C]; the loss has a gradient by it.
        exposure_time_s: [B, 1, 1, 1].
        dn: read [B, H, W, C].
        averaged_pixels: sensor pixels averaged into each pixel of dn; the noise is smaller by its root.
        misfit: the model's own error as a share of the light (`relative_misfit`), which no averaging makes smaller. The
            residual is then over both errors together (`model_error`), and the penalty Cauchy's: what the model cannot
            explain, such as the glint of a mirror, loses its pull. It is weighted so that what pulls on average pulls
            as before. None: only the noise is known, and the penalty is `charbonnier`.
        drawn: [B, H, W]; where it is zero the radiance depends on nothing, and no gradient is needed. Such pixels may
            be left out of the sum, though not of the number that it is divided by; their residual is then zero.
        factor: on the loss; multiplying it afterwards costs a pass over its gradient.
        stored: `JpegCoding.coefficients` of each picture, if dn was stored so; None: they are found.

    Returns:
        loss: scalar; residual: [B, H, W, C], `Sensor.deviance_residual` over its deviation, without gradient.

    Raises:
        ValueError: shapes disagree, or images are smaller than the 3x3 of an edge.
    """
    _check(radiance, exposure_time_s, dn)
    radiance, sensor = sensor.linear(radiance, exposure_time_s)
    native = None if sensor.jpeg else compiled.module_for(radiance, exposure_time_s, dn)
    if native is None:
        settings = (averaged_pixels, edge_weight, misfit, stored)
        loss, residual = likelihood_loss_reference(radiance, exposure_time_s, dn, sensor, *settings)
        return factor * loss, residual
    model, stride = _sensor_model(native, sensor, averaged_pixels), sampling_stride(radiance)
    drawn = None if drawn is None else drawn.detach().contiguous()
    settings = (model, misfit, OWN, stride, factor, edge_weight, drawn)
    return _swept(native.likelihood, radiance, exposure_time_s, dn, sensor, *settings)


def likelihood_loss_reference(
    radiance: Tensor,
    exposure_time_s: Tensor,
    dn: Tensor,
    sensor: Sensor,
    averaged_pixels: int = 1,
    edge_weight: float = 0.0,
    misfit: float | None = None,
    stored: list[Tensor] | None = None,
) -> tuple[Tensor, Tensor]:
    """Return what `likelihood_loss` does, in readable PyTorch."""
    if sensor.jpeg is not None and averaged_pixels == 1:
        stored = sensor.jpeg.stacked(dn / (sensor.white_dn / FULL_SCALE)) if stored is None else stored
        return _coded_likelihood(radiance, exposure_time_s, stored, sensor, sensor.jpeg, misfit)
    prediction = sensor.predicted(radiance, exposure_time_s, averaged_pixels)
    residual = sensor.residual_of(prediction, dn, averaged_pixels)
    if misfit is None:
        loss = charbonnier(residual)
    else:
        with torch.no_grad():
            own = model_error(radiance, exposure_time_s, sensor, averaged_pixels, misfit)
            excess = own.variance_dn2(prediction, sensor) / prediction.variance_dn2
        residual = residual / (1 + excess).sqrt()
        loss = own.weight * cauchy(residual)
    if edge_weight:
        visible = prediction.expected_dn.clamp(max=sensor.white_dn)
        loss = loss + edge_weight * sobel_edge_loss(sensor.stabilised(visible), sensor.stabilised(dn))
    return loss, residual.detach()


def _coded_likelihood(
    radiance: Tensor,
    exposure_time_s: Tensor,
    stored: list[Tensor],
    sensor: Sensor,
    coding: JpegCoding,
    misfit: float | None,
) -> tuple[Tensor, Tensor]:
    """Return the loss of readings that were stored as JPEG, and the residual of its blocks in each pixel.

    Coefficients are compared, each within its step, since what their rounding leaves in pixels is alike in all pixels
    of a block. Edges are not: rounding moves them.
    """
    prediction = dataclasses.replace(sensor, jpeg=None).predicted(radiance, exposure_time_s)
    read, variance = prediction.clipped_moments(sensor.white_dn)
    weight = 1.0
    if misfit is not None:
        with torch.no_grad():
            own = error_of(prediction, sensor, 1, misfit)
            variance, weight = variance + own.variance_dn2(prediction, sensor), own.weight
    scale_dn = sensor.white_dn / FULL_SCALE
    residuals = coding.deviance_residuals(read / scale_dn, variance / scale_dn**2, stored)
    penalty = charbonnier if misfit is None else cauchy
    shares = [penalty(of) * (of.numel() / radiance.numel()) for of in residuals]
    loss = weight * torch.stack(shares).sum()
    in_pixels = coding.in_pixels([of.detach() for of in residuals], *radiance.shape[1:3])
    return loss, in_pixels.expand_as(radiance)


def published_loss(
    radiance: Tensor,
    exposure_time_s: Tensor,
    dn: Tensor,
    sensor: Sensor,
    ssim_weight: float = 0.2,
    edge_weight: float = 0.0,
    clamped: bool = True,
) -> tuple[Tensor, Tensor]:
    """Return (1 - ssim_weight)·L1 + ssim_weight·(1 - SSIM) + edge_weight·Sobel and the residual, as in publications.

    The loss of 3DGS (Kerbl et al. 2023) with the edges of Jiang et al. 2025, each a mean over images of which 0 is
    black and 1 full scale.

    Args:
        radiance, exposure_time_s, dn: as for `likelihood_loss`.
        clamped: the prediction is clamped at full scale, as the sensor clamps the readings: a saturated reading then
            asks for no more than full scale. Otherwise it asks for exactly full scale.

    Returns:
        loss: scalar; residual: [B, H, W, C] predicted - read in full scales, without gradient.

    Raises:
        ValueError: shapes disagree, or images are smaller than the 3x3 of an edge.
    """
    _check(radiance, exposure_time_s, dn)
    radiance, sensor = sensor.linear(radiance, exposure_time_s)
    native = compiled.module_for(radiance, exposure_time_s, dn)
    if native is None:
        return published_loss_reference(
            radiance, exposure_time_s, dn, sensor, ssim_weight, edge_weight, clamped
        )
    model = _sensor_model(native, sensor)
    return _swept(
        native.published, radiance, exposure_time_s, dn, sensor, model, ssim_weight, edge_weight, clamped
    )


def published_loss_reference(
    radiance: Tensor,
    exposure_time_s: Tensor,
    dn: Tensor,
    sensor: Sensor,
    ssim_weight: float = 0.2,
    edge_weight: float = 0.0,
    clamped: bool = True,
) -> tuple[Tensor, Tensor]:
    """Return what `published_loss` does, in readable PyTorch."""
    full_scale_dn = sensor.white_dn - sensor.black_dn
    predicted = (sensor.expected_dn(radiance, exposure_time_s) - sensor.black_dn) / full_scale_dn
    if clamped:  # what is not finite stays so
        predicted = torch.where(predicted > 1, 1 + 0 * predicted, predicted)
    truth = (dn - sensor.black_dn) / full_scale_dn
    loss = (1 - ssim_weight) * (predicted - truth).abs().mean()
    if ssim_weight:
        loss = loss + ssim_weight * (1 - ssim(predicted, truth))
    if edge_weight:
        loss = loss + edge_weight * sobel_edge_loss(predicted, truth)
    return loss, (predicted - truth).detach()


@torch.no_grad()
def fit_figures(
    radiance: Tensor,
    alpha: Tensor,
    exposure_time_s: Tensor,
    dn: Tensor,
    sensor: Sensor,
    averaged_pixels: int = 1,
) -> Fit:
    """Return how well a step's frames fit: chi² on the target, PSNR, and the model's own error (`relative_misfit`).

    chi² is the squared difference of readings and their expectation over the variance that noise gives them, both
    summed where alpha [B, H, W] exceeds 0.05: 1 when the model is true, above where it errs, NaN where nothing is seen.
    Mean and variance are those of clipped readings, which vary less than others and so have less weight; a saturated
    mean of several pixels has none, since some of its pixels need not be saturated. PSNR is that of the prediction
    clamped at full scale. The other arguments are as for `likelihood_loss`.
    """
    radiance, sensor = sensor.linear(radiance, exposure_time_s)
    native = None if sensor.jpeg else compiled.module_for(radiance, alpha, exposure_time_s, dn)
    if native is not None:
        model, gains = _sensor_model(native, sensor, averaged_pixels), _gains(sensor, exposure_time_s)
        light, opaque, read = (image.detach().contiguous() for image in (radiance, alpha, dn))
        threads = compiled.threads()
        chi2, mse, misfit2 = native.fit(light, opaque, read, gains, model, ON_TARGET_ALPHA, threads)
        misfit = math.sqrt(misfit2)
    else:
        prediction = sensor.predicted(radiance, exposure_time_s, averaged_pixels)
        squares, expected = prediction.chi2_terms(dn, sensor.white_dn)
        seen = (alpha > ON_TARGET_ALPHA)[..., None] & ((averaged_pixels == 1) | (dn < sensor.white_dn))
        chi2 = (averaged_pixels * squares[seen].sum() / expected[seen].sum()).item()
        visible = prediction.expected_dn.clamp(max=sensor.white_dn)
        mse = ((visible - dn) / sensor.white_dn).square().mean().item()
        misfit = misfit_of(prediction, dn, sensor, averaged_pixels)
    return Fit(chi2, -10 * math.log10(max(mse, 1e-12)), misfit)


def charbonnier(normalised_residual: Tensor, knee: float = 2.0) -> Tensor:
    """Return the mean robust penalty: half the square well below `knee` sigma, growing by `knee` a sigma well above."""
    return (knee * knee * ((1 + (normalised_residual / knee) ** 2).sqrt() - 1)).mean()


def cauchy(normalised_residual: Tensor, tail: float = 3.0) -> Tensor:
    """Return the mean robust penalty: half the square well below `tail` sigma, growing as a logarithm well above."""
    return (0.5 * tail * tail * torch.log1p((normalised_residual / tail) ** 2)).mean()


def ssim(a: Tensor, b: Tensor) -> Tensor:
    """Return the mean structural similarity of images in 0..1, Gaussian window, zero padding as in 3DGS."""
    return ssim_map(a, b).mean()


def ssim_map(a: Tensor, b: Tensor) -> Tensor:
    """Return SSIM at each pixel [B, C, H, W]."""
    a, b = a.movedim(-1, 1), b.movedim(-1, 1)
    stack = torch.cat([a, b, a * a, b * b, a * b], dim=1)
    blurred = _gaussian_blur(stack)
    mean_a, mean_b, aa, bb, ab = blurred.chunk(5, dim=1)
    variance_a, variance_b, covariance = aa - mean_a**2, bb - mean_b**2, ab - mean_a * mean_b
    luminance = (2 * mean_a * mean_b + SSIM_C1) / (mean_a**2 + mean_b**2 + SSIM_C1)
    return luminance * (2 * covariance + SSIM_C2) / (variance_a + variance_b + SSIM_C2)


def _gaussian_blur(images: Tensor) -> Tensor:
    x = torch.arange(SSIM_WINDOW, dtype=images.dtype, device=images.device) - SSIM_WINDOW // 2
    window = torch.exp(-0.5 * (x / SSIM_SIGMA) ** 2)
    window = window / window.sum()
    flat = images.flatten(0, 1)[:, None]
    flat = F.conv2d(flat, window.view(1, 1, 1, -1), padding=(0, SSIM_WINDOW // 2))
    flat = F.conv2d(flat, window.view(1, 1, -1, 1), padding=(SSIM_WINDOW // 2, 0))
    return flat.view_as(images)


def sobel(image: Tensor) -> tuple[Tensor, Tensor]:
    """Return the 3x3 Sobel derivatives along x and y [B, H-2, W-2, C], without padding."""
    smooth_y = image[:, :-2] + 2 * image[:, 1:-1] + image[:, 2:]
    smooth_x = image[:, :, :-2] + 2 * image[:, :, 1:-1] + image[:, :, 2:]
    return smooth_y[:, :, 2:] - smooth_y[:, :, :-2], smooth_x[:, 2:] - smooth_x[:, :-2]


def sobel_edge_loss(predicted: Tensor, truth: Tensor) -> Tensor:
    """Return |Sx(predicted) - Sx(truth)| + |Sy(predicted) - Sy(truth)|, means over pixels (Jiang et al. 2025)."""
    dx, dy = sobel(predicted - truth)
    return dx.abs().mean() + dy.abs().mean()


def _check(radiance: Tensor, exposure_time_s: Tensor, dn: Tensor) -> None:
    if radiance.shape != dn.shape or radiance.ndim != 4 or min(radiance.shape[1:3]) < 3:
        raise ValueError(
            f"radiance and dn must both be [B, H, W, C] with H, W >= 3, got {list(radiance.shape)} and {list(dn.shape)}"
        )
    if exposure_time_s.shape != (len(radiance), 1, 1, 1):
        raise ValueError(
            f"exposure_time_s must be [{len(radiance)}, 1, 1, 1], got {list(exposure_time_s.shape)}"
        )


def _sensor_model(native, sensor: Sensor, averaged_pixels: int = 1):
    """Return the sensor as the compiled module takes it."""
    return native.SensorModel(
        sensor.black_dn,
        sensor.white_dn,
        sensor.electrons_per_dn,
        sensor.read_noise_dn,
        averaged_pixels,
    )


def _gains(sensor: Sensor, exposure_time_s: Tensor) -> Tensor:
    """Return the DN per radiance of each frame [B]."""
    return (sensor.dn_per_radiance_s * exposure_time_s.detach()).flatten()


def _swept(
    sweep, radiance: Tensor, exposure_time_s: Tensor, dn: Tensor, sensor: Sensor, *settings: Any
) -> tuple[Tensor, Tensor]:
    """Return a compiled loss, with its gradient if the radiance needs one, and its residual."""
    values = radiance.detach().contiguous()
    residual = torch.empty_like(values)
    gradient = torch.empty_like(values) if radiance.requires_grad else None
    gains, threads = _gains(sensor, exposure_time_s), compiled.threads()
    loss = sweep(values, dn.contiguous(), gains, *settings, residual, gradient, threads)
    if gradient is None:
        return radiance.new_tensor(loss), residual
    return _KnownGradient.apply(radiance, loss, gradient), residual


class _KnownGradient(torch.autograd.Function):
    """A scalar of the radiance that was computed together with its gradient."""

    @staticmethod
    def forward(ctx, radiance: Tensor, value: float, gradient: Tensor) -> Tensor:
        ctx.save_for_backward(gradient)
        return radiance.new_tensor(value)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grad_outputs: Tensor):  # pyright: ignore[reportIncompatibleMethodOverride]
        (gradient,) = ctx.saved_tensors
        return gradient if grad_outputs[0] == 1 else gradient * grad_outputs[0], None, None
