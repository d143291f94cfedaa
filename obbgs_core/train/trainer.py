"""The training loop: frames, a sensor and a method in, Gaussians out. `Trainer.step` is one step of it."""

import dataclasses
import logging
import math
import statistics
import time
from collections.abc import Callable, Iterable
from itertools import pairwise
from pathlib import Path

import torch

from obbgs_base.errors import Interrupted, reason
from obbgs_core.background import backdrop
from obbgs_core.batches import Batch, Batches
from obbgs_core.compiled import torch_on_one_thread
from obbgs_core.errors import Diverged, expect
from obbgs_core.evidence.radiance import described
from obbgs_core.frames import TrainingFrame, alike, given
from obbgs_core.methods.config import SET_BACK_AT, SET_BACK_TO, MethodConfig, Moment
from obbgs_core.model.gaussians import Gaussians
from obbgs_core.poses.corrections import PoseCorrections
from obbgs_core.poses.estimate import PoseEstimate
from obbgs_core.published import mcmc
from obbgs_core.published.growth import outliers
from obbgs_core.render import Rendered, backend_for, pictures_at, render
from obbgs_core.render.backdrops import covered, doubted
from obbgs_core.sensor import Sensor
from obbgs_core.train.adam import FIRST_MEMORY, SECOND_MEMORY, learning_rates
from obbgs_core.train.joining import begun_again, check_joinable, join, release, withhold
from obbgs_core.train.objective import DROPPED_UNTIL, dropped, image_loss, priors
from obbgs_core.train.parts import Seen
from obbgs_core.train.result import Exposing, StepInfo, TrainResult
from obbgs_core.train.setup import TrainingSetup, prepare
from obbgs_core.train.state import Identity, TrainingState

log = logging.getLogger(__name__)
CHECKPOINT_EVERY_S = 20.0
BACKDROPS_EVERY = 100  # steps
LEAST_PSF_SIGMA_PX = 0.05  # a learnt point spread stays above: at 0 its square has no slope
PACE_STEPS = 50  # the time left is estimated from the pace of so many steps
# by so much a whole training takes longer than its steps at the pace of the first (TDRS and DSCOVR)
DECISIONS = 0.4


def train(
    frames: Iterable[TrainingFrame],
    sensor: Sensor,
    config: MethodConfig,
    seed: int = 0,
    on_step: Callable[[StepInfo], None] = lambda info: None,
    time_limit_s: float = math.inf,
    checkpoint: Path | None = None,
    should_stop: Callable[[], bool] = lambda: False,
    on_warning: Callable[[str], None] = log.warning,
) -> TrainResult:
    """Fit Gaussians to frames.

    The same seed and machine give the same result bit for bit, on any number of threads, also when it was killed and
    called again with the same checkpoint file; a checkpoint of another training is not used. The time limit counts
    the time spent before a kill too. The checkpoint of a finished training stays, so that the model is not lost where
    what is done with it afterwards fails.

    Args:
        should_stop: called after each step; when it returns true, the training is saved and ends in `Interrupted`.
        on_warning: called with each thing that is unusual about the frames.

    Raises:
        ValueError: frames, sensor or config are of another type.
        TooFewFrames: fewer than three frames.
        ReconstructionError: every frame is black, or frames differ in size.
        Diverged: the loss, or all of the Gaussians, stopped being finite.
        Interrupted: should_stop returned true.
    """
    trainer = Trainer(frames, sensor, config, seed, on_warning)
    if checkpoint is not None and trainer.resume(checkpoint):
        log.info("resumed at step %d of %d", trainer.state.steps_done, config.steps)
    saved = time.monotonic()
    while not (reason := trainer.stop_reason(time_limit_s)):
        on_step(trainer.step())
        if should_stop():
            kept = _saved(trainer, checkpoint)
            where = "not saved" if kept is None else f"saved in {kept}: the same command goes on from there"
            done = trainer.state.steps_done
            raise Interrupted(f"interrupted at step {done} of {config.steps}, {where}")
        if time.monotonic() - saved > CHECKPOINT_EVERY_S:
            _saved(trainer, checkpoint)
            saved = time.monotonic()
    _saved(trainer, checkpoint)
    return trainer.result(reason)


