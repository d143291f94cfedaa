"""Flight's and ground's links over the virtual CAN bus: at the start, at the end, and while one side does not read."""

import os
import threading
import time
from collections.abc import Callable

import pytest

from flightsw.icd.link.can import FLIGHT_SIDE, GROUND_SIDE
from flightsw.icd.link.framing import frame_packet
from flightsw.ports import Link, open_link
from hil.links.virtual_can import VirtualCan

BOTH = pytest.mark.parametrize("fd", [False, True], ids=["classic", "fd"])


class Reader:
    """The ground's end of the link, read by a thread that can be stopped for a while."""

    def __init__(self, line: VirtualCan):
        self.link = open_link(line.ground_url, GROUND_SIDE)
        self.received = b""
        self._run, self._end = threading.Event(), False
        self._run.set()
        self._thread = threading.Thread(target=self._read)
        self._thread.start()

    def _read(self) -> None:
        while not self._end:
            self._run.wait()
            self.received += self.link.exchange(0.01)

    def stall(self, seconds: float) -> None:
        self._run.clear()
        time.sleep(seconds)
        self._run.set()

    def __enter__(self) -> "Reader":
        return self

    def __exit__(self, *_: object) -> None:
        self._end = True
        self._thread.join()
        self.link.close()


def wait_for(condition: Callable[[], bool], limit_s: float = 30.0) -> None:
    end_s = time.monotonic() + limit_s
    while not condition() and time.monotonic() < end_s:
        time.sleep(0.01)


def write_all(link: Link, packets: list[bytes]) -> None:
    end_s, waiting = time.monotonic() + 60, list(packets)
    while waiting and time.monotonic() < end_s:
        if link.ready:
            link.write(waiting.pop(0))
        link.exchange(0.0 if link.ready else 0.005)
    assert not waiting


def assert_nothing_is_lost(line: VirtualCan, *links: Link) -> None:
    for link in links:
        assert set(link.losses.values()) == {0}, link.losses
    for lane in line.statistics().values():
        assert lane.frames_lost == lane.frames_overrun == lane.frames_abandoned == 0, lane


@BOTH
def test_what_is_sent_just_before_a_link_is_closed_arrives(fd):
    packets = [frame_packet(os.urandom(size)) for size in (1000, 30, 400)]
    with VirtualCan(fd=fd) as line, Reader(line) as reader:
        with open_link(line.flight_url, FLIGHT_SIDE) as flight:
            for packet in packets:
                flight.write(packet)
        wait_for(lambda: len(reader.received) >= sum(map(len, packets)))
        assert reader.received == b"".join(packets)
        assert_nothing_is_lost(line, flight, reader.link)


@BOTH
def test_what_is_sent_before_the_other_side_opens_arrives(fd):
    packets = [frame_packet(os.urandom(size)) for size in (100, 400, 1000)]
    with VirtualCan(fd=fd) as line, open_link(line.flight_url, FLIGHT_SIDE) as flight:
        for packet in packets:
            flight.write(packet)
        end_s = time.monotonic() + 1.0
        while time.monotonic() < end_s:
            flight.exchange(0.01)
        with Reader(line) as reader:
            end_s = time.monotonic() + 30
            while len(reader.received) < sum(map(len, packets)) and time.monotonic() < end_s:
                flight.exchange(0.01)
            assert reader.received == b"".join(packets)
            assert_nothing_is_lost(line, flight, reader.link)


def test_a_link_that_is_closed_while_nobody_listens_counts_what_was_not_sent():
    with VirtualCan() as line:
        with open_link(line.flight_url, FLIGHT_SIDE) as flight:
            flight.write(frame_packet(bytes(100)))
        assert flight.losses["messages_failed"] == 1


@BOTH
@pytest.mark.parametrize("packet_bytes", [1100, 4096])
@pytest.mark.parametrize("stall_s", [0.3, 1.0])
def test_a_ground_that_does_not_read_for_a_while_loses_nothing(fd, packet_bytes, stall_s):
    packets = [frame_packet(os.urandom(packet_bytes)) for _ in range(160 if packet_bytes == 1100 else 48)]
    with (
        VirtualCan(fd=fd) as line,
        Reader(line) as reader,
        open_link(line.flight_url, FLIGHT_SIDE) as flight,
    ):
        half = len(packets) // 2
        writer = threading.Thread(target=write_all, args=(flight, packets))
        writer.start()
        wait_for(lambda: reader.received.count(b"\0") >= half // 2)
        reader.stall(stall_s)
        writer.join()
        end_s = time.monotonic() + 30
        while len(reader.received) < sum(map(len, packets)) and time.monotonic() < end_s:
            flight.exchange(0.01)
        assert reader.received == b"".join(packets)
        assert_nothing_is_lost(line, flight, reader.link)


@BOTH
def test_a_spacecraft_that_does_not_read_for_a_while_loses_nothing(fd):
    packets = [frame_packet(os.urandom(1100)) for _ in range(60)]
    with (
        VirtualCan(fd=fd) as line,
        Reader(line) as reader,
        open_link(line.flight_url, FLIGHT_SIDE) as flight,
    ):
        write_all(flight, packets[:30])
        time.sleep(1.0)  # while answers wait in its port
        write_all(flight, packets[30:])
        end_s = time.monotonic() + 30
        while len(reader.received) < sum(map(len, packets)) and time.monotonic() < end_s:
            flight.exchange(0.01)
        assert reader.received == b"".join(packets)
        assert_nothing_is_lost(line, flight, reader.link)
