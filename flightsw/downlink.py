"""The flight side of the link: frames until the ground has stored them, telemetry at once, commands as they come."""

import contextlib
import logging
import os
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from flightsw.commands import Commander, ReplayCounter
from flightsw.errors import DownlinkError, FlightError, StoreError
from flightsw.housekeeping import EventLog, ProcessMeter, disk_values
from flightsw.icd.frame import HEADER, decode_frame, encode_thumbnail
from flightsw.icd.framing import PacketStream
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
from flightsw.icd.transfer import UPLINK, Receiver, Sender, timer_s
from flightsw.ports import Link
from flightsw.settings import Settings
from flightsw.store import FrameStore
from flightsw.triage import ModelVerified, Ranked, TriageWorker, sending_order, sent_view
from obbgs_base.files import sync_folder

log = logging.getLogger(__name__)

WAIT_S = 0.02  # longest wait for the port before timers and outbox are looked at again
OUTBOX_S = 0.2  # between looks at the outbox, which another process may fill
RETRY_S = 5.0  # before a frame that cannot be read is tried again
AHEAD = 2  # files put before their data are on the wire: few, so that the order can change
PLACED = 32  # frames whose place by triage is decided one by one at a look: more than go until the next
HEADERS_A_LOOK = 20  # frame headers queued at once: a full outbox must not hold the files back
GOODBYE_S = 0.5  # for the last telemetry at the end
RANKING_S = 30.0  # for which pictures wait to be ranked by a new model: what goes first is lost to the others
RESTART_S = 0.5  # from a failure to the new start
RESTARTS = 5  # in a row, and no more
SOUND_S = 60.0  # a downlink that ran for so long was in order: its next failure is the first in a row
REFUSAL_S = 1.0  # between events of refused commands, which anybody can cause; all are counted


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
    counter: ReplayCounter | None = None,
    capture_values: Callable[[], dict[str, Any]] = dict,
) -> DownlinkProgress:
    """Send the outbox until told to stop, or until it is empty, and return the counts.

    A frame leaves the outbox only when the ground has reported it stored; a transfer that fails is put again.
    `on_progress` is called after each delivery and about five times a second. What fails is started again from what is
    on the disk, with an event to the ground; nothing on board may end the link while frames wait.

    Args:
        counter: the key and its replay counter; without one every command is refused.
        capture_values: what capture knows of the housekeeping packet's items.

    Raises:
        StoreError: the outbox cannot be read or changed, six times in a row.
        DownlinkError: the same for a reason that nobody foresaw.
    """
    downlink = _Downlink(store, link, mission, counter, capture_values, clock_s)
    logger = logging.getLogger("flightsw")
    logger.addHandler(downlink.events)
    try:
        empty_since_s: float | None = None
        next_look_s = float("-inf")
        while not should_stop():
            now_s = clock_s()
            try:
                if now_s >= next_look_s:
                    next_look_s = now_s + OUTBOX_S
                    downlink.look(now_s)
                    on_progress(downlink.progress())
                if downlink.turn(now_s):
                    on_progress(downlink.progress())
                downlink.fill(now_s)
            except Exception as error:  # the outermost loop of the downlink's thread
                downlink.start_again(error)
                next_look_s = float("-inf")
                continue
            if downlink.waiting:
                empty_since_s = None
            elif empty_since_s is None:
                empty_since_s = now_s
            # stay a little: if our last acknowledgement is lost, the ground asks once more
            elif exit_when_empty and now_s - empty_since_s > downlink.interval_s:
                break
        downlink.say_goodbye()
    finally:
        logger.removeHandler(downlink.events)
        downlink.stop()
    return downlink.progress()


