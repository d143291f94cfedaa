"""Our command lines called in this process: what they print and how they end, as a shell would see it."""

import contextlib
import importlib
import io
import signal
import sys
import threading
from dataclasses import dataclass


@dataclass(frozen=True)
class Called:
    """How a command ended; anything but an exit would have failed the test."""

    returncode: int
    stdout: str
    stderr: str


def call(tool: str, *arguments: object) -> Called:
    """Call `flightsw`, `ground` or `hil`; signals and threads are then handled as before."""
    main = importlib.import_module(f"{tool}.cli").main
    out, err, code = io.StringIO(), io.StringIO(), None
    argv, hook = sys.argv, threading.excepthook
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    sys.argv = [tool, *map(str, arguments)]
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            main()
    except SystemExit as ended:
        code = ended.code
    finally:
        sys.argv, threading.excepthook = argv, hook
        for number, handler in handlers.items():
            signal.signal(number, handler)
    assert code is None or isinstance(code, int)
    return Called(code or 0, out.getvalue(), err.getvalue())
