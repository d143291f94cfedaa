"""An answer counts only for the very file, store and transaction that it names, and with a key only from its owner."""

import random

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from spacepackets.cfdp import ConditionCode, Direction, TransmissionMode
from spacepackets.cfdp.conf import PduConfig
from spacepackets.cfdp.pdu import FileDataPdu, FinishedPdu, NakPdu
from spacepackets.cfdp.pdu.file_data import FileDataParams
from spacepackets.cfdp.pdu.finished import DeliveryCode, FileStatus, FinishedParams
from spacepackets.util import ByteFieldU8, ByteFieldU32

from flightsw.icd.codestream import encode_pixels
from flightsw.icd.frame import HEADER
from flightsw.icd.link.auth import Key
from flightsw.icd.mission import CameraSection
from flightsw.icd.transfer import Outcome, Receiver, Sender, Verdict, answer_key, parse_pdu
from flightsw.icd.transfer.cfdp_fixes import Gaps
from flightsw.icd.transfer.checksum import RunningChecksum
from flightsw.icd.transfer.receipt import attach, receipt

MAX_PDU_BYTES = 200
INTERVAL_S = 0.5
STORE, OTHER_STORE = b"store  1", b"store  2"
KEY, OTHER_KEY = (answer_key(Key(1, bytes([number]) * 32)) for number in (1, 2))


class Ground:
    """A receiver that keeps what it stores, and says what it is told to say."""

    def __init__(self, key: bytes | None = None, verdict: Verdict = Verdict.STORED):
        self.stored: list[bytes] = []
        self.verdict = verdict
        self.receiver = Receiver(MAX_PDU_BYTES, INTERVAL_S, self.accept, key=key)

    def accept(self, name: str, content: bytes) -> Verdict:
        if self.verdict:
            self.stored.append(content)
        return self.verdict


def send(
    sender: Sender, ground: Ground | None, content: bytes, number: int = 7, forged: bytes = b""
) -> Outcome:
    """Send a file and return how that ended; `forged` comes once in place of an answer."""
    now_s = 0.0
    sender.put("00000000.obf", content, number, now_s)
    while True:
        now_s += 0.01
        down = sender.next_pdu(now_s)
        if ground is not None:
            if down is not None:
                ground.receiver.receive(down, now_s)
            if (up := ground.receiver.next_pdu(now_s)) is not None:
                sender.receive(up, now_s)
        if forged and now_s > 1.0:
            sender.receive(forged, now_s)
            forged = b""
        if outcomes := sender.outcomes():
            return outcomes[0]


def sender(store: bytes = STORE, *keys: bytes) -> Sender:
    return Sender(MAX_PDU_BYTES, INTERVAL_S, store=store, keys=keys)


def finished(number: int, given: bytes = b"", verdict: Verdict = Verdict.STORED) -> bytes:
    params = FinishedParams.success_params()
    if not verdict:
        rejected = FileStatus.DISCARDED_FILESTORE_REJECTION
        params = FinishedParams(ConditionCode.FILESTORE_REJECTION, DeliveryCode.DATA_INCOMPLETE, rejected)
    if given:
        attach(params, verdict, given)
    return bytes(FinishedPdu(configuration(number), params).pack())


def configuration(number: int) -> PduConfig:
    return PduConfig(
        source_entity_id=ByteFieldU8(1),
        dest_entity_id=ByteFieldU8(2),
        transaction_seq_num=ByteFieldU32(number),
        trans_mode=TransmissionMode.ACKNOWLEDGED,
        direction=Direction.TOWARDS_RECEIVER,
    )


@pytest.mark.parametrize("first", [b"a" * 500, b"a" * 900])
@pytest.mark.parametrize("store", [STORE, OTHER_STORE])
def test_another_file_under_a_number_that_was_used_is_stored_before_it_counts_as_delivered(first, store):
    ground, content = Ground(), b"b" * 500
    assert send(sender(), ground, first).delivered
    assert send(sender(store), ground, content).delivered
    assert ground.stored == [first, content]


def test_the_same_file_again_is_answered_without_being_stored_again():
    ground, content = Ground(), b"b" * 500
    assert send(sender(), ground, content).delivered and send(sender(), ground, content).delivered
    assert ground.stored == [content]


