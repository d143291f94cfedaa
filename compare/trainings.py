"""Trainings of Gaussians as compared methods: resumable, followed on the way, ended early where they have converged."""

import dataclasses
import functools
import time
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from compare.follow import MARKS
from compare.opponents.reconstruction import EstimatedPoses, Reconstruction, Work
from compare.validation import BEST, Best, imaging, withheld
from ground.run.model_files import SURFACE_POINTS
from obbgs_base.errors import Interrupted
from obbgs_core.frames import TrainingFrame, cameras_of
from obbgs_core.io.ply import save_ply
from obbgs_core.methods.config import MethodConfig
from obbgs_core.model.gaussians import Gaussians
from obbgs_core.poses.corrections import with_estimate
from obbgs_core.poses.estimate import PoseEstimate
from obbgs_core.score.intervals import interval_scores, stated_error_scores
from obbgs_core.score.poses import settled_poses
from obbgs_core.score.surface import surface_positions
from obbgs_core.sensor import Sensor
from obbgs_core.train.result import TrainResult
from obbgs_core.train.trainer import CHECKPOINT_EVERY_S, Trainer

CHECKPOINT, MODEL = "training.checkpoint", "model.ply"
NEVER_BEFORE = 0.5  # of the steps: no training ends early before


def reconstruct_gaussians(
    frames: list[TrainingFrame],
    sensor: Sensor,
    config: MethodConfig,
    seed: int,
    work: Work,
    settled: Callable[[], bool] = lambda: False,
    time_limit_s: float = float("inf"),
    validated: bool = False,
) -> Reconstruction:
    """Return the Gaussians that a method trains; its figures say how the training went.

    The same call goes on from the checkpoint of a killed one and ends in the same model. A limit of 0 s returns the
    Gaussians that the training starts from.

    Args:
        settled: asked after growth and resets are over and half of the steps are done; when it is true the training
            ends as converged. A method with a rule of its own for its end (`chi2_end`) is not asked.
        validated: every tenth bracket is not trained on; the model is the one on the way that shows those best, and the
            training ends where none has been better for a fifth of the steps. What that takes counts.

    Raises:
        ReconstructionError: the frames allow no model, or the training diverged.
        Interrupted: work.should_stop returned true; the training is saved.
        OSError: it cannot be saved.
    """
    frames, kept_back = withheld(frames) if validated else (frames, [])
    trainer = Trainer(frames, sensor, config, seed)
    checkpoint = None if work.folder is None else work.folder / CHECKPOINT
    if checkpoint is not None:
        trainer.resume(checkpoint)
    resumed_at = trainer.state.steps_done
    best = Best(kept_back, None if work.folder is None else work.folder / BEST)

    def save() -> None:
        if checkpoint is not None:
            trainer.save(checkpoint)

    saved_s = time.monotonic()
    while not (reason := trainer.stop_reason(time_limit_s)):
        if converged := _may_end(trainer) and settled():
            reason = f"converged at step {trainer.state.steps_done} of {config.steps}"
            break
        info = trainer.step()
        work.on_step(info.step / info.steps, info.seconds, lambda surface: _snapshot(trainer, surface))
        if work.should_stop():
            save()
            raise Interrupted(f"interrupted at step {info.step} of {info.steps}")
        marked = any((info.step - 1) / info.steps < mark <= info.step / info.steps for mark in MARKS)
        if marked and kept_back:
            best.look(trainer)
            if best.is_past(trainer):
                reason = f"validation brackets were shown best after step {best.step} of {config.steps}"
                converged = True
                break
        if marked or time.monotonic() - saved_s > CHECKPOINT_EVERY_S:
            save()
            saved_s = time.monotonic()
    else:
        converged = False
    save()
    result = best.of(trainer, trainer.result(reason)) if kept_back else trainer.result(reason)
    if work.folder is not None:
        save_ply(result.gaussians, work.folder / MODEL, sun_dir=frames[0].sun_dir)
    posed = _estimated(frames, result.pose_estimate)
    return Reconstruction(
        points=result.gaussians.means,
        surface=surface_positions(result.gaussians, cameras_of(posed), SURFACE_POINTS, seed),
        image=imaging(result.gaussians, sensor, result.exposing),
        size_bytes=sum(4 * tensor.numel() for tensor in result.gaussians.parameters().values()),
        seconds=result.seconds,
        figures=_figures(trainer, result, resumed_at, converged)
        | ({"best_step": best.step} if kept_back else {}),
        # the images of other methods need more than a radiance and an exposure time
        stated_errors=functools.partial(_stated_errors, result, posed, sensor)
        if config.exposure_aware and not config.published.compensation
        else None,
        poses=_poses(result.gaussians, sensor, result.pose_estimate),
    )


def _figures(trainer: Trainer, result: TrainResult, resumed_at: int, converged: bool) -> dict[str, Any]:
    """Return the columns of a row that say how a training went."""
    return {
        "gaussians": len(result.gaussians),
        "steps": trainer.state.steps_done,
        "converged": converged,
        **({"resumed_at": resumed_at} if resumed_at else {}),
        "start": result.start,
        "stop": result.stop_reason,
        "appearance": result.appearance,
        "growth": result.growth,
        "poses": result.poses,
    }


def _stated_errors(
    result: TrainResult,
    training: list[TrainingFrame],
    sensor: Sensor,
    scored: list[TrainingFrame],
    radiance: list[Tensor],
    calibration: Sequence[TrainingFrame],
) -> dict[str, float]:
    intervals = interval_scores(result.gaussians, training, sensor, scored, radiance, calibration)
    return intervals | stated_error_scores(result.gaussians, sensor, scored, result.misfit)


def _estimated(frames: list[TrainingFrame], estimate: PoseEstimate | None) -> list[TrainingFrame]:
    """Return training frames with the poses that a training found, without those that it left out."""
    if estimate is None:
        return frames
    poses = {number: torch.from_numpy(pose).float() for number, pose in estimate.by_frame().items()}
    return [dataclasses.replace(f, world_to_camera=poses[f.id]) for f in frames if f.id in poses]


def _poses(gaussians: Gaussians, sensor: Sensor, estimate: PoseEstimate | None) -> EstimatedPoses | None:
    if estimate is None:
        return None

    def settled(frames: list[TrainingFrame]) -> list[TrainingFrame]:
        tagged = with_estimate(frames, estimate)
        poses = settled_poses(gaussians, tagged, sensor)
        return [dataclasses.replace(f, world_to_camera=p) for f, p in zip(frames, poses, strict=True)]

    return EstimatedPoses(estimate, settled)


def _may_end(trainer: Trainer) -> bool:
    """Return whether growth and resets are over and half of the steps are done, of a method without an own end."""
    config = trainer.setup.config
    half_done = trainer.state.steps_done >= NEVER_BEFORE * config.steps
    return half_done and trainer.is_past_growth and not config.chi2_end


def _snapshot(trainer: Trainer, with_surface: bool) -> Reconstruction:
    """Return the training as it stands."""
    gaussians, setup, poses = trainer.gaussians, trainer.setup, trainer.state.poses.corrections
    estimate = None if poses is None else poses.estimate(setup.frames)  # dark frames are not among those
    frames = setup.frames if poses is None else poses.frames(setup.frames)
    return Reconstruction(
        points=gaussians.means,
        surface=surface_positions(gaussians, cameras_of(frames), SURFACE_POINTS)
        if with_surface
        else torch.zeros(0, 3),
        image=imaging(gaussians, setup.sensor, trainer.exposing),
        size_bytes=0,
        seconds=trainer.state.seconds,
        poses=_poses(gaussians, setup.sensor, estimate),
    )
