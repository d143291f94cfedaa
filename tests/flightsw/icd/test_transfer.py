"""CFDP over a lossy wire in simulated time, and one test for each defect of cfdp-py 0.7.0 that we fix."""

import contextlib
import importlib.metadata
import random
from collections.abc import Callable
from typing import Any

import pytest
from cfdppy.handler import dest as stock_dest
from cfdppy.handler.dest import DestHandler, LostSegmentTracker
from cfdppy.handler.source import SourceHandler
from hypothesis import given, settings
from hypothesis import strategies as st
from spacepackets.cfdp import ConditionCode, DirectiveType, PduConfig, TransmissionMode
from spacepackets.cfdp.pdu import AckPdu, EofPdu, FileDataPdu, FinishedPdu, NakPdu
from spacepackets.cfdp.pdu.file_data import FileDataParams
from spacepackets.util import ByteFieldU8, ByteFieldU32

from flightsw.icd.packet import PacketError
from flightsw.icd.transfer import UPLINK, Receiver, Sender, parse_pdu, timer_s
from flightsw.icd.transfer.cfdp_fixes import FixedDestHandler, FixedSourceHandler, Gaps
from flightsw.icd.transfer.receiver import MAX_NAK_BYTES
from flightsw.icd.transfer.rounds import merged_ranges

MAX_PDU_BYTES = 200
INTERVAL_S = 0.5
STEP_S = 0.01
NEVER = lambda pdu, number: False  # noqa: E731


class Wire:
    """A sender, a receiver, and a wire that loses or changes what it is told to, in simulated time."""

    def __init__(
        self,
        lose_down: Callable[[object, int], bool] = NEVER,
        lose_up: Callable[[object, int], bool] = NEVER,
        alter: Callable[[bytes], bytes] = lambda pdu: pdu,
    ):
        self.stored: dict[str, bytes] = {}
        self.times_stored = 0
        self.sender = Sender(MAX_PDU_BYTES, INTERVAL_S)
        self.receiver = Receiver(MAX_PDU_BYTES, INTERVAL_S, self.store)
        self.delivered: set[str] = set()
        self.failed: list[str] = []
        self.sent_down: list[Any] = []
        self.sent_up: list[Any] = []
        self.now_s = 0.0
        self._lose_down, self._lose_up, self._alter = lose_down, lose_up, alter

    def store(self, name: str, content: bytes) -> bool:
        self.stored[name] = content
        self.times_stored += 1
        return True

    def run(self, until_s: float) -> None:
        while self.now_s < until_s:
            down, up = self.sender.next_pdu(self.now_s), self.receiver.next_pdu(self.now_s)
            self.now_s += STEP_S
            if down is not None:
                self.sent_down.append(parse_pdu(down))
                if not self._lose_down(self.sent_down[-1], len(self.sent_down)):
                    self.receiver.receive(self._alter(down), self.now_s)
            if up is not None:
                self.sent_up.append(parse_pdu(up))
                if not self._lose_up(self.sent_up[-1], len(self.sent_up)):
                    self.sender.receive(up, self.now_s)
            for outcome in self.sender.outcomes():
                if outcome.delivered:
                    self.delivered.add(outcome.name)
                else:
                    self.failed.append(outcome.name)


def content(size_bytes: int, seed: int = 0) -> bytes:
    return random.Random(seed).randbytes(size_bytes)


def once(kind: type, times: int = 1) -> Callable[[object, int], bool]:
    """Return what loses the first PDUs of a kind."""
    left = [times]

    def lose(pdu: object, number: int) -> bool:
        hit = isinstance(pdu, kind) and left[0] > 0
        left[0] -= hit
        return hit

    return lose


def acknowledges(pdu: object, directive: DirectiveType) -> bool:
    return isinstance(pdu, AckPdu) and pdu.directive_code_of_acked_pdu == directive


@pytest.fixture
def unfix(monkeypatch):
    """Gives methods of the fixed state machines back their original form."""

    def restore(*names: str, of: type = FixedDestHandler, to: type = DestHandler) -> None:
        changed = type("Unfixed", (of,), {name: getattr(to, name) for name in names})
        user = "sender" if of is FixedSourceHandler else "receiver"
        monkeypatch.setattr(f"flightsw.icd.transfer.{user}.{of.__name__}", changed)

    yield restore
    stock_dest._AckedModeParams().lost_seg_tracker.reset()  # the original shares it with everyone


