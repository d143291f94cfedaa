"""Validation brackets: held out of the first part of the training, they decide whether poses are refined."""

import dataclasses
import math
from dataclasses import dataclass

import torch
from torch import Tensor

from obbgs_core.batches import Batch
from obbgs_core.evidence import Evidence
from obbgs_core.frames import TrainingFrame, pose_numbers
from obbgs_core.losses import ON_TARGET_ALPHA, likelihood_loss
from obbgs_core.model.gaussians import Gaussians
from obbgs_core.poses.corrections import PoseCorrections
from obbgs_core.poses.registration import PoseInformation, pose_information
from obbgs_core.render.slopes import render_with_slopes
from obbgs_core.sensor import Sensor

# One bracket in seven, at least three in all; a prime number, so that no cycle of the capture repeats with it.
INTERVAL, FEWEST = 7, 3
FEWEST_FRAMES_IN_ALL = 24  # with fewer, every frame is needed for training
FIT_STEPS = 5  # of Gauss and Newton, of a validation bracket's correction
SQUARES = 8  # of the checkerboard, along the side of a square as large as what a picture shows of the target
SMALLEST_SQUARE_PX = 4
LEAST_GAIN = 0.02  # of the squared residuals: corrections that gain less are not worth their time
ROBUST = 3.0  # root mean squares that a residual counts as at most
SURE = 2.0  # standard errors by which brackets have to gain more than that


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
    """What validation brackets say of whether poses err.

    factors: [B] log Bayes factors of "the pose errs as its tag states" to "it is exact", one of each bracket.
    gains: [B] by what share the squared residuals fall in one half of a bracket's picture where its pose is corrected
        by the other half; errors: [B] their standard errors.
    """

    factors: Tensor
    gains: Tensor
    errors: Tensor

    @property
    def mean(self) -> Evidence:
        """Over the brackets, with the standard error of the mean."""
        return Evidence(self.factors.mean(), error=self.factors.std().item() / math.sqrt(len(self.factors)))

    @property
    def gain(self) -> Evidence:
        """What corrections gain in the brackets on average, where the other half of the picture has told them."""
        error = SURE * self.errors.square().sum().sqrt().item() / len(self.errors)
        return Evidence(self.gains.mean(), max(0.0, LEAST_GAIN - error), error)

    @property
    def justifies(self) -> bool:
        """Whether poses are corrected: the brackets say so on the whole, or surely gain by it."""
        return bool(self.mean.justifies | self.gain.justifies)

    def __str__(self) -> str:
        return (
            f"that a validation bracket's pose errs has a log Bayes factor of {self.mean.gain:.1f} ± "
            f"{self.mean.error:.1f}; corrected by half of the picture, the other half errs {self.gain.gain:.1%} less, "
            f"of which {self.gain.error:.1%} may be chance"
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

    Of photographs a few cameras may err where most are exact, which the mean of the factors does not show. So it is
    also seen whether corrections predict: one half of the squares of a checkerboard tells the correction, the other
    half whether it is one (cross-validation). What a coarse model gets wrong differs from square to square.

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
    factors = torch.tensor([_evidence(model, alone, poses, batch, sensor, cell_m) for batch in brackets])
    gains = torch.tensor([_gain(model, alone, PoseCorrections(alone), batch, sensor) for batch in brackets])
    return CorrectionEvidence(factors, *gains.unbind(1))


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


@torch.no_grad()
def _gain(
    model: Gaussians, frames: list[TrainingFrame], poses: PoseCorrections, batch: Batch, sensor: Sensor
) -> tuple[float, float]:
    """Return by what share half of a picture errs less where the other half has corrected its pose, with its error.

    One frame of the bracket is asked.
    """
    place = len(batch.indices) // 2
    index, dn = batch.indices[place], batch.dn[place, None]
    images = (batch.exposure_time_s[place, None], dn, sensor, batch.averaged_pixels)
    errors, square = [], torch.empty(0)
    for _ in range(FIT_STEPS + 1):
        cameras = poses.cameras([index], batch.cameras.one(place))
        rendered, slopes = render_with_slopes(model, cameras)
        if not errors:
            square = _checkerboard(rendered.alpha[0] > ON_TARGET_ALPHA)
        errors.append(likelihood_loss(rendered.radiance, *images)[1][0].square().sum(dim=2))
        # a picture without slopes says nothing of its pose
        views = (rendered.radiance, torch.where((square % 2 == 0)[..., None, None], slopes, 0.0))
        poses.gather([index], pose_information(*views, rendered.alpha, rendered.depth, cameras, *images))
        poses.step(frames)
    judged = square % 2 == 1
    before, after = (error[judged] for error in (errors[0], errors[-1]))
    most = ROBUST**2 * before.mean()
    fall = before.clamp(max=most) - after.clamp(max=most)
    by_square = torch.zeros(int(square.max()) + 1).index_add(0, square[judged], fall)
    whole = before.clamp(max=most).sum().clamp(min=1e-9)
    return float(by_square.sum() / whole), float(by_square.square().sum().sqrt() / whole)


def _checkerboard(shown: Tensor) -> Tensor:
    """Return the number [H, W] of the square that a pixel of the target is in, odd on black ones; -2 beside it."""
    side = max(SMALLEST_SQUARE_PX, round(math.sqrt(int(shown.sum())) / SQUARES))
    rows, columns = (torch.arange(size) // side for size in shown.shape)
    width = int(columns[-1]) // 2 * 2 + 3  # odd: a number is even where row and column are so together
    return torch.where(shown, rows[:, None] * width + columns, -2)
