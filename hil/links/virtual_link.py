"""What the virtual serial line and the virtual CAN bus share: two pseudo-terminals, a thread, and how they are run."""

import contextlib
import os
import time
import tty
from collections.abc import Callable
from dataclasses import asdict, fields, replace
from typing import Any, Self

from hil.links.faults import Faults
from hil.watched import WatchedThread


class VirtualLink:
    """Two pseudo-terminals and a thread that carries bytes between them while the `with` block runs.

    `flight_url` and `ground_url` are the two ends. `faults` and `latency_s` may be changed while it runs.
    """

    flight_url: str
    ground_url: str

    def __init__(self, faults: Faults | None = None, latency_s: float = 0.0):
        if not latency_s >= 0:
            raise ValueError(f"latency_s must not be negative, got {latency_s}")
        self.faults = faults or Faults()
        self.latency_s = latency_s
        self.is_cut = False
        self._stop = False
        self._masters, self._slaves = [], []
        for _ in range(2):
            master, slave = os.openpty()
            tty.setraw(slave)  # at once: a terminal by default echoes and translates
            os.set_blocking(master, False)
            self._masters.append(master)
            self._slaves.append(slave)  # kept open, or reading the master fails until a program opens it
        self._thread = WatchedThread(f"simulated link ({type(self).__name__})", self._run)

    @property
    def flight_device(self) -> str:
        return os.ttyname(self._slaves[0])

    @property
    def ground_device(self) -> str:
        return os.ttyname(self._slaves[1])

    def cut(self) -> None:
        """Break the cable: what is written is lost, and counted."""
        self.is_cut = True

    def mend(self) -> None:
        """Repair the cable."""
        self.is_cut = False

    def statistics(self) -> dict[str, Any]:
        """Return the counts so far by direction: `down` from flight to ground, `up` from ground to flight."""
        raise NotImplementedError

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def check(self) -> None:
        """Raise ServerError if the thread has failed, so that no byte crosses any more."""
        self._thread.check()

    def __exit__(self, kind: object, *_: object) -> None:
        self._stop = True
        self._thread.join()
        for descriptor in self._masters + self._slaves:
            with contextlib.suppress(OSError):
                os.close(descriptor)
        if kind is None:
            self.check()

    def _run(self) -> None:
        raise NotImplementedError


def control(line: VirtualLink, command: str) -> str:
    """Execute `cut`, `mend`, `latency SECONDS` or a fault's name with its probability, and return the new state.

    Raises:
        ValueError: another command, or a value out of range; the message says what was expected.
    """
    word, *values = command.split() or [""]
    names = [field.name for field in fields(Faults)]
    if (word, values) == ("cut", []):
        line.cut()
    elif (word, values) == ("mend", []):
        line.mend()
    elif word in names and len(values) == 1:
        line.faults = replace(line.faults, **{word: float(values[0])})
    elif word == "latency" and len(values) == 1 and float(values[0]) >= 0:
        line.latency_s = float(values[0])
    else:
        raise ValueError(
            f"expected cut, mend, latency SECONDS, or {', '.join(names)} with a probability of 0 to 1; got {command!r}"
        )
    state = "cut" if line.is_cut else "whole"
    return f"{state}, latency {line.latency_s:g} s, {asdict(line.faults)}"


def run_link(
    line: VirtualLink,
    on_ready: Callable[[VirtualLink], None],
    should_stop: Callable[[], bool] = lambda: False,
    on_statistics: Callable[[dict[str, Any]], None] = lambda statistics: None,
    every_s: float = 1.0,
) -> dict[str, Any]:
    """Run a link until `should_stop` returns True (asked every 50 ms) or Ctrl-C, and return its counts.

    `on_ready` is called with the link once its two ends can be opened.

    Raises:
        ServerError: the link failed.
    """
    with line:
        on_ready(line)
        then_s = time.monotonic()
        with contextlib.suppress(KeyboardInterrupt):
            while not should_stop():
                time.sleep(0.05)
                line.check()
                if time.monotonic() - then_s >= every_s:
                    then_s = time.monotonic()
                    on_statistics(line.statistics())
        return line.statistics()
