"""What the flight software reports about itself: values of the process and the disk, and events."""

import logging
import os
import shutil
import threading
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Any

from flightsw.clock import utc_ns
from flightsw.icd.telemetry import DICTIONARY
from obbgs_base.errors import counted

MAX_EVENTS = 200  # waiting to be sent, or to be sent again; the oldest are lost, and counted in the next one
QUIET_S = (
    10.0  # without a packet of the ground: events that were sent meanwhile may have gone into a cut link
)
ON_THE_WAY_S = 2.0  # before the silence, from when on events may be lost too


class EventLog(logging.Handler):
    """Events to be sent. As a logging handler it makes an event of every warning and error of the flight software.

    Any thread may write, one takes them out. Events are not acknowledged: those that were sent while the ground was
    silent are sent again, the same bytes, once it is heard.
    """

    def __init__(self, utc_ns: Callable[[], int] = utc_ns, clock_s: Callable[[], float] = time.monotonic):
        super().__init__(logging.WARNING)
        self._utc_ns, self._clock_s = utc_ns, clock_s
        self._packets: deque[bytes] = deque()
        self._sent: deque[tuple[float, bytes]] = deque()  # and when, s, since the ground was heard
        self._heard_s = float("-inf")
        self._lost = self._not_kept = 0
        self._guard = threading.Lock()

    def add(self, name: str, **values: Any) -> None:
        """Queue an event of the dictionary."""
        packet = self._pack(name, **values)
        with self._guard:
            if len(self._packets) >= MAX_EVENTS:
                self._packets.popleft()
                self._lost += 1
            self._packets.append(packet)

    def _pack(self, name: str, **values: Any) -> bytes:
        return DICTIONARY.events[name].pack(utc_ns=self._utc_ns(), **values)

    def emit(self, record: logging.LogRecord) -> None:
        self.add("error" if record.levelno >= logging.ERROR else "warning", problem=record.getMessage())

    def heard(self) -> None:
        """Note that a packet of the ground has come; after a silence what was sent meanwhile is sent again."""
        now_s = self._clock_s()
        with self._guard:
            if now_s - self._heard_s > QUIET_S:
                again = [packet for _, packet in self._sent]
                if self._not_kept:
                    problem = (
                        f"not sent again: {counted(self._not_kept, 'event')} of the time without the ground"
                    )
                    again.insert(0, self._pack("warning", problem=problem))
                self._packets.extendleft(reversed(again))
                self._sent.clear()
            self._heard_s, self._not_kept = now_s, 0
            self._forget_received()

    def _forget_received(self) -> None:
        while self._sent and self._sent[0][0] < self._heard_s - ON_THE_WAY_S:
            self._sent.popleft()

    def take(self) -> bytes | None:
        """Return the next event's packet data, None when there is none."""
        with self._guard:
            if not self._packets:
                return None
            lost, self._lost = self._lost, 0
            packet = self._packets.popleft()
            self._sent.append((self._clock_s(), packet))
            self._forget_received()
            if len(self._sent) > MAX_EVENTS:
                self._sent.popleft()
                self._not_kept += 1
        if lost:
            self.add("warning", problem=f"lost {counted(lost, 'event')}: more than {MAX_EVENTS} waited")
        return packet


class ProcessMeter:
    """The load of this process."""

    def __init__(self, clock_s: Callable[[], float] = time.monotonic):
        self._clock_s = clock_s
        self.started_s = clock_s()
        self._then = (self.started_s, time.process_time())

    def values(self) -> dict[str, Any]:
        """Return uptime, processor time since the last call, and memory, by their names in the dictionary."""
        now = (self._clock_s(), time.process_time())
        elapsed_s = max(now[0] - self._then[0], 1e-9)
        cpu_percent = 100 * (now[1] - self._then[1]) / elapsed_s
        self._then = now
        pages = int(Path("/proc/self/statm").read_text().split()[1])
        return {
            "uptime_s": int(now[0] - self.started_s),
            "cpu_percent": cpu_percent,
            "rss_bytes": pages * os.sysconf("SC_PAGE_SIZE"),
        }


def disk_values(folder: Path, store_bytes: int) -> dict[str, int]:
    """Return the disk's values by their names in the dictionary."""
    try:
        free_bytes = shutil.disk_usage(folder).free
    except OSError:
        free_bytes = 0
    return {"store_bytes": store_bytes, "disk_free_bytes": free_bytes}
