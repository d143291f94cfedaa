"""Whether frames ask for more Gaussians than the budget allows: what they could pay for, and what brackets gain."""

import math

import torch
from torch import Tensor

from obbgs_core.batches import Batches
from obbgs_core.compiled import each
from obbgs_core.evidence import Evidence
from obbgs_core.evidence.gains import ROBUST, bic_penalty, shown_frames
from obbgs_core.misfit import relative_misfit, sampled
from obbgs_core.model.gaussians import Gaussians
from obbgs_core.render import render
from obbgs_core.sensor import Sensor

SURE = 2.0  # standard errors by which brackets that were kept back must gain
# Of what a model does not explain, that as many Gaussians again do: 0.4 of photographs, 0.1 of renders, where twice as
# many gain less than 0.2 dB of views that are kept back.
EXPLAINED = 0.25
LEAST_ERROR = 1e-3  # of the light: smaller errors of the model are alike


@torch.no_grad()
def as_many_again(gaussians: Gaussians, batches: Batches, sensor: Sensor) -> Evidence:
    """Return what the frames could gain by as many Gaussians again, with the BIC penalty of so many, in nats.

    It is a share of what is not explained: of half of how far the squared residuals of the readings that show the
    target exceed their expectation, which is 1. Residuals are cut off, as the loss does it.
    """
    gain, values, chosen = 0.0, 0, shown_frames(batches)
    times = len(batches.frames) / len(chosen)

    def unexplained(index: int) -> tuple[float, int]:
        batch = batches.batch([index])
        radiance = render(gaussians, batch.cameras).radiance
        prediction = sensor.predicted(radiance, batch.exposure_time_s)
        empty_dn = sensor.expected_dn(batch.cameras.behind, batch.exposure_time_s)
        lit = (prediction.expected_dn - empty_dn).abs() > prediction.sigma_dn
        residual = sensor.normalised_residual(radiance, batch.exposure_time_s, batch.dn)[lit]
        return 0.5 * float((residual.clamp(-ROBUST, ROBUST).square() - 1).sum()), int(lit.sum())

    for more, lit in each(unexplained, chosen):
        gain += more * times
        values += lit
    penalty = len(gaussians) * bic_penalty(gaussians, round(values * times))
    return Evidence(torch.tensor(EXPLAINED * gain, dtype=torch.float64), penalty)


@torch.no_grad()
def log_errors(gaussians: Gaussians, batches: Batches, sensor: Sensor, brackets: list[list[int]]) -> Tensor:
    """Return the logarithm of the model's own error, as a share of the light, in each of B brackets [B]."""
    errors = []
    for bracket in brackets:
        batch = batches.batch(bracket)
        radiance, dn = sampled(sensor, render(gaussians, batch.cameras).radiance, batch.dn)
        errors.append(relative_misfit(radiance, batch.exposure_time_s, dn, sensor))
    return torch.tensor(errors).nan_to_num().clamp(min=LEAST_ERROR).log()


def fewer(before: Tensor, after: Tensor) -> Evidence:
    """Return by how much the logarithms of brackets' errors [B] have fallen on average, with what may be chance."""
    fall = before - after
    return Evidence(fall.mean(), error=SURE * fall.std(correction=0).item() / math.sqrt(len(fall)))
