"""Files over packets: CFDP class 2 (CCSDS 727.0-B). Bytes in, bytes out, time passed in.

The side that has a file owns a Sender, the other a Receiver. Both take PDUs with `receive` and give PDUs with
`next_pdu`; they keep no thread, no clock, no port and no disk.
"""

import struct
from collections import OrderedDict, deque
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from cfdppy import exceptions as cfdp_errors
from cfdppy.mib import IndicationConfig, LocalEntityConfig, RemoteEntityConfig, RemoteEntityConfigTable
from cfdppy.request import PutRequest
from spacepackets.cfdp import ChecksumType, ConditionCode, Direction, DirectiveType, TransmissionMode
from spacepackets.cfdp.defs import InvalidCrcError, UnsupportedCfdpVersionError
from spacepackets.cfdp.pdu import AckPdu, EofPdu, FileDataPdu, FinishedPdu, MetadataPdu, NakPdu
from spacepackets.cfdp.pdu.ack import TransactionStatus
from spacepackets.cfdp.pdu.helper import PduFactory
from spacepackets.seqcount import ProvidesSeqCount
from spacepackets.util import ByteFieldU8

from flightsw.icd.cfdp_shim import (
    Clock,
    Faults,
    Indications,
    MendedDest,
    MendedSource,
    NoCheckTimer,
    OneFile,
    delivered,
)
from flightsw.icd.packet import PacketError

FLIGHT, GROUND = ByteFieldU8(1), ByteFieldU8(2)  # entity IDs
Route = tuple[ByteFieldU8, ByteFieldU8]  # the entities that send and receive a file
DOWNLINK: Route = (FLIGHT, GROUND)
UPLINK: Route = (GROUND, FLIGHT)
TIMER_LIMIT = 8  # expirations in a row before a transaction ends; below 6 a lossy link ends good ones
SILENCE_INTERVALS = 4  # a living receiver that owes us an answer sends something every interval
SILENCE_S = 3.0  # at least, unless it waits for its disk
BUFFER_BYTES = 20_480  # what a pseudo-terminal or driver holds before it makes the writer wait
REMEMBERED = 4096  # closed transactions whose late PDUs are still answered
POLL_S = 0.02  # between looks at the receiving side's timers
MAX_NAK_BYTES = 128  # of a PDU: a short one gets through where a CAN bus loses most long messages
FIT_SEGMENTS = 8  # how many must have been sent before their loss says anything
MIN_SEGMENT_BYTES = 32  # a packet needs 27 bytes more

UNPARSABLE = (
    ValueError,
    IndexError,
    KeyError,
    TypeError,
    struct.error,
    InvalidCrcError,
    UnsupportedCfdpVersionError,
)
REFUSALS = (
    cfdp_errors.PduIgnoredForDest,
    cfdp_errors.PduIgnoredForSource,
    cfdp_errors.InvalidPduDirection,
    cfdp_errors.InvalidPduForDestHandler,
    cfdp_errors.InvalidPduForSourceHandler,
    cfdp_errors.InvalidSourceId,
    cfdp_errors.InvalidDestinationId,
    cfdp_errors.InvalidTransactionSeqNum,
    cfdp_errors.InvalidNakPdu,
    cfdp_errors.NoRemoteEntityConfigFound,
)


def timer_s(baud_rate: int) -> float:
    """Return the time after which an answer counts as lost: twice the round trip through full buffers."""
    round_trip_s = 0.1 + 2 * BUFFER_BYTES * 10 / baud_rate
    return 2 * round_trip_s