# ---- what a file transfer promises ----


def test_a_receiver_that_is_silent_for_two_and_a_half_seconds_is_waited_for():
    """It may wait for its disk: whoever gives up on it sends the file again in vain."""
    wire = Wire(lose_up=lambda pdu, number: isinstance(pdu, FinishedPdu) and wire.now_s < 2.5)
    wire.sender.put("slow", content(1000), 1, 0.0)
    wire.run(5.0)
    assert wire.delivered == {"slow"} and wire.failed == []


def test_the_version_that_the_fixes_are_for_is_installed():
    assert importlib.metadata.version("cfdp-py") == "0.7.0"


@given(
    loss=st.sampled_from([0.0, 0.02, 0.1, 0.3]),
    seed=st.integers(0, 10_000),
    sizes=st.lists(st.integers(0, 3000), min_size=1, max_size=6),
)
@settings(max_examples=40)
def test_every_file_arrives_intact_whatever_is_lost(loss, seed, sizes):
    rng = random.Random(seed)
    wire = Wire(lambda pdu, number: rng.random() < loss, lambda pdu, number: rng.random() < loss)
    files = {f"{number:08d}.obf": content(size, seed + number) for number, size in enumerate(sizes)}
    for number, (name, data) in enumerate(files.items()):
        wire.sender.put(name, data, number + 1, 0.0)
    transaction = len(files)
    while wire.delivered != set(files) and wire.now_s < 200:
        wire.run(wire.now_s + 0.5)
        for name in wire.failed:
            transaction += 1
            wire.sender.put(name, files[name], transaction, wire.now_s)
        wire.failed.clear()
    assert wire.stored == files
    assert wire.delivered == set(files)


def test_without_losses_nothing_is_sent_twice_and_the_sum_of_segments_is_the_file():
    wire = Wire()
    wire.sender.put("a", content(1500), 1, 0.0)
    wire.run(1.0)
    assert wire.delivered == {"a"}
    assert wire.sender.segments_resent == wire.receiver.segments_resent == 0
    assert sum(len(pdu.file_data) for pdu in wire.sent_down if isinstance(pdu, FileDataPdu)) == 1500
    assert wire.receiver.open_transactions == 0
    assert all(pdu.packet_len <= MAX_PDU_BYTES for pdu in wire.sent_down)


def test_a_lost_segment_is_asked_for_and_sent_again_alone():
    wire = Wire(lose_down=lambda pdu, number: number == 4)
    wire.sender.put("a", content(1500), 1, 0.0)
    wire.run(2.0)
    assert wire.stored["a"] == content(1500)
    assert wire.sender.segments_resent == 1


def test_the_oldest_file_goes_first():
    wire = Wire()
    for number in range(3):
        wire.sender.put(str(number), content(500), number + 1, 0.0)
    wire.run(1.0)
    order = [pdu.transaction_seq_num.value for pdu in wire.sent_down if isinstance(pdu, FileDataPdu)]
    assert order == sorted(order)


def test_segments_shrink_while_long_packets_are_lost_and_grow_again_afterwards():
    """As on a CAN bus that loses frames: a packet in many frames hardly ever arrives."""
    wire = Wire(lose_down=lambda pdu, number: isinstance(pdu, FileDataPdu) and len(pdu.file_data) > 60)
    wire.sender.put("a", content(1500), 1, 0.0)
    wire.run(10.0)
    assert wire.stored["a"] == content(1500) and wire.failed == []
    assert all(len(pdu.file_data) <= 60 for pdu in wire.sent_down[-20:] if isinstance(pdu, FileDataPdu))
    wire._lose_down = NEVER
    for number in range(2, 6):
        wire.sender.put(str(number), content(1500), number, wire.now_s)
        wire.run(wire.now_s + 1.0)
    assert max(len(pdu.file_data) for pdu in wire.sent_down[-8:] if isinstance(pdu, FileDataPdu)) > 150


