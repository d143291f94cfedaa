"""Pose refinement: six small numbers a bracket beside the Gaussians, held by the pose tags' whole covariance."""

import dataclasses

import torch
from torch import Tensor

from obbgs_core.frames import Batch, TrainingFrame, bracket_numbers
from obbgs_core.model.cameras import Cameras
from obbgs_core.model.gaussians import Gaussians
from obbgs_core.model.pose_covariance import whitening
from obbgs_core.model.rotations import from_rotation_vectors, multiply
from obbgs_core.train.corrections import Corrections

NULL = 1e-9  # a singular value of rows of unit length that is zero up to rounding


class PoseCorrections(Corrections):
    """Corrections [P, 6] of unit variance; times the root of the tags' covariance they are rigid motions.

    Such a motion stands in front of world_to_camera: a rotation about the camera's axes, then a shift along them. What
    the tags know exactly is not corrected.

    Frames of one bracket share their motion: the error of a navigation solution hardly changes within it. Its
    covariance is the mean of those that the frames' tags give, each in its own camera's axes; an exact tag counts with
    zeros. The tags' errors are one and the same, not independent draws, so several tags make it no more certain (which
    weighing by inverse covariances would say). However they are correlated, the covariance of their mean is never
    larger than the mean of their covariances, and it is equal where the tags agree.
    """

    def __init__(self, frames: list[TrainingFrame]):
        super().__init__(bracket_numbers(frames), 6)
        covariances = torch.zeros(len(frames), 6, 6, dtype=torch.float64)
        for i, frame in enumerate(frames):
            if frame.pose_covariance is not None:
                covariances[i] = frame.pose_covariance
        self.whitening = whitening(self._bracket_means(covariances))

    @property
    def rank(self) -> Tensor:
        """The number of directions [P] in which each bracket may be corrected."""
        return self.whitening.rank

    def corrected(self, indices: list[int], world_to_camera: Tensor) -> Tensor:
        """Return the poses [B, 4, 4] of frames with their corrections in front; gradients reach the corrections."""
        root = self.whitening.root[self.rows(indices)]
        return rigid_motions(_times(root, self.of(indices))) @ world_to_camera

    @torch.no_grad()
    def step(self, rate: float) -> None:
        """Move the corrections; what moves no pose stays zero, so that the prior counts only what does."""
        super().step(rate)
        self.value.copy_(_times(self.whitening.support, self.value))

    def cameras(self, batch: Batch) -> Cameras:
        """Return a step's cameras with their corrections."""
        corrected = self.corrected(batch.indices, batch.cameras.world_to_camera)
        return dataclasses.replace(batch.cameras, world_to_camera=corrected)

    @torch.no_grad()
    def settle(self, gaussians: Gaussians, frames: list[TrainingFrame]) -> Gaussians:
        """Fix the gauge: move model and corrections together to where the corrections are least likely noise.

        Moving the model rigidly by d and every pose by its inverse changes no image; of all such twins the one with
        the smallest corrections (weighted by the tags) is kept. A motion that would change what a tag knows exactly
        is none of them.
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
