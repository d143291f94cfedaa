"""What a training decides on the way: pose refinement, adding and removing Gaussians, what the radiance depends on."""

import dataclasses
import logging
import math
from typing import Literal

import torch
from torch import Tensor

from obbgs_core.batches import Batch, Batches
from obbgs_core.errors import Diverged
from obbgs_core.losses import ON_TARGET_ALPHA
from obbgs_core.misfit import Compared, sampled, stated_misfit
from obbgs_core.poses.corrections import PoseCorrections
from obbgs_core.poses.evidence import correction_evidence
from obbgs_core.render import Rendered, render
from obbgs_core.train import pose_rounds
from obbgs_core.train.appearance import SUN_FROM, described, raised_degree
from obbgs_core.train.config import Moment
from obbgs_core.train.glints import FEWEST_STEPS, HIGHLIGHTS_FROM, MORE_FRAMES, along_normals, lobed
from obbgs_core.train.growth import (
    GRADIENT_THRESHOLD,
    Growth,
    densify,
    densify_boxes,
    finite,
    keep,
    near_camera_weight,
    reset_opacities,
    worst_boxes,
)
from obbgs_core.train.multi_view import crossing_boxes, inside, threshold_factor
from obbgs_core.train.order import FrameOrder
from obbgs_core.train.parsimony import justified
from obbgs_core.train.poses import HELD_AT, HOLDS, PoseDecision
from obbgs_core.train.setup import TrainingSetup
from obbgs_core.train.smoothing import sampling_deviation_m
from obbgs_core.train.state import TrainingState

# share of the steps from which brackets that were kept back are trained on (docs/experiments/093)
UNSEEN_UNTIL = 0.6
log = logging.getLogger(__name__)


def smooth(setup: TrainingSetup, state: TrainingState) -> None:
    """Find the widths of the 3D filter anew, where the method has one, because Gaussians have moved or are others."""
    if setup.config.smoothing_px2:
        state.smoothing_m = sampling_deviation_m(
            state.gaussians.means, batches_at(setup, state).frames, setup.config.smoothing_px2
        )


def batches_at(setup: TrainingSetup, state: TrainingState) -> Batches:
    """Return the training's images with the poses as they are estimated so far."""
    return setup.batches if state.poses is None else setup.batches.posed(state.poses.frames(setup.frames))


def is_recorded(setup: TrainingSetup, share: float) -> bool:
    """Return whether what growth decides by is recorded at this share of the steps."""
    growth = setup.config.growth
    return min(growth.begin, growth.recorded_from) <= share < growth.end


def is_growing(setup: TrainingSetup, share: float) -> bool:
    """Return whether Gaussians are added at this share of the steps."""
    return setup.config.growth.begin <= share < setup.config.growth.end


@torch.no_grad()
def observe(
    setup: TrainingSetup,
    state: TrainingState,
    rendered: Rendered,
    batch: Batch,
    residual: Tensor,
    share: float,
) -> None:
    """Record what growth decides by: the screen gradients, and the boxes behind each frame's worst tile."""
    growth, cameras, depth_weight = setup.config.growth, batch.cameras, None
    if growth.depth_scale:
        depth_weight = near_camera_weight(state.gaussians.means, cameras, growth.depth_scale * setup.unit_m)
    height, width = setup.frames[0].dn.shape[:2]  # half of it is the unit of the published threshold
    half_x_px, half_y_px = 0.5 * cameras.scale * width, 0.5 * cameras.scale * height
    if growth.share:  # ranks by the gradient itself
        half_x_px = half_y_px = max(half_x_px, half_y_px)
    half_size_px = half_x_px, half_y_px
    state.growth.observe(rendered, half_size_px, growth.pixel_weighted, depth_weight)
    if growth.obb_interval and is_growing(setup, share):
        state.boxes += worst_boxes(state.gaussians, rendered, cameras, residual, growth.obb_centre)


def decide_poses(setup: TrainingSetup, state: TrainingState, share: float) -> None:
    """Refine the poses if the validation brackets say that they err.

    They are asked before the first round of refinement, and trained on from then on, or once they have told the model's
    own error (`measure_unseen`).
    """
    config = setup.config
    if (
        state.pose_decision is not PoseDecision.OPEN
        or share < config.poses.refine_from
        or not pose_rounds.is_turn(setup, state, share)
    ):
        return
    brackets = [setup.batches.batch(b) for b in state.order.validation_brackets]
    cell_m = pose_rounds.cell_m(setup)
    evidence = correction_evidence(state.model.detach(), setup.frames, brackets, setup.sensor, cell_m)
    refined = evidence.says_so
    state.poses = PoseCorrections(setup.frames) if refined else None
    state.holds = HOLDS if refined else 0
    state.pose_decision = PoseDecision.REFINED if refined else PoseDecision.TAGS_HOLD
    state.pose_evidence = f"step {state.steps_done + 1}: {evidence}"
    log.info("poses %s", state.pose_report)
    if refined or not setup.keeps_unseen:
        state.order = FrameOrder.of(setup.frames, config.bracket_steps, [], state.misfits, state.order)


