"""The frames of the outbox as file transfers: what is put in flight next, and what became of each."""

import itertools
import logging
from collections import deque
from collections.abc import Collection, Sequence
from dataclasses import dataclass

from spacepackets.cfdp import ConditionCode

from flightsw.errors import StoreError
from flightsw.icd.frame import decode_frame, encode_thumbnail, header_of
from flightsw.icd.mission import LinkSection
from flightsw.icd.packet import PacketError
from flightsw.icd.transfer import Outcome, Sender
from flightsw.storage.store import FrameStore
from flightsw.triage.ranking import Ranking

log = logging.getLogger(__name__)
RETRY_S = 5.0  # before a frame that cannot be read, or that the ground cannot store, is tried again
REJECTED_S = (
    60.0,
    3600.0,
)  # the same after the first rejection by the ground; doubled up to the second value
NOT_STORED = ConditionCode.FILESTORE_REJECTION.name  # the reason where the ground cannot store now
AHEAD = 2  # files put before their data are on the wire: few, so that the order can change


@dataclass
class SendingCounts:
    """What became of the frames in this run, restarts of the downlink included."""

    delivered: int = 0
    payload_bytes: int = 0  # of delivered frames
    segments_sent: int = 0  # before the last restart
    segments_resent: int = 0
    transfers_failed: int = 0  # put again afterwards
    frames_unreadable: int = 0
    frames_rejected: int = 0  # by the ground, and kept; each is counted once


class FrameSender:
    """Sends frames and thumbnails by CFDP, few at a time, in the order that it was given last."""

    def __init__(
        self,
        store: FrameStore,
        ranking: Ranking,
        counts: SendingCounts,
        max_pdu_bytes: int,
        interval_s: float,
        link: LinkSection,
        keys: Sequence[bytes] = (),
    ):
        self.rejected: dict[int, int] = {}  # waiting frames that the ground did not take, and how often
        self.transfers = Sender(
            max_pdu_bytes,
            interval_s,
            link.files_in_flight,
            checksum=link.checksum,
            store=store.identity,
            keys=keys,
        )
        self._store, self._ranking, self._counts = store, ranking, counts
        self._queue: deque[int] = deque()  # frames to be put, in order
        self._thumbnails: deque[int] = deque()  # frames whose thumbnail is to be put
        self._sizes_bytes: dict[int, int] = {}  # of frames in flight
        self._retry_s: dict[int, float] = {}
        self._unsure = set(store.in_flight())  # frames that may be on the ground without this side knowing
        self._times_put_back = store.times_put_back

    @property
    def waiting(self) -> Collection[int]:
        """The frames still to be delivered, those in flight included, oldest first."""
        return self._store.waiting

    def look(self) -> list[int]:
        """Look at the outbox and return the frames that are new in it.

        Raises:
            StoreError: the disk refuses.
        """
        return self._store.look()

    def ready(self, now_s: float, at_most: int | None = None) -> list[int]:
        """Return the first waiting frames that are not in flight and not known to be unreadable for now."""
        if self._store.times_put_back != self._times_put_back:  # asked for by the ground: without delay
            self._times_put_back = self._store.times_put_back
            self._retry_s.clear()
            self.rejected.clear()
        in_flight = set(self.transfers.in_flight)
        ready = (
            frame_id
            for frame_id in self.waiting
            if frame_file_name(frame_id) not in in_flight and self._retry_s.get(frame_id, now_s) <= now_s
        )
        return list(itertools.islice(ready, at_most))

    def queue(self, frame_ids: list[int]) -> None:
        """Send these frames next, in this order; it replaces the order given before."""
        self._queue = deque(frame_ids)

    def queue_thumbnail(self, frame_id: int) -> None:
        self._thumbnails.append(frame_id)

    def fill(self, now_s: float) -> None:
        """Put what is next in flight: thumbnails before frames, no more than a little ahead of the wire."""
        transfers = self.transfers
        while self._thumbnails and transfers.unsent < AHEAD:
            self._put_thumbnail(self._thumbnails.popleft(), now_s)
        while self._queue and transfers.unsent < AHEAD and transfers.has_room:
            frame_id = self._queue.popleft()
            unsure = {*(other for other in self._unsure if other in self.waiting), frame_id}
            transaction = self._store.next_transaction(unsure)  # from now on it is not dropped for room
            container = self._read(frame_id, now_s)
            if container is not None:
                self._unsure = unsure
                self._sizes_bytes[frame_id] = len(container)
                transfers.put(frame_file_name(frame_id), container, transaction, now_s)
                self._ranking.note_sent(frame_id, header_of(container))

    def outcomes(self, now_s: float) -> tuple[int, list[Outcome]]:
        """Take account of the transfers that ended; return how many did, and the frames' that failed."""
        outcomes = self.transfers.outcomes()
        failed = []
        for outcome in outcomes:
            if not outcome.name.endswith(".obf"):
                continue  # a thumbnail: it is not sent again, its frame follows
            frame_id = int(outcome.name.removesuffix(".obf"))
            if outcome.delivered:
                self._confirm(frame_id)
            else:
                self._counts.transfers_failed += 1
                self._ranking.note_failed(frame_id)
                log.info("%s: transfer failed (%s), put again", outcome.name, outcome.reason)
                failed.append(outcome)
                self._wait_after(frame_id, outcome, now_s)
        return len(outcomes), failed

    def stop(self) -> None:
        """Add this sender's segments to the counts."""
        self._counts.segments_sent += self.transfers.segments_sent
        self._counts.segments_resent += self.transfers.segments_resent

    def _read(self, frame_id: int, now_s: float) -> bytes | None:
        try:
            return self._store.read(frame_id)
        except StoreError as error:
            if frame_id not in self.waiting:  # deleted since the order was given
                return None
            if frame_id not in self._retry_s:
                log.error("%s", error)
                self._counts.frames_unreadable += 1
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
            name, transaction = f"{frame_id:08d}.obt", self._store.next_transaction(self._unsure)
            self.transfers.put(name, thumbnail, transaction, now_s, urgent=True)

    def _wait_after(self, frame_id: int, outcome: Outcome, now_s: float) -> None:
        """Have a frame wait that the ground did not take: it is not sent for ever without a pause."""
        if outcome.refused:
            times = self.rejected.get(frame_id, 0) + 1
            self.rejected[frame_id] = times
            first_s, longest_s = REJECTED_S
            self._retry_s[frame_id] = now_s + min(first_s * 2.0 ** min(times - 1, 30), longest_s)
            if times == 1:
                self._counts.frames_rejected += 1
                log.warning("frame %d stays on board: %s by the ground", frame_id, outcome.reason)
        elif outcome.reason == NOT_STORED:
            self._retry_s[frame_id] = now_s + RETRY_S

    def _confirm(self, frame_id: int) -> None:
        if frame_id not in self.waiting:  # a late answer may confirm it twice
            return
        self._store.mark_delivered(frame_id)
        self._unsure.discard(frame_id)
        self.rejected.pop(frame_id, None)
        size_bytes = self._sizes_bytes.pop(frame_id, 0)
        self._counts.delivered += 1
        self._counts.payload_bytes += size_bytes
        self._ranking.note_delivered(frame_id)
        log.info("frame %d delivered, %d bytes, %d waiting", frame_id, size_bytes, len(self.waiting))


def frame_file_name(frame_id: int) -> str:
    """Return the name of the file by which a frame is sent."""
    return f"{frame_id:08d}.obf"
