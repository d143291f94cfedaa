"""From the link to the session: receive, check, decode, write. Nothing that arrives can end the pass."""

import contextlib
import logging
import re
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from logging.handlers import RotatingFileHandler
from pathlib import Path
from typing import Any

import imagecodecs

from flightsw.icd.frame import Frame, decode_frame, saturated_again
from flightsw.icd.link.auth import Key
from flightsw.icd.link.can import GROUND_SIDE
from flightsw.icd.link.framing import PacketStream
from flightsw.icd.mission import Mission
from flightsw.icd.packet import (
    APID_COMMANDS,
    APID_FILES,
    APID_HOUSEKEEPING,
    APID_UPLINK_FILES,
    TELECOMMAND,
    PacketError,
)
from flightsw.icd.transfer import Incoming, Receiver, Verdict, answer_key, timer_s
from flightsw.ports import Link, open_link
from ground.link.forward import Forwarder
from ground.link.uplink import Uplinker, listening
from ground.session.folder import SessionError
from ground.session.telemetry import TelemetryLog, refusal
from ground.session.writer import SessionWriter
from obbgs_base.errors import in_words, reason
from obbgs_base.files import write_whole

log = logging.getLogger(__name__)

WAIT_S = 0.02  # longest wait for bytes before timers are checked again
SAVE_S = 1.0  # between writes of session.json
STATUS_S = 0.25  # between updates of the console
LOG, MAX_LOG_BYTES = "listener.log", 1 << 20  # in the session; the one before is kept as listener.log.1
# A frame (.obf) or thumbnail (.obt) by its number. Other names are refused, so that none can act as a path.
FILE_NAME = re.compile(r"(\d{8})\.(obf|obt)", re.ASCII)
# In intervals of the transfer timer, once the session holds all frames that were asked for:
LINGER_INTERVALS = 4  # without a packet, after which the spacecraft counts as gone
SETTLE_INTERVALS = 12  # for the spacecraft to learn that all its frames have arrived


@dataclass(frozen=True)
class ListenSummary:
    """What a pass brought. Counts are of this run, except `frames_in_session` and `frames_captured`: of all runs."""

    frames_received: int = 0
    frames_in_session: int = 0
    frames_captured: int | None = None  # as the spacecraft's telemetry said; None before the first
    thumbnails_received: int = 0
    headers_received: int = 0  # frame headers, which come as telemetry
    bytes_received: int = 0  # from the port
    bytes_sent: int = 0
    packets_received: int = 0
    packets_forwarded: int = 0  # to another ground system
    payload_bytes: int = 0  # containers of frames_received
    open_transfers: int = 0
    commands_ended: int = 0
    joined_bytes: int = 0  # the rest of a packet that was under way when listening began
    skipped_bytes: int = 0  # not part of a good packet
    crc_errors: int = 0  # packets damaged on the wire
    packets_missing: int = 0  # gaps in the sequence counts
    packets_foreign: int = 0
    telemetry_refused: int = 0  # intact packets that the dictionary does not know
    segments_resent: int = 0
    pdus_refused: int = 0
    frames_rejected: int = 0  # arrived intact, but not a usable frame or thumbnail
    duplicates: int = 0  # frames that came again
    store_failures: int = 0  # the disk refused them; the spacecraft keeps the frames
    hang_ups: int = 0
    packets_not_forwarded: int = 0  # that this machine dropped, or the other host refused
    link_losses: dict[str, int] = field(default_factory=dict)  # counts of the link itself, by name

    @property
    def losses(self) -> dict[str, int]:
        """The counts that go to session.json."""
        names = (
            "skipped_bytes crc_errors packets_missing packets_foreign telemetry_refused segments_resent "
            "pdus_refused frames_rejected duplicates store_failures hang_ups packets_not_forwarded"
        )
        return {name: getattr(self, name) for name in names.split()} | self.link_losses


