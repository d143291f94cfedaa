"""Telemetry, events and command reports as they come: kept with the session, and the newest at hand."""

import json
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Any

from flightsw.icd.command import Report
from flightsw.icd.frame import read_header
from flightsw.icd.packet import (
    APID_EVENTS,
    APID_FRAME_HEADERS,
    APID_HOUSEKEEPING,
    APID_REPORTS,
    PacketError,
)
from flightsw.icd.telemetry import DICTIONARY

EVENTS_KEPT = 200  # in memory; the file has all


class TelemetryLog:
    """Writes telemetry.jsonl, events.jsonl and reports.jsonl below a session; nothing that comes raises.

    `on_event` is given each event's line: event, severity, text and its values.
    """

    def __init__(
        self,
        folder: Path,
        on_event: Callable[[dict[str, Any]], None] = lambda event: None,
        on_report: Callable[[Report], None] = lambda report: None,
        utc_ns: Callable[[], int] = time.time_ns,
    ):
        self.refused = 0  # whole packets that the dictionary does not know
        self.write_failures = 0
        self.housekeeping: dict[str, Any] = {}  # the newest, {} before the first
        self.housekeeping_utc_ns = 0  # when it came
        self.frame_header: dict[str, Any] = {}
        self.headers_received = 0
        self.events: deque[dict[str, Any]] = deque(maxlen=EVENTS_KEPT)
        self._folder, self._on_event, self._on_report, self._utc_ns = folder, on_event, on_report, utc_ns

    def add(self, apid: int, data: bytes) -> None:
        """Take a packet's data from the link."""
        received = {"received_utc_ns": self._utc_ns()}
        try:
            if apid == APID_HOUSEKEEPING:
                layout, values = DICTIONARY.unpack("telemetry", data)
                self.housekeeping, self.housekeeping_utc_ns = values, received["received_utc_ns"]
                self._write("telemetry.jsonl", received | {"packet": layout.name} | values)
            elif apid == APID_FRAME_HEADERS:
                self.frame_header = read_header(data)
                self.headers_received += 1
                self._write("telemetry.jsonl", received | {"packet": "frame"} | self.frame_header)
            elif apid == APID_EVENTS:
                layout, values = DICTIONARY.unpack("events", data)
                event = {"event": layout.name, "severity": layout.severity, "text": layout.sentence(values)}
                self.events.append(received | event | values)
                self._write("events.jsonl", self.events[-1])
                self._on_event(plain(self.events[-1]))
            elif apid == APID_REPORTS:
                report = Report.unpack(data)
                self._write("reports.jsonl", received | vars(report))
                self._on_report(report)
            else:
                raise PacketError(f"no telemetry has APID 0x{apid:03X}")
        except PacketError:
            self.refused += 1

    def _write(self, name: str, line: dict[str, Any]) -> None:
        """Add a line. A line cut off by a power cut stands alone: the next one starts on a line of its own."""
        try:
            with open(self._folder / name, "ab+") as file:
                if file.tell():
                    file.seek(-1, 2)
                    if file.read(1) != b"\n":
                        file.write(b"\n")
                file.write(json.dumps(plain(line), allow_nan=False).encode() + b"\n")
        except OSError:
            self.write_failures += 1


def plain(line: dict[str, Any]) -> dict[str, Any]:
    """Return the values as JSON has them: bytes in hexadecimal."""
    return {name: value.hex() if isinstance(value, bytes) else value for name, value in line.items()}
