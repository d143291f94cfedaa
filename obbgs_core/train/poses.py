"""Whether the tagged poses are refined, when they move together with the model that is trained, and how far."""

import copy
import dataclasses
import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from types import MappingProxyType

from obbgs_core.evidence.poses import correction_evidence
from obbgs_core.frames import pose_numbers
from obbgs_core.methods.config import SET_BACK_AT, SET_BACK_TO, SET_BACKS, Moment
from obbgs_core.model.gaussians import Gaussians
from obbgs_core.poses.answers import PoseRound, Question
from obbgs_core.poses.corrections import PoseCorrections
from obbgs_core.poses.estimate import PoseEstimate
from obbgs_core.train.adam import learning_rates
from obbgs_core.train.order import FrameOrder
from obbgs_core.train.parts import Change, Now
from obbgs_core.train.setup import Start, TrainingSetup

REFINED_FROM = 0.25  # share of the steps before which the model is too coarse for it (experiment 044)
ALIGNED_FROM = 0.05  # the same, of poses that were aligned before the start (experiment 079)
# In so many rounds the poses would move during a whole training if they moved as often as before `SET_BACK_AT`, or as
# after it (experiment 079).
EARLY_ROUNDS, LATE_ROUNDS = 60, 25
# Of more, rounds are the rarer the more there are, of twice as many and more so rare that all take half the time; not
# where navigation's errors are shared: with 105 of the demo, 0.29 px were left of them instead of 0.11.
MANY_BRACKETS = 50
SURFACE_UNTIL = 0.5  # share of the steps until which the Gaussians go along with the surface's cells then
CELLS = 12  # of the surface along the target's radius
# after which the answer of a round is used, at most: about as many as it takes where a core is free (experiment 083)
ANSWER_STEPS = 16
# share of the steps after which brackets that do not fit are left out: poses have mostly settled
LEFT_OUT_FROM = 0.6
# share of the steps from which brackets count as one where the gauge is settled: earlier, a frame with the Earth went
# 3 px astray (experiment 103)
AS_ONE_FROM = 0.8
# by which a picture's residuals stand out, where its bracket is left out (`Answer.standing_out`), and where it is asked
# in small from then on (`Answer.doubtful`)
FAR, DOUBTFUL = 6.0, 3.0
# shares of the steps until which frames that have the Earth are asked in pictures of these shares of their size; the
# first is also that of frames whose residuals stand out
COARSE_UNTIL = ((0.15, 0.25), (0.3, 0.5))
SMALLEST_PX = 24  # along a side, of the pictures of the latter
log = logging.getLogger(__name__)


class PoseDecision(Enum):
    """Whether the tagged poses are refined."""

    OPEN = "open"  # the validation brackets will decide
    NEVER = "never"  # by the settings
    EXACT_TAGS = "exact tags"
    TOO_FEW_BRACKETS = "too few brackets"
    TAGS_HOLD = "tags hold"  # the validation brackets say so
    REFINED = "refined"

    @property
    def is_tested(self) -> bool:
        """Whether validation brackets have decided, or the settings."""
        return self in (PoseDecision.NEVER, PoseDecision.TAGS_HOLD, PoseDecision.REFINED)

    @property
    def is_open(self) -> bool:
        """Whether validation brackets are still to decide, or would if there were enough of them."""
        return self in (PoseDecision.OPEN, PoseDecision.TOO_FEW_BRACKETS)


WHY_TAGGED = {  # for people alone
    PoseDecision.OPEN: "training ended before this was decided",
    PoseDecision.EXACT_TAGS: "the tags are exact",
    PoseDecision.TOO_FEW_BRACKETS: "too few brackets for validation",
}


