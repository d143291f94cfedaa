"""Adam over the Gaussians' parameters, and the learning rate of each parameter over the training."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from obbgs_core import compiled
from obbgs_core.model.gaussians import LOBES, TENSORS, Gaussians
from obbgs_core.settings import check, number

FIRST_MEMORY, SECOND_MEMORY = 0.9, 0.999  # shares of the moments that a step keeps (Kingma and Ba 2015)
OPACITY_RATE = 0.05  # of opacity logits a step (Kerbl et al. 2023)
AXIS_RATE = 0.01  # of the axes of highlights a step
WEIGHT_RATE = 0.03  # of the logarithms of their weights a step
GLOSS_RATE = 0.01  # of the logarithms of roughness and peak radiance a step
PSF_RATE = 0.002  # of the point spread a step, in pixels of the sensor
AMBIENT_RATE = 0.001  # of the ambient light a step, in units of the Sun's


@dataclass(frozen=True)
class RateSettings:
    """Learning rates a step, of the means in the method's unit of length and of `sh` in its unit of radiance."""

    means: float = 1.6e-4  # at the first step
    means_end: float = 1.6e-6  # at the last step, with exponential decay between them
    quats: float = 0.001
    log_scales: float = 0.005
    sh: float = 0.0025
    sh_rest: float = 1.0  # factor on the rate of the coefficients above degree 0
    # all rates but that of the means decay exponentially to this share of themselves
    final_share: float = 1.0
    # Share of the second moments that a step keeps: the smaller it is, the sooner steps follow gradients that shrink.
    # Where the Sun or the poses may move, the default is taken instead: a step that has forgotten the gradients of
    # another Sun is too large for it, and refined poses lose accuracy.
    second_memory: float = number(SECOND_MEMORY, most=0.9999)

    def __post_init__(self):
        check(self, "rates")


def learning_rates(
    rates: RateSettings,
    share: float,
    unit_m: float,
    coefficients: int,
    radiance_unit: float = 1.0,
    lobe: int = LOBES[-1],
) -> dict[str, float | Tensor]:
    """Return each parameter's rate after a share of the steps: of `sh` [1, K, 1] if they differ, of `lobes` [1, lobe].

    Args:
        unit_m: the method's unit of length.
        coefficients: K, of the radiance.
        radiance_unit: the method's unit of radiance.
        lobe: numbers of a Gaussian's lobe.
    """
    decay = rates.final_share**share
    sh: float | Tensor = rates.sh * decay * radiance_unit
    if rates.sh_rest != 1 and coefficients > 1:
        factors = torch.full((1, coefficients, 1), rates.sh_rest)
        factors[:, 0] = 1
        sh = sh * factors
    return {
        "means": rates.means ** (1 - share) * rates.means_end**share * unit_m,
        "quats": rates.quats * decay,
        "log_scales": rates.log_scales * decay,
        "opacity_logits": OPACITY_RATE * decay,
        "sh": sh,
        "lobes": torch.tensor([[AXIS_RATE, AXIS_RATE, AXIS_RATE, WEIGHT_RATE][-lobe:]]) * decay,
        "gloss": GLOSS_RATE * decay,
        "ambient": AMBIENT_RATE * decay,
        "psf_sigma_px": PSF_RATE * decay,
    }


class Adam:
    """Adam (Kingma and Ba 2015) whose moments follow the Gaussians when they are split or removed."""

    def __init__(
        self,
        gaussians: Gaussians,
        betas: tuple[float, float] = (FIRST_MEMORY, SECOND_MEMORY),
        eps: float = 1e-15,
    ):
        self.betas, self.eps, self.steps = betas, eps, 0
        self.first = {name: torch.zeros_like(t) for name, t in gaussians.parameters().items()}
        self.second = {name: torch.zeros_like(t) for name, t in gaussians.parameters().items()}

    @torch.no_grad()
    def step(self, gaussians: Gaussians, rates: dict[str, float | Tensor]) -> None:
        """Move every parameter that has a gradient, and drop the gradients; a rate may differ within a parameter."""
        self.steps += 1
        b1, b2 = self.betas
        correction = math.sqrt(1 - b2**self.steps) / (1 - b1**self.steps)
        for name, parameter in gaussians.parameters().items():
            if parameter.grad is None:
                continue
            values, gradient = parameter.detach(), parameter.grad.contiguous()
            rate = torch.as_tensor(rates[name] * correction, dtype=values.dtype)
            first, second = self.first[name], self.second[name]
            native = compiled.module_for(values)
            if native is not None:  # the same in one pass over memory
                if rate.ndim:  # one for each number of a Gaussian
                    rate = rate[0].expand(values.shape[1:])
                each, threads = rate.reshape(-1), compiled.threads()
                native.adam_step(values, gradient, first, second, each, b1, b2, self.eps, threads)
            else:
                first.lerp_(gradient, 1 - b1)
                second.mul_(b2).addcmul_(gradient, gradient, value=1 - b2)
                values.sub_(rate * first / second.sqrt().add_(self.eps))
            parameter.grad = None

    def reset(self, name: str) -> None:
        """Set the moments of a parameter to zero, because its values were changed by hand."""
        self.first[name].zero_()
        self.second[name].zero_()

    def widen(self, gaussians: Gaussians) -> None:
        """Follow coefficients of radiance that were added, or highlights: their moments are zero."""
        for moments in (self.first, self.second):
            more = torch.zeros_like(gaussians.sh)
            more[:, : moments["sh"].shape[1]] = moments["sh"]
            moments["sh"] = more
            for name in ("lobes", "gloss"):
                if gaussians.has_highlights and name not in moments:
                    moments[name] = torch.zeros_like(getattr(gaussians, name))

    def follow(self, kept: Tensor, added: int) -> None:
        """Keep the moments of the Gaussians `kept` (index) and append zeros for `added` new ones."""
        for moments in (self.first, self.second):
            for name in (*TENSORS, "lobes") if "lobes" in moments else TENSORS:
                rest = torch.zeros(added, *moments[name].shape[1:], dtype=moments[name].dtype)
                moments[name] = torch.cat([moments[name][kept], rest])
