"""What brackets that the training has not seen say of it: whether poses need correcting, whether growth still pays."""

import math

import torch
from torch import Tensor

from obbgs_core.frames import Batch, TrainingFrame, bracket_numbers
from obbgs_core.losses import ON_TARGET_ALPHA, fit_figures, likelihood_loss
from obbgs_core.model.gaussians import Gaussians
from obbgs_core.render import render
from obbgs_core.sensor import Sensor
from obbgs_core.train.poses import PoseCorrections

INTERVAL, FEWEST = 7, 3  # brackets; a prime keeps step with no cycle of exposures
FEWEST_IN_ALL = 24  # frames: of fewer, each is needed
SETTLING_STEPS = 20  # of a held-out bracket's correction


def held_out_brackets(frames: list[TrainingFrame]) -> list[list[int]]:
    """Return the frames, by index, of every seventh bracket; none where frames or brackets are few."""
    numbers = bracket_numbers(frames)
    chosen = range(INTERVAL // 2, max(numbers) + 1, INTERVAL)
    if len(frames) < FEWEST_IN_ALL or len(chosen) < FEWEST:
        return []
    return [[i for i, number in enumerate(numbers) if number == wanted] for wanted in chosen]


def worth_of_corrections(
    model: Gaussians, frames: list[TrainingFrame], brackets: list[Batch], sensor: Sensor, rate: float
) -> tuple[float, float]:
    """Return how many times its price correcting a bracket's pose gains, in the mean, and the mean's deviation.

    The model has not seen these brackets, so it cannot have bent to their tags. What settling a bracket's correction
    on the model gains, nats over its chi² (a coarse model errs by more than noise, alike in neighbouring pixels:
    Lebreton et al. 1992), is compared with the price of its numbers (Schwarz 1978).
    """
    poses, worth = PoseCorrections(frames), []
    for batch in brackets:
        numbers = int(poses.rank[poses.of_frame[batch.indices[0]]])
        if numbers:
            tagged, _, _ = _settled(model, poses, batch, sensor, rate, 0)
            settled, chi2, values = _settled(model, poses, batch, sensor, rate, SETTLING_STEPS)
            gain = (tagged - settled) * batch.dn.numel() / chi2
            worth.append(gain / (0.5 * numbers * math.log(values)))
    return mean_and_error(torch.tensor(worth))


def losses(
    model: Gaussians,
    frames: list[TrainingFrame],
    brackets: list[Batch],
    sensor: Sensor,
    rate: float,
    refined: bool,
) -> Tensor:
    """Return the mean robust loss of each bracket [P], its pose settled on the model first where poses are refined."""
    poses, steps = PoseCorrections(frames), SETTLING_STEPS if refined else 0
    return torch.tensor([_settled(model, poses, batch, sensor, rate, steps)[0] for batch in brackets])


def mean_and_error(values: Tensor) -> tuple[float, float]:
    """Return the mean of values [P] and its own deviation."""
    return values.mean().item(), values.std().item() / math.sqrt(len(values))


def _settled(
    model: Gaussians, poses: PoseCorrections, batch: Batch, sensor: Sensor, rate: float, steps: int
) -> tuple[float, float, int]:
    """Settle a bracket's correction on the model; return the loss, the chi² and the values on the target there."""
    # no step has seen a held-out frame, so its exposure time is the tag's; none of these steps may correct it
    images = (batch.exposure_time_s.detach(), batch.dn, sensor, batch.averaged_pixels)
    for k in range(steps):
        loss, _ = likelihood_loss(render(model, poses.cameras(batch)).radiance, *images)
        (loss + poses.prior(batch.indices, batch.dn.numel())).backward()
        poses.step(rate * (1 - k / steps))
    with torch.no_grad():
        rendered = render(model, poses.cameras(batch))
        loss = likelihood_loss(rendered.radiance, *images)[0]
        if steps:
            loss = loss + poses.prior(batch.indices, batch.dn.numel())
    chi2, _ = fit_figures(rendered.radiance, rendered.alpha, *images)
    on_target = int((rendered.alpha > ON_TARGET_ALPHA).sum()) * batch.averaged_pixels * batch.dn.shape[-1]
    return loss.item(), chi2, max(2, on_target)
