"""The flight side of the link: frames until the ground has stored them, telemetry at once, commands as they come."""

import contextlib
import logging
import time
from collections import deque
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from typing import Any

from flightsw.clock import utc_ns
from flightsw.downlink.commands import Commander, KeyRing, Upload
from flightsw.downlink.frame_sender import FrameSender, SendingCounts
from flightsw.downlink.housekeeping import EventLog, ProcessMeter, disk_values
from flightsw.errors import DownlinkError, FlightError, StoreError
from flightsw.icd.frame import HEADER, header_of, read_header
from flightsw.icd.link.framing import PacketStream
from flightsw.icd.mission import Mission
from flightsw.icd.packet import (
    APID_COMMANDS,
    APID_EVENTS,
    APID_FILES,
    APID_FRAME_HEADERS,
    APID_HOUSEKEEPING,
    APID_REPORTS,
    APID_UPLINK_FILES,
    TELEMETRY,
    PacketError,
)
from flightsw.icd.telemetry import DICTIONARY
from flightsw.icd.transfer import UPLINK, Receiver, answer_key, timer_s
from flightsw.ports import Link
from flightsw.storage.settings import Settings, load_settings
from flightsw.storage.store import FrameStore
from flightsw.triage.ranking import Ranking
from flightsw.triage.worker import ModelVerified
from obbgs_base.errors import in_words

log = logging.getLogger(__name__)

WAIT_S = 0.02  # longest wait for the port before timers and outbox are looked at again
OUTBOX_S = 0.2  # between looks at the outbox, which another process may fill
LINK_OVER_LOOK = 4.0  # the least that the link has of the time, over what looks at a slow disk take
STORE_RETRY_S = 5.0  # between attempts at a store that cannot be read
FRAMES_A_LOOK = 256  # queued, more than are sent between two looks: what waits in all does not matter
VIEWS_A_LOOK = 100
HEADERS_A_LOOK = 20  # frame headers queued at once: a full outbox must not hold the files back
LAST_TELEMETRY_S = 0.5  # for sending the last telemetry at the end
RESTART_S = 0.5  # from a failure to the new start
RESTARTS = 5  # in a row, and no more
SOUND_S = 60.0  # a downlink that ran for so long was in order: its next failure is the first in a row
REFUSAL_S = 1.0  # between events of refused commands, which any sender can cause; all are counted


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
    frames_rejected: int = 0  # by the ground, and kept
    rejected_waiting: int = 0  # of those that wait
    skipped_bytes: int = 0  # received and not part of a good packet
    crc_errors: int = 0
    packets_missing: int = 0
    hang_ups: int = 0
    commands_accepted: int = 0
    commands_refused: int = 0
    commands_repeated: int = 0
    restarts: int = 0  # after failures


