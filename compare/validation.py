"""Early stopping by validation: some brackets are kept back, and the model that shows them best is the result."""

import dataclasses
import io
import math
import time
from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor

from obbgs_base.files import write_whole
from obbgs_core.frames import TrainingFrame, cameras_of
from obbgs_core.model.cameras import Cameras
from obbgs_core.model.gaussians import Gaussians
from obbgs_core.render import render
from obbgs_core.score.metrics import psnr_db
from obbgs_core.sensor import Sensor
from obbgs_core.train.result import Exposing, TrainResult
from obbgs_core.train.trainer import Trainer

BEST = "best.pt"
VALIDATED_EVERY = 10  # brackets; one of so many is kept back
PATIENCE = 0.2  # of the steps


def withheld(frames: list[TrainingFrame]) -> tuple[list[TrainingFrame], list[TrainingFrame]]:
    """Return frames to train on, and every tenth bracket to validate by; few enough are all trained on."""
    brackets = list(dict.fromkeys(frame.bracket for frame in frames))
    validating = set(brackets[VALIDATED_EVERY // 2 :: VALIDATED_EVERY])
    parts = [f for f in frames if f.bracket not in validating], [f for f in frames if f.bracket in validating]
    return parts if parts[1] else (frames, [])


class Best:
    """The model of a training that shows brackets best which were kept back from it.

    Args:
        frames: of those brackets.
        path: where it is kept; None: nowhere.
    """

    def __init__(self, frames: list[TrainingFrame], path: Path | None):
        self._frames, self._path = frames, path
        self.step, self._psnr_db = 0, -math.inf
        self._model: Gaussians | None = None
        self._exposing: Exposing | None = None
        if frames and path is not None and path.exists():
            with torch.serialization.safe_globals([Gaussians, Exposing]):
                kept = torch.load(path, weights_only=True)
            self.step, self._psnr_db, self._model, self._exposing = kept

    @torch.no_grad()
    def look(self, trainer: Trainer) -> None:
        """Keep the model as it is now where it is the best so far; the training's clock goes on."""
        began = time.monotonic()
        gaussians, sensor, exposing = trainer.gaussians.detach(), trainer.setup.sensor, trainer.exposing
        image = imaging(gaussians, sensor, exposing)
        values = [
            psnr_db(image(cameras_of([f]), f.exposure_time_s), f.dn / sensor.white_dn) for f in self._frames
        ]
        value = sum(values) / len(values)
        if value > self._psnr_db:
            self.step, self._psnr_db = trainer.state.steps_done, value
            self._model, self._exposing = gaussians.copied(), exposing
            if self._path is not None:
                content = io.BytesIO()
                torch.save((self.step, value, self._model, exposing), content)
                write_whole(self._path, content.getvalue())
        trainer.state.seconds += time.monotonic() - began

    def is_past(self, trainer: Trainer) -> bool:
        """Return whether no model has been better for a fifth of the steps."""
        return trainer.state.steps_done - self.step > PATIENCE * trainer.setup.config.steps

    def of(self, trainer: Trainer, result: TrainResult) -> TrainResult:
        """Return a finished training with its best model."""
        self.look(trainer)
        assert self._model is not None and self._exposing is not None
        return dataclasses.replace(
            result, gaussians=self._model, exposing=self._exposing, seconds=trainer.state.seconds
        )


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
