"""The virtual CAN bus: a frame's bits, arbitration, python-can as an independent client, faults that are counted."""

import contextlib
import os
import time
from collections.abc import Iterator

import can
import pytest
from can.interfaces.slcan import slcanBus
from hypothesis import given
from hypothesis import strategies as st
from isotp import CanMessage

from flightsw.icd.link.link_url import parse_link_url
from flightsw.icd.link.slcan import FD_SIZES, SlcanText, format_slcan, open_slcan
from hil.links.can_timing import frame_bits, frame_s
from hil.links.faults import Faults
from hil.links.virtual_can import VirtualCan

FRAMES = [CanMessage(0x100 + number % 50, 8, number.to_bytes(8, "big")) for number in range(400)]


def classic_bits_by_hand(frame: CanMessage) -> int:
    """Return a classic frame's number of bits by ISO 11898-1, built bit by bit."""
    number = frame.arbitration_id
    head = f"0{number >> 18:011b}11{number & 0x3FFFF:018b}0" if frame.is_extended_id else f"0{number:011b}0"
    head += "00" + f"{len(frame.data):04b}" + "".join(f"{byte:08b}" for byte in frame.data)
    crc = 0
    for bit in head:
        crc_next = (bit == "1") ^ (crc >> 14 & 1)
        crc = crc << 1 & 0x7FFF
        if crc_next:
            crc ^= 0x4599
    stuffed = ""
    for bit in head + f"{crc:015b}":
        stuffed += bit
        if stuffed[-5:] in ("00000", "11111"):
            stuffed += "1" if bit == "0" else "0"
    return len(stuffed) + 1 + 2 + 7 + 3


@given(st.integers(0, 0x7FF), st.binary(max_size=8), st.booleans())
def test_a_classic_frame_has_the_bits_of_the_standard(number, data, extended):
    frame = CanMessage(number << (18 if extended else 0), len(data), data, extended_id=extended)
    assert frame_bits(frame) == (classic_bits_by_hand(frame), 0)


@given(st.integers(0, 0x7FF), st.integers(0, 8))
def test_a_frame_is_never_longer_than_the_worst_case_of_the_literature(number, size):
    """Davis et al., Controller Area Network schedulability analysis, 2007: 55 + 10 bits a byte, 11-bit identifier."""
    for fill in (0x00, 0xFF, 0x0F, 0xF0, 0x55):
        bits, _ = frame_bits(CanMessage(number, size, bytes([fill]) * size))
        assert 47 + 8 * size <= bits <= 55 + 10 * size


def test_a_can_fd_frame_sends_its_data_at_the_higher_rate():
    frame = CanMessage(0x555, 15, b"\x55" * 64, is_fd=True, bitrate_switch=True)
    nominal_bits, data_bits = frame_bits(frame)
    # nothing to stuff but FDF 1, res 0, BRS 1 and zeros after: ESI, length 1111, data, count 4, CRC 21, fixed 7
    assert data_bits == 5 + 512 + 4 + 21 + 7
    assert nominal_bits == 17 + 13
    assert frame_s(frame, 1_000_000) == pytest.approx(30e-6 + 549 / 5e6)


def opened(line: VirtualCan) -> None:
    """Open both adapters as a computer would."""
    for device in (line.flight_device, line.ground_device):
        descriptor = os.open(device, os.O_RDWR | os.O_NOCTTY)
        os.write(descriptor, open_slcan(parse_link_url(line.flight_url)))
        os.close(descriptor)
    end_s = time.monotonic() + 5
    while not (line._flight.is_open and line._ground.is_open) and time.monotonic() < end_s:
        time.sleep(0.01)


def on_the_way(line: VirtualCan) -> int:
    """Return how many frames from the flight end have neither arrived nor been given up."""
    lane = line.statistics()["down"]
    ended = lane.frames_out + lane.frames_lost + lane.frames_cut + lane.frames_overrun + lane.frames_abandoned
    return lane.frames_in + lane.frames_duplicated - ended


