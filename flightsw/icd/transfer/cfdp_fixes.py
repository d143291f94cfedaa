"""cfdp-py 0.7.0's state machines with their known defects fixed, on a given clock, without a disk.

Each fix overrides a private method, so the version is pinned, and each has a test that fails when the fix is not
needed any more or no longer enough.
"""

import hashlib
import io
from bisect import bisect_left, bisect_right
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from cfdppy.defs import CfdpState
from cfdppy.filestore import VirtualFilestore
from cfdppy.handler.dest import (
    CompletionDisposition,
    DestHandler,
    LostSegmentTracker,
)
from cfdppy.handler.dest import (
    TransactionStep as DestStep,
)
from cfdppy.handler.source import SourceHandler
from cfdppy.handler.source import TransactionStep as SourceStep
from cfdppy.mib import CheckTimerProvider, DefaultFaultHandlerBase
from cfdppy.user import CfdpUserBase
from spacepackets.cfdp import ConditionCode
from spacepackets.cfdp.pdu import EofPdu, FileDataPdu, FinishedPdu, MetadataPdu, NakPdu
from spacepackets.cfdp.pdu.finished import DeliveryCode, FileStatus, FinishedParams
from spacepackets.cfdp.pdu.nak import get_max_seg_reqs_for_max_packet_size_and_pdu_cfg
from spacepackets.cfdp.tlv import FilestoreResponseStatusCode
from spacepackets.countdown import Countdown

from flightsw.icd.mission import Checksum
from flightsw.icd.transfer.checksum import RunningChecksum
from flightsw.icd.transfer.receipt import Verdict, attach, receipt, store_of

MAX_GAPS = 16_384  # of one file: 50 MB with 30 % of its segments lost have some 10,000
DIGEST_BYTES = 2 << 20  # read for checksum and digest in one call


def delivered(finished: FinishedParams) -> bool:
    """Tell whether a Finished PDU's parameters mean that the whole file is stored on the other side."""
    return (
        finished.condition_code == ConditionCode.NO_ERROR
        and finished.delivery_code == DeliveryCode.DATA_COMPLETE
        and finished.file_status == FileStatus.FILE_RETAINED
    )


class Clock:
    """The time that the owner of a transfer last passed in."""

    now_s = 0.0


class ClockCountdown(Countdown):
    """A countdown that reads a Clock where the original reads the machine's time."""

    def __init__(self, clock: Clock, timeout_s: float):
        self._clock, self._timeout_s, self._start_s = clock, timeout_s, clock.now_s

    def timed_out(self) -> bool:
        return self._clock.now_s - self._start_s >= self._timeout_s

    def reset(self, new_timeout: Any = None) -> None:
        self._start_s = self._clock.now_s


class OneFile(VirtualFilestore):
    """A file store that is one file in memory: names from the link reach no disk.

    What is read in order goes into the file's checksum and its SHA-256 on the way, so that no call takes long at its
    end. Those bytes do not change any more: another segment with the same place is ignored there.
    """

    def __init__(self, content: bytes, max_bytes: int, checksum: Checksum):
        self.size_bytes = len(content)
        self._max_bytes = max_bytes
        self._file = io.BytesIO(content)  # which takes and gives its content without a copy
        self._digested_bytes = 0
        self._checksum, self._sha256 = RunningChecksum(checksum), hashlib.sha256()

    @property
    def content(self) -> bytes:
        return self._file.getvalue()

    @property
    def sha256(self) -> bytes | None:
        """The digest of the whole file, None before all of it was read."""
        return self._sha256.digest() if self._digested_bytes == self.size_bytes else None

    def digest(self, end: int) -> bool:
        """Read the next `DIGEST_BYTES` before this byte; tell whether nothing before it is left to be read."""
        left_bytes = end - self._digested_bytes
        if left_bytes > 0:
            self.read_data(Path(), self._digested_bytes, min(left_bytes, DIGEST_BYTES))
        return left_bytes <= DIGEST_BYTES

    def forget(self) -> None:
        """Give the memory of the content back."""
        self._file, self.size_bytes = io.BytesIO(), 0

    def read_data(self, file: Path, offset: int | None, read_len: int) -> bytes:
        start = offset or 0
        self._file.seek(start)
        data = self._file.read(read_len)
        if start == self._digested_bytes:
            self._digested_bytes += len(data)
            self._checksum.add(data)
            self._sha256.update(data)
        return data

    def write_data(self, file: Path, data: bytes, offset: int | None) -> None:
        start = offset or 0
        end = start + len(data)
        if end > self._max_bytes:
            raise PermissionError(f"{end} bytes are more than the {self._max_bytes} allowed")
        known_bytes = max(self._digested_bytes - start, 0)
        if known_bytes < len(data):
            self._file.seek(start + known_bytes)
            self._file.write(data[known_bytes:])
            self.size_bytes = max(self.size_bytes, end)

    def calculate_checksum(
        self, checksum_type: Any, file_path: Path, size_to_verify: int, segment_len: int = 4096
    ) -> bytes:
        """Return the checksum of what was read in order, which is all of the file where a transfer ends well."""
        return self._checksum.value()

    def file_size(self, file: Path) -> int:
        return self.size_bytes

    def file_exists(self, path: Path) -> bool:
        return True

    def is_directory(self, path: Path) -> bool:
        return False

    def truncate_file(self, file: Path) -> None:
        """Keep the content: each transaction has its own file, and data may come before the metadata."""

    def filename_from_full_path(self, path: Path) -> str:
        return path.name

    def read_from_opened_file(self, bytes_io: Any, offset: int, read_len: int) -> bytes:
        return self.read_data(Path(), offset, read_len)

    def create_file(self, *_: Any, **__: Any) -> FilestoreResponseStatusCode:
        return FilestoreResponseStatusCode.NOT_PERFORMED  # there is one file, and it is here

    delete_file = rename_file = replace_file = create_directory = create_file
    remove_directory = list_directory = create_file


