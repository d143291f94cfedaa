"""A link on one desk: two pseudo-terminals joined at a line's rate, with seeded, counted faults.

Here the serial line, and what it shares with the CAN bus (virtual_can.py).
"""

import contextlib
import os
import random
import select
import time
import tty
from collections import deque
from collections.abc import Callable
from dataclasses import asdict, dataclass, fields, replace
from typing import Any, Self

from flightsw.icd.framing import DELIMITER
from hil.watched import WatchedThread

BITS_PER_BYTE = 10  # start bit, 8 data bits, stop bit
BURST_S = 0.01  # what a late wake-up may catch up: small, so that the writer feels real back-pressure
TICK_S = 0.002
MAX_PACKET_BYTES = 65_536  # a longer run without a delimiter passes as one packet
RECEIVE_BUFFER_BYTES = 4096  # without flow control: what a driver holds for a reader that is late


@dataclass(frozen=True)
class Faults:
    """How often a unit suffers, each 0 to 1, in both directions. A unit is a packet (bytes up to a zero
    byte) on a serial line and a CAN frame on a bus; what each fault means on a bus: virtual_can.py."""

    loss: float = 0.0
    bit_flip: float = 0.0  # one random bit of the unit
    duplicate: float = 0.0
    reorder: float = 0.0  # changes places with the next unit

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
    overrun_bytes: int = 0  # without flow control: nobody took them in time
    held_bytes: int = 0  # read and not yet written


class VirtualLink:
    """Two pseudo-terminals and what is between them, run by a thread; use it in a `with`.

    `flight_url` and `ground_url` name the ends. `faults` and `latency_s` may be changed while it runs.
    """

    flight_url: str
    ground_url: str

    def __init__(self, faults: Faults | None = None, latency_s: float = 0.0):
        if not latency_s >= 0:
            raise ValueError(f"latency_s must not be negative, got {latency_s}")
        self.faults = faults or Faults()
        self.latency_s = latency_s
        self.is_cut = False
        self._stop = False
        self._masters, self._slaves = [], []
        for _ in range(2):
            master, slave = os.openpty()
            tty.setraw(slave)  # at once: an untouched terminal echoes and translates
            os.set_blocking(master, False)
            self._masters.append(master)
            self._slaves.append(slave)  # kept open, or reading fails while nobody is attached
        self._thread = WatchedThread(f"simulated link ({type(self).__name__})", self._run)

    @property
    def flight_device(self) -> str:
        return os.ttyname(self._slaves[0])

    @property
    def ground_device(self) -> str:
        return os.ttyname(self._slaves[1])

    def cut(self) -> None:
        """Break the cable: what is written vanishes."""
        self.is_cut = True

    def mend(self) -> None:
        self.is_cut = False

    def statistics(self) -> dict[str, Any]:
        """Return the counts so far: `down` from flight to ground, `up` the other way."""
        raise NotImplementedError

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def check(self) -> None:
        """Raise ServerError if nothing crosses any more."""
        self._thread.check()

    def __exit__(self, kind: object, *_: object) -> None:
        self._stop = True
        self._thread.join()
        for descriptor in self._masters + self._slaves:
            with contextlib.suppress(OSError):
                os.close(descriptor)
        if kind is None:
            self.check()

    def _run(self) -> None:
        raise NotImplementedError


class _Lane:
    """One direction. Reads at the line's rate, so that the kernel's buffer fills and the writer must wait."""

    def __init__(self, line: "VirtualSerial", source: int, sink: int, seed: int):
        self.source, self.sink = source, sink
        self.statistics = LaneStatistics()
        self._line = line
        self._bytes_per_s = line.baud_rate / BITS_PER_BYTE
        self._credit_bytes = 0.0
        self._then_s = time.monotonic()
        self._random = random.Random(seed)
        self._packet = bytearray()  # under way, until its delimiter
        self._held_back: bytes | None = None  # waits to follow the next packet
        self._travelling: deque[tuple[float, bytes]] = deque()  # when it arrives, what
        self._out = bytearray()

    def turn(self) -> None:
        """Move what time, source and sink allow now."""
        now_s = time.monotonic()
        burst_bytes = max(64.0, BURST_S * self._bytes_per_s)
        elapsed_s = now_s - self._then_s
        self._credit_bytes = min(self._credit_bytes + elapsed_s * self._bytes_per_s, burst_bytes)
        self._then_s = now_s
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
        """Let a held-back packet go when the line is quiet: no other comes to overtake it."""
        if self._held_back is not None:
            self._send(self._held_back, time.monotonic())
            self._held_back = None


class VirtualSerial(VirtualLink):
    """Two pseudo-terminals that behave like the ends of a serial cable.

    Bytes cross at `baud_rate`. With flow control a full buffer on the far side holds the near side back, so
    that without faults no byte is lost; without it, what nobody reads in time is lost and counted.
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
            time.sleep(TICK_S)  # lets the credit grow; a read a byte would cost a core


def flip_a_bit(data: bytes, source: random.Random) -> bytes:
    """Return `data` with one random bit changed."""
    bit = source.randrange(8 * len(data))
    damaged = bytearray(data)
    damaged[bit // 8] ^= 1 << bit % 8
    return bytes(damaged)


def control(line: VirtualLink, command: str) -> str:
    """Obey one line of text and return the answer: `cut`, `mend`, or a fault's or the latency's new value.

    Raises:
        ValueError: another command, or a value out of range; the message says what was expected.
    """
    word, *values = command.split() or [""]
    names = [field.name for field in fields(Faults)]
    if (word, values) == ("cut", []):
        line.cut()
    elif (word, values) == ("mend", []):
        line.mend()
    elif word in names and len(values) == 1:
        line.faults = replace(line.faults, **{word: float(values[0])})
    elif word == "latency" and len(values) == 1 and float(values[0]) >= 0:
        line.latency_s = float(values[0])
    else:
        raise ValueError(
            f"expected cut, mend, latency SECONDS, or {', '.join(names)} with a share of 0 to 1; got {command!r}"
        )
    state = "cut" if line.is_cut else "whole"
    return f"{state}, latency {line.latency_s:g} s, {asdict(line.faults)}"


def run_link(
    line: VirtualLink,
    on_ready: Callable[[VirtualLink], None],
    should_stop: Callable[[], bool] = lambda: False,
    on_statistics: Callable[[dict[str, Any]], None] = lambda statistics: None,
    every_s: float = 1.0,
) -> dict[str, Any]:
    """Run a link until `should_stop` (looked at often) or Ctrl-C, and return its counts.

    `on_ready` is given the link once its two ends can be opened.

    Raises:
        ServerError: the link failed.
    """
    with line:
        on_ready(line)
        then_s = time.monotonic()
        with contextlib.suppress(KeyboardInterrupt):
            while not should_stop():
                time.sleep(0.05)
                line.check()
                if time.monotonic() - then_s >= every_s:
                    then_s = time.monotonic()
                    on_statistics(line.statistics())
        return line.statistics()