SHA256 = bytes.fromhex("c775e7b757ede630cd0aa1113bd102661ab38829ca52a6422ab782862f268646")  # of 1234567890
FORGED = {
    "of another file": finished(7, receipt(Verdict.STORED, STORE, 7, bytes(32), None)),
    "of another store": finished(7, receipt(Verdict.STORED, OTHER_STORE, 7, SHA256, None)),
    "of another transaction": finished(7, receipt(Verdict.STORED, STORE, 8, SHA256, None)),
    "a rejection": finished(7, receipt(Verdict.REJECTED, STORE, 7, SHA256, None)),
    "cut": finished(7, receipt(Verdict.STORED, STORE, 7, SHA256, None)[:15]),
}


@pytest.mark.parametrize("forged", FORGED.values(), ids=FORGED)
def test_a_receipt_for_anything_else_confirms_nothing(forged):
    assert not send(sender(), None, b"1234567890", forged=forged).delivered


def test_the_receipt_for_this_very_file_confirms_it():
    fitting = finished(7, receipt(Verdict.STORED, STORE, 7, SHA256, None))
    assert send(sender(), None, b"1234567890", forged=fitting).delivered


@pytest.mark.parametrize(
    "given", [b"", receipt(Verdict.STORED, STORE, 7, SHA256, None)], ids=["none", "no tag"]
)
def test_with_a_key_on_board_nobody_without_it_confirms_a_file(given):
    assert not send(sender(STORE, KEY), None, b"1234567890", forged=finished(7, given)).delivered


@pytest.mark.parametrize(
    ("on_board", "at_the_ground", "delivered"),
    [
        ((), None, True),
        ((), KEY, True),
        ((KEY,), KEY, True),
        ((KEY, OTHER_KEY), OTHER_KEY, True),
        ((KEY,), OTHER_KEY, False),
        ((KEY,), None, False),
    ],
)
def test_a_key_on_board_must_be_that_of_the_ground(on_board, at_the_ground, delivered):
    ground, content = Ground(at_the_ground), b"c" * 500
    outcome = send(sender(STORE, *on_board), ground, content)
    assert (outcome.delivered, outcome.refused) == (delivered, not delivered)
    assert ground.stored == [content]


def test_a_rejected_file_is_told_from_one_that_cannot_be_stored_now():
    rejected = send(sender(STORE, KEY), Ground(KEY, Verdict.REJECTED), b"d" * 500)
    unstored = send(sender(STORE, KEY), Ground(KEY, Verdict.UNSTORED), b"d" * 500)
    assert (rejected.delivered, rejected.refused, rejected.reason) == (False, True, "rejected")
    assert (unstored.delivered, unstored.refused, unstored.reason) == (False, False, "FILESTORE_REJECTION")


# ---- limits ----


@given(st.lists(st.tuples(st.booleans(), st.integers(0, 60), st.integers(0, 20)), max_size=60))
def test_gaps_are_never_more_than_allowed_and_miss_nothing(steps):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("flightsw.icd.transfer.cfdp_fixes.MAX_GAPS", 4)
        gaps, missing = Gaps(), set()
        for adds, start, length in steps:
            span = set(range(start, start + length))
            if adds:
                gaps.add_lost_segment((start, start + length))
                missing |= span
            else:
                gaps.remove_lost_segment((start, start + length))
                missing -= span
            assert len(gaps.lost_segments) <= 4
            edges = [edge for gap in gaps.lost_segments for edge in gap]
            assert edges == sorted(set(edges))  # apart, and none empty
            assert missing <= {byte for a, b in gaps.lost_segments for byte in range(a, b)}


def test_a_file_with_more_gaps_than_allowed_arrives(monkeypatch):
    monkeypatch.setattr("flightsw.icd.transfer.cfdp_fixes.MAX_GAPS", 5)
    content, lost = random.Random(1).randbytes(20_000), random.Random(2)
    ground, tx, now_s = Ground(), sender(), 0.0
    tx.put("00000000.obf", content, 1, now_s)
    while not (outcomes := tx.outcomes()):
        now_s += 0.01
        down, up = tx.next_pdu(now_s), ground.receiver.next_pdu(now_s)
        if down is not None and lost.random() > 0.3:
            ground.receiver.receive(down, now_s)
        if up is not None:
            tx.receive(up, now_s)
    assert outcomes[0].delivered and ground.stored == [content]


