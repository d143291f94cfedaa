"""Pose refinement: six small numbers for each bracket, with the pose tags' whole covariance as their prior."""

import dataclasses
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from obbgs_core.frames import TrainingFrame, bracket_numbers
from obbgs_core.model.cameras import Cameras
from obbgs_core.model.gaussians import Gaussians
from obbgs_core.model.pose_covariance import whitening
from obbgs_core.model.rotations import from_rotation_vectors, multiply
from obbgs_core.settings import check, fraction
from obbgs_core.train.batches import Batch

NULL = 1e-9  # a singular value of rows of unit length that is zero up to rounding
POSE_RATE = 0.3  # learning rate at the first step, in standard deviations of the pose tag
SECOND_MOMENT_DECAY = 0.99  # a step that sees the bracket


@dataclass(frozen=True)
class PoseSettings:
    """Whether the tagged poses are refined together with the Gaussians."""

    # auto: if the likelihood gain on the validation brackets justifies it
    refine: Literal["never", "always", "auto"] = "never"
    # share of the steps before which the model is too coarse to correct poses
    refine_from: float = fraction(0.25)

    def __post_init__(self):
        check(self, "poses")


def pose_rate(share: float, settings: PoseSettings) -> float:
    """Return the learning rate of the corrections after a share of the steps, in standard deviations of the tag."""
    return POSE_RATE * (1 - share) if share >= settings.refine_from else 0.0


