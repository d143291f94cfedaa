"""Validation brackets: held out of the first part of the training, they decide whether poses are refined."""

import dataclasses
import math

import torch

from obbgs_core.frames import TrainingFrame, bracket_numbers
from obbgs_core.losses import ON_TARGET_ALPHA, fit_figures, likelihood_loss
from obbgs_core.model.gaussians import Gaussians
from obbgs_core.pose_corrections import PoseCorrections
from obbgs_core.registration import pose_information
from obbgs_core.render import render
from obbgs_core.sensor import Sensor
from obbgs_core.train.batches import Batch

# One bracket in seven, at least three in all; a prime number, so that no cycle of the capture repeats with it.
INTERVAL, FEWEST = 7, 3
FEWEST_FRAMES_IN_ALL = 24  # with fewer, every frame is needed for training
FIT_STEPS = 5  # of Gauss and Newton, of a validation bracket's correction


def validation_brackets(frames: list[TrainingFrame]) -> list[list[int]]:
    """Return the frames, by index, of every seventh bracket; none where frames or brackets are few."""
    chosen = every_seventh_bracket(frames)
    return [] if len(frames) < FEWEST_FRAMES_IN_ALL or len(chosen) < FEWEST else chosen


def every_seventh_bracket(frames: list[TrainingFrame]) -> list[list[int]]:
    """Return the frames, by index, of every seventh bracket, the fourth first; further frames change no earlier one."""
    numbers = bracket_numbers(frames)
    chosen = range(INTERVAL // 2, max(numbers) + 1, INTERVAL)
    return [[i for i, number in enumerate(numbers) if number == wanted] for wanted in chosen]


def correction_gain(
    model: Gaussians, frames: list[TrainingFrame], brackets: list[Batch], sensor: Sensor
) -> tuple[float, float]:
    """Return the likelihood gain of correcting a bracket's pose over its BIC penalty: the mean, and its standard error.

    The model was not trained on these brackets, so it cannot have adapted to their tags. The gain is that of fitting a
    bracket's correction to the fixed model, in nats. It is divided by chi² as for overdispersed counts (Lebreton et al.
    1992), because a coarse model errs by more than noise, and alike in neighbouring pixels. The penalty is half the
    number of corrected directions times ln(values on the target) (Schwarz 1978).
    """
    poses = PoseCorrections(frames)
    # a bracket is corrected by itself, so its own errors are those that all frames share as well
    alone = [
        dataclasses.replace(f, navigation=None, pose_covariance=c)
        for f, c in zip(frames, poses.covariances, strict=True)
    ]
    poses, ratios = PoseCorrections(alone), []
    for batch in brackets:
        directions = int(poses.rank[poses.of_frame[batch.indices[0]]])
        if directions:
            (tagged, _, _), (corrected, chi2, values) = _fitted(model, alone, poses, batch, sensor)
            gain = (tagged - corrected) * batch.dn.numel() / chi2
            ratios.append(gain / (0.5 * directions * math.log(values)))
    ratios = torch.tensor(ratios)
    return ratios.mean().item(), ratios.std().item() / math.sqrt(len(ratios))


def _fitted(
    model: Gaussians, frames: list[TrainingFrame], poses: PoseCorrections, batch: Batch, sensor: Sensor
) -> tuple[tuple[float, float, int], tuple[float, float, int]]:
    """Fit a bracket's correction; return loss with prior, chi² and values on the target, as tagged and as corrected."""
    images, found = (batch.exposure_time_s, batch.dn, sensor, batch.averaged_pixels), []
    row = poses.of_frame[batch.indices[0]]
    for _ in range(FIT_STEPS + 1):
        cameras = poses.cameras(batch.indices, batch.cameras)
        with torch.no_grad():
            rendered = render(model, cameras)
        loss = likelihood_loss(rendered.radiance, *images)[0].item()
        loss += 0.5 * poses.value[row].square().sum().item() / batch.dn.numel()
        chi2, _ = fit_figures(rendered.radiance, rendered.alpha, *images)
        on_target = int((rendered.alpha > ON_TARGET_ALPHA).sum()) * batch.averaged_pixels * batch.dn.shape[-1]
        found.append((loss, chi2, max(2, on_target)))
        views = (rendered.radiance, rendered.alpha, rendered.depth, cameras)
        poses.gather(batch.indices, pose_information(*views, *images))
        poses.step(frames)
    return found[0], min(found)
