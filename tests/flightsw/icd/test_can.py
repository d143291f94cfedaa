"""Packets over CAN: ISO-TP messages, with loss, repetition and hostile frames."""

import isotp
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flightsw.icd.link.can import FLIGHT_IDS, GROUND_IDS, MAX_MESSAGE_BYTES, OFFERS, IsoTpChannels
from flightsw.icd.link.framing import frame_packet
from flightsw.icd.link.link_url import parse_link_url
from flightsw.icd.link.slcan import FD_SIZES, format_slcan

CLASSIC, FD = (parse_link_url(f"slcan:///dev/null?fd={fd}") for fd in (0, 1))
BOTH = pytest.mark.parametrize("url", [CLASSIC, FD], ids=["classic", "fd"])


class Wire:
    """Both sides' channels, and a wire that a test may damage."""

    def __init__(self, url):
        self.flight = IsoTpChannels(FLIGHT_IDS, GROUND_IDS, url)
        self.ground = IsoTpChannels(GROUND_IDS, FLIGHT_IDS, url)
        self.received = b""
        self.now_s = 0.0
        self.down: list[isotp.CanMessage] = []

    def run(self, alter=lambda frames: frames) -> bytes:
        """Pass frames to and fro until both are quiet; return what the ground received."""
        _, down = self.flight.exchange([], self.now_s)
        while down:
            self.down += down
            packets, up = self.ground.exchange(alter(down), self.now_s)
            self.received += packets
            _, down = self.flight.exchange(up, self.now_s)
        return self.received


@BOTH
@given(
    packets=st.lists(
        st.integers(1, 4096).flatmap(lambda n: st.binary(min_size=n, max_size=n)), min_size=1, max_size=12
    )
)
@settings(max_examples=25)
def test_packets_of_any_length_arrive_whole_and_in_order(url, packets):
    wire = Wire(url)
    framed = b"".join(map(frame_packet, packets))
    wire.flight.write(framed)
    assert wire.run() == framed
    assert wire.ground.frames_discarded == wire.flight.messages_failed == 0
    assert len(frame_packet(bytes(4096))) <= MAX_MESSAGE_BYTES


@BOTH
def test_frames_are_those_of_iso_15765_2(url):
    """Against the byte tables of the standard, by hand."""
    wire = Wire(url)
    message = bytes(range(1, 126))
    wire.flight.write(message + b"\0")
    wire.run()
    size = 64 if url.fd else 8
    assert wire.down[0].data == bytes([0x10, 125]) + message[: size - 2]  # first frame
    assert wire.down[1].data[:size] == (bytes([0x21]) + message[size - 2 :])[:size]  # consecutive frame 1
    assert {frame.arbitration_id for frame in wire.down} == {FLIGHT_IDS[0]}
    assert all(len(frame.data) in FD_SIZES for frame in wire.down)


@BOTH
def test_a_message_that_lost_a_frame_is_dropped_and_counted_and_the_next_one_passes(url):
    wire = Wire(url)
    first, second = frame_packet(bytes(range(1, 200)) * 3), frame_packet(bytes(range(1, 200)) * 2)

    def lose_one(frames):
        return [frame for number, frame in enumerate(frames) if number != 3 or len(frames) < 5]

    wire.flight.write(first)
    assert wire.run(lose_one) == b""
    wire.flight.write(second)
    assert wire.run() == second
    assert wire.ground.frames_discarded > 0


@BOTH
def test_a_frame_that_comes_twice_harms_nothing(url):
    wire = Wire(url)
    framed = frame_packet(bytes(range(1, 200)) * 3)
    wire.flight.write(framed)
    assert (
        wire.run(lambda frames: [frame for frame in frames for _ in range(1 + (frame.data[0] >> 4 == 2))])
        == framed
    )
    assert wire.ground.frames_repeated > 0
    assert wire.ground.frames_discarded == 0


@BOTH
def test_a_short_packet_neither_overtakes_a_long_one_nor_waits_for_it(url):
    wire = Wire(url)
    packets = [frame_packet(bytes(range(1, 200))), frame_packet(b"end"), frame_packet(bytes(range(1, 200)))]
    wire.flight.write(b"".join(packets))
    _, down = wire.flight.exchange([], 0.0)
    assert [frame.data[0] >> 4 for frame in down] == [1, 1, 1]  # three first frames: all are under way
    wire.received, up = wire.ground.exchange(down, 0.0)
    while up:
        _, down = wire.flight.exchange(up, 0.0)
        packets_now, up = wire.ground.exchange(down, 0.0)
        wire.received += packets_now
    assert wire.received == b"".join(packets)


