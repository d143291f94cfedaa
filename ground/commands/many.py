"""Several sessions at once: each is reconstructed, scored and reported on in a process of its own."""

import signal
import time
import uuid
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from distributed import Client, Future, KilledWorker

from ground.run.cluster import ClusterError, connected, fitting_hosts, threads_of, training_mb
from ground.run.evaluate import evaluate
from ground.run.reconstruct import AttitudeSource, reconstruct
from ground.run.runs import read_metrics, run_folder
from ground.show.report.document import write_report
from obbgs_base.errors import Interrupted, ObbgsError, counted, in_words
from obbgs_core.process import prepare_process

POLL_S = 0.2
REPORT = "report.html"
LOOK_EVERY_S = 1.0  # for a wish to stop


@dataclass(frozen=True)
class Asked:
    """What `reconstruct` is asked to do with each session."""

    name: str
    method: str
    changes: dict[str, Any]
    seed: int
    time_limit_s: float
    attitude: AttitudeSource
    overwrite: bool


@dataclass
class Ended:
    """What became of a session: the metrics of its run, or why there are none."""

    metrics: dict[str, Any] | None = None
    problem: str = ""
    was_done: bool = False


def reconstruct_all(
    sessions: Sequence[Path],
    asked: Asked,
    scheduler: str | None,
    workers: int | None,
    on_end: Callable[[Path, Ended], None] = lambda session, ended: None,
    should_stop: Callable[[], bool] = lambda: False,
) -> dict[Path, Ended]:
    """Reconstruct sessions, as many at a time as there are processes, and return what became of each.

    One that cannot be reconstructed does not end the others. Runs that are finished already are not made again, unless
    they are to be overwritten; one whose process dies is given to another, which goes on from its checkpoint.

    Args:
        scheduler, workers: as for `cluster.connected`.
        on_end: called with each session as it ends.

    Raises:
        ValueError: a session is given twice.
        ClusterError: as in `cluster.connected`, or the scheduler is lost.
        Interrupted: should_stop returned true; the trainings are saved.
    """
    if len({session.resolve() for session in sessions}) < len(sessions):
        raise ValueError("a session is given twice: a run of one name is made once in each")
    ended: dict[Path, Ended] = {}
    needs_mb: dict[Path, float] = {}
    for session in sessions:
        try:
            done = _finished(session, asked)
            if done is None:
                needs_mb[session] = training_mb(session, asked.method, asked.changes)
        except (ObbgsError, OSError) as error:
            done = Ended(problem=in_words(error))
        if done is not None:
            ended[session] = done
            on_end(session, done)
    if needs_mb:
        with connected(scheduler, workers, list(needs_mb.values()), __name__) as client:
            for session, result in _run(client, needs_mb, asked, should_stop):
                ended[session] = result
                on_end(session, result)
    if len(ended) < len(sessions):
        raise Interrupted(
            f"interrupted; {len(ended)} of {counted(len(sessions), 'session')} done: "
            f"the same command goes on from there"
        )
    return {session: ended[session] for session in sessions}


def _run(
    client: Client, needs_mb: dict[Path, float], asked: Asked, should_stop: Callable[[], bool]
) -> Iterator[tuple[Path, Ended]]:
    """Yield each session as its run ends; those that were interrupted are left out."""
    token = f".stop-{uuid.uuid4().hex[:8]}"
    wishes = {session: run_folder(session.resolve(), asked.name).parent / token for session in needs_mb}
    running: dict[Future, Path] = {}
    pending = list(needs_mb)
    try:
        while pending or running:
            while pending and len(running) < threads_of(client):
                session = pending.pop(0)
                wishes[session].parent.mkdir(parents=True, exist_ok=True)
                given = (session.resolve(), asked, wishes[session])
                hosts = fitting_hosts(client, needs_mb[session])
                running[client.submit(reconstructed, *given, pure=False, workers=hosts)] = session
            for future in [future for future in running if future.done()]:
                session = running.pop(future)
                if (result := _result(future)) is not None:
                    yield session, result
            if should_stop():
                pending.clear()
                for session in running.values():
                    wishes[session].touch()
            time.sleep(POLL_S)
    finally:
        for session in running.values():  # workers that go on elsewhere after an error
            wishes[session].touch()
        for session in needs_mb.keys() - set(running.values()):
            wishes[session].unlink(missing_ok=True)


def reconstructed(session: Path, asked: Asked, wish: Path) -> dict[str, Any]:
    """Reconstruct, score and report on a session, and return its metrics; runs in a worker.

    Args:
        wish: a file; when it appears, the training is saved and ends in Interrupted.
    """
    prepare_process(threads=1)
    looked_s = -LOOK_EVERY_S

    def should_stop() -> bool:
        nonlocal looked_s
        if time.monotonic() - looked_s < LOOK_EVERY_S:
            return False
        looked_s = time.monotonic()
        return wish.exists()

    if not _has_run(session, asked):
        reconstruct(
            session,
            asked.name,
            asked.method,
            asked.changes,
            asked.seed,
            asked.time_limit_s,
            overwrite=asked.overwrite,
            should_stop=should_stop,
            attitude=asked.attitude,
        )
    metrics = evaluate(session, asked.name)
    write_report(session, asked.name)
    return metrics


def dask_setup(worker: Any) -> None:
    """Ignore the interrupt that a terminal sends to all processes of a command, which asks its workers to save."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _has_run(session: Path, asked: Asked) -> bool:
    """Return whether a session has the run already that it is asked for."""
    return not asked.overwrite and (run_folder(session, asked.name) / "metrics.json").is_file()


def _finished(session: Path, asked: Asked) -> Ended | None:
    """Return the run that a session has already, with its report; None where something is left to do."""
    folder = run_folder(session, asked.name)
    if not _has_run(session, asked) or not (folder / REPORT).is_file():
        return None
    return Ended(read_metrics(folder / "metrics.json"), was_done=True)


def _result(future: Future) -> Ended | None:
    """Return what became of the session of a task that has ended; None where it was interrupted.

    Raises:
        ClusterError: the scheduler was lost.
    """
    if future.status == "finished":
        return Ended(future.result())
    if future.status != "error":
        raise ClusterError("the scheduler was lost; the same command goes on from what is saved")
    error = future.exception()
    if isinstance(error, Interrupted):
        return None
    if isinstance(error, KilledWorker):
        return Ended(
            problem="its process was killed several times, perhaps for want of memory; give fewer --workers"
        )
    assert isinstance(error, Exception)
    return Ended(problem=in_words(error))
