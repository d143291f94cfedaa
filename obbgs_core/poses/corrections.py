"""Corrections of the poses of a pass: few parameters that all frames share, and six small numbers for each bracket."""

import copy
import dataclasses
import math

import numpy as np
import torch
from torch import Tensor

from obbgs_base.physics.navigation_errors import SIZE, NominalMotion, SharedParameters, displaced, jacobian
from obbgs_core.frames import TrainingFrame, pose_numbers
from obbgs_core.model.cameras import Cameras
from obbgs_core.model.gaussians import Gaussians
from obbgs_core.model.motions import adjoints, motion_vectors, rigid_motions
from obbgs_core.model.pose_covariance import whitening
from obbgs_core.model.rotations import from_rotation_vectors, multiply
from obbgs_core.poses.estimate import PoseEstimate
from obbgs_core.poses.normal_equations import NormalEquations, ReducedEquations, times
from obbgs_core.poses.registration import CellInformation, CellShifts, PoseInformation

NULL = 1e-9  # a singular value of rows of unit length that is zero up to rounding
LINEAR = 0.1  # prior deviations by which shared parameters move before their effect is linearised anew
GAUGE_ROUNDS = 3  # of the linear problem that fixes the gauge; its error is of second order in the motion
# by which deviations were too small where they could be compared with the truth: the model's errors are alike in many
# pictures
DOUBT = 2.0
SETTLED = 0.01  # deviations: no further round follows one that moves no correction by more


