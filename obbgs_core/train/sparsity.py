"""What few frames need: Gaussians that do not lean on each other, and space that counts as empty more strongly.

Few frames are explained by many models. Those that explain them only together, one Gaussian behind the other, show
something else from any other side.
"""

import dataclasses
from dataclasses import dataclass

import torch
from torch import Tensor

from obbgs_core.model.gaussians import Gaussians
from obbgs_core.settings import check, fraction

FEW, MANY = 12, 48  # frames: up to the first everything below holds in full, from the second on nothing
# of the harmonics, at most, where frames are fewer than `MANY`: few views leave higher ones open
FEW_SH_DEGREE = 1
DROPPED_UNTIL = 0.85  # share of the steps; in the rest all Gaussians settle together
MOST_OPACITY, LEAST_OPACITY = 0.999, 1e-5  # of a Gaussian in a step; the least is not drawn


@dataclass(frozen=True)
class SparseSettings:
    """What takes the place of other settings where frames are few, if it is more; between `FEW` and `MANY` a share."""

    dropout: float = fraction(0.0)  # of the method's `dropout`
    sky_weight: float = 0.0  # of `loss.sky_weight`

    def __post_init__(self):
        check(self, "sparse")


def few_share(frames: int) -> float:
    """Return how far so many frames are few: 1 up to `FEW`, falling to 0 at `MANY`."""
    return min(1.0, max(0.0, (MANY - frames) / (MANY - FEW)))


def dropped(gaussians: Gaussians, rate: float, rng: torch.Generator) -> Gaussians:
    """Return Gaussians of which a share is left out at random, the others more opaque by as much; differentiable.

    Where that would be more than opaque, the gradient is as if it were not: otherwise nothing could make them fainter.

    Source: Park, Ryu and Kim, DropGaussian, 2025, where the rate grows with the steps; here it is the same throughout.
    """
    kept: Tensor = torch.rand(len(gaussians), generator=rng) >= rate
    wanted = gaussians.opacities * kept / (1 - rate)
    opacities = wanted + (wanted.clamp(LEAST_OPACITY, MOST_OPACITY) - wanted).detach()
    return dataclasses.replace(gaussians, opacity_logits=torch.logit(opacities))