def parse_pdu(data: bytes, route: Route = DOWNLINK) -> Any:
    """Return the PDU in `data`.

    Raises:
        PacketError: no PDU, not of class 2, of another route, or with bytes left over.
    """
    try:
        pdu = PduFactory.from_raw(data)
        if isinstance(pdu, MetadataPdu):
            _ = pdu.source_file_name, pdu.dest_file_name  # decoded only here, and perhaps not text
        if isinstance(pdu, EofPdu):
            # spacepackets 0.32.0 leaves the code in the upper half of its byte
            pdu.condition_code = ConditionCode(data[pdu.pdu_header.header_len + 1] >> 4)
    except UNPARSABLE as error:
        raise PacketError(f"not a CFDP PDU: {error}") from error
    if pdu is None or pdu.packet_len != len(data) or pdu.pdu_header.crc_flag:
        raise PacketError(f"not one whole CFDP PDU without CRC in {len(data)} bytes")
    if pdu.transmission_mode != TransmissionMode.ACKNOWLEDGED:
        raise PacketError("a CFDP PDU of class 1, this link uses class 2")
    if (pdu.source_entity_id.value, pdu.dest_entity_id.value) != (route[0].value, route[1].value):
        raise PacketError(
            f"CFDP entities {pdu.source_entity_id.value} to {pdu.dest_entity_id.value}, not ours"
        )
    return pdu


def _configuration(
    local: ByteFieldU8,
    remote: ByteFieldU8,
    max_pdu_bytes: int,
    interval_s: float,
    max_segment_bytes: int | None = None,
):
    local_config = LocalEntityConfig(local, IndicationConfig(), Faults())
    remote_config = RemoteEntityConfig(
        entity_id=remote,
        max_file_segment_len=max_segment_bytes,
        max_packet_len=max_pdu_bytes,
        closure_requested=True,
        crc_on_transmission=False,
        default_transmission_mode=TransmissionMode.ACKNOWLEDGED,
        crc_type=ChecksumType.CRC_32,
        positive_ack_timer_interval_seconds=interval_s,
        positive_ack_timer_expiration_limit=TIMER_LIMIT,
        immediate_nak_mode=False,  # measured: immediate mode resends far more after a restart
        nak_timer_interval_seconds=interval_s,
        nak_timer_expiration_limit=TIMER_LIMIT,
    )
    return local_config, RemoteEntityConfigTable([remote_config])


def _acknowledges(pdu: Any, directive: DirectiveType) -> bool:
    return isinstance(pdu, AckPdu) and pdu.directive_code_of_acked_pdu == directive


def _acknowledgement(pdu: EofPdu | FinishedPdu, towards: Direction) -> bytes:
    """Return the ACK for a PDU of a transaction that is closed already."""
    directive = DirectiveType.EOF_PDU if isinstance(pdu, EofPdu) else DirectiveType.FINISHED_PDU
    config = pdu.pdu_header.pdu_conf
    config.direction = towards
    return bytes(AckPdu(config, directive, pdu.condition_code, TransactionStatus.TERMINATED).pack())


class _OneNumber(ProvidesSeqCount):
    """The transaction number that the caller chose; the library would count from 0 after each restart."""

    max_bit_width = 32  # type: ignore[assignment]

    def __init__(self, number: int):
        self._number = number

    def get_and_increment(self) -> int:
        return self._number


@dataclass(frozen=True)
class Outcome:
    """How the sending of a file ended. Only `delivered` means that the other side has stored it."""

    name: str
    delivered: bool
    reason: str


@dataclass
class _Sending:
    name: str
    size_bytes: int
    handler: MendedSource
    user: Indications
    faults: Faults
    last_sign_s: float  # last PDU sent or received
    round_bytes: int  # sent in this round: at first the whole file, then what was asked for again
    queue: deque[bytes] = field(default_factory=deque)
    sent_up_to: int = 0
    asked_bytes: int = 0  # for the next round
    asked_up_to: int = 0  # end of the last NAK's scope, 0 before the first
    urgent: bool = False