def send(line: VirtualCan, frames: list[CanMessage]) -> list[CanMessage]:
    """Send frames from flight to ground as fast as the adapter takes them; return what comes until all have ended."""
    text, stream, received = SlcanText(), b"".join(map(format_slcan, frames)), []
    near, far = (
        os.open(device, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        for device in (line.flight_device, line.ground_device)
    )
    lane = line.statistics()["down"]
    frames_in_at_end, frames_out_before = lane.frames_in + len(frames), lane.frames_out

    def is_quiet() -> bool:
        """Nothing has come for a while, and longer on a busy machine, where the kernel still holds frames."""
        has_all = len(received) >= lane.frames_out - frames_out_before
        return time.monotonic() - moved_s > (0.2 if has_all else 1.0)

    moved_s, end_s = time.monotonic(), time.monotonic() + 60
    # the kernel hands the last text of the adapter to the reader some time after the adapter wrote it
    while lane.frames_in < frames_in_at_end or on_the_way(line) or not is_quiet():
        assert time.monotonic() < end_s, f"the bus stands still: {lane}"
        if lane.frames_in < frames_in_at_end or on_the_way(line):
            moved_s = time.monotonic()
        with contextlib.suppress(BlockingIOError):
            stream = stream[os.write(near, stream) :]
        with contextlib.suppress(BlockingIOError):
            os.read(near, 65_536)  # the adapter's answers
        with contextlib.suppress(BlockingIOError):
            received += text.feed(os.read(far, 65_536))
            moved_s = time.monotonic()
        time.sleep(0.001)
    os.close(near)
    os.close(far)
    return received


def contents(frames: list[CanMessage]) -> list[tuple[int, bytes]]:
    return [(frame.arbitration_id, frame.data) for frame in frames]


def assert_counts_add_up(line: VirtualCan) -> None:
    for lane in line.statistics().values():
        assert lane.frames_in + lane.frames_duplicated == (
            lane.frames_out
            + lane.frames_lost
            + lane.frames_cut
            + lane.frames_overrun
            + lane.frames_abandoned
            + lane.frames_held
        )


def test_without_faults_every_frame_passes_in_order_at_the_bus_rate():
    with VirtualCan(125_000) as line:
        opened(line)
        began_s = time.monotonic()
        assert contents(send(line, FRAMES)) == contents(FRAMES)
        seconds = time.monotonic() - began_s
        assert seconds > sum(frame_s(frame, 125_000) for frame in FRAMES)
        down = line.statistics()["down"]
        assert (down.frames_in, down.frames_out, down.bytes_out) == (400, 400, 3200)
        assert down.bus_busy_s == pytest.approx(sum(frame_s(frame, 125_000) for frame in FRAMES))
        assert_counts_add_up(line)


@pytest.fixture
def python_can() -> Iterator[tuple[slcanBus, slcanBus]]:
    """python-can's own clients on both ends of a CAN FD bus."""
    with VirtualCan(fd=True) as line:
        timing = can.BitTimingFd.from_sample_point(80_000_000, 1_000_000, 75.0, 5_000_000, 75.0)
        ends = [
            slcanBus(device, timing=timing, sleep_after_open=0.0)
            for device in (line.flight_device, line.ground_device)
        ]
        yield ends[0], ends[1]
        for end in ends:
            end.shutdown()


def test_python_can_exchanges_frames_of_every_kind_over_the_bus(python_can):
    near, far = python_can
    messages = [
        can.Message(
            arbitration_id=0x123 << (18 if extended else 0),
            data=bytes(range(size)),
            is_extended_id=extended,
            is_fd=fd,
            bitrate_switch=fd,
        )
        for extended in (False, True)
        for fd, size in ((False, 0), (False, 8), (True, 12), (True, 64))
    ]
    end_s = time.monotonic() + 5
    while far._queue.qsize() == 0 and near.get_serial_number(0.1) is None and time.monotonic() < end_s:
        pass  # until the adapters answer
    received: list[can.Message] = []
    for message in messages:
        near.send(message)
    while len(received) < len(messages) and time.monotonic() < end_s:
        message = far.recv(0.1)
        received += [message] if message is not None else []
    assert [(m.arbitration_id, bytes(m.data), m.is_fd) for m in received] == [
        (m.arbitration_id, bytes(m.data), m.is_fd) for m in messages
    ]


def test_the_lower_identifier_wins_the_bus():
    with VirtualCan(10_000) as line:
        opened(line)
        low, high = (CanMessage(number, 8, bytes(8)) for number in (0x010, 0x7F0))
        line._flight.queue.extend((0.0, high) for _ in range(3))
        line._ground.queue.extend((0.0, low) for _ in range(3))
        line._flight.statistics.frames_in, line._ground.statistics.frames_in = 3, 3
        order = []
        end_s = time.monotonic() + 5
        while len(order) < 6 and time.monotonic() < end_s:
            counts = [line.statistics()[lane].frames_out for lane in ("up", "down")]
            order += ["up"] * (counts[0] - order.count("up")) + ["down"] * (counts[1] - order.count("down"))
            time.sleep(0.001)
        assert order[-3:] == ["down"] * 3
        assert order.count("up") == 3


def test_a_frame_destroyed_on_the_bus_is_repeated_and_takes_more_time():
    with VirtualCan(faults=Faults(loss=0.3), seed=4) as line:
        opened(line)
        assert contents(send(line, FRAMES)) == contents(FRAMES)
        down = line.statistics()["down"]
        assert 100 < down.frames_destroyed < 250  # 171 expected, 400 * 0.3 / 0.7
        assert down.frames_lost == 0
        assert down.bus_busy_s > sum(frame_s(frame, 1_000_000) for frame in FRAMES)
        assert_counts_add_up(line)


def test_in_one_shot_mode_a_destroyed_frame_is_lost_and_counted():
    with VirtualCan(faults=Faults(loss=0.3), seed=4, one_shot=True) as line:
        opened(line)
        received = send(line, FRAMES)
        down = line.statistics()["down"]
        assert down.frames_lost == down.frames_destroyed == len(FRAMES) - len(received)
        assert 70 < down.frames_lost < 170
        assert_counts_add_up(line)


def test_each_fault_happens_about_as_often_as_asked_and_is_counted():
    with VirtualCan(faults=Faults(bit_flip=0.1, duplicate=0.1, reorder=0.1), seed=6) as line:
        opened(line)
        received = send(line, FRAMES)
        down = line.statistics()["down"]
        assert_counts_add_up(line)
    for count in (down.frames_flipped, down.frames_duplicated, down.frames_reordered):
        assert 15 <= count <= 75  # 40 expected, 5 sigma either way
    assert down.frames_out == len(FRAMES) + down.frames_duplicated
    unharmed = [content for content in contents(received) if content in contents(FRAMES)]
    assert len(unharmed) >= down.frames_out - 3 * down.frames_flipped


def test_the_same_seed_brings_the_same_faults():
    def run(seed: int) -> list[tuple[int, bytes]]:
        with VirtualCan(faults=Faults(bit_flip=0.2), seed=seed) as line:
            opened(line)
            return contents(send(line, FRAMES[:100]))

    first = run(1)
    assert first == run(1)
    assert first != run(2)


def test_a_cut_bus_swallows_frames_and_a_mended_one_passes_them():
    with VirtualCan() as line:
        opened(line)
        line.cut()
        assert send(line, FRAMES[:50]) == []
        assert line.statistics()["down"].frames_cut == 50
        line.mend()
        assert contents(send(line, FRAMES[:50])) == contents(FRAMES[:50])
        assert_counts_add_up(line)


def test_latency_delays_a_frame_without_holding_back_the_next():
    with VirtualCan(latency_s=0.3) as line:
        opened(line)
        began_s = time.monotonic()
        assert contents(send(line, FRAMES[:100])) == contents(FRAMES[:100])
        assert time.monotonic() - began_s > 0.3


def test_a_computer_that_does_not_read_loses_what_its_adapter_cannot_hold():
    frames = [FRAMES[number % 400] for number in range(4000)]  # 88 kB of text
    with VirtualCan() as line:
        opened(line)
        near = os.open(line.flight_device, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        stream, end_s = b"".join(map(format_slcan, frames)), time.monotonic() + 20
        while stream and time.monotonic() < end_s:
            with contextlib.suppress(BlockingIOError):
                stream = stream[os.write(near, stream) :]
            with contextlib.suppress(BlockingIOError):
                os.read(near, 65_536)
            time.sleep(0.001)
        received = send(line, [])
        os.close(near)
        down = line.statistics()["down"]
        assert down.frames_overrun > 0
        assert down.frames_out == len(received) == len(frames) - down.frames_overrun
        assert_counts_add_up(line)


def written(line: VirtualCan, frames: list[CanMessage]) -> int:
    """Open flight's adapter alone, give it frames, and return the port's descriptor."""
    near = os.open(line.flight_device, os.O_RDWR | os.O_NOCTTY)
    os.write(near, open_slcan(parse_link_url(line.flight_url)) + b"".join(map(format_slcan, frames)))
    end_s = time.monotonic() + 5
    while line.statistics()["down"].frames_in < len(frames) and time.monotonic() < end_s:
        time.sleep(0.01)
    time.sleep(0.05)  # far longer than the frames take on the bus
    return near


def test_a_frame_that_nobody_acknowledges_waits_until_the_other_adapter_is_open():
    with VirtualCan() as line:
        near = written(line, FRAMES[:20])
        assert line.statistics()["down"].frames_out == 0
        far = os.open(line.ground_device, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        os.write(far, open_slcan(parse_link_url(line.ground_url)))
        assert contents(send(line, [])) == contents(FRAMES[:20])
        os.close(near)
        os.close(far)
        assert line.statistics()["down"].frames_lost == 0
        assert_counts_add_up(line)


def test_frames_in_an_adapter_that_its_computer_closes_are_abandoned_and_counted():
    with VirtualCan() as line:
        near = written(line, FRAMES[:20])
        os.write(near, b"C\r")
        end_s = time.monotonic() + 5
        while line._flight.is_open and time.monotonic() < end_s:
            time.sleep(0.01)
        os.close(near)
        time.sleep(0.05)
        down = line.statistics()["down"]
        assert (down.frames_abandoned, down.frames_lost, down.frames_held) == (20, 0, 0)
        assert_counts_add_up(line)


def test_an_adapter_that_is_not_open_refuses_frames_and_a_wrong_bit_rate():
    with VirtualCan(500_000) as line:
        near = os.open(line.flight_device, os.O_RDWR | os.O_NOCTTY)
        for text, answer in (
            (b"t1000\r", b"\a"),
            (b"S8\r", b"\r"),
            (b"O\r", b"\a"),  # the bus runs at S6
            (b"S6\r", b"\r"),
            (b"O\r", b"\r"),
            (b"t1000\r", b"z\r"),
            (b"b1000\r", b"\a"),  # no CAN FD on this bus
            (b"nonsense\r", b"\a"),
        ):
            os.write(near, text)
            assert os.read(near, len(answer)) == answer, text
        os.close(near)
        assert line.statistics()["down"].refused == 4


def test_a_bit_rate_is_one_of_the_adapter_s():
    with pytest.raises(ValueError, match="bitrate must be one of 10000, 20000"):
        VirtualCan(123)
    assert len(FD_SIZES) == 16