def test_a_cut_that_hits_all_files_halves_the_segments_once():
    wire = Wire(lose_down=lambda pdu, number: isinstance(pdu, FileDataPdu) and number < 50)
    for number in range(4):
        wire.sender.put(str(number), content(1500), number + 1, 0.0)
    wire.run(5.0)
    assert wire.delivered == {"0", "1", "2", "3"}
    sizes = {len(pdu.file_data) for pdu in wire.sent_down if isinstance(pdu, FileDataPdu)}
    assert {186, 100} <= sizes <= {186, 100, 1500 % 186, 186 - 100}  # whole, halved, what is left over


def test_many_gaps_are_asked_for_in_several_short_packets_and_all_sent_in_one_round():
    wire = Wire(lose_down=lambda pdu, number: number % 3 == 0 and number < 100)
    wire.receiver = Receiver(1000, INTERVAL_S, wire.store)
    wire.sender.put("a", content(15_000), 1, 0.0)
    wire.run(5.0)
    naks = [pdu for pdu in wire.sent_up if isinstance(pdu, NakPdu)]
    assert wire.stored["a"] == content(15_000)
    assert len(naks) > 2 and all(pdu.packet_len <= MAX_NAK_BYTES for pdu in naks)
    assert naks[0].start_of_scope == 0 and naks[-1].end_of_scope == 15_000
    assert wire.sender.segments_resent == sum(len(pdu.segment_requests) for pdu in naks)


def test_the_sender_is_told_only_after_the_file_is_stored_and_not_when_it_cannot_be():
    wire = Wire()
    wire.receiver._accept = lambda name, data: False  # a full disk
    wire.sender.put("a", content(500), 1, 0.0)
    wire.run(3.0)
    assert wire.delivered == set()
    assert wire.failed == ["a"]


def test_a_silent_link_ends_in_failure_not_in_waiting():
    wire = Wire(lose_down=lambda pdu, number: True)
    wire.sender.put("a", content(500), 1, 0.0)
    wire.run(30.0)
    assert wire.failed == ["a"]
    assert wire.sender.in_flight == []


def test_a_transfer_that_the_sender_left_is_given_up():
    wire = Wire(lose_down=lambda pdu, number: number > 4)
    wire.sender.put("a", content(1500), 1, 0.0)
    wire.run(60.0)
    assert wire.receiver.open_transactions == 0
    assert wire.stored == {}


def test_a_file_reported_late_counts_as_delivered():
    wire = Wire(lose_up=lambda pdu, number: not wire.failed)  # deaf until it gives up, after 8 intervals
    wire.sender.put("a", content(500), 1, 0.0)
    wire.run(12.0)
    assert wire.failed == ["a"]
    assert wire.delivered == {"a"}


def test_a_second_copy_of_a_finished_transfer_opens_nothing():
    wire = Wire()
    wire.sender.put("a", content(500), 1, 0.0)
    wire.run(1.0)
    for pdu in list(wire.sent_down):
        wire.receiver.receive(bytes(pdu.pack()), wire.now_s)
    assert wire.receiver.open_transactions == 0
    assert wire.times_stored == 1


def test_timers_follow_the_baud_rate():
    assert timer_s(115_200) > 2 * 20_480 * 10 / 115_200  # longer than both full buffers take
    assert timer_s(3_000_000) < 1.0


# ---- hostile input ----


@given(st.binary(max_size=80))
def test_random_bytes_are_a_pdu_or_a_packet_error(data):
    with contextlib.suppress(PacketError):
        assert parse_pdu(data).packet_len == len(data)


@given(st.integers(0, 2**32))
@settings(max_examples=60)
def test_damaged_pdus_that_passed_the_crc_neither_raise_nor_yield_a_wrong_file(seed):
    rng = random.Random(seed)

    def damage(pdu: bytes) -> bytes:
        damaged = bytearray(pdu)
        for _ in range(rng.choice([0, 0, 1, 2, 5])):
            damaged[rng.randrange(len(damaged))] ^= 1 << rng.randrange(8)
        return bytes(damaged[: rng.randrange(len(damaged)) if rng.random() < 0.1 else None])

    wire = Wire(alter=damage)
    files = {str(number): content(900, number) for number in range(4)}
    for number, (name, data) in enumerate(files.items()):
        wire.sender.put(name, data, number + 1, 0.0)
    wire.run(2.0)
    for pdu in wire.sent_down + wire.sent_up:  # and everything to the wrong side too
        for side in (wire.sender, wire.receiver):
            side.receive(damage(bytes(pdu.pack())), wire.now_s)
            side.next_pdu(wire.now_s)
    assert all(data in files.values() for data in wire.stored.values())


