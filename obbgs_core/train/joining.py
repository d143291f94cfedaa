"""More frames for a training that is under way: what was learnt is kept, and the start is carved again."""

import dataclasses
import logging

import torch
import torch.nn.functional as F
from scipy.spatial import KDTree
from torch import Tensor

from obbgs_core.model.cameras import stacked_suns
from obbgs_core.model.gaussians import Gaussians
from obbgs_core.poses.evidence import every_seventh_bracket
from obbgs_core.render.lighting import constant_towards
from obbgs_core.start import hull
from obbgs_core.train.adam import Adam
from obbgs_core.train.appearance import SUN_FROM
from obbgs_core.train.config import MethodConfig
from obbgs_core.train.decisions import is_keeping_unseen, is_undecided, smooth
from obbgs_core.train.glints import first_lobes
from obbgs_core.train.growth import Growth
from obbgs_core.train.order import FrameOrder
from obbgs_core.train.parsimony import padded_to
from obbgs_core.train.poses import HELD_FROM, HOLDS, PoseDecision
from obbgs_core.train.setup import TrainingSetup
from obbgs_core.train.state import TrainingState

log = logging.getLogger(__name__)
# A Gaussian stays while so many of the silhouettes see light near its centre: fewer than carve the hull, because
# training has moved it to where it explains the pictures.
STAYING_AGREEMENT = 0.7
# rounds in which a frame's pose has moved, in the mean, after which no schedule is held for the poses again
SETTLED_ROUNDS = 10.0
NEW_SPACINGS = 2.0  # a new point of the hull becomes a Gaussian where none is within so many of its spacings


def check_joinable(config: MethodConfig) -> None:
    """Refuse a method whose training cannot take in frames on its way.

    Raises:
        ValueError: such a method.
    """
    if not config.exposure_aware or config.compensation or config.coarse:
        raise ValueError(
            f"no frames can join a training of {config.name}: it must know exposure times, learn no colours of single "
            "frames and have no coarse stages, as obbgs"
        )


def join(
    setup: TrainingSetup, state: TrainingState, joined: TrainingSetup, fresh: TrainingState, hold: float
) -> None:
    """Change the state of a training so that it goes on with more frames.

    Gaussians stay where the silhouettes of all frames still see light. Of the start that was carved of all frames those
    are added that are on no surface of the earlier start and where the model has nothing. The schedule is set back to
    the share `hold` of the steps, or to where the Sun is tested if only now it is known to move.

    Args:
        setup: of the training so far.
        joined: of all frames; it begins with those of `setup`, in their order.
        fresh: the state in which a training of `joined` would start.
    """
    config, gaussians = joined.config, state.gaussians.detach()
    if state.poses is not None:  # poses and surface settle together only while the rates are large
        hold = min(hold, HELD_FROM)
        if gaussians.shading == "view":  # what turns with the view would explain what the poses should
            coefficients = (config.light.sh_degree + 1) ** 2
            gaussians = dataclasses.replace(gaussians.matt(), sh=gaussians.sh[:, :coefficients].contiguous())
            state.adam, state.highlights_frames = Adam(gaussians), 0
    position = min(state.steps_done, round(config.steps_until(hold)))
    if joined.sun_moves and not setup.sun_moves and config.light.sh_degree == 0:
        position = min(position, max(0, round(config.steps_until(SUN_FROM)) - 1))
        # a direction that was chosen while the Sun stood still is chosen again
        constant = gaussians.sh[:, :1].contiguous()
        gaussians = dataclasses.replace(gaussians.matt(), sh=constant, shading="view")
        state.adam = Adam(gaussians)
    turning = gaussians.shading == "lambert" and gaussians.sh.shape[1] > 1
    if turning and not joined.albedos_turn:  # the Sun goes further round than it was known to
        suns = stacked_suns([frame.sun_dir for frame in setup.frames])
        assert suns is not None
        mean = F.normalize(suns.mean(dim=0), dim=0)
        gaussians = dataclasses.replace(gaussians, sh=constant_towards(gaussians, mean))
        state.adam = Adam(gaussians)
    kept = torch.nonzero(_stays(gaussians, joined))[:, 0]
    old, start = gaussians.select(kept), fresh.gaussians.detach()
    added = torch.nonzero(_is_new(start, setup.start_means, old.means))[:, 0]
    added = added[: max(0, config.growth.max_gaussians - len(kept))]
    new = dataclasses.replace(
        start.select(added),
        sh=padded_to(start.sh[added], gaussians.sh.shape[1]),
    )
    if gaussians.has_highlights:
        new = dataclasses.replace(
            new, lobes=first_lobes(new.means, joined.frames[0], gaussians), gloss=gaussians.gloss
        )
    log.info(
        "%d frames: %d of %d Gaussians stay on the hull, %d join them",
        *(len(joined.frames), len(kept), len(gaussians), len(new)),
    )
    state.gaussians = Gaussians.concatenate([old, new]).trainable()
    state.adam.follow(kept, len(new))
    state.adam.betas = fresh.adam.betas  # others where only now the Sun is known to move
    state.growth, state.boxes, state.shadows = Growth.of(len(state.gaussians)), [], fresh.shadows
    if state.poses is not None:
        state.poses = fresh.poses
        state.pose_rounds *= len(setup.frames) / len(joined.frames)
    elif not state.pose_decision.is_tested or fresh.poses is not None:
        state.poses, state.poses_aligned, state.holds = fresh.poses, fresh.poses_aligned, fresh.holds
        state.pose_decision, state.pose_evidence = fresh.pose_decision, fresh.pose_evidence
    state.placed_by, state.round = fresh.placed_by, None
    withhold(joined, state)
    smooth(joined, state)
    state.steps_done, state.average, state.has_joined = position, None, True


