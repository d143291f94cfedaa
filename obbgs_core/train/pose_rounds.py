"""When and how the poses move together with the model that is trained on them."""

import torch

from obbgs_core.pose_estimate import PoseEstimate
from obbgs_core.registration import pose_information
from obbgs_core.render import render
from obbgs_core.train.poses import ALIGNED_FROM
from obbgs_core.train.setup import TrainingSetup
from obbgs_core.train.state import TrainingState

ROUNDS = 25  # in which the poses would move if they did so during the whole training
CELLS = 12  # of the surface along the target's radius
RENDERED = 6  # frames at a time


def is_due(setup: TrainingSetup, state: TrainingState, share: float) -> bool:
    """Return whether the poses move in this step."""
    begin = ALIGNED_FROM if state.poses_aligned else setup.config.poses.refine_from
    return state.poses is not None and share >= begin and is_turn(setup, state)


def is_turn(setup: TrainingSetup, state: TrainingState) -> bool:
    """Return whether it is the turn of a round."""
    whole = setup.config.steps_until(1) - setup.config.steps_until(0)
    return state.steps_done % max(1, round(whole / ROUNDS)) == 0


def cell_m(setup: TrainingSetup) -> float:
    """Return the edge of the cells that the surface is divided into."""
    return setup.radius_m / CELLS


def move(setup: TrainingSetup, state: TrainingState, scale: float) -> None:
    """Move the poses to where one frame of each bracket wants them if the surface goes along; settle the gauge.

    The frames of a bracket take turns.

    Args:
        scale: of the images.
    """
    poses = state.poses
    assert poses is not None
    turn, brackets = state.steps_done, [[] for _ in range(len(poses.value))]
    for index, bracket in enumerate(poses.of_frame):
        brackets[bracket].append(index)
    _gather(setup, state, [members[turn % len(members)] for members in brackets], scale)
    poses.step(setup.frames)
    poses.clear()
    state.gaussians = poses.fix_gauge(state.gaussians.detach(), setup.frames).trainable()


def estimate(setup: TrainingSetup, state: TrainingState, scale: float) -> PoseEstimate | None:
    """Return what all frames say of the poses by the model as it stands; None where they are as tagged."""
    if state.poses is None:
        return None
    _gather(setup, state, list(range(len(setup.frames))), scale)
    found = state.poses.estimate(setup.frames)
    state.poses.clear()
    return found


@torch.no_grad()
def _gather(setup: TrainingSetup, state: TrainingState, indices: list[int], scale: float) -> None:
    """Let pictures of the model as it stands say what the frames tell of their poses and of the surface."""
    poses, model = state.poses, state.model.detach()
    assert poses is not None
    for first in range(0, len(indices), RENDERED):
        batch = setup.batches.batch(indices[first : first + RENDERED], scale)
        cameras = poses.cameras(batch.indices, batch.cameras)
        rendered = render(model, cameras)
        images = (rendered.radiance, rendered.alpha, rendered.depth)
        readings = (batch.exposure_time_s, batch.dn, setup.sensor, batch.averaged_pixels)
        poses.gather(batch.indices, pose_information(*images, cameras, *readings, cell_m=cell_m(setup)))
