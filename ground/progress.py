"""A training on the screen, or in lines where there is no terminal, and how it is stopped."""

import contextlib
import logging
import signal
import time
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn

if TYPE_CHECKING:  # torch takes seconds to import, and signals are obeyed before
    from obbgs_core.train.result import StepInfo

EVENTS = ("ground.reconstruct", "obbgs_core.train")  # loggers whose events are shown
PLAIN_S = 10.0  # between lines where there is no terminal
REDRAWN = 5  # steps


@contextlib.contextmanager
def steps_shown(console: Console) -> Iterator[Callable[[str, "StepInfo"], None]]:
    """Give what shows the steps of trainings by their label: a bar each, or a line every ten seconds and at the end.

    Between them stand the events that the training tells its log.
    """
    events = _Events(console)
    for name in EVENTS:
        logging.getLogger(name).addHandler(events)
    try:
        with _bars(console) if console.is_terminal else contextlib.nullcontext(_Lines(console)) as show:
            yield show
    finally:
        for name in EVENTS:
            logging.getLogger(name).removeHandler(events)


@contextlib.contextmanager
def _bars(console: Console) -> Iterator[Callable[[str, "StepInfo"], None]]:
    with Progress(
        TextColumn("{task.description:>18}"),
        BarColumn(bar_width=24),
        TextColumn("{task.fields[state]}"),
        console=console,
    ) as progress:
        tasks = {}

        def show(label: str, info: "StepInfo") -> None:
            if label not in tasks:
                tasks[label] = progress.add_task(label, total=info.steps, state="")
            if info.step % REDRAWN == 0 or info.step == info.steps:
                progress.update(tasks[label], completed=info.step, state=f"step {info.step} {_state(info)}")

        yield show


class _Lines:
    """Prints the state of a training every ten seconds, at its first step and at its last."""

    def __init__(self, console: Console):
        self._console, self._label, self._next_s = console, "", 0.0

    def __call__(self, label: str, info: "StepInfo") -> None:
        now_s = time.monotonic()
        if label == self._label and now_s < self._next_s and info.step < info.steps:
            return
        self._label, self._next_s = label, now_s + PLAIN_S
        say(self._console, f"{label}: step {info.step} of {info.steps} {_state(info)}")


class _Events(logging.Handler):
    """Prints what is told at the level of information; warnings have their own way to the screen."""

    def __init__(self, console: Console):
        super().__init__(logging.INFO)
        self._console = console

    def emit(self, record: logging.LogRecord) -> None:
        if record.levelno == logging.INFO and not record.exc_info:
            say(self._console, record.getMessage())


def say(console: Console, text: str) -> None:
    """Print a line as it is."""
    console.print(text, markup=False, highlight=False, soft_wrap=True)


def _state(info: "StepInfo") -> str:
    return (
        f"PSNR {info.psnr_db:.1f} dB chi² {info.chi2:.1f} {info.gaussians} Gaussians "
        f"{info.seconds_left:.0f} s left"
    )


class Stop:
    """Ctrl-C and SIGTERM as a question, `asked`, which a training answers by saving itself; a second one ends at once.

    Where nothing asks the question, before the first step and after the run, they raise KeyboardInterrupt. Imports are
    waited for: a library that is cut off in its own comes up broken.
    """

    def __init__(self) -> None:
        self.asked, self._patient = False, True

    def ask(self) -> None:
        """From here on a signal is a question."""
        self._patient = True

    def obey(self) -> None:
        """From here on a signal ends the work at once, and so does one that has come already."""
        self._patient = False
        if self.asked:
            raise KeyboardInterrupt

    @contextlib.contextmanager
    def on_signals(self) -> Iterator["Stop"]:
        """Obey both signals until the end of the block."""
        before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
        for number in before:
            signal.signal(number, self._received)
        try:
            yield self
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)

    def _received(self, *_: object) -> None:
        if self.asked or not self._patient:
            raise KeyboardInterrupt
        self.asked = True
