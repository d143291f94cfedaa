"""The rows of a comparison brought together: means over seeds, by method, target and condition."""

import math
import statistics
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

from compare.errors import cannot_be_made, for_people
from compare.methods import reference_names

# losses against the frames as taken up to which a method holds, or is only shaken
HOLDS_DB, SHAKEN_DB = 1.0, 3.0
MARGIN_DB = 1.0  # above the best image without training: less is a failure; seeds scatter by about 0.3 dB


LEVELS_DB, LEVEL_F = (35, 38, 40), 60  # of clean PSNR, and of F within 0.02, %: how soon they are reached


@dataclass(frozen=True)
class Metric:
    """A column: the row's key, its title with unit, how it is written, and which way is better (None: neither)."""

    key: str
    title: str
    form: str
    more_is_better: bool | None

    def gain(self, value: float | None) -> str:
        """Return a gain in words: a difference of scores in their own unit, of errors the share that is saved."""
        if value is None:
            return ""
        if self.more_is_better is False:
            return f"{value:+.1f} %"
        if self.key.endswith("_db"):
            return f"{value:+.2f} dB"
        return f"{value:+.1f} points" if self.title.endswith("%") else f"{value:+.4f}"


METRICS = (
    Metric("psnr_clean_db", "clean PSNR, dB", "{:.2f}", True),
    Metric("psnr_clean_pooled_db", "pooled, dB", "{:.2f}", True),
    Metric("psnr_foreground_db", "foreground, dB", "{:.2f}", True),
    Metric("psnr_best_db", "best on the way, dB", "{:.2f}", True),
    Metric("psnr_mu_db", "mu-law, dB", "{:.2f}", True),
    Metric("psnr_noisy_db", "noisy, dB", "{:.2f}", True),
    Metric("psnr_srgb_db", "sRGB, dB", "{:.2f}", True),
    Metric("ssim_clean", "SSIM", "{:.4f}", True),
    Metric("lpips", "LPIPS", "{:.4f}", False),
    Metric("ssim_srgb", "SSIM, sRGB", "{:.4f}", True),
    Metric("lpips_srgb", "LPIPS, sRGB", "{:.4f}", False),
    *(
        Metric(f"{key}_{radius}_surface", f"{title} .{radius}, %", "{:.1f}", True)
        for radius in ("01", "02")
        for key, title in (("precision", "precision"), ("recall", "recall"), ("f", "F"))
    ),
    Metric("chamfer_surface", "Chamfer of the surface", "{:.4f}", False),
    Metric("chamfer", "Chamfer of centres", "{:.4f}", False),
    Metric("hausdorff", "Hausdorff of centres", "{:.3f}", False),
    Metric("completeness_centres", "centres complete, %", "{:.1f}", True),
    Metric("completeness_surface", "surface complete, %", "{:.1f}", True),
    Metric("completeness_shown_surface", "complete of what is shown, %", "{:.1f}", True),
    Metric("accuracy_surface", "accuracy", "{:.4f}", False),
    Metric("interval_90_clean", "90 % intervals hold, share", "{:.2f}", None),
    Metric("chi2_held_out_both", "chi² over noise and own error", "{:.2f}", None),
    Metric("gaussians", "Gaussians", "{:,.0f}", None),
    Metric("bytes", "kB", "{:,.0f}", None),
    *(Metric(f"seconds_to_{level}_db", f"s to {level} dB", "{:,.1f}", False) for level in LEVELS_DB),
    Metric("seconds_to_f60", "s to F .02 of 60 %", "{:,.1f}", False),
    Metric("cpu_seconds", "processor time, s", "{:,.1f}", None),
    Metric("seconds", "seconds", "{:,.1f}", None),
    Metric("energy_j", "energy, J", "{:,.0f}", None),
)
# of the paper's figure: gains of these, the first three of pictures, the others of geometry; where no truth is
# known, of noisy PSNR, which all sessions have
GAINS = ("psnr_clean_db", "ssim_clean", "lpips", "chamfer", "completeness_centres", "hausdorff")


CLEAN, NOISY = METRICS[0], next(metric for metric in METRICS if metric.key == "psnr_noisy_db")