class PoseCorrections:
    """The poses of all frames with their corrections: shared parameters `shared` [19], then `value` [P, 6] a bracket.

    The shared parameters (`obbgs_base.physics.navigation_errors`) move the tagged poses, each bracket's own correction
    follows. The own corrections have unit variance: times the root of the tags' covariance they are rigid motions in
    front of world_to_camera, a rotation about the camera's axes (rad), then a shift along them (m). Directions in which
    the tags are exact, and shared parameters whose prior deviation is 0, are not corrected. The focal length is not
    estimated: from a distance it shows as the range does.

    Frames of one bracket share their motion: the error of a navigation solution hardly changes within seconds. A
    frame that says so (`own_pose`) counts as a bracket by itself. The covariance of a bracket's motion is the mean of
    those that the frames' tags give, each in its own camera's axes; an exact tag counts with zeros. The tags of a
    bracket share one error instead of being independent draws, so several tags do not reduce it (weighting by inverse
    covariances would claim so). However they are correlated, the covariance of their mean is never larger than the
    mean of their covariances, and it is equal where the tags agree.
    """

    # covariances as of `left_open`, when poses and surface last moved together; None: they did not yet
    together: tuple[Tensor, Tensor] | None = None

    def __init__(self, frames: list[TrainingFrame]):
        self.of_frame = pose_numbers(frames)  # the row of each frame
        count = max(self.of_frame) + 1
        self.value = torch.zeros(count, 6)
        covariances = torch.zeros(len(frames), 6, 6, dtype=torch.float64)
        for i, frame in enumerate(frames):
            if frame.pose_covariance is not None:
                covariances[i] = frame.pose_covariance
        self.whitening = whitening(self._bracket_means(covariances))
        self.tags = torch.stack([frame.world_to_camera for frame in frames]).double()  # [F, 4, 4]
        navigation = frames[0].navigation
        sigmas = SharedParameters() if navigation is None else navigation.sigmas
        self.sigmas = torch.from_numpy(dataclasses.replace(sigmas, focal=np.zeros(1)).vector())  # [19]
        self.shared = torch.zeros(SIZE, dtype=torch.float64)
        self.linear_at = torch.full_like(self.shared, torch.nan)  # [19] where `by_shared` was taken
        self.moved = self.tags  # [F, 4, 4] the tags with the shared parameters
        self.by_shared = torch.zeros(
            len(frames), 6, 0, dtype=torch.float64
        )  # [F, 6, S] motion by whitened parameter
        if self.sigmas.any():
            self._move_shared(frames, self.shared)
        self.clear()

    def extended(self, frames: list[TrainingFrame]) -> "PoseCorrections":
        """Return the corrections of more frames, which begin with those of this one; new brackets have no own yet."""
        more = PoseCorrections(frames)
        if more.sigmas.any():
            more._move_shared(frames, self.shared)
        more.value[: len(self.value)] = self.value
        return more

    @property
    def rank(self) -> Tensor:
        """The number of directions [P] in which each bracket may be corrected by itself."""
        return self.whitening.rank

    @property
    def covariances(self) -> Tensor:
        """The covariances [F, 6, 6] of the poses' errors as tagged: shared and own together."""
        root = self.whitening.root.double()[self.of_frame]
        return root @ root.mT + self.by_shared @ self.by_shared.mT

    @property
    def free(self) -> Tensor:
        """Which of the shared parameters [19] are estimated."""
        return self.sigmas > 0

    def rows(self, indices: list[int]) -> Tensor:
        """Return the rows [B] of frames."""
        return torch.tensor([self.of_frame[i] for i in indices])

    def corrected(self, indices: list[int]) -> Tensor:
        """Return the poses [B, 4, 4] of frames with their corrections."""
        rows = self.rows(indices)
        own = rigid_motions(times(self.whitening.root[rows], self.value[rows]).double())
        return (own @ self.moved[indices]).float()

    def cameras(self, indices: list[int], cameras: Cameras) -> Cameras:
        """Return the cameras of frames with their corrections."""
        return dataclasses.replace(cameras, world_to_camera=self.corrected(indices))

    def frames(self, frames: list[TrainingFrame]) -> list[TrainingFrame]:
        """Return the frames with corrected poses."""
        poses = self.corrected(list(range(len(frames))))
        return [dataclasses.replace(f, world_to_camera=p) for f, p in zip(frames, poses, strict=True)]

    def gather(self, indices: list[int], information: PoseInformation) -> None:
        """Keep what pictures of frames say of their poses, in place of what earlier ones said."""
        self.gradient[indices], self.curvature[indices] = information.gradient, information.curvature
        if information.cells is not None:
            self.cells |= dict(zip(indices, information.cells, strict=True))
            self.cell_m = information.cell_m

    def clear(self) -> None:
        """Forget what was gathered."""
        self.gradient = torch.zeros(len(self.of_frame), 6, dtype=torch.float64)
        self.curvature = torch.zeros(len(self.of_frame), 6, 6, dtype=torch.float64)
        self.cells: dict[int, CellInformation] = {}
        self.cell_m = 0.0

    def step(
        self,
        frames: list[TrainingFrame],
        extra: Tensor | None = None,
        reach_m: float | None = None,
        together: bool = False,
    ) -> tuple[Tensor, CellShifts | None]:
        """Move all corrections to the minimum of what was gathered plus their priors.

        One step of Gauss and Newton in all parameters together, and in the places of the surface's cells where pictures
        told of them. The prior of a bracket counts once.

        Args:
            extra: [F, 6, E] motions by further parameters of unit variance that are to be estimated along.
            reach_m: prior deviation of the shift of a cell; None: its edge.
            together: whether the surface goes along; what this step leaves open is kept as `together` then.

        Returns:
            The change of the further parameters [E] from zero, and where the surface's cells go.
        """
        normal = self._normal_equations(extra, reach_m)
        if together:
            self.together = self._covariances(normal)
        all_shared, own = normal.solution()
        shared, others = all_shared.split([self.by_shared.shape[2], 0 if extra is None else extra.shape[2]])
        self._change_shared(frames, shared)
        self.value = times(self.whitening.support, self.value + own.float())
        return others, normal.shifts(all_shared, own) if isinstance(normal, ReducedEquations) else None

    def changed(self, frames: list[TrainingFrame], by: Tensor) -> "PoseCorrections":
        """Return the corrections with the free shared parameters [S] changed by so many prior deviations."""
        other = copy.copy(self)
        other._change_shared(frames, by)
        return other

    def body_motions(self) -> Tensor:
        """Return how frames see small motions of the whole body [F, 6, 7], as motions of their cameras.

        Columns: a turn about each of the body's axes, a shift along each, and a logarithm of the size, in units in
        which `after_motion` takes them.
        """
        poses = self.corrected(list(range(len(self.of_frame)))).double()
        nearer = torch.cat([torch.zeros_like(poses[:, :3, 3:]), -poses[:, :3, 3:]], dim=1)
        return torch.cat([adjoints(poses), nearer], dim=2) * self._body_units()

    def after_motion(self, gaussians: Gaussians, change: Tensor) -> Gaussians:
        """Return a model after a small motion [7] of the whole body, in the units of `body_motions`."""
        motion = change * self._body_units()
        similarity = rigid_motions(motion[None, :6])[0]
        similarity[:3, :3] *= torch.exp(motion[6])
        return _transformed(gaussians, similarity, float(motion[6]))

    def _body_units(self) -> Tensor:
        """Return 1 rad, the mean range and a logarithm of 1: prior deviations that hold nothing."""
        units = torch.ones(7, dtype=torch.float64)
        units[3:6] = self.tags[:, :3, 3].norm(dim=1).mean()
        return units

    def _normal_equations(
        self, extra: Tensor | None = None, reach_m: float | None = None
    ) -> NormalEquations | ReducedEquations:
        rows, count = torch.tensor(self.of_frame), len(self.value)
        root = self.whitening.root.double()[rows]
        curvature, gradient = self.curvature, self.gradient
        by_shared, now = self.by_shared, (self.shared / self.sigmas)[self.free]
        if extra is not None:
            by_shared, now = torch.cat([by_shared, extra], 2), torch.cat([now, now.new_zeros(extra.shape[2])])
        own = root.mT @ curvature

        def summed(of_frames: Tensor) -> Tensor:
            return torch.zeros(count, *of_frames.shape[1:], dtype=torch.float64).index_add(0, rows, of_frames)

        normal = NormalEquations(
            summed(own @ root) + torch.eye(6, dtype=torch.float64),
            summed(own @ by_shared),
            (by_shared.mT @ curvature @ by_shared).sum(0) + torch.eye(len(now), dtype=torch.float64),
            -summed(times(root.mT, gradient)) - self.value.double(),
            -times(by_shared.mT, gradient).sum(0) - now,
        )
        if not self.cells:
            return normal
        seen, cells = list(self.cells), list(self.cells.values())
        brackets = [self.of_frame[i] for i in seen]
        reach_m = self.cell_m if reach_m is None else reach_m
        return normal.with_cells(cells, brackets, root[seen], by_shared[seen], self.cell_m, reach_m)

    def left_open(self) -> tuple[Tensor, Tensor]:
        """Return the covariances of the shared parameters [S, S] and of the brackets [P, 6, 6], in units of the prior.

        They follow from what was gathered. Where its pictures told of the surface's cells, what moves poses and surface
        together counts as not known.
        """
        return self._covariances(self._normal_equations(self.body_motions() if self.cells else None))

    def _covariances(self, normal: NormalEquations | ReducedEquations) -> tuple[Tensor, Tensor]:
        """Return the covariances as `left_open` does, without those of further parameters."""
        shared, own = normal.covariances()
        size = self.by_shared.shape[2]
        return shared[:size, :size], own

    def estimate(self, frames: list[TrainingFrame]) -> PoseEstimate:
        """Return the corrected poses and their corrections, with prior and posterior deviations.

        The posterior deviations are those of the time when poses and surface last moved together, if they did, else
        those of the likelihood that was gathered last; `DOUBT` times, as long as the prior allows it.
        """
        shared, own = (_doubted(part) for part in self.together or self.left_open())
        root, spread = self.whitening.root.double(), torch.zeros(SIZE, SIZE, dtype=torch.float64)
        sigmas = self.sigmas[self.free]
        chosen = torch.nonzero(self.free)[:, 0]
        spread[chosen[:, None], chosen] = sigmas[:, None] * shared * sigmas
        posterior = spread.diagonal().clamp(min=0).sqrt()
        navigation = frames[0].navigation
        prior = SharedParameters() if navigation is None else navigation.sigmas
        last = torch.from_numpy(prior.vector())[-1:]
        return PoseEstimate(
            frame_ids=[f.id for f in frames],
            brackets=self.of_frame,
            tagged=self.tags.numpy(),
            estimated=self.corrected(list(range(len(frames)))).double().numpy(),
            shared=SharedParameters.of(self.shared.numpy()),
            shared_prior=prior,
            shared_posterior=SharedParameters.of(torch.cat([posterior[:-1], last]).numpy()),
            shared_covariance=spread.numpy(),
            own=times(root, self.value.double()).numpy(),
            own_prior=(root @ root.mT).diagonal(dim1=1, dim2=2).sqrt().numpy(),
            own_posterior=(root @ own @ root.mT).diagonal(dim1=1, dim2=2).clamp(min=0).sqrt().numpy(),
        )

    def _change_shared(self, frames: list[TrainingFrame], deviations: Tensor) -> None:
        """Change the shared parameters that are free by [S] prior deviations."""
        if deviations.numel():
            change = torch.zeros(SIZE, dtype=torch.float64)
            change[self.free] = self.sigmas[self.free] * deviations
            self._move_shared(frames, self.shared + change)

    def _move_shared(self, frames: list[TrainingFrame], shared: Tensor) -> None:
        """Set the shared parameters, and what they make of the tags."""
        motion, at = motion_of(frames), SharedParameters.of(shared.numpy())
        self.shared, self.moved = shared, torch.from_numpy(displaced(motion, at))
        further = ((shared - self.linear_at) / self.sigmas)[self.free].abs().max()
        if not further <= LINEAR:  # also the first time, when it is NaN
            columns = torch.from_numpy(jacobian(motion, at))
            self.by_shared, self.linear_at = columns[:, :, self.free] * self.sigmas[self.free], shared

    def fix_gauge(self, gaussians: Gaussians, frames: list[TrainingFrame], as_one: bool = False) -> Gaussians:
        """Return the model moved and scaled to where the corrections, moved with it, are smallest in their deviations.

        Moving the model rigidly by d and every pose by its inverse changes no image, nor does a larger model that is
        farther away by as much, so training leaves both open. Changes that would move a direction in which a tag is
        exact are excluded, unless a shared parameter takes them up.

        Args:
            as_one: all brackets together count as one beside the shared parameters. The model's errors are alike in
                all of them, and if each counted by itself, differences far smaller than any picture shows would fix
                the body's size (experiment 103).
        """
        whole, target = torch.eye(4, dtype=torch.float64), self.corrected(list(range(len(frames)))).double()
        log_scale = 0.0
        for _ in range(GAUGE_ROUNDS):
            motion, shared = self._gauge(target, as_one)
            rigid = rigid_motions(motion[None, :6])[0]
            scale = torch.exp(motion[6])
            whole[:3] *= scale
            target[:, :3, 3] *= scale
            log_scale += float(motion[6])
            whole = rigid @ whole
            target = target @ torch.linalg.inv(rigid)
            self._change_shared(frames, shared)
            left, before = motion_vectors(target @ torch.linalg.inv(self.moved)), self.value
            self.value = times(self.whitening.inverse, self._bracket_means(left)).float()
            if max([*(self.value - before).abs().flatten(), *shared.abs()]) < SETTLED:
                break
        return _transformed(gaussians, whole, log_scale)

    def _gauge(self, poses: Tensor, as_one: bool) -> tuple[Tensor, Tensor]:
        """Return the change of the body that makes the corrections smallest, and that of the shared parameters [S].

        The former [7] is a small motion and a logarithm of its size. It adds adjoint · d to each correction, which the
        shared parameters may take up instead.
        """
        size = self.by_shared.shape[2]
        farther = torch.cat([torch.zeros(len(poses), 3, 1, dtype=poses.dtype), poses[:, :3, 3:]], dim=1)
        columns = [-adjoints(poses), farther, -self.by_shared]
        adjoint = self._bracket_means(torch.cat(columns, dim=2))  # [P, 6, 7 + S]
        free = _null_space((self.whitening.exact @ adjoint).flatten(0, 1))
        alike = len(self.value) ** -0.5 if as_one and size else 1.0
        own_rows = alike * (self.whitening.inverse @ adjoint).flatten(0, 1)
        shared_rows = torch.cat([torch.zeros(size, 7, dtype=torch.float64), torch.eye(size).double()], dim=1)
        rows = torch.cat([own_rows, shared_rows]) @ free
        now = torch.cat([alike * self.value.flatten().double(), (self.shared / self.sigmas)[self.free]])
        change = free @ (torch.linalg.pinv(rows) @ -now)
        return change[:7], change[7:]

    def _bracket_means(self, of_frames: Tensor) -> Tensor:
        """Return the mean over each bracket's frames [P, ...] of what each frame has [F, ...]."""
        of_frame = torch.tensor(self.of_frame)
        sums = torch.zeros(len(self.value), *of_frames.shape[1:], dtype=of_frames.dtype)
        frames = torch.bincount(of_frame).view(-1, *[1] * (of_frames.dim() - 1))
        return sums.index_add(0, of_frame, of_frames) / frames