def run_downlink(
    store: FrameStore,
    link: Link,
    mission: Mission,
    exit_when_empty: bool = False,
    on_progress: Callable[[DownlinkProgress], None] = lambda progress: None,
    should_stop: Callable[[], bool] = lambda: False,
    clock_s: Callable[[], float] = time.monotonic,
    keys: KeyRing | None = None,
    capture_values: Callable[[], dict[str, Any]] = dict,
    boot: int = 0,
    events: EventLog | None = None,
    store_may_open: Callable[[], bool] = lambda: True,
) -> DownlinkProgress:
    """Send the outbox until told to stop, or until the ground has or rejects all of it, and return the counts.

    A frame leaves the outbox only when the ground has reported it stored; a transfer that fails is put again.
    `on_progress` is called after each delivery and about five times a second. After a failure the downlink starts again
    from what is on the disk, with an event to the ground; nothing on board may end the link while frames wait. Without
    a store that can be read, telemetry is sent and commands are obeyed all the same; an event says why, and it is tried
    again every `STORE_RETRY_S`.

    Args:
        keys: the keys and their replay counters; without one every command is refused.
        capture_values: what capture knows of the housekeeping packet's items.
        boot: the number of this start of the flight software, for the housekeeping packet.
        events: where the flight software's warnings are already going; a new one without it.
        store_may_open: whether a store that is not open yet may be opened, which takes long where it is to be repaired.

    Raises:
        DownlinkError: an unforeseen error, six times in a row.
    """
    events = events or EventLog(clock_s=clock_s)
    downlink = _Downlink(store, link, mission, keys, capture_values, clock_s, boot, events)
    logger = logging.getLogger("flightsw")
    logger.addHandler(downlink.events)
    for problem in keys.problems if keys is not None else ():
        log.error("no command is taken with a key: %s", problem)
    try:
        empty_since_s: float | None = None
        next_look_s = float("-inf")
        while not should_stop():
            now_s = clock_s()
            try:
                if now_s >= next_look_s:
                    utc_ns()  # so that a step of the clock is seen, and told, soon
                    is_open = downlink.store_is_open(now_s, store_may_open)
                    if is_open:
                        downlink.look(now_s)
                    on_progress(downlink.progress())
                    looked_s = clock_s()
                    # Where a look takes long, most of the time is the link's all the same. At the start another thread
                    # opens the store, and the first frame goes out as soon as it is open.
                    pause_s = max(OUTBOX_S, LINK_OVER_LOOK * (looked_s - now_s)) if is_open else WAIT_S
                    next_look_s = looked_s + pause_s
                if downlink.turn(now_s):
                    on_progress(downlink.progress())
                downlink.fill(now_s)
            except Exception as error:  # the outermost loop of the downlink's thread
                downlink.start_again(error)
                next_look_s = float("-inf")
                continue
            if len(downlink.waiting) > downlink.rejected_waiting or not store.is_open:
                empty_since_s = None
            elif empty_since_s is None:
                empty_since_s = now_s
            # stay a little: if our last acknowledgement is lost, the ground asks once more
            elif exit_when_empty and now_s - empty_since_s > downlink.interval_s:
                break
        downlink.send_last_telemetry()
    finally:
        logger.removeHandler(downlink.events)
        downlink.stop()
    return downlink.progress()


