"""Conditions of one kind in the order of their severity: how methods lose, and where each of them breaks."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

from compare.charts.results import Results

LEAST_F_PERCENT = 50.0  # of the surface within 0.02: a model with less shows another body
F = "f_02_surface"


@dataclass(frozen=True)
class Kind:
    """A kind of condition, which has one number.

    key: of the condition. title: with unit.
    usual: the number of frames as they were taken; infinity where they have more than any condition leaves.
    severe: which numbers are worse than the usual one.
    """

    key: str
    title: str
    usual: float
    severe: Literal["more", "less", "both"] = "more"


KINDS = (
    Kind("frames", "training frames", math.inf, "less"),
    Kind("lost_percent", "frames lost at random, %", 0.0),
    Kind("noise", "noise, times that of the camera", 1.0),
    Kind("pedestal", "pedestal, share of full scale", 0.0),
    Kind("stray_gradient", "stray light up to, share of full scale", 0.0),
    Kind("earth", "frames with the Earth, share", 0.0),
    Kind("blur_px", "motion during the exposure, px", 0.0),
    Kind("pose_error_deg", "pose errors, degrees", 0.0),
    Kind("exposure_error", "errors of exposure times, share", 0.0),
    Kind("exposure_ratios", "each exposure over the one before", 1.0),
    Kind("jpeg", "JPEG quality", math.inf, "less"),
    Kind("response_gamma", "exponent of the response", 1.0, "both"),
    Kind("hot_pixels", "hot pixels, share", 0.0),
    Kind("believed_noise", "noise that is believed, times the true one", 1.0, "both"),
    Kind("believed_gain", "gain that is believed, times the true one", 1.0, "both"),
)


@dataclass(frozen=True)
class Series:
    """The conditions of one kind, by their numbers, the smallest first.

    That of the frames as they were taken is among them, unless a condition of this kind is the same.
    """

    kind: Kind
    conditions: tuple[tuple[float, str], ...]

    def label(self, value: float) -> str:
        """Return how a condition's number is written."""
        return "as taken" if math.isinf(value) else f"{value:g}"

    def outwards(self) -> list[list[tuple[float, str]]]:
        """Return the conditions from the usual one to the most severe, on each side on which there are severe ones."""
        less = [(value, name) for value, name in self.conditions if value <= self.kind.usual][::-1]
        more = [(value, name) for value, name in self.conditions if value >= self.kind.usual]
        sides = {"less": [less], "more": [more], "both": [less, more]}[self.kind.severe]
        return [side for side in sides if any(value != self.kind.usual for value, _ in side)]


@dataclass(frozen=True)
class Breaking:
    """How far a method holds.

    broken_at: the mildest numbers at which it is broken, below and above the usual one; none where it never is.
    held: the most severe numbers that it was tried at, on each side on which it never breaks.
    why: in words, of each number in broken_at.
    is_judged: False where no image without a model was scored, so that nothing tells that it holds.
    """

    broken_at: tuple[float, ...]
    held: tuple[float, ...]
    why: tuple[str, ...]
    is_judged: bool = True


def series_of(results: Results) -> list[Series]:
    """Return the conditions that change one number, by kind; kinds of which there is none are left out."""
    changes: dict[str, Mapping[str, Any]] = {
        row["condition"]: row["changes"] for row in results.rows if "changes" in row
    }
    found = []
    for kind in KINDS:
        of_kind = [
            (_number(change[kind.key]), name) for name, change in changes.items() if set(change) == {kind.key}
        ]
        if not of_kind:
            continue
        if kind.usual not in {value for value, _ in of_kind}:
            of_kind.append((kind.usual, results.base))
        found.append(Series(kind, tuple(sorted(of_kind))))
    return found


def breaking_points(results: Results) -> list[tuple[Series, dict[str, Breaking]]]:
    """Return where methods break, by label, under each kind of condition that any was tried under in earnest."""
    found = [
        (series, {label: point for label in results.trained if (point := breaking(results, label, series))})
        for series in series_of(results)
    ]
    return [
        (series, points)
        for series, points in found
        if any(point.broken_at or point.held or not point.is_judged for point in points.values())
    ]


def breaking(results: Results, label: str, series: Series) -> Breaking | None:
    """Return where a method breaks on any target; None where it was not tried under conditions of this kind.

    It is broken where it ends in an error, where its score is below the better one of a black image and the mean image,
    and where F of the surface within 0.02 is below one half.
    """
    conditions = {name for _, name in series.conditions if name != results.base}
    if not any(results.tried(label, target, name) for target in results.targets for name in conditions):
        return None
    broken, held, why, is_judged = [], [], [], True
    for side in series.outwards():
        tried, unjudged = None, False
        for value, condition in side:
            rows = [row for target in results.targets for row in results.tried(label, target, condition)]
            if not rows:
                continue
            reason = next((r for t in results.targets if (r := _broken(results, label, t, condition))), None)
            if reason is not None:
                broken.append(value)
                why.append(reason)
                break
            if all(_is_judged(results, label, target, condition) for target in results.targets):
                tried = value
            elif value != series.kind.usual:
                unjudged = True
        else:
            if tried is not None and tried != series.kind.usual:
                held.append(tried)
            elif unjudged:
                is_judged = False
    return Breaking(tuple(broken), tuple(held), tuple(why), is_judged)


def _broken(results: Results, label: str, target: str, condition: str) -> str | None:
    """Return in words why a method is broken on a target under a condition; None where it is not, or was not tried."""
    if not results.tried(label, target, condition):
        return None
    if (error := results.error(label, target, condition)) is not None:
        return f"{target}: {error}"
    key = results.score_of(target).key
    value, floor = results.mean(label, target, condition, key), results.nothing(target, condition)
    if value is not None and floor is not None and not value >= floor:
        return f"{target}: {value:.2f} dB, and {floor:.2f} dB without any model"
    share = results.mean(label, target, condition, F)
    if share is not None and share < LEAST_F_PERCENT:
        return f"{target}: F within .02 is {share:.1f} %"
    return None


def _is_judged(results: Results, label: str, target: str, condition: str) -> bool:
    """Tell whether it is known what a target comes to without a model; True where the method was not tried on it."""
    return not results.tried(label, target, condition) or results.nothing(target, condition) is not None


def _number(value: float | list[float]) -> float:
    """Return the number of a condition; of exposure times the ratio of neighbours."""
    if isinstance(value, list):
        return round((value[-1] / value[0]) ** (1 / max(1, len(value) - 1)), 3)
    return float(value)
