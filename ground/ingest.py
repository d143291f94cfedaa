"""From the wire to the session: receive, check, decode, write. Nothing the link brings ends the pass."""

import logging
import re
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from flightsw.icd.frame import decode_frame
from flightsw.icd.framing import PacketStream
from flightsw.icd.mission import Mission
from flightsw.icd.packet import APID_FILES, TELECOMMAND, PacketError
from flightsw.icd.transfer import Receiver, timer_s
from ground.link import SerialLink
from ground.session import SessionError, SessionWriter

log = logging.getLogger(__name__)

WAIT_S = 0.02  # longest wait for bytes before timers are looked at again
SAVE_S = 1.0  # between writes of session.json
FRAME_NAME = re.compile(r"(\d{8})\.obf", re.ASCII)  # any other name is refused: a name is no path
LINGER_INTERVALS = 4  # of silence before a sender with an open transfer counts as gone


@dataclass(frozen=True)
class ListenSummary:
    """What a pass brought. Counts are of this run, `frames_in_session` of all runs."""

    frames_received: int = 0
    frames_in_session: int = 0
    bytes_received: int = 0  # from the port
    payload_bytes: int = 0  # containers of frames_received
    open_transfers: int = 0
    skipped_bytes: int = 0  # not part of a good packet
    crc_errors: int = 0  # packets damaged on the wire
    packets_missing: int = 0  # gaps in the sequence count
    packets_foreign: int = 0
    segments_resent: int = 0
    pdus_refused: int = 0
    frames_rejected: int = 0  # arrived whole, but no usable frame
    duplicates: int = 0  # frames that came again
    store_failures: int = 0  # disk refused; the flight side keeps the frame
    hang_ups: int = 0

    @property
    def losses(self) -> dict[str, int]:
        """The counts that session.json keeps."""
        names = (
            "skipped_bytes crc_errors packets_missing packets_foreign segments_resent pdus_refused "
            "frames_rejected duplicates store_failures hang_ups"
        )
        return {name: getattr(self, name) for name in names.split()}


def listen(
    link_url: str,
    session_dir: str | Path,
    mission: Mission,
    exit_after: int | None = None,
    idle_timeout_s: float | None = None,
    on_progress: Callable[[ListenSummary], None] = lambda summary: None,
    should_stop: Callable[[], bool] = lambda: False,
    clock_s: Callable[[], float] = time.monotonic,
) -> ListenSummary:
    """Write what comes over the link into a session, new or continued, and return the counts.

    Ends when told to stop, when the session holds `exit_after` frames, or when no packet has come for
    `idle_timeout_s`. `on_progress` is called after each frame and about once a second.

    Raises:
        ConfigError: the URL is not usable.
        LinkError: the port cannot be opened.
        SessionError: the folder cannot be used as this mission's session.
    """
    with SerialLink(link_url) as link:
        writer = SessionWriter(session_dir, mission)
        ingest = _Ingest(link, writer, mission)
        interval_s = timer_s(link.baud_rate)
        last_packet_s = last_save_s = clock_s()
        while not should_stop():
            now_s = clock_s()
            frames_before = ingest.frames_received
            if ingest.turn(now_s):
                last_packet_s = now_s
            if ingest.frames_received > frames_before or now_s - last_save_s >= SAVE_S:
                on_progress(ingest.summary())
            if now_s - last_save_s >= SAVE_S:
                last_save_s = now_s
                ingest.save()
            if idle_timeout_s is not None and now_s - last_packet_s > idle_timeout_s:
                log.info("no packet for %.1f s", idle_timeout_s)
                break
            if exit_after is not None and writer.frame_count >= exit_after:
                # the flight side must hear that its last frames are stored, if it is still there
                quiet_s = now_s - last_packet_s
                if not ingest.open_transfers or quiet_s > LINGER_INTERVALS * interval_s:
                    break
        ingest.save()
        on_progress(ingest.summary())
        return ingest.summary()


class _Ingest:
    def __init__(self, link: SerialLink, writer: SessionWriter, mission: Mission):
        self.frames_received = 0
        self._link, self._writer = link, writer
        self._stream = PacketStream(TELECOMMAND, APID_FILES, mission.link.max_packet_bytes)
        self._receiver = Receiver(self._stream.max_data_bytes, timer_s(link.baud_rate), self._accept)
        self._payload_bytes = self._rejected = self._duplicates = self._store_failures = 0

    @property
    def open_transfers(self) -> int:
        return self._receiver.open_transactions

    def turn(self, now_s: float) -> bool:
        """Take what came and send what is due; tell whether a good packet came."""
        packets = self._stream.decode(self._link.exchange(WAIT_S))
        for pdu in packets:
            self._receiver.receive(pdu, now_s)
        while self._link.ready and (pdu := self._receiver.next_pdu(now_s)) is not None:
            self._link.write(self._stream.encode(pdu))
        return bool(packets)

    def _accept(self, name: str, container: bytes) -> bool:
        """Store a file that came whole; False only when it is worth sending again.

        What is no frame of this mission would be none the next time: it is counted and not asked for again.
        The flight side's store still has it.
        """
        try:
            match = FRAME_NAME.fullmatch(name)
            frame = decode_frame(container)
            if match is None or int(match[1]) != frame.frame_id:
                raise PacketError(f"frame {frame.frame_id} came under the name {name[:40]!r}")
            is_new = self._writer.add(frame, container)
        except (PacketError, SessionError) as error:
            self._rejected += 1
            log.warning("frame rejected: %s", error)
            return True
        except OSError as error:
            self._store_failures += 1
            log.error("frame %s cannot be written, the flight side keeps it: %s", name, error)
            return False
        if is_new:
            self.frames_received += 1
            self._payload_bytes += len(container)
            log.info("frame %d: %d bytes", frame.frame_id, len(container))
        else:
            self._duplicates += 1
            log.info("frame %d came again", frame.frame_id)
        return True

    def save(self) -> None:
        summary = self.summary()
        try:
            self._writer.save(summary.losses, summary.bytes_received)
        except OSError as error:
            log.error("session.json cannot be written: %s", error)

    def summary(self) -> ListenSummary:
        deframer = self._stream.deframer
        return ListenSummary(
            frames_received=self.frames_received,
            frames_in_session=self._writer.frame_count,
            bytes_received=self._link.bytes_read,
            payload_bytes=self._payload_bytes,
            open_transfers=self.open_transfers,
            skipped_bytes=deframer.skipped_bytes,
            crc_errors=deframer.crc_errors,
            packets_missing=self._stream.packets_missing,
            packets_foreign=self._stream.packets_foreign,
            segments_resent=self._receiver.segments_resent,
            pdus_refused=self._receiver.pdus_refused,
            frames_rejected=self._rejected,
            duplicates=self._duplicates,
            store_failures=self._store_failures,
            hang_ups=self._link.hang_ups,
        )