def measure_unseen(setup: TrainingSetup, state: TrainingState, share: float) -> None:
    """Learn how many times as large the model's own error is on brackets that were kept back, and train on them too.

    When growth has ended most details are found, and there is still time to learn what these brackets show.
    """
    if share < UNSEEN_UNTIL or not is_keeping_unseen(setup, state):
        return
    state.unseen_factor = unseen_factor(setup, state)
    by_exposure = setup.config.bracket_steps
    state.order = FrameOrder.of(setup.frames, by_exposure, [], state.misfits, state.order)


def is_undecided(state: TrainingState) -> bool:
    """Return whether validation brackets are still to decide on the poses, or would if there were enough of them."""
    return state.pose_decision in (PoseDecision.OPEN, PoseDecision.TOO_FEW_BRACKETS)


def is_keeping_unseen(setup: TrainingSetup, state: TrainingState) -> bool:
    """Return whether there are brackets that are kept back for `measure_unseen`."""
    return setup.keeps_unseen and not is_undecided(state) and bool(state.order.validation_brackets)


@torch.no_grad()
def unseen_factor(setup: TrainingSetup, state: TrainingState) -> float | None:
    """Return how many times as large the model's own error is on the brackets that are kept back; None if not known."""
    compared = []
    for bracket in state.order.validation_brackets:
        batch = setup.batches.batch(bracket)
        rendered = render(state.model, batch.cameras)
        radiance, alpha, dn = sampled(setup.sensor, rendered.radiance, rendered.alpha, batch.dn)
        compared.append(Compared(radiance, alpha > ON_TARGET_ALPHA, batch.exposure_time_s, dn))
    misfit = stated_misfit(compared, setup.sensor)
    if not state.misfit or math.isnan(misfit):
        log.warning("the brackets kept back do not tell the model's own error: that of the others is stated")
        return None
    log.info("the model's own error is %.2f times as large on brackets kept back", misfit / state.misfit)
    return misfit / state.misfit


def change_number(
    setup: TrainingSetup, state: TrainingState, batch: Batch, residual: Tensor, moment: Moment
) -> None:
    """Densify everywhere, or between two such times inside the boxes of the worst tiles; reset opacities; when due."""
    settings, now = setup.config.growth, moment.step
    whole = setup.config.steps_until(1) - setup.config.steps_until(0)
    if (
        setup.frames[0].background
        and settings.opacity_reset_interval
        and now == round(settings.begin * whole)
    ):
        reset_opacities(state.gaussians, state.adam, state.log_lowering)  # as in 3DGS on a white background
    if not is_growing(setup, moment.share):
        if moment.share >= settings.end and now % settings.interval == 0:
            left = setup.config.steps - state.steps_done - 1
            if left >= settings.interval:  # Gaussians end under the filter that they were trained with
                smooth(setup, state)
        return
    if now % settings.interval == 0:
        drop_not_finite(state)
        crossed, threshold = None, GRADIENT_THRESHOLD
        if settings.multi_view:
            crossed = inside(state.gaussians.means.detach(), crossing_boxes(batch.cameras, residual))
            threshold *= threshold_factor(batch.cameras)
        model = (state.gaussians, state.adam, state.growth, setup.unit_m, settings, moment.share, state.rng)
        state.gaussians = densify(*model, crossed, threshold)
        state.growth, state.boxes = Growth.of(len(state.gaussians)), []
        smooth(setup, state)
    elif state.boxes and now % settings.obb_interval == 0:
        drop_not_finite(state)
        state.gaussians, state.growth = densify_boxes(
            state.gaussians, state.adam, state.growth, state.boxes, setup.unit_m, settings, state.rng
        )
        state.boxes = []
        smooth(setup, state)
    if settings.opacity_reset_interval and now % settings.opacity_reset_interval == 0:
        reset_opacities(state.gaussians, state.adam, state.log_lowering)


