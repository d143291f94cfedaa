"""Loaded by each worker of a comparison's own cluster: it is ready for its first cell, and Ctrl-C is not for it.

The command, which gets the signal too, asks its workers to save.
"""

import signal
from typing import Any

from obbgs_base.imports import quick_imports

with quick_imports():
    import compare.grid.worker  # noqa: F401 (what the cells need)


def dask_setup(worker: Any) -> None:
    """Ignore the interrupt that a terminal sends to all processes of a command."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
