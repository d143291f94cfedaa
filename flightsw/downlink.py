"""What goes down next: the outbox, oldest frame first, each until the ground says that it has stored it."""

import logging
import time
from collections.abc import Callable
from dataclasses import dataclass

from flightsw.errors import StoreError
from flightsw.icd.framing import PacketStream
from flightsw.icd.mission import Mission
from flightsw.icd.packet import APID_FILES, TELEMETRY
from flightsw.icd.transfer import Sender, timer_s
from flightsw.link import SerialLink
from flightsw.store import FrameStore

log = logging.getLogger(__name__)

WAIT_S = 0.02  # longest wait for the port before timers and outbox are looked at again
OUTBOX_S = 0.2  # between looks at the outbox, which another process may fill
RETRY_S = 5.0  # before a frame that cannot be read is tried again


@dataclass(frozen=True)
class DownlinkProgress:
    """Where the pass stands. All counts are of this run."""

    delivered: int = 0
    waiting: int = 0  # in the outbox, those in flight included
    in_flight: int = 0
    payload_bytes: int = 0  # of delivered frames
    bytes_sent: int = 0  # on the wire
    bytes_received: int = 0
    packets_sent: int = 0
    segments_sent: int = 0
    segments_resent: int = 0
    transfers_failed: int = 0  # put again afterwards
    frames_unreadable: int = 0
    skipped_bytes: int = 0  # received and not part of a good packet
    crc_errors: int = 0
    packets_missing: int = 0
    hang_ups: int = 0


def run_downlink(
    store: FrameStore,
    link: SerialLink,
    mission: Mission,
    exit_when_empty: bool = False,
    on_progress: Callable[[DownlinkProgress], None] = lambda progress: None,
    should_stop: Callable[[], bool] = lambda: False,
    clock_s: Callable[[], float] = time.monotonic,
) -> DownlinkProgress:
    """Send the outbox until told to stop, or until it is empty, and return the counts.

    A frame leaves the outbox only when the ground has reported it stored; a transfer that fails is put again.
    `on_progress` is called after each delivery and about five times a second.

    Raises:
        StoreError: the outbox cannot be read or changed.
    """
    downlink = _Downlink(store, link, mission)
    empty_since_s: float | None = None
    next_look_s = float("-inf")
    while not should_stop():
        now_s = clock_s()
        if now_s >= next_look_s:
            next_look_s = now_s + OUTBOX_S
            downlink.fill(now_s)
            on_progress(downlink.progress())
        if downlink.turn(now_s):
            downlink.fill(now_s)
            on_progress(downlink.progress())
        if downlink.waiting:
            empty_since_s = None
        elif empty_since_s is None:
            empty_since_s = now_s
        # stay a little: if our last acknowledgement is lost, the ground asks once more
        elif exit_when_empty and now_s - empty_since_s > downlink.interval_s:
            break
    return downlink.progress()


class _Downlink:
    def __init__(self, store: FrameStore, link: SerialLink, mission: Mission):
        self.interval_s = timer_s(link.baud_rate)
        self.waiting: list[int] = []
        self._store, self._link = store, link
        self._stream = PacketStream(TELEMETRY, APID_FILES, mission.link.max_packet_bytes)
        self._sender = Sender(self._stream.max_data_bytes, self.interval_s)
        self._retry_s: dict[int, float] = {}
        self._delivered = self._payload_bytes = self._failed = self._unreadable = 0

    def fill(self, now_s: float) -> None:
        """Put the oldest waiting frames in flight, as many as there is room for."""
        self.waiting = self._store.outbox()
        in_flight = set(self._sender.in_flight)
        for frame_id in self.waiting:
            name = f"{frame_id:08d}.obf"
            if not self._sender.has_room:
                break
            if name in in_flight or self._retry_s.get(frame_id, now_s) > now_s:
                continue
            try:
                container = self._store.read(frame_id)
            except StoreError as error:
                log.error("%s", error)
                self._unreadable += frame_id not in self._retry_s
                self._retry_s[frame_id] = now_s + RETRY_S
                continue
            self._sender.put(name, container, self._store.next_transaction(), now_s)

    def turn(self, now_s: float) -> bool:
        """Send and receive what the port takes and gives at once; tell whether a transfer ended."""
        pdu = self._sender.next_pdu(now_s) if self._link.ready else None
        if pdu is not None:
            self._link.write(self._stream.encode(pdu))
        data = self._link.exchange(WAIT_S if pdu is None else 0.0)
        for answer in self._stream.decode(data):
            self._sender.receive(answer, now_s)
        outcomes = self._sender.outcomes()
        for outcome in outcomes:
            frame_id = int(outcome.name.removesuffix(".obf"))
            if outcome.delivered:
                self._confirm(frame_id)
            else:
                self._failed += 1
                log.warning("frame %d: transfer failed (%s), put again", frame_id, outcome.reason)
        return bool(outcomes)

    def _confirm(self, frame_id: int) -> None:
        if frame_id in self.waiting:  # a late answer may confirm it twice
            self._store.mark_delivered(frame_id)
            self.waiting.remove(frame_id)
            size_bytes = self._store.path(frame_id).stat().st_size
            self._delivered += 1
            self._payload_bytes += size_bytes
            log.info("frame %d delivered, %d bytes, %d waiting", frame_id, size_bytes, len(self.waiting))

    def progress(self) -> DownlinkProgress:
        deframer = self._stream.deframer
        return DownlinkProgress(
            delivered=self._delivered,
            waiting=len(self.waiting),
            in_flight=len(self._sender.in_flight),
            payload_bytes=self._payload_bytes,
            bytes_sent=self._link.bytes_written,
            bytes_received=self._link.bytes_read,
            packets_sent=self._stream.packets_sent,
            segments_sent=self._sender.segments_sent,
            segments_resent=self._sender.segments_resent,
            transfers_failed=self._failed,
            frames_unreadable=self._unreadable,
            skipped_bytes=deframer.skipped_bytes,
            crc_errors=deframer.crc_errors,
            packets_missing=self._stream.packets_missing,
            hang_ups=self._link.hang_ups,
        )
