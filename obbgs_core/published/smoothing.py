"""The 3D smoothing filter of Mip-Splatting: no Gaussian has more detail than the pictures sample (Yu et al. 2024)."""

import dataclasses
import math

import torch
import torch.nn.functional as F
from torch import Tensor

from obbgs_core.frames import TrainingFrame, sampling_rates
from obbgs_core.model.gaussians import Gaussians

FULL_LOG_OPACITY = -1e-6  # opacities stay below 1, where the logit is infinite


@torch.no_grad()
def sampling_deviation_m(means: Tensor, frames: list[TrainingFrame], variance_px2: float) -> Tensor:
    """Return the deviation [N], m, of the filter of each Gaussian: that many pixels where it is seen largest.

    Gaussians in no view take the smallest sampling rate of all others.

    Args:
        means: [N, 3] m.
        variance_px2: of the filter, where the sampling rate is that of the pixels.
    """
    rate = sampling_rates(means, frames)
    seen = rate > 0
    if seen.any():
        rate = torch.where(seen, rate, rate[seen].min())
    return math.sqrt(variance_px2) / rate


def smoothed(gaussians: Gaussians, deviation_m: Tensor) -> Gaussians:
    """Return Gaussians convolved with round ones of deviation_m [N], their light unchanged; differentiable.

    Variances grow by the filter's, opacities fall by the root of the ratio of the determinants.
    """
    log_scales = 0.5 * torch.log((2 * gaussians.log_scales).exp() + deviation_m[:, None] ** 2)
    log_opacities = F.logsigmoid(gaussians.opacity_logits) + log_lowering(gaussians, deviation_m)
    log_opacities = log_opacities.clamp(max=FULL_LOG_OPACITY)
    logits = log_opacities - torch.log(-torch.expm1(log_opacities))
    return dataclasses.replace(gaussians, log_scales=log_scales, opacity_logits=logits)


def log_lowering(gaussians: Gaussians, deviation_m: Tensor) -> Tensor:
    """Return the logarithm [N] of the factor by which `smoothed` lowers opacities."""
    return -0.5 * torch.log1p((deviation_m[:, None] / gaussians.scales) ** 2).sum(dim=1)
