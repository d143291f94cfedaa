"""Model selection by the Bayesian information criterion (BIC): which Gaussians, and which degree of the harmonics.

A parameter is justified if its likelihood gain exceeds its BIC penalty. The equations are in docs/method.md.
"""

import dataclasses
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TypeVar

import torch
from torch import Tensor

from obbgs_core.batches import Batch, Batches
from obbgs_core.compiled import each
from obbgs_core.evidence import Evidence
from obbgs_core.frames import sampling_rates
from obbgs_core.model.gaussians import Gaussians
from obbgs_core.render import render, weighted_gradient
from obbgs_core.sensor import Sensor

Answer = TypeVar("Answer")
ROBUST = 3.0  # deviations that a residual counts as at most
VIEWS = 36  # training frames that are rendered at most, spread evenly; gains are scaled to all frames
# An opaque Gaussian that no picture shows on as much as a strip, one pixel wide and so many of the target's radii long,
# hides nothing that its neighbours do not hide too. Detail lies along edges: the limit grows with the target's width in
# the picture. Under Lambert's law smaller ones bring no decibels (experiment 073).
SHOWN_RADII, SHOWN_RADII_LAMBERT = 1 / 450, 1 / 150


def bic_penalty(gaussians: Gaussians, values: int) -> float:
    """Return the BIC penalty of one Gaussian, nats: half its parameters times ln(values) (Schwarz 1978).

    Args:
        values: sensor values that show the target above the noise, over all frames.
    """
    parameters = sum(tensor[0].numel() for tensor in gaussians.tensors().values()) - 1  # a quaternion has 3
    if gaussians.shading == "lambert":  # how albedos turn with the Sun corrects the light, not what is there
        parameters -= gaussians.sh[0, 1:].numel()
    return 0.5 * parameters * math.log(max(2, values))


def justified(
    gaussians: Gaussians,
    batches: Batches,
    sensor: Sensor,
    radius_m: float,
    keep_above_opacity: float,
    rng: torch.Generator,
) -> Tensor:
    """Return which Gaussians [N] gain more likelihood than their BIC penalty, or are opaque and shown by a picture.

    Args:
        radius_m: of the target.
        keep_above_opacity: how opaque the latter are: dark surface explains no light and is surface nevertheless.
    """
    evidence, shown_px = likelihood_gains(gaussians, batches, sensor, rng)
    surface = gaussians.opacities.detach() > keep_above_opacity
    least_radii = SHOWN_RADII_LAMBERT if gaussians.shading == "lambert" else SHOWN_RADII
    middle = gaussians.means.detach().median(dim=0).values
    least_px = least_radii * radius_m * sampling_rates(middle[None], batches.frames)
    return evidence.justifies | (surface & (shown_px > least_px))


def likelihood_gains(
    gaussians: Gaussians, batches: Batches, sensor: Sensor, rng: torch.Generator
) -> tuple[Evidence, Tensor]:
    """Return each Gaussian's likelihood gain with its BIC penalty, and the pixels that show it.

    The gain [N], in nats over all frames, is what the log-likelihood would lose without the Gaussian. Without Gaussian
    j the prediction changes by exactly -o_j d(prediction)/d(o_j), because compositing is linear in each opacity; at the
    optimum the log-likelihood falls by half the sum of that change squared over the noise variance. The sum of squares
    over pixels is estimated without bias by back-propagating random signs (Hutchinson 1989), one draw a frame.

    The pixels [N] are those of the picture that shows most of it: the sum of its weights there. Its weight in a pixel
    is the share of the pixel's light that is its own where all are equally bright.
    """
    model = gaussians.detach()
    model.opacity_logits.requires_grad_()
    gains, shown_px, values = torch.zeros(len(model)), torch.zeros(len(model)), 0
    times = len(batches.frames) / len(shown_frames(batches))

    def shown(view: _View) -> tuple[Tensor, Tensor]:
        (weights,) = torch.autograd.grad(view.radiance[..., 0].sum(), view.added, retain_graph=True)
        slope = weighted_gradient(view.radiance, view.weight * view.signs, model.opacity_logits)
        # o·d/do, from the derivative by the logit
        return weights[0, :, 0], slope / (1 - model.opacities.detach()).clamp(min=1e-6)

    for lit, (weights, change) in _asked(shown, model, batches, sensor, rng):
        shown_px = torch.maximum(shown_px, weights)
        gains += 0.5 * change**2
        values += lit
    return Evidence(gains * times, bic_penalty(gaussians, round(values * times))), shown_px


