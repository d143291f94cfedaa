"""The other side of a file transfer as somebody else builds it: cfdp-py 0.7.0 as it is, none of our fixes.

Each transaction has a handler of its own, as its documentation proposes; what a handler raises is counted. Its timers
read a simulated clock through spacepackets' one function for the time.
"""

import random
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Any

from cfdppy.defs import CfdpState
from cfdppy.filestore import NativeFilestore
from cfdppy.handler.dest import DestHandler, acknowledge_inactive_eof_pdu
from cfdppy.handler.source import SourceHandler
from cfdppy.mib import (
    CheckTimerProvider,
    DefaultFaultHandlerBase,
    IndicationConfig,
    LocalEntityConfig,
    RemoteEntityConfig,
    RemoteEntityConfigTable,
)
from cfdppy.request import PutRequest
from cfdppy.user import CfdpUserBase
from spacepackets.cfdp import ChecksumType, TransmissionMode
from spacepackets.cfdp.pdu import AckPdu, EofPdu
from spacepackets.cfdp.pdu.ack import TransactionStatus
from spacepackets.cfdp.pdu.helper import PduFactory
from spacepackets.countdown import Countdown
from spacepackets.seqcount import ProvidesSeqCount
from spacepackets.util import ByteFieldU8

FLIGHT, GROUND = ByteFieldU8(1), ByteFieldU8(2)


class _User(CfdpUserBase):
    def __init__(self) -> None:
        super().__init__(NativeFilestore())
        self.finished: Any = None

    def transaction_finished_indication(self, params: Any) -> None:
        self.finished = params.finished_params

    def _ignore(self, *_: Any, **__: Any) -> None:
        pass

    transaction_indication = eof_sent_indication = file_segment_recv_indication = metadata_recv_indication = (
        _ignore
    )
    report_indication = suspended_indication = resumed_indication = fault_indication = _ignore
    abandoned_indication = eof_recv_indication = _ignore


class _Faults(DefaultFaultHandlerBase):
    def ignore_cb(self, transaction_id: Any, cond: Any, progress: int) -> None:
        pass

    notice_of_suspension_cb = notice_of_cancellation_cb = abandoned_cb = ignore_cb


class _Timers(CheckTimerProvider):
    def provide_check_timer(self, local_entity_id: Any, remote_entity_id: Any, entity_type: Any) -> Countdown:
        return Countdown.from_seconds(5.0)


class _Number(ProvidesSeqCount):
    max_bit_width = 32  # type: ignore[assignment]

    def __init__(self, number: int):
        self.number = number

    def get_and_increment(self) -> int:
        return self.number


def _settings(
    local: ByteFieldU8, remote: ByteFieldU8, checksum: ChecksumType, interval_s: float
) -> tuple[LocalEntityConfig, RemoteEntityConfigTable]:
    remote_config = RemoteEntityConfig(
        entity_id=remote,
        max_file_segment_len=None,
        max_packet_len=1000,
        closure_requested=True,
        crc_on_transmission=False,
        default_transmission_mode=TransmissionMode.ACKNOWLEDGED,
        crc_type=checksum,
        positive_ack_timer_interval_seconds=interval_s,
        nak_timer_interval_seconds=interval_s,
    )
    return LocalEntityConfig(local, IndicationConfig(), _Faults()), RemoteEntityConfigTable([remote_config])


class StrangeReceiver:
    """Receives our files into a folder."""

    def __init__(self, folder: Path, checksum: ChecksumType, interval_s: float):
        self.errors: list[str] = []
        self.finished: dict[int, Any] = {}
        self._folder, self._checksum, self._interval_s = folder, checksum, interval_s
        self._handlers: dict[int, tuple[DestHandler, _User]] = {}
        self._queue: deque[bytes] = deque()

    def receive(self, data: bytes) -> None:
        pdu = PduFactory.from_raw(data)
        assert pdu is not None
        number = pdu.transaction_seq_num.value
        if number in self.finished:
            if isinstance(pdu, EofPdu):
                self._queue.append(
                    bytes(acknowledge_inactive_eof_pdu(pdu, TransactionStatus.TERMINATED).pack())
                )
            return
        if number not in self._handlers:
            if isinstance(pdu, AckPdu):
                return
            user = _User()
            local, remotes = _settings(GROUND, FLIGHT, self._checksum, self._interval_s)
            self._handlers[number] = DestHandler(local, user, remotes, _Timers()), user
        self._step(number, pdu)

    def next_pdu(self) -> bytes | None:
        for number in list(self._handlers):
            self._step(number, None)
        return self._queue.popleft() if self._queue else None

    def _step(self, number: int, pdu: Any) -> None:
        handler, user = self._handlers[number]
        try:
            handler.state_machine(pdu)
        except Exception as error:  # whatever it raises, the stranger goes on
            self.errors.append(repr(error))
        while holder := handler.get_next_packet():
            if holder.pdu is not None:
                self._queue.append(bytes(holder.pdu.pack()))
        if user.finished is not None and handler.transaction_id is None:
            self.finished[number] = user.finished
            del self._handlers[number]


class StrangeSender:
    """Sends files to us, one at a time."""

    def __init__(self, checksum: ChecksumType, interval_s: float):
        self.errors: list[str] = []
        self.finished: Any = None
        self._user = _User()
        self._number = _Number(0)
        local, remotes = _settings(FLIGHT, GROUND, checksum, interval_s)
        self._handler = SourceHandler(local, self._user, remotes, _Timers(), self._number)
        self._queue: deque[bytes] = deque()

    @property
    def idle(self) -> bool:
        return self._handler.state == CfdpState.IDLE and not self._queue

    def put(self, file: Path, name: str, number: int) -> None:
        self._handler.reset()
        self._user.finished, self._number.number = None, number
        self._handler.put_request(PutRequest(GROUND, file, Path(name), TransmissionMode.ACKNOWLEDGED, True))
        self._step(None)

    def receive(self, data: bytes) -> None:
        pdu = PduFactory.from_raw(data)
        assert pdu is not None
        if not self.idle and pdu.transaction_seq_num.value == self._number.number:
            self._step(pdu)

    def next_pdu(self) -> bytes | None:
        if not self._queue:
            self._step(None)
        return self._queue.popleft() if self._queue else None

    def _step(self, pdu: Any) -> None:
        try:
            self._handler.state_machine(pdu)
        except Exception as error:  # whatever it raises, the stranger goes on
            self.errors.append(repr(error))
        while holder := self._handler.get_next_packet():
            if holder.pdu is not None:
                self._queue.append(bytes(holder.pdu.pack()))
        if self._user.finished is not None:
            self.finished = self._user.finished


def lossy(
    deliver: Callable[[bytes], None], loss: float, rng: random.Random
) -> Callable[[bytes | None], None]:
    """Return what delivers a PDU, or loses it."""

    def send(pdu: bytes | None) -> None:
        if pdu is not None and rng.random() >= loss:
            deliver(pdu)

    return send
