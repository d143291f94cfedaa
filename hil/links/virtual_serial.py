"""A serial line between two pseudo-terminals: bytes cross at the baud rate, with seeded and counted faults."""

import contextlib
import os
import random
import select
import time
from collections import deque
from dataclasses import dataclass

from flightsw.icd.link.framing import DELIMITER
from hil.links.faults import Faults, flip_a_bit
from hil.links.virtual_link import VirtualLink

BITS_PER_BYTE = 10  # start bit, 8 data bits, stop bit
BURST_S = 0.01  # what a late wake-up may catch up: small, so that the writer feels real back-pressure
TICK_S = 0.002
MAX_PACKET_BYTES = 65_536  # a longer run without a delimiter passes as one packet
RECEIVE_BUFFER_BYTES = 4096  # without flow control: what a driver holds for a reader that is late


@dataclass
class LaneStatistics:
    """Counts of one direction.

    bytes_in + duplicated_bytes = bytes_out + lost_bytes + cut_bytes + overrun_bytes + held_bytes, at all times.
    """

    bytes_in: int = 0
    bytes_out: int = 0
    packets: int = 0
    packets_lost: int = 0
    packets_flipped: int = 0
    packets_duplicated: int = 0
    packets_reordered: int = 0
    lost_bytes: int = 0
    duplicated_bytes: int = 0
    cut_bytes: int = 0
    overrun_bytes: int = 0  # without flow control: nobody read them in time
    held_bytes: int = 0  # read from one end and not yet written to the other


class _Lane:
    """One direction. Reads no faster than the line's rate, so that the kernel's buffer fills and the writer waits."""

    def __init__(self, line: "VirtualSerial", source: int, sink: int, seed: int):
        self.source, self.sink = source, sink
        self.statistics = LaneStatistics()
        self._line = line
        self._bytes_per_s = line.baud_rate / BITS_PER_BYTE
        self._credit_bytes = 0.0
        self._last_turn_s = time.monotonic()
        self._random = random.Random(seed)
        self._packet = bytearray()  # read so far, until its delimiter
        self._held_back: bytes | None = None  # a packet that the next one overtakes
        self._travelling: deque[tuple[float, bytes]] = deque()  # each with its time of arrival
        self._out = bytearray()

    def turn(self) -> None:
        """Move the bytes that the line's rate, the source and the sink allow now."""
        now_s = time.monotonic()
        burst_bytes = max(64.0, BURST_S * self._bytes_per_s)
        elapsed_s = now_s - self._last_turn_s
        self._credit_bytes = min(self._credit_bytes + elapsed_s * self._bytes_per_s, burst_bytes)
        self._last_turn_s = now_s
        self._write(now_s)
        if self._credit_bytes < 1 or (self._out and self._line.flow_control):
            return
        try:
            data = os.read(self.source, int(self._credit_bytes))
        except BlockingIOError:
            return
        self._credit_bytes -= len(data)
        self.statistics.bytes_in += len(data)
        if self._line.is_cut:
            self.statistics.cut_bytes += len(data) + len(self._packet)
            self._packet.clear()
        elif self._line.faults.any or self._packet:
            self._impair(data, now_s)
        else:
            self.statistics.packets += data.count(DELIMITER)
            self._send(data, now_s)
        self._write(now_s)

    @property
    def has_unwritten(self) -> bool:
        return bool(self._out or self._travelling)

    def _send(self, data: bytes, now_s: float) -> None:
        self._travelling.append((now_s + self._line.latency_s, data))

    def _write(self, now_s: float) -> None:
        while self._travelling and self._travelling[0][0] <= now_s:
            self._out += self._travelling.popleft()[1]
        if self._out:
            with contextlib.suppress(BlockingIOError):
                count = os.write(self.sink, self._out)
                self.statistics.bytes_out += count
                del self._out[:count]
        if not self._line.flow_control:
            self.statistics.overrun_bytes += len(self._out[RECEIVE_BUFFER_BYTES:])
            del self._out[RECEIVE_BUFFER_BYTES:]
        travelling_bytes = sum(len(data) for _, data in self._travelling)
        self.statistics.held_bytes = (
            len(self._out) + travelling_bytes + len(self._packet) + len(self._held_back or b"")
        )

    def _impair(self, data: bytes, now_s: float) -> None:
        for byte in data:
            self._packet.append(byte)
            if byte == 0 or len(self._packet) >= MAX_PACKET_BYTES:
                self._pass_on(bytes(self._packet), now_s)
                self._packet.clear()

    def _pass_on(self, packet: bytes, now_s: float) -> None:
        draw, faults, statistics = self._random.random, self._line.faults, self.statistics
        statistics.packets += 1
        if draw() < faults.loss:
            statistics.packets_lost += 1
            statistics.lost_bytes += len(packet)
            return
        if draw() < faults.bit_flip:
            statistics.packets_flipped += 1
            packet = flip_a_bit(packet, self._random)
        if draw() < faults.duplicate:
            statistics.packets_duplicated += 1
            statistics.duplicated_bytes += len(packet)
            packet += packet
        if self._held_back is not None:
            self._send(packet + self._held_back, now_s)
            self._held_back = None
        elif draw() < faults.reorder:
            statistics.packets_reordered += 1
            self._held_back = packet
        else:
            self._send(packet, now_s)

    def release(self) -> None:
        """Send the packet that was held back: the line is quiet, and no other comes to overtake it."""
        if self._held_back is not None:
            self._send(self._held_back, time.monotonic())
            self._held_back = None


class VirtualSerial(VirtualLink):
    """Two pseudo-terminals that behave like the ends of a serial cable.

    Bytes cross at `baud_rate`. With flow control a full buffer at the receiver stops the sender, so that without
    faults no byte is lost; without flow control, what nobody reads in time is lost and counted.
    """

    def __init__(
        self,
        baud_rate: int,
        faults: Faults | None = None,
        seed: int = 0,
        latency_s: float = 0.0,
        flow_control: bool = True,
    ):
        if baud_rate < 1:
            raise ValueError(f"baud_rate must be positive, got {baud_rate}")
        super().__init__(faults, latency_s)
        self.baud_rate, self.flow_control = baud_rate, flow_control
        flight, ground = self._masters
        self._down = _Lane(self, flight, ground, 2 * seed)
        self._up = _Lane(self, ground, flight, 2 * seed + 1)

    @property
    def flight_url(self) -> str:  # type: ignore[override]
        return f"serial://{self.flight_device}?baud={self.baud_rate}"

    @property
    def ground_url(self) -> str:  # type: ignore[override]
        return f"serial://{self.ground_device}?baud={self.baud_rate}"

    def statistics(self) -> dict[str, LaneStatistics]:
        return {"down": self._down.statistics, "up": self._up.statistics}

    def _run(self) -> None:
        lanes = (self._down, self._up)
        while not self._stop:
            wait_s = TICK_S if any(lane.has_unwritten for lane in lanes) else 0.05
            readable, _, _ = select.select(self._masters, [], [], wait_s)
            for lane in lanes:
                if lane.source not in readable:
                    lane.release()
                lane.turn()
            time.sleep(TICK_S)  # lets the credit grow; one read a byte would keep a core busy