@dataclass(frozen=True)
class Status:
    """The state of a pass, as the console shows it."""

    now_s: float
    summary: ListenSummary
    connected: bool  # the port is open
    quiet_s: float  # since the last good packet
    incoming: list[Incoming]
    housekeeping: dict[str, Any]  # the newest, {} before the first
    housekeeping_age_s: float
    frame_header: dict[str, Any]
    events: list[dict[str, Any]]
    commands: list[tuple[int, str, str]]  # counter, name and stage of those without a result
    model: dict[str, Any] | None = (
        None  # a `LiveStatus`; {}: the training starts; None: no model is made meanwhile
    )


def listen(
    link_url: str,
    session_dir: str | Path,
    mission: Mission,
    exit_after: int | None = None,
    idle_timeout_s: float | None = None,
    on_progress: Callable[[ListenSummary], None] = lambda summary: None,
    should_stop: Callable[[], bool] = lambda: False,
    clock_s: Callable[[], float] = time.monotonic,
    on_status: Callable[[Status], None] = lambda status: None,
    on_event: Callable[[dict[str, Any]], None] = lambda event: None,
    forward: Forwarder | None = None,
    key: Key | None = None,
) -> ListenSummary:
    """Write what arrives over the link into a new or existing session and return the counts.

    Commands that `ground uplink` leaves in the session are sent. Ends when `should_stop` returns True, when the session
    holds `exit_after` frames, or when no packet has come for `idle_timeout_s`. `on_progress` is called after each frame
    and about once a second, `on_status` four times a second, `on_event` for each event as it comes. `forward` is
    given every packet of the spacecraft. `key` authenticates the answers by which frames leave the spacecraft's outbox;
    a spacecraft with a key takes no others.

    Raises:
        ConfigError: the URL is not valid.
        LinkError: the port cannot be opened.
        SessionError: the folder cannot be used as this mission's session, or another process listens into it.
    """
    with open_link(link_url, GROUND_SIDE) as link, listening(Path(session_dir)), _logged(Path(session_dir)):
        writer = SessionWriter(session_dir, mission)
        ingest = _Ingest(link, writer, mission, on_event, forward, key)
        interval_s = timer_s(link.baud_rate)
        now_s = clock_s()
        ingest.last_packet_s = last_save_s = last_status_s = now_s
        complete_s: float | None = None  # when the session first held all frames asked for
        while not should_stop():
            now_s = clock_s()
            frames_before = ingest.frames_received
            ingest.turn(now_s)
            if ingest.frames_received > frames_before or now_s - last_save_s >= SAVE_S:
                on_progress(ingest.summary())
            if now_s - last_save_s >= SAVE_S:
                last_save_s = now_s
                ingest.save()
            if now_s - last_status_s >= STATUS_S:
                last_status_s = now_s
                on_status(ingest.status(now_s))
            if idle_timeout_s is not None and now_s - ingest.last_packet_s > idle_timeout_s:
                log.info("no packet for %.1f s", idle_timeout_s)
                break
            if exit_after is not None and writer.frame_count >= exit_after:
                # If the spacecraft is still there, it must learn that its last frames are stored.
                complete_s = now_s if complete_s is None else complete_s
                is_told = ingest.flight_outbox == 0 and not ingest.open_transfers
                is_gone = now_s - ingest.last_packet_s > LINGER_INTERVALS * interval_s
                if is_told or is_gone or now_s - complete_s > SETTLE_INTERVALS * interval_s:
                    break
        ingest.turn(clock_s())  # what lies in the port already is not lost
        ingest.save()
        on_progress(ingest.summary())
        on_status(ingest.status(now_s))
        return ingest.summary()