class _Downlink:
    """One side of the link: what is sent and received at each turn. What must survive a restart is kept here."""

    def __init__(
        self,
        store: FrameStore,
        link: Link,
        mission: Mission,
        keys: KeyRing | None,
        capture_values: Callable[[], dict[str, Any]],
        clock_s: Callable[[], float],
        boot: int,
        events: EventLog,
    ):
        self.interval_s = timer_s(link.baud_rate)
        self.events = events
        self._store, self._link, self._mission, self._clock_s = store, link, mission, clock_s
        self._capture_values, self._boot = capture_values, boot
        self._stream = PacketStream(TELEMETRY, mission.link.max_packet_bytes)
        self._key_ring = keys or KeyRing([])
        self._answer_keys: list[bytes] = []
        self._renew_answer_keys()
        self._commander = Commander(keys, store, mission, self._note_refusal, clock_s)
        self._meter = ProcessMeter(clock_s)
        self._telemetry: deque[tuple[int, bytes]] = deque()
        self._next_housekeeping_s = self._next_refusal_s = float("-inf")
        self._announced: set[int] = set()  # and those still to be, over restarts
        self._to_announce: deque[int] = deque()
        self._store_retry_s = float("-inf")
        self._has_store = False  # since the store is open, here or by who owns it
        self._store_problem = ""  # of which the ground was told last
        self._counts = SendingCounts()
        self._restarts = self._restarts_in_a_row = 0
        self._told_start = False
        self._start()
        if store.is_open:
            self._tell_start()

    def _tell_start(self) -> None:
        """Tell the ground once that flight has started, as soon as it is known what is on the disk."""
        if not self._told_start:
            self._told_start = True
            self.events.add("started", frames_stored=self._store.frame_count, outbox_frames=len(self.waiting))

    def _start(self) -> None:
        """Begin with what is on the disk: no file in flight, no frame ranked."""
        store = self._store
        self._started_s = self._clock_s()
        self._ranking = Ranking(store, self._mission.camera, self._clock_s)
        self._frames = self._new_sender()
        self._uploads: Receiver | None = None  # of the model file that was announced last
        self._upload: Upload | None = None
        self._views_to_note: deque[int] = deque()  # of frames that were delivered in earlier runs
        self._commander.end_models("the downlink failed before the model was in use")
        if store.is_open:
            self._begin_with_store()

    def _new_sender(self) -> FrameSender:
        return FrameSender(
            self._store,
            self._ranking,
            self._counts,
            self._stream.max_data_bytes,
            self.interval_s,
            self._mission.link,
            self._answer_keys,
        )

    def _begin_with_store(self) -> None:
        self._has_store = True
        try:
            self._ranking.start()
            self._take_in(self._frames.look())
        except (OSError, StoreError) as error:
            self._store_failed(error, self._clock_s())
        waiting = self.waiting
        self._views_to_note.extend(f.frame_id for f in self._store.frames if f.frame_id not in waiting)

    def store_is_open(self, now_s: float, may_open: Callable[[], bool]) -> bool:
        """Tell whether there is a store to look at, after opening it if that is due."""
        if now_s < self._store_retry_s:
            return False
        if not self._store.is_open:
            if not may_open():
                return False
            try:
                self._store.open()
            except StoreError as error:
                self._tell_start()
                self._store_failed(error, now_s)
                return False
        if not self._has_store:
            self._commander.settings = load_settings(self._store.folder, self._mission)
            self._frames = self._new_sender()  # of this store's identity
            self._begin_with_store()
        self._tell_start()
        return True

    def _store_failed(self, error: Exception, now_s: float) -> None:
        """Say why there are no frames to send, once for each reason, and leave the store alone for a while."""
        self._store_retry_s = now_s + STORE_RETRY_S
        if (problem := in_words(error)) != self._store_problem:
            self._store_problem = problem
            log.error("%s; commands are obeyed, and it is tried again every %g s", problem, STORE_RETRY_S)

    def start_again(self, error: Exception) -> None:
        """Begin anew after a failure and a pause; the log's error is an event to the ground.

        Raises:
            StoreError, DownlinkError: it failed too often in a row.
        """
        if self._clock_s() - self._started_s > SOUND_S:
            self._restarts_in_a_row = 0
        while self._restarts_in_a_row < RESTARTS:
            self._restarts += 1
            self._restarts_in_a_row += 1
            log.error("the downlink failed, restart %d: %r", self._restarts, error, exc_info=error)
            self._frames.stop()
            self._ranking.stop()
            time.sleep(RESTART_S)
            try:
                return self._start()
            except Exception as again:
                error = again
        if isinstance(error, FlightError):
            raise error
        problem = f"the downlink failed {RESTARTS + 1} times in a row, at last with {error!r}"
        raise DownlinkError(f"{problem}; start flightsw again, the store keeps the frames") from error

    @property
    def settings(self) -> Settings:
        return self._commander.settings

    @property
    def waiting(self) -> Collection[int]:
        """The frames still to be delivered, those in flight included."""
        return self._frames.waiting

    @property
    def rejected_waiting(self) -> int:
        """How many of them the ground did not take."""
        return len(self._frames.rejected)

    def look(self, now_s: float) -> None:
        """Take in new frames and results of triage, and order the frames that wait."""
        for verified in self._ranking.collect():
            self._report_model(verified)
        try:
            self._take_in(self._frames.look())
        except StoreError as error:
            self._store_failed(error, now_s)
            return
        self._announce()
        self._note_views()
        self._ranking.rank(self.waiting)
        if self.settings.priority == "triage":
            self._frames.queue(self._ranking.ordered(self._frames.ready(now_s), now_s))
        else:
            self._frames.queue(self._frames.ready(now_s, FRAMES_A_LOOK))

    def fill(self, now_s: float) -> None:
        """Put the next files in flight."""
        try:
            self._frames.fill(now_s)
        except StoreError as error:
            self._store_failed(error, now_s)

    def turn(self, now_s: float) -> bool:
        """Send and receive what the port takes and gives at once; tell whether a transfer ended."""
        packet = self._next_packet(now_s) if self._link.ready else None
        if packet is not None:
            self._link.write(self._stream.encode(*packet))
        data = self._link.exchange(WAIT_S if packet is None else 0.0)
        for apid, content in self._stream.decode(data):
            self.events.heard()
            if apid == APID_FILES:
                self._frames.transfers.receive(content, now_s)
            elif apid == APID_COMMANDS:
                self._commander.receive(content)
                self._renew_answer_keys()
            elif apid == APID_UPLINK_FILES:
                self._receive_upload(content, now_s)
        self._commander.poll()
        ended, failed = self._frames.outcomes(now_s)
        for outcome in failed:
            self.events.add("transfer_failed", file=outcome.name, reason=outcome.reason)
        return bool(ended)

    def _renew_answer_keys(self) -> None:
        """Have frames delivered by no receipt that was made with a key that is retired now."""
        valid = [own.key for own in self._key_ring.counters if not own.is_retired]
        self._answer_keys[:] = map(answer_key, valid + self._key_ring.without_counter)

    def send_last_telemetry(self) -> None:
        """Send the queued telemetry and the event that the software stops."""
        self.events.add("stopped")
        self._telemetry.append((APID_HOUSEKEEPING, self._housekeeping()))
        self._next_housekeeping_s = float("inf")
        end_s = self._clock_s() + LAST_TELEMETRY_S
        while self._clock_s() < end_s:
            if self._link.ready:
                packet = self._next_telemetry(self._clock_s())
                if packet is None:
                    break
                self._link.write(self._stream.encode(*packet))
            self._link.exchange(0.0 if self._link.ready else WAIT_S)

    def stop(self) -> None:
        self._ranking.stop()

    def _next_packet(self, now_s: float) -> tuple[int, bytes] | None:
        packet = self._next_telemetry(now_s)
        if packet is not None:
            return packet
        if self._uploads is not None and (pdu := self._uploads.next_pdu(now_s)) is not None:
            return APID_UPLINK_FILES, pdu
        pdu = self._frames.transfers.next_pdu(now_s)
        return None if pdu is None else (APID_FILES, pdu)

    def _next_telemetry(self, now_s: float) -> tuple[int, bytes] | None:
        if self._commander.reports:
            return APID_REPORTS, self._commander.reports.pop(0).pack()
        if (event := self.events.take()) is not None:
            return APID_EVENTS, event
        if self._telemetry:
            return self._telemetry.popleft()
        if now_s >= self._next_housekeeping_s:
            self._next_housekeeping_s = now_s + self._mission.link.housekeeping_s
            return APID_HOUSEKEEPING, self._housekeeping()
        return None

    def _housekeeping(self) -> bytes:
        progress, settings = self.progress(), self.settings
        frames_stored, bracket = self._store.frame_count, settings.bracket(self._mission)
        values = {
            "utc_ns": utc_ns(),
            "boot": self._boot,
            "mode": "safe" if settings.safe_mode else "normal",
            "camera": "none",
            "exposure_times_ms": bracket.exposure_times_ms,
            "near": settings.max_error_dn,
            "priority": settings.priority,
            "model": (self._ranking.model_sha256 or bytes(4))[:4],
            "frames_stored": frames_stored,
            "frames_failed": 0,
            "frames_refused": 0,
            "frames_dropped": self._store.dropped_undelivered,
            "frames_ranked": self._ranking.frames_ranked,
            "outbox_frames": progress.waiting,
            "command_counter": self._commander.last_counter,
        }
        names = {item.name for item in DICTIONARY.telemetry["housekeeping"].items}
        values |= {name: value for name, value in vars(progress).items() if name in names}
        values |= self._meter.values() | disk_values(self._store.folder, self._store.used_bytes)
        return DICTIONARY.telemetry["housekeeping"].pack(**values | self._capture_values())

    def _take_in(self, arrived: list[int]) -> None:
        """Have frames announced that have come into the outbox, once each."""
        self._to_announce.extend(frame_id for frame_id in arrived if frame_id not in self._announced)
        self._announced.update(arrived)

    def _announce(self) -> None:
        """Send each new frame's header at once, and its thumbnail if those go first."""
        for frame_id in taken(self._to_announce, HEADERS_A_LOOK):
            if frame_id not in self.waiting:
                continue
            with contextlib.suppress(
                OSError, PacketError
            ):  # of a damaged one nothing: it is counted when it is sent
                header = self._header(frame_id)
                read_header(header)
                self._telemetry.append((APID_FRAME_HEADERS, header))
            if self.settings.priority == "thumbnail-first":
                self._frames.queue_thumbnail(frame_id)

    def _note_views(self) -> None:
        """Have the ranking know the views of frames that earlier runs have delivered, some at a time."""
        for frame_id in taken(self._views_to_note, VIEWS_A_LOOK):
            with contextlib.suppress(OSError):
                self._ranking.note_sent(frame_id, self._header(frame_id))

    def _header(self, frame_id: int) -> bytes:
        with open(self._store.path(frame_id), "rb") as container:
            return header_of(container.read(HEADER.size))

    def _receive_upload(self, pdu: bytes, now_s: float) -> None:
        """Take a PDU of the announced file; without an announcement there is nothing to keep it in."""
        upload = self._commander.upload
        if upload is not None and upload != self._upload:
            self._upload = upload
            self._uploads = Receiver(
                self._stream.max_data_bytes,
                self.interval_s,
                self._accept_model,
                max_file_bytes=upload.sealed_bytes,
                max_open=2,
                route=UPLINK,
                checksum=self._mission.link.checksum,
            )
        if self._uploads is not None:
            self._uploads.receive(pdu, now_s)

    def _accept_model(self, name: str, content: bytes) -> bool:
        path = self._commander.receive_model(name, content)
        if path is not None:
            self._ranking.verify(path)
        return path is not None

    def _report_model(self, result: ModelVerified) -> None:
        """Tell the ground how the verification of a model ended: of one that it sent, or of the one on board."""
        is_from_before = result.path == self._ranking.model_path
        if is_from_before and result.problem:
            log.error("the model on board is not usable: %s", result.problem)
            return
        if not is_from_before:
            text = f"model {result.sha256.hex()[:8]} ranks frames"
            self._commander.end_model(result.path, result.problem, text)
        if result.problem is None:
            self.events.add("model_in_use", sha256=result.sha256)

    def _note_refusal(self, problem: str) -> None:
        log.info("command refused: %s", problem)
        if self._clock_s() >= self._next_refusal_s:
            self._next_refusal_s = self._clock_s() + REFUSAL_S
            self.events.add("command_refused", problem=problem)

    def progress(self) -> DownlinkProgress:
        deframer, counts, transfers = self._stream.deframer, self._counts, self._frames.transfers
        return DownlinkProgress(
            delivered=counts.delivered,
            waiting=len(self.waiting),
            in_flight=len(transfers.in_flight),
            payload_bytes=counts.payload_bytes,
            bytes_sent=self._link.bytes_written,
            bytes_received=self._link.bytes_read,
            packets_sent=self._stream.packets_sent,
            segments_sent=counts.segments_sent + transfers.segments_sent,
            segments_resent=counts.segments_resent + transfers.segments_resent,
            transfers_failed=counts.transfers_failed,
            frames_unreadable=counts.frames_unreadable,
            frames_rejected=counts.frames_rejected,
            rejected_waiting=len(self._frames.rejected),
            skipped_bytes=deframer.skipped_bytes,
            crc_errors=deframer.crc_errors,
            packets_missing=self._stream.packets_missing,
            hang_ups=self._link.hang_ups,
            commands_accepted=self._commander.accepted,
            commands_refused=self._commander.refused,
            commands_repeated=self._commander.repeated,
            restarts=self._restarts,
        )


def taken(queue: deque[int], count: int) -> Iterator[int]:
    """Take up to `count` numbers out of a queue."""
    for _ in range(min(count, len(queue))):
        yield queue.popleft()