def test_hostile_sizes_take_no_memory():
    wire = Wire()
    wire.receiver = Receiver(MAX_PDU_BYTES, INTERVAL_S, wire.store, max_file_bytes=10_000, max_open=3)
    for number in range(50):
        wire.sender = Sender(MAX_PDU_BYTES, INTERVAL_S)
        wire.sender.put("a", content(400 if number % 2 else 20_000), number + 1, 0.0)
        wire.receiver.receive(wire.sender.next_pdu(0.0) or b"", 0.0)
    assert wire.receiver.open_transactions <= 3
    assert wire.receiver.pdus_refused == 25


def test_packets_that_claim_the_last_byte_of_many_files_take_the_memory_of_four():
    """Each makes room for a whole file; a good file that follows arrives all the same."""
    wire, largest = Wire(), 10_000
    wire.receiver = Receiver(MAX_PDU_BYTES, INTERVAL_S, wire.store, max_file_bytes=largest)
    for number in range(2, 22):
        sender = Sender(MAX_PDU_BYTES, INTERVAL_S)
        sender.put("a", content(100), number, 0.0)
        first, second = (parse_pdu(sender.next_pdu(0.0) or b"") for _ in range(2))
        data = first if isinstance(first, FileDataPdu) else second
        claim = FileDataPdu(data.pdu_header.pdu_conf, FileDataParams(b"x", largest - 1))
        wire.receiver.receive(bytes(claim.pack()), 0.0)
        assert sum(file.received_bytes for file in wire.receiver.incoming()) <= 4 * largest
    assert wire.receiver.open_transactions == 4 and wire.receiver.pdus_refused == 0
    wire.sender.put("good", content(9_000), 1, 0.0)
    wire.run(10.0)
    assert wire.stored == {"good": content(9_000)} and wire.delivered == {"good"}


def test_a_nak_for_everything_many_times_costs_the_file_once():
    ranges = [(0, 0), (0, 0), (0, 5000), (100, 2**32 - 1), (900, 50), (0, 1000)]
    assert merged_ranges(ranges, 1000) == [(0, 0), (0, 1000)]


# ---- the fixed defects: each test also shows what happens without its fix ----


def four_files_with_gaps() -> Wire:
    wire = Wire(
        lose_down=lambda pdu, number: isinstance(pdu, FileDataPdu) and number in (3, 9, 20, 21),
        lose_up=once(NakPdu, 4),  # so that the next file comes while the last one waits
    )
    for number in range(4):
        wire.sender.put(str(number), content(1500, number), number + 1, 0.0)
    wire.run(20.0)
    return wire


def test_each_transaction_has_its_own_gaps(unfix):
    wire = four_files_with_gaps()
    assert wire.stored == {str(number): content(1500, number) for number in range(4)}
    assert wire.sender.segments_resent == 4
    unfix("_common_first_packet_handler")
    assert four_files_with_gaps().stored != wire.stored


def one_flipped_byte() -> Wire:
    def flip(pdu: bytes) -> bytes:
        return pdu[:-1] + bytes([pdu[-1] ^ 1]) if isinstance(parse_pdu(pdu), FileDataPdu) else pdu

    wire = Wire(alter=flip)
    wire.sender.put("a", content(500), 1, 0.0)
    wire.run(3.0)
    return wire


def test_a_byte_flipped_before_framing_is_not_reported_as_good(unfix):
    wire = one_flipped_byte()
    assert wire.stored == {} and wire.failed == ["a"]
    unfix("_handle_transfer_completion")
    assert "a" in one_flipped_byte().stored


