"""The training beside a listener: a process of its own at lower priority, started again when something kills it."""

import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Self

from ground.run.live.status import read_status
from obbgs_base.errors import Interrupted, ObbgsError, in_words

LOG = "live.log"  # in the session: what the training says
NICENESS = 10
MOST_STARTS = 5  # of a training that is killed again and again, by a lack of memory for instance
POLL_S = 0.2


class TrainingFailed(ObbgsError):
    """The training beside a listener ended with an error, which the message repeats."""


class LiveProcess:
    """Runs `ground live` without a link on the session that this process receives.

    Leaving the `with` block in an error saves the training and ends it. Where this process is killed, the training
    notices that, saves itself and ends.

    Args:
        run: the run's folder.
        options: of the command.
        say: shows a line to the operator.
    """

    def __init__(self, session: Path, run: Path, options: list[str], say: Callable[[str], None]):
        self._log, self._run, self._say = session / LOG, run, say
        self._command = [sys.executable, "-m", "ground.cli", "live", *options, "--listener", str(os.getpid())]
        self._process: subprocess.Popen | None = None
        self._starts = 0
        self._problem = ""  # why there is no training any more

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._end()

    def tend(self) -> None:
        """Start the training, or start it again if it was killed; an error of its own is shown, and it stays ended."""
        code = self._process.poll() if self._process else -1
        if code is None or code == 0 or self._problem:
            return
        if code > 0 or self._starts == MOST_STARTS:
            words = self._last_words() if code > 0 else ""
            self._fail(words or f"it was killed {self._starts} times")
            return
        if self._process is not None:
            self._say(f"the training was ended by signal {-code} and is started again")
        self._starts += 1
        try:
            self._start()
        except OSError as error:
            self._fail(f"its process cannot be started: {in_words(error)}")

    def _end(self) -> None:
        if self._process is not None and self._process.poll() is None:
            self._process.terminate()
            self._process.wait()

    def _start(self) -> None:
        with open(self._log, "a") as log:  # its own group: Ctrl-C on the terminal is for the listener
            self._process = subprocess.Popen(
                ["nice", "-n", str(NICENESS), *self._command],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                start_new_session=True,
            )

    def _fail(self, problem: str) -> None:
        self._problem = problem
        self._say(f"the training has failed, receiving goes on: {problem}")

    def _last_words(self) -> str:
        try:
            lines = self._log.read_text(errors="replace").strip().splitlines()
        except OSError as error:
            return f"it ended, and its log cannot be read: {in_words(error)}"
        return lines[-1].removeprefix("ground: ") if lines else "it ended without a word"

    def status(self) -> dict[str, Any]:
        """Return how the training stands, as `read_status`; {} while it has said nothing and has not failed."""
        facts = read_status(self._run)
        return facts | {"state": "failed", "message": self._problem} if self._problem else facts

    def finish(self, should_stop: Callable[[], bool], on_status: Callable[[dict[str, Any]], None]) -> None:
        """Wait until the training, which knows that the pass is over, has made its run.

        Raises:
            TrainingFailed: it ended with an error, or was killed too often.
            Interrupted: should_stop returned True; the training is saved.
        """
        self.tend()
        while self._process is None or self._process.poll() != 0:
            if self._problem:
                raise TrainingFailed(f"no model was finished: {self._problem} (log: {self._log})")
            if should_stop():
                self._end()
                raise Interrupted(
                    "interrupted; the training is saved, and the same command goes on from there"
                )
            self.tend()
            if facts := self.status():
                on_status(facts)
            time.sleep(POLL_S)
