"""The response of a camera whose readings are no straight line in light: its exponent, learnt beside the model.

The model is one for all exposure times. If the readings of long exposures are too bright for it and those of short
ones too dark, by a ratio that is a power of the exposure time, then readings are that power of light. Compared are
neighbours in a bracket, or, where every view has one exposure, the frames of neighbouring settings in each tenth of the
pass, which see the target from all of its sides alike. An exposure time that an automatic camera chose by what it saw
says what it saw, and tells nothing. Readings count in the radiance that both can read, so that a model which is too
dark where it is bright is no evidence either.

Source: Mitsunaga and Nayar, Radiometric self calibration, 1999, who fit a polynomial to exposures of one view.
"""

import itertools
import logging
import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch

from obbgs_core.batches import Batch, Batches
from obbgs_core.compiled import each
from obbgs_core.frames import TrainingFrame, bracket_numbers
from obbgs_core.misfit import sampled
from obbgs_core.model.gaussians import Gaussians
from obbgs_core.render import render
from obbgs_core.sensor import Sensor

log = logging.getLogger(__name__)
DECIDED_AT = (0.3, 0.5, 0.7)  # shares of the steps
LEAST_STEP = 0.1  # of the logarithms of exposure times that are compared
FEWEST_READINGS = 30
MOST = 120  # frames, or pairs of neighbours in a bracket, that are rendered
FEWEST = 24  # pairs of neighbours in brackets; of each setting, where views have one exposure, one a part
LEFT_OUT = 10  # parts of the pass, each left out once (jackknife)
# of ln of exposure times and ln of the light that the model shows in the frames: more, and the camera chose them by it
MOST_CHOSEN = 0.5
# an exponent is used that is by so much other than 1, and by so many of its errors
LEAST, CERTAIN = 0.02, 3.0
LIT_SIGMA, BELOW_FULL_SCALE = 4.0, 0.9  # readings that count: between so much noise and so much of full scale
RANGE = (0.3, 3.0)  # of exponents: others are none of a camera's


@dataclass
class Response:
    """What is known of the exponent."""

    exponent: float = 1.0  # that is used
    error: float = math.nan  # its standard error; nan: not measured

    @torch.no_grad()
    def decide(self, model: Gaussians, batches: Batches, sensor: Sensor) -> bool:
        """Take the exponent that the frames tell beside the model as it stands; return whether it is another one."""
        in_brackets = _in_brackets(batches.frames)
        pairs = in_brackets or _in_turns(batches.frames)
        indices = sorted({i for pair in pairs for i in (*pair.one, *pair.other)})
        found = each(lambda i: _told(model, batches.batch([i]), sensor), indices)
        told = dict(zip(indices, found, strict=True))
        if not in_brackets and _chosen(told.values()):
            return False
        found = [(pair.part, compared) for pair in pairs if (compared := _compared(pair, told))]
        parts = np.array([part for part, _ in found])
        steps = np.array([compared for _, compared in found]).reshape(-1, 2)
        if len(set(parts.tolist())) < LEFT_OUT:
            return False
        without = np.array([_slope(steps[parts != part]) for part in range(LEFT_OUT)])
        self.error = math.sqrt((LEFT_OUT - 1) * without.var())
        now, before = self.exponent + _slope(steps), self.exponent
        is_bent = abs(now - 1) > max(LEAST, CERTAIN * self.error) and RANGE[0] <= now <= RANGE[1]
        self.exponent = now if is_bent else 1.0
        if self.exponent != 1:
            log.info("%s", self)
        return self.exponent != before

    def __str__(self) -> str:
        if self.exponent == 1:
            return "readings are linear in light, as stated"
        return f"readings follow light to the power of {self.exponent:.3f} ± {self.error:.3f}"


class _Pair(NamedTuple):
    """Frames of one exposure time that are compared with those of another, by index, and in which part of the pass."""

    part: int
    one: list[int]
    other: list[int]


def _in_brackets(frames: list[TrainingFrame]) -> list[_Pair]:
    """Return some neighbours in brackets; none where there are too few."""
    numbers = bracket_numbers(frames)
    times_s = [frame.exposure_time_s for frame in frames]
    pairs = [
        i
        for i, (a, b) in enumerate(itertools.pairwise(numbers))
        if a == b and abs(math.log(times_s[i + 1] / times_s[i])) > LEAST_STEP
    ]
    if len(pairs) < FEWEST:
        return []
    chosen = np.linspace(0, len(pairs) - 1, min(len(pairs), MOST)).round().astype(int)
    return [_Pair(n * LEFT_OUT // len(chosen), [pairs[k]], [pairs[k] + 1]) for n, k in enumerate(chosen)]


def _in_turns(frames: list[TrainingFrame]) -> list[_Pair]:
    """Return what neighbouring settings saw in each part of the pass, of exposure times that come again and again."""
    chosen = np.linspace(0, len(frames) - 1, min(len(frames), MOST)).round().astype(int).tolist()
    parts = np.array_split(chosen, LEFT_OUT)
    times_s, counts = np.unique([frames[i].exposure_time_s for i in chosen], return_counts=True)
    settings = times_s[(2 * counts > counts.max()) & (counts >= LEFT_OUT)]
    pairs = []
    for (number, part), (one_s, other_s) in itertools.product(enumerate(parts), itertools.pairwise(settings)):
        one, other = ([i for i in part.tolist() if frames[i].exposure_time_s == s] for s in (one_s, other_s))
        if one and other and math.log(other_s / one_s) > LEAST_STEP:
            pairs.append(_Pair(number, one, other))
    return pairs


def _chosen(told: Iterable["_Told"]) -> bool:
    """Return whether exposure times go with the light that the model shows in their frames."""
    pairs = [(math.log(t.exposure_time_s), math.log(t.brightness)) for t in told if t.brightness > 0]
    times, lights = np.array(pairs).reshape(-1, 2).T
    varies = len(pairs) > 0 and times.std() > 0 and lights.std() > 0
    return bool(varies and abs(np.corrcoef(times, lights)[0, 1]) > MOST_CHOSEN)


@dataclass(frozen=True)
class _Told:
    """What the readings of a frame say beside the model: [K] values of pixels that are neither dark nor full."""

    exposure_time_s: float
    brightness: float  # mean radiance of the whole picture
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
    values = radiance[counts], light[counts], dn[counts] - sensor.black_dn
    return _Told(batch.exposure_time_s.item(), radiance.mean().item(), *values)


def _together(told: list[_Told]) -> _Told:
    """Return what frames of one exposure time say together."""
    values = [torch.cat([getattr(t, name) for t in told]) for name in ("radiance", "light", "read")]
    return _Told(told[0].exposure_time_s, sum(t.brightness for t in told) / len(told), *values)


def _compared(pair: _Pair, told: dict[int, _Told]) -> tuple[float, float] | None:
    """Return by how much ln of the exposure time, and of read over expected light, differ between frames.

    None where too few readings of either lie in the radiance that both can read.
    """
    one, other = (_together([told[i] for i in indices]) for indices in (pair.one, pair.other))
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
