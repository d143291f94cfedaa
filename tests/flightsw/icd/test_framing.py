"""Packets in a byte stream: any chunking, no accepted damage, every byte counted."""

import binascii

import pytest
from hypothesis import given
from hypothesis import strategies as st

from flightsw.icd.link.framing import CRC_BYTES, Deframer, PacketStream, frame_packet, max_frame_bytes
from flightsw.icd.packet import APID_EVENTS, APID_FILES, APIDS, TELECOMMAND, TELEMETRY, pack_packet

MAX_PACKET_BYTES = 300
packets = st.lists(st.binary(min_size=1, max_size=MAX_PACKET_BYTES), max_size=8)


def total_bytes(deframer: Deframer) -> int:
    heard = deframer.packet_bytes + deframer.idle_bytes + deframer.joined_bytes
    return heard + deframer.skipped_bytes + deframer.pending_bytes


@given(packets, st.lists(st.integers(1, 400), max_size=20))
def test_any_chunking_of_the_stream_yields_the_same_packets(sent, chunk_sizes):
    stream = b"".join(frame_packet(packet) for packet in sent)
    deframer = Deframer(MAX_PACKET_BYTES)
    received = []
    for size in chunk_sizes:
        received += deframer.feed(stream[:size])
        stream = stream[size:]
    received += deframer.feed(stream)
    assert received == sent
    assert deframer.skipped_bytes == 0


