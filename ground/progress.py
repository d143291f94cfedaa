"""A training on the screen, or in lines where there is no terminal, and how it is stopped."""

import contextlib
import signal
import time
from collections.abc import Callable, Iterator

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn

from obbgs_core.optimize import StepInfo

PLAIN_S = 10.0  # between lines where there is no terminal
REDRAWN = 5  # steps


@contextlib.contextmanager
def steps_shown(console: Console) -> Iterator[Callable[[str, StepInfo], None]]:
    """Give what shows the steps of trainings by their label: a bar each, or a line every ten seconds and at the end."""
    if not console.is_terminal:
        yield _Lines(console)
        return
    with Progress(
        TextColumn("{task.description:>18}"),
        BarColumn(bar_width=24),
        TextColumn("{task.fields[state]}"),
        console=console,
    ) as progress:
        tasks = {}

        def show(label: str, info: StepInfo) -> None:
            if label not in tasks:
                tasks[label] = progress.add_task(label, total=info.steps, state="")
            if info.step % REDRAWN == 0 or info.step == info.steps:
                progress.update(tasks[label], completed=info.step, state=_state(info))

        yield show


class _Lines:
    """Prints the state of a training every ten seconds, at its first step and at its last."""

    def __init__(self, console: Console):
        self._console, self._label, self._next_s = console, "", 0.0

    def __call__(self, label: str, info: StepInfo) -> None:
        now_s = time.monotonic()
        if label == self._label and now_s < self._next_s and info.step < info.steps:
            return
        self._label, self._next_s = label, now_s + PLAIN_S
        self._console.print(f"{label}: {_state(info)}", markup=False, highlight=False, soft_wrap=True)


def _state(info: StepInfo) -> str:
    return (
        f"step {info.step} of {info.steps}, PSNR {info.psnr_db:.1f} dB, chi² {info.chi2:.1f}, "
        f"{info.gaussians:,} Gaussians, {info.seconds_left:.0f} s left"
    )


class Stop:
    """Ctrl-C and SIGTERM as a question, `asked`, while a training can still save itself; a second one ends at once.

    Before the first step and after the run there is nothing to save: there they raise KeyboardInterrupt.
    """

    def __init__(self) -> None:
        self.asked = self.patient = False

    @contextlib.contextmanager
    def on_signals(self) -> Iterator["Stop"]:
        """Obey both signals until the end of the block."""
        before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
        for number in before:
            signal.signal(number, self._obey)
        try:
            yield self
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)

    def _obey(self, *_: object) -> None:
        if self.asked or not self.patient:
            raise KeyboardInterrupt
        self.asked = True