def with_best(row: dict[str, Any]) -> dict[str, Any]:
    """Return a row with what its curve tells, where it has one.

    psnr_best_db: the highest clean PSNR, which the method would have reached if the truth had told it when to stop:
    those that come to fit the noise end below it. seconds_to_35_db and the like, seconds_to_f60: the processor time
    after which it first had a clean PSNR, or F within 0.02 of 60 %, without that of measuring; missing where never.
    """
    curve = row.get("curve") or []
    values = [point["psnr_clean_db"] for point in curve if "psnr_clean_db" in point]
    asked = {f"seconds_to_{level}_db": ("psnr_clean_db", level) for level in LEVELS_DB}
    asked["seconds_to_f60"] = "f_02_surface", LEVEL_F
    found = {name: seconds_to(curve, *what) for name, what in asked.items()}
    best = {"psnr_best_db": max(values)} if values else {}
    return row | best | {name: seconds for name, seconds in found.items() if seconds is not None}


def seconds_to(curve: Iterable[Mapping[str, float]], key: str, level: float) -> float | None:
    """Return the processor time after which a curve first reaches a level, between its points on a straight line.

    None where it never does, or where only the clock was read on the way.
    """
    before: tuple[float, float] | None = None
    for point in curve:
        if key not in point or "cpu_seconds" not in point:
            continue
        now = point["cpu_seconds"], point[key]
        if now[1] >= level:
            if before is None:
                return now[0]
            return before[0] + (now[0] - before[0]) * (level - before[1]) / (now[1] - before[1])
        before = now
    return None