class Indications(CfdpUserBase):
    """Keeps what the handlers say about their one transaction."""

    def __init__(
        self,
        vfs: OneFile,
        accept: Callable[[str, bytes], bool | Verdict] | None = None,
        key: bytes | None = None,
    ):
        super().__init__(vfs)
        self.file = vfs
        self._accept, self._key = accept, key
        self.store = b""  # that the file is from; empty if the sender does not say it
        self.dest_name: str | None = None
        self.finished: Any = None

    def transaction_finished_indication(self, params: Any) -> None:
        self.finished = params.finished_params
        if self._accept is None or not delivered(self.finished):
            return
        verdict = self._accept(self.dest_name or "", self.file.content)
        if not isinstance(verdict, Verdict):
            verdict = Verdict.STORED if verdict else Verdict.UNSTORED
        sha256 = self.file.sha256
        if self.store and sha256 is not None and verdict is not Verdict.UNSTORED:
            transaction = params.transaction_id.seq_num.value
            made = receipt(verdict, self.store, transaction, sha256, self._key)
            attach(self.finished, verdict, made)
        if not verdict:
            self.finished.condition_code = ConditionCode.FILESTORE_REJECTION
            self.finished.delivery_code = DeliveryCode.DATA_INCOMPLETE
            self.finished.file_status = FileStatus.DISCARDED_FILESTORE_REJECTION

    def metadata_recv_indication(self, params: Any) -> None:
        self.dest_name = params.dest_file_name

    def _ignore(self, *_: Any, **__: Any) -> None:
        pass

    transaction_indication = eof_sent_indication = file_segment_recv_indication = _ignore
    report_indication = suspended_indication = resumed_indication = fault_indication = _ignore
    abandoned_indication = eof_recv_indication = _ignore


class Faults(DefaultFaultHandlerBase):
    """Remembers the first condition that ended a transaction early."""

    def __init__(self):
        super().__init__()
        self.condition: ConditionCode | None = None

    def notice_of_cancellation_cb(self, transaction_id: Any, cond: ConditionCode, progress: int) -> None:
        self.condition = self.condition or cond

    def ignore_cb(self, transaction_id: Any, cond: ConditionCode, progress: int) -> None:
        pass

    notice_of_suspension_cb = abandoned_cb = notice_of_cancellation_cb


class NoCheckTimer(CheckTimerProvider):
    """Class 2 uses no check timer."""

    def provide_check_timer(self, local_entity_id: Any, remote_entity_id: Any, entity_type: Any) -> Countdown:
        raise AssertionError("the check timer belongs to class 1")