def withhold(setup: TrainingSetup, state: TrainingState) -> None:
    """Draw from all frames, but for every seventh bracket until it has told what it is kept back for.

    That is whether poses are refined, and the model's own error. Brackets keep their numbers when others follow, so
    those that tell it have never been trained on.
    """
    wanted = is_undecided(state) or is_keeping_unseen(setup, state)
    withheld = every_seventh_bracket(setup.frames) if wanted else []
    by_exposure = setup.config.bracket_steps
    state.order = FrameOrder.of(setup.frames, by_exposure, withheld, state.misfits, state.order)


def release(setup: TrainingSetup, state: TrainingState, hold: float) -> None:
    """Train on the withheld brackets too where they stayed too few for a decision, because no frames follow."""
    if state.pose_decision is PoseDecision.TOO_FEW_BRACKETS and state.order.validation_brackets:
        by_exposure = setup.config.bracket_steps
        state.order = FrameOrder.of(setup.frames, by_exposure, [], state.misfits, state.order)
        state.steps_done = min(state.steps_done, round(setup.config.steps_until(hold)))


def begun_again(state: TrainingState, fresh: TrainingState) -> TrainingState:
    """Return a state before the first step, with the refined poses of a training that frames joined, if they hold.

    Args:
        fresh: the state in which a training of all frames from these poses would start.
    """
    again = dataclasses.replace(
        fresh,
        history=state.history,
        seconds=state.seconds,
        removed_not_finite=state.removed_not_finite,
    )
    if state.poses is not None and fresh.poses is state.poses:
        again.pose_decision, again.pose_evidence = state.pose_decision, state.pose_evidence
        again.poses_aligned = True
        again.holds = 0 if state.pose_rounds >= SETTLED_ROUNDS else HOLDS
    return again


def _stays(gaussians: Gaussians, setup: TrainingSetup) -> Tensor:
    """Return which Gaussians [N] lie where enough silhouettes see light near their centres; all if none do."""
    reach_m = setup.radius_m / hull.COARSE_VOXELS
    stays = hull.agreement(list(setup.outlines.values()), gaussians.means, reach_m) >= STAYING_AGREEMENT
    return stays if stays.any() else torch.ones_like(stays)


def _is_new(start: Gaussians, earlier_means: Tensor, means: Tensor) -> Tensor:
    """Return which of the first Gaussians [N] are far from the centres of an earlier start and from a model's."""
    distances = [KDTree(m.numpy()).query(start.means.numpy())[0] for m in (earlier_means, means)]
    nearest_m = torch.from_numpy(distances[0]).minimum(torch.from_numpy(distances[1]))
    return nearest_m > NEW_SPACINGS * start.scales[:, 0]
