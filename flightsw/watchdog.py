"""Tells systemd that the flight software is ready, alive or stopping (sd_notify); without systemd nothing is sent.

Source: sd_notify(3): datagrams to the socket that NOTIFY_SOCKET names, whose leading @ stands for a zero byte.
"""

import logging
import os
import socket
import time
from collections.abc import Callable

from obbgs_base.errors import reason

log = logging.getLogger(__name__)


def notify(state: str) -> None:
    """Send one state, such as READY=1, to the service manager, if there is one."""
    address = os.environ.get("NOTIFY_SOCKET", "")
    if not address:
        return
    if address.startswith("@"):
        address = "\0" + address[1:]
    try:
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as channel:
            channel.setblocking(False)  # a full queue must not stop the flight software
            channel.sendto(state.encode(), address)
    except OSError as error:
        log.warning("the service manager was not told %s: %s", state, reason(error))


class Watchdog:
    """Says WATCHDOG=1 while every loop keeps the time in which it promised to report again."""

    def __init__(self, clock_s: Callable[[], float] = time.monotonic):
        self._clock_s = clock_s
        self._due_s: dict[str, float] = {}  # of each loop

    def expect(self, loop: str, within_s: float) -> None:
        """Note that a loop is alive and reports again within so many seconds."""
        self._due_s[loop] = self._clock_s() + within_s

    def ended(self, loop: str) -> None:
        """Note that a loop is over; nothing is expected of it any more."""
        self._due_s.pop(loop, None)

    def alive(self) -> None:
        """Tell the service manager that all loops are alive, unless one of them is overdue."""
        now_s = self._clock_s()
        if all(due_s >= now_s for due_s in list(self._due_s.values())):
            notify("WATCHDOG=1")