class Gaps(LostSegmentTracker):
    """The missing ranges of a file, sorted and apart from each other, `MAX_GAPS` at most.

    Any range can be taken out; the original refuses partial overlap, and sorts all gaps for each PDU. Where one more
    gap would be too many, the last two become one: what lies between them is asked for again.
    """

    def add_lost_segment(self, lost_seg: tuple[int, int]) -> None:
        start, end = lost_seg
        if start >= end:
            return
        gaps = self.lost_segments
        first = bisect_left(gaps, start, key=lambda gap: gap[1])  # those that it touches follow each other
        last = bisect_right(gaps, end, key=lambda gap: gap[0])
        if first < last:
            start, end = min(start, gaps[first][0]), max(end, gaps[last - 1][1])
        gaps[first:last] = [(start, end)]
        self._limit()

    def remove_lost_segment(self, segment_to_remove: tuple[int, int]) -> bool:
        start, end = segment_to_remove
        gaps = self.lost_segments
        first = bisect_right(gaps, start, key=lambda gap: gap[1])  # of those that it overlaps
        last = bisect_left(gaps, end, key=lambda gap: gap[0])
        if start >= end or first >= last:
            return False
        before = gaps[first:last]
        gaps[first:last] = [(a, b) for a, b in ((before[0][0], start), (end, before[-1][1])) if a < b]
        self._limit()
        return True  # also where it counts as missing again: the sender lives

    def _limit(self) -> None:
        gaps = self.lost_segments
        if len(gaps) > MAX_GAPS:
            gaps[-2:] = [(gaps[-2][0], gaps[-1][1])]