class PoseCorrections:
    """Corrections `value` [P, 6] of unit variance, a row for each bracket.

    Times the root of the tags' covariance they are rigid motions in front of world_to_camera: a rotation about the
    camera's axes (rad), then a shift along them (m). Directions in which the tags are exact are not corrected.

    Frames of one bracket share their motion: the error of a navigation solution hardly changes within it. Its
    covariance is the mean of those that the frames' tags give, each in its own camera's axes; an exact tag counts with
    zeros. The tags of a bracket share one error instead of being independent draws, so several tags do not reduce it
    (weighting by inverse covariances would claim so). However they are correlated, the covariance of their mean is
    never larger than the mean of their covariances, and it is equal where the tags agree.
    """

    def __init__(self, frames: list[TrainingFrame]):
        self.of_frame = bracket_numbers(frames)  # the row of each frame
        rows = max(self.of_frame) + 1
        self.value = torch.zeros(rows, 6, requires_grad=True)
        self.second = torch.zeros(rows, 6)  # running mean of the squared gradient
        self.visits = torch.zeros(rows, 1)  # steps that saw the bracket
        covariances = torch.zeros(len(frames), 6, 6, dtype=torch.float64)
        for i, frame in enumerate(frames):
            if frame.pose_covariance is not None:
                covariances[i] = frame.pose_covariance
        self.whitening = whitening(self._bracket_means(covariances))

    @torch.no_grad()
    def extended(self, frames: list[TrainingFrame]) -> "PoseCorrections":
        """Return the corrections of more frames, which begin with those of this one; new brackets have none yet."""
        more, known = PoseCorrections(frames), len(self.value)
        for name in ("value", "second", "visits"):
            getattr(more, name)[:known] = getattr(self, name)
        return more

    @property
    def rank(self) -> Tensor:
        """The number of directions [P] in which each bracket may be corrected."""
        return self.whitening.rank

    def rows(self, indices: list[int]) -> Tensor:
        """Return the rows [B] of frames."""
        return torch.tensor([self.of_frame[i] for i in indices])

    def corrected(self, indices: list[int], world_to_camera: Tensor) -> Tensor:
        """Return the poses [B, 4, 4] of frames with their corrections in front; gradients reach the corrections."""
        rows = self.rows(indices)
        return rigid_motions(_times(self.whitening.root[rows], self.value[rows])) @ world_to_camera

    def prior(self, indices: list[int], values: int) -> Tensor:
        """Return the corrections' part of a step's mean loss: half their squares over the number of its values."""
        return 0.5 * self.value[self.rows(indices)].square().sum() / values

    @torch.no_grad()
    def step(self, rate: float) -> None:
        """Move what has a gradient against it, over its root mean square; `rate` is in deviations of the tag.

        This is Adam without its first moment: a bracket is seen only a few dozen times, and momentum overshoots.
        Directions in which the tags are exact stay zero, so that the prior counts only those that move a pose.
        """
        gradient = self.value.grad
        if gradient is not None:
            seen = gradient.abs().sum(1, keepdim=True) > 0
            self.visits += seen
            decayed = SECOND_MOMENT_DECAY * self.second + (1 - SECOND_MOMENT_DECAY) * gradient**2
            self.second = torch.where(seen, decayed, self.second)
            second = self.second / (1 - SECOND_MOMENT_DECAY ** self.visits.clamp(min=1))
            self.value -= torch.where(seen, rate * gradient / (second.sqrt() + 1e-15), 0.0)
            self.value.grad = None
        self.value.copy_(_times(self.whitening.support, self.value))

    def cameras(self, batch: Batch) -> Cameras:
        """Return a step's cameras with their corrections."""
        corrected = self.corrected(batch.indices, batch.cameras.world_to_camera)
        return dataclasses.replace(batch.cameras, world_to_camera=corrected)

    @torch.no_grad()
    def fix_gauge(self, gaussians: Gaussians, frames: list[TrainingFrame]) -> Gaussians:
        """Return the model moved rigidly to where the corrections, moved with it, are smallest in the tags' deviations.

        Moving the model rigidly by d and every pose by its inverse changes no image, so training leaves d open. Motions
        that would change a direction in which a tag is exact are excluded.
        """
        poses = torch.stack([frame.world_to_camera for frame in frames]).double()
        R, t = poses[:, :3, :3], poses[:, :3, 3]
        # a small motion d of the body, seen in the camera's axes: rotation R w, shift R v + t x (R w)
        adjoints = torch.zeros(len(frames), 6, 6, dtype=torch.float64)
        adjoints[:, :3, :3] = R
        adjoints[:, 3:, 3:] = R
        adjoints[:, 3:, :3] = _cross_matrices(t) @ R
        adjoint = self._bracket_means(adjoints)
        free = _null_space((self.whitening.exact @ adjoint).flatten(0, 1))
        rows = (self.whitening.inverse @ adjoint).flatten(0, 1) @ free
        motion = free @ (torch.linalg.pinv(rows) @ self.value.flatten().double())
        self.value.sub_(_times(self.whitening.inverse, adjoint @ motion).float())
        motion = motion.float()
        rigid = rigid_motions(motion[None])[0]
        return dataclasses.replace(  # a turn this small does not show in the radiance
            gaussians,
            means=gaussians.means @ rigid[:3, :3].T + rigid[:3, 3],
            quats=multiply(from_rotation_vectors(motion[:3]).expand(len(gaussians), 4), gaussians.quats),
        )

    def _bracket_means(self, of_frames: Tensor) -> Tensor:
        """Return the mean over each bracket's frames [P, ...] of what each frame has [F, ...]."""
        of_frame = torch.tensor(self.of_frame)
        sums = torch.zeros(len(self.value), *of_frames.shape[1:], dtype=of_frames.dtype)
        frames = torch.bincount(of_frame).view(-1, *[1] * (of_frames.dim() - 1))
        return sums.index_add(0, of_frame, of_frames) / frames


def rigid_motions(xi: Tensor) -> Tensor:
    """Return [B, 4, 4] of rotation vectors (rad) and shifts (m) [B, 6]; exact rotations for any angle."""
    generator = torch.zeros(len(xi), 4, 4, dtype=xi.dtype)
    generator[:, :3, :3] = _cross_matrices(xi[:, :3])
    motion = torch.matrix_exp(generator)
    shift = torch.zeros_like(motion)
    shift[:, :3, 3] = xi[:, 3:]
    return motion + shift


def _times(matrices: Tensor, vectors: Tensor) -> Tensor:
    return (matrices @ vectors[..., None])[..., 0]


def _null_space(rows: Tensor) -> Tensor:
    """Return an orthonormal basis [n, k] of what all rows [M, n] map to zero, whatever their lengths."""
    lengths = rows.norm(dim=1, keepdim=True)
    _, singular, basis = torch.linalg.svd(torch.where(lengths > 0, rows / lengths, 0.0), full_matrices=False)
    return basis[singular < NULL].T


def _cross_matrices(v: Tensor) -> Tensor:
    x, y, z = v.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).unflatten(-1, (3, 3))