@contextlib.contextmanager
def _logged(session_dir: Path) -> Iterator[None]:
    """Have warnings and errors kept in the session too, as far as its disk takes them."""
    handler = RotatingFileHandler(session_dir / LOG, maxBytes=MAX_LOG_BYTES, backupCount=1, delay=True)
    handler.setLevel(logging.WARNING)
    handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(name)s: %(message)s"))
    handler.handleError = lambda record: None
    logger = logging.getLogger()
    logger.addHandler(handler)
    try:
        yield
    finally:
        logger.removeHandler(handler)
        with contextlib.suppress(OSError):
            handler.close()


class _Ingest:
    """Receives packets, hands each to its receiver, and sends what they have to answer."""

    def __init__(
        self,
        link: Link,
        writer: SessionWriter,
        mission: Mission,
        on_event: Callable[[dict[str, Any]], None],
        forward: Forwarder | None,
        key: Key | None = None,
    ):
        self.frames_received = 0
        self.last_packet_s = self._housekeeping_s = float("-inf")
        # frames still to come, as housekeeping said after the last frame
        self.flight_outbox: int | None = None
        self._link, self._writer, self._on_event, self._forward = link, writer, on_event, forward
        self._stream = PacketStream(TELECOMMAND, mission.link.max_packet_bytes)
        if forward is not None:
            self._stream.on_packet = forward.send
        interval_s, max_pdu_bytes = timer_s(link.baud_rate), self._stream.max_data_bytes
        self._receiver = Receiver(
            max_pdu_bytes,
            interval_s,
            self._accept,
            mission.camera.max_container_bytes,
            checksum=mission.link.checksum,
            key=None if key is None else answer_key(key),
        )
        self._uplinker = Uplinker(
            writer.folder, max_pdu_bytes, interval_s, self._note_end, checksum=mission.link.checksum
        )
        self._telemetry = TelemetryLog(
            writer.folder,
            on_event,
            lambda report: self._uplinker.take_report(report, self.last_packet_s),
            flight=writer.flight,
        )
        self._thumbnails = self._commands_ended = 0
        self._payload_bytes = self._rejected = self._duplicates = self._store_failures = 0

    @property
    def open_transfers(self) -> int:
        return self._receiver.open_transactions

    def turn(self, now_s: float) -> None:
        """Receive what has come and send what is due: acknowledgements, then commands, then a piece of a model."""
        wait_s = 0.0 if self._uplinker.is_sending_file and self._link.ready else WAIT_S
        for apid, content in self._stream.decode(self._link.exchange(wait_s)):
            self.last_packet_s = now_s
            if apid == APID_FILES:
                self._receiver.receive(content, now_s)
            elif apid == APID_UPLINK_FILES:
                self._uplinker.files.receive(content, now_s)
            else:
                self._telemetry.add(apid, content)
                if apid == APID_HOUSEKEEPING:
                    self._housekeeping_s = now_s
                    self.flight_outbox = self._telemetry.housekeeping.get("outbox_frames")
        while self._link.ready and (pdu := self._receiver.next_pdu(now_s)) is not None:
            self._link.write(self._stream.encode(APID_FILES, pdu))
        if self._link.ready and (command := self._uplinker.next_command(now_s)) is not None:
            self._link.write(self._stream.encode(APID_COMMANDS, command))
        if self._link.ready and (pdu := self._uplinker.next_pdu(now_s)) is not None:
            self._link.write(self._stream.encode(APID_UPLINK_FILES, pdu))

    def _accept(self, name: str, container: bytes) -> Verdict:
        """Store a file that has arrived whole, and say what became of it.

        A file that is not a frame of this mission would not be one the next time either: it is counted and rejected,
        and the spacecraft keeps it. UNSTORED: it should be sent again, because the disk failed.
        """
        try:
            match = FILE_NAME.fullmatch(name)
            frame = decode_frame(container)
            if match is None or int(match[1]) != frame.frame_id:
                raise PacketError(f"frame {frame.frame_id} has the file name {name[:40]!r}")
            if match[2] == "obt":
                self._keep_thumbnail(frame)
                return Verdict.STORED
            self.flight_outbox = None
            is_new = self._writer.add(saturated_again(frame, container), container)
        except (PacketError, SessionError) as error:
            self._rejected += 1
            log.warning("frame rejected, the spacecraft keeps it: %s", error)
            return Verdict.REJECTED
        except OSError as error:
            self._store_failures += 1
            log.error("frame %s cannot be written, the spacecraft keeps it: %s", name, reason(error))
            return Verdict.UNSTORED
        if is_new:
            self.frames_received += 1
            self._payload_bytes += len(container)
            log.info("frame %d: %d bytes", frame.frame_id, len(container))
        else:
            self._duplicates += 1
            log.info("frame %d was received before", frame.frame_id)
        return Verdict.STORED

    def _keep_thumbnail(self, frame: Frame) -> None:
        """Write a thumbnail as a 16-bit linear PNG like the frames; it is a few dozen pixels wide."""
        folder = self._writer.folder / "thumbnails"
        folder.mkdir(exist_ok=True)
        write_whole(folder / f"{frame.frame_id:06d}.png", bytes(imagecodecs.png_encode(frame.dn, level=1)))
        self._thumbnails += 1

    def _note_end(self, counter: int, command: str, stage: str, text: str) -> None:
        self._commands_ended += 1
        severity = "info" if stage == "completed" else "warning"
        line = {
            "event": "command",
            "severity": severity,
            "text": f"command {counter}, {command}, {stage}: {text}",
        }
        line["problem"] = refusal(counter, text)
        self._telemetry.events.append({"received_utc_ns": time.time_ns()} | line)
        self._on_event(self._telemetry.events[-1])

    def save(self) -> None:
        summary = self.summary()
        try:
            self._writer.save(summary.losses, summary.bytes_received, self._telemetry.flight)
        except OSError as error:
            log.error("session.json cannot be written: %s", in_words(error))

    def status(self, now_s: float) -> Status:
        telemetry = self._telemetry
        return Status(
            now_s=now_s,
            summary=self.summary(),
            connected=self._link.connected,
            quiet_s=now_s - self.last_packet_s,
            incoming=self._receiver.incoming(),
            housekeeping=telemetry.housekeeping,
            housekeeping_age_s=now_s - self._housekeeping_s,
            frame_header=telemetry.frame_header,
            events=list(telemetry.events),
            commands=[(job.counter, job.command, job.stage) for job in self._uplinker.jobs.values()],
        )

    def summary(self) -> ListenSummary:
        deframer, flight = self._stream.deframer, self._telemetry.flight
        return ListenSummary(
            frames_received=self.frames_received,
            frames_in_session=self._writer.frame_count,
            frames_captured=flight.captured(self._writer.last_frame_id) if flight else None,
            thumbnails_received=self._thumbnails,
            headers_received=self._telemetry.headers_received,
            bytes_received=self._link.bytes_read,
            bytes_sent=self._link.bytes_written,
            packets_received=self._stream.packets_received,
            payload_bytes=self._payload_bytes,
            open_transfers=self.open_transfers,
            commands_ended=self._commands_ended,
            joined_bytes=deframer.joined_bytes,
            skipped_bytes=deframer.skipped_bytes,
            crc_errors=deframer.crc_errors,
            packets_missing=self._stream.packets_missing,
            packets_foreign=self._stream.packets_foreign,
            telemetry_refused=self._telemetry.refused,
            segments_resent=self._receiver.segments_resent,
            pdus_refused=self._receiver.pdus_refused,
            frames_rejected=self._rejected,
            duplicates=self._duplicates,
            store_failures=self._store_failures + self._telemetry.write_failures,
            hang_ups=self._link.hang_ups,
            packets_forwarded=self._forward.sent if self._forward else 0,
            packets_not_forwarded=self._forward.dropped if self._forward else 0,
            link_losses=self._link.losses,
        )
