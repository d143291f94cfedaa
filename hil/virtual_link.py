"""A serial line on one desk: two pseudo-terminals joined at a baud rate, with seeded, counted faults."""

import contextlib
import os
import random
import select
import threading
import time
import tty
from collections.abc import Callable
from dataclasses import asdict, dataclass

from flightsw.icd.framing import DELIMITER

BITS_PER_BYTE = 10  # start bit, 8 data bits, stop bit
BURST_S = 0.01  # what a late wake-up may catch up: small, so that the writer feels real back-pressure
TICK_S = 0.002
MAX_PACKET_BYTES = 65_536  # a longer run without a delimiter passes as one packet


@dataclass(frozen=True)
class Faults:
    """How often a packet (bytes up to a zero byte) suffers, each 0 to 1, in both directions."""

    loss: float = 0.0
    bit_flip: float = 0.0  # one random bit of the packet
    duplicate: float = 0.0
    reorder: float = 0.0  # changes places with the next packet

    def __post_init__(self):
        for name, value in asdict(self).items():
            if not 0 <= value <= 1:
                raise ValueError(f"{name} must be 0 to 1, got {value}")

    @property
    def any(self) -> bool:
        return any(asdict(self).values())


@dataclass
class LaneStatistics:
    """What one direction did.

    bytes_in + duplicated_bytes = bytes_out + lost_bytes + cut_bytes + held_bytes, at all times.
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
    held_bytes: int = 0  # read and not yet written


class _Lane:
    """One direction. Reads at the line's rate, so that the kernel's buffer fills and the writer must wait."""

    def __init__(self, source: int, sink: int, baud_rate: int, faults: Faults, seed: int):
        self.source, self.sink = source, sink
        self.statistics = LaneStatistics()
        self._bytes_per_s = baud_rate / BITS_PER_BYTE
        self._credit_bytes = 0.0
        self._then_s = time.monotonic()
        self._faults, self._random = faults, random.Random(seed)
        self._packet = bytearray()  # under way, until its delimiter
        self._held_back: bytes | None = None  # waits to follow the next packet
        self._out = bytearray()

    def turn(self, is_cut: bool) -> None:
        """Move what time, source and sink allow now."""
        now_s = time.monotonic()
        burst_bytes = max(64.0, BURST_S * self._bytes_per_s)
        elapsed_s = now_s - self._then_s
        self._credit_bytes = min(self._credit_bytes + elapsed_s * self._bytes_per_s, burst_bytes)
        self._then_s = now_s
        self._write()
        if self._credit_bytes < 1 or self._out:
            return
        try:
            data = os.read(self.source, int(self._credit_bytes))
        except BlockingIOError:
            return
        self._credit_bytes -= len(data)
        self.statistics.bytes_in += len(data)
        if is_cut:
            self.statistics.cut_bytes += len(data) + len(self._packet)
            self._packet.clear()
        elif self._faults.any:
            self._impair(data)
        else:
            self.statistics.packets += data.count(DELIMITER)
            self._out += data
        self._write()

    @property
    def has_unwritten(self) -> bool:
        return bool(self._out)

    def _write(self) -> None:
        if self._out:
            with contextlib.suppress(BlockingIOError):
                count = os.write(self.sink, self._out)
                self.statistics.bytes_out += count
                del self._out[:count]
        self.statistics.held_bytes = len(self._out) + len(self._packet) + len(self._held_back or b"")

    def _impair(self, data: bytes) -> None:
        for byte in data:
            self._packet.append(byte)
            if byte == 0 or len(self._packet) >= MAX_PACKET_BYTES:
                self._pass_on(bytes(self._packet))
                self._packet.clear()

    def _pass_on(self, packet: bytes) -> None:
        draw, faults, statistics = self._random.random, self._faults, self.statistics
        statistics.packets += 1
        if draw() < faults.loss:
            statistics.packets_lost += 1
            statistics.lost_bytes += len(packet)
            return
        if draw() < faults.bit_flip:
            statistics.packets_flipped += 1
            bit = self._random.randrange(8 * len(packet))
            damaged = bytearray(packet)
            damaged[bit // 8] ^= 1 << bit % 8
            packet = bytes(damaged)
        if draw() < faults.duplicate:
            statistics.packets_duplicated += 1
            statistics.duplicated_bytes += len(packet)
            packet += packet
        if self._held_back is not None:
            self._out += packet + self._held_back
            self._held_back = None
        elif draw() < faults.reorder:
            statistics.packets_reordered += 1
            self._held_back = packet
        else:
            self._out += packet

    def release(self) -> None:
        """Let a held-back packet go when the line is quiet: no other comes to overtake it."""
        if self._held_back is not None:
            self._out += self._held_back
            self._held_back = None


class VirtualSerial:
    """Two pseudo-terminals that behave like the ends of a cable; use it in a `with`.

    `flight_url` and `ground_url` name the ends. Bytes cross at `baud_rate`; a full buffer on the far side
    holds the near side back, as hardware flow control does, so that without faults no byte is lost.
    """

    def __init__(self, baud_rate: int, faults: Faults | None = None, seed: int = 0):
        if baud_rate < 1:
            raise ValueError(f"baud_rate must be positive, got {baud_rate}")
        self.baud_rate = baud_rate
        self._masters, self._slaves = [], []
        for _ in range(2):
            master, slave = os.openpty()
            tty.setraw(slave)  # at once: an untouched terminal echoes and translates
            os.set_blocking(master, False)
            self._masters.append(master)
            self._slaves.append(slave)  # kept open, or reading fails while nobody is attached
        flight, ground = self._masters
        faults = faults or Faults()
        self._down = _Lane(flight, ground, baud_rate, faults, 2 * seed)
        self._up = _Lane(ground, flight, baud_rate, faults, 2 * seed + 1)
        self._cut = self._stop = False
        self._thread = threading.Thread(target=self._run, name="virtual serial line", daemon=True)

    @property
    def flight_device(self) -> str:
        return os.ttyname(self._slaves[0])

    @property
    def ground_device(self) -> str:
        return os.ttyname(self._slaves[1])

    @property
    def flight_url(self) -> str:
        return f"serial://{self.flight_device}?baud={self.baud_rate}"

    @property
    def ground_url(self) -> str:
        return f"serial://{self.ground_device}?baud={self.baud_rate}"

    def cut(self) -> None:
        """Break the cable: what is written vanishes."""
        self._cut = True

    def mend(self) -> None:
        self._cut = False

    def statistics(self) -> dict[str, LaneStatistics]:
        """Return the counts so far: `down` from flight to ground, `up` the other way."""
        return {"down": self._down.statistics, "up": self._up.statistics}

    def __enter__(self) -> "VirtualSerial":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop = True
        self._thread.join()
        for descriptor in self._masters + self._slaves:
            with contextlib.suppress(OSError):
                os.close(descriptor)

    def _run(self) -> None:
        lanes = (self._down, self._up)
        while not self._stop:
            wait_s = TICK_S if any(lane.has_unwritten for lane in lanes) else 0.05
            readable, _, _ = select.select(self._masters, [], [], wait_s)
            for lane in lanes:
                if lane.source not in readable:
                    lane.release()
                lane.turn(self._cut)
            time.sleep(TICK_S)  # lets the credit grow; a read a byte would cost a core


def run_link(
    baud_rate: int,
    faults: Faults,
    seed: int,
    on_ready: Callable[[VirtualSerial], None],
    should_stop: Callable[[], bool] = lambda: False,
    on_statistics: Callable[[dict[str, LaneStatistics]], None] = lambda statistics: None,
    every_s: float = 1.0,
) -> dict[str, LaneStatistics]:
    """Run a line until `should_stop` (looked at often) or Ctrl-C, and return its counts.

    `on_ready` is given the line once its two ends can be opened.
    """
    with VirtualSerial(baud_rate, faults, seed) as line:
        on_ready(line)
        then_s = time.monotonic()
        with contextlib.suppress(KeyboardInterrupt):
            while not should_stop():
                time.sleep(0.05)
                if time.monotonic() - then_s >= every_s:
                    then_s = time.monotonic()
                    on_statistics(line.statistics())
        return line.statistics()
