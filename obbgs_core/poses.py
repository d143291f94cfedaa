"""Pose refinement: six small numbers a bracket beside the Gaussians, held by the pose tag's own covariance."""

import dataclasses

import torch
from torch import Tensor

from obbgs_core.cameras import Cameras
from obbgs_core.corrections import Corrections
from obbgs_core.frames import Batch, TrainingFrame, bracket_numbers
from obbgs_core.gaussians import Gaussians
from obbgs_core.rotations import from_rotation_vectors, multiply


class PoseCorrections(Corrections):
    """Corrections [P, 6] in units of the tag's deviations: rotation about, then shift along, the camera's axes.

    Frames of one bracket share their correction: the error of a navigation solution hardly changes within it.
    """

    def __init__(self, frames: list[TrainingFrame]):
        super().__init__(bracket_numbers(frames), 6)
        self.sigma = torch.zeros_like(self.value)
        for frame, number in zip(frames, self.of_frame, strict=True):
            if frame.pose_sigma is not None:
                self.sigma[number] = frame.pose_sigma

    def corrected(self, indices: list[int], world_to_camera: Tensor) -> Tensor:
        """Return the poses [B, 4, 4] of frames with their corrections in front; gradients reach the corrections."""
        return rigid_motions(self.of(indices) * self.sigma[self.rows(indices)]) @ world_to_camera

    def cameras(self, batch: Batch) -> Cameras:
        """Return a step's cameras with their corrections."""
        corrected = self.corrected(batch.indices, batch.cameras.world_to_camera)
        return dataclasses.replace(batch.cameras, world_to_camera=corrected)

    @torch.no_grad()
    def settle(self, gaussians: Gaussians, frames: list[TrainingFrame]) -> Gaussians:
        """Fix the gauge: move model and corrections together to where the corrections are least likely noise.

        Moving the model rigidly by d and every pose by its inverse changes no image; of all such twins the one with
        the smallest corrections (weighted by the tags) is kept.
        """
        tags = torch.zeros(len(self.sigma), 4, 4)
        for frame, number in zip(frames, self.of_frame, strict=True):
            tags[number] = frame.world_to_camera
        R, t = tags[:, :3, :3], tags[:, :3, 3]
        # a small motion d of the body, seen in the camera's axes: rotation R w, shift R v + t x (R w)
        adjoint = torch.zeros(len(tags), 6, 6)
        adjoint[:, :3, :3] = R
        adjoint[:, 3:, 3:] = R
        adjoint[:, 3:, :3] = _cross_matrices(t) @ R
        weight = torch.where(self.sigma > 0, 1 / self.sigma.clamp(min=1e-12), 0.0)
        rows = (adjoint * weight[..., None]).reshape(-1, 6).double()
        motion = torch.linalg.lstsq(rows, self.value.reshape(-1, 1).double()).solution[:, 0].float()
        moved = adjoint @ motion
        self.value -= torch.where(self.sigma > 0, moved * weight, 0.0)
        rigid = rigid_motions(motion[None])[0]
        return dataclasses.replace(  # a turn this small does not show in the radiance
            gaussians,
            means=gaussians.means @ rigid[:3, :3].T + rigid[:3, 3],
            quats=multiply(from_rotation_vectors(motion[:3]).expand(len(gaussians), 4), gaussians.quats),
        )


def rigid_motions(xi: Tensor) -> Tensor:
    """Return [B, 4, 4] of rotation vectors (rad) and shifts (m) [B, 6]; exact rotations for any angle."""
    generator = torch.zeros(len(xi), 4, 4, dtype=xi.dtype)
    generator[:, :3, :3] = _cross_matrices(xi[:, :3])
    motion = torch.matrix_exp(generator)
    shift = torch.zeros_like(motion)
    shift[:, :3, 3] = xi[:, 3:]
    return motion + shift


def _cross_matrices(v: Tensor) -> Tensor:
    x, y, z = v.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).unflatten(-1, (3, 3))
