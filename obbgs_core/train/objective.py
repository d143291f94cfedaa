"""What a training step minimises: the loss of its images, and priors on the Gaussians."""

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from obbgs_core.batches import Batch
from obbgs_core.losses import likelihood_loss, published_loss
from obbgs_core.model.gaussians import Gaussians
from obbgs_core.render import Rendered
from obbgs_core.sensor import Sensor
from obbgs_core.settings import check
from obbgs_core.train.neighbours import normals_apart


@dataclass(frozen=True)
class LossSettings:
    """The loss of the images, and the weights of what is added to it."""

    # likelihood: the sensor model, saturated pixels censored
    kind: Literal["l1_ssim", "likelihood"] = "l1_ssim"
    ssim_weight: float = 0.2  # of 1 - SSIM, the rest is L1; without effect on the likelihood
    edge_weight: float = 0.0  # of the difference of Sobel derivatives
    # of l1_ssim: the prediction is clamped at full scale as the sensor clips, so that a saturated pixel does not pull
    clamped: bool = True
    # of the likelihood: the model's own error is learnt beside the noise, and what it cannot explain loses its pull
    misfit: bool = False
    # of the mean peak radiance of highlights along normals: a prior for matt surface
    gloss_weight: float = 0.0
    # of how far the normals of neighbours are apart, under Lambert's law: faces are smooth
    normal_weight: float = 0.0
    # of the mean shortest scale over the target's radius: flat Gaussians are surface
    flat_weight: float = 0.0
    sky_weight: float = 0.0  # of the mean alpha of pixels that show no light: space is empty
    # of the mean transmittance of pixels that certainly show light, where the Sun stands still and the sky is black:
    # what is dark is opaque too
    solid_weight: float = 0.0

    def __post_init__(self):
        check(self, "loss")


def image_loss(
    rendered: Rendered,
    batch: Batch,
    sensor: Sensor,
    settings: LossSettings,
    misfit: float | None = None,
    everywhere: bool = False,
) -> tuple[Tensor, Tensor]:
    """Return the loss of a step's images and the residual [B, H, W, C], in sigmas or in full scales.

    The loss is a mean over the pixels of the whole frames, to which those outside of their windows add nothing, nor
    need those that no Gaussian reaches.

    misfit: the model's own error as far as it is known, see `likelihood_loss`.
    everywhere: more than the Gaussians is learnt, and each pixel depends on it.
    """
    images = (rendered.radiance, batch.exposure_time_s, batch.dn, sensor)
    if settings.kind == "likelihood":
        drawn = None if everywhere else rendered.alpha
        known = (batch.averaged_pixels, settings.edge_weight, misfit, drawn)
        return likelihood_loss(*images, *known, factor=batch.share)
    loss, residual = published_loss(*images, settings.ssim_weight, settings.edge_weight, settings.clamped)
    return loss * (batch.share * len(batch.cameras)), residual  # a sum over the step's frames, as published


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
        total = total + settings.sky_weight * batch.share * (rendered.alpha * batch.sky).mean()
    if batch.solid is not None:
        through = (1 - rendered.alpha) * batch.solid
        total = total + settings.solid_weight * batch.share * through.mean()
    if settings.flat_weight:
        total = total + settings.flat_weight * gaussians.scales.amin(dim=1).mean() / radius_m
    if nearest is not None:
        total = total + settings.normal_weight * normals_apart(gaussians, nearest)
    return total
