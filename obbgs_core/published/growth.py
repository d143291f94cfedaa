"""How Gaussians are added and removed by published methods: 3DGS, Pixel-GS, and the filter of Jiang et al."""

import dataclasses
import math

import torch
from torch import Tensor

from obbgs_core.model.cameras import Cameras
from obbgs_core.model.gaussians import Gaussians
from obbgs_core.model.rotations import quats_to_matrices

SPLIT_SHRINK = 1.6  # the two Gaussians of a split have its deviations divided by this (Kerbl et al. 2023)
# of the method's unit of length: larger Gaussians are split, smaller ones cloned (the same)
SPLIT_SIZE = 0.01
GRADIENT_THRESHOLD = 0.0002  # mean screen gradient, per half of an image's width and height (the same)
RESET_OPACITY = 0.01  # no opacity is above this after a reset (the same)


def near_camera_weight(means: Tensor, cameras: Cameras, near_m: float) -> Tensor:
    """Return the factor [C, N] on the gradients of Gaussians nearer than `near_m` to a camera (Pixel-GS, 2024)."""
    along = cameras.world_to_camera[:, 2]
    depths_m = along[:, :3] @ means.detach().T + along[:, 3:]
    return (depths_m / near_m).clamp(0, 1) ** 2


@torch.no_grad()
def grow(
    gaussians: Gaussians,
    growing: Tensor,
    split_over_m: float,
    rng: torch.Generator,
    cloned: Tensor | None = None,
) -> tuple[Gaussians, Tensor]:
    """Return the model with the growing Gaussians [N] bool cloned (small ones) or split in two (large ones).

    Those that were not split stand first in it, unchanged; their old indices are returned too. Splitting draws two
    centres from the Gaussian itself and divides its deviations by `SPLIT_SHRINK`, as in Kerbl et al. 2023.

    Args:
        cloned: [N] bool of further Gaussians to be cloned, whatever their size.
    """
    large = gaussians.scales.max(dim=1).values > split_over_m
    cloning = growing & ~large
    clones = torch.nonzero(cloning if cloned is None else cloning | cloned)[:, 0]
    splits = torch.nonzero(growing & large)[:, 0]
    kept = torch.nonzero(~(growing & large))[:, 0]
    parts = [gaussians.select(kept), gaussians.select(clones)]
    for _ in range(2):
        half = gaussians.select(splits)
        noise = torch.randn(len(splits), 3, generator=rng) * half.scales
        half.means = half.means + (quats_to_matrices(half.quats) @ noise[..., None])[..., 0]
        half.log_scales = half.log_scales - math.log(SPLIT_SHRINK)
        parts.append(half)
    return Gaussians.concatenate(parts), kept


@torch.no_grad()
def outliers(gaussians: Gaussians, spread: float = 4.0, faint: float = 0.1) -> Tensor:
    """Return which Gaussians [N] the centre-constrained filter removes: far from the robust centre, or faint and far.

    Distance is from the median centre and limited to `spread` times the median distance. A faint Gaussian, one with
    an opacity below `faint`, is removed at half of that (Jiang et al. 2025, section 3.6).
    """
    distance = (gaussians.means - gaussians.means.median(dim=0).values).norm(dim=1)
    limit = spread * distance.median().clamp(min=1e-9)
    return (distance > limit) | ((gaussians.opacities < faint) & (distance > limit / 2))


@torch.no_grad()
def reset_opacities(gaussians: Gaussians, log_lowering: Tensor | None = None) -> Gaussians:
    """Return nearly transparent Gaussians, of which only those that are needed will become opaque again.

    Args:
        log_lowering: [N] logarithm of the factor by which opacities are lower when they are rendered; None: zeros.
    """
    if log_lowering is None:
        logits = gaussians.opacity_logits.clamp(max=math.log(RESET_OPACITY / (1 - RESET_OPACITY)))
    else:
        most = (RESET_OPACITY / log_lowering.exp()).clamp(max=1 - 1e-6)
        logits = torch.minimum(gaussians.opacity_logits, most.logit())
    return dataclasses.replace(gaussians, opacity_logits=logits)
