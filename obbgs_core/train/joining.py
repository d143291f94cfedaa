"""More frames for a training that is under way: what was learnt is kept, and the start is carved again."""

import dataclasses
import logging

import torch
import torch.nn.functional as F
from scipy.spatial import KDTree
from torch import Tensor

from obbgs_core.evidence.gains import padded_to
from obbgs_core.evidence.highlights import first_lobes
from obbgs_core.evidence.poses import every_seventh_bracket
from obbgs_core.methods.config import SET_BACK_TO, SET_BACKS, MethodConfig
from obbgs_core.model.cameras import stacked_suns
from obbgs_core.model.gaussians import Gaussians
from obbgs_core.render.lighting import constant_towards
from obbgs_core.start import hull
from obbgs_core.train.adam import Adam
from obbgs_core.train.parts import Change
from obbgs_core.train.poses import PoseDecision, Poses
from obbgs_core.train.selection import SUN_FROM
from obbgs_core.train.setup import TrainingSetup
from obbgs_core.train.state import TrainingState

log = logging.getLogger(__name__)
JOINED_AT = 0.25  # share of the steps that the schedule is set back to when frames join (experiment 049)
# A Gaussian stays while so many of the silhouettes see light near its centre: fewer than carve the hull, because
# training has moved it to where it explains the pictures.
STAYING_AGREEMENT = 0.7
# rounds in which a frame's pose has moved, in the mean, after which no schedule is set back for the poses again
SETTLED_ROUNDS = 10.0
NEW_SPACINGS = 2.0  # a new point of the hull becomes a Gaussian where none is within so many of its spacings


def check_joinable(config: MethodConfig) -> None:
    """Refuse a method whose training cannot take in frames on its way.

    Raises:
        ValueError: such a method.
    """
    if not config.exposure_aware or config.published.compensation or config.published.coarse:
        raise ValueError(
            f"no frames can join a training of {config.name}: it must know exposure times, learn no colours of single "
            "frames and have no coarse stages, as obbgs"
        )


def join(setup: TrainingSetup, state: TrainingState, joined: TrainingSetup, fresh: TrainingState) -> None:
    """Change the state of a training so that it goes on with more frames.

    Gaussians stay where the silhouettes of all frames still see light. Of the start that was carved of all frames those
    are added that are on no surface of the earlier start and where the model has nothing. The schedule is set back to
    the share `JOINED_AT` of the steps, or to where the Sun is tested if only now it is known to move.

    Args:
        setup: of the training so far.
        joined: of all frames; it begins with those of `setup`, in their order.
        fresh: the state in which a training of `joined` would start.
    """
    config, gaussians, poses = joined.config, state.gaussians.detach(), state.poses
    share = JOINED_AT
    if poses.corrections is not None:  # poses and surface settle together only while the rates are large
        share = min(share, SET_BACK_TO)
        if gaussians.shading == "view":  # what turns with the view would explain what the poses should
            coefficients = (config.published.sh_degree + 1) ** 2
            gaussians = dataclasses.replace(gaussians.matt(), sh=gaussians.sh[:, :coefficients].contiguous())
            state.adam, state.highlights.frames = Adam(gaussians), 0
    position = min(state.steps_done, round(config.steps_until(share)))
    if joined.sun_moves and not setup.sun_moves and config.published.sh_degree == 0:
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
    state.adam.betas = fresh.adam.betas  # others where only now the Sun is known to move
    state.shadows, state.average, state.has_joined = fresh.shadows, fresh.average, True
    state.extension = fresh.extension
    if poses.corrections is not None:
        poses.corrections = fresh.poses.corrections
        poses.moved *= len(setup.frames) / len(joined.frames)
    elif not poses.decision.is_tested or fresh.poses.corrections is not None:
        state.poses = poses = dataclasses.replace(fresh.poses, moved=poses.moved)
    poses.placed_by, poses.round = fresh.poses.placed_by, None
    state.apply(joined, Change(Gaussians.concatenate([old, new]), kept))
    state.order.extend(joined.exposures_s)
    withhold(joined, state)
    state.steps_done = position


def withhold(setup: TrainingSetup, state: TrainingState) -> None:
    """Draw from all frames, but for every seventh bracket until it has told what it is kept back for.

    That is whether poses are refined, and the model's own error. Brackets keep their numbers when others follow, so
    those that tell it have never been trained on.
    """
    wanted = state.poses.decision.is_open or state.keeps_unseen(setup)
    state.order.keep_back(every_seventh_bracket(setup.frames) if wanted else [])


def release(setup: TrainingSetup, state: TrainingState) -> None:
    """Train on the withheld brackets too where they stayed too few for a decision, because no frames follow."""
    if state.poses.decision is PoseDecision.TOO_FEW_BRACKETS and state.order.validation_brackets:
        state.order.keep_back([])
        state.steps_done = min(state.steps_done, round(setup.config.steps_until(JOINED_AT)))


def begun_again(state: TrainingState, fresh: TrainingState) -> TrainingState:
    """Return a state before the first step, with the refined poses of a training that frames joined, if they hold.

    Args:
        fresh: the state in which a training of all frames from these poses would start.
    """
    again, poses = state.begun_again(fresh), state.poses
    if poses.corrections is not None and fresh.poses.corrections is poses.corrections:
        set_backs = 0 if poses.moved >= SETTLED_ROUNDS else SET_BACKS
        told = (poses.decision, poses.corrections, poses.reason, True, set_backs, fresh.poses.placed_by)
        again.poses = Poses(*told)
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