def select_model(setup: TrainingSetup, state: TrainingState) -> None:
    """Prune by BIC and test a higher harmonic degree, when due; a moving Sun and highlights are tested before.

    Where no highlights were found they are tested again once half as many frames again have joined; where poses are
    refined they are only tested once the poses have settled again.
    """
    config, now = setup.config, state.steps_done + 1
    settling = state.has_joined and state.poses is not None
    begin = HELD_AT if settling else HIGHLIGHTS_FROM
    settled = now >= round(config.steps_until(begin)) >= FEWEST_STEPS and not (settling and state.holds)
    untested = len(setup.frames) >= MORE_FRAMES * state.highlights_frames
    if settled and untested and config.light.highlights and not state.gaussians.has_highlights:
        add_highlights(setup, state)
    if any(now == round(config.steps_until(at)) for at in config.parsimony.prune_at):
        prune_by_bic(setup, state)
        raise_degree(setup, state, ("sun", "view") if setup.sun_moves else ("view",))
    elif setup.sun_moves and now == round(config.steps_until(SUN_FROM)):
        raise_degree(setup, state, ("sun",))


def prune_by_bic(setup: TrainingSetup, state: TrainingState) -> None:
    """Remove the Gaussians whose likelihood gain is below their BIC penalty, unless that were all of them."""
    drop_not_finite(state)
    batches, settings = batches_at(setup, state), setup.config.parsimony
    kept = justified(state.model, batches, setup.sensor, settings, setup.radius_m, state.rng)
    if kept.any():
        removed = len(state.gaussians) - int(kept.sum())
        state.gaussians = keep(state.gaussians, state.adam, kept)
        state.growth, state.boxes = Growth.of(len(state.gaussians)), []
        smooth(setup, state)
        log.info("step %d: %d Gaussians are pruned by BIC", state.steps_done + 1, removed)


def raise_degree(
    setup: TrainingSetup, state: TrainingState, directions: tuple[Literal["view", "sun"], ...]
) -> None:
    """Let the radiance turn with view or Sun, or raise its degree, if the likelihood gain exceeds the BIC penalty."""
    raised, reason = raised_degree(
        state.gaussians,
        batches_at(setup, state),
        setup.sensor,
        directions,
        setup.config.light,
        setup.albedos_turn,
        state.rng,
    )
    if raised is not None:
        state.gaussians = raised
        state.adam.widen(raised)
    if reason:
        state.appearance_reason = f"step {state.steps_done + 1}, {reason}"
        log.info("radiance %s", described(state.gaussians, state.appearance_reason))


def add_highlights(setup: TrainingSetup, state: TrainingState) -> None:
    """Give every Gaussian a highlight, if frames that are withheld from the choice are explained better by them.

    Where the Sun moves they get one in any case: along their normals if withheld brackets are not explained better.
    """
    drop_not_finite(state)
    found = lobed(
        state.model,
        batches_at(setup, state),
        setup.sensor,
        state.misfit,
        state.shadows,
        state.steps_done,
    )
    shiny, along = found.gaussians, ""
    if shiny is None and state.gaussians.shading != "view":
        shiny, along = along_normals(state.gaussians), "; they lie along the normals"
    if shiny is not None:
        changed = {name: getattr(shiny, name) for name in ("sh", "lobes", "gloss", "static_sun")}
        state.gaussians = dataclasses.replace(state.gaussians, **changed).trainable()
        state.adam.widen(state.gaussians)
    state.highlights_frames = len(setup.frames)
    state.highlights_reason = (
        f"step {state.steps_done + 1}, highlights would gain {found.gain:,.0f} nats on frames that they are not "
        f"fitted to, with {found.sureness:.1f} standard errors{along}"
    )
    log.info("radiance %s", described(state.gaussians, state.highlights_reason))


def drop_not_finite(state: TrainingState) -> None:
    """Remove the Gaussians of which a parameter became NaN or infinite, and count them.

    Raises:
        Diverged: no Gaussian is finite.
    """
    kept = finite(state.gaussians)
    count = len(kept) - int(kept.sum())
    if count == len(kept):
        problem = f"none of {count} Gaussians has finite parameters any more,"
        raise Diverged(state.steps_done, math.nan, problem)
    if count:
        state.gaussians = keep(state.gaussians, state.adam, kept)
        state.growth = state.growth.select(kept)
        if state.average is not None:
            state.average = state.average.select(kept)
        if state.smoothing_m is not None:
            state.smoothing_m = state.smoothing_m[kept]
        state.removed_not_finite += count
        log.warning("step %d: %d Gaussians were not finite and are removed", state.steps_done, count)
