"""The response of a camera whose readings are no straight line in light: its exponent, learnt beside the model.

The model is one for all exposure times. If the readings of long exposures are too bright for it and those of short
ones too dark, by a ratio that is a power of the exposure time, then readings are that power of light. Frames are
compared with their neighbours in the bracket alone, because an exposure time that an automatic camera chose by what it
saw says what it saw, and in the radiance that both can read, so that a model which is too dark where it is bright is no
evidence either.

Source: Mitsunaga and Nayar, Radiometric self calibration, 1999, who fit a polynomial to exposures of one view.
"""

import itertools
import logging
import math
from dataclasses import dataclass

import numpy as np
import torch

from obbgs_core.batches import Batch, Batches
from obbgs_core.frames import bracket_numbers
from obbgs_core.misfit import sampled
from obbgs_core.model.gaussians import Gaussians
from obbgs_core.render import render
from obbgs_core.sensor import Sensor

log = logging.getLogger(__name__)
DECIDED_AT = (0.3, 0.5, 0.7)  # shares of the steps
LEAST_STEP = 0.1  # of the logarithms of exposure times that are compared
FEWEST_READINGS = 30
MOST = 120  # pairs of neighbours in a bracket that are rendered
FEWEST = 24  # pairs of frames that are compared
LEFT_OUT = 10  # parts of the pass, each left out once (jackknife)
# an exponent is used that is by so much other than 1, and by so many of its errors
LEAST, CERTAIN = 0.02, 3.0
LIT_SIGMA, BELOW_FULL_SCALE = 4.0, 0.9  # readings that count: between so much noise and so much of full scale
RANGE = (0.3, 3.0)  # of exponents


@dataclass
class Response:
    """What is known of the exponent."""

    exponent: float = 1.0  # that is used
    error: float = math.nan  # its standard error; nan: not measured

    @torch.no_grad()
    def decide(self, model: Gaussians, batches: Batches, sensor: Sensor) -> bool:
        """Take the exponent that the frames tell beside the model as it stands; return whether it is another one."""
        numbers = bracket_numbers(batches.frames)
        pairs_of_one = [i for i, (a, b) in enumerate(itertools.pairwise(numbers)) if a == b]
        if len(pairs_of_one) < FEWEST:
            return False
        chosen = np.linspace(0, len(pairs_of_one) - 1, min(len(pairs_of_one), MOST)).round().astype(int)
        starts = [pairs_of_one[i] for i in chosen]
        told = {
            i: _told(model, batches.batch([i]), sensor) for i in sorted({*starts, *(i + 1 for i in starts)})
        }
        found = [_compared(told[i], told[i + 1]) for i in starts]
        pairs = np.array([pair for pair in found if pair]).reshape(-1, 2)
        pairs = pairs[np.abs(pairs[:, 0]) > LEAST_STEP]
        if len(pairs) < FEWEST:
            return False
        parts = np.arange(len(pairs)) * LEFT_OUT // len(pairs)
        without = np.array([_slope(pairs[parts != part]) for part in range(LEFT_OUT)])
        self.error = math.sqrt((LEFT_OUT - 1) * without.var())
        now, before = self.exponent + _slope(pairs), self.exponent
        is_bent = abs(now - 1) > max(LEAST, CERTAIN * self.error)
        self.exponent = min(max(now, RANGE[0]), RANGE[1]) if is_bent else 1.0
        if self.exponent != 1:
            log.info("%s", self)
        return self.exponent != before

    def __str__(self) -> str:
        if self.exponent == 1:
            return "readings are linear in light, as stated"
        return f"readings follow light to the power of {self.exponent:.3f} ± {self.error:.3f}"


@dataclass(frozen=True)
class _Told:
    """What the readings of a frame say beside the model: [K] values of pixels that are neither dark nor full."""

    exposure_time_s: float
    radiance: torch.Tensor
    light: torch.Tensor  # that is expected, DN above black
    read: torch.Tensor  # DN above black

    def log_ratio(self, least: float, most: float) -> float | None:
        """Return ln of the light that is read over that which is expected, where the radiance lies between bounds.

        None where too few readings tell.
        """
        counts = (self.radiance >= least) & (self.radiance <= most)
        if counts.sum() < FEWEST_READINGS:
            return None
        # a ratio of sums: any weight of pixels by their noise would be another one for each exposure time
        ratio = float(self.read[counts].sum() / self.light[counts].sum())
        return math.log(ratio) if ratio > 0 else None


def _told(model: Gaussians, batch: Batch, sensor: Sensor) -> _Told:
    radiance, dn = sampled(sensor, render(model, batch.cameras).radiance, batch.dn)
    prediction = sensor.predicted(radiance, batch.exposure_time_s)
    light, variance = prediction.expected_dn - sensor.black_dn, prediction.variance_dn2
    counts = light > LIT_SIGMA * variance.sqrt()
    counts &= light < BELOW_FULL_SCALE * (sensor.white_dn - sensor.black_dn)
    return _Told(batch.exposure_time_s.item(), radiance[counts], light[counts], dn[counts] - sensor.black_dn)


def _compared(one: _Told, other: _Told) -> tuple[float, float] | None:
    """Return by how much ln of the exposure time, and of read over expected light, differ between two frames.

    None where too few readings of either lie in the radiance that both can read.
    """
    if not one.radiance.numel() or not other.radiance.numel():
        return None
    least = max(float(one.radiance.min()), float(other.radiance.min()))
    most = min(float(one.radiance.max()), float(other.radiance.max()))
    before, after = one.log_ratio(least, most), other.log_ratio(least, most)
    if before is None or after is None:
        return None
    return math.log(other.exposure_time_s / one.exposure_time_s), after - before


def _slope(pairs: np.ndarray) -> float:
    """Return the slope of the line through the origin that fits pairs [N, 2] best."""
    return float(pairs[:, 0] @ pairs[:, 1] / (pairs[:, 0] @ pairs[:, 0]))
