"""Trainings of Gaussians as compared methods: resumable, followed on the way, ended early where they have converged."""

import dataclasses
import functools
import time
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from compare.follow import MARKS
from compare.opponents.reconstruction import EstimatedPoses, Reconstruction, Work
from ground.run.intervals import interval_scores, stated_error_scores
from ground.run.model_files import SURFACE_POINTS
from obbgs_base.errors import Interrupted
from obbgs_core.frames import TrainingFrame, cameras_of
from obbgs_core.io.ply import save_ply
from obbgs_core.methods.config import MethodConfig
from obbgs_core.model.cameras import Cameras
from obbgs_core.model.gaussians import Gaussians
from obbgs_core.poses.corrections import with_estimate
from obbgs_core.poses.estimate import PoseEstimate
from obbgs_core.render import render
from obbgs_core.score.poses import settled_poses
from obbgs_core.score.surface import surface_positions
from obbgs_core.sensor import Sensor
from obbgs_core.train.result import Exposing, TrainResult
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
) -> Reconstruction:
    """Return the Gaussians that a method trains; its figures say how the training went.

    The same call goes on from the checkpoint of a killed one and ends in the same model. A limit of 0 s returns the
    Gaussians that the training starts from.

    Args:
        settled: asked after growth and resets are over and half of the steps are done; when it is true the training
            ends as converged. A method with a rule of its own for its end (`chi2_end`) is not asked.

    Raises:
        ReconstructionError: the frames allow no model, or the training diverged.
        Interrupted: work.should_stop returned true; the training is saved.
        OSError: it cannot be saved.
    """
    trainer = Trainer(frames, sensor, config, seed)
    checkpoint = None if work.folder is None else work.folder / CHECKPOINT
    if checkpoint is not None:
        trainer.resume(checkpoint)
    resumed_at = trainer.state.steps_done

    def save() -> None:
        if checkpoint is not None:
            trainer.save(checkpoint)

    saved_s = time.monotonic()
    while not (reason := trainer.stop_reason(time_limit_s)):
        if converged := _may_end(trainer) and settled():
            reason = f"converged at step {trainer.state.steps_done} of {config.steps}"
            break
        info = trainer.step()
        work.on_step(info.step / info.steps, info.seconds, lambda: _snapshot(trainer))
        if work.should_stop():
            save()
            raise Interrupted(f"interrupted at step {info.step} of {info.steps}")
        marked = any((info.step - 1) / info.steps < mark <= info.step / info.steps for mark in MARKS)
        if marked or time.monotonic() - saved_s > CHECKPOINT_EVERY_S:
            save()
            saved_s = time.monotonic()
    else:
        converged = False
    save()
    result = trainer.result(reason)
    if work.folder is not None:
        save_ply(result.gaussians, work.folder / MODEL, sun_dir=frames[0].sun_dir)
    posed = _estimated(frames, result.pose_estimate)
    return Reconstruction(
        points=result.gaussians.means,
        surface=surface_positions(result.gaussians, cameras_of(posed), SURFACE_POINTS, seed),
        image=imaging(result.gaussians, sensor, result.exposing),
        size_bytes=sum(4 * tensor.numel() for tensor in result.gaussians.parameters().values()),
        seconds=result.seconds,
        figures={
            "gaussians": len(result.gaussians),
            "steps": trainer.state.steps_done,
            "converged": converged,
            **({"resumed_at": resumed_at} if resumed_at else {}),
            "start": result.start,
            "stop": result.stop_reason,
            "appearance": result.appearance,
            "growth": result.growth,
            "poses": result.poses,
        },
        # the images of other methods need more than a radiance and an exposure time
        stated_errors=functools.partial(_stated_errors, result, posed, sensor)
        if config.exposure_aware and not config.published.compensation
        else None,
        poses=_poses(result.gaussians, sensor, result.pose_estimate),
    )


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


def imaging(gaussians: Gaussians, sensor: Sensor, exposing: Exposing) -> Callable[[Cameras, float], Tensor]:
    """Return the function from a camera and an exposure time (s) to a model's image [H, W, C] in 0..1.

    Args:
        exposing: what the pictures are made with: the exposure that a blind method takes every other for, and the gains
            that a method has learnt.
    """

    @torch.no_grad()
    def image(camera: Cameras, exposure_time_s: float) -> Tensor:
        radiance = render(gaussians, camera).radiance[0]
        return exposing.image(radiance, sensor, exposure_time_s)

    return image


def _may_end(trainer: Trainer) -> bool:
    """Return whether growth and resets are over and half of the steps are done, of a method without an own end."""
    config = trainer.setup.config
    half_done = trainer.state.steps_done >= NEVER_BEFORE * config.steps
    return half_done and trainer.is_past_growth and not config.chi2_end


def _snapshot(trainer: Trainer) -> Reconstruction:
    """Return the training as it stands, without points on its surface, which take long."""
    gaussians, setup, poses = trainer.gaussians, trainer.setup, trainer.state.poses.corrections
    estimate = None if poses is None else poses.estimate(setup.frames)  # dark frames are not among those
    return Reconstruction(
        points=gaussians.means,
        surface=torch.zeros(0, 3),
        image=imaging(gaussians, setup.sensor, trainer.exposing),
        size_bytes=0,
        seconds=trainer.state.seconds,
        poses=_poses(gaussians, setup.sensor, estimate),
    )