@pytest.mark.parametrize("checksum", ["crc-32", "crc-32c", "modular"])
def test_no_call_checks_more_than_a_part_of_a_file(monkeypatch, checksum):
    """Where the file's first bytes come last, all the others are still to be checked then."""
    part_bytes, added = 1000, []
    monkeypatch.setattr("flightsw.icd.transfer.cfdp_fixes.DIGEST_BYTES", part_bytes)
    add = RunningChecksum.add
    monkeypatch.setattr(RunningChecksum, "add", lambda self, part: (added.append(len(part)), add(self, part)))
    content, stored, most = random.Random(1).randbytes(20_001), [], 0
    tx = Sender(MAX_PDU_BYTES, INTERVAL_S, store=STORE, keys=[KEY], checksum=checksum)
    rx = Receiver(
        MAX_PDU_BYTES,
        INTERVAL_S,
        lambda name, data: stored.append(data) or True,
        checksum=checksum,
        key=KEY,
    )
    tx.put("00000000.obf", content, 1, 0.0)
    for turn in range(3000):
        now_s, before = turn * 0.01, len(added)
        down = tx.next_pdu(now_s)
        most, before = max(most, sum(added[before:])), len(added)
        is_first = (
            down is not None and isinstance(parse_pdu(down), FileDataPdu) and parse_pdu(down).offset == 0
        )
        if down is not None and not (is_first and now_s < 2.0):
            rx.receive(down, now_s)
            most, before = max(most, sum(added[before:])), len(added)
        if (up := rx.next_pdu(now_s)) is not None:
            tx.receive(up, now_s)
        most = max(most, sum(added[before:]))
    (outcome,) = tx.outcomes()
    assert outcome.delivered and stored == [content]
    assert sum(added) == 2 * len(content) and most <= 2 * part_bytes


def test_a_segment_with_other_bytes_does_not_change_what_was_checked():
    content, ground, tx = random.Random(1).randbytes(1000), Ground(KEY), sender(STORE, KEY)
    forged = FileDataPdu(configuration(7), FileDataParams(b"forged" * 10, 0))
    receive = ground.receiver.receive

    def received_twice(data: bytes, now_s: float) -> None:
        receive(data, now_s)
        if isinstance(parse_pdu(data), FileDataPdu):
            receive(bytes(forged.pack()), now_s)

    ground.receiver.receive = received_twice
    assert send(tx, ground, content).delivered and ground.stored == [content]


def test_naks_are_made_one_by_one_and_ask_for_everything():
    ground, rest = Ground(), 400
    for offset in range(0, 2 * rest, 2):  # each second byte
        data = FileDataPdu(configuration(1), FileDataParams(b"x", offset))
        ground.receiver.receive(bytes(data.pack()), 0.0)
    tx = sender()
    tx.put("00000000.obf", b"x" * 2 * rest, 1, 0.0)
    while (down := tx.next_pdu(0.0)) is not None:
        if not isinstance(parse_pdu(down), FileDataPdu):
            ground.receiver.receive(down, 0.0)
    naks = []
    while (up := ground.receiver.next_pdu(1.0)) is not None:
        if isinstance(pdu := parse_pdu(up), NakPdu):
            naks.append(pdu)
    asked = [request for nak in naks for request in nak.segment_requests]
    assert len(naks) > 20 and asked == [(offset, offset + 1) for offset in range(1, 2 * rest, 2)]
    scopes = [(nak.start_of_scope, nak.end_of_scope) for nak in naks]
    assert scopes[0][0] == 0 and scopes[-1][1] == 2 * rest and scopes == sorted(scopes)


@pytest.mark.parametrize(
    ("side_px", "channels", "bit_depth"), [(1, 1, 8), (16, 3, 16), (40, 1, 16), (300, 3, 12)]
)
def test_no_container_is_larger_than_the_ground_takes_from_this_camera(side_px, channels, bit_depth):
    camera = CameraSection(side_px, side_px, 100.0, 100.0, 1.0, 1.0, channels=channels, bit_depth=bit_depth)
    shape = (side_px, side_px) + ((3,) if channels == 3 else ())
    noise = np.random.default_rng(0).integers(0, 1 << bit_depth, shape).astype(np.uint16)
    assert HEADER.size + 4 + len(encode_pixels(noise, 0)) <= camera.max_container_bytes
