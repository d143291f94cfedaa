"""Adam over the Gaussians' parameters, their learning rates over the training, and the mean of the last models."""

import dataclasses
import math

import torch
from torch import Tensor

from obbgs_core import compiled
from obbgs_core.methods.config import RateSettings
from obbgs_core.model.gaussians import LOBES, TENSORS, Gaussians
from obbgs_core.train.parts import Change

FIRST_MEMORY, SECOND_MEMORY = 0.9, 0.999  # shares of the moments that a step keeps (Kingma and Ba 2015)
OPACITY_RATE = 0.05  # of opacity logits a step (Kerbl et al. 2023)
AXIS_RATE = 0.01  # of the axes of highlights a step
WEIGHT_RATE = 0.03  # of the logarithms of their weights a step
GLOSS_RATE = 0.01  # of the logarithms of roughness and peak radiance a step
PSF_RATE = 0.002  # of the point spread a step, in pixels of the sensor
AMBIENT_RATE = 0.001  # of the ambient light a step, in units of the Sun's


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

    def apply(self, change: Change) -> None:
        """Follow a change of the model."""
        if change.kept is not None:
            self.follow(change.kept, change.added)
        self.widen(change.model)
        for name in change.begun_anew:
            self.reset(name)


class Average:
    """The mean of a model over some steps, parameter by parameter: single steps scatter about what all frames want.

    gaussians: without gradients; None: none is averaged yet.

    Source: Polyak and Juditsky, Acceleration of Stochastic Approximation by Averaging, 1992.
    """

    def __init__(self):
        self.gaussians: Gaussians | None = None
        self.steps = 0

    @torch.no_grad()
    def observe(self, gaussians: Gaussians, is_averaged: bool = True) -> None:
        """Take in the model after one more step; where it is too early for that, forget what was averaged."""
        if not is_averaged or self.gaussians is None:
            self.gaussians, self.steps = (gaussians.copied(), 1) if is_averaged else (None, 0)
            return
        self.steps += 1
        before, now = self.gaussians.parameters(), gaussians.parameters()
        means = {name: before[name].lerp(value.detach(), 1 / self.steps) for name, value in now.items()}
        self.gaussians = dataclasses.replace(gaussians, **means)

    def follow(self, change: Change) -> None:
        """Keep the mean where a change only removes Gaussians; else it begins anew."""
        if self.gaussians is None or change.kept is None or change.added:
            self.gaussians, self.steps = None, 0
        else:
            self.gaussians = self.gaussians.select(change.kept)
