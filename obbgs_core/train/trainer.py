"""The training loop, readable top to bottom: frames and a method in, Gaussians out."""

import dataclasses
import functools
import hashlib
import io
import json
import logging
import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import torch
from torch import Tensor

from obbgs_base.errors import Interrupted
from obbgs_base.files import write_whole
from obbgs_core import obb
from obbgs_core.errors import Diverged, ReconstructionError
from obbgs_core.frames import (
    FEWEST_FRAMES,
    Batch,
    Batches,
    TrainingFrame,
    camera_extent_m,
    sun_span_deg,
    usable,
)
from obbgs_core.losses import fit_figures, likelihood_loss, normal_disagreement, published_loss
from obbgs_core.model.cameras import Cameras
from obbgs_core.model.gaussians import Gaussians
from obbgs_core.render import Rendered, render, shadow_map
from obbgs_core.render.lighting import lambertian
from obbgs_core.render.shadows import SHADOW_MAP_PX, ShadowMap, lit_shares
from obbgs_core.sensor import Sensor
from obbgs_core.start.hull import shows_light
from obbgs_core.start.initial import first_gaussians, silhouettes
from obbgs_core.train import validation as held_out
from obbgs_core.train.growth import Adam, Growth, densify, densify_boxes, finite, keep, outliers, trainable
from obbgs_core.train.parsimony import likelihood_gains, next_degree_gain, padded, price
from obbgs_core.train.poses import PoseCorrections
from obbgs_core.train.presets import MethodConfig

log = logging.getLogger(__name__)
CHI2_MEMORY = 0.98  # of the running chi² a step
CHECKPOINT_EVERY_S = 20.0
WORTH_REFINING = 1.5  # times its price: of exact tags 0.5 to 1.3 was measured, at 1 px of error 2.9 to 5.4
FLAT_COST = 0.25  # of a step's cost that does not shrink with the image


@dataclass(frozen=True)
class StepInfo:
    step: int
    steps: int
    loss: float
    psnr_db: float  # of this step's frames, full scale = 1
    chi2: float  # running mean squared normalised residual where the model is; 1 is pure noise
    gaussians: int
    seconds: float
    seconds_left: float  # if the pace per pixel stays as it is


@dataclass
class TrainResult:
    gaussians: Gaussians
    config: MethodConfig  # as used: with the budget that the frames pay for
    history: list[StepInfo] = field(default_factory=list)
    stop_reason: str = ""
    start: str = ""  # where the first Gaussians came from
    reference_exposure_s: float | None = None  # what every exposure was taken for when exposure is ignored
    removed_outliers: int = 0
    dark_frames: int = 0  # left out: nothing in them rises above the noise
    sun_span_deg: float = 0.0  # largest angle between two frames' Suns, body frame
    appearance: str = ""  # what the radiance turns with, and why
    growth: str = ""  # when growth ended, and why
    poses: str = ""  # whether the poses were refined, and why
    exposures: str = ""  # by how much the exposure times were corrected
    seconds: float = 0.0
    budget: str = ""  # the most Gaussians, and why no more
    removed_not_finite: int = 0  # Gaussians of which a parameter stopped being a number


def train(
    frames: list[TrainingFrame],
    sensor: Sensor,
    config: MethodConfig,
    seed: int = 0,
    on_step: Callable[[StepInfo], None] = lambda info: None,
    time_limit_s: float = math.inf,
    checkpoint: Path | None = None,
    should_stop: Callable[[], bool] = lambda: False,
) -> TrainResult:
    """Fit Gaussians to frames.

    The same seed, thread count and machine give the same result bit for bit, also when the training was killed and
    called again with the same checkpoint file; a checkpoint of another training is not used. The time limit counts
    the time spent before a kill too. The checkpoint of a finished training stays, so that nothing that is done with the
    model afterwards can lose it.

    Args:
        should_stop: asked after each step; when it says yes, the training is saved and ends in `Interrupted`.

    Raises:
        TooFewFrames: fewer than three frames.
        ReconstructionError: every frame is black, or frames differ in size.
        Diverged: the loss, or all of the Gaussians, stopped being finite.
        Interrupted: should_stop said so.
    """
    trainer = Trainer(frames, sensor, config, seed)
    if checkpoint is not None and trainer.resume(checkpoint):
        log.info("resumed at step %d of %d", trainer.steps_done, config.steps)
    saved = time.monotonic()
    while not (reason := trainer.stop_reason(time_limit_s)):
        on_step(trainer.step())
        if should_stop():
            kept = _saved(trainer, checkpoint)
            where = "not saved" if kept is None else f"saved in {kept}: the same command goes on from there"
            raise Interrupted(f"interrupted at step {trainer.steps_done} of {config.steps}, {where}")
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
    except OSError as error:  # a full disk: the training is worth more than its checkpoint
        log.warning("step %d: %s cannot be written: %s", trainer.steps_done, checkpoint, error)
        return None
    return checkpoint


