"""The receiving end of a file transfer."""

from collections import OrderedDict, deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from spacepackets.cfdp import ConditionCode, Direction, DirectiveType
from spacepackets.cfdp.pdu import AckPdu, EofPdu, FileDataPdu, FinishedPdu, MetadataPdu

from flightsw.icd.mission import Checksum
from flightsw.icd.packet import PacketError
from flightsw.icd.transfer.cfdp_fixes import Clock, FixedDestHandler, Indications, NoCheckTimer, OneFile
from flightsw.icd.transfer.checksum import TYPES
from flightsw.icd.transfer.pdu import (
    DOWNLINK,
    REFUSALS,
    TIMER_LIMIT,
    Route,
    acknowledgement,
    acknowledges,
    configuration,
    parse_pdu,
    remember,
)
from flightsw.icd.transfer.receipt import Verdict, store_of

POLL_S = 0.02  # between looks at the timers of the transactions
# of memory that all open files may take, in files of the largest size: a short packet can claim any byte of a file
LARGEST_FILES = 4
MAX_NAK_BYTES = 128  # of a PDU: a short one gets through where a CAN bus loses most long messages


@dataclass(frozen=True)
class Incoming:
    """A file that is being received."""

    name: str  # the sender's, anything; empty until known
    received_bytes: int  # up to the last byte that came
    size_bytes: int | None  # None until known


@dataclass
class _Receiving:
    handler: FixedDestHandler
    user: Indications
    last_sign_s: float
    received_up_to: int = 0
    size_bytes: int | None = None
    checksum: bytes | None = None  # as the EOF says
    finished_pdu: bytes | None = None

    @property
    def closed(self) -> "_Closed":
        name, store = self.user.dest_name or "", self.user.store
        return _Closed(name, store, self.size_bytes, self.checksum, self.finished_pdu or b"")


@dataclass(frozen=True)
class _Closed:
    """What is known of a transaction that has ended: which file it was, and the answer."""

    name: str
    store: bytes
    size_bytes: int | None
    checksum: bytes | None
    finished_pdu: bytes

    def is_other(self, pdu: Any) -> bool:
        """Tell whether a PDU is of another file, whose sender has used the number again."""
        if isinstance(pdu, MetadataPdu):
            return (pdu.dest_file_name or "", store_of(pdu), pdu.file_size) != (
                self.name,
                self.store,
                self.size_bytes,
            )
        if isinstance(pdu, EofPdu) and pdu.condition_code == ConditionCode.NO_ERROR:
            return (pdu.file_size, pdu.file_checksum) != (self.size_bytes, self.checksum)
        return False


