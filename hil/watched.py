"""Threads of the simulator whose failures are logged and reported to those that depend on them."""

import logging
import threading
from collections.abc import Callable

from obbgs_base.errors import ObbgsError

log = logging.getLogger(__name__)


class ServerError(ObbgsError):
    """A thread of the simulator has failed while others still depend on it."""


class WatchedThread(threading.Thread):
    """Runs `work` until it returns. If it raises, that is logged at once, and `check` raises it as a ServerError."""

    def __init__(self, name: str, work: Callable[[], object]):
        super().__init__(name=name, daemon=True)
        self._work = work
        self._error: Exception | None = None

    def run(self) -> None:
        try:
            self._work()
        except Exception as error:  # the outermost loop of this thread
            self._error = error
            log.error("the %s has ended: %r", self.name, error, exc_info=error)

    def check(self) -> None:
        """Raise ServerError if the thread ended by an error."""
        if self._error is not None:
            raise ServerError(f"the {self.name} has ended: {self._error!r}") from self._error
