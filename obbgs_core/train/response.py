"""The response of a camera whose readings are no straight line in light: its exponent, learnt beside the model.

The model is one for all exposure times. If the readings of long exposures are too bright for it and those of short
ones too dark, by a ratio that is a power of the exposure time, then readings are that power of light. Frames are
compared with the ones beside them, so that what changes slowly along a pass, such as the light, is no evidence.

Source: Mitsunaga and Nayar, Radiometric self calibration, 1999, who fit a polynomial to exposures of one view.
"""

import logging
import math
from dataclasses import dataclass

import numpy as np
import torch

from obbgs_core.batches import Batch, Batches
from obbgs_core.misfit import sampled
from obbgs_core.model.gaussians import Gaussians
from obbgs_core.render import render
from obbgs_core.sensor import Sensor

log = logging.getLogger(__name__)
DECIDED_AT = (0.3, 0.5, 0.7)  # shares of the steps
LEAST_STEP = 0.1  # of the logarithms of exposure times that are compared
FEWEST_READINGS = 30
MOST = 120  # pairs of neighbouring frames that are rendered
FEWEST = 24  # pairs of frames that are compared
LEFT_OUT = 10  # parts of the pass, each left out once (jackknife)
LEAST, CERTAIN = (
    0.02,
    3.0,
)  # an exponent is used that is by so much other than 1, and by so many of its errors
LIT_SIGMA, BELOW_FULL_SCALE = 4.0, 0.9  # readings that count: between so much noise and so much of full scale
RANGE = (0.3, 3.0)  # of exponents


@dataclass
class Response:
    """What is known of the exponent."""

    exponent: float = 1.0  # that is used
    error: float = math.nan  # its standard error; nan: not measured

    @torch.no_grad()
    def decide(self, model: Gaussians, batches: Batches, sensor: Sensor, misfit: float) -> bool:
        """Take the exponent that the frames tell beside the model as it stands; return whether it is another one."""
        last = len(batches.frames) - 2
        starts = np.linspace(0, last, min(last + 1, MOST)).round().astype(int).tolist()
        told = {
            i: _told(model, batches.batch([i]), sensor, misfit)
            for i in sorted({*starts, *(i + 1 for i in starts)})
        }
        found = [(told[i], told[i + 1]) for i in starts]
        pairs = np.array([np.subtract(b, a) for a, b in found if a and b]).reshape(-1, 2)
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


def _told(model: Gaussians, batch: Batch, sensor: Sensor, misfit: float) -> tuple[float, float] | None:
    """Return ln of a frame's exposure time, and of the light that it reads over that which is expected.

    None where too few readings tell.
    """
    radiance, dn = sampled(sensor, render(model, batch.cameras).radiance, batch.dn)
    prediction = sensor.predicted(radiance, batch.exposure_time_s)
    light, variance = prediction.expected_dn - sensor.black_dn, prediction.variance_dn2
    counts = light > LIT_SIGMA * variance.sqrt()
    counts &= light < BELOW_FULL_SCALE * (sensor.white_dn - sensor.black_dn)
    if counts.sum() < FEWEST_READINGS:
        return None
    light, read = light[counts], dn[counts] - sensor.black_dn
    weight = 1 / (variance[counts] + (misfit * light).square())
    ratio = float((weight * light * read).sum() / (weight * light.square()).sum())
    return (math.log(batch.exposure_time_s.item()), math.log(ratio)) if ratio > 0 else None


def _slope(pairs: np.ndarray) -> float:
    """Return the slope of the line through the origin that fits pairs [N, 2] best."""
    return float(pairs[:, 0] @ pairs[:, 1] / (pairs[:, 0] @ pairs[:, 0]))
