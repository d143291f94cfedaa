"""Makes one row: loads a cell's session, runs its method under its condition, scores the result. Runs in a worker."""

import math
import shutil
from pathlib import Path
from typing import Any

from compare.case import Case, content_digest, load_case
from compare.conditions import given
from compare.errors import CompareError
from compare.follow import FEW_MARKS, MARKS, SURFACE_MARKS, Follower, image_of
from compare.grid.cells import Cell
from compare.grid.origin import commit, with_origin
from compare.grid.rows import locked
from compare.methods import Outcome, Task, method
from compare.opponents.reconstruction import Work
from compare.trainings import MODEL
from compare.views import write_views
from ground.run.scores import of_similarity
from ground.session.folder import SessionError
from obbgs_core.errors import ReconstructionError
from obbgs_core.process import prepare_process

BENCH = "compare"
WORK, VIEWS = "work", "views"  # folders below the comparison's
ROW_NAMES = {  # of the scores whose names in a row differ
    "psnr_clean_foreground_db": "psnr_foreground_db",
    "lpips_clean": "lpips",
    "completeness": "completeness_centres",
}
ROW_LEAVES_OUT = ("accuracy", "hausdorff_surface", "completeness_shown")
OF_NO_SURFACE = (
    "completeness_surface",
    "recall_01_surface",
    "recall_02_surface",
    "f_01_surface",
    "f_02_surface",
)


def run_cell(cell: Cell, out: Path, stop: Path, command: str) -> dict[str, Any]:
    """Return the row of a cell; an interrupted cell goes on from its checkpoint in the comparison's folder.

    Frames that allow no model give a row with the `error`. Views for the page are left in the folder.

    Raises:
        Interrupted: the file `stop` appeared; the work is saved.
        SessionError: the session cannot be used any more, or is another than the grid was made for.
    """
    prepare_process(threads=1)
    commit()  # as it is now: files may change while the work goes on
    folder = out / WORK / cell.digest
    with locked(folder, wait=True):  # a worker that was thought dead may still be at it
        return _made(cell, out, folder, stop, command)


def _made(cell: Cell, out: Path, folder: Path, stop: Path, command: str) -> dict[str, Any]:
    if content_digest(cell.session.path) != cell.session.digest:
        raise SessionError(
            f"{cell.session.path} has changed since the command started, which would mix rows of two contents: start "
            "the command again"
        )
    row: dict[str, Any] = {
        "digest": cell.digest,
        "method": cell.method,
        "target": cell.session.name,
        "seed": cell.seed,
        "size": cell.session.size_px,
        "condition": cell.condition_name,
        "steps_share": cell.budget.steps_share,
    }
    if cell.budget.largest is not None:
        row["largest"] = cell.budget.largest
    if cell.condition.stated():
        row["changes"] = cell.condition.stated()
    try:
        case = load_case(cell.session.path, cell.condition.held_out_sector_deg)
        wanted = method(cell.method, cell.weights)
        marks = MARKS if wanted.settable else FEW_MARKS
        # the time that a surface takes is asked of frames as they were taken
        follower = Follower(case, folder, stop, marks, () if cell.condition.stated() else SURFACE_MARKS)
        frames, sensor = given(case, cell.condition)
        task = Task(
            case,
            frames,
            sensor,
            cell.seed,
            cell.budget.steps_share,
            cell.budget.largest,
            cell.condition.set,
            Work(folder, follower.on_step, follower.should_stop),
            follower.settled,
        )
        outcome = wanted.run(task)
        seen, pose_errors = case.seen_by(outcome.reconstruction)
        row |= _rounded_all(pose_errors) | scores(seen, outcome, out / VIEWS / f"{cell.digest}.npz")
        if pose_errors:
            row |= _after_similarity(case.seen_by(outcome.reconstruction, with_size=True)[0], outcome)
        if (stated_errors := outcome.reconstruction.stated_errors) is not None:
            row |= _rounded_all(stated_errors(seen.held_out, seen.radiance, seen.calibration))
        if curve := follower.finish(outcome.reconstruction):
            row["curve"] = curve
            row["cpu_seconds"] = round(follower.cpu_seconds, 2)
        if outcome.reconstruction.seconds and (joules := follower.joules) is not None:
            row["energy_j"] = round(joules, 1)
    except (ReconstructionError, CompareError) as error:
        row["error"] = f"{type(error).__name__}: {error}"
    return with_origin(row, BENCH, command)


def _after_similarity(case: Case, outcome: Outcome) -> dict[str, Any]:
    """Return the scores of a model whose size is corrected too, of a case that it sees so."""
    result = outcome.reconstruction
    figures = case.cloud_scores(result.points, result.surface)
    if result.image is not None:
        figures |= case.image_scores([image_of(result, frame) for frame in case.held_out])
    return _rounded_all(of_similarity(figures))


def scores(case: Case, outcome: Outcome, views: Path) -> dict[str, Any]:
    """Return the figures of a method's result, as a row has them, and write the views that a page shows."""
    result, images = outcome.reconstruction, outcome.images
    figures: dict[str, Any] = dict(result.figures)
    if images is None and result.image is not None:
        images = [image_of(result, frame) for frame in case.held_out]
    if images is not None:
        write_views(case, images, views)
        figures |= case.image_scores(images)
    if result.image is not None:
        figures |= case.radiance_scores(result.image)
    if case.cloud_m is not None and len(result.points):
        figures |= dict.fromkeys(OF_NO_SURFACE, 0.0)
    figures |= case.cloud_scores(result.points, result.surface)
    if result.seconds:
        figures |= {"bytes": result.size_bytes, "seconds": result.seconds}
    return _rounded_all(
        {ROW_NAMES.get(key, key): value for key, value in figures.items() if key not in ROW_LEAVES_OUT}
    )


def clear_work(out: Path, digest: str) -> None:
    """Remove what a finished cell needs no more: all but its model."""
    folder = out / WORK / digest
    for path in folder.iterdir() if folder.is_dir() else ():
        if path.name != MODEL:
            shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)
    if folder.is_dir() and not any(folder.iterdir()):
        folder.rmdir()


def _rounded_all(figures: dict[str, Any]) -> dict[str, Any]:
    """Return the figures as rows have them; one that is not finite has no meaning, and is left out."""
    return {
        key: round(value, 5) if isinstance(value, float) else value
        for key, value in figures.items()
        if not isinstance(value, float) or math.isfinite(value)
    }
