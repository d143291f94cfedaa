"""Loaded by each worker of a comparison's own cluster: Ctrl-C is for the command, which asks its workers to save."""

import signal
from typing import Any


def dask_setup(worker: Any) -> None:
    """Ignore the interrupt that a terminal sends to all processes of a command."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
