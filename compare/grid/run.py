"""Runs a grid: hands its cells to workers, writes each row when it is made, and says how far the whole is."""

import statistics
import time
import uuid
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from distributed import Client, Future, KilledWorker

from compare.errors import CompareError
from compare.follow import progress
from compare.grid.cells import Cell
from compare.grid.rows import Rows, locked
from compare.grid.worker import WORK, clear_work, run_cell
from ground.run.cluster import connected, fitting_hosts, threads_of
from obbgs_base.errors import Interrupted

POLL_S = 0.2
LOCAL_WORKER = "compare.grid.local_worker"


@dataclass(frozen=True)
class State:
    """How far a comparison is; seconds_left is None until something is known of each method's pace."""

    done: int
    total: int
    running: list[tuple[Cell, float]]  # and the share of its work that is done
    seconds_left: float | None
    news: dict[str, Any] | None = None  # a row that has just been made


@dataclass
class Summary:
    """What became of a grid's cells."""

    made: int = 0
    were_done: int = 0
    failed: dict[str, str] = field(default_factory=dict)  # label of a cell to the reason why it has no row


def run_grid(
    cells: Sequence[Cell],
    out: Path,
    command: str,
    scheduler: str | None = None,
    workers: int | None = None,
    on_state: Callable[[State], None] = lambda state: None,
    should_stop: Callable[[], bool] = lambda: False,
) -> Summary:
    """Make the rows of the cells that have none yet in `out`/rows.jsonl, and return what became of them.

    A cell whose worker dies is given to another one, which goes on from its checkpoint. A cell that cannot be made is
    reported and the others are made.

    Raises:
        CompareError: another command works in the folder, or the scheduler is lost.
        ClusterError: the scheduler does not answer, or a cell needs more memory than any worker has.
        Interrupted: should_stop returned true; the running cells are saved.
    """
    with locked(out):
        rows = Rows(out)
        todo = [cell for cell in cells if cell.digest not in rows.rows]
        summary = Summary(were_done=len(cells) - len(todo))
        if todo:
            with connected(scheduler, workers, [cell.memory_mb for cell in todo], LOCAL_WORKER) as client:
                _Run(client, out, command, rows, todo, len(cells), summary, on_state).work(should_stop)
        return summary


class _Run:
    """The cells of one command under way."""

    def __init__(
        self,
        client: Client,
        out: Path,
        command: str,
        rows: Rows,
        todo: list[Cell],
        total: int,
        summary: Summary,
        on_state: Callable[[State], None],
    ):
        self._client, self._out, self._command, self._rows = client, out, command, rows
        self._pending, self._total, self._summary, self._on_state = list(todo), total, summary, on_state
        self._running: dict[Future, Cell] = {}
        self._token = uuid.uuid4().hex[:8]
        self._stop = out / WORK / f"stop-{self._token}"

    def work(self, should_stop: Callable[[], bool]) -> None:
        """Make all cells.

        Raises:
            Interrupted, CompareError: as in `run_grid`.
        """
        (self._out / WORK).mkdir(exist_ok=True)
        told_s = 0.0
        try:
            while self._pending or self._running:
                self._submit()
                self._collect()
                if time.monotonic() - told_s > 1:
                    told_s = time.monotonic()
                    self._tell()
                if should_stop() and not self._stop.exists():
                    self._stop.touch()
                    self._pending.clear()
                time.sleep(POLL_S)
            if self._stop.exists():
                left = self._total - len(self._summary.failed) - self._summary.were_done - self._summary.made
                raise Interrupted(
                    f"interrupted; {self._summary.made} rows were made and {left} are left: the same command goes on "
                    "from there"
                )
        finally:
            self._stop.touch()  # workers that go on elsewhere after an error
            if not self._running:
                self._stop.unlink()

    def _submit(self) -> None:
        """Give the next cells to workers, as many as there are threads."""
        threads = threads_of(self._client)
        while self._pending and len(self._running) < threads:
            cell = self._pending.pop(0)
            hosts = fitting_hosts(self._client, cell.memory_mb)
            future = self._client.submit(
                run_cell,
                cell,
                self._out.resolve(),
                self._stop.resolve(),
                self._command,
                key=f"{cell.digest}-{self._token}",
                pure=False,
                workers=hosts,
            )
            self._running[future] = cell

    def _collect(self) -> None:
        """Write the rows of cells that have ended."""
        for future in [future for future in self._running if future.done()]:
            cell = self._running.pop(future)
            if future.status == "finished":
                row = future.result()
                self._rows.add(row)
                clear_work(self._out, cell.digest)
                self._summary.made += 1
                self._tell(row)
            elif future.status == "error":
                error = future.exception()
                if isinstance(error, Interrupted):
                    continue
                reason = f"{type(error).__name__}: {error}"
                if isinstance(error, KilledWorker):
                    reason = "its worker was killed several times, perhaps for want of memory; give fewer --workers"
                self._summary.failed[cell.label] = reason
            else:
                raise CompareError("the scheduler was lost; the same command goes on from what is saved")

    def _tell(self, row: dict[str, Any] | None = None) -> None:
        running = []
        for cell in self._running.values():
            told = progress(self._out / WORK / cell.digest)
            running.append((cell, 0.0 if told is None else told[0]))
        done = self._summary.were_done + self._summary.made + len(self._summary.failed)
        self._on_state(State(done, self._total, running, self._seconds_left(), row))

    def _seconds_left(self) -> float | None:
        """Return the time that the other cells will take, at the pace of finished and running ones of their kind."""
        paces: dict[tuple, list[float]] = {}
        for row in self._rows.rows.values():
            if "error" not in row:
                paces.setdefault((row["method"], row["size"]), []).append(
                    row.get("seconds", 0.0) / row["steps_share"]
                )
        left = 0.0
        running = {}
        for cell in self._running.values():
            told = progress(self._out / WORK / cell.digest)
            if told is not None and told[0] > 0:
                running[cell.digest] = told
                kind = (cell.method, cell.session.size_px)
                paces.setdefault(kind, [told[1] / told[0] / cell.budget.steps_share])
        for cell in [*self._running.values(), *self._pending]:
            kind = (cell.method, cell.session.size_px)
            if cell.digest in running:
                share, seconds = running[cell.digest]
                left += seconds / share - seconds
            elif kind in paces:
                left += statistics.fmean(paces[kind]) * cell.budget.steps_share
            else:
                return None
        return left / max(1, threads_of(self._client))