def next_degree_gain(
    gaussians: Gaussians, batches: Batches, sensor: Sensor, rng: torch.Generator
) -> Evidence:
    """Return the likelihood gain of the next spherical-harmonic degree with its BIC penalty, in nats.

    A score test (Rao 1948): with slope g and curvature F of the log-likelihood at zero, a coefficient gains g²/(2F).
    F is the diagonal of the Fisher information: coefficients that explain the same light are counted twice. Where the
    Sun hardly moves, its harmonics are nearly constant: the part that the constant explains is projected out.
    """
    old = gaussians.sh.shape[1]
    model = padded(gaussians.detach(), math.isqrt(old))
    model.sh.requires_grad_()
    slope, curvature, shared = (torch.zeros_like(model.sh) for _ in range(3))
    values, times = 0, len(batches.frames) / len(shown_frames(batches))

    def told(view: _View) -> tuple[Tensor, Tensor]:
        residual = view.residual(sensor).clamp(-ROBUST, ROBUST)  # as the loss is
        g = weighted_gradient(view.radiance, view.weight * residual, model.sh, keep_graph=True)
        return g, weighted_gradient(view.radiance, view.weight * view.signs, model.sh)

    for lit, (g, probe) in _asked(told, model, batches, sensor, rng):
        slope += g
        curvature += probe**2
        shared += probe * probe[:, :1]
        values += lit
    new_slope, new_curvature = slope[:, old:], curvature[:, old:]
    if model.shading == "sun":
        by_constant = shared[:, old:] / curvature[:, :1].clamp(min=1e-6)
        new_slope = new_slope - by_constant * slope[:, :1]
        new_curvature = new_curvature - by_constant * shared[:, old:]
    gain = times * (new_slope**2 / (2 * new_curvature.clamp(min=1e-6))).sum().item()
    penalty = 0.5 * new_slope.numel() * math.log(max(2, values * times))
    return Evidence(torch.tensor(gain, dtype=torch.float64), penalty)


@dataclass(frozen=True)
class _View:
    """One training frame as the model predicts it [1, H, W, C], with the random signs of Hutchinson's estimator."""

    batch: Batch
    radiance: Tensor  # with its graph
    added: Tensor  # [1, N, C] zero: light of each Gaussian on top of the model's own, to ask what shows it
    # of the radiance, in deviations of the reading; 0 where saturated, because the reading does not depend on it there
    weight: Tensor
    signs: Tensor

    def residual(self, sensor: Sensor) -> Tensor:
        """Return (read - expected) / deviation of the reading: mean 0 where the model is true."""
        batch = self.batch
        residual = sensor.normalised_residual(self.radiance.detach(), batch.exposure_time_s, batch.dn)
        return -residual * math.sqrt(batch.averaged_pixels)


def _asked(
    question: Callable[[_View], Answer],
    model: Gaussians,
    batches: Batches,
    sensor: Sensor,
    rng: torch.Generator,
) -> Iterator[tuple[int, Answer]]:
    """Ask some of the training frames, spread evenly; yield the values of each that show the target, and its answer."""

    def answered(given: tuple[Batch, Tensor]) -> tuple[int, Answer]:
        batch, signs = given
        added = torch.zeros(1, len(model), model.sh.shape[2], requires_grad=True)
        radiance = render(model, batch.cameras, added=added).radiance
        prediction = sensor.predicted(radiance.detach(), batch.exposure_time_s)
        sigma_dn = prediction.sigma_dn / math.sqrt(batch.averaged_pixels)
        dn_per_radiance = sensor.dn_per_radiance_s * batch.exposure_time_s
        weight = torch.where(batch.dn < sensor.white_dn, dn_per_radiance / sigma_dn, 0.0)
        empty_dn = sensor.expected_dn(batch.cameras.behind, batch.exposure_time_s)
        values = int(((prediction.expected_dn - empty_dn).abs() > sigma_dn).sum()) * batch.averaged_pixels
        return values, question(_View(batch, radiance, added, weight, signs))

    taken = (batches.batch([index]) for index in shown_frames(batches))
    signs = ((b, torch.randint(0, 2, b.dn.shape, generator=rng) * 2.0 - 1) for b in taken)
    yield from each(answered, signs)


def shown_frames(batches: Batches, most: int = VIEWS) -> range:
    """Return the indices of the frames that are rendered, spread evenly over time and over the exposure times.

    Exposure times come in turns: a stride that shares a factor with their number would meet only some of them.
    """
    exposures = len({frame.exposure_time_s for frame in batches.frames})
    stride = max(1, math.ceil(len(batches.frames) / most))
    while math.gcd(stride, exposures) > 1:
        stride += 1
    return range(0, len(batches.frames), stride)


def padded(gaussians: Gaussians, degree: int) -> Gaussians:
    """Return the same Gaussians with room for spherical harmonics up to `degree`, the new ones zero."""
    return dataclasses.replace(gaussians, sh=padded_to(gaussians.sh, (degree + 1) ** 2))


def padded_to(coefficients: Tensor, count: int) -> Tensor:
    """Return coefficients [N, count, C] that begin with the given ones [N, K, C]; the others are zero."""
    room = coefficients.new_zeros(len(coefficients), count - coefficients.shape[1], coefficients.shape[2])
    return torch.cat([coefficients, room], dim=1)
