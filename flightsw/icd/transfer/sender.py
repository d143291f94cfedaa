"""The sending end of a file transfer."""

from collections import OrderedDict, deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from cfdppy.request import PutRequest
from spacepackets.cfdp import ConditionCode, Direction, DirectiveType, TransmissionMode
from spacepackets.cfdp.pdu import FileDataPdu, FinishedPdu, NakPdu
from spacepackets.seqcount import ProvidesSeqCount

from flightsw.icd.mission import Checksum
from flightsw.icd.packet import PacketError
from flightsw.icd.transfer.cfdp_fixes import (
    Clock,
    Faults,
    FixedSourceHandler,
    Indications,
    NoCheckTimer,
    OneFile,
    delivered,
)
from flightsw.icd.transfer.pdu import (
    DOWNLINK,
    REFUSALS,
    Route,
    acknowledgement,
    acknowledges,
    configuration,
    parse_pdu,
    remember,
)
from flightsw.icd.transfer.receipt import Verdict, fits, receipt_in, store_message
from flightsw.icd.transfer.rounds import NakRounds, SegmentLength, merged_ranges

SILENCE_INTERVALS = 4  # a living receiver that owes us an answer sends something every interval
SILENCE_S = 3.0  # at least: the receiver may be waiting for its disk
RESENT_AT_ONCE = 32  # segments that are queued in one call, of those that the receiver asks for again


class _OneNumber(ProvidesSeqCount):
    """The transaction number that the caller chose; the library would count from 0 after each restart."""

    max_bit_width = 32  # type: ignore[assignment]

    def __init__(self, number: int):
        self._number = number

    def get_and_increment(self) -> int:
        return self._number


@dataclass(frozen=True)
class Outcome:
    """How the sending of a file ended. Only `delivered` means that the other side has stored it.

    refused: the other side does not take it, or gives no receipt that fits; the next try will hardly end better.
    """

    name: str
    delivered: bool
    reason: str
    refused: bool = False


@dataclass(frozen=True)
class _File:
    """Which file a transaction carries, as a receipt says it."""

    name: str
    store: bytes
    transaction: int
    sha256: bytes | None  # None while not all of it was sent once

    def verdict(self, finished: FinishedPdu, keys: Sequence[bytes]) -> Verdict | None:
        """Return what a Finished PDU says about this very file; None if it does not prove to be about it.

        A receiver that knows no receipts is believed where there is no key.
        """
        params = finished.finished_params
        given = receipt_in(params)
        if delivered(params):
            verdict = Verdict.STORED
        elif given and params.condition_code == ConditionCode.FILESTORE_REJECTION:
            verdict = Verdict.REJECTED
        else:
            return Verdict.UNSTORED
        if not self.store or (not given and not keys):
            return verdict
        if self.sha256 is None or not fits(given, verdict, self.store, self.transaction, self.sha256, keys):
            return None
        return verdict


@dataclass
class _Sending:
    name: str
    store: bytes
    transaction: int
    size_bytes: int
    handler: FixedSourceHandler
    user: Indications
    faults: Faults
    last_sign_s: float  # last PDU sent or received
    rounds: NakRounds
    urgent: bool
    queue: deque[bytes] = field(default_factory=deque)
    sent_up_to: int = 0
    wanted: deque[tuple[int, int]] = field(default_factory=deque)  # asked for again, not in the queue yet
    nak: NakPdu | None = None  # that asked last
    unproven: bool = False  # an answer came whose receipt does not fit
    verdict: Verdict | None = None

    @property
    def file(self) -> _File:
        return _File(self.name, self.store, self.transaction, self.user.file.sha256)


