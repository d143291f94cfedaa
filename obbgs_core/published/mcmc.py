"""Growth as sampling: Gaussians that have faded are moved to others, and all are shaken (3DGS-MCMC).

Source: Kheradmand et al., 3D Gaussian Splatting as Markov Chain Monte Carlo, 2024, and the authors' code.
"""

import math

import torch
from torch import Tensor

from obbgs_core.model.gaussians import Gaussians
from obbgs_core.model.rotations import quats_to_matrices

DEAD_OPACITY = 0.005  # Gaussians that are fainter are moved
GROWTH = 1.05  # times as many after each time, up to the budget
MOST_COPIES = 51  # of one Gaussian at a time
NOISE_RATE = 5e5  # over the rate of the means
STEEPNESS = 100.0  # of the sigmoid of the opacity by which opaque Gaussians stay where they are
WEIGHT = 0.01  # of the mean opacity and of the mean deviation, m, in the loss


@torch.no_grad()
def relocated(gaussians: Gaussians, most: int, rng: torch.Generator) -> tuple[Gaussians, Tensor]:
    """Return the model with its dead Gaussians moved to living ones, and some more, and the indices of those that stay.

    Those that stay as they are stand first. Places are drawn by opacity; the copies at one place together look like the
    one that was there.

    Args:
        most: the largest number of Gaussians.
    """
    opacities = gaussians.opacities
    alive = torch.nonzero(opacities > DEAD_OPACITY)[:, 0]
    if len(alive) == 0:
        return gaussians, torch.arange(len(gaussians))
    wanted = max(len(gaussians), min(most, int(GROWTH * len(gaussians))))
    drawn = torch.multinomial(opacities[alive], wanted - len(alive), replacement=True, generator=rng)
    copies = 1 + torch.bincount(drawn, minlength=len(alive))
    copies = copies.clamp(max=MOST_COPIES)
    kept, sources = alive[copies == 1], alive[copies > 1]
    number = copies[copies > 1]
    parts = gaussians.select(sources)
    opacity, shrink = shared(opacities[sources], number)
    parts.opacity_logits = opacity.clamp(DEAD_OPACITY, 1 - 1e-6).logit()
    parts.log_scales = parts.log_scales + shrink.log()[:, None]
    return Gaussians.concatenate([gaussians.select(kept), parts.select(_repeated(number))]), kept


def shared(opacities: Tensor, copies: Tensor) -> tuple[Tensor, Tensor]:
    """Return the opacity [N] of each of some copies [N] of Gaussians, and the factor [N] on their deviations.

    Together the copies let through as much light in their middle as the one, and cover as much area.
    """
    each = 1 - (1 - opacities.double()) ** (1 / copies.double())
    total = torch.zeros_like(each)
    for i in range(1, int(copies.max()) + 1):
        term = sum(math.comb(i - 1, k) * (-1) ** k * each ** (k + 1) / math.sqrt(k + 1) for k in range(i))
        total += torch.where(copies >= i, term, 0)
    return each.float(), (opacities.double() / total).float()


@torch.no_grad()
def shake(gaussians: Gaussians, rate_m: float | Tensor, rng: torch.Generator) -> None:
    """Move the means at random, within each Gaussian's shape, the more the fainter it is.

    Args:
        rate_m: of the means in this step, m.
    """
    axes = quats_to_matrices(gaussians.quats) * gaussians.scales[:, None]
    loose = torch.sigmoid(STEEPNESS * (DEAD_OPACITY - gaussians.opacities))[:, None]
    noise = torch.randn(gaussians.means.shape, generator=rng) * loose * NOISE_RATE * rate_m
    gaussians.means.detach().add_((axes @ (axes.transpose(1, 2) @ noise[..., None]))[..., 0])


def sparsity(gaussians: Gaussians) -> Tensor:
    """Return what is added to the loss so that Gaussians fade and shrink where nothing needs them."""
    return WEIGHT * (gaussians.opacities.mean() + gaussians.scales.mean())


def _repeated(number: Tensor) -> Tensor:
    return torch.repeat_interleave(torch.arange(len(number)), number)