class Trainer:
    """A training under way: everything the next step depends on, and nothing else.

    Raises:
        TooFewFrames, ReconstructionError: as in `train`.
    """

    def __init__(self, frames: list[TrainingFrame], sensor: Sensor, config: MethodConfig, seed: int = 0):
        began = time.monotonic()
        self.sensor, self.config, self.seed = sensor, config, seed
        self.rng = torch.Generator().manual_seed(seed)
        checked, self.reference_exposure_s = usable(frames, config.exposure_aware)
        self.frames = [f for f in checked if shows_light(f.dn, sensor)]
        self.dark_frames = len(checked) - len(self.frames)
        if len(self.frames) < FEWEST_FRAMES:
            raise ReconstructionError(
                f"{self.dark_frames} of {len(checked)} frames are black (eclipse, or exposures too short): only "
                f"{len(self.frames)} rise above the noise, {FEWEST_FRAMES} are needed"
            )
        outlines = silhouettes(self.frames, sensor)
        lit_pixels = sum(int(outline.sure.sum()) for outline in outlines.values())
        self.config, self.budget = _paid_for(config, lit_pixels)
        config = self.config
        log.info("budget: %s", self.budget)
        self.gaussians, self.radius, self.start = first_gaussians(
            self.frames, list(outlines.values()), sensor, config, self.rng
        )
        self.unit_m = camera_extent_m(self.frames) if config.length_unit == "cameras" else self.radius
        self.sun_span_deg = sun_span_deg(self.frames)
        self.why_appearance = "as configured" if config.sh_degree else ""
        self.adam = Adam(self.gaussians)
        self.growth = Growth(len(self.gaussians), config.pixel_weighted)
        sky = {i: outline.sky for i, outline in outlines.items()} if config.sky_weight else None
        self.batches = Batches(self.frames, sensor.white_dn, config, self.rng, sky)
        self.grow_until, self.growth_ended = config.grow_until, "as configured"
        self.best: tuple[float, Tensor] | None = None  # image scale and losses of the held-out brackets
        self.intervals_since_best = 0
        self.poses = PoseCorrections(self.frames) if config.refine_poses == "always" else None
        brackets = held_out.held_out_brackets(self.frames)
        self.poses_decided = _decided_at_once(config, self.frames, brackets)
        if config.grow_patience or not self.poses_decided:
            self.batches.hold_out(brackets)
        self.boxes: list[obb.Obb] = []
        self.shadow_maps: dict[tuple[float, ...], ShadowMap] = {}  # by the Sun's direction
        self.chi2, self.psnr_db, self.steps_done = math.nan, math.nan, 0
        self.history: list[StepInfo] = []
        self.removed_not_finite = 0
        self.seconds = time.monotonic() - began

    def step(self) -> StepInfo:
        """Render some frames, move the Gaussians down the gradient, and change their number when it is time.

        Raises:
            Diverged: the loss stopped being finite.
        """
        began = time.monotonic()
        config, share = self.config, self.steps_done / self.config.steps
        batch = self.batches.take(_image_scale(config, share))
        cameras = batch.cameras if self.poses is None else self.poses.cameras(batch)
        with_normals = config.normal_weight > 0 and share >= config.normal_from
        rendered = render(self.gaussians, cameras, normals=with_normals, sunlit=self._sunlit(cameras))
        loss, residual = _image_loss(rendered, batch, self.sensor, config)
        if not torch.isfinite(loss):
            raise Diverged(self.steps_done, loss.item())
        (loss + self._priors(batch, share, rendered, cameras)).backward()
        if config.grow_from <= share < self.grow_until:
            self._observe(rendered, batch, residual)
        self._freeze_later_degrees()
        self.adam.step(self.gaussians, _rates(config, share, self.unit_m, self.gaussians.sh.shape[1]))
        self.gaussians.ambient.detach().clamp_(min=0)
        if self.poses is not None:
            self.poses.step(config.lr_poses * (1 - share) if share >= config.poses_from else 0.0)
        if self.batches.exposures is not None:
            self.batches.exposures.step(config.lr_poses * (1 - share) if share >= config.poses_from else 0.0)
        self._ask_held_out(share)
        self._change_number(share, batch)
        self._look(rendered, batch)
        self.steps_done += 1
        self.seconds += time.monotonic() - began
        info = StepInfo(
            self.steps_done,
            config.steps,
            loss.item(),
            self.psnr_db,
            self.chi2,
            len(self.gaussians),
            self.seconds,
            _seconds_left(self.history, config, self.steps_done, self.seconds),
        )
        self.history.append(info)
        return info

    def stop_reason(self, time_limit_s: float = math.inf) -> str:
        """Return why the training is over, or nothing."""
        config = self.config
        if self.seconds >= time_limit_s:
            untrained = ", before the first step: the model is its untrained start"
            return f"time limit of {time_limit_s:g} s" + (untrained if self.steps_done == 0 else "")
        if (
            config.chi2_end
            and self.chi2 <= config.chi2_end
            and self.steps_done >= self.grow_until * config.steps
        ):
            return f"residual chi² reached the noise ({self.chi2:.3f})"
        if self.steps_done >= config.steps:
            return f"all {config.steps} steps done (residual chi² {self.chi2:.2f})"
        return ""

    def result(self, stop_reason: str) -> TrainResult:
        """Return the model as it stands, filtered and with its gauge fixed as the method asks.

        Raises:
            Diverged: no Gaussian is finite.
        """
        self._drop_not_finite()
        gaussians, removed = self.gaussians.detach(), 0
        if self.config.outlier_filter:
            stray = outliers(gaussians)
            removed = int(stray.sum())
            gaussians = gaussians.select(torch.nonzero(~stray)[:, 0])
        if self.poses is not None:
            gaussians = self.poses.settle(gaussians, self.frames)
        return TrainResult(
            gaussians,
            self.config,
            self.history,
            stop_reason,
            self.start,
            self.reference_exposure_s,
            removed,
            self.dark_frames,
            self.sun_span_deg,
            self.appearance,
            f"until step {min(self.steps_done, round(self.grow_until * self.config.steps))} ({self.growth_ended})",
            self.poses_decided or "as tagged (training ended before this was decided)",
            self.exposures,
            self.seconds,
            self.budget,
            self.removed_not_finite,
        )

    @property
    def appearance(self) -> str:
        """What the radiance turns with, and why."""
        what = "constant" if self.gaussians.sh.shape[1] == 1 else f"turns with the {self.gaussians.shading}"
        if self.gaussians.shading == "lambert":
            what = f"follows Lambert's law with cast shadows, ambient {self.gaussians.ambient.item():.3f} of the Sun"
        return f"{what} ({self.why_appearance})" if self.why_appearance else what

    @property
    def exposures(self) -> str:
        """By how much the exposure times were corrected."""
        found = self.batches.exposures
        if found is None:
            return "as tagged"
        return f"corrected by {found.rms:.2%} rms, where tags may err by {found.sigma:.2%}"

    def save(self, path: Path) -> None:
        """Write everything the next step depends on, whole or not at all."""
        state = {
            "fingerprint": self.fingerprint,
            "gaussians": dataclasses.asdict(self.gaussians.detach()),
            "why_appearance": self.why_appearance,
            "adam": {"first": self.adam.first, "second": self.adam.second, "steps": self.adam.steps},
            "growth": (self.growth.gradient, self.growth.weight, self.growth.radius_px),
            "shadow_maps": [
                (sun, m.sun.world_to_camera, m.sun.K, m.first_m) for sun, m in self.shadow_maps.items()
            ],
            "boxes": [(box.centre, box.axes, box.half_extents) for box in self.boxes],
            "batches": self.batches.state(),
            "rng": self.rng.get_state(),
            "poses": self.poses.state() if self.poses is not None else None,
            "decisions": (self.poses_decided, self.grow_until, self.growth_ended),
            "best": (self.best, self.intervals_since_best),
            "numbers": (self.chi2, self.psnr_db, self.steps_done, self.seconds),
            "removed_not_finite": self.removed_not_finite,
            "history": [dataclasses.astuple(info) for info in self.history],
        }
        content = io.BytesIO()
        torch.save(state, content)
        write_whole(path, content.getvalue())

    def resume(self, path: Path) -> bool:
        """Go on from a checkpoint of this very training; return False when there is none."""
        if not path.exists():
            return False
        state = torch.load(path, weights_only=True)
        if state["fingerprint"] != self.fingerprint:
            log.warning("%s belongs to another training: it is not used", path)
            return False
        self.gaussians = trainable(Gaussians(**state["gaussians"]))
        self.why_appearance = state["why_appearance"]
        self.adam.first, self.adam.second = state["adam"]["first"], state["adam"]["second"]
        self.adam.steps = state["adam"]["steps"]
        self.growth = Growth(len(self.gaussians), self.config.pixel_weighted)
        self.growth.gradient, self.growth.weight, self.growth.radius_px = state["growth"]
        self.boxes = [obb.Obb(*box) for box in state["boxes"]]
        for sun, pose, K, first_m in state["shadow_maps"]:
            self.shadow_maps[sun] = ShadowMap(Cameras(pose, K, SHADOW_MAP_PX, SHADOW_MAP_PX), first_m)
        self.batches.restore(state["batches"])
        self.rng.set_state(state["rng"])
        self.poses = PoseCorrections(self.frames) if state["poses"] is not None else None
        if self.poses is not None:
            self.poses.restore(state["poses"])
        self.poses_decided, self.grow_until, self.growth_ended = state["decisions"]
        self.best, self.intervals_since_best = state["best"]
        self.chi2, self.psnr_db, self.steps_done, self.seconds = state["numbers"]
        self.removed_not_finite = state.get("removed_not_finite", 0)  # not in checkpoints of before
        self.history = [StepInfo(*info) for info in state["history"]]
        return True

    @functools.cached_property
    def fingerprint(self) -> str:
        """What makes this training this one: the method, the seed, the sensor and the frames."""
        digest = hashlib.sha256(json.dumps([dataclasses.asdict(self.config), self.seed]).encode())
        digest.update(repr(self.sensor).encode())
        for f in self.frames:
            digest.update(
                f.dn.numpy().tobytes() + f.world_to_camera.numpy().tobytes() + f.K.numpy().tobytes()
            )
            known = [None if tag is None else tag.tolist() for tag in (f.sun_dir, f.pose_covariance)]
            digest.update(repr((f.exposure_time_s, f.bracket, known)).encode())
        return digest.hexdigest()

    def _ask_held_out(self, share: float) -> None:
        """Decide by the held-out brackets what is due; when all is decided they join the training."""
        config = self.config
        if not self.poses_decided and share >= config.poses_from:
            self._decide_poses(share)
        waits = config.grow_patience > 0 and share < self.grow_until
        due = share >= config.grow_from and (self.steps_done + 1) % config.grow_interval == 0
        if self.batches.held_out and waits and due:
            self._judge_growth(share)
            waits = share < self.grow_until
        if self.batches.held_out and self.poses_decided and not waits:
            self.batches.hold_out([])

    def _decide_poses(self, share: float) -> None:
        """Refine the poses if corrections of the held-out brackets' would earn their parameters."""
        model, brackets = self.gaussians.detach(), self._held_out(share)
        rate = self.config.lr_poses
        mean, error = held_out.worth_of_corrections(model, self.frames, brackets, self.sensor, rate)
        pays = mean - error > WORTH_REFINING
        self.poses = PoseCorrections(self.frames) if pays else None
        self.poses_decided = (
            f"{'refined' if pays else 'as tagged'} (step {self.steps_done + 1}: correcting a held-out bracket gains "
            f"{mean:.1f} ± {error:.1f} times its price)"
        )
        log.info("poses %s", self.poses_decided)

    def _judge_growth(self, share: float) -> None:
        """End the growth when the held-out brackets have not been explained better for some intervals."""
        model, scale = self.gaussians.detach(), _image_scale(self.config, share)
        rate, refined = self.config.lr_poses, self.poses is not None
        losses = held_out.losses(model, self.frames, self._held_out(share), self.sensor, rate, refined)
        gain, error = math.inf, 0.0
        if self.best is not None and self.best[0] == scale:
            gain, error = held_out.mean_and_error(self.best[1] - losses)
        if gain > error:
            self.best, self.intervals_since_best = (scale, losses), 0
            return
        self.intervals_since_best += 1
        if self.intervals_since_best >= self.config.grow_patience:
            self.grow_until = share
            self.growth_ended = (
                f"held-out loss {losses.mean():.4f}, {gain:.4f} ± {error:.4f} less than "
                f"{self.intervals_since_best} intervals before"
            )
            log.info("step %d: growth ends, %s", self.steps_done + 1, self.growth_ended)

    def _held_out(self, share: float) -> list[Batch]:
        return [self.batches.batch(b, _image_scale(self.config, share)) for b in self.batches.held_out]

    def _priors(self, batch: Batch, share: float, rendered: Rendered, cameras: Cameras) -> Tensor:
        """Return what is asked of the Gaussians besides the images: thin and solid ones, likely poses and exposures."""
        config, total = self.config, torch.zeros(())
        if config.sh_weight and self.gaussians.sh.shape[1] > 1 and self.gaussians.shading == "view":
            total = total + config.sh_weight * self.gaussians.sh[:, 1:].square().mean()
        if batch.sky is not None:
            total = total + config.sky_weight * (rendered.alpha * batch.sky).mean()
        if config.flat_weight:
            total = total + config.flat_weight * self.gaussians.scales.amin(dim=1).mean() / self.radius
        if rendered.normals is not None:
            images = (rendered.depth, rendered.alpha, rendered.normals)
            total = total + config.normal_weight * normal_disagreement(*images, cameras)
        if config.solid_weight and share >= config.solid_from:
            opacities = self.gaussians.opacities
            total = total + config.solid_weight * (opacities * (1 - opacities)).mean()
        for corrections in (self.poses, self.batches.exposures):
            if corrections is not None:
                total = total + corrections.prior(batch.indices, batch.dn.numel())
        return total

    def _freeze_later_degrees(self) -> None:
        """Keep the coefficients of radiance still whose degree has not come yet (Kerbl et al. 2023)."""
        gradient = self.gaussians.sh.grad
        if self.config.sh_interval and gradient is not None:
            degree = self.steps_done // self.config.sh_interval
            gradient[:, (degree + 1) ** 2 :] = 0

    def _sunlit(self, cameras: Cameras) -> Tensor | None:
        """Return the share of each camera's Sun that reaches each Gaussian [C, N]; none where that does not count.

        What the Sun sees moves slowly: it is looked up in pictures that are taken only every so many steps.
        """
        if self.gaussians.shading != "lambert":
            return None
        if self.steps_done % self.config.shadow_interval == 0:
            self.shadow_maps = {}
        maps = []
        for sun_dir in cameras.known_suns():
            sun = tuple(sun_dir.tolist())
            if sun not in self.shadow_maps:
                self.shadow_maps[sun] = shadow_map(self.gaussians, sun_dir)
            maps.append(self.shadow_maps[sun])
        return lit_shares(self.gaussians, maps)

    def _observe(self, rendered: Rendered, batch: Batch, residual: Tensor) -> None:
        """Record the screen gradients, and the boxes behind each frame's worst tile."""
        depth_weight = None
        if self.config.depth_scale:
            near_m = self.config.depth_scale * self.unit_m
            depth_weight = (_depths_m(self.gaussians.means, batch.cameras) / near_m).clamp(0, 1) ** 2
        self.growth.observe(rendered, max(batch.cameras.width, batch.cameras.height) / 2, depth_weight)
        if not self.config.obb_interval:
            return
        error = residual.abs()
        means = self.gaussians.means.detach()
        for i in range(len(batch.cameras)):
            tile = obb.worst_tile(error[i])
            members = obb.behind_tile(
                means, rendered.means2d[i], rendered.depth[i], batch.cameras.world_to_camera[i], tile
            )
            if members.sum() >= obb.FEWEST:
                self.boxes.append(obb.fit(means[members], self.config.obb_mean_centre))

    def _change_number(self, share: float, batch: Batch) -> None:
        """Grow, prune and weigh the Gaussians at the method's intervals."""
        config, now = self.config, self.steps_done + 1
        growing = config.grow_from <= share < self.grow_until
        if growing and now % config.grow_interval == 0:
            self._drop_not_finite()
            self.gaussians = densify(
                self.gaussians, self.adam, self.growth, self.unit_m, config, share, self.rng
            )
            self.growth, self.boxes = Growth(len(self.gaussians), config.pixel_weighted), []
        elif growing and self.boxes and now % config.obb_interval == 0:
            self._drop_not_finite()
            self.gaussians, self.growth = densify_boxes(
                self.gaussians, self.adam, self.growth, self.boxes, self.unit_m, config, self.rng
            )
            self.boxes = []
        if config.opacity_reset_interval and growing and now % config.opacity_reset_interval == 0:
            with torch.no_grad():
                self.gaussians.opacity_logits.clamp_(max=math.log(0.01 / 0.99))
            self.adam.rest("opacity_logits")
        scale, sun_moves = math.sqrt(1 / batch.averaged_pixels), 0 < config.sun_span_deg < self.sun_span_deg
        if any(now == round(at * config.steps) for at in config.weigh_at):
            self.best = None  # a model just weighed explains less for a while
            self._weigh(scale)
            self._raise_degree(scale, *(("sun", "view") if sun_moves else ("view",)))
        elif sun_moves and now == round(config.sun_from * config.steps):
            self._raise_degree(scale, "sun")

    def _drop_not_finite(self) -> None:
        """Remove the Gaussians of which a parameter is no number any more, and count them."""
        kept = finite(self.gaussians)
        count = len(kept) - int(kept.sum())
        if count == len(kept):
            problem = f"none of {count} Gaussians has finite parameters any more,"
            raise Diverged(self.steps_done, math.nan, problem)
        if count:
            self.gaussians = keep(self.gaussians, self.adam, kept)
            self.growth.follow(kept)
            self.removed_not_finite += count
            log.warning("step %d: %d Gaussians were not finite and are removed", self.steps_done, count)

    def _weigh(self, scale: float) -> None:
        """Remove the Gaussians that do not earn their parameters."""
        self._drop_not_finite()
        gains, values = likelihood_gains(self.gaussians, self.batches, self.sensor, scale, self.rng)
        earning = gains >= self.config.price_factor * price(self.gaussians, values)
        earning |= self.gaussians.opacities.detach() > self.config.keep_opacity
        if earning.any():
            removed = len(self.gaussians) - int(earning.sum())
            self.gaussians = keep(self.gaussians, self.adam, earning)
            self.growth, self.boxes = Growth(len(self.gaussians), self.config.pixel_weighted), []
            log.info("step %d: %d Gaussians did not earn their parameters", self.steps_done + 1, removed)

    def _raise_degree(self, scale: float, *directions: Literal["view", "sun"]) -> None:
        """Raise the harmonics' degree if that would pay; constant ones turn with the first direction that does.

        A Sun that moves goes first: it is known to change what is seen. Of two score tests the larger gain is no guide:
        each frame has one view and one Sun, so either explains much of the other, and neighbours' gains are counted
        twice (a tumbling target, view by 1.66 to 1.52 Mnats: 30.6 dB on held-out views; with the Sun 33.9 dB).
        """
        degree = math.isqrt(self.gaussians.sh.shape[1])
        if degree > self.config.most_sh_degree or self.gaussians.shading == "lambert":
            return
        tested = []
        for direction in directions if degree == 1 else (self.gaussians.shading,):
            turning = dataclasses.replace(self.gaussians, shading=direction)
            gain, cost = next_degree_gain(turning, self.batches, self.sensor, scale, self.rng)
            tested.append(f"with the {direction} it would gain {gain:.0f} nats at a price of {cost:.0f}")
            if gain <= cost:
                continue
            if direction == "sun" and self.config.sun_shading == "lambert":
                self.gaussians = trainable(lambertian(self.gaussians))
            else:
                self.gaussians = trainable(padded(turning, degree))
                self.adam.widen(self.gaussians)
            break
        self.why_appearance = f"step {self.steps_done + 1}, degree {degree}: {'; '.join(tested)}"
        log.info("radiance %s", self.appearance)

    def _look(self, rendered: Rendered, batch: Batch) -> None:
        """Keep the running chi² on the target, and the PSNR of this step's frames."""
        chi2, self.psnr_db = fit_figures(
            rendered.radiance,
            rendered.alpha,
            batch.exposure_time_s,
            batch.dn,
            self.sensor,
            batch.averaged_pixels,
        )
        if not math.isnan(chi2):
            self.chi2 = chi2 if math.isnan(self.chi2) else CHI2_MEMORY * self.chi2 + (1 - CHI2_MEMORY) * chi2