def test_can_fd_has_20_ms_under_way_and_no_more_than_an_adapter_and_a_terminal_hold():
    """Half of the channels wait behind the others' data with their first frames."""
    wire = Wire(FD)
    framed = frame_packet(bytes(1100))
    wire.flight.write(40 * framed)
    _, down = wire.flight.exchange([], 0.0)
    assert len(down) / 2 * len(framed) * 10 / FD.payload_baud_rate > 0.02
    text_bytes = sum(map(len, map(format_slcan, down)))
    _, up = wire.ground.exchange(down, 0.0)
    text_bytes += sum(map(len, map(format_slcan, wire.flight.exchange(up, 0.0)[1])))
    assert text_bytes < 32_768 + 19_456  # as measured of a pseudo-terminal; the adapter is the virtual one
    assert len({frame.arbitration_id for frame in down}) == len(down)


def pass_time(wire: Wire, seconds: float, look_s: float = 0.02) -> list[isotp.CanMessage]:
    """Let both sides look at their ports, where nothing comes, for a while; return the frames that flight sends."""
    frames = []
    for _ in range(round(seconds / look_s)):
        wire.now_s += look_s
        frames += wire.flight.exchange([], wire.now_s)[1]
        wire.ground.exchange([], wire.now_s)
    return frames


@BOTH
def test_a_message_that_nobody_answers_is_offered_again_and_in_the_end_given_up_and_counted(url):
    wire = Wire(url)
    wire.flight.write(frame_packet(bytes(range(1, 100))))
    _, offers = wire.flight.exchange([], wire.now_s)
    offers += pass_time(wire, 10.0)
    assert len(offers) == OFFERS
    assert {(frame.data[0] >> 4, frame.data) for frame in offers} == {
        (1, offers[0].data)
    }  # first frames, all alike
    assert wire.flight.messages_failed == 1 and wire.flight.ready


@BOTH
def test_an_offer_or_its_answer_that_is_lost_costs_time_and_no_message(url):
    wire = Wire(url)
    framed = frame_packet(bytes(range(1, 200)) * 3)
    wire.flight.write(framed)
    wire.flight.exchange([], wire.now_s)  # this offer is lost
    second = pass_time(wire, 0.5)
    assert len(second) == 1
    wire.ground.exchange(second, wire.now_s)  # its answer is lost
    third = pass_time(wire, 1.0)
    assert len(third) == 1
    _, answers = wire.ground.exchange(third, wire.now_s)
    _, rest = wire.flight.exchange(answers, wire.now_s)
    assert wire.ground.exchange(rest, wire.now_s)[0] == framed
    assert wire.ground.frames_discarded == wire.flight.messages_failed == 0


@BOTH
def test_offers_that_waited_unread_together_are_answered_once(url):
    """A second answer would be taken for that to the channel's next message, which would overtake others."""
    wire = Wire(url)
    wire.flight.write(frame_packet(bytes(range(1, 100))))
    _, offers = wire.flight.exchange([], wire.now_s)
    offers += pass_time(wire, 1.0)
    assert len(offers) > 1
    assert len(wire.ground.exchange(offers, wire.now_s)[1]) == 1


@BOTH
def test_a_second_answer_that_comes_late_lets_no_message_overtake_another(url):
    """Where computers or adapters are busy, an offer and its repetition may both be answered."""
    wire = Wire(url)
    packets = [frame_packet(bytes([number]) * 100) for number in (1, 2, 3)]
    wire.flight.write(packets[0])
    _, offer = wire.flight.exchange([], wire.now_s)
    _, answer = wire.ground.exchange(offer, wire.now_s)
    offer_again = pass_time(wire, 0.5)
    _, second_answer = wire.ground.exchange(offer_again, wire.now_s)
    assert len(answer) == len(second_answer) == 1
    wire.flight.write(packets[1])
    _, down = wire.flight.exchange([], wire.now_s)
    down += wire.flight.exchange(answer, wire.now_s)[1]
    wire.flight.write(packets[2])
    down += wire.flight.exchange([], wire.now_s)[1]
    down += wire.flight.exchange(second_answer, wire.now_s)[1]
    while down:
        packet, up = wire.ground.exchange(down, wire.now_s)
        wire.received += packet
        _, down = wire.flight.exchange(up, wire.now_s)
    assert wire.received == b"".join(packets)
    assert wire.ground.frames_discarded == wire.flight.messages_failed == 0


