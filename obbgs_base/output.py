"""Output that no work waits for: where it cannot be written or nobody reads it, the work goes on."""

import contextlib
import io
import logging
import os
import select
import sys
import threading
import time
from collections import deque
from collections.abc import Iterator
from typing import Any

from obbgs_base.errors import reason

log = logging.getLogger(__name__)
MAX_WAITING_BYTES = 1 << 20  # printed and not yet taken; a screen of the console has some 20 kB
LAST_S = 2.0  # at the end, for what still waits


def open_standard_streams() -> None:
    """Have /dev/null in the place of standard streams that were closed at the start.

    Otherwise the next file or port that is opened would have their number, and take what is printed.
    """
    for descriptor in range(3):
        try:
            os.fstat(descriptor)
        except OSError:
            os.set_inheritable(
                os.open(os.devnull, os.O_RDWR), True
            )  # the lowest number that is free: this one
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, mode))  # noqa: SIM115 -- open until the end


@contextlib.contextmanager
def output_may_fail(log: logging.Logger = log) -> Iterator[None]:
    """Have threads write what is printed within the block, so that no failure and no wait reaches who prints.

    What a stream does not take is dropped: everything that fails, and what comes while more than `MAX_WAITING_BYTES`
    wait. The log is told why at once, each reason once, and how much it was at the end. Also a decorator, of a command
    that works for long.
    """
    before = {name: getattr(sys, name) for name in ("stdout", "stderr")}
    writers = [_Writer(name, stream, log) for name, stream in before.items() if _is_file(stream)]
    for writer in writers:
        setattr(sys, writer.name, writer.text)
    try:
        yield
    finally:
        end_s = time.monotonic() + LAST_S
        for writer in writers:
            writer.finish(end_s)
            setattr(sys, writer.name, before[writer.name])


def _is_file(stream: Any) -> bool:
    """Tell whether a stream writes to a descriptor; another one, such as a test's, neither fails nor waits."""
    try:
        stream.fileno()
    except (AttributeError, OSError, ValueError):
        return False
    return True


class _Writer(io.RawIOBase):
    """Takes a stream's bytes at once, and writes them in a thread."""

    def __init__(self, name: str, stream: Any, log: logging.Logger):
        with contextlib.suppress(OSError):
            stream.flush()
        self.name, self._descriptor, self._log = name, stream.fileno(), log
        self._begun = b""  # of a line or a screen that is not complete yet
        self._waiting: deque[bytes] = deque()
        self._waiting_bytes = self._lost_lines = 0
        self._told: set[str] = set()
        self._is_over = False
        self._changed = threading.Condition()
        raw: Any = self
        self.text = io.TextIOWrapper(raw, stream.encoding, "backslashreplace", line_buffering=True)
        self._thread = threading.Thread(target=self._run, name=f"write to {name}", daemon=True)
        self._thread.start()

    def writable(self) -> bool:
        return True

    def fileno(self) -> int:
        return self._descriptor

    def isatty(self) -> bool:
        return os.isatty(self._descriptor)

    def write(self, data: Any) -> int:
        self._begun += bytes(data)
        return len(data)

    def flush(self) -> None:
        """Hand over what was written since the last call, as one piece that is written or dropped as a whole."""
        piece, self._begun = self._begun, b""
        if not piece:
            return
        with self._changed:
            fits = self._waiting_bytes + len(piece) <= MAX_WAITING_BYTES
            if fits:
                self._waiting.append(piece)
                self._waiting_bytes += len(piece)
                self._changed.notify()
        if not fits:
            self._lose(piece, "nobody reads it")

    def finish(self, end_s: float) -> None:
        """Wait until all is written, to a time of `time.monotonic` at most, and tell how much was not."""
        self.text.flush()
        with self._changed:
            self._is_over = True
            self._changed.notify()
        self._thread.join(max(end_s - time.monotonic(), 0.0))
        with self._changed:
            lost_lines = self._lost_lines + sum(map(_lines, self._waiting))
        if lost_lines:
            self._log.warning("%d lines of %s were dropped", lost_lines, self.name)

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._waiting or self._is_over)
                if not self._waiting:
                    return
                piece = self._waiting[0]
            problem = self._put(piece)
            with self._changed:
                self._waiting.popleft()
                self._waiting_bytes -= len(piece)
            if problem:
                self._lose(piece, problem)

    def _put(self, piece: bytes) -> str:
        """Write a piece, however long that takes; return why it could not be."""
        left = memoryview(piece)
        while left:
            try:
                left = left[os.write(self._descriptor, left) :]
            except BlockingIOError:  # another process has set it so
                select.select([], [self._descriptor], [])
            except OSError as error:
                return reason(error)
        return ""

    def _lose(self, piece: bytes, reason: str) -> None:
        with self._changed:
            self._lost_lines += _lines(piece)
            is_told = reason in self._told
            self._told.add(reason)
        if not is_told:  # after it is noted: this may come back here, if the log goes to this stream
            self._log.warning("%s does not take what is printed, the work goes on: %s", self.name, reason)


def _lines(piece: bytes) -> int:
    return max(piece.count(b"\n"), 1)
