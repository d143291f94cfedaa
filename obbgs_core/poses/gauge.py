"""The gauge of estimated poses: a body that moves, and all poses with it, gives the same pictures."""

import torch
from torch import Tensor

from obbgs_core.frames import TrainingFrame
from obbgs_core.model.motions import adjoints, point_flow, rigid_motions
from obbgs_core.poses.corrections import PoseCorrections
from obbgs_core.poses.registration import PoseInformation

ROUNDS = 8  # of aligning, Gauss-Newton
# deviations of poses that a training has refined, and of those that silhouettes say, of projections on the target
REFINED_PX, ALIGNED_PX = 0.5, 2.0


def best_motion(estimated: Tensor, true: Tensor, radius_m: float, with_size: bool = False) -> Tensor:
    """Return the motion [4, 4] of the body after which estimated poses see it most nearly as the true ones do.

    The sum of the squared angles between the projections of seven points, the body's origin and six at `radius_m` from
    it, is least: what pictures show counts, and an error along the line of sight counts as little as it shows.

    Args:
        estimated, true: [N, 4, 4] world_to_camera; a point x of the model is at motion · x in the true body frame.
        with_size: a similarity, its upper left block size times a rotation, instead of a rigid motion.
    """
    estimated, true = estimated.double(), true.double()
    motion = torch.eye(4, dtype=torch.float64)
    # from the mean rotation on, since Gauss-Newton does not find back from half a turn
    u, _, v = torch.linalg.svd((true[:, :3, :3].mT @ estimated[:, :3, :3]).sum(dim=0))
    motion[:3, :3] = u @ torch.diag(torch.stack([*u.new_ones(2), torch.linalg.det(u @ v)])) @ v
    for _ in range(ROUNDS):
        now = seen_after(true, motion)
        flow, left = seen_points(now, estimated, radius_m)
        nearer = torch.cat(
            [torch.zeros_like(now[:, :3, 3:]), -now[:, :3, 3:]], dim=1
        )  # by the logarithm of size
        columns = torch.cat([adjoints(now), nearer], dim=2) if with_size else adjoints(now)
        change = torch.linalg.pinv((flow @ columns[:, None]).flatten(0, 2)) @ left.flatten()
        motion = motion @ rigid_motions(change[None, :6])[0]
        if with_size:
            motion[:3, :3] *= torch.exp(change[6])
    return motion


def size_of(motion: Tensor) -> float:
    """Return the factor by which a rigid motion (1) or a similarity [4, 4] makes the body larger."""
    return torch.linalg.det(motion[:3, :3].double()).item() ** (1 / 3)


def seen_after(poses: Tensor, motion: Tensor) -> Tensor:
    """Return the poses [N, 4, 4] that see the body before a motion [4, 4] as given ones see it after: rigid again."""
    seen = poses @ motion
    seen[:, :3] /= size_of(motion)
    return seen


def seen_points(now: Tensor, wanted: Tensor, radius_m: float) -> tuple[Tensor, Tensor]:
    """Return how seven points' projections (focal length 1) move with poses [N, 7, 2, 6], and how far they should.

    They are the body's origin and six points at `radius_m` from it; how far: [N, 7, 2] from `now` to `wanted`.
    """
    points = torch.cat([torch.zeros(1, 3), torch.eye(3), -torch.eye(3)]).double() * radius_m
    at, goal = (points @ poses[:, :3, :3].mT + poses[:, None, :3, 3] for poses in (now, wanted))
    flow = point_flow(at.flatten(0, 1), torch.eye(3).double().expand(at.shape[0] * at.shape[1], 3, 3))
    return flow.unflatten(0, at.shape[:2]), goal[..., :2] / goal[..., 2:] - at[..., :2] / at[..., 2:]


def joined(
    poses: PoseCorrections, aligned: PoseCorrections, frames: list[TrainingFrame], radius_m: float
) -> PoseCorrections:
    """Return refined poses of the first frames, and of the others those that silhouettes tell, as the model sees them.

    What the first frames of a pass tell of the shared parameters leads further and further astray with the time since
    (docs/experiments/078). The silhouettes of all frames tell where the others are, up to a similarity of the body.
    That is found from the poses known both ways.

    Args:
        poses: refined, of the first of the frames; their gauge is that of the model.
        aligned: of all frames, by their silhouettes.
        radius_m: of the target.
    """
    count = len(poses.of_frame)
    known, others = list(range(count)), list(range(count, len(frames)))
    refined, now = poses.corrected(known).double(), poses.extended(frames)
    motion = best_motion(refined, aligned.corrected(known), radius_m, with_size=True)
    wanted = torch.cat([refined, seen_after(aligned.corrected(others).double(), motion)])
    deviation_px = torch.tensor([REFINED_PX] * count + [ALIGNED_PX] * len(others), dtype=torch.float64)
    weight = (torch.stack([f.K[0, 0] for f in frames]).double() / deviation_px).square()[:, None, None]
    for _ in range(ROUNDS):
        flow, left = seen_points(now.corrected(known + others).double(), wanted, radius_m)
        flow = flow.flatten(1, 2) / flow.shape[1] ** 0.5  # the points of a pose count as one
        left = left.flatten(1, 2)[..., None] / left.shape[1] ** 0.5
        now.gather(
            known + others, PoseInformation(-(weight * flow.mT @ left)[..., 0], weight * flow.mT @ flow)
        )
        now.step(frames)
    now.clear()
    return now
