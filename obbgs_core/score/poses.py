"""Fair scores of models whose poses were refined: the model may have moved as a whole, and its tags err.

Pictures are compared from poses that are settled on each held-out frame with the model fixed, and from true poses
after the motion of the model that brings its estimated poses nearest to the true ones: a rigid one, and a similarity,
which may change the model's size as well. A larger target that is farther away by as much gives the same pictures, so
where navigation leaves the range open nothing can tell the size. Geometry and poses are compared after either motion.
"""

import dataclasses
from dataclasses import dataclass

import torch
from torch import Tensor

from obbgs_core.frames import TrainingFrame, averaged, cameras_of
from obbgs_core.losses import likelihood_loss
from obbgs_core.model.gaussians import Gaussians
from obbgs_core.model.motions import motion_vectors
from obbgs_core.model.rotations import from_rotation_vectors, multiply
from obbgs_core.poses.corrections import PoseCorrections
from obbgs_core.poses.gauge import seen_after, seen_points
from obbgs_core.poses.registration import pose_information
from obbgs_core.render.slopes import render_with_slopes
from obbgs_core.sensor import Sensor

SCALES = (
    4,
    2,
    1,
)  # sensor pixels along a side of a pixel of the pictures that a pose is settled on, coarse to fine
STEPS = 4  # of Gauss and Newton on each
SMALLEST_PX = 24  # no picture is averaged to fewer pixels along a side


@dataclass(frozen=True)
class PoseErrors:
    """How far poses are from the true ones, root mean squares over them.

    rotation_deg: of the turn from true to estimated camera axes; range_share: of the camera's distance from its true
    place over its range; pixels: of the projections of points of the target.
    """

    rotation_deg: float
    range_share: float
    pixels: float


def pose_errors(
    estimated: Tensor, true: Tensor, motion: Tensor, radius_m: float, focal_px: float
) -> PoseErrors:
    """Return how far estimated poses [N, 4, 4] are from true ones after the body's motion [4, 4]."""
    estimated, moved = estimated.double(), seen_after(true.double(), motion.double())
    errors = motion_vectors(estimated @ torch.linalg.inv(moved))
    centres = [-(p[:, :3, :3].mT @ p[:, :3, 3:])[..., 0] for p in (estimated, moved)]
    ranges = moved[:, :3, 3].norm(dim=1)
    _, away = seen_points(moved, estimated, radius_m)

    def root_mean_square(values: Tensor) -> float:
        return values.square().mean().sqrt().item()

    return PoseErrors(
        rotation_deg=root_mean_square(torch.rad2deg(errors[:, :3].norm(dim=1))),
        range_share=root_mean_square((centres[0] - centres[1]).norm(dim=1) / ranges),
        pixels=focal_px * root_mean_square(away.norm(dim=-1)),
    )


def moved(gaussians: Gaussians, motion: Tensor) -> Gaussians:
    """Return a model after a rigid motion [4, 4]; radiance that turns with the view or the Sun does not turn along."""
    turn = quat_of(motion[:3, :3]).to(gaussians.quats)
    rigid = motion.to(gaussians.means)
    return dataclasses.replace(
        gaussians,
        means=gaussians.means @ rigid[:3, :3].T + rigid[:3, 3],
        quats=multiply(turn.expand(len(gaussians), 4), gaussians.quats),
    )


def quat_of(rotation: Tensor) -> Tensor:
    """Return the quaternion [4] w, x, y, z of a rotation [3, 3] by less than half a turn."""
    pose = torch.eye(4, dtype=rotation.dtype)
    pose[:3, :3] = rotation
    return from_rotation_vectors(motion_vectors(pose[None])[0, :3])


def settled_poses(model: Gaussians, frames: list[TrainingFrame], sensor: Sensor) -> Tensor:
    """Return the poses [F, 4, 4] of frames, each settled on its own picture with the model fixed.

    Gauss-Newton steps on the likelihood of the picture and the prior of its tag, coarse pictures first. The best pose
    on the whole picture is kept, so that no pose becomes worse.

    Args:
        frames: with tags and their whole covariances; one without covariance keeps its pose.
    """
    return torch.stack([_settled(model, frame, sensor) for frame in frames])


@torch.no_grad()
def _settled(model: Gaussians, frame: TrainingFrame, sensor: Sensor) -> Tensor:
    alone = [dataclasses.replace(frame, navigation=None)]
    poses, whole, best = PoseCorrections(alone), cameras_of(alone), (float("inf"), frame.world_to_camera)
    if not int(poses.rank[0]):
        return frame.world_to_camera
    exposure_s = torch.tensor(frame.exposure_time_s).view(1, 1, 1, 1)
    for factor in (f for f in SCALES if f == 1 or min(frame.shape[:2]) >= f * SMALLEST_PX):
        dn, cameras = averaged(frame.dn, factor, sensor.white_dn)[None], whole.scaled(1 / factor)
        for _ in range(STEPS):
            at = poses.cameras([0], cameras)
            rendered, slopes = render_with_slopes(model, at)
            images = (exposure_s, dn, sensor, factor * factor)
            if factor == 1:
                loss = likelihood_loss(rendered.radiance, *images)[0].item() * dn.numel()
                best = min(
                    best,
                    (loss + 0.5 * poses.value.square().sum().item(), poses.corrected([0])[0]),
                    key=_first,
                )
            views = (rendered.radiance, slopes, rendered.alpha, rendered.depth)
            poses.gather([0], pose_information(*views, at, *images))
            poses.step(alone)
    return best[1]


def _first(pair: tuple[float, Tensor]) -> float:
    return pair[0]