@dataclass
class Poses:
    """The poses of a training.

    reason: what the decision rests on, in words for the report; nothing where the decision says it all.
    corrections: None: as tagged.
    aligned: before the first step, or by rounds before the schedule was set back.
    set_backs: how often the schedule will still be set back for them.
    placed_by: refined poses that the setup was made with, as they were then; None: it was made with the tags.
    round: under way.
    moved: rounds in which the pose of a frame has moved, mean of the frames.
    doubtful: frames whose residuals stood out in the last round.
    """

    decision: PoseDecision
    corrections: PoseCorrections | None
    reason: str = ""
    aligned: bool = False
    set_backs: int = 0
    placed_by: PoseCorrections | None = None
    round: PoseRound | None = None
    moved: float = 0.0
    doubtful: Sequence[int] = ()

    @staticmethod
    def first(
        setup: TrainingSetup, start: Start, are_enough: bool, refined: PoseCorrections | None
    ) -> "Poses":
        """Return the poses before the first step.

        Args:
            are_enough: the validation brackets, to decide.
            refined: poses that the start was made with.
        """
        placed_by = copy.deepcopy(refined)
        if start.poses is not None:
            return Poses(PoseDecision.REFINED, start.poses, start.why, True, SET_BACKS, placed_by)
        if setup.config.poses.refine == "always":
            return Poses(PoseDecision.REFINED, PoseCorrections(setup.frames), set_backs=SET_BACKS)
        if setup.config.poses.refine == "never":
            return Poses(PoseDecision.NEVER, None)
        if not PoseCorrections(setup.frames).covariances.any():
            return Poses(PoseDecision.EXACT_TAGS, None)
        return Poses(PoseDecision.OPEN if are_enough else PoseDecision.TOO_FEW_BRACKETS, None)

    @property
    def report(self) -> str:
        """Whether they are refined, and why, in words."""
        if self.decision is PoseDecision.REFINED:
            said, why = "refined", ""
        else:
            said, why = "as tagged", WHY_TAGGED.get(self.decision, "")
        why = self.reason or why
        return f"{said} ({why})" if why else said

    def due(self, now: Now) -> bool:
        """Return whether a decision is due, or a round begins or is answered."""
        return self._is_tested(now) or self._begins(now) or self._is_answered(now)

    def decide(self, now: Now) -> Change | None:
        """Test the tags, begin a round, or return the model and move the poses as the last round says.

        A round takes as long as some steps, in which training goes on. When its answer is used is counted in steps, not
        in seconds, so that results do not depend on the machine; until it is there, the training waits for it.
        """
        if self._is_tested(now):
            self._test(now)
        if self._begins(now):
            self.round = self._begun(now)
        return self._move(now, self.round) if self.round is not None and self._is_answered(now) else None

    def _is_tested(self, now: Now) -> bool:
        is_time = now.moment.share >= REFINED_FROM and is_turn(now.setup, now.moment)
        return self.decision is PoseDecision.OPEN and is_time

    def _begins(self, now: Now) -> bool:
        if self.corrections is None or self.round is not None:
            return False
        is_time = now.moment.share >= (ALIGNED_FROM if self.aligned else REFINED_FROM)
        # models are averaged from one round to the next: a round near the end would leave none to average
        steps = steps_between(now.setup, now.moment.share)
        in_time = now.config.steps - now.moment.done > _delay(steps) + steps // 2
        return is_time and is_turn(now.setup, now.moment) and in_time

    def _is_answered(self, now: Now) -> bool:
        return self.round is not None and now.taken >= self.round.answered_at

    def _test(self, now: Now) -> None:
        """Refine the poses if the validation brackets say that they err.

        They are asked before the first round of refinement, and trained on from then on, or once they have told the
        model's own error (`Fit`).
        """
        setup = now.setup
        brackets = [setup.batches.batch(b) for b in now.order.validation_brackets]
        evidence = correction_evidence(
            now.model.detach(), setup.frames, brackets, setup.sensor, cell_m(setup)
        )
        if evidence.justifies:
            self.decision, self.set_backs = PoseDecision.REFINED, SET_BACKS
            self.corrections = PoseCorrections(setup.frames)
        else:
            self.decision, self.set_backs, self.corrections = PoseDecision.TAGS_HOLD, 0, None
        self.reason = f"step {now.moment.done + 1}: {evidence}"
        log.info("poses %s", self.report)
        if evidence.justifies or not setup.keeps_unseen:
            now.order.keep_back([])

    def _begun(self, now: Now) -> PoseRound:
        """Return a round in which one frame of each bracket is asked; the frames of a bracket take turns."""
        poses, setup, done = self.corrections, now.setup, now.moment.done
        assert poses is not None
        brackets = [[] for _ in range(len(poses.value))]
        for index in now.order.fitting:
            brackets[poses.of_frame[index]].append(index)
        shown = [members for members in brackets if members]
        steps = steps_between(setup, now.moment.share)
        since = done - setup.config.steps_until(LEFT_OUT_FROM)
        return PoseRound(
            _question(
                setup,
                now.model,
                poses,
                [members[done // steps % len(members)] for members in shown],
                self._coarse(setup, now.moment.share),
            ),
            shown,
            answered_at=now.taken + _delay(steps),
            judges=0 <= since < steps_between(setup, LEFT_OUT_FROM),
        )

    def _coarse(self, setup: TrainingSetup, share: float) -> dict[int, float]:
        """Return the frames that are asked in smaller pictures, and the share of their size.

        They have the Earth, and so no silhouette to be aligned by, or they stand out: their poses may lie beyond what
        whole pictures lead back from.
        """
        early = next((scale for until, scale in COARSE_UNTIL if share < until), 1.0)
        of_earth = [i for i, frame in enumerate(setup.frames) if early < 1 and frame.earth_m is not None]
        small = COARSE_UNTIL[0][1]
        doubtful = [i for i in self.doubtful if small * min(setup.frames[i].shape[:2]) >= SMALLEST_PX]
        return dict.fromkeys(of_earth, early) | dict.fromkeys(doubtful, small)

    def _move(self, now: Now, asked: PoseRound) -> Change:
        """Move the poses to where one frame of each bracket wants them if the surface goes along; settle the gauge.

        Where poses were aligned and Gaussians are still added, these go along with the surface. At the first round
        after `LEFT_OUT_FROM` of the steps, brackets whose residuals stand out are left out of the training for good.
        """
        poses, setup, answer = self.corrections, now.setup, asked.answer()
        assert poses is not None
        self.round, self.moved = None, self.moved + 1
        poses.gather(answer.indices, answer.information)
        self.doubtful = [answer.indices[i] for i in answer.doubtful(DOUBTFUL)]
        if asked.judges:
            self._leave_out(now, poses, [asked.brackets[i] for i in answer.standing_out(FAR)])
        along = self.aligned and now.moment.share < SURFACE_UNTIL
        reach = cell_m(setup) if along else reach_m(setup, now.moment.share)
        motion, shifts = poses.step(setup.frames, poses.body_motions(), reach, together=along)
        poses.clear()
        gaussians = now.gaussians.detach()
        if shifts is not None and along:
            moved = gaussians.means + shifts.of_points(gaussians.means)
            gaussians = dataclasses.replace(gaussians, means=moved)
        gaussians = poses.after_motion(gaussians, motion)
        return Change(poses.fix_gauge(gaussians, setup.frames, now.moment.share >= AS_ONE_FROM), None)

    @staticmethod
    def _leave_out(now: Now, poses: PoseCorrections, brackets: list[list[int]]) -> None:
        """Train no more on some brackets, and forget what they said of the poses."""
        if not brackets:
            return
        indices = [i for members in brackets for i in members]
        now.order.leave_out(indices)
        for index in indices:
            poses.gradient[index], poses.curvature[index] = 0, 0
            poses.cells.pop(index, None)
        names = ", ".join(str(now.setup.frames[i].id) for i in now.order.left_out)
        log.warning(
            "step %d: frames %s fit no pose that their tags allow and are left out", now.moment.done, names
        )

    def set_back(self, setup: TrainingSetup, done: int) -> int:
        """Return how many steps count as done: fewer where the schedule is set back for the poses."""
        if not self.set_backs or done < round(setup.config.steps_until(SET_BACK_AT)):
            return done
        self.set_backs -= 1
        self.aligned = True  # by the rounds so far
        return round(setup.config.steps_until(SET_BACK_TO))

    def estimate(self, setup: TrainingSetup, model: Gaussians, order: FrameOrder) -> PoseEstimate | None:
        """Return what all frames say of the poses by a model; None where they are as tagged."""
        poses, shown = self.corrections, order.fitting
        if poses is None:
            return None
        poses.gather(shown, _question(setup, model, poses, shown).answer().information)
        found = poses.estimate(setup.frames).of_frames(shown)
        poses.clear()
        return found


def is_turn(setup: TrainingSetup, moment: Moment) -> bool:
    """Return whether it is the turn of a round."""
    return moment.done % steps_between(setup, moment.share) == 0


def steps_between(setup: TrainingSetup, share: float) -> int:
    """Return the number of steps from one round to the next at a share of the steps."""
    rounds = EARLY_ROUNDS if share < SET_BACK_AT else LATE_ROUNDS
    many = (1 + max(pose_numbers(setup.frames))) / MANY_BRACKETS
    rarer = max(1.0, many * min(2.0, many)) if setup.frames[0].navigation is None else 1.0
    return max(1, round(rarer * (setup.config.steps_until(1) - setup.config.steps_until(0)) / rounds))


def _delay(steps: int) -> int:
    """Return after how many steps a round is answered, of `steps` from one to the next."""
    return min(ANSWER_STEPS, steps - 1)


def cell_m(setup: TrainingSetup) -> float:
    """Return the edge of the cells that the surface is divided into."""
    return setup.radius_m / CELLS


def reach_m(setup: TrainingSetup, share: float) -> float:
    """Return how far training moves a Gaussian from one round to the next: by about its rate in each step."""
    rates = learning_rates(setup.config.rates, share, setup.unit_m, 1, setup.radiance_unit)
    return float(rates["means"]) * steps_between(setup, share)


def _question(
    setup: TrainingSetup,
    model: Gaussians,
    poses: PoseCorrections,
    indices: list[int],
    coarse: Mapping[int, float] = MappingProxyType({}),
) -> Question:
    """Return what frames are asked about a model and their poses as they stand; training may go on meanwhile."""
    batches, at = setup.batches.posed(setup.frames), poses.corrected(indices)
    return Question(model.copied(), batches, indices, at, setup.sensor, cell_m(setup), coarse)
