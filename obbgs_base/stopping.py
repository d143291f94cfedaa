"""Ending a command cleanly when SIGTERM or Ctrl-C arrives."""

import signal
import threading
import time

POLL_S = 0.05  # after which a wait looks again at what a signal may have asked for


class StopRequest(threading.Event):
    """An event that a signal handler may set, whatever the main thread does at that moment.

    `threading.Event` holds a lock while it begins and ends a wait, and a handler that runs in between would wait for
    that lock for ever. And a handler runs only once the main thread is back in Python: a signal that arrives just
    before a wait without a time limit is not handled until that wait is over. Therefore nothing here takes a lock, and
    every wait is made of short ones.
    """

    def __init__(self) -> None:
        super().__init__()
        self._is_requested = False

    def is_set(self) -> bool:
        return self._is_requested

    def set(self) -> None:
        self._is_requested = True

    def clear(self) -> None:
        self._is_requested = False

    def wait(self, timeout: float | None = None) -> bool:
        """Return whether a stop was requested within `timeout` seconds."""
        end_s = float("inf") if timeout is None else time.monotonic() + timeout
        while not self._is_requested and (left_s := end_s - time.monotonic()) > 0:
            time.sleep(min(left_s, POLL_S))
        return self._is_requested


def stop_on_signals() -> StopRequest:
    """Return a request that SIGTERM and SIGINT make from now on."""
    stop = StopRequest()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: stop.set())
    return stop


def join(thread: threading.Thread) -> None:
    """Wait for a thread to end; unlike `Thread.join`, signals that arrive meanwhile are handled for certain."""
    while thread.is_alive():
        thread.join(POLL_S)