def _saved(trainer: "Trainer", checkpoint: Path | None) -> Path | None:
    """Save a training and return where; None where it is not wanted, or where the disk does not take it."""
    if checkpoint is None:
        return None
    try:
        trainer.save(checkpoint)
    except OSError as error:  # a full disk must not end the training
        log.warning("step %d: %s cannot be written: %s", trainer.state.steps_done, checkpoint, reason(error))
        return None
    return checkpoint


class Trainer:
    """A training under way: `setup` is what it is given and never changes, `state` is what every step changes.

    Raises:
        TooFewFrames, ReconstructionError: as in `train`.
    """

    @torch_on_one_thread()
    def __init__(
        self,
        frames: Iterable[TrainingFrame],
        sensor: Sensor,
        config: MethodConfig,
        seed: int = 0,
        on_warning: Callable[[str], None] = log.warning,
    ):
        expect(sensor, Sensor, "sensor", "a Sensor")
        expect(config, MethodConfig, "config", 'a MethodConfig, such as preset("obbgs")')
        frames = given(frames)
        began, self._backend = time.monotonic(), backend_for(config.device)
        self._given, self._stated = frames, sensor
        self.setup, start = prepare(frames, sensor, config, seed)
        for warning in self.setup.warnings:
            on_warning(warning)
        self.state = TrainingState.first(self.setup, start)
        self.state.seconds = time.monotonic() - began

    @torch_on_one_thread()
    def step(self) -> StepInfo:
        """Render some frames, move Gaussians and poses down the gradient, and take the decisions that are due.

        Raises:
            Diverged: the loss, or all of the Gaussians, stopped being finite.
        """
        began = time.monotonic()
        setup, state, config = self.setup, self.state, self.setup.config
        moment = config.moment(state.steps_done)
        self._renew_backdrops()
        drawn = state.order.draw(min(moment.frames, len(setup.frames)), state.rng)
        batch = setup.batches.batch(drawn, moment.image_scale, pictures_at(self._backend))
        if state.poses.corrections is not None:
            cameras = state.poses.corrections.cameras(drawn, batch.cameras)
            batch = dataclasses.replace(batch, cameras=cameras)
        sunlit = state.shadows.sunlit(state.gaussians, batch.cameras, state.steps_done)
        model, drops = state.model, setup.dropout > 0 and moment.share < DROPPED_UNTIL
        drawn_model = dropped(model, setup.dropout, state.rng) if drops else model
        rendered = self._compensated(render(drawn_model, batch.cameras, self._backend, sunlit), batch)
        batch = doubted(batch, rendered, setup.sensor, setup.frames)
        loss, residual = image_loss(rendered, batch, setup.sensor, config, state.fit.misfit)
        if not torch.isfinite(loss):
            raise Diverged(state.steps_done, loss.item())
        smooth = config.loss.normal_weight > 0 and state.gaussians.shading == "lambert"
        nearest = state.neighbours.of(state.gaussians, state.steps_done) if smooth else None
        prior = priors(state.gaussians, rendered, batch, setup.radius_m, config.loss, nearest)
        if config.published.growth == "sampled":
            prior = prior + mcmc.sparsity(state.gaussians)
        (loss + prior).backward()
        seen = Seen(batch, rendered, residual)
        state.growth.observe(setup, state.gaussians, seen, moment)
        if drops:  # figures are of the whole model, as it was before the step
            with torch.no_grad():
                rendered = self._compensated(render(state.model, batch.cameras, self._backend, sunlit), batch)
        self._descend(moment)
        self._decide(moment, seen)
        state.average.observe(state.gaussians, moment.share >= config.averaged_from)
        state.fit.observe(setup, rendered, seen, state.steps_done)
        state.steps_done += 1
        self._learn_response()
        state.seconds += time.monotonic() - began
        info = self._recorded(loss.item())
        state.steps_done = state.poses.set_back(setup, state.steps_done)
        self._prolong_growth()
        return info

    def _renew_backdrops(self) -> None:
        """Find where the model is in the frames that have the Earth, when due, and what stands behind it there."""
        setup, state = self.setup, self.state
        indices = [i for i, frame in enumerate(setup.frames) if frame.earth_m is not None]
        if not indices or setup.config.published.loss != "likelihood":
            return
        # a round of poses asks about one and the same
        due = state.steps_done % BACKDROPS_EVERY == 0 and state.poses.round is None
        if due or set(state.near_target) != set(indices):
            batches, model = self._batches, state.model
            with torch.no_grad():
                alphas = {i: render(model, batches.cameras([i])).alpha[0] for i in indices}
            state.near_target = {i: covered(alpha) for i, alpha in alphas.items()}
        elif setup.batches.has_backdrops:
            return
        near = state.near_target
        seen = {i: backdrop(setup.frames[i], setup.sensor, near[i]) for i in indices}
        setup.batches.stand(seen, {i: ~near[i] for i in indices if setup.config.loss.sky_weight})

    def _decide(self, moment: Moment, seen: Seen) -> None:
        """Take the decisions that are due, one part after the other."""
        setup, state, config = self.setup, self.state, self.setup.config
        now = state.now(setup, moment, seen)
        for part in state.parts:
            if part.due(now):
                state.drop_not_finite(setup)
                change = part.decide(state.now(setup, moment, seen))
                if change is not None:
                    state.apply(setup, change)
                now = state.now(setup, moment, seen)
        # Gaussians end under the filter that they were trained with
        left = config.steps - moment.done - 1 >= config.growth.interval
        if moment.share >= config.growth.end and moment.step % config.growth.interval == 0 and left:
            state.find_filter(setup)

    def _compensated(self, rendered: Rendered, batch: Batch) -> Rendered:
        """Return what was rendered in the colours of its frames, where the method learns those."""
        compensation, sensor = self.state.compensation, self.setup.sensor
        if compensation is None:
            return rendered
        full_scale = (sensor.white_dn - sensor.black_dn) / (sensor.dn_per_radiance_s * batch.exposure_time_s)
        radiance = compensation.applied(rendered.radiance, batch.indices, full_scale)
        return dataclasses.replace(rendered, radiance=radiance)

    def _descend(self, moment: Moment) -> None:
        """Move the Gaussians and the colours of the frames down their gradients."""
        state, setup = self.state, self.setup
        interval, gradient = setup.config.published.sh_interval, state.gaussians.sh.grad
        if interval and gradient is not None:  # higher degrees are not trained yet (3DGS)
            gradient[:, ((moment.done + 1) // interval + 1) ** 2 :] = 0
        of_sh = (state.gaussians.sh.shape[1], setup.radiance_unit, state.gaussians.lobes.shape[1])
        rates = learning_rates(setup.config.rates, moment.share, setup.unit_m, *of_sh)
        state.adam.step(state.gaussians, rates)
        if setup.config.published.growth == "sampled":
            mcmc.shake(state.gaussians, rates["means"], state.rng)
        state.gaussians.ambient.detach().clamp_(min=0)
        state.gaussians.psf_sigma_px.detach().clamp_(min=LEAST_PSF_SIGMA_PX)
        if state.compensation is not None:
            state.compensation.step(moment.share)

    def _learn_response(self) -> None:
        """Take another exponent of the camera's response when that is due and the frames tell it."""
        state, setup, done = self.state, self.setup, self.state.steps_done
        due = {round(setup.config.steps_until(share)): share for share in state.response.decided_at}
        can_tell = done in due and state.fit.misfit is not None and not setup.sun_moves
        if can_tell and state.response.decide(state.model, self._batches, setup.sensor, due[done]):
            self._use_found()

    def _prolong_growth(self) -> None:
        """Set the schedule back where growth has come to its end and is to go on."""
        state, setup, config = self.state, self.setup, self.setup.config
        at_end = state.steps_done == round(config.steps_until(config.growth.end))
        if at_end and state.extension.goes_on(setup, state.model, self._batches, state.order):
            self._use_found()
            state.steps_done = state.extension.back(self.setup.config)
            # the more Gaussians there are, the fewer readings tell the gradient of each
            state.adam.betas = (FIRST_MEMORY, SECOND_MEMORY)

    @property
    def _batches(self) -> Batches:
        """The training's images with the poses as they are estimated so far."""
        setup, poses = self.setup, self.state.poses.corrections
        return setup.batches if poses is None else setup.batches.posed(poses.frames(setup.frames))

    def _use_found(self) -> None:
        """Let the setup have what was found of the sensor's response and of the budget."""
        setup, found = self.setup, self.state
        sensor = dataclasses.replace(setup.sensor, response=found.response.exponent)
        config, most = setup.config, setup.config.growth.max_gaussians
        if found.extension.errors is not None:
            growth = dataclasses.replace(config.growth, max_gaussians=max(most, setup.shown))
            config = dataclasses.replace(config, growth=growth)
        batches = setup.batches.exposed(found.response.gains(setup.frames))
        self.setup = dataclasses.replace(setup, sensor=sensor, config=config, batches=batches)

    def _recorded(self, loss: float) -> StepInfo:
        """Return how the training stands, and keep it in the history."""
        state = self.state
        info = StepInfo(
            step=state.steps_done,
            steps=self.setup.config.steps,
            loss=loss,
            psnr_db=state.fit.psnr_db,
            chi2=state.fit.chi2,
            gaussians=len(state.gaussians),
            seconds=state.seconds,
            seconds_left=_seconds_left(state, self.setup.config),
        )
        state.history.append(info)
        return info

    def stop_reason(self, time_limit_s: float = math.inf) -> str:
        """Return why the training is over; nothing if it goes on."""
        config, state = self.setup.config, self.state
        if state.seconds >= time_limit_s:
            untrained = ", before the first step: the model is its untrained start"
            return f"time limit of {time_limit_s:g} s" + (untrained if state.steps_done == 0 else "")
        all_drawn = not state.order.validation_brackets  # what is kept back is to be trained on first
        if config.chi2_end and state.fit.chi2 <= config.chi2_end and self.is_past_growth and all_drawn:
            return f"residual chi² reached the noise ({state.fit.chi2:.3f})"
        if state.steps_done >= config.steps:
            taken = len(state.history)  # more where the schedule was set back, for poses or for growth
            again = "" if taken == config.steps else f" of the schedule done, {taken:,} in all"
            return f"all {config.steps} steps{again or ' done'} (residual chi² {state.fit.chi2:.2f})"
        return ""

    @torch_on_one_thread()
    def join(self, frames: list[TrainingFrame]) -> None:
        """Go on with more frames: the model is kept, and the start is carved again of all frames.

        The schedule is set back, so that it ends only when none come.

        Raises:
            ValueError: the method's training cannot take in frames, see `check_joinable`.
            ReconstructionError: as in `train`.
        """
        check_joinable(self.setup.config)
        began = time.monotonic()
        every = alike(self._given + frames)
        joined, fresh = self._prepared(every, self.state.poses.corrections)
        join(self.setup, self.state, joined, fresh)
        self.setup, self._given = joined, every
        self._use_found()
        self.state.seconds += time.monotonic() - began

    def withhold(self) -> None:
        """Keep back the brackets that will decide on the poses, however few there are yet, because frames will join."""
        withhold(self.setup, self.state)

    @torch_on_one_thread()
    def end_joining(self) -> None:
        """Complete the training of all frames, because no more will join; nothing where that is already under way.

        Brackets that were kept back are trained on too if they are too few to decide. If frames have joined, the start
        is carved once more, with the poses that were refined meanwhile, and the schedule begins again: what the first
        few frames taught about shapes and highlights, and what was learnt while poses still erred, holds a model back
        for good (docs/experiments/078).
        """
        began = time.monotonic()
        release(self.setup, self.state)
        if self.state.has_joined:
            self.setup, fresh = self._prepared(self._given, self.state.poses.corrections)
            self.state = begun_again(self.state, fresh)
            log.info("%d frames: the schedule begins again", len(self.setup.frames))
        self.state.seconds += time.monotonic() - began

    def _prepared(
        self, frames: list[TrainingFrame], poses: PoseCorrections | None
    ) -> tuple[TrainingSetup, TrainingState]:
        """Return setup and first state of a training of frames that begin with those of this one, with their poses."""
        given = (self._stated, self.setup.asked, self.setup.seed, self.setup.silhouettes)
        setup, start = prepare(frames, *given, poses)
        return setup, TrainingState.first(setup, start, poses)

    @property
    def pose_estimate(self) -> PoseEstimate | None:
        """What was found of the poses so far, by the last pictures that were asked; None where they are as tagged."""
        poses = self.state.poses.corrections
        return (
            None if poses is None else poses.estimate(self.setup.frames).of_frames(self.state.order.fitting)
        )

    @property
    def share(self) -> float:
        """The share of the schedule that is done; it falls where frames join."""
        return self.setup.config.moment(self.state.steps_done).share

    @property
    def is_past_growth(self) -> bool:
        """Whether growth and resets of opacities are over."""
        config = self.setup.config
        return self.state.steps_done >= config.steps_until(config.growth.end)

    @property
    def gaussians(self) -> Gaussians:
        """The model as it stands, averaged in the last steps, without gradients, with the 3D filter in it."""
        return self.state.averaged_model

    @property
    def exposing(self) -> Exposing:
        """What pictures of the model as it stands are made with."""
        compensation, tagged_s = self.state.compensation, self.setup.tagged_exposures_s
        maps = {} if compensation is None else compensation.by_exposure(tagged_s)
        return Exposing(self.setup.reference_exposure_s, maps)

    def result(self, stop_reason: str) -> TrainResult:
        """Return the model as it stands, filtered as the method asks, with the poses that it was made with.

        Raises:
            Diverged: no Gaussian is finite.
        """
        setup, state = self.setup, self.state
        state.drop_not_finite(setup)
        fit, factor = state.fit, state.fit.unseen_factor
        if state.keeps_unseen(setup):  # ended before they were trained on
            factor = fit.unseen(state.model, setup, state.order.validation_brackets)
        gaussians, removed = self.gaussians, 0
        if setup.config.published.outlier_filter:
            stray = outliers(gaussians)
            removed = int(stray.sum())
            gaussians = gaussians.select(torch.nonzero(~stray)[:, 0])
        return TrainResult(
            gaussians=gaussians,
            config=setup.config,
            history=state.history,
            stop_reason=stop_reason,
            start=setup.start,
            budget=setup.budget,
            appearance=described(state.gaussians, state.harmonics.reason, state.highlights.reason),
            growth=f"until step {min(state.steps_done, round(setup.config.steps_until(setup.config.growth.end)))}"
            + (f" of the schedule ({reason})" if (reason := state.extension.reason) else ""),
            poses=state.poses.report,
            pose_estimate=state.poses.estimate(setup, state.model, state.order),
            exposing=self.exposing,
            misfit=None if fit.misfit is None else fit.misfit * (1.0 if factor is None else factor),
            unseen_factor=factor,
            sky_level=setup.sky_level,
            response=state.response,
            sun_span_deg=setup.sun_span_deg,
            dark_frames=setup.dark_frames,
            misfit_frames=[setup.frames[i].id for i in state.order.left_out],
            removed_outliers=removed,
            removed_not_finite=state.removed_not_finite,
            seconds=state.seconds,
        )

    def save(self, path: Path) -> None:
        """Write everything that the next step depends on, whole or not at all."""
        self.state.save(path, Identity.of(self.setup))

    def resume(self, path: Path) -> bool:
        """Go on from a checkpoint of this very training; return False when there is none."""
        state = TrainingState.load(path, Identity.of(self.setup))
        if state is None:
            return False
        self.state = state
        if state.poses.placed_by is not None:
            self.setup, _ = self._prepared(self._given, state.poses.placed_by)
        self._use_found()
        return True


def _seconds_left(state: TrainingState, config: MethodConfig) -> float | None:
    """Return the time that the remaining steps will take, with their decisions, at the middle pace of the last ones."""
    last, done = state.history[: -PACE_STEPS - 1 : -1], state.steps_done
    counted = [info.seconds for back, info in enumerate(last, 1) if info.step == done - back]
    if not counted:
        return None
    again = state.poses.set_backs * config.work(
        *(round(config.steps_until(s)) for s in (SET_BACK_TO, SET_BACK_AT))
    )
    times = enumerate(pairwise([state.seconds, *counted]))
    pace = statistics.median((end - begin) / config.work(done - i - 1, done - i) for i, (end, begin) in times)
    decisions = DECISIONS * (1 - done / config.steps) if config.learns_misfit else 0.0
    return (1 + decisions) * pace * (config.work(done, config.steps) + again)