def eof_acknowledgements() -> int:
    """Return how often an EOF sent three times is acknowledged while data is missing."""
    wire = Wire(lose_down=lambda pdu, number: isinstance(pdu, FileDataPdu))
    wire.sender.put("a", content(300), 1, 0.0)
    wire.run(0.2)
    eof = next(pdu for pdu in wire.sent_down if isinstance(pdu, EofPdu))
    for _ in range(2):
        wire.receiver.receive(bytes(eof.pack()), wire.now_s)
    wire.run(wire.now_s + 0.1)
    return sum(acknowledges(pdu, DirectiveType.EOF_PDU) for pdu in wire.sent_up)


def test_a_repeated_eof_is_acknowledged_each_time(monkeypatch):
    assert eof_acknowledgements() == 3
    monkeypatch.setattr(FixedDestHandler, "acknowledge_again", lambda self: None)
    assert eof_acknowledgements() == 1


def metadata_and_a_segment_lost() -> Wire:
    wire = Wire(lose_down=lambda pdu, number: number in (1, 4))
    wire.sender.put("a", content(1500), 1, 0.0)
    wire.run(20.0)
    return wire


def test_metadata_that_comes_after_the_eof_ends_in_a_good_file(unfix):
    wire = metadata_and_a_segment_lost()
    assert wire.stored == {"a": content(1500)}
    unfix("_handle_metadata_packet")
    assert metadata_and_a_segment_lost().delivered == set()


def test_data_that_comes_before_the_metadata_is_kept(unfix):
    assert metadata_and_a_segment_lost().sender.segments_resent == 1
    unfix("_handle_file_data_without_previous_metadata")
    assert metadata_and_a_segment_lost().sender.segments_resent > 1


def test_the_checksum_of_an_eof_before_the_metadata_is_kept(unfix):
    assert metadata_and_a_segment_lost().delivered == {"a"}
    unfix("_handle_eof_without_previous_metadata", "_handle_file_data_without_previous_metadata")
    assert metadata_and_a_segment_lost().delivered == set()


def test_the_condition_of_an_eof_is_read_right():
    config = PduConfig(ByteFieldU8(1), ByteFieldU8(2), ByteFieldU32(7), TransmissionMode.ACKNOWLEDGED)
    eof = EofPdu(config, bytes(4), 0, condition_code=ConditionCode.CANCEL_REQUEST_RECEIVED)
    assert parse_pdu(bytes(eof.pack())).condition_code == ConditionCode.CANCEL_REQUEST_RECEIVED
    assert EofPdu.unpack(eof.pack()).condition_code == ConditionCode.CANCEL_REQUEST_RECEIVED << 4  # theirs


def finished_before_the_acknowledgement() -> Wire:
    wire = Wire(lose_up=lambda pdu, number: acknowledges(pdu, DirectiveType.EOF_PDU))
    wire.sender.put("a", content(500), 1, 0.0)
    wire.run(20.0)
    return wire


def test_finished_counts_as_the_acknowledgement_of_the_eof(unfix):
    assert finished_before_the_acknowledgement().failed == []
    unfix("_check_inserted_packet", of=FixedSourceHandler, to=SourceHandler)
    assert finished_before_the_acknowledgement().failed == ["a"]


def test_a_repeated_finished_is_acknowledged_after_the_end():
    acknowledgement = [1]

    def lose_first(pdu: object, number: int) -> bool:
        hit = acknowledges(pdu, DirectiveType.FINISHED_PDU) and acknowledgement[0] > 0
        acknowledgement[0] -= hit
        return hit

    wire = Wire(lose_down=lose_first)
    wire.sender.put("a", content(500), 1, 0.0)
    wire.run(3 * INTERVAL_S)
    assert wire.delivered == {"a"}
    assert wire.receiver.open_transactions == 0
    assert sum(isinstance(pdu, FinishedPdu) for pdu in wire.sent_up) == 2


def finished_never_acknowledged() -> set[ConditionCode]:
    """Return the conditions that the receiver reports when nobody acknowledges."""
    wire = Wire(lose_down=lambda pdu, number: acknowledges(pdu, DirectiveType.FINISHED_PDU))
    wire.sender.put("a", content(500), 1, 0.0)
    wire.run(20.0)
    return {pdu.condition_code for pdu in wire.sent_up if isinstance(pdu, FinishedPdu)}