class Results:
    """The rows of a comparison; those of one method with several budgets are told apart by their label.

    Where a condition, session or setting was changed under its old name, a folder holds several rows of one name and
    seed: the row that is asked for counts, otherwise the last, and `replaced` counts the others. A row that was made
    under other names is shown under those of today.

    Args:
        asked: session and condition of each cell of the grid that was asked for last, by its digest.
    """

    def __init__(
        self, rows: Iterable[dict[str, Any]], asked: Mapping[str, tuple[str, str]] = MappingProxyType({})
    ):
        named: dict[tuple, dict[str, Any]] = {}
        given = []
        for row in rows:
            target, condition = asked.get(row["digest"], (row["target"], row["condition"]))
            given.append(row | {"target": target, "condition": condition})
        for row in given:
            key = (row["method"], budget_of(row), row["target"], row["condition"], row["seed"])
            if key not in named or named[key]["digest"] not in asked:
                named[key] = row
        self.replaced = len(given) - len(named)
        self.rows = [with_best(row) for row in named.values()]
        budgets: dict[str, set[str]] = {}
        for row in self.rows:
            budgets.setdefault(row["method"], set()).add(budget_of(row))
        self._cells: dict[tuple[str, str, str], list[dict[str, Any]]] = {}
        self.labels: list[str] = []
        self.method_of: dict[str, str] = {}
        self._several = {method for method, of_method in budgets.items() if len(of_method) > 1}
        for row in self.rows:
            method, label = row["method"], self.label_of(row)
            self.method_of[label] = method
            self._cells.setdefault((label, row["target"], row["condition"]), []).append(row)
        order = reference_names()
        self.labels = sorted(
            self.method_of,
            key=lambda label: order.index(m) if (m := self.method_of[label]) in order else len(order),
        )
        self.targets = list(dict.fromkeys(row["target"] for row in self.rows))
        self.conditions = list(dict.fromkeys(row["condition"] for row in self.rows))
        plain = [row["condition"] for row in self.rows if "changes" not in row]
        self.base = (
            plain[0] if plain else next(iter(self.conditions), "")
        )  # what conditions are compared with
        self.conditions.sort(key=lambda condition: condition != self.base)
        self.truth = any("psnr_clean_db" in row for row in self.rows)

    def label_of(self, row: dict[str, Any]) -> str:
        """Return what a row's method is called: with its budget, where the method was run with several."""
        method = row["method"]
        return f"{method} ({budget_of(row)})" if method in self._several else method

    @property
    def score(self) -> Metric:
        """What methods are ranked by over all targets: clean PSNR where the truth of most is known, noisy elsewhere."""
        scores = [self.score_of(target) for target in self.targets]
        return max((CLEAN, NOISY), key=scores.count)

    def score_of(self, target: str) -> Metric:
        """Return what methods are ranked by on one target: clean PSNR, or noisy where its truth is not known."""
        is_known = any(row.get(CLEAN.key) is not None for row in self.rows if row["target"] == target)
        return CLEAN if is_known else NOISY

    def known(self, target: str | None = None) -> list[Metric]:
        """Return the columns that any row has a value of, as they were taken: of one target, or of all."""
        rows = [row for row in self.rows if target in (None, row["target"]) and row["condition"] == self.base]
        return [metric for metric in METRICS if any(row.get(metric.key) is not None for row in rows)]

    @property
    def trained(self) -> list[str]:
        """The labels of methods that reconstruct something."""
        return [label for label in self.labels if self.method_of[label] not in reference_names()]

    def of(self, label: str, target: str, condition: str) -> list[dict[str, Any]]:
        """Return the rows of a cell of the table, one a seed."""
        return self._cells.get((label, target, condition), [])

    def tried(self, label: str, target: str, condition: str) -> list[dict[str, Any]]:
        """Return the rows of a cell whose condition could be made of its session, so that the method was tried."""
        return [row for row in self.of(label, target, condition) if not cannot_be_made(row)]

    def was_run(self, label: str, condition: str) -> bool:
        """Tell whether a method was run under a condition on any target."""
        return any(self.of(label, target, condition) for target in self.targets)

    @property
    def trained_conditions(self) -> list[str]:
        """The conditions under which any training was run."""
        return [c for c in self.conditions if any(self.was_run(label, c) for label in self.trained)]

    def run_on(self, target: str) -> list[str]:
        """Return the methods that were run on a target as it was taken."""
        return [label for label in self.labels if self.of(label, target, self.base)]

    def runs(self, label: str) -> int:
        """Return the number of targets on which a method was run as they were taken."""
        return sum(bool(self.of(label, target, self.base)) for target in self.targets)

    def unjudged(self, label: str, condition: str) -> str:
        """Return in words why a method has no verdict under a condition: it was not run, or made no pictures."""
        return "no score" if self.was_run(label, condition) else NOT_RUN

    def mean(self, label: str, target: str, condition: str, key: str) -> float | None:
        """Return the mean over seeds; None where nothing was measured."""
        values = [row[key] for row in self.of(label, target, condition) if row.get(key) is not None]
        return statistics.fmean(values) if values else None

    def over_targets(self, label: str, condition: str, key: str) -> tuple[float | None, int]:
        """Return the mean over targets of the means over seeds, and of how many targets it is."""
        means = [self.mean(label, target, condition, key) for target in self.targets]
        known = [value for value in means if value is not None]
        return (statistics.fmean(known) if known else None), len(known)

    def spread(self, label: str, target: str, condition: str, key: str) -> float | None:
        """Return the deviation over seeds; None of fewer than two."""
        values = [row[key] for row in self.of(label, target, condition) if row.get(key) is not None]
        return statistics.stdev(values) if len(values) > 1 else None

    def error(self, label: str, target: str, condition: str) -> str | None:
        """Return in words why a cell has no result; None where it has one or was not asked for."""
        return next(
            (
                for_people(str(row.get("error") or row.get("failed")))
                for row in self.of(label, target, condition)
                if row.get("error") or row.get("failed")
            ),
            None,
        )

    def verdict(self, label: str, condition: str) -> tuple[str, str]:
        """Return how a method stands a condition, in one of `VERDICTS`, and its figures in words; over all targets.

        The worst target decides.
        """
        found = [verdict for t in self.targets if (verdict := self._verdict(label, t, condition)) is not None]
        return max(found, key=lambda verdict: VERDICTS.index(verdict[0])) if found else ("", "")

    def _verdict(self, label: str, target: str, condition: str) -> tuple[str, str] | None:
        if (reason := self.error(label, target, condition)) is not None:
            return "refused", f"{target}: {reason}"
        key = self.score_of(target).key
        value = self.mean(label, target, condition, key)
        if value is None:
            return None
        floor = self.floor(target, condition)
        usual = self.mean(label, target, self.base, key)
        words = f"{target}: {value:.2f} dB"
        if usual is not None and condition != self.base:
            words += f", {value - usual:+.2f} dB against {self.base}"
        if floor is not None:
            words += f", {value - floor:+.2f} dB against the best image without training"
        if not math.isfinite(value) or (floor is not None and value < floor + MARGIN_DB):
            return "fails", words
        if floor is None:
            return UNJUDGED, f"{words}; no image without training was scored"
        if usual is None:
            return UNJUDGED, f"{words}; it was not trained {self.base}"
        loss = usual - value
        return ("holds" if loss <= HOLDS_DB else "shaken" if loss <= SHAKEN_DB else "suffers"), words

    def floor(self, target: str, condition: str) -> float | None:
        """Return the score of the best of black, mean and untrained on a target; None where none is there."""
        return self._best_of(("black", "mean", "untrained"), target, condition)

    def nothing(self, target: str, condition: str) -> float | None:
        """Return the score of the better one of a black image and the mean image; None where neither is there."""
        return self._best_of(("black", "mean"), target, condition)

    def _best_of(self, methods: tuple[str, ...], target: str, condition: str) -> float | None:
        """Return the best score of some methods, under a condition or else as taken; None where none is there."""
        found = []
        for label in self.labels:
            if self.method_of[label] in methods:
                key = self.score_of(target).key
                value = self.mean(label, target, condition, key)
                found.append(self.mean(label, target, self.base, key) if value is None else value)
        return max((value for value in found if value is not None), default=None)

    def clock(self, target: str, keys: Iterable[str]) -> tuple[str, str]:
        """Return the key of a training's time that is drawn against its scores, and the name of its axis.

        That is the processor's time where all trainings of a target have it, on the way too: other work may have shared
        the machine. Elsewhere it is the clock's.
        """
        keys = set(keys)
        rows = [row for label in self.trained for row in self.of(label, target, self.base)]
        timed = [row for row in rows if row.get("seconds") and keys & row.keys()]
        points = [point for row in rows for point in row.get("curve", []) if keys & point.keys()]
        if (timed or points) and all("cpu_seconds" in each for each in (*timed, *points)):
            return "cpu_seconds", "processor time of training, s"
        return "seconds", "time of training by the clock, s"

    def gain(self, label: str, base: str, target: str, key: str) -> float | None:
        """Return by how much a method is better than a base method on a target, negative where it is worse.

        Of scores it is the difference, since a share of decibels says nothing; of errors the per cent that are saved.
        """
        ours, theirs = (self.mean(name, target, self.base, key) for name in (label, base))
        if ours is None or theirs is None:
            return None
        if next(metric.more_is_better for metric in METRICS if metric.key == key):
            return ours - theirs
        return 100 * (theirs - ours) / theirs if theirs else None

    def gains(self, label: str, base: str) -> list[tuple[Metric, list[float | None]]]:
        """Return a method's gains over another, target by target, of the metrics of which any is known."""
        is_known = all(self.score_of(target) is CLEAN for target in self.targets)
        names = GAINS if is_known else (NOISY.key, *GAINS)
        found = []
        for metric in sorted((m for m in METRICS if m.key in names), key=lambda m: names.index(m.key)):
            values = [self.gain(label, base, target, metric.key) for target in self.targets]
            if any(value is not None for value in values):
                found.append((metric, values))
        return found

    @property
    def gain_base(self) -> str | None:
        """The method that others are compared with in gains: 3DGS where it is there, else the first."""
        published = [label for label in self.trained if self.method_of[label] == "3dgs"]
        return next(iter([*published, *self.trained]), None)


UNJUDGED, NOT_RUN = "not judged", "not run"
VERDICTS = ("holds", "shaken", "suffers", UNJUDGED, "fails", "refused")  # the worse, the later


def pareto(points: list[tuple[float, float]]) -> list[tuple[float, float]]:
    """Return the points (cost, score) that no other beats in both, by rising cost."""
    front: list[tuple[float, float]] = []
    for cost, score in sorted(points, key=lambda point: (point[0], -point[1])):
        if not front or score > front[-1][1]:
            front.append((cost, score))
    return front


def budget_of(row: dict[str, Any]) -> str:
    """Return in words what a training of a row might use."""
    most = f"at most {row['largest']:,} Gaussians" if "largest" in row else ""
    if row["steps_share"] == 1:
        return most or "all steps"
    share = f"{100 * row['steps_share']:g} % of the steps"
    return f"{share} and {most}" if most else share