class Receiver:
    """The receiving entity. `accept(name, content)` stores a whole, checked file before the sender is told.

    `accept` returns True or False, or a `Verdict`: False when it cannot store now, REJECTED when it would not take the
    file the next time either; the sender then keeps it. The same file may come twice, and the name is the sender's:
    it may be anything. With `key` the receipts of files that come from a store have a tag.
    """

    def __init__(
        self,
        max_pdu_bytes: int,
        interval_s: float,
        accept: Callable[[str, bytes], bool | Verdict],
        max_file_bytes: int = 64 << 20,
        max_open: int = 32,
        route: Route = DOWNLINK,
        checksum: Checksum = "crc-32",
        key: bytes | None = None,
    ):
        self.segments_received = 0
        self.segments_resent = 0  # came at or below what was there already: resent, late or twice
        self.pdus_received = 0
        self.pdus_refused = 0
        self._max_pdu_bytes, self._interval_s, self._accept = max_pdu_bytes, interval_s, accept
        self._max_file_bytes, self._max_open, self._route = max_file_bytes, max_open, route
        self._checksum: Checksum = checksum
        self._key = key
        self._clock = Clock()
        self._receiving: OrderedDict[int, _Receiving] = OrderedDict()
        self._closed: OrderedDict[int, _Closed] = OrderedDict()  # by transaction
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
        self._forget_other(pdu, transaction)
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
            self._make_room(receiving, pdu.offset + len(pdu.file_data))
            receiving.received_up_to = max(receiving.received_up_to, pdu.offset + len(pdu.file_data))
        elif isinstance(pdu, EofPdu | MetadataPdu):
            receiving.size_bytes = pdu.file_size
            if isinstance(pdu, EofPdu):
                receiving.checksum = pdu.file_checksum
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
        if not self._queue:
            for receiving in self._receiving.values():
                if (nak := next(receiving.handler.naks, None)) is not None:
                    return bytes(nak.pack())
        return self._queue.popleft() if self._queue else None

    def _forget_other(self, pdu: Any, transaction: int) -> None:
        """Forget a file that was answered if its number now comes with another one."""
        receiving = self._receiving.get(transaction)
        if receiving is not None and receiving.finished_pdu is not None and receiving.closed.is_other(pdu):
            del self._receiving[transaction]
        elif transaction in self._closed and self._closed[transaction].is_other(pdu):
            del self._closed[transaction]

    def _answer_late(self, pdu: Any, transaction: int) -> None:
        if isinstance(pdu, EofPdu):
            self._queue.append(acknowledgement(pdu, Direction.TOWARDS_SENDER))
            self._queue.append(self._closed[transaction].finished_pdu)

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
            if isinstance(pdu, MetadataPdu) and pdu.checksum_type != TYPES[self._checksum]:
                raise PacketError(f"checksum type {pdu.checksum_type}, this link uses {self._checksum}")
        elif not acknowledges(pdu, DirectiveType.FINISHED_PDU):
            raise PacketError(f"{type(pdu).__name__} is not for a receiver")

    def _open(self, transaction: int) -> _Receiving:
        if len(self._receiving) >= self._max_open:
            del self._receiving[min(self._receiving, key=self._last_sign_s)]
        source, destination = self._route
        nak_bytes = min(self._max_pdu_bytes, MAX_NAK_BYTES)
        config, remotes = configuration(destination, source, nak_bytes, self._interval_s, self._checksum)
        user = Indications(OneFile(b"", self._max_file_bytes, self._checksum), self._accept, self._key)
        handler = FixedDestHandler(config, user, remotes, NoCheckTimer())
        handler.clock = self._clock
        receiving = _Receiving(handler, user, self._clock.now_s)
        self._receiving[transaction] = receiving
        return receiving

    def _last_sign_s(self, transaction: int) -> float:
        return self._receiving[transaction].last_sign_s

    def _make_room(self, receiving: _Receiving, size_bytes: int) -> None:
        """Give up the files that were silent for longest where one of this size would not fit beside them."""
        sizes = {
            number: other.user.file.size_bytes
            for number, other in self._receiving.items()
            if other is not receiving
        }
        while sizes and sum(sizes.values()) + size_bytes > LARGEST_FILES * self._max_file_bytes:
            oldest = min(sizes, key=self._last_sign_s)
            del self._receiving[oldest], sizes[oldest]

    def _step(self, transaction: int, receiving: _Receiving, pdu: Any) -> None:
        try:
            receiving.handler.state_machine(pdu)
        except REFUSALS:
            self.pdus_refused += 1
        self._drain(receiving)
        if receiving.finished_pdu is not None:
            receiving.user.file.forget()  # stored or given up; only the answers are still needed
            receiving.handler.naks = iter(())
        if receiving.handler.idle:
            self._receiving.pop(transaction, None)
            if receiving.finished_pdu is not None:
                remember(self._closed, transaction, receiving.closed)

    def _drain(self, receiving: _Receiving) -> None:
        while holder := receiving.handler.get_next_packet():
            if holder.pdu is not None:
                packed = bytes(holder.pdu.pack())
                self._queue.append(packed)
                if isinstance(holder.pdu, FinishedPdu):
                    receiving.finished_pdu = packed
