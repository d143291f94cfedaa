"""Has models tried and frames ranked in a process of its own, which is killed when it takes too long."""

import contextlib
import dataclasses
import json
import logging
import os
import queue
import selectors
import signal
import subprocess
import sys
import threading
import time
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np

from flightsw.triage.model_process import Limits, Task
from flightsw.triage.scores import Ranked

log = logging.getLogger(__name__)
BEGIN_S = 120.0  # for Python and onnxruntime to be loaded from a slow disk, before the model's time begins
MODEL_FIRST, FRAME = 0, 1  # a new model does not wait until all frames are ranked by the one before


class ModelStopped(Exception):
    """The process of a model ended or has to be killed; the message goes on after "the model"."""

    is_unfit = True  # it is the model's fault


@dataclass(frozen=True)
class ModelVerified:
    """How a model file was found; `problem` is None for one that ranks frames from now on.

    `is_unfit`: it is the model's fault, and it would be no better another time.
    """

    path: Path
    sha256: bytes
    problem: str | None
    is_unfit: bool = False


@dataclass(frozen=True)
class ModelFailed:
    """The model that ranked frames had to be stopped; it ranks none any more."""

    problem: str


Result = ModelVerified | ModelFailed | tuple[Path, Ranked | None]


class ModelProcess:
    """A process that has a model: `begin` loads and tries it, `rank` ranks a frame; any thread may kill it."""

    def __init__(self, task: Task):
        self._task, self._text = task, b""
        one_thread = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
        self._process = subprocess.Popen(  # a session of its own: Ctrl-C on the terminal is for flight
            [sys.executable, "-m", "flightsw.triage.model_process"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            start_new_session=True,
            env=os.environ | one_thread,
        )

    def begin(self) -> dict[str, Any]:
        """Return what the process says of the model: its `sha256`, or the `problem`.

        Raises:
            ModelStopped: it took too long, or the process ended.
        """
        try:
            self._ask(dataclasses.asdict(self._task), BEGIN_S)
        except ModelStopped as stopped:
            stopped.is_unfit = False  # it has not begun
            raise
        return self._answer(self._task.limits.time_s)

    def rank(self, container: Path) -> dict[str, Any]:
        """Return the values of a `Ranked`, or the `problem` with this frame.

        Raises:
            ModelStopped: it took too long, or the process ended.
        """
        return self._ask(str(container), self._task.limits.time_s)

    @property
    def exit_code(self) -> int | None:
        """The process's exit code, minus a signal's number; None while it runs."""
        return self._process.returncode

    def kill(self) -> None:
        """End the process, whatever it does."""
        self._process.kill()

    def close(self) -> None:
        """End the process and wait until it is gone."""
        self._process.kill()
        self._process.wait()
        for pipe in (self._process.stdin, self._process.stdout):
            with contextlib.suppress(OSError):
                pipe.close()  # type: ignore[union-attr]

    def _ask(self, question: Any, within_s: float) -> dict[str, Any]:
        assert self._process.stdin is not None
        try:
            os.write(self._process.stdin.fileno(), json.dumps(question).encode() + b"\n")
        except BrokenPipeError as error:
            raise ModelStopped(self._how_it_ended()) from error
        return self._answer(within_s)

    def _answer(self, within_s: float) -> dict[str, Any]:
        """Return the next line of the process."""
        assert self._process.stdout is not None
        end_s = time.monotonic() + within_s
        with selectors.DefaultSelector() as selector:
            selector.register(self._process.stdout, selectors.EVENT_READ)
            while b"\n" not in self._text:
                if not selector.select(max(end_s - time.monotonic(), 0.0)):
                    raise ModelStopped(f"did not come to an end within {within_s:g} s")
                data = os.read(self._process.stdout.fileno(), 65536)
                if not data:
                    raise ModelStopped(self._how_it_ended())
                self._text += data
        line, self._text = self._text.split(b"\n", 1)
        return json.loads(line)

    def _how_it_ended(self) -> str:
        code = self._process.wait()
        if code == -signal.SIGXCPU:
            return f"took more than {self._task.limits.time_s:g} s of processor time"
        if code < 0:
            return (
                f"ended its process by {signal.Signals(-code).name}, as one does that needs too much memory"
            )
        return f"ended its process with exit code {code}"


class TriageWorker:
    """Verifies models and ranks frames, while the link goes on; what runs a model is a process of its own."""

    def __init__(self, K: np.ndarray, width: int, height: int, limits: Limits | None = None):
        self._K, self._size, self._limits = K, (width, height), limits or Limits()
        self._number = count()
        self._tasks: queue.PriorityQueue[tuple[int, int, Path]] = queue.PriorityQueue()
        self._results: queue.SimpleQueue[Result] = queue.SimpleQueue()
        self._model: ModelProcess | None = None  # that ranks frames
        self.processes: set[ModelProcess] = set()  # all that run
        self._guard, self._is_stopped = threading.Lock(), False
        self._thread = threading.Thread(target=self._run, name="triage", daemon=True)

    def verify(self, model: Path) -> None:
        """Check and try a model file, before any frame is ranked; if it is usable, later frames are ranked by it."""
        self._put(MODEL_FIRST, model)

    def rank(self, container: Path) -> None:
        """Rank a stored frame by the newest model."""
        self._put(FRAME, container)

    def forget_frames(self) -> None:
        """Rank none of the frames that wait."""
        models = []
        with contextlib.suppress(queue.Empty):
            while True:
                task = self._tasks.get_nowait()
                models += [task] if task[0] == MODEL_FIRST else []
        for task in models:
            self._tasks.put(task)

    def results(self) -> list[Result]:
        """Return what was done since the last call, in order; None for a frame that cannot be ranked."""
        done = []
        while not self._results.empty():
            done.append(self._results.get())
        return done

    def stop(self) -> None:
        """End at once, and every process of a model with it; what waits is dropped."""
        with self._guard:
            self._is_stopped = True
            for process in self.processes:
                process.kill()
        if self._thread.is_alive():
            self._put(MODEL_FIRST, Path())  # so that the thread looks up
            self._thread.join()

    def _put(self, kind: int, path: Path) -> None:
        if self._thread.ident is None:
            self._thread.start()
        self._tasks.put((kind, next(self._number), path))

    def _run(self) -> None:
        try:
            while True:
                kind, _, path = self._tasks.get()
                if self._is_stopped:
                    return
                try:
                    result = self._verified(path) if kind == MODEL_FIRST else self._ranked(path)
                except Exception as error:  # the outermost loop of this thread: frames would wait forever
                    log.error("triage failed at %s: %r", path.name, error, exc_info=error)
                    problem = f"triage failed: {error!r}"
                    result = ModelVerified(path, b"", problem) if kind == MODEL_FIRST else (path, None)
                if self._is_stopped:  # what it was doing was killed
                    return
                self._results.put(result)
        finally:
            for process in list(self.processes):
                self._close(process)

    def _verified(self, path: Path) -> ModelVerified:
        (width, height), K = self._size, self._K.tolist()
        with self._guard:
            if self._is_stopped:
                return ModelVerified(path, b"", "triage was stopped")
            process = ModelProcess(Task(str(path), width, height, K, self._limits))
            self.processes.add(process)
        try:
            answer = process.begin()
        except ModelStopped as stopped:
            answer = {"problem": f"the model {stopped}", "is_unfit": stopped.is_unfit}
        if "problem" in answer:
            self._close(process)
            return ModelVerified(path, b"", answer["problem"], answer["is_unfit"])
        if self._model is not None:
            self._close(self._model)
        self._model = process
        return ModelVerified(path, bytes.fromhex(answer["sha256"]), None)

    def _ranked(self, path: Path) -> Result:
        if self._model is None:
            return path, None
        try:
            answer = self._model.rank(path)
        except ModelStopped as stopped:
            self._close(self._model)
            self._model = None
            return ModelFailed(f"the model {stopped}, at {path.name}")
        if "problem" in answer:
            log.warning("%s cannot be ranked: %s", path.name, answer["problem"])
            return path, None
        return path, Ranked(**answer | {"path": path, "view": tuple(answer["view"])})

    def _close(self, process: ModelProcess) -> None:
        process.close()
        with self._guard:
            self.processes.discard(process)
