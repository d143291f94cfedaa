"""What a training step minimises: the loss of its images, and priors on the Gaussians."""

import dataclasses
from dataclasses import dataclass

import torch
from scipy.spatial import KDTree
from torch import Tensor

from obbgs_core.batches import Batch
from obbgs_core.losses import likelihood_loss, published_loss
from obbgs_core.methods.config import LossSettings, MethodConfig
from obbgs_core.model.gaussians import Gaussians
from obbgs_core.render import Rendered
from obbgs_core.render.highlights import shortest_axes
from obbgs_core.sensor import Sensor

NEIGHBOURS = 8  # of a Gaussian, whose normals are compared with its own
NEIGHBOUR_INTERVAL = 20  # steps between two searches for them
EDGE_SINE_SQUARED = 0.02  # of the angle, 8 degrees, at which the cost is half of the largest
DROPPED_UNTIL = 0.85  # share of the steps; in the rest all Gaussians settle together
MOST_OPACITY, LEAST_OPACITY = 0.999, 1e-5  # of a Gaussian in a step that drops some; the least is not drawn


def image_loss(
    rendered: Rendered,
    batch: Batch,
    sensor: Sensor,
    config: MethodConfig,
    misfit: float | None = None,
) -> tuple[Tensor, Tensor]:
    """Return the loss of a step's images and the residual [B, H, W, C], in sigmas or in full scales.

    The loss is a mean over the pixels of the whole frames, to which those outside of their windows add nothing, nor
    need those that no Gaussian reaches.

    misfit: the model's own error as far as it is known, see `likelihood_loss`.
    """
    images = (rendered.radiance, batch.exposure_time_s, batch.dn, sensor)
    published, edge_weight = config.published, config.loss.edge_weight
    if published.loss == "likelihood":
        # where colours of frames are learnt each pixel depends on them
        drawn = None if published.compensation else rendered.alpha
        known = (batch.averaged_pixels, edge_weight, misfit, drawn)
        return likelihood_loss(*images, *known, factor=batch.shown, stored=batch.stored)
    loss, residual = published_loss(*images, published.ssim_weight, edge_weight, published.clamped)
    return loss * (batch.shown * len(batch.cameras)), residual  # a sum over the step's frames, as published


def priors(
    gaussians: Gaussians,
    rendered: Rendered,
    batch: Batch,
    radius_m: float,
    settings: LossSettings,
    nearest: Tensor | None = None,
) -> Tensor:
    """Return the weighted sum of the priors on the Gaussians: matt, flat, smooth, opaque where light is seen, and not
    in front of the empty sky.

    nearest: [N, K], the neighbours of each Gaussian whose normals are compared; None: they are not.
    """
    total = torch.zeros(())
    if settings.gloss_weight and gaussians.lobes.shape[1] == 1:
        total = (
            total + settings.gloss_weight * gaussians.lobes.exp().mean() * gaussians.gloss[1:].exp().mean()
        )
    if batch.sky is not None:
        total = total + settings.sky_weight * batch.shown * (rendered.alpha * batch.sky).mean()
    if batch.solid is not None:
        through = (1 - rendered.alpha) * batch.solid
        total = total + settings.solid_weight * batch.shown * through.mean()
    if settings.flat_weight:
        total = total + settings.flat_weight * gaussians.scales.amin(dim=1).mean() / radius_m
    if nearest is not None:
        total = total + settings.normal_weight * normals_apart(gaussians, nearest)
    return total


@dataclass
class Neighbours:
    """The nearest neighbours of each Gaussian; Gaussians move slowly, so they are kept for some steps."""

    # [N, 8] indices, fewer where there are fewer Gaussians; None: not searched yet
    nearest: Tensor | None = None

    def of(self, gaussians: Gaussians, step: int) -> Tensor:
        """Return the indices [N, 8] of the Gaussians whose centres are nearest to each one's."""
        if self.nearest is None or len(self.nearest) != len(gaussians) or step % NEIGHBOUR_INTERVAL == 0:
            centres = gaussians.means.detach().nan_to_num().numpy()
            _, found = KDTree(centres).query(centres, k=min(NEIGHBOURS + 1, len(centres)))
            self.nearest = torch.from_numpy(found.reshape(len(centres), -1)[:, 1:])  # without itself
        return self.nearest


def normals_apart(gaussians: Gaussians, nearest: Tensor) -> Tensor:
    """Return how far neighbours' normals are apart, 0 to 1: the mean of s² / (s² + 0.02), s the sine of their angle.

    Under Lambert's law the brightness of a Gaussian depends on its normal, and few Suns are seen from few sides: a face
    whose Gaussians each lean a little their own way looks even under the Suns of the training and patchy under others.

    The pull is strongest at 5 degrees and falls beyond, so that edges stay. The normal is the shortest axis and has no
    sign: the two sides of a plate agree.

    Args:
        nearest: [N, K], the neighbours of each Gaussian.
    """
    if nearest.numel() == 0:
        return torch.zeros(())
    normals = shortest_axes(gaussians)
    sine_squared = 1 - (normals[:, None] * normals[nearest]).sum(dim=2).square()
    return (sine_squared / (sine_squared + EDGE_SINE_SQUARED)).mean()


def dropped(gaussians: Gaussians, rate: float, rng: torch.Generator) -> Gaussians:
    """Return Gaussians of which a share is left out at random, the others more opaque by as much; differentiable.

    Few frames are explained by many models. Those that explain them only together, one Gaussian behind the other, show
    something else from any other side. Where a Gaussian would be more than opaque, the gradient is as if it were not:
    otherwise nothing could make them fainter.

    Source: Park, Ryu and Kim, DropGaussian, 2025, where the rate grows with the steps; here it is the same throughout.
    """
    kept: Tensor = torch.rand(len(gaussians), generator=rng) >= rate
    wanted = gaussians.opacities * kept / (1 - rate)
    opacities = wanted + (wanted.clamp(LEAST_OPACITY, MOST_OPACITY) - wanted).detach()
    return dataclasses.replace(gaussians, opacity_logits=torch.logit(opacities))