@BOTH
def test_a_channel_whose_second_answer_never_comes_is_used_again(url):
    wire = Wire(url)
    packet = frame_packet(bytes(range(1, 100)))
    wire.flight.write(packet)
    _, offer = wire.flight.exchange([], wire.now_s)
    _, answer = wire.ground.exchange(offer, wire.now_s)
    pass_time(wire, 0.5)
    wire.flight.exchange(answer, wire.now_s)
    channels = {offer[0].arbitration_id}
    pass_time(wire, 1.5)
    wire.flight.write(packet)
    _, offer = wire.flight.exchange([], wire.now_s)
    assert {frame.arbitration_id for frame in offer} == channels


@BOTH
def test_time_in_which_a_side_does_not_look_at_its_port_ends_no_message(url):
    wire = Wire(url)
    framed = frame_packet(bytes(range(1, 200)) * 3)
    wire.flight.write(framed)
    _, first = wire.flight.exchange([], 0.0)
    _, answer = wire.ground.exchange(first, 0.0)
    _, rest = wire.flight.exchange(answer, 100.0)  # the answer lay in flight's port for 100 s
    half = len(rest) // 2
    assert wire.ground.exchange(rest[:half], 0.1)[0] == b""
    assert wire.ground.exchange(rest[half:], 100.0)[0] == framed
    assert wire.ground.frames_discarded == wire.flight.messages_failed == 0


@BOTH
def test_the_rest_of_a_message_to_someone_who_listened_before_is_no_loss(url):
    before, now = Wire(url), Wire(url)
    framed = frame_packet(bytes(range(1, 200)) * 3)
    before.flight.write(framed)
    first = before.flight.exchange([], 0.0)[1]
    answers = before.ground.exchange(first, 0.0)[1]
    rest = before.flight.exchange(answers, 0.0)[1]
    assert now.ground.exchange(rest, 0.0)[0] == b"" and now.ground.frames_discarded == 0
    before.ground.abandon()  # as when a port is opened again
    assert before.ground.exchange(rest, 0.1)[0] == b"" and before.ground.frames_discarded == 0
    now.flight.write(framed)
    assert now.run() == framed
    assert now.ground.exchange(rest, 100.0)[0] == b"" and now.ground.frames_discarded > 0


@BOTH
def test_a_message_whose_rest_never_comes_is_dropped_and_counted(url):
    wire = Wire(url)
    wire.flight.write(frame_packet(bytes(range(1, 200)) * 3))
    wire.run(lambda frames: frames[:1])
    pass_time(wire, 10.0)
    assert wire.ground.frames_discarded == 1


@BOTH
def test_long_packets_under_way_are_no_more_than_an_adapter_and_a_terminal_hold(url):
    wire = Wire(url)
    wire.flight.write(40 * frame_packet(bytes(4096)))
    _, down = wire.flight.exchange([], 0.0)
    text_bytes = sum(map(len, map(format_slcan, down)))
    _, up = wire.ground.exchange(down, 0.0)
    text_bytes += sum(map(len, map(format_slcan, wire.flight.exchange(up, 0.0)[1])))
    assert text_bytes < 32_768 + 17_396  # as measured of a pseudo-terminal; the adapter is the virtual one


def test_frames_of_other_nodes_are_not_for_us():
    wire = Wire(CLASSIC)
    other = [
        isotp.CanMessage(0x123, 3, b"\x02ab"),
        isotp.CanMessage(FLIGHT_IDS[0], 3, b"\x02ab", extended_id=True),
    ]
    assert wire.ground.exchange(other, 0.0) == (b"", [])
    assert wire.ground.frames_foreign == 2


@BOTH
@given(st.data())
@settings(max_examples=60)
def test_hostile_frames_neither_raise_nor_take_memory_nor_yield_more_than_they_carry(url, data):
    ground = IsoTpChannels(GROUND_IDS, FLIGHT_IDS, url)
    carried = yielded = 0
    for _ in range(data.draw(st.integers(1, 60))):
        size = data.draw(st.sampled_from(FD_SIZES if url.fd else FD_SIZES[:9]))
        content = data.draw(st.binary(min_size=size, max_size=size))
        if content and data.draw(st.booleans()):  # else random bytes rarely make a sequence
            content = (
                bytes([data.draw(st.sampled_from([0x03, 0x10, 0x20, 0x21, 0x22, 0x30, 0x32]))]) + content[1:]
            )
        frame = isotp.CanMessage(data.draw(st.sampled_from(FLIGHT_IDS[:2])), FD_SIZES.index(size), content)
        packets, answers = ground.exchange([frame], 0.0)
        carried, yielded = carried + size, yielded + len(packets) - packets.count(b"\0")
        assert len(answers) <= 1
    assert yielded <= carried
    buffers = [channel.received_bytes for channel in ground._channels.values()]
    assert max(buffers) <= MAX_MESSAGE_BYTES
