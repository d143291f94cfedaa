"""Receives telemetry, events and command reports, keeps them with the session and the newest ones in memory."""

import dataclasses
import time
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

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
from obbgs_base.checked import checked_line

EVENTS_KEPT = 200  # in memory; the file has all
EARLIER_COUNTS = ("run_utc_ns", "run_uptime_s")
# from here on the number of a start is drawn at random (flightsw/storage/boot_counter.py)
DRAWN_BOOTS = 1 << 31


@dataclass(frozen=True)
class FlightCounts:
    """What telemetry has said of the frames on board, over all runs of flight and ground software; counts never fall.

    Telemetry may be lost: more frames may have been taken since it was last received.
    """

    frames_stored: int = 0  # ever stored, deleted ones too: numbers start at 0 and are never used twice
    frames_refused: int = 0  # taken, but not stored for lack of room
    frames_failed: int = 0  # exposures that gave no frame
    frames_dropped: int = 0  # stored, then deleted before delivery to make room
    # The newest start of flight software that was heard of, and its counts, which begin at that start.
    run_boot: int = 0
    run_refused: int = 0
    run_failed: int = 0

    @classmethod
    def from_tree(cls, tree: Mapping[str, Any]) -> Self:
        """Return the counts in a session's header; earlier versions told starts of flight software apart by clocks.

        Raises:
            TypeError, ValueError: they are none.
        """
        return cls(**{name: value for name, value in tree.items() if name not in EARLIER_COUNTS})

    def __post_init__(self):
        for name, value in vars(self).items():
            if type(value) is not int or value < 0:
                raise ValueError(f"flight.{name} must be a count, got {value!r}")

    def captured(self, last_frame_id: int = -1) -> int:
        """Return how many frames were taken; `last_frame_id` is the highest number received, -1 for none."""
        return max(self.frames_stored, last_frame_id + 1) + self.frames_refused

    def after_header(self, frame_id: int) -> "FlightCounts":
        """Return the counts after the header of a frame was received."""
        return dataclasses.replace(self, frames_stored=max(self.frames_stored, frame_id + 1))

    def after_housekeeping(self, values: Mapping[str, Any]) -> "FlightCounts":
        """Return the counts after a housekeeping packet.

        Starts of flight software are told apart by their number `boot`, whatever its clock says; a packet of an earlier
        start comes late and adds nothing to what that start's later ones said. Frames that were deleted after delivery
        are not counted here; they are known by the numbers in their headers.
        """
        boot, refused, failed = values.get("boot", 0), values["frames_refused"], values["frames_failed"]
        before_refused = before_failed = 0
        if boot == self.run_boot:
            before_refused, before_failed = self.run_refused, self.run_failed
            refused, failed = max(refused, before_refused), max(failed, before_failed)
        elif self._is_late(boot):
            boot, refused, failed = self.run_boot, self.run_refused, self.run_failed
            before_refused, before_failed = refused, failed
        return FlightCounts(
            frames_stored=max(self.frames_stored, values["frames_stored"] + values["frames_dropped"]),
            frames_refused=self.frames_refused + refused - before_refused,
            frames_failed=self.frames_failed + failed - before_failed,
            frames_dropped=max(self.frames_dropped, values["frames_dropped"]),
            run_boot=boot,
            run_refused=refused,
            run_failed=failed,
        )

    def _is_late(self, boot: int) -> bool:
        """Tell whether a start was before the newest one. Numbers that were drawn at random have no order."""
        return boot < self.run_boot < DRAWN_BOOTS


class TelemetryLog:
    """Writes telemetry.jsonl, events.jsonl and reports.jsonl in a session folder; no packet makes it raise.

    `on_event` receives each event's line: event, severity, text and its values. An event that comes again, because the
    spacecraft did not know whether it had arrived, is taken once.
    """

    def __init__(
        self,
        folder: Path,
        on_event: Callable[[dict[str, Any]], None] = lambda event: None,
        on_report: Callable[[Report], None] = lambda report: None,
        utc_ns: Callable[[], int] = time.time_ns,
        flight: FlightCounts | None = None,
    ):
        self.flight = flight  # also from earlier runs of ground software; None before any telemetry
        self.refused = 0  # intact packets that the dictionary does not know
        self.write_failures = 0
        self.housekeeping: dict[str, Any] = {}  # the newest, {} before the first
        self.frame_header: dict[str, Any] = {}
        self.headers_received = 0
        self.events: deque[dict[str, Any]] = deque(maxlen=EVENTS_KEPT)
        self._known_events: deque[bytes] = deque(
            maxlen=2 * EVENTS_KEPT
        )  # as many as the spacecraft may repeat
        self._folder, self._on_event, self._on_report, self._utc_ns = folder, on_event, on_report, utc_ns

    def add(self, apid: int, data: bytes) -> None:
        """Take the data of a packet from the link."""
        received = {"received_utc_ns": self._utc_ns()}
        try:
            if apid == APID_HOUSEKEEPING:
                layout, values = DICTIONARY.unpack("telemetry", data)
                self.housekeeping = values
                self.flight = (self.flight or FlightCounts()).after_housekeeping(values)
                self._write("telemetry.jsonl", received | {"packet": layout.name} | values)
            elif apid == APID_FRAME_HEADERS:
                self.frame_header = read_header(data)
                self.headers_received += 1
                self.flight = (self.flight or FlightCounts()).after_header(self.frame_header["frame_id"])
                self._write("telemetry.jsonl", received | {"packet": "frame"} | self.frame_header)
            elif apid == APID_EVENTS:
                layout, values = DICTIONARY.unpack("events", data)
                if data in self._known_events:
                    return
                self._known_events.append(data)
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
        """Append a line with its checksum; after a line left unfinished by a power cut it starts a new one."""
        try:
            with open(self._folder / name, "ab+") as file:
                if file.tell():
                    file.seek(-1, 2)
                    if file.read(1) != b"\n":
                        file.write(b"\n")
                file.write(checked_line(plain(line)) + b"\n")
        except OSError:
            self.write_failures += 1


def refusal(counter: int, text: str) -> str:
    """Return the problem of the spacecraft's event about a refused command, which its report tells as well."""
    return f"counter {counter}: {text}"


def plain(line: dict[str, Any]) -> dict[str, Any]:
    """Return values that JSON can hold: bytes become hexadecimal text."""
    return {name: value.hex() if isinstance(value, bytes) else value for name, value in line.items()}
