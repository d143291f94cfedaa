"""Processes that end with the one that started them, whether it returns, is told to end, or is killed."""

import os
import signal
import subprocess
import sys
from types import FrameType

# Linux: the kernel kills the process when its parent ends (prctl 1 is PR_SET_PDEATHSIG), also after exec. A parent
# that had ended before is noticed by another parent's number. Elsewhere there is no such thing and the command is
# only executed. A launcher and not `preexec_fn`, which may hang where other threads run.
LAUNCHER = """
import os, signal, sys
if sys.platform == "linux":
    import ctypes
    ctypes.CDLL(None).prctl(1, signal.SIGKILL)
    if os.getppid() != int(sys.argv[1]):
        sys.exit(1)
os.execvp(sys.argv[2], sys.argv[2:])
"""


def tied(command: list[str]) -> list[str]:
    """Return what runs `command` as a process that is killed when the thread that starts it has ended.

    Give it to `subprocess`. The process keeps its number: it becomes `command`. On Linux; elsewhere nothing ties it.
    """
    return [sys.executable, "-I", "-S", "-c", LAUNCHER, str(os.getpid()), *command]


def unwind_on_sigterm() -> None:
    """Leave by SystemExit on the next SIGTERM, so that every `with` and `finally` ends what it began.

    A second SIGTERM ends the process at once. To be called by a program's main thread.
    """

    def leave(number: int, _: FrameType | None) -> None:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        sys.exit(128 + number)

    signal.signal(signal.SIGTERM, leave)


def end(process: subprocess.Popen, patience_s: float = 10.0) -> None:
    """Tell a process to end and wait for it; kill it when that takes longer than `patience_s`."""
    process.terminate()
    try:
        process.wait(patience_s)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
