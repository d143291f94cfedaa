"""What a camera does otherwise than stated, learnt beside the model: its response's exponent, its exposure times.

The model is one for all exposure times. If the readings of long exposures are too bright for it and those of short
ones too dark, by a ratio that is a power of the exposure time, then readings are that power of light. Compared are
neighbours in a bracket, or, where every view has one exposure, frames of neighbouring settings that see the target from
nearly the same direction: from another, glare differs by more than what is looked for. Of what they say the median
counts. An exposure time that an automatic camera chose by what it saw says what it saw, and tells nothing. Readings
count in the radiance that both can read, so that a model which is too dark where it is bright is no evidence either.

Ratios that follow no power are those of exposure times which are not as stated, each by a factor; the median is taken
as stated, since what all share is the unit of light. A ratio that grows along the pass, alike in the frames of every
exposure time, is a drift, unless the directions of the views say when they were taken: light that grows with the Sun's
phase does the same on a pass that goes round its target once. Where each frame has an error of its own
(`frame_errors`), that takes the place of all these.

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
from obbgs_core.evidence.exposures import frame_errors, jackknifed
from obbgs_core.frames import TrainingFrame, bracket_numbers, cameras_of
from obbgs_core.misfit import sampled
from obbgs_core.model.gaussians import Gaussians
from obbgs_core.render import render
from obbgs_core.sensor import Sensor

log = logging.getLogger(__name__)
DECIDED_AT = (0.3, 0.5, 0.7)  # shares of the steps
# errors of single frames are told from then on: before, the model itself errs from frame to frame
FRAMES_FROM = 0.5
FOLLOWED_AT = (0.6, 0.8, 0.9)  # and where they are used
LEAST_STEP = 0.1  # of the logarithms of exposure times that are compared
FEWEST_READINGS = 30
MOST = 60  # pairs of neighbours in a bracket that are rendered
FEWEST = 24  # pairs of neighbours in brackets; of each setting, where views have one exposure, one a part
LEFT_OUT = 10  # parts of the pass or, where views have one exposure, of all directions, each left out once (jackknife)
MOST_OF_PART = 5  # pairs of nearly the same direction
FEWEST_PARTS = 7  # that tell something
# of ln of exposure times and ln of the light that the model shows in the frames: more, and the camera chose them by it
MOST_CHOSEN = 0.5
# what is by so much other than stated is used, and by so many of its errors
LEAST, CERTAIN = 0.02, 3.0
# a model itself errs along a pass by up to half of it (the demo: 0.027 with an error of 0.008)
LEAST_DRIFT = 0.05
# share of the variance of the frames' places in the pass that their views' directions explain: more, and there is no
# telling a drift from light that turns with the view (0.7 to 1.0 on passes of the simulator, 0 on views at random)
MOST_EXPLAINED = 0.5
LIT_SIGMA, BELOW_FULL_SCALE = 4.0, 0.9  # readings that count: between so much noise and so much of full scale
MOST_WRONG = 0.5  # of ln(true / stated exposure time)
RANGE = (0.3, 3.0)  # of exponents: others are none of a camera's


@dataclass
class Response:
    """What is known of the exponent, and of exposure times that are not as stated."""

    exponent: float = 1.0  # that is used
    error: float = math.nan  # its standard error; nan: not measured
    settings: dict[float, float] | None = None  # ln(true / stated) of stated exposure times; None: as stated
    drift: float = 0.0  # of ln(true / stated) from the first frame to the last
    # ln(true / stated), by id; None: frames have no errors of their own
    frames: dict[int, float] | None = None

    @property
    def is_as_stated(self) -> bool:
        """Whether readings are linear in light and exposure times right, as far as it is known."""
        return self.exponent == 1 and self.settings is None and self.drift == 0 and self.frames is None

    @property
    def decided_at(self) -> tuple[float, ...]:
        """The shares of the steps after which it is decided."""
        return DECIDED_AT if self.frames is None else DECIDED_AT + FOLLOWED_AT

    @torch.no_grad()
    def decide(self, model: Gaussians, batches: Batches, sensor: Sensor, share: float = 1.0) -> bool:
        """Take what the frames tell beside the model as it stands; return whether it is something else.

        Args:
            share: of the steps that are done.
        """
        used = np.log(self.gains(batches.frames) or np.ones(len(batches.frames)))
        errors = frame_errors(model, batches, sensor, used) if share >= FRAMES_FROM else None
        if errors is not None:
            self.exponent, self.settings, self.drift = 1.0, None, 0.0
            self.frames = {f.id: own for f, own in zip(batches.frames, errors.tolist(), strict=True)}
            log.info("%s", self)
            return True
        if (
            self.frames is not None
        ):  # what else there may be is decided beside a model that was trained without them
            self.frames = None
            return True
        in_brackets = _in_brackets(batches.frames)
        pairs = in_brackets or _in_turns(batches.frames)
        indices = sorted({i for pair in pairs for i in (pair.one, pair.other)})
        frames = batches.frames
        found = each(lambda i: _told(model, batches.batch([i]), sensor, frames[i].exposure_time_s), indices)
        told = dict(zip(indices, found, strict=True))
        if not in_brackets and _chosen(told.values()):
            return False
        contrasts = _Contrasts.of([c for pair in pairs if (c := _compared(pair, told)) is not None])
        if len(set(contrasts.parts.tolist())) < FEWEST_PARTS:
            return False
        before = self.exponent, self.settings, self.drift
        stated = {
            s: (self.exponent - 1) * math.log(s) + (self.settings or {}).get(s, 0.0)
            for s in contrasts.times_s
        }
        contrasts.values += contrasts.design @ np.array(list(stated.values()))
        bend, error = map(float, jackknifed(contrasts.slope, contrasts.parts))
        uneven, errors = jackknifed(contrasts.uneven, contrasts.parts)
        of_settings = contrasts.settings(np.full(len(contrasts.parts), True))
        self.error = error
        is_uneven = (np.abs(uneven) > np.maximum(LEAST, CERTAIN * errors)).any()
        if is_uneven and np.abs(of_settings).max() <= MOST_WRONG:
            self.exponent = 1.0
            self.settings = dict(zip(contrasts.times_s, of_settings.tolist(), strict=True))
        else:
            is_bent = abs(bend) > max(LEAST, CERTAIN * error) and RANGE[0] <= 1 + bend <= RANGE[1]
            self.exponent, self.settings = 1 + bend if is_bent else 1.0, None
        self.drift = 0.0 if _explained(frames) > MOST_EXPLAINED else self._drift(told, len(frames))
        if (self.exponent, self.settings, self.drift) == before:
            return False
        log.info("%s", self)
        return True

    def _drift(self, told: dict[int, "_Told"], count: int) -> float:
        """Return the drift that the frames tell."""
        groups: dict[tuple[int, float], list[_Told]] = {}
        for i, t in told.items():
            groups.setdefault((i * LEFT_OUT // count, t.exposure_time_s), []).append(t)
        levels = {key: _together(group).log_ratio(0.0, math.inf) for key, group in groups.items()}
        known = [(part, s, level) for (part, s), level in levels.items() if level is not None]
        parts, times_s, level = np.array(known).reshape(-1, 3).T
        for s in set(times_s.tolist()):  # what a setting does to all of its frames is no drift
            level[times_s == s] -= level[times_s == s].mean()
        if len(set(parts.tolist())) < FEWEST_PARTS:
            return 0.0
        slope, error = jackknifed(lambda kept: np.polyfit(parts[kept], level[kept], 1)[0] * LEFT_OUT, parts)
        now = self.drift + float(slope)
        return now if max(LEAST_DRIFT, CERTAIN * error) < abs(now) <= MOST_WRONG else 0.0

    def gains(self, frames: list[TrainingFrame]) -> list[float] | None:
        """Return the true exposure time of each frame over the stated one; None where all are as stated."""
        if self.frames is not None:  # frames that joined since are as stated
            return [math.exp(self.frames.get(frame.id, 0.0)) for frame in frames]
        if self.settings is None and self.drift == 0:
            return None
        middle, settings = (len(frames) - 1) / 2, self.settings or {}
        drifts = [self.drift * (i - middle) / max(2 * middle, 1) for i in range(len(frames))]
        return [
            math.exp(d + settings.get(f.exposure_time_s, 0.0)) for f, d in zip(frames, drifts, strict=True)
        ]

    def __str__(self) -> str:
        said = []
        if self.exponent != 1:
            said.append(f"readings follow light to the power of {self.exponent:.3f} ± {self.error:.3f}")
        if self.settings:
            each = ", ".join(
                f"{1e3 * s:g} ms is {1e3 * s * math.exp(g):.4g} ms" for s, g in self.settings.items()
            )
            said.append(f"exposure times are not as stated: {each}")
        if self.drift:
            said.append(
                f"exposure times drift by {math.expm1(self.drift):+.1%} from the first frame to the last"
            )
        if self.frames:
            said.append(
                f"exposure times err by {np.std(list(self.frames.values())):.1%} from frame to frame; each is estimated"
            )
        return "; ".join(said) or "readings are linear in light and exposure times right, as stated"


@dataclass
class _Contrasts:
    """By how much ln of read over expected light differs between frames of two exposure times, N times."""

    times_s: list[float]  # S exposure times
    design: np.ndarray  # [N, S] -1 at the one, 1 at the other
    values: np.ndarray  # [N]
    parts: np.ndarray  # [N] of the pass

    @staticmethod
    def of(found: list[tuple[int, float, float, float]]) -> "_Contrasts":
        """Return the contrasts of parts, exposure times of the one and of the other, and values."""
        times_s = sorted({s for _, one_s, other_s, _ in found for s in (one_s, other_s)})
        design = np.array(
            [[float(s == other) - float(s == one) for s in times_s] for _, one, other, _ in found]
        ).reshape(len(found), len(times_s))
        return _Contrasts(times_s, design, np.array([f[3] for f in found]), np.array([f[0] for f in found]))

    def slope(self, kept: np.ndarray) -> np.ndarray:
        """Return the median of the slopes over ln of exposure times of some contrasts."""
        steps = (self.design @ np.log(self.times_s))[kept]
        return np.array(np.median(self.values[kept] / steps))

    def settings(self, kept: np.ndarray) -> np.ndarray:
        """Return one value for each exposure time [S] that fits some contrasts best, with a median of 0."""
        values = np.linalg.lstsq(self.design[kept], self.values[kept], rcond=None)[0]
        return values - np.median(values)

    def uneven(self, kept: np.ndarray) -> np.ndarray:
        """Return what of `settings` no slope explains."""
        logs = np.log(self.times_s)
        values = self.settings(kept) - self.slope(kept) * logs
        return values - np.median(values)


class _Pair(NamedTuple):
    """A frame of one exposure time that is compared with one of another, by index, and in which part they are."""

    part: int
    one: int
    other: int


def _directions(frames: list[TrainingFrame]) -> np.ndarray:
    """Return the directions [N, 3], unit, from which frames see the target."""
    return torch.nn.functional.normalize(cameras_of(frames).centres.double(), dim=1).numpy()


def _explained(frames: list[TrainingFrame]) -> float:
    """Return the adjusted R² of frames' places in the pass by the directions from which they see the target."""
    directions = _directions(frames)
    design, along = np.column_stack([directions, np.ones(len(frames))]), np.arange(len(frames))
    fitted = design @ np.linalg.lstsq(design, along)[0]
    unexplained = np.sum((along - fitted) ** 2) / np.sum((along - along.mean()) ** 2)
    return 1 - unexplained * (len(frames) - 1) / max(1, len(frames) - design.shape[1])


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
    return [_Pair(n * LEFT_OUT // len(chosen), pairs[k], pairs[k] + 1) for n, k in enumerate(chosen)]


def _in_turns(frames: list[TrainingFrame]) -> list[_Pair]:
    """Return frames of neighbouring settings in pairs that see the target from nearly the same direction."""
    exposures_s = np.array([frame.exposure_time_s for frame in frames])
    times_s, counts = np.unique(exposures_s, return_counts=True)
    settings = times_s[(2 * counts > counts.max()) & (counts >= LEFT_OUT)]
    directions = _directions(frames)
    cosines = directions @ directions.T
    middles = [0]  # of parts: each is as far from those before it as any frame
    while len(middles) < LEFT_OUT:
        middles.append(int(cosines[:, middles].max(axis=1).argmin()))
    part = cosines[:, middles].argmax(axis=1)
    candidates = [
        (-cosines[i, j], i, j)
        for one_s, other_s in itertools.pairwise(settings)
        if math.log(other_s / one_s) > LEAST_STEP
        for i in np.flatnonzero(exposures_s == one_s)
        for j in np.flatnonzero(exposures_s == other_s)
    ]
    uses, of_part = np.zeros(len(frames), dtype=int), np.zeros(LEFT_OUT, dtype=int)
    pairs = []
    for _, i, j in sorted(candidates):
        if max(uses[i], uses[j]) < 2 and of_part[part[i]] < MOST_OF_PART:
            uses[[i, j]] += 1
            of_part[part[i]] += 1
            pairs.append(_Pair(int(part[i]), int(i), int(j)))
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


def _told(model: Gaussians, batch: Batch, sensor: Sensor, exposure_time_s: float) -> _Told:
    radiance, dn = sampled(sensor, render(model, batch.cameras).radiance, batch.dn)
    prediction = sensor.predicted(radiance, batch.exposure_time_s)
    light, variance = prediction.expected_dn - sensor.black_dn, prediction.variance_dn2
    counts = light > LIT_SIGMA * variance.sqrt()
    counts &= light < BELOW_FULL_SCALE * (sensor.white_dn - sensor.black_dn)
    values = radiance[counts], light[counts], dn[counts] - sensor.black_dn
    return _Told(exposure_time_s, radiance.mean().item(), *values)


def _together(told: list[_Told]) -> _Told:
    """Return what frames of one exposure time say together."""
    values = [torch.cat([getattr(t, name) for t in told]) for name in ("radiance", "light", "read")]
    return _Told(told[0].exposure_time_s, sum(t.brightness for t in told) / len(told), *values)


def _compared(pair: _Pair, told: dict[int, _Told]) -> tuple[int, float, float, float] | None:
    """Return the part of a pair, its two exposure times, and by how much ln of read over expected light differs.

    None where too few readings of either lie in the radiance that both can read.
    """
    one, other = told[pair.one], told[pair.other]
    if not one.radiance.numel() or not other.radiance.numel():
        return None
    least = max(float(one.radiance.min()), float(other.radiance.min()))
    most = min(float(one.radiance.max()), float(other.radiance.max()))
    before, after = one.log_ratio(least, most), other.log_ratio(least, most)
    if before is None or after is None:
        return None
    return pair.part, one.exposure_time_s, other.exposure_time_s, after - before
