"""Which of several rotations, whose outlines all agree, is the target's: short trainings tell, or say that they do not.

A body and its mirror image, turning the mirrored way, show the same outlines from far away, but not the same surface:
what lies in front of one lies behind the other.
"""

import dataclasses
import logging
import math
from collections.abc import Callable

import numpy as np
import torch

from obbgs_base.errors import Interrupted
from obbgs_core.attitude.target_motion import TargetMotion
from obbgs_core.frames import TrainingFrame, cameras_of
from obbgs_core.losses import likelihood_loss
from obbgs_core.methods.presets import preset
from obbgs_core.render import render
from obbgs_core.sensor import Sensor
from obbgs_core.train.trainer import train

log = logging.getLogger(__name__)
STEPS = 150
HELD_OUT = 5  # every fifth bracket
# standard errors by which the best rotation's loss on held-out brackets is below that of each other
CERTAIN = 3.0


# A wrong rotation must not be excused as the model's own error. In the test of a mirrored motion its held-out loss is
# 5.3 standard errors above that of the true one (the method's own weights tell it as well since pictures are whole).
NOISE_ALONE = {
    "loss.misfit": False,
    "loss.flat_weight": 3.0,
    "loss.sky_weight": 0.2,
    "loss.solid_weight": 0.0,
}


def chosen_by_training(
    frames: list[TrainingFrame],
    times_s: np.ndarray,
    sensor: Sensor,
    motions: list[TargetMotion],
    on_share: Callable[[float], None] = lambda share: None,
    should_stop: Callable[[], bool] = lambda: False,
) -> int | None:
    """Return which motion's short training predicts held-out brackets best; None where no one does for certain.

    Args:
        frames: with poses and Sun relative to inertial axes.
        times_s: [N] of the frames, from the motions' epoch.
        on_share: called with the share of the trainings that is done.

    Raises:
        Interrupted: should_stop returned True.
    """
    losses = []
    for place, motion in enumerate(motions):
        if should_stop():
            raise Interrupted("interrupted while rotations were compared; nothing of it is kept")
        losses.append(held_out_losses(turning(frames, motion.inertial_to_body(times_s)), sensor))
        log.info("rotation %d of %d: held-out loss %.4g", place + 1, len(motions), losses[-1].mean())
        on_share((place + 1) / len(motions))
    best = int(np.argmin([loss.mean() for loss in losses]))
    for place, loss in enumerate(losses):
        worse = loss - losses[best]
        if place != best and not worse.mean() > CERTAIN * worse.std(ddof=1) / math.sqrt(len(worse)):
            return None
    return best


def turning(frames: list[TrainingFrame], inertial_to_body: np.ndarray) -> list[TrainingFrame]:
    """Return frames in the axes of a body with attitudes [N, 3, 3]; what their tags doubt is left out."""
    found = []
    for frame, attitude in zip(frames, torch.from_numpy(inertial_to_body).float(), strict=True):
        pose = frame.world_to_camera.clone()
        pose[:3, :3] = pose[:3, :3] @ attitude.T
        sun = None if frame.sun_dir is None else attitude @ frame.sun_dir
        found.append(
            dataclasses.replace(
                frame,
                world_to_camera=pose,
                sun_dir=sun,
                pose_covariance=None,
                navigation=None,
                inertial_to_body=None,
            )
        )
    return found


def held_out_losses(frames: list[TrainingFrame], sensor: Sensor) -> np.ndarray:
    """Return the mean loss of each held-out bracket [B] after a short training on the others."""
    brackets = sorted({frame.bracket for frame in frames if frame.bracket is not None})
    held_out = brackets[HELD_OUT // 2 :: HELD_OUT]
    config = preset("obbgs", {"steps": STEPS, "poses.refine": "never", **NOISE_ALONE})
    model = train([f for f in frames if f.bracket not in held_out], sensor, config).gaussians
    losses: dict[int, list[float]] = {bracket: [] for bracket in held_out}
    for frame in frames:
        if frame.bracket in losses:
            with torch.no_grad():
                radiance = render(model, cameras_of([frame])).radiance
                exposure_s = torch.full((1, 1, 1, 1), frame.exposure_time_s)
                loss, _ = likelihood_loss(radiance, exposure_s, frame.dn[None], sensor)
            losses[frame.bracket].append(float(loss))
    return np.array([np.mean(of_bracket) for of_bracket in losses.values()])