class FixedDestHandler(DestHandler):
    """The receiving state machine of one transaction."""

    clock: Clock
    cfg: Any
    user: Indications  # pyright: ignore[reportIncompatibleVariableOverride]  # it is given no other
    naks: Iterator[NakPdu] = iter(())  # still to be sent, of the last sequence

    def _common_first_packet_handler(self, pdu: Any) -> bool | None:
        # the original's default tracker is one object shared by all transactions: files get each other's gaps
        self._params.acked_params.lost_seg_tracker = Gaps()
        return super()._common_first_packet_handler(pdu)

    def _handle_eof_without_previous_metadata(self, eof_pdu: EofPdu) -> None:
        # the original forgets the checksum and then calls the good file damaged; and it throws away data
        # that came before the metadata, so that one lost packet costs the whole file
        params = self._params
        params.acked_params.metadata_missing = True
        if eof_pdu.condition_code != ConditionCode.NO_ERROR:
            self._handle_eof_cancel(eof_pdu)
        elif params.fp.progress < eof_pdu.file_size:
            params.acked_params.lost_seg_tracker.add_lost_segment((params.fp.progress, eof_pdu.file_size))
        params.fp.crc32, params.fp.file_size = eof_pdu.file_checksum, eof_pdu.file_size
        params.fp.progress = eof_pdu.file_size
        self._prepare_eof_ack_packet()
        self._eof_ack_pdu_done()

    def _handle_file_data_without_previous_metadata(self, fd_pdu: FileDataPdu) -> None:
        self._handle_fd_pdu(fd_pdu)

    def _handle_fd_pdu(self, file_data_pdu: FileDataPdu) -> None:
        super()._handle_fd_pdu(file_data_pdu)
        self._digest()

    def _digest(self) -> bool:
        """Take some of what has no gap before it into checksum and digest; tell whether that was all of it."""
        gaps = self._params.acked_params.lost_seg_tracker.lost_segments
        return self.user.file.digest(gaps[0][0] if gaps else self._params.fp.progress)

    def _handle_metadata_packet(self, metadata_pdu: MetadataPdu) -> None:
        self.user.store = store_of(metadata_pdu)
        super()._handle_metadata_packet(metadata_pdu)
        if self._params.acked_params.deferred_lost_segment_detection_active:
            # the original goes back to waiting for file data, and both sides wait forever
            self.states.step = DestStep.WAITING_FOR_MISSING_DATA

    def _deferred_lost_segment_handling(self) -> None:
        # the original makes all NAK PDUs of a sequence at once, which takes long where gaps are many
        acked, remote = self._params.acked_params, self._params.remote_cfg
        assert remote is not None
        timer, missing = acked.procedure_timer, bool(acked.lost_seg_tracker.lost_segments)
        if not missing and not acked.metadata_missing:
            if self._digest():  # else it goes on in the next call
                super()._deferred_lost_segment_handling()  # all is there
            return
        if timer is None:
            acked.procedure_timer = ClockCountdown(self.clock, remote.nak_timer_interval_seconds)
        elif timer.busy():
            return
        elif acked.nak_activity_counter + 1 == remote.nak_timer_expiration_limit:
            self._params.finished_params.delivery_code = DeliveryCode.DATA_INCOMPLETE
            self._declare_fault(ConditionCode.NAK_LIMIT_REACHED)
            return
        else:
            acked.nak_activity_counter += 1
            timer.reset()
        self.naks = self._nak_sequence()

    def _nak_sequence(self) -> Iterator[NakPdu]:
        """Give the NAK PDUs that ask for all that is missing now; their scopes follow each other to the file's end."""
        params, acked = self._params, self._params.acked_params
        remote, size_bytes = params.remote_cfg, params.fp.file_size
        assert remote is not None and size_bytes is not None
        most = get_max_seg_reqs_for_max_packet_size_and_pdu_cfg(remote.max_packet_len, params.pdu_conf)
        wanted = [(0, 0)] * acked.metadata_missing + acked.lost_seg_tracker.lost_segments
        for first in range(0, len(wanted), most):
            batch = wanted[first : first + most]
            start = batch[0][0] if first else 0
            end = batch[-1][1] if first + most < len(wanted) else size_bytes
            yield NakPdu(params.pdu_conf, start, end, batch)

    def _start_positive_ack_procedure(self) -> None:
        super()._start_positive_ack_procedure()
        if self._params.remote_cfg is not None:
            timeout_s = self._params.remote_cfg.positive_ack_timer_interval_seconds
            self._params.positive_ack_params.ack_timer = ClockCountdown(self.clock, timeout_s)

    def _handle_transfer_completion(self) -> None:
        # with nothing missing the original reports success without looking at the checksum
        params, file = self._params, self.user.file
        if params.completion_disposition == CompletionDisposition.COMPLETED:
            whole = file.size_bytes == params.fp.file_size
            if whole and not file.digest(file.size_bytes):
                return  # it goes on in the next call
            if (
                not whole
                or file.calculate_checksum(params.checksum_type, Path(), file.size_bytes) != params.fp.crc32
            ):
                params.finished_params.delivery_code = DeliveryCode.DATA_INCOMPLETE
                params.finished_params.condition_code = ConditionCode.FILE_CHECKSUM_FAILURE
        super()._handle_transfer_completion()

    def _handle_positive_ack_procedures(self) -> None:
        # at the limit the original tells the sender that the file, which is stored, was cancelled
        ack = self._params.positive_ack_params
        limit = self._params.remote_cfg.positive_ack_timer_expiration_limit if self._params.remote_cfg else 0
        if ack.ack_timer is not None and ack.ack_timer.timed_out() and ack.ack_counter + 1 >= limit:
            self._reset_internal(False)
        else:
            super()._handle_positive_ack_procedures()

    def acknowledge_again(self) -> None:
        """Answer an EOF that came before: its acknowledgement may be lost. The original stays silent."""
        self._prepare_eof_ack_packet()

    @property
    def has_seen_eof(self) -> bool:
        return self.states.step in (
            DestStep.WAITING_FOR_MISSING_DATA,
            DestStep.TRANSFER_COMPLETION,
            DestStep.SENDING_FINISHED_PDU,
            DestStep.WAITING_FOR_FINISHED_ACK,
        )

    @property
    def idle(self) -> bool:
        return self.states.state == CfdpState.IDLE


class FixedSourceHandler(SourceHandler):
    """The sending state machine of one transaction."""

    clock: Clock
    cfg: Any
    user: Indications  # pyright: ignore[reportIncompatibleVariableOverride]  # it is given no other

    def _start_positive_ack_procedure(self) -> None:
        super()._start_positive_ack_procedure()
        if self._params.remote_cfg is not None:
            timeout_s = self._params.remote_cfg.positive_ack_timer_interval_seconds
            self._params.positive_ack_params.ack_timer = ClockCountdown(self.clock, timeout_s)

    def limit_segments(self, segment_bytes: int) -> None:
        """Send what is still to be sent, and what is asked for again, in segments of at most this many bytes."""
        self._params.fp.segment_len = min(self._params.fp.segment_len, segment_bytes)

    def _check_inserted_packet(self, packet: Any) -> None:
        if isinstance(packet, FinishedPdu) and self.states.step == SourceStep.WAITING_FOR_EOF_ACK:
            # Finished says more than the EOF's acknowledgement, which is lost; the original drops it
            self.states.step = SourceStep.WAITING_FOR_FINISHED
        super()._check_inserted_packet(packet)

    @property
    def idle(self) -> bool:
        return self.states.state == CfdpState.IDLE