def _paid_for(config: MethodConfig, lit_pixels: int) -> tuple[MethodConfig, str]:
    """Return the method with no more Gaussians than the budget and the lit pixels allow, and the budget in words."""
    most, budget = config.max_gaussians, f"at most {config.max_gaussians:,} Gaussians"
    if config.pixels_per_gaussian and lit_pixels // config.pixels_per_gaussian < most:
        most = max(1, lit_pixels // config.pixels_per_gaussian)
        budget = (
            f"at most {most:,} Gaussians instead of {config.max_gaussians:,}: one for each "
            f"{config.pixels_per_gaussian} of the {lit_pixels:,} pixels that are lit in the long exposures"
        )
    fewer = min(config.start_count, most)
    return dataclasses.replace(config, max_gaussians=most, start_count=fewer), budget


def _decided_at_once(config: MethodConfig, frames: list[TrainingFrame], brackets: list[list[int]]) -> str:
    """Return whether the poses are refined, and why, where no training is needed to know."""
    if config.refine_poses != "auto":
        return {"never": "as tagged", "always": "refined"}[config.refine_poses]
    if not any(f.pose_covariance is not None and f.pose_covariance.any() for f in frames):
        return "as tagged (the tags are exact)"
    return "" if brackets else "as tagged (too few brackets to hold any out)"


def _image_scale(config: MethodConfig, share: float) -> float:
    return next(scale for start, scale in reversed(config.pyramid) if share >= start)


def _image_loss(
    rendered: Rendered, batch: Batch, sensor: Sensor, config: MethodConfig
) -> tuple[Tensor, Tensor]:
    """Return the loss of a step and what growth looks at [B, H, W, C]: residuals in sigmas, or in full scales."""
    images = (rendered.radiance, batch.exposure_time_s, batch.dn, sensor)
    if config.loss == "likelihood":
        return likelihood_loss(*images, batch.averaged_pixels, config.edge_weight)
    loss, residual = published_loss(*images, config.ssim_weight, config.edge_weight)
    return loss * len(batch.cameras), residual  # a sum over the step's frames, as published


def _rates(config: MethodConfig, share: float, unit_m: float, coefficients: int) -> dict[str, float | Tensor]:
    """Return the rate of each parameter at a share of the steps; of the radiance one a coefficient if they differ."""
    fall = config.lr_end**share
    lr_sh: float | Tensor = config.lr_sh * fall
    if config.lr_sh_rest != 1 and coefficients > 1:
        factors = torch.full((1, coefficients, 1), config.lr_sh_rest)
        factors[:, 0] = 1
        lr_sh = lr_sh * factors
    return {
        "means": config.lr_means ** (1 - share) * config.lr_means_end**share * unit_m,
        "quats": config.lr_quats * fall,
        "log_scales": config.lr_log_scales * fall,
        "opacity_logits": config.lr_opacity_logits * fall,
        "sh": lr_sh,
        "ambient": config.lr_ambient * fall,
    }


def _depths_m(means: Tensor, cameras: Cameras) -> Tensor:
    """Return how far before each camera's plane the Gaussians lie [C, N], m."""
    along = cameras.world_to_camera[:, 2]
    return along[:, :3] @ means.detach().T + along[:, 3:]


def _seconds_left(history: list[StepInfo], config: MethodConfig, done: int, seconds: float) -> float:
    """Return the time the remaining steps will take: their work at the pace of the last fifty."""

    def work(first: int, last: int) -> float:
        starts = [round(start * config.steps) for start, _ in config.pyramid] + [config.steps]
        return sum(
            max(0, min(last, until) - max(first, start)) * (FLAT_COST + scale**2)
            for (_, scale), start, until in zip(config.pyramid, starts[:-1], starts[1:], strict=True)
        )

    before = history[-50] if len(history) >= 50 else None
    since, spent = (before.step, seconds - before.seconds) if before else (0, seconds)
    return spent / max(work(since, done), 1e-9) * work(done, config.steps)
