"""Validation brackets: held out of the first part of the training, they decide whether poses are refined."""

import dataclasses
import math
from dataclasses import dataclass

import torch
from torch import Tensor

from obbgs_core.batches import Batch
from obbgs_core.evidence import Evidence
from obbgs_core.frames import TrainingFrame, pose_numbers
from obbgs_core.losses import likelihood_loss
from obbgs_core.model.gaussians import Gaussians
from obbgs_core.poses.corrections import PoseCorrections
from obbgs_core.poses.registration import PoseInformation, pose_information
from obbgs_core.render.slopes import render_with_slopes
from obbgs_core.sensor import Sensor

# One bracket in seven, at least three in all; a prime number, so that no cycle of the capture repeats with it.
INTERVAL, FEWEST = 7, 3
FEWEST_FRAMES_IN_ALL = 24  # with fewer, every frame is needed for training
FIT_STEPS = 5  # of Gauss and Newton, of a validation bracket's correction
# Of one bracket: above it some poses err, even where most are right. Coarse models gave up to 10 on exact poses, and 28
# on a photograph whose published camera is off (docs/experiments/061).
CERTAIN_NATS = 20.0


def validation_brackets(frames: list[TrainingFrame]) -> list[list[int]]:
    """Return the frames, by index, of every seventh bracket; none where frames or brackets are few."""
    chosen = every_seventh_bracket(frames)
    return [] if len(frames) < FEWEST_FRAMES_IN_ALL or len(chosen) < FEWEST else chosen


def every_seventh_bracket(frames: list[TrainingFrame]) -> list[list[int]]:
    """Return the frames, by index, of every seventh bracket, the fourth first; further frames change no earlier one."""
    numbers = pose_numbers(frames)
    chosen = range(INTERVAL // 2, max(numbers) + 1, INTERVAL)
    return [[i for i, number in enumerate(numbers) if number == wanted] for wanted in chosen]


@dataclass(frozen=True)
class CorrectionEvidence:
    """Log Bayes factors of "the pose errs as its tag states" to "it is exact", one of each validation bracket [B]."""

    factors: Tensor

    @property
    def mean(self) -> Evidence:
        """Over the brackets, with the standard error of the mean."""
        return Evidence(self.factors.mean(), error=self.factors.std().item() / math.sqrt(len(self.factors)))

    @property
    def largest(self) -> Evidence:
        """That of the bracket whose pose errs most certainly."""
        return Evidence(self.factors.max(), CERTAIN_NATS)

    @property
    def justifies(self) -> bool:
        """Whether poses are corrected: the brackets say so on the whole, or one is certain of it."""
        return bool(self.mean.justifies | self.largest.justifies)

    def __str__(self) -> str:
        certain = f", of {self.largest.gain:.0f} in one of them" if self.largest.justifies else ""
        return (
            f"that a validation bracket's pose errs has a log Bayes factor of {self.mean.gain:.1f} ± "
            f"{self.mean.error:.1f}{certain}"
        )


def correction_evidence(
    model: Gaussians, frames: list[TrainingFrame], brackets: list[Batch], sensor: Sensor, cell_m: float
) -> CorrectionEvidence:
    """Return what validation brackets say of whether poses err.

    The model was not trained on these brackets, so it cannot have adapted to their tags. A bracket's correction z, in
    deviations of what its tag states, is fitted to the fixed model. With A the curvature of the likelihood there the
    logarithm is nearly z (1 + A) z / 2 - ln det(1 + A) / 2 (Laplace's approximation; Dickey 1971). What a coarse model
    gets wrong is alike in neighbouring pixels and in all frames of a bracket: the values of a cell of the surface in a
    bracket count as one.

    Args:
        cell_m: edge of the surface's cells, as in `registration.pose_information`.
    """
    poses = PoseCorrections(frames)
    # a bracket is corrected by itself, so its own errors are those that all frames share as well
    alone = [
        dataclasses.replace(f, navigation=None, pose_covariance=c)
        for f, c in zip(frames, poses.covariances, strict=True)
    ]
    poses = PoseCorrections(alone)
    return CorrectionEvidence(
        torch.tensor([_evidence(model, alone, poses, batch, sensor, cell_m) for batch in brackets])
    )


def _evidence(
    model: Gaussians,
    frames: list[TrainingFrame],
    poses: PoseCorrections,
    batch: Batch,
    sensor: Sensor,
    cell_m: float,
) -> float:
    """Fit a bracket's correction and return its log Bayes factor; of the steps the likeliest pose counts."""
    images, found = (batch.exposure_time_s, batch.dn, sensor, batch.averaged_pixels), []
    row, count = poses.of_frame[batch.indices[0]], len(batch.indices)
    root = poses.whitening.root[row].double()
    for _ in range(FIT_STEPS + 1):
        cameras = poses.cameras(batch.indices, batch.cameras)
        rendered, slopes = render_with_slopes(model, cameras)
        loss = likelihood_loss(rendered.radiance, *images)[0].item()
        views = (rendered.radiance, slopes, rendered.alpha, rendered.depth, cameras)
        told = pose_information(*views, *images, cell_m=cell_m)
        told = PoseInformation(told.gradient / count, told.curvature / count)
        precision = torch.eye(6, dtype=torch.float64) + root.T @ told.curvature.sum(0) @ root
        z = poses.value[row].double()
        found.append((loss, float(z @ precision @ z - torch.logdet(precision)) / 2))
        poses.gather(batch.indices, told)
        poses.step(frames)
    return min(found)[1]