def with_estimate(frames: list[TrainingFrame], estimate: PoseEstimate) -> list[TrainingFrame]:
    """Return frames with the tags that an estimate of the shared parameters makes of theirs, and what is left to doubt.

    Their covariance is that of the tag's own errors plus that of the estimated parameters.
    """
    if frames[0].navigation is None:
        return frames
    poses = PoseCorrections(frames)
    motion = motion_of(frames)
    columns = torch.from_numpy(jacobian(motion, estimate.shared))
    spread = columns @ torch.from_numpy(estimate.shared_covariance) @ columns.mT
    root = poses.whitening.root.double()[poses.of_frame]
    places = torch.from_numpy(displaced(motion, estimate.shared)).float()
    return [
        dataclasses.replace(f, world_to_camera=place, pose_covariance=own + shared, navigation=None)
        for f, place, own, shared in zip(frames, places, root @ root.mT, spread, strict=True)
    ]


def _doubted(covariance: Tensor) -> Tensor:
    """Return covariances [..., n, n], in units of the prior, with pictures that count `DOUBT` squared times less."""
    unit = torch.eye(covariance.shape[-1], dtype=covariance.dtype)
    told = torch.linalg.inv(covariance) - unit
    return torch.linalg.inv(told / DOUBT**2 + unit)


