"""Chooses by withheld views whether the target has highlights, and where each Gaussian's lobe points at first.

Each view says with which radiance it sees a Gaussian: compositing is linear in the radiances, and where all that a
pixel shows changes alike, the log-likelihood is a parabola in the change. A lobe is then a curve through these points,
and the best of many axes is found without rendering again. The equations are in docs/method.md.
"""

import dataclasses
import math
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from obbgs_core.batches import Batch, Batches
from obbgs_core.compiled import each
from obbgs_core.evidence import Evidence
from obbgs_core.evidence.gains import shown_frames
from obbgs_core.frames import TrainingFrame, bracket_numbers, cameras_of
from obbgs_core.misfit import mean_light2
from obbgs_core.model.cameras import stacked_suns
from obbgs_core.model.gaussians import Gaussians
from obbgs_core.model.sh import from_radiance, radiance
from obbgs_core.render import render, weighted_gradient
from obbgs_core.render.highlights import brightest_axes, lobe
from obbgs_core.render.shadows import Shadows
from obbgs_core.sensor import Sensor

VIEWS = 120  # training frames that are rendered, spread evenly: few of them show the glint of one Gaussian
# Gaussians that decide, spread evenly: first so many, and more where those gain on average
SAMPLES = (192, 768)
ALPHAS, SHARP_ALPHAS = (0.2, 0.4), (0.12,)  # roughness of GGX that is tried; the latter where the Sun moves
STRENGTHS = (1.0, 2.0, 4.0, 8.0, 16.0)  # of a lobe's peak over the mean radiance: tried
AXES = 250  # directions that a lobe is tried in, 13 degrees apart
LEAST_GAIN = 3.0  # nats: a Gaussian whose lobe gains less starts with the weight FAINT
FAINT = 0.05
# of lobes along normals at first: roughness; peak over the mean radiance
NORMAL_ALPHA, NORMAL_STRENGTH = 0.2, 8.0
SURE = 2.0  # standard errors by which the root of the gain on the other half must exceed zero on average
STILL_DEG = 5.0  # a Sun that is known and never further than this from its mean direction stands still
AT_ONCE = 16  # Gaussians whose axes are searched together: the cache holds their shares


@dataclass(frozen=True)
class Lobes:
    """What highlights a training starts with, and what they gain.

    gaussians: with a lobe each; None where the evidence does not justify them.
    evidence: the mean of the gains' signed square roots, on frames that the lobes are not fitted to.
    nats: the gain over all frames.
    """

    gaussians: Gaussians | None
    evidence: Evidence
    nats: float

    def __str__(self) -> str:
        errors = self.evidence.gain / self.evidence.error * SURE
        return (
            f"highlights along axes of their own would gain {self.nats:,.0f} nats on frames that they are not fitted "
            f"to, with {errors:.1f} standard errors"
        )


@dataclass(frozen=True)
class _Seen:
    """What V views say of a change of the radiance of N Gaussians."""

    slope: Tensor  # [N, V, C] derivative of the log-likelihood by it
    information: Tensor  # [N, V, C] the parabola's curvature, if all that a pixel shows changes alike
    axes: Tensor  # [N, V, 3] unit, of a lobe that is seen at its brightest
    sunlit: Tensor  # [N, V] share of the Sun that reaches it, where the model knows it; else 1
    half_vector: bool  # whether these axes are half vectors
    static_sun: Tensor  # [3], or [0], as in `Gaussians`

    def of(self, gaussians: Tensor, views: Tensor) -> "_Seen":
        """Return a part of it; indices or masks."""
        parts = (self.slope, self.information, self.axes, self.sunlit)
        slope, information, axes, sunlit = (part[gaussians][:, views] for part in parts)
        return _Seen(slope, information, axes, sunlit, self.half_vector, self.static_sun)

    def shares(self, axes: Tensor, alpha: float) -> Tensor:
        """Return the share of its peak [N, V, M] at which a lobe along each of some axes [M, 3] is seen."""
        return lobe(self.axes @ axes.T, torch.tensor(alpha), self.half_vector) * self.sunlit[..., None]

    def parabolas(self, shares: Tensor) -> tuple[Tensor, Tensor]:
        """Return slope and curvature [N, M] by a lobe's strength, grey, with the best constant beside each strength."""
        slope, information = self.slope.sum(-1), self.information.sum(-1)
        with_constant = torch.einsum("nv,nvm->nm", information, shares)
        by_constant = with_constant / information.sum(1, keepdim=True).clamp(min=1e-12)
        slopes = torch.einsum("nv,nvm->nm", slope, shares) - by_constant * slope.sum(1, keepdim=True)
        curvatures = torch.einsum("nv,nvm->nm", information, shares.square()) - by_constant * with_constant
        return slopes, curvatures