class _Downlink:
    def __init__(
        self,
        store: FrameStore,
        link: Link,
        mission: Mission,
        counter: ReplayCounter | None,
        capture_values: Callable[[], dict[str, Any]],
        clock_s: Callable[[], float],
    ):
        self.interval_s = timer_s(link.baud_rate)
        self.waiting: list[int] = []
        self.events = EventLog()
        self._store, self._link, self._mission, self._clock_s = store, link, mission, clock_s
        self._capture_values = capture_values
        self._stream = PacketStream(TELEMETRY, mission.link.max_packet_bytes)
        self._commander = Commander(counter, store, mission, self._note_refusal, clock_s)
        self._meter = ProcessMeter(clock_s)
        self._telemetry: deque[tuple[int, bytes]] = deque()
        self._next_housekeeping_s = self._next_refusal_s = float("-inf")
        self._announced: set[int] = set()
        self._delivered = self._payload_bytes = self._failed = self._unreadable = 0
        self._segments_sent = self._segments_resent = 0  # before the last start
        self._restarts = self._restarts_in_a_row = 0
        self._start()
        self.events.add("started", frames_stored=len(store.frames), outbox_frames=len(self.waiting))

    def _start(self) -> None:
        """Begin with what is on the disk: no file in flight, no frame ranked."""
        store, camera = self._store, self._mission.camera
        self._started_s = self._clock_s()
        self._sender = Sender(self._stream.max_data_bytes, self.interval_s)
        self._worker = TriageWorker(np.array(camera.K), camera.width, camera.height)
        self._hold_until_s = float("-inf")
        self._queue: deque[int] = deque()  # frames to be put, in order
        self._thumbnails: deque[int] = deque()  # frames whose thumbnail is to be put
        self._sizes_bytes: dict[int, int] = {}  # of frames in flight
        self._retry_s: dict[int, float] = {}
        self._scores: dict[int, Ranked] = {}
        self._given_to_worker: set[int] = set()
        self._being_ranked: set[int] = set()
        self._sent_views: dict[int, tuple[float, ...]] = {}  # of frames delivered and in flight
        self._model_sha256 = b""
        self._uploads: Receiver | None = None  # of the model file that was announced last
        self._upload_counter = 0
        (store.folder / "model.onnx.received").unlink(missing_ok=True)
        self._is_model_looked_at = self._model_path.exists()
        if self._is_model_looked_at:
            self._worker.verify(self._model_path)
        self.waiting = store.outbox()
        for frame_id in {frame.frame_id for frame in store.frames}.difference(self.waiting):
            with contextlib.suppress(OSError), open(store.path(frame_id), "rb") as container:
                self._note_sent(frame_id, container.read(HEADER.size))

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
            self._segments_sent += self._sender.segments_sent
            self._segments_resent += self._sender.segments_resent
            self._worker.stop()
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
    def _model_path(self) -> Path:
        return self._store.folder / "model.onnx"

    def look(self, now_s: float) -> None:
        """See what the outbox and triage have brought, and put what waits into its order."""
        for result in self._worker.results():
            if isinstance(result, ModelVerified):
                self._end_verification(result)
                continue
            path, score = result
            self._being_ranked.discard(int(path.stem))
            if score is not None:
                self._scores[score.frame_id] = score
        self.waiting = self._store.outbox()
        self._announce()
        if self._model_sha256:
            for frame_id in self.waiting:
                if frame_id not in self._given_to_worker:
                    self._given_to_worker.add(frame_id)
                    self._being_ranked.add(frame_id)
                    self._worker.rank(self._store.path(frame_id))
        in_flight = set(self._sender.in_flight)
        self._queue = deque(
            self._ordered(
                [
                    frame_id
                    for frame_id in self.waiting
                    if picture_name(frame_id) not in in_flight and self._retry_s.get(frame_id, now_s) <= now_s
                ],
                now_s,
            )
        )

    def fill(self, now_s: float) -> None:
        """Put what is next in flight: thumbnails before pictures, no more than a little ahead of the wire."""
        sender = self._sender
        while self._thumbnails and sender.unsent < AHEAD:
            self._put_thumbnail(self._thumbnails.popleft(), now_s)
        while self._queue and sender.unsent < AHEAD and sender.has_room:
            frame_id = self._queue.popleft()
            container = self._read(frame_id, now_s)
            if container is not None:
                self._sizes_bytes[frame_id] = len(container)
                sender.put(picture_name(frame_id), container, self._store.next_transaction(), now_s)
                self._note_sent(frame_id, container[: HEADER.size])

    def turn(self, now_s: float) -> bool:
        """Send and receive what the port takes and gives at once; tell whether a transfer ended."""
        packet = self._next_packet(now_s) if self._link.ready else None
        if packet is not None:
            self._link.write(self._stream.encode(*packet))
        data = self._link.exchange(WAIT_S if packet is None else 0.0)
        for apid, content in self._stream.decode(data):
            if apid == APID_FILES:
                self._sender.receive(content, now_s)
            elif apid == APID_COMMANDS:
                self._commander.receive(content)
            elif apid == APID_UPLINK_FILES:
                self._receive_upload(content, now_s)
        outcomes = self._sender.outcomes()
        for outcome in outcomes:
            if not outcome.name.endswith(".obf"):
                continue  # a thumbnail: best effort, its picture follows
            if outcome.delivered:
                self._confirm(int(outcome.name.removesuffix(".obf")))
            else:
                self._failed += 1
                self._sent_views.pop(int(outcome.name.removesuffix(".obf")), None)
                log.info("%s: transfer failed (%s), put again", outcome.name, outcome.reason)
                self.events.add("transfer_failed", file=outcome.name, reason=outcome.reason)
        return bool(outcomes)

    def say_goodbye(self) -> None:
        """Send the telemetry that waits, and that this is the end."""
        self.events.add("stopped")
        self._telemetry.append((APID_HOUSEKEEPING, self._housekeeping()))
        self._next_housekeeping_s = float("inf")
        end_s = self._clock_s() + GOODBYE_S
        while self._clock_s() < end_s:
            if self._link.ready:
                packet = self._next_telemetry(self._clock_s())
                if packet is None:
                    break
                self._link.write(self._stream.encode(*packet))
            self._link.exchange(0.0 if self._link.ready else WAIT_S)

    def stop(self) -> None:
        self._worker.stop()

    def _next_packet(self, now_s: float) -> tuple[int, bytes] | None:
        packet = self._next_telemetry(now_s)
        if packet is not None:
            return packet
        if self._uploads is not None and (pdu := self._uploads.next_pdu(now_s)) is not None:
            return APID_UPLINK_FILES, pdu
        pdu = self._sender.next_pdu(now_s)
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
        frames_stored, bracket = len(self._store.frames), settings.bracket(self._mission)
        values = {
            "utc_ns": time.time_ns(),
            "mode": "safe" if settings.safe_mode else "normal",
            "camera": "none",
            "exposure_times_ms": bracket.exposure_times_ms,
            "near": settings.max_error_dn,
            "priority": settings.priority,
            "model": (self._model_sha256 or bytes(4))[:4],
            "frames_stored": frames_stored,
            "frames_failed": 0,
            "frames_refused": 0,
            "frames_dropped": self._store.dropped_undelivered,
            "frames_ranked": len(self._scores),
            "outbox_frames": progress.waiting,
            "command_counter": self._commander.last_counter,
        }
        names = {item.name for item in DICTIONARY.telemetry["housekeeping"].items}
        values |= {name: value for name, value in vars(progress).items() if name in names}
        values |= self._meter.values() | disk_values(self._store.folder, self._store.used_bytes)
        return DICTIONARY.telemetry["housekeeping"].pack(**values | self._capture_values())

    def _announce(self) -> None:
        """Send each new frame's header at once, and its thumbnail if those go first."""
        new = [frame_id for frame_id in self.waiting if frame_id not in self._announced]
        for frame_id in new[:HEADERS_A_LOOK]:
            self._announced.add(frame_id)
            with contextlib.suppress(OSError), open(self._store.path(frame_id), "rb") as container:
                self._telemetry.append((APID_FRAME_HEADERS, container.read(HEADER.size)))
            if self.settings.priority == "thumbnail-first":
                self._thumbnails.append(frame_id)

    def _ordered(self, frame_ids: list[int], now_s: float) -> list[int]:
        """Return the frames to be sent, in the commanded order.

        By triage, those that are being ranked wait for it, all of them for a while after a model comes into use.
        Frames that have no score go before those whose score says nothing (in eclipse, pose not valid).
        """
        if self.settings.priority != "triage":
            return frame_ids
        if self._is_model_looked_at or (self._being_ranked and now_s < self._hold_until_s):
            return []
        ready = [frame_id for frame_id in frame_ids if frame_id not in self._being_ranked]
        scores = [self._scores[frame_id] for frame_id in ready if frame_id in self._scores]
        ordered = sending_order(scores, list(self._sent_views.values()), PLACED)
        unranked = [frame_id for frame_id in ready if frame_id not in self._scores]
        comparable = [score.frame_id for score in ordered if score.comparable]
        return [*comparable, *unranked, *(score.frame_id for score in ordered if not score.comparable)]

    def _note_sent(self, frame_id: int, header: bytes) -> None:
        """Keep what a frame that is under way shows: others like it are worth less."""
        with contextlib.suppress(PacketError):
            view = sent_view(header)
            if view is not None:
                self._sent_views[frame_id] = view

    def _read(self, frame_id: int, now_s: float) -> bytes | None:
        try:
            return self._store.read(frame_id)
        except StoreError as error:
            if frame_id not in self._retry_s:
                log.error("%s", error)
                self._unreadable += 1
            self._retry_s[frame_id] = now_s + RETRY_S
            return None

    def _put_thumbnail(self, frame_id: int, now_s: float) -> None:
        container = self._read(frame_id, now_s) if frame_id in self.waiting else None
        try:
            thumbnail = encode_thumbnail(decode_frame(container)) if container is not None else None
        except PacketError as error:
            log.error("frame %d has no thumbnail: %s", frame_id, error)
            return
        if thumbnail is not None:
            name, transaction = f"{frame_id:08d}.obt", self._store.next_transaction()
            self._sender.put(name, thumbnail, transaction, now_s, urgent=True)

    def _confirm(self, frame_id: int) -> None:
        if frame_id in self.waiting:  # a late answer may confirm it twice
            self._store.mark_delivered(frame_id)
            self.waiting.remove(frame_id)
            size_bytes = self._sizes_bytes.pop(frame_id, 0)
            self._delivered += 1
            self._payload_bytes += size_bytes
            self._scores.pop(frame_id, None)
            log.info("frame %d delivered, %d bytes, %d waiting", frame_id, size_bytes, len(self.waiting))

    def _receive_upload(self, pdu: bytes, now_s: float) -> None:
        """Take a PDU of the announced file; without an announcement there is nothing to keep it in."""
        upload = self._commander.upload
        if upload is not None and upload.counter != self._upload_counter:
            self._upload_counter = upload.counter
            self._uploads = Receiver(
                self._stream.max_data_bytes,
                self.interval_s,
                self._accept_model,
                max_file_bytes=upload.sealed_bytes,
                max_open=2,
                route=UPLINK,
            )
        if self._uploads is not None:
            self._uploads.receive(pdu, now_s)

    def _accept_model(self, name: str, content: bytes) -> bool:
        path = self._commander.receive_model(name, content)
        if path is not None:
            self._worker.verify(path)
        return path is not None

    def _end_verification(self, result: ModelVerified) -> None:
        if result.path == self._model_path:  # from before a restart
            self._is_model_looked_at = False
            if result.problem:
                log.error("the model on board is not usable: %s", result.problem)
                return
        elif result.problem is not None:
            result.path.unlink(missing_ok=True)
            self._commander.end_model(self._upload_counter, result.problem)
            return
        else:
            os.replace(result.path, self._model_path)
            sync_folder(self._store.folder)
            self._commander.end_model(
                self._upload_counter, None, f"model {result.sha256.hex()[:8]} ranks frames"
            )
        self._model_sha256 = result.sha256
        self._hold_until_s = self._clock_s() + RANKING_S
        self._scores.clear()
        self._given_to_worker.clear()  # with those that wait to be ranked: they are ranked twice
        self.events.add("model_in_use", sha256=result.sha256)

    def _note_refusal(self, problem: str) -> None:
        log.info("command refused: %s", problem)
        if self._clock_s() >= self._next_refusal_s:
            self._next_refusal_s = self._clock_s() + REFUSAL_S
            self.events.add("command_refused", problem=problem)

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
            segments_sent=self._segments_sent + self._sender.segments_sent,
            segments_resent=self._segments_resent + self._sender.segments_resent,
            transfers_failed=self._failed,
            frames_unreadable=self._unreadable,
            skipped_bytes=deframer.skipped_bytes,
            crc_errors=deframer.crc_errors,
            packets_missing=self._stream.packets_missing,
            hang_ups=self._link.hang_ups,
            commands_accepted=self._commander.accepted,
            commands_refused=self._commander.refused,
            commands_repeated=self._commander.repeated,
            restarts=self._restarts,
        )


def picture_name(frame_id: int) -> str:
    """Return the name under which a frame goes down."""
    return f"{frame_id:08d}.obf"