def _transformed(gaussians: Gaussians, similarity: Tensor, log_scale: float) -> Gaussians:
    """Return a model after a similarity [4, 4], given with the logarithm of its size; radiance does not turn along."""
    turn = motion_vectors(similarity[None] / math.exp(log_scale))[0, :3].to(gaussians.quats)
    matrix = similarity.to(gaussians.means)
    return dataclasses.replace(
        gaussians,
        means=gaussians.means @ matrix[:3, :3].T + matrix[:3, 3],
        log_scales=gaussians.log_scales + log_scale,
        quats=multiply(from_rotation_vectors(turn).expand(len(gaussians), 4), gaussians.quats),
    )


def motion_of(frames: list[TrainingFrame]) -> NominalMotion:
    """Return the nominal motion of frames that state their navigation."""
    navigation = frames[0].navigation
    assert navigation is not None
    poses = torch.stack([f.world_to_camera for f in frames]).double().numpy()
    attitudes = np.stack(
        [np.eye(3) if f.inertial_to_body is None else f.inertial_to_body.numpy() for f in frames]
    )
    times_s = np.array([f.time_s for f in frames])
    return NominalMotion.of_poses(
        times_s,
        poses,
        attitudes,
        mean_motion_rad_s=navigation.mean_motion_rad_s,
        inertial_to_rtn=navigation.inertial_to_rtn,
        rate_rad_s=navigation.rate_rad_s,
        inertia=navigation.inertia,
        rate_steps=navigation.rate_steps,
    )


def _null_space(rows: Tensor) -> Tensor:
    """Return an orthonormal basis [n, k] of what all rows [M, n] map to zero, whatever their lengths."""
    missing = rows.shape[1] - rows.shape[0]
    if missing > 0:  # else directions that no row sees would not be returned
        rows = torch.cat([rows, rows.new_zeros(missing, rows.shape[1])])
    lengths = rows.norm(dim=1, keepdim=True)
    _, singular, basis = torch.linalg.svd(torch.where(lengths > 0, rows / lengths, 0.0), full_matrices=False)
    return basis[singular < NULL].T
