"""When and how the poses move together with the model that is trained on them."""

import dataclasses
import logging

import torch
from torch import Tensor

from obbgs_core.poses.answers import PoseRound, Question
from obbgs_core.poses.estimate import PoseEstimate
from obbgs_core.train.adam import learning_rates
from obbgs_core.train.order import FrameOrder
from obbgs_core.train.poses import (
    ALIGNED_FROM,
    EARLY_ROUNDS,
    HELD_AT,
    HELD_FROM,
    LATE_ROUNDS,
    SURFACE_UNTIL,
)
from obbgs_core.train.setup import TrainingSetup
from obbgs_core.train.state import TrainingState

CELLS = 12  # of the surface along the target's radius
# after which the answer of a round is used, at most: about as many as it takes where a core is free
ANSWER_STEPS = 16
# share of the steps after which brackets that do not fit are left out: poses have mostly settled
MISFIT_FROM = 0.6
# of the logarithms of the brackets' residuals: median absolute deviations, scaled to those of a normal distribution,
# above the median
MISFIT_DEVIATIONS = 6.0
MISFIT_FACTOR = 6.0  # and the residual as a share of the picture's light is above the median by this factor
log = logging.getLogger(__name__)


def advance(setup: TrainingSetup, state: TrainingState, share: float) -> None:
    """Begin a round where it is time for one, and move the poses by what the round before has found where that is due.

    A round takes as long as some steps, in which training goes on. When its answer is used is counted in steps, not in
    seconds, so that results do not depend on the machine; until it is there, the training waits for it.
    """
    if state.poses is None:
        return
    begin = ALIGNED_FROM if state.poses_aligned else setup.config.poses.refine_from
    steps = steps_between(setup, share)
    delay = min(ANSWER_STEPS, steps - 1)
    # models are averaged from one round to the next: a round near the end would leave none to average
    in_time = setup.config.steps - state.steps_done > delay + steps // 2
    if state.round is None and share >= begin and is_turn(setup, state, share) and in_time:
        state.round = _begun(setup, state, share, delay)
    if state.round is not None and len(state.history) >= state.round.answered_at:
        _move(setup, state, state.round)
        state.round = None


def is_turn(setup: TrainingSetup, state: TrainingState, share: float) -> bool:
    """Return whether it is the turn of a round, at the share of the steps that are done."""
    return state.steps_done % steps_between(setup, share) == 0


def steps_between(setup: TrainingSetup, share: float) -> int:
    """Return the number of steps from one round to the next at a share of the steps."""
    rounds = EARLY_ROUNDS if share < HELD_AT else LATE_ROUNDS
    return max(1, round((setup.config.steps_until(1) - setup.config.steps_until(0)) / rounds))


def cell_m(setup: TrainingSetup) -> float:
    """Return the edge of the cells that the surface is divided into."""
    return setup.radius_m / CELLS


def reach_m(setup: TrainingSetup, share: float) -> float:
    """Return how far training moves a Gaussian from one round to the next: by about its rate in each step."""
    rates = learning_rates(setup.config.rates, share, setup.unit_m, 1, setup.radiance_unit)
    return float(rates["means"]) * steps_between(setup, share)


def _begun(setup: TrainingSetup, state: TrainingState, share: float, delay: int) -> PoseRound:
    """Return a round in which one frame of each bracket is asked; the frames of a bracket take turns.

    delay: in steps, until it is answered.
    """
    poses = state.poses
    assert poses is not None
    brackets, left_out = [[] for _ in range(len(poses.value))], set(state.misfits)
    for index, bracket in enumerate(poses.of_frame):
        if index not in left_out:
            brackets[bracket].append(index)
    shown = [members for members in brackets if members]
    turn = state.steps_done // steps_between(setup, share)
    since = state.steps_done - setup.config.steps_until(MISFIT_FROM)
    return PoseRound(
        _question(setup, state, [members[turn % len(members)] for members in shown]),
        shown,
        answered_at=len(state.history) + delay,
        judges=0 <= since < steps_between(setup, MISFIT_FROM),
    )


