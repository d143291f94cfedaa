"""Follows one piece of work: its curve of held-out scores, its time and energy, how far it is, and whether to stop."""

import json
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from compare.case import Case
from compare.energy import EnergyMeter
from compare.opponents.reconstruction import Reconstruction
from obbgs_base.files import write_whole
from obbgs_core.frames import TrainingFrame, cameras_of
from obbgs_core.score.metrics import psnr_db, surface_scores

MARKS = (0.02, *(i / 20 for i in range(1, 20)))  # shares of the work at which the curve is measured
FEW_MARKS = (0.02, 0.05, 0.1, 0.2, 0.35, 0.5, 0.7)  # of methods whose images take long
SURFACE_MARKS = (0.1, 0.3, 0.6)  # of surfaces, which take seconds
CURVE_VIEWS = 16  # held-out frames, evenly spaced; final scores use all
SETTLED_DB, SETTLED_OVER = (
    0.05,
    0.2,
)  # a curve has settled if it moved by less over this share of what is done
LOOK_EVERY_S = 1.0  # for a wish to stop
TELL_EVERY_S = 2.0  # how far the work is
CURVE, PROGRESS = "curve.json", "progress.json"


class Follower:
    """Measures work on its way; what it measured is kept in a folder, so that an interrupted work's curve goes on.

    Args:
        folder: of the work's own files.
        stop: a file; when it appears, the work should save itself and end.
        marks: shares of the work at which it is measured; surface_marks: those at which its surface is, too.
    """

    def __init__(
        self,
        case: Case,
        folder: Path,
        stop: Path,
        marks: tuple[float, ...] = MARKS,
        surface_marks: tuple[float, ...] = SURFACE_MARKS,
    ):
        self.points: list[dict[str, float]] = []  # share, seconds, PSNR, Chamfer distance, and F of surfaces
        self._folder, self._stop = folder, stop
        self._marks, self._surface_marks = marks, surface_marks
        self._psnr = "psnr_clean_db" if case.radiance else "psnr_noisy_db"
        count = len(case.held_out)
        self._case = case.of_views(
            sorted({round(i * (count - 1) / max(1, CURVE_VIEWS - 1)) for i in range(CURVE_VIEWS)})
        )
        self._looked_s = self._told_s = -1e9
        self._share, self._meter, self._joules_before = 0.0, EnergyMeter(), 0.0
        self._told = _read(folder / PROGRESS) or {}
        self.cpu_seconds = 0.0
        self._worked_s = time.process_time()
        kept = _read(folder / CURVE)
        if kept is not None:
            self.points, self._joules_before = kept["points"], kept["joules"]

    def on_step(self, share: float, seconds: float, snapshot: Callable[[bool], Reconstruction]) -> None:
        """Note that a share of the work is done, and measure the reconstruction as it stands where that is due.

        `cpu_seconds` is the processor time of the work until now, over all its interrupted parts, without measuring.
        """
        self.cpu_seconds += time.process_time() - self._worked_s
        if self._share == 0.0:
            self._resume_costs(seconds)
        if share < self._share or self._share == 0.0:  # the work began, or went on, behind what was measured
            self.points = [point for point in self.points if point["share"] <= share]
        self._share = share
        measured = self.points[-1]["share"] if self.points else 0.0
        if share < 1 and any(measured < mark <= share for mark in self._marks):
            with_surface = any(measured < mark <= share for mark in self._surface_marks)
            self._add(share, seconds, snapshot(with_surface))
        now_s = time.monotonic()
        if now_s - self._told_s > TELL_EVERY_S:
            self._told_s = now_s
            self._meter.sample()
            self._tell(seconds)
        self._worked_s = time.process_time()

    def finish(self, reconstruction: Reconstruction) -> list[dict[str, float]]:
        """Return the curve with the finished reconstruction as its last point; [] of work that was never followed."""
        if self._share:
            self._tell(reconstruction.seconds)
            self._add(self._share, reconstruction.seconds, reconstruction)
        else:  # it was complete already
            self._resume_costs(reconstruction.seconds)
        return self.points

    def should_stop(self) -> bool:
        """Return whether the command that wants this work has asked it to stop; looks once a second."""
        now_s = time.monotonic()
        if now_s - self._looked_s < LOOK_EVERY_S:
            return False
        self._looked_s = now_s
        if self._stop.exists():
            self._keep()
            return True
        return False

    def settled(self) -> bool:
        """Return whether the curve moved by less than 0.05 dB over the last fifth of what is done."""
        if not self.points:
            return False
        last = self.points[-1]["share"]
        before = [point for point in self.points if point["share"] <= (1 - SETTLED_OVER) * last]
        window = self.points[len(before) - 1 if before else 0 :]
        values = [point[self._psnr] for point in window if self._psnr in point]
        return len(before) > 0 and len(values) > 2 and max(values) - min(values) < SETTLED_DB

    @property
    def joules(self) -> float | None:
        """The energy that the processor packages took meanwhile, over all interrupted parts; None where unknown."""
        taken = self._meter.sample()
        return None if taken is None else self._joules_before + taken

    def _resume_costs(self, seconds: float) -> None:
        """Take over what the parts before cost, as far as the work goes on from them: none of it if it began anew."""
        told_s = self._told.get("seconds", 0.0)
        kept = min(1.0, seconds / told_s) if told_s else 0.0
        self.cpu_seconds += kept * self._told.get("cpu_seconds", 0.0)
        self._joules_before *= kept

    def _add(self, share: float, seconds: float, reconstruction: Reconstruction) -> None:
        spent = {"seconds": round(seconds, 2), "cpu_seconds": round(self.cpu_seconds, 2)}
        point = {"share": round(share, 5)} | spent | self._measured(reconstruction)
        self.points = [earlier for earlier in self.points if earlier["share"] < point["share"]] + [point]
        self._keep()

    def _tell(self, seconds: float) -> None:
        told = {"share": self._share, "seconds": seconds, "cpu_seconds": self.cpu_seconds, "pid": os.getpid()}
        (self._folder / PROGRESS).write_text(json.dumps(told))

    def _measured(self, reconstruction: Reconstruction) -> dict[str, float]:
        figures: dict[str, float] = {}
        case, _ = self._case.seen_by(reconstruction)
        if reconstruction.image is not None:
            pairs = zip(case.held_out, case.clean or case.noisy, strict=True)
            values = [psnr_db(image_of(reconstruction, frame), expected) for frame, expected in pairs]
            figures[self._psnr] = round(sum(values) / len(values), 4)
        if case.cloud_m is not None and len(reconstruction.points):
            scores = case.cloud_scores(reconstruction.points, torch.zeros(0, 3))
            figures["chamfer"] = round(scores["chamfer"], 5)
            if len(reconstruction.surface):
                surface = reconstruction.surface.double().numpy() * case.units_per_m
                scores = surface_scores(surface, case.cloud_m * case.units_per_m)
                figures |= {f"{key}_surface": round(scores[key], 2) for key in ("f_01", "f_02")}
        return figures

    def _keep(self) -> None:
        kept: dict[str, Any] = {"points": self.points, "joules": self.joules or 0.0}
        write_whole(self._folder / CURVE, json.dumps(kept).encode())


def image_of(reconstruction: Reconstruction, frame: TrainingFrame) -> torch.Tensor:
    """Return a reconstruction's noiseless image [H, W, C] of a frame in 0..1; it must make images."""
    assert reconstruction.image is not None
    with torch.no_grad():
        return reconstruction.image(cameras_of([frame]), frame.exposure_time_s)


def progress(folder: Path) -> tuple[float, float] | None:
    """Return the share of a work that is done and its seconds, as it last told; None where it has told nothing."""
    told = _read(folder / PROGRESS)
    return None if told is None else (told["share"], told["seconds"])


def _read(path: Path) -> dict[str, Any] | None:
    """Return what a file of ours holds; None where there is none, or half of one."""
    try:
        return json.loads(path.read_bytes())
    except (OSError, ValueError):
        return None