@given(st.binary(min_size=1, max_size=MAX_PACKET_BYTES), st.data())
def test_a_flipped_bit_is_never_accepted(packet, data):
    framed = bytearray(frame_packet(packet))
    bit = data.draw(st.integers(0, 8 * len(framed) - 1))
    framed[bit // 8] ^= 1 << bit % 8
    deframer = Deframer(MAX_PACKET_BYTES)
    received = deframer.feed(b"\0" + bytes(framed) + b"\0" + frame_packet(b"next"))
    assert received == [b"next"]
    assert deframer.crc_errors >= 1
    assert total_bytes(deframer) == 1 + len(framed) + 1 + len(frame_packet(b"next"))


@given(st.lists(st.binary(max_size=2000), max_size=10))
def test_hostile_bytes_take_no_memory_and_are_all_counted(chunks):
    deframer = Deframer(MAX_PACKET_BYTES)
    for chunk in chunks:
        deframer.feed(chunk)
        assert deframer.pending_bytes <= max_frame_bytes(MAX_PACKET_BYTES)
    assert total_bytes(deframer) == sum(map(len, chunks))


def test_a_receiver_that_starts_in_the_middle_is_in_step_at_the_next_packet():
    stream = frame_packet(b"first packet") + frame_packet(b"second")
    deframer = Deframer(MAX_PACKET_BYTES)
    assert deframer.feed(stream[5:]) == [b"second"]
    assert deframer.joined_bytes == len(frame_packet(b"first packet")) - 5
    assert deframer.skipped_bytes == deframer.crc_errors == 0, "nothing was damaged"
    assert deframer.feed(stream[5:]) == [b"second"]
    assert deframer.crc_errors == 1, "in the midst of the stream it is damage"


def test_a_delimiter_with_its_lowest_bit_flipped_adds_no_byte_to_the_packet():
    framed = frame_packet(b"\0")
    assert Deframer(MAX_PACKET_BYTES).feed(framed[:-1] + b"\x01\0") == []


def test_the_longest_packet_passes_and_a_longer_one_does_not():
    deframer = Deframer(MAX_PACKET_BYTES)
    longest = bytes(range(1, 255)) + b"x" * (MAX_PACKET_BYTES - 254)
    assert deframer.feed(frame_packet(longest)) == [longest]
    assert deframer.feed(frame_packet(longest + b"yyyy")) == []
    assert deframer.crc_errors == 1


def test_crc_is_that_of_the_catalogue():
    framed = frame_packet(b"123456789")
    assert framed[-1 - CRC_BYTES : -1] == bytes([0xD6, 0x4E])  # check value of CRC-16/GENIBUS
    assert (
        binascii.crc_hqx(b"123456789", 0xFFFF) ^ 0xFFFF == 0xD64E
    )  # the standard library's, by another route


def test_gaps_in_the_count_are_noticed_and_late_packets_taken_back():
    flight = PacketStream(TELEMETRY, MAX_PACKET_BYTES)
    ground = PacketStream(TELECOMMAND, MAX_PACKET_BYTES)
    wire = [flight.encode(APID_FILES, bytes([number])) for number in range(6)]
    for number in (0, 1, 4, 3):  # 2 is lost, 3 comes late
        assert ground.decode(wire[number]) == [(APID_FILES, bytes([number]))]
        assert ground.decode(flight.encode(APID_EVENTS, b"counted on its own"))
    assert ground.packets_missing == 1
    assert ground.packets_received == 8


def numbered(seq_count: int) -> bytes:
    return frame_packet(pack_packet(TELEMETRY, APID_FILES, seq_count % (1 << 14), b"numbered"))


@given(st.integers(0, (1 << 14) - 1), st.data())
def test_whatever_is_lost_doubled_and_swapped_each_missing_packet_counts_once(first, data):
    copies = data.draw(st.lists(st.integers(0, 2), min_size=1, max_size=150))
    sent = [number for number, times in enumerate(copies) for _ in range(times)]
    delays = data.draw(st.lists(st.integers(0, 20), min_size=len(sent), max_size=len(sent)))
    order = [number for _, number in sorted(zip(map(sum, zip(sent, delays, strict=True)), sent, strict=True))]
    ground = PacketStream(TELECOMMAND, MAX_PACKET_BYTES)
    for number in order:
        ground.decode(numbered(first + number))
    # what was sent before the first packet that came is not known to exist
    expected = set(range(order[0], max(order) + 1)) - set(order) if order else set()
    assert ground.packets_missing == len(expected)


@pytest.mark.parametrize(
    ("heard_before", "unheard"), [(200, 0), (5000, 0), (5000, 500), (12_000, 0), (12_000, 500)]
)
def test_a_new_start_of_the_other_side_is_no_loss_and_hides_none(heard_before, unheard):
    ground = PacketStream(TELECOMMAND, MAX_PACKET_BYTES)
    for number in range(heard_before):
        ground.decode(numbered(number))
    for number in range(unheard, 3000):  # from 0 again, perhaps while the link was cut
        if number % 10 != 5:
            ground.decode(numbered(number))
    lost = sum(number % 10 == 5 for number in range(unheard, 3000))
    assert ground.packets_missing == lost


@pytest.mark.parametrize("heard_before", [1, 700, 16_000])
@pytest.mark.parametrize("cut", [1, 500, 1500, 5000])
def test_what_a_cut_of_the_link_loses_is_counted(heard_before, cut):
    """700 and 1,500 would not do if a jump that ends near 0 were always taken for a new start."""
    ground = PacketStream(TELECOMMAND, MAX_PACKET_BYTES)
    for number in [*range(heard_before), heard_before + cut]:
        ground.decode(numbered(number))
    wrapped = (heard_before + cut) % (1 << 14)
    looks_like_a_new_start = cut > 1024 and wrapped < 1024
    assert ground.packets_missing == (0 if looks_like_a_new_start else cut)


def test_packets_of_another_application_or_our_own_echo_are_not_for_us():
    flight = PacketStream(TELEMETRY, MAX_PACKET_BYTES)
    foreign = frame_packet(pack_packet(TELECOMMAND, APIDS.stop, 0, b"other"))
    echo = flight.encode(APID_FILES, b"echo")
    assert flight.decode(echo + foreign + frame_packet(b"short")) == []
    assert flight.packets_foreign == 3


def test_the_sequence_count_wraps_without_a_gap():
    flight = PacketStream(TELEMETRY, MAX_PACKET_BYTES)
    ground = PacketStream(TELECOMMAND, MAX_PACKET_BYTES)
    for _ in range((1 << 14) + 2):
        (_, data), *more = ground.decode(flight.encode(APID_FILES, b"next"))
        assert data == b"next" and not more
    assert (ground.packets_missing, ground.packets_received) == (0, (1 << 14) + 2)