def _move(setup: TrainingSetup, state: TrainingState, asked: PoseRound) -> None:
    """Move the poses to where one frame of each bracket wants them if the surface goes along; settle the gauge.

    Where poses were aligned and Gaussians are still added, these go along with the surface. At the first round after
    `MISFIT_FROM` of the steps, brackets whose residuals stand out are left out of the training for good.
    """
    poses, answer = state.poses, asked.answer()
    assert poses is not None
    state.pose_rounds += 1
    state.average = None  # of models at other poses, which may have moved as a whole since
    share = setup.config.moment(state.steps_done).share
    poses.gather(answer.indices, answer.information)
    if asked.judges:
        far = torch.nonzero(standing_out(answer.dispersion, answer.shares))[:, 0]
        _leave_out(setup, state, [asked.brackets[i] for i in far.tolist()])
    along = state.poses_aligned and share < SURFACE_UNTIL
    reach = cell_m(setup) if along else reach_m(setup, share)
    motion, shifts = poses.step(setup.frames, poses.body_motions(), reach, together=along)
    poses.clear()
    gaussians = state.gaussians.detach()
    if shifts is not None and along:
        gaussians = dataclasses.replace(gaussians, means=gaussians.means + shifts.of_points(gaussians.means))
    state.gaussians = poses.fix_gauge(poses.after_motion(gaussians, motion), setup.frames).trainable()


def hold(setup: TrainingSetup, state: TrainingState) -> None:
    """Set the schedule back, as often as poses that are refined want it, when it reaches `HELD_AT`."""
    if state.holds and state.steps_done >= round(setup.config.steps_until(HELD_AT)):
        state.holds -= 1
        state.poses_aligned = True  # by the rounds so far
        state.steps_done = round(setup.config.steps_until(HELD_FROM))


def standing_out(dispersion: Tensor, share: Tensor) -> Tensor:
    """Return which of P pictures are so far off that something else than the model's error is in them.

    Both residuals have to say so: the smallest error of a pose shows in deviations of the noise where thin structures
    are seen edge-on, but it moves little of the picture's light there.

    Args:
        dispersion: [P] mean squares in deviations of the noise, NaN where the target is not in the picture.
        share: [P] of the picture's light (`relative_misfit`), also NaN there.
    """
    logs = dispersion.log()
    above = logs - logs.nanmedian()
    far = above > MISFIT_DEVIATIONS * 1.4826 * above.abs().nanmedian()
    return far & (share > MISFIT_FACTOR * share.nanmedian())


def _leave_out(setup: TrainingSetup, state: TrainingState, brackets: list[list[int]]) -> None:
    """Train no more on some brackets, and forget what they said of the poses."""
    poses = state.poses
    assert poses is not None
    if not brackets:
        return
    for index in (i for members in brackets for i in members):
        state.misfits.append(index)
        poses.gradient[index], poses.curvature[index] = 0, 0
        poses.cells.pop(index, None)
    names = ", ".join(str(setup.frames[i].id) for i in state.misfits)
    log.warning(
        "step %d: frames %s fit no pose that their tags allow and are left out", state.steps_done, names
    )
    by_exposure, withheld = setup.config.bracket_steps, state.order.validation_brackets
    state.order = FrameOrder.of(setup.frames, by_exposure, withheld, state.misfits, state.order)


def fitting(setup: TrainingSetup, state: TrainingState) -> list[int]:
    """Return the indices of the frames that are trained on because they fit some pose that their tags allow."""
    return [i for i in range(len(setup.frames)) if i not in set(state.misfits)]


def estimate(setup: TrainingSetup, state: TrainingState) -> PoseEstimate | None:
    """Return what all frames say of the poses by the model as it stands; None where they are as tagged."""
    if state.poses is None:
        return None
    shown = fitting(setup, state)
    state.poses.gather(shown, _question(setup, state, shown).answer().information)
    found = state.poses.estimate(setup.frames).of_frames(shown)
    state.poses.clear()
    return found


def _question(setup: TrainingSetup, state: TrainingState, indices: list[int]) -> Question:
    """Return what frames are asked about the model and their poses as they stand; training may go on meanwhile."""
    assert state.poses is not None
    model, poses = state.model.copied(), state.poses.corrected(indices)
    return Question(model, setup.batches, indices, poses, setup.sensor, cell_m(setup))