def test_a_stored_file_is_never_reported_as_cancelled(unfix):
    assert finished_never_acknowledged() == {ConditionCode.NO_ERROR}
    unfix("_handle_positive_ack_procedures")
    assert ConditionCode.POSITIVE_ACK_LIMIT_REACHED in finished_never_acknowledged()


@given(st.lists(st.tuples(st.integers(0, 30), st.integers(0, 30)), max_size=8), st.data())
def test_any_range_can_be_taken_out_of_the_gaps(ranges, data):
    gaps = Gaps()
    missing: set[int] = set()
    for start, length in ranges:
        gaps.add_lost_segment((start, start + length))
        missing |= set(range(start, start + length))
    start = data.draw(st.integers(0, 40))
    end = data.draw(st.integers(start, 60))
    gaps.remove_lost_segment((start, end))
    missing -= set(range(start, end))
    assert {byte for a, b in gaps.lost_segments for byte in range(a, b)} == missing


def test_the_original_gaps_refuse_partial_overlap():
    original = LostSegmentTracker()
    original.add_lost_segment((0, 10))
    with pytest.raises(ValueError, match="Partial overlap"):
        original.remove_lost_segment((5, 15))


def test_a_restarted_sender_with_a_new_number_does_not_mix_files():
    wire = Wire()
    wire.sender.put("old", content(1500, 1), 7, 0.0)
    wire.run(0.05)  # killed in the middle
    wire.sender = Sender(MAX_PDU_BYTES, INTERVAL_S)
    wire.sender.put("new", content(1500, 2), 8, wire.now_s)
    wire.run(3.0)
    assert wire.stored == {"new": content(1500, 2)}


def run_both_ways(sender: Sender, receiver: Receiver, until_s: float) -> list[Any]:
    """Return the outcomes of a lossless wire in simulated time."""
    outcomes, now_s = [], 0.0
    while now_s < until_s:
        down, up = sender.next_pdu(now_s), receiver.next_pdu(now_s)
        now_s += STEP_S
        if down is not None:
            receiver.receive(down, now_s)
        if up is not None:
            sender.receive(up, now_s)
        outcomes += sender.outcomes()
    return outcomes


def test_files_go_up_as_they_go_down_and_the_two_routes_do_not_mix():
    stored: dict[str, bytes] = {}

    def store(name: str, content: bytes) -> bool:
        stored[name] = content
        return True

    up = Sender(MAX_PDU_BYTES, INTERVAL_S, route=UPLINK)
    up.put("model-1", b"weights" * 100, 1, 0.0)
    outcomes = run_both_ways(up, Receiver(MAX_PDU_BYTES, INTERVAL_S, store, route=UPLINK), 3.0)
    assert [(o.name, o.delivered) for o in outcomes] == [("model-1", True)]
    assert stored == {"model-1": b"weights" * 100}
    up.put("model-2", b"weights", 2, 3.0)
    down_only = Receiver(MAX_PDU_BYTES, INTERVAL_S, store)
    pdu = up.next_pdu(3.0)
    assert pdu is not None
    down_only.receive(pdu, 3.0)
    assert (down_only.pdus_refused, down_only.open_transactions) == (1, 0)


def test_an_urgent_file_overtakes_those_under_way_and_progress_is_told():
    stored: list[str] = []

    def store(name: str, content: bytes) -> bool:
        stored.append(name)
        return True

    sender, receiver = Sender(MAX_PDU_BYTES, INTERVAL_S), Receiver(MAX_PDU_BYTES, INTERVAL_S, store)
    sender.put("slow", bytes(5000), 1, 0.0)
    for _ in range(10):
        pdu = sender.next_pdu(0.0)
        assert pdu is not None
        receiver.receive(pdu, 0.0)
    (incoming,) = receiver.incoming()
    assert (incoming.name, incoming.size_bytes) == ("slow", 5000) and 0 < incoming.received_bytes < 5000
    assert sender.unsent == 1
    sender.put("first", bytes(500), 2, 0.0, urgent=True)
    sender.put("second", bytes(500), 3, 0.0, urgent=True)
    run_both_ways(sender, receiver, 3.0)
    assert stored == ["first", "second", "slow"]
    assert receiver.incoming() == [] and sender.unsent == 0