class Sender:
    """The sending entity: several files in flight, the first put first on the wire."""

    def __init__(
        self, max_pdu_bytes: int, interval_s: float, max_in_flight: int = 8, route: Route = DOWNLINK
    ):
        self.segments_sent = 0
        self.segments_resent = 0
        self.pdus_received = 0
        self.pdus_refused = 0
        self._max_pdu_bytes, self._interval_s, self._max_in_flight = max_pdu_bytes, interval_s, max_in_flight
        self._route = route
        self._segment_bytes = max_pdu_bytes
        self._fit_sent_bytes = self._fit_lost_bytes = 0  # since the segments were last looked at
        self._next_fit_s = float("-inf")
        self._clock = Clock()
        self._sending: OrderedDict[int, _Sending] = OrderedDict()
        self._closed: OrderedDict[int, str] = OrderedDict()  # transaction to name
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
        config, remotes = _configuration(
            source, destination, self._max_pdu_bytes, self._interval_s, self._segment_bytes
        )
        user = Indications(OneFile(content, len(content)))
        handler = MendedSource(config, user, remotes, NoCheckTimer(), _OneNumber(transaction))
        handler.clock = self._clock
        path = Path(name)
        handler.put_request(PutRequest(destination, path, path, TransmissionMode.ACKNOWLEDGED, True))
        faults = config.default_fault_handlers
        assert isinstance(faults, Faults)
        self._sending[transaction] = _Sending(name, len(content), handler, user, faults, now_s, len(content))
        if urgent:
            self._sending[transaction].urgent = True
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
            if not isinstance(pdu, NakPdu | FinishedPdu) and not _acknowledges(pdu, DirectiveType.EOF_PDU):
                raise PacketError(f"{type(pdu).__name__} is not for a sender")
        except PacketError:
            self.pdus_refused += 1
            return
        transaction = pdu.transaction_seq_num.value
        sending = self._sending.get(transaction)
        if sending is None:
            self._answer_late(pdu, transaction)
            return
        sending.last_sign_s = now_s
        if isinstance(pdu, NakPdu):
            if sending.queue and pdu.start_of_scope < sending.asked_up_to:  # what it asks for is on its way
                return
            pdu.segment_requests = _merged(pdu.segment_requests, sending.size_bytes)
            if pdu.start_of_scope < sending.asked_up_to:  # asked anew
                sending.asked_bytes = 0
            sending.asked_up_to = pdu.end_of_scope
            sending.asked_bytes += sum(end - start for start, end in pdu.segment_requests)
            if pdu.end_of_scope >= sending.size_bytes:
                self._fit_segments(sending.round_bytes, sending.asked_bytes)
                sending.round_bytes, sending.asked_bytes = sending.asked_bytes, 0
            sending.handler.limit_segments(self._segment_bytes)
        self._step(transaction, sending, pdu)

    def next_pdu(self, now_s: float) -> bytes | None:
        """Return what to send next, None when there is nothing to send now."""
        self._clock.now_s = now_s
        if self._last_words:
            return self._last_words.popleft()
        for sending in self._sending.values():
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
                self._close(transaction, sending, "no answer")
        return None

    def outcomes(self) -> list[Outcome]:
        """Return how files ended since the last call."""
        ended, self._outcomes = self._outcomes, []
        return ended

    def _fit_segments(self, sent_bytes: int, lost_bytes: int) -> None:
        """Halve the segments while most are lost, double them while few are.

        What loses CAN frames loses most long messages and few short ones. On a serial line the length does not
        matter, and the longest wins.
        """
        self._fit_sent_bytes += sent_bytes
        self._fit_lost_bytes += lost_bytes
        if self._fit_sent_bytes < FIT_SEGMENTS * self._segment_bytes:
            return
        now_s, share = self._clock.now_s, self._fit_lost_bytes / self._fit_sent_bytes
        if share > 1 / 2 and now_s >= self._next_fit_s:
            self._next_fit_s = now_s + self._interval_s  # once for all files that a cut has hit
            self._segment_bytes = max(self._segment_bytes // 2, MIN_SEGMENT_BYTES)
        elif share < 1 / 4:
            self._segment_bytes = min(2 * self._segment_bytes, self._max_pdu_bytes)
        self._fit_sent_bytes = self._fit_lost_bytes = 0

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
            if good:
                self._fit_segments(sending.round_bytes, 0)
            self._close(transaction, sending, "" if good else sending.user.finished.condition_code.name, good)
        elif sending.faults.condition is not None:
            self._close(transaction, sending, sending.faults.condition.name)
        elif sending.handler.idle:
            self._close(transaction, sending, "abandoned")

    def _close(self, transaction: int, sending: _Sending, reason: str, good: bool = False) -> None:
        self._last_words.extend(sending.queue)
        del self._sending[transaction]
        _remember(self._closed, transaction, sending.name)
        self._outcomes.append(Outcome(sending.name, good, reason))

    def _answer_late(self, pdu: Any, transaction: int) -> None:
        """Acknowledge a Finished that comes again, or too late: else the receiver keeps on sending it."""
        if not isinstance(pdu, FinishedPdu):
            return
        if transaction in self._closed and delivered(pdu.finished_params):
            self._outcomes.append(Outcome(self._closed[transaction], True, "told late"))
        self._last_words.append(_acknowledgement(pdu, Direction.TOWARDS_RECEIVER))


@dataclass(frozen=True)
class Incoming:
    """A file under way."""

    name: str  # the sender's, anything; empty until known
    received_bytes: int  # up to the last byte that came
    size_bytes: int | None  # None until known


@dataclass
class _Receiving:
    handler: MendedDest
    user: Indications
    last_sign_s: float
    received_up_to: int = 0
    size_bytes: int | None = None
    finished_pdu: bytes | None = None


class Receiver:
    """The receiving entity. `accept(name, content)` stores a whole, checked file before the sender is told.

    `accept` returns False when it cannot store; the sender then keeps the file. The same file may come twice,
    and the name is the sender's: it may be anything.
    """

    def __init__(
        self,
        max_pdu_bytes: int,
        interval_s: float,
        accept: Callable[[str, bytes], bool],
        max_file_bytes: int = 64 << 20,
        max_open: int = 32,
        route: Route = DOWNLINK,
    ):
        self.segments_received = 0
        self.segments_resent = 0  # came at or below what was there already: resent, late or twice
        self.pdus_received = 0
        self.pdus_refused = 0
        self._max_pdu_bytes, self._interval_s, self._accept = max_pdu_bytes, interval_s, accept
        self._max_file_bytes, self._max_open, self._route = max_file_bytes, max_open, route
        self._clock = Clock()
        self._receiving: OrderedDict[int, _Receiving] = OrderedDict()
        self._closed: OrderedDict[int, bytes] = OrderedDict()  # transaction to its Finished PDU
        self._queue: deque[bytes] = deque()
        self._next_poll_s = float("-inf")

    @property
    def open_transactions(self) -> int:
        return len(self._receiving)

    def incoming(self) -> list[Incoming]:
        """Return the files that are not whole yet."""
        return [
            Incoming(receiving.user.dest_name or "", receiving.received_up_to, receiving.size_bytes)
            for receiving in self._receiving.values()
            if receiving.finished_pdu is None
        ]

    def receive(self, data: bytes, now_s: float) -> None:
        """Take a PDU from the sending side; what is not valid is counted and dropped."""
        self._clock.now_s = now_s
        self.pdus_received += 1
        try:
            pdu = parse_pdu(data, self._route)
            transaction = pdu.transaction_seq_num.value
            self._check(pdu, self._receiving.get(transaction))
        except PacketError:
            self.pdus_refused += 1
            return
        if transaction in self._closed:
            self._answer_late(pdu, transaction)
            return
        receiving = self._receiving.get(transaction)
        if receiving is None:
            if isinstance(pdu, AckPdu):
                return
            receiving = self._open(transaction)
        receiving.last_sign_s = now_s
        if isinstance(pdu, FileDataPdu):
            self.segments_received += 1
            self.segments_resent += pdu.offset < receiving.received_up_to
            receiving.received_up_to = max(receiving.received_up_to, pdu.offset + len(pdu.file_data))
        elif isinstance(pdu, EofPdu | MetadataPdu):
            receiving.size_bytes = pdu.file_size
        again = isinstance(pdu, EofPdu) and receiving.handler.has_seen_eof
        self._step(transaction, receiving, None if again else pdu)
        if again and transaction in self._closed:
            self._answer_late(pdu, transaction)
        elif again:
            receiving.handler.acknowledge_again()
            self._drain(receiving)
            if receiving.finished_pdu is not None:  # the sender does not seem to know
                self._queue.append(receiving.finished_pdu)

    def next_pdu(self, now_s: float) -> bytes | None:
        """Return what to send next, None when there is nothing to send now."""
        self._clock.now_s = now_s
        if not self._queue and now_s >= self._next_poll_s:
            self._next_poll_s = now_s + POLL_S
            for transaction, receiving in list(self._receiving.items()):
                self._step(transaction, receiving, None)
                if now_s - receiving.last_sign_s > (TIMER_LIMIT + 2) * self._interval_s:
                    self._receiving.pop(transaction, None)  # not closed: if the sender lives it may go on
        return self._queue.popleft() if self._queue else None

    def _answer_late(self, pdu: Any, transaction: int) -> None:
        if isinstance(pdu, EofPdu):
            self._queue.append(_acknowledgement(pdu, Direction.TOWARDS_SENDER))
            self._queue.append(self._closed[transaction])

    def _check(self, pdu: Any, receiving: _Receiving | None) -> None:
        if pdu.direction != Direction.TOWARDS_RECEIVER:
            raise PacketError("a CFDP PDU for the sender came to the receiver")
        if isinstance(pdu, FileDataPdu):
            limit = self._max_file_bytes
            if receiving is not None and receiving.size_bytes is not None:
                limit = receiving.size_bytes
            if pdu.offset + len(pdu.file_data) > limit:
                raise PacketError(f"file data up to byte {pdu.offset + len(pdu.file_data)} of {limit}")
        elif isinstance(pdu, EofPdu | MetadataPdu):
            if pdu.file_size > self._max_file_bytes:
                raise PacketError(f"a file of {pdu.file_size} bytes, allowed are {self._max_file_bytes}")
            if isinstance(pdu, MetadataPdu) and pdu.checksum_type != ChecksumType.CRC_32:
                raise PacketError(f"checksum type {pdu.checksum_type}, this link uses CRC-32")
        elif not _acknowledges(pdu, DirectiveType.FINISHED_PDU):
            raise PacketError(f"{type(pdu).__name__} is not for a receiver")

    def _open(self, transaction: int) -> _Receiving:
        if len(self._receiving) >= self._max_open:
            oldest = min(self._receiving, key=lambda number: self._receiving[number].last_sign_s)
            del self._receiving[oldest]
        source, destination = self._route
        nak_bytes = min(self._max_pdu_bytes, MAX_NAK_BYTES)
        config, remotes = _configuration(destination, source, nak_bytes, self._interval_s)
        user = Indications(OneFile(b"", self._max_file_bytes), self._accept)
        handler = MendedDest(config, user, remotes, NoCheckTimer())
        handler.clock = self._clock
        receiving = _Receiving(handler, user, self._clock.now_s)
        self._receiving[transaction] = receiving
        return receiving

    def _step(self, transaction: int, receiving: _Receiving, pdu: Any) -> None:
        try:
            receiving.handler.state_machine(pdu)
        except REFUSALS:
            self.pdus_refused += 1
        self._drain(receiving)
        if receiving.finished_pdu is not None:
            receiving.user.file.content.clear()  # stored or given up; only the answers are still needed
        if receiving.handler.idle:
            self._receiving.pop(transaction, None)
            if receiving.finished_pdu is not None:
                _remember(self._closed, transaction, receiving.finished_pdu)

    def _drain(self, receiving: _Receiving) -> None:
        while holder := receiving.handler.get_next_packet():
            if holder.pdu is not None:
                packed = bytes(holder.pdu.pack())
                self._queue.append(packed)
                if isinstance(holder.pdu, FinishedPdu):
                    receiving.finished_pdu = packed


def _merged(requests: list[tuple[int, int]], size_bytes: int) -> list[tuple[int, int]]:
    """Return a NAK's ranges inside the file, sorted, without overlap: a hostile NAK costs one file."""
    merged: list[tuple[int, int]] = []
    for start, end in sorted(requests):
        end = min(end, size_bytes)
        if merged and merged[-1] != (0, 0) and start <= merged[-1][1]:
            merged[-1] = (merged[-1][0], max(merged[-1][1], end))
        elif start < end or ((start, end) == (0, 0) and not merged):
            merged.append((start, end))
    return merged


def _remember(closed: OrderedDict, transaction: int, value: Any) -> None:
    closed[transaction] = value
    while len(closed) > REMEMBERED:
        closed.popitem(last=False)


__all__ = [
    "DOWNLINK",
    "UPLINK",
    "ConditionCode",
    "Incoming",
    "Outcome",
    "Receiver",
    "Sender",
    "parse_pdu",
    "timer_s",
]
