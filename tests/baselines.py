"""Baselines without training: how a black image, the mean image and the untrained start score on held-out frames.

A bar for image quality says something only where it lies above these: on small dark pictures black alone scores 34 dB.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from obbgs_core.score.metrics import foreground_psnr_db, psnr_db
from obbgs_core.train.config import MethodConfig
from obbgs_core.train.trainer import Trainer
from tests.benchmarks.targets import Target, predicted


@dataclass(frozen=True)
class Score:
    """Mean PSNR over the held-out frames against their noiseless exposures, dB."""

    clean_db: float  # of the whole image
    foreground_db: float  # of the pixels that the target covers


def black(target: Target) -> Score:
    """Return the score of images without light: the black level in every pixel."""
    level = target.sensor.black_dn / target.sensor.white_dn
    return _score(target, [torch.full_like(exact, level) for exact in target.clean])


def mean_image(target: Target) -> Score:
    """Return the score of predicting, for each exposure time, the mean of its training frames.

    Where no training frame has the exposure time, it is the mean of all of them.
    """
    means: dict[float, Tensor] = {}
    for exposure_s in {f.exposure_time_s for f in target.held_out}:
        same = [f.dn for f in target.training if f.exposure_time_s == exposure_s]
        means[exposure_s] = torch.stack(same or [f.dn for f in target.training]).mean(0)
    return _score(target, [means[f.exposure_time_s] / target.sensor.white_dn for f in target.held_out])


def untrained(target: Target, config: MethodConfig, seed: int = 0) -> Score:
    """Return the score of the Gaussians that a training starts from.

    Raises:
        ReconstructionError: the frames allow no start, as in `Trainer`.
    """
    trainer = Trainer(target.training, target.sensor, config, seed)
    gaussians, reference_s = trainer.gaussians, trainer.setup.reference_exposure_s
    images = [
        predicted(gaussians, f, target.sensor, reference_s or f.exposure_time_s) for f in target.held_out
    ]
    return _score(target, images)


def _score(target: Target, images: list[Tensor]) -> Score:
    clean = [psnr_db(image, exact) for image, exact in zip(images, target.clean, strict=True)]
    foreground = foreground_psnr_db(zip(images, target.clean, target.alpha, strict=True))
    return Score(math.fsum(clean) / len(clean), foreground)
