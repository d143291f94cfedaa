"""Child processes that end with their parent, whether it returns, is terminated, or is killed."""

import os
import signal
import subprocess
import sys
from pathlib import Path
from types import FrameType

# On Linux the kernel kills the process when its parent ends (prctl 1 is PR_SET_PDEATHSIG), also after exec. If the
# parent has already ended, the process has another parent by now and ends itself. Elsewhere the command is only run.
# This is a launcher and not a `preexec_fn`, which may deadlock in a program with several threads.
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
    """Return a command for `subprocess` that runs `command` as a process which is killed when its parent ends.

    The parent is the thread that starts it. The process becomes `command` and keeps its number. Only on Linux is it
    killed; elsewhere `command` just runs.
    """
    return [sys.executable, "-I", "-S", "-c", LAUNCHER, str(os.getpid()), *command]


def unwind_on_sigterm() -> None:
    """Raise SystemExit on the next SIGTERM, so that every `with` and `finally` block is left in order.

    A second SIGTERM ends the process at once. Must be called by a program's main thread.
    """

    def leave(number: int, _: FrameType | None) -> None:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        sys.exit(128 + number)

    signal.signal(signal.SIGTERM, leave)


def installed(tool: str) -> str:
    """Return the path of one of our command lines (flightsw, ground, hil) in this Python environment."""
    return str(Path(sys.executable).with_name(tool))


def end(process: subprocess.Popen, timeout_s: float = 10.0) -> None:
    """Terminate a process and wait for it; kill it when that takes longer than `timeout_s`."""
    process.terminate()
    try:
        process.wait(timeout_s)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