def lobed(
    gaussians: Gaussians,
    batches: Batches,
    sensor: Sensor,
    misfit: float | None,
    shadows: Shadows,
    step: int,
) -> Lobes:
    """Return the Gaussians with a lobe each, if frames that the lobes were not fitted to are explained better by them.

    Where the Sun stands still every second frame is one half: frames of a bracket show the same view, which makes the
    test lenient. Where it moves it is every second bracket, so that lobes are not judged by the view and the Sun that
    they were fitted to (experiment 057). For each roughness and strength, the axes
    that gain most on one half are scored on the other; what surely gains most there is chosen for all Gaussians and
    fitted to all frames. Nothing is random.

    Args:
        misfit: the model's own error, see `likelihood_loss`.
        shadows: of the model at this step.
    """
    model = gaussians.detach()
    seen = _seen(model, batches, sensor, misfit, shadows, step)
    unit = radiance(model.sh[:, :1], torch.zeros_like(model.means)).mean().item()
    axes = _sphere(AXES)
    moves = model.shading != "view"
    alphas, first = SHARP_ALPHAS if moves else ALPHAS, _first_half(batches, moves)
    evidence, best, nats = Evidence(torch.zeros(())), 0, 0.0
    for count in SAMPLES:
        sample = torch.arange(0, len(model), max(1, len(model) // count))
        # [alphas * strengths, sample]
        gains = _gains_on_other_half(seen, first, sample, axes, alphas, unit).flatten(0, 1)
        # roots: a few lobes that are far off in a view would outweigh all the others by their squares
        roots = gains.sign() * gains.abs().sqrt()
        means, errors = roots.mean(dim=1), roots.std(dim=1, correction=0) / math.sqrt(len(sample))
        best = int((means - SURE * errors).argmax())
        evidence = Evidence(means[best], error=SURE * max(errors[best].item(), 1e-12))
        nats = gains[best].sum().item() * len(model) / len(sample) * len(batches.frames) / seen.slope.shape[1]
        if evidence.gain <= 0:
            break
    if not evidence.justifies:
        return Lobes(None, evidence, nats)
    alpha, strength = alphas[best // len(STRENGTHS)], STRENGTHS[best % len(STRENGTHS)] * unit
    return Lobes(_with_lobes(model, seen, axes, alpha, strength), evidence, nats)


def along_normals(gaussians: Gaussians) -> Gaussians:
    """Return the Gaussians with a faint lobe each, along its normal; the training finds how bright it is.

    A lobe with an axis of its own can explain what else is special about the few frames that show it. One along the
    normal has to agree with the shading of all the others (experiment 057).
    """
    means = gaussians.means.detach()
    unit = radiance(gaussians.sh.detach()[:, :1], torch.zeros_like(means)).mean().item()
    gloss = torch.tensor([NORMAL_ALPHA, *[NORMAL_STRENGTH * unit] * gaussians.sh.shape[2]]).log()
    return dataclasses.replace(
        gaussians, lobes=torch.full((len(means), 1), math.log(FAINT)), gloss=gloss, static_sun=torch.zeros(0)
    )


def _first_half(batches: Batches, by_bracket: bool) -> Tensor:
    """Return which of the frames that are rendered [V] are the first half."""
    shown = shown_frames(batches, VIEWS)
    if not by_bracket:
        return torch.arange(len(shown)) % 2 == 0
    numbers = bracket_numbers(batches.frames)
    return torch.tensor([numbers[index] % 2 == 0 for index in shown])


def _gains_on_other_half(
    seen: _Seen, first: Tensor, sample: Tensor, axes: Tensor, alphas: tuple[float, ...], unit: float
) -> Tensor:
    """Return what lobes fitted to one half of the views gain on the other [alphas, strengths, sample], nats.

    Args:
        first: [V] bool, which views are the first half.
    """
    return torch.cat(
        [_gains_of_few(seen, first, few, axes, alphas, unit) for few in sample.split(AT_ONCE)], dim=2
    )


def _gains_of_few(
    seen: _Seen, first: Tensor, few: Tensor, axes: Tensor, alphas: tuple[float, ...], unit: float
) -> Tensor:
    """Return what `_gains_on_other_half` does, for so few Gaussians that the processor's cache holds their shares."""
    gains = torch.zeros(len(alphas), len(STRENGTHS), len(few))
    halves = [seen.of(few, views) for views in (first, ~first)]
    for a, alpha in enumerate(alphas):
        parabolas = [half.parabolas(half.shares(axes, alpha)) for half in halves]
        for (slope, curvature), (slope_there, curvature_there) in (parabolas, parabolas[::-1]):
            for k, strength in enumerate(STRENGTHS):
                s = strength * unit
                here, at = (s * slope - 0.5 * s * s * curvature).max(dim=1)
                there = (s * slope_there - 0.5 * s * s * curvature_there).gather(1, at[:, None])[:, 0]
                gains[a, k] += torch.where(here > LEAST_GAIN, there, 0.0)
    return gains


def _with_lobes(model: Gaussians, seen: _Seen, axes: Tensor, alpha: float, strength: float) -> Gaussians:
    """Return the model with the best of some axes for each Gaussian, and with the colours that then fit best."""
    every, found, gained = torch.ones(seen.slope.shape[1], dtype=torch.bool), [], []
    for part in torch.arange(len(model)).split(AT_ONCE):
        views = seen.of(part, every)
        slope, curvature = views.parabolas(views.shares(axes, alpha))
        gain, at = (strength * slope - 0.5 * strength**2 * curvature).max(dim=1)
        found.append(axes[at])
        gained.append(gain)
    axis, bright = torch.cat(found), torch.cat(gained) > LEAST_GAIN
    weight = torch.where(bright, 1.0, FAINT)
    cosine = (seen.axes * axis[:, None]).sum(dim=-1)
    share = (lobe(cosine, torch.tensor(alpha), seen.half_vector) * seen.sunlit * bright[:, None])[..., None]
    information = seen.information.sum(1).clamp(min=1e-12)  # [N, C]
    with_constant, slope = (seen.information * share).sum(1), seen.slope.sum(1)
    up = (seen.slope * share).sum((0, 1)) - (with_constant / information * slope).sum(0)
    down = (seen.information * share.square()).sum((0, 1)) - (with_constant.square() / information).sum(0)
    strengths = (up / down.clamp(min=1e-12)).clamp(0.1 * strength, 10 * strength)  # [C]
    before = radiance(model.sh[:, :1], torch.zeros_like(model.means))
    # the ridge keeps what hardly any view sees
    change = (slope - with_constant * strengths) / (information + information.mean())
    sh = model.sh.clone()
    sh[:, 0] = from_radiance((before + change).clamp(min=0.02 * before.mean()))
    lobes = torch.cat([axis, weight.log()[:, None]], dim=1)
    gloss = torch.cat([torch.tensor([alpha]), strengths]).log()
    return dataclasses.replace(model, sh=sh, lobes=lobes, gloss=gloss, static_sun=seen.static_sun)


def _seen(
    model: Gaussians,
    batches: Batches,
    sensor: Sensor,
    misfit: float | None,
    shadows: Shadows,
    step: int,
) -> _Seen:
    """Return what some of the training frames say of the Gaussians, in both errors, the model's and the noise."""
    static_sun = _static_sun(batches.frames) if model.shading == "view" else None

    def said(given: tuple[Batch, Tensor | None]) -> tuple[Tensor, ...]:
        batch, sunlit = given
        added = torch.zeros(1, len(model), model.sh.shape[2], requires_grad=True)
        rendered = render(model, batch.cameras, sunlit=sunlit, added=added)
        prediction = sensor.predicted(rendered.radiance.detach(), batch.exposure_time_s)
        variance = prediction.variance_dn2 / batch.averaged_pixels
        if misfit is not None:
            # everywhere the same: a highlight where there is none is as wrong as none where there is one
            variance = variance + misfit**2 * mean_light2(prediction, sensor, batch.averaged_pixels)
        gain = sensor.dn_per_radiance_s * batch.exposure_time_s.reshape(-1, 1, 1, 1)
        expected = prediction.expected_dn
        known = (batch.dn < sensor.white_dn) | (expected < sensor.white_dn)  # saturated: at least this much
        weight = known * gain / variance
        image = rendered.radiance
        slope = weighted_gradient(image, weight * (batch.dn - expected), added, keep_graph=True)
        alike = weight * gain * rendered.alpha.detach()[..., None]
        information = weighted_gradient(image, alike, added)
        lit = torch.ones(len(model)) if sunlit is None else sunlit[0].to(slope)
        directions = F.normalize(model.means - batch.cameras.centres[0], dim=1)
        sun = static_sun if model.shading == "view" else batch.cameras.known_suns()[0]
        return slope[0], information[0], brightest_axes(directions, sun), lit

    taken = (batches.batch([index]) for index in shown_frames(batches, VIEWS))
    found = zip(*each(said, ((b, shadows.sunlit(model, b.cameras, step)) for b in taken)), strict=True)
    slope, information, axes, sunlit = (torch.stack(values, dim=1) for values in found)
    known = model.shading != "view" or static_sun is not None
    return _Seen(
        slope, information, axes, sunlit, known, torch.zeros(0) if static_sun is None else static_sun
    )


def _static_sun(frames: list[TrainingFrame]) -> Tensor | None:
    """Return the direction [3] towards a Sun that stands still in the body frame; None if it moves or is not known."""
    directions = stacked_suns([frame.sun_dir for frame in frames])
    if directions is None:
        return None
    mean = F.normalize(directions.mean(dim=0), dim=0)
    return mean if (directions @ mean).min() > math.cos(math.radians(STILL_DEG)) else None


def first_lobes(means: Tensor, frame: TrainingFrame, model: Gaussians) -> Tensor:
    """Return faint lobes [N, 1 or 4] for Gaussians that join a model; those with axes are brightest in a frame."""
    weights = torch.full((len(means), 1), math.log(FAINT))
    if model.lobes.shape[1] == 1:
        return weights
    sun = frame.sun_dir if model.shading != "view" else model.static_sun
    directions = F.normalize(means - cameras_of([frame]).centres[0], dim=1)
    return torch.cat(
        [brightest_axes(directions, None if sun is None or not len(sun) else sun), weights], dim=1
    )


def _sphere(count: int) -> Tensor:
    """Return unit vectors [count, 3] spread over the sphere (Fibonacci lattice)."""
    place = torch.arange(count) + 0.5
    z, angle = 1 - 2 * place / count, math.pi * (1 + math.sqrt(5)) * place
    across = (1 - z * z).sqrt()
    return torch.stack([across * angle.cos(), across * angle.sin(), z], dim=1)