class Sender:
    """The sending entity: several files in flight, the first put first on the wire.

    Args:
        store: the identity of the store that the files are from, of `STORE_BYTES`; with it the receiver's answers count
            only with a receipt for the very file.
        keys: one of these must have made each receipt.
    """

    def __init__(
        self,
        max_pdu_bytes: int,
        interval_s: float,
        max_in_flight: int = 8,
        route: Route = DOWNLINK,
        checksum: Checksum = "crc-32",
        store: bytes = b"",
        keys: Sequence[bytes] = (),
    ):
        self.segments_sent = 0
        self.segments_resent = 0
        self.pdus_received = 0
        self.pdus_refused = 0
        self._max_pdu_bytes, self._interval_s, self._max_in_flight = max_pdu_bytes, interval_s, max_in_flight
        self._route = route
        self._checksum: Checksum = checksum
        self._store, self._keys = store, keys
        self._segments = SegmentLength(max_pdu_bytes, interval_s)
        self._clock = Clock()
        self._sending: OrderedDict[int, _Sending] = OrderedDict()
        self._closed: OrderedDict[int, _File] = OrderedDict()  # by transaction
        self._last_words: deque[bytes] = deque()  # PDUs of closed transactions
        self._outcomes: list[Outcome] = []

    @property
    def in_flight(self) -> list[str]:
        return [sending.name for sending in self._sending.values()]

    @property
    def has_room(self) -> bool:
        return len(self._sending) < self._max_in_flight

    @property
    def unsent(self) -> int:
        """How many files in flight have data that has not been sent once."""
        return sum(sending.sent_up_to < sending.size_bytes for sending in self._sending.values())

    def put(self, name: str, content: bytes, transaction: int, now_s: float, urgent: bool = False) -> None:
        """Start to send a file, before all others that are not `urgent`.

        A transaction number must never be used twice, not even after a restart.
        """
        self._clock.now_s = now_s
        source, destination = self._route
        config, remotes = configuration(
            source,
            destination,
            self._max_pdu_bytes,
            self._interval_s,
            self._checksum,
            self._segments.length_bytes,
        )
        user = Indications(OneFile(content, len(content), self._checksum))
        handler = FixedSourceHandler(config, user, remotes, NoCheckTimer(), _OneNumber(transaction))
        handler.clock = self._clock
        path = Path(name)
        request = PutRequest(destination, path, path, TransmissionMode.ACKNOWLEDGED, True)
        if self._store:
            request.msgs_to_user = [store_message(self._store)]
        handler.put_request(request)
        faults = config.default_fault_handlers
        assert isinstance(faults, Faults)
        rounds = NakRounds(len(content))
        self._sending[transaction] = _Sending(
            name, self._store, transaction, len(content), handler, user, faults, now_s, rounds, urgent
        )
        if urgent:
            for number in [n for n, sending in self._sending.items() if not sending.urgent]:
                self._sending.move_to_end(number)

    def receive(self, data: bytes, now_s: float) -> None:
        """Take a PDU from the other side; what is not valid is counted and dropped."""
        self._clock.now_s = now_s
        self.pdus_received += 1
        try:
            pdu = parse_pdu(data, self._route)
            if pdu.direction != Direction.TOWARDS_SENDER:
                raise PacketError("a CFDP PDU for the receiver came to the sender")
            if not isinstance(pdu, NakPdu | FinishedPdu) and not acknowledges(pdu, DirectiveType.EOF_PDU):
                raise PacketError(f"{type(pdu).__name__} is not for a sender")
        except PacketError:
            self.pdus_refused += 1
            return
        transaction = pdu.transaction_seq_num.value
        sending = self._sending.get(transaction)
        if sending is None:
            self._answer_late(pdu, transaction)
            return
        if isinstance(pdu, FinishedPdu):
            sending.verdict = sending.file.verdict(pdu, self._keys)
            if sending.verdict is None:  # of another file, or of somebody without the key
                self.pdus_refused += 1
                sending.unproven = True
                return
        sending.last_sign_s = now_s
        if isinstance(pdu, NakPdu):
            if (sending.queue or sending.wanted) and sending.rounds.is_repeated(pdu.start_of_scope):
                return  # what it asks for is on its way
            pdu.segment_requests = merged_ranges(pdu.segment_requests, sending.size_bytes)
            ended = sending.rounds.take_nak(pdu.start_of_scope, pdu.end_of_scope, pdu.segment_requests)
            if ended is not None:
                self._segments.adapt(*ended, now_s)
            sending.handler.limit_segments(self._segments.length_bytes)
            sending.nak = pdu
            sending.wanted.extend(pdu.segment_requests)
            return
        self._step(transaction, sending, pdu)

    def next_pdu(self, now_s: float) -> bytes | None:
        """Return what to send next, None when there is nothing to send now."""
        self._clock.now_s = now_s
        if self._last_words:
            return self._last_words.popleft()
        for transaction, sending in list(self._sending.items()):
            if not sending.queue and sending.wanted:
                self._send_again(transaction, sending)
            if sending.queue:
                sending.last_sign_s = now_s
                return sending.queue.popleft()
        for transaction, sending in list(self._sending.items()):
            self._step(transaction, sending, None)
            if self._last_words:
                return self._last_words.popleft()
            if sending.queue:
                sending.last_sign_s = now_s
                return sending.queue.popleft()
            if now_s - sending.last_sign_s > max(SILENCE_INTERVALS * self._interval_s, SILENCE_S):
                reason = "answered without a fitting receipt" if sending.unproven else "no answer"
                self._close(transaction, sending, reason, refused=sending.unproven)
        return None

    def outcomes(self) -> list[Outcome]:
        """Return how files ended since the last call."""
        ended, self._outcomes = self._outcomes, []
        return ended

    def _step(self, transaction: int, sending: _Sending, pdu: Any) -> None:
        try:
            sending.handler.state_machine(pdu)
        except REFUSALS:
            self.pdus_refused += 1
        while holder := sending.handler.get_next_packet():
            outgoing = holder.pdu
            if isinstance(outgoing, FileDataPdu):
                self.segments_sent += 1
                self.segments_resent += outgoing.offset < sending.sent_up_to
                sending.sent_up_to = max(sending.sent_up_to, outgoing.offset + len(outgoing.file_data))
            if outgoing is not None:
                sending.queue.append(bytes(outgoing.pack()))
        if sending.user.finished is not None:
            good = delivered(sending.user.finished)
            refused = sending.verdict is Verdict.REJECTED
            if good:
                self._segments.adapt(sending.rounds.sent_bytes, 0, self._clock.now_s)
            reason = "" if good else sending.user.finished.condition_code.name
            self._close(transaction, sending, "rejected" if refused else reason, good, refused)
        elif sending.faults.condition is not None:
            self._close(transaction, sending, sending.faults.condition.name)
        elif sending.handler.idle:
            self._close(transaction, sending, "abandoned")

    def _send_again(self, transaction: int, sending: _Sending) -> None:
        """Queue a part of what was asked for again: all of it at once would take long where much was lost."""
        assert sending.nak is not None
        part, left_bytes = [], RESENT_AT_ONCE * self._segments.length_bytes
        while sending.wanted and left_bytes > 0:
            start, end = sending.wanted.popleft()
            part.append((start, min(end, start + left_bytes)))
            if end > start + left_bytes:
                sending.wanted.appendleft((start + left_bytes, end))
            left_bytes -= max(end - start, 1)
        nak = sending.nak
        nak.segment_requests = part
        self._step(transaction, sending, nak)

    def _close(
        self, transaction: int, sending: _Sending, reason: str, good: bool = False, refused: bool = False
    ) -> None:
        self._last_words.extend(sending.queue)
        del self._sending[transaction]
        remember(self._closed, transaction, sending.file)
        self._outcomes.append(Outcome(sending.name, good, reason, refused))

    def _answer_late(self, pdu: Any, transaction: int) -> None:
        """Acknowledge a Finished that comes again, or too late: else the receiver keeps on sending it."""
        if not isinstance(pdu, FinishedPdu):
            return
        file = self._closed.get(transaction)
        if file is not None and file.verdict(pdu, self._keys) is Verdict.STORED:
            self._outcomes.append(Outcome(file.name, True, "told late"))
        self._last_words.append(acknowledgement(pdu, Direction.TOWARDS_RECEIVER))
