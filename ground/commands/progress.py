"""Shows the progress of trainings, as bars or as lines of text, and stops them on Ctrl-C or SIGTERM."""

import contextlib
import logging
import signal
import time
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn

if TYPE_CHECKING:  # torch takes seconds to import, and signals must be handled before that
    from obbgs_core.train.result import StepInfo

EVENTS = ("ground.run.reconstruct", "ground.run.model_files", "obbgs_core.train")  # loggers that are shown
PLAIN_S = 10.0  # between lines where there is no terminal
REDRAWN = 5  # steps


@contextlib.contextmanager
def steps_shown(console: Console) -> Iterator[Callable[[str, "StepInfo"], None]]:
    """Give a function that shows a step of a training by its label; messages of the training's log stand between.

    On a terminal each training has a bar; elsewhere a line for its first and last step and every ten seconds.
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


def shares_shown(console: Console) -> Callable[[str, float], None]:
    """Return a function that prints what is being done and the share that is done, at first and every ten seconds."""
    last: tuple[str, float] = ("", 0.0)

    def show(what: str, share: float) -> None:
        nonlocal last
        now = time.monotonic()
        if what != last[0] or now - last[1] > PLAIN_S:
            last = (what, now)
            say(console, f"{what}: {share:.0%}")

    return show


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
    """Prints the state of a training every ten seconds, at its first step, at its last and where it is set back."""

    def __init__(self, console: Console):
        self._console, self._label, self._next_s, self._step = console, "", 0.0, 0

    def __call__(self, label: str, info: "StepInfo") -> None:
        now_s, last = time.monotonic(), self._step if label == self._label else 0
        self._step, is_back = info.step, info.step < last
        if label == self._label and now_s < self._next_s and info.step < info.steps and not is_back:
            return
        self._label, self._next_s = label, now_s + PLAIN_S
        back = f" (the schedule was set back from step {last})" if is_back else ""
        say(self._console, f"{label}: step {info.step} of {info.steps}{back} {_state(info)}")


class _Events(logging.Handler):
    """Prints log messages of level INFO; warnings reach the screen through the program's own handler."""

    def __init__(self, console: Console):
        super().__init__(logging.INFO)
        self._console = console

    def emit(self, record: logging.LogRecord) -> None:
        if record.levelno == logging.INFO and not record.exc_info:
            say(self._console, record.getMessage())


class Lines:
    """Prints what a long work says every ten seconds, and at once where its first word changes."""

    def __init__(self, console: Console):
        self._console, self._first_word, self._next_s = console, "", 0.0

    def __call__(self, label: str, text: str) -> None:
        now_s, first_word = time.monotonic(), text.partition(" ")[0]
        if first_word == self._first_word and now_s < self._next_s:
            return
        self._first_word, self._next_s = first_word, now_s + PLAIN_S
        say(self._console, f"{label}: {text}")


def say(console: Console, text: str) -> None:
    """Print a line of plain text, without markup."""
    console.print(text, markup=False, highlight=False, soft_wrap=True)


def _state(info: "StepInfo") -> str:
    left = "" if info.seconds_left is None else f" {info.seconds_left:.0f} s left"
    return f"PSNR {info.psnr_db:.1f} dB chi² {info.chi2:.1f} {info.gaussians} Gaussians{left}"


class Stop:
    """Turns Ctrl-C and SIGTERM into a request to save and stop; a second signal raises KeyboardInterrupt at once.

    During a training a signal sets `requested`, which the training looks at after each step. Where there is nothing to
    save it raises KeyboardInterrupt instead, but not during imports: a half-imported library would fail later.
    """

    def __init__(self) -> None:
        self.requested, self._deferred = False, True

    def defer(self) -> None:
        """From here on a signal only sets `requested`."""
        self._deferred = True

    def raise_at_once(self) -> None:
        """From here on a signal raises KeyboardInterrupt, and so does one that has come already."""
        self._deferred = False
        if self.requested:
            raise KeyboardInterrupt

    @contextlib.contextmanager
    def on_signals(self) -> Iterator["Stop"]:
        """Handle both signals until the end of the block."""
        before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
        for number in before:
            signal.signal(number, self._received)
        try:
            yield self
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)

    def _received(self, *_: object) -> None:
        if self.requested or not self._deferred:
            raise KeyboardInterrupt
        self.requested = True
