"""A CAN bus on one desk: two slcan adapters on pseudo-terminals, joined by a bus that takes a frame's time.

A frame takes the time of its bits on the bus, stuff bits included (ISO 11898-1); the lower identifier goes
first. What the faults mean here:

- loss destroys a frame on the bus. The sending controller notices and sends it again, as real ones do: it costs
  time. With `one_shot` (a mode of real controllers) it does not, and the frame is lost.
- bit_flip hits a line of the adapter's text, which nothing protects (the bus itself has its CRC).
- duplicate and reorder hit the lines that an adapter hands to its computer.
- A cut bus swallows frames as if another node still acknowledged them.
- While the other adapter is not open nobody acknowledges a frame: its controller keeps it and tries again.
- A computer that does not read in time loses what its adapter cannot hold: an overrun.
"""

import contextlib
import os
import random
import select
import time
from collections import deque
from dataclasses import dataclass
from functools import lru_cache

from isotp import CanMessage

from flightsw.icd.can import SlcanText, format_slcan, parse_slcan
from flightsw.icd.link_url import SLCAN_BITRATES
from hil.links.virtual_link import Faults, VirtualLink, flip_a_bit

DATA_BITRATE = 5_000_000  # of CAN FD's data phase
QUEUE_FRAMES = 128  # an adapter takes no more text until the bus has taken some
ADAPTER_BUFFER_BYTES = 32_768  # of text that a computer has not read, besides the terminal's own
ERROR_FRAME_BITS = 20  # error flags, delimiter, pause: at least 17, at most 31
TICK_S = 0.0005


@dataclass
class BusLaneStatistics:
    """What one direction did, in CAN frames.

    frames_in + frames_duplicated = frames_out + frames_lost + frames_cut + frames_overrun + frames_abandoned +
    frames_held, at all times; a destroyed frame that is sent again is still held.
    """

    frames_in: int = 0  # taken by the sending adapter
    frames_out: int = 0  # handed to the other computer
    bytes_out: int = 0  # their data
    frames_destroyed: int = 0  # on the bus
    frames_lost: int = 0  # destroyed and not sent again
    frames_flipped: int = 0
    frames_duplicated: int = 0
    frames_reordered: int = 0
    frames_cut: int = 0
    frames_overrun: int = 0
    frames_abandoned: int = 0  # in an adapter whose own computer closed it
    frames_held: int = 0
    commands: int = 0
    refused: int = 0  # lines that the sending adapter did not understand or was not open for
    bus_busy_s: float = 0.0  # this direction's share of the bus


class _Adapter:
    """An slcan adapter: text to the computer, frames to the bus."""

    def __init__(self, bus: "VirtualCan", master: int, seed: int):
        self.master = master
        self.statistics = BusLaneStatistics()  # of the direction that it sends
        self.queue: deque[tuple[float, CanMessage]] = deque()  # when it came, what
        self.is_open = False
        self._bus = bus
        self._random = random.Random(seed)
        self._bitrate = self._fd = 0
        self._line = bytearray()
        self._travelling: deque[tuple[float, CanMessage]] = deque()
        self._held_back: tuple[bytes, int] | None = None
        self._out = bytearray()
        self._out_frames: deque[list[int]] = deque()  # text bytes left and data bytes of frames in `_out`
        self.partner: _Adapter = self

    @property
    def wants_text(self) -> bool:
        return len(self.queue) < QUEUE_FRAMES

    @property
    def has_unwritten(self) -> bool:
        return bool(self._out or self._travelling)

    def read(self, now_s: float) -> None:
        """Take lines from the computer."""
        try:
            data = os.read(self.master, 16_384)
        except BlockingIOError:
            return
        *ended, rest = (bytes(self._line) + data).split(b"\r")
        self._line = bytearray(rest[: SlcanText.MAX_LINE_BYTES])
        for line in ended:
            self._obey(line, now_s)

    def _obey(self, line: bytes, now_s: float) -> None:
        frame = parse_slcan(line)
        if frame is not None and self.is_open and (self._fd or not frame.is_fd):
            self.queue.append((now_s, frame))
            self.statistics.frames_in += 1
            self._answer(b"Z\r" if frame.is_extended_id else b"z\r")
            return
        if line == b"C":
            self.is_open = False
            self.statistics.frames_abandoned += len(self.queue)
            self.queue.clear()
        elif line[:1] == b"S" and line[1:].isdigit() and int(line[1:]) < len(SLCAN_BITRATES):
            self._bitrate, self._fd = SLCAN_BITRATES[int(line[1:])], 0
        elif line == b"Y5":
            self._fd = 1
        elif line == b"O" and self._bitrate == self._bus.bitrate:
            self.is_open = True
        elif line == b"V":
            self._answer(b"V1013")
        elif line == b"N":
            self._answer(b"NHIL0")
        elif line:
            self.statistics.refused += 1
            self._answer(b"\a")
            return
        self.statistics.commands += bool(line)
        self._answer(b"\r")

    def _answer(self, text: bytes) -> None:
        if len(self._out) < ADAPTER_BUFFER_BYTES:
            self._out += text
            self._out_frames.append([len(text), -1])

    def receive(self, frame: CanMessage, at_s: float) -> None:
        """Take a frame from the bus; it reaches the computer after the link's latency."""
        self._travelling.append((at_s + self._bus.latency_s, frame))

    def write(self, now_s: float) -> None:
        """Hand the computer what has arrived and fits."""
        arrived = 0
        while self._travelling and self._travelling[0][0] <= now_s:
            self._hand_over(self._travelling.popleft()[1])
            arrived += 1
        if not arrived and self._held_back is not None:  # nothing comes to overtake it
            held, self._held_back = self._held_back, None
            self._queue_text(*held)
        if self._out:
            with contextlib.suppress(BlockingIOError):
                count = os.write(self.master, self._out)
                del self._out[:count]
                self._count_written(count)
        lane = self.partner.statistics
        lane.frames_held = (
            len(self.partner.queue)
            + len(self._travelling)
            + sum(size >= 0 for _, size in self._out_frames)
            + (self._held_back is not None)
        )

    def _count_written(self, count: int) -> None:
        lane = self.partner.statistics
        while count:
            entry = self._out_frames[0]
            taken = min(count, entry[0])
            entry[0] -= taken
            count -= taken
            if not entry[0]:
                self._out_frames.popleft()
                if entry[1] >= 0:
                    lane.frames_out += 1
                    lane.bytes_out += entry[1]

    def _hand_over(self, frame: CanMessage) -> None:
        draw, faults, lane = self._random.random, self._bus.faults, self.partner.statistics
        if not self.is_open:
            lane.frames_abandoned += 1
            return
        text, size = format_slcan(frame), len(frame.data)
        if draw() < faults.bit_flip:
            lane.frames_flipped += 1
            text = flip_a_bit(text, self._random)
        twice = draw() < faults.duplicate
        lane.frames_duplicated += twice
        if self._held_back is None and draw() < faults.reorder:
            lane.frames_reordered += 1
            self._held_back = text, size
            if twice:
                self._queue_text(text, size)
            return
        for _ in range(1 + twice):
            self._queue_text(text, size)
        if self._held_back is not None:
            held, self._held_back = self._held_back, None
            self._queue_text(*held)

    def _queue_text(self, text: bytes, size: int) -> None:
        if len(self._out) + len(text) > ADAPTER_BUFFER_BYTES:
            self.partner.statistics.frames_overrun += 1
            return
        self._out += text
        self._out_frames.append([len(text), size])


class VirtualCan(VirtualLink):
    """Two slcan adapters on one CAN bus, or on one CAN FD bus whose data phase runs at 5 Mbit/s."""

    def __init__(
        self,
        bitrate: int = 1_000_000,
        fd: bool = False,
        faults: Faults | None = None,
        seed: int = 0,
        latency_s: float = 0.0,
        one_shot: bool = False,
    ):
        if bitrate not in SLCAN_BITRATES:
            rates = ", ".join(map(str, sorted(SLCAN_BITRATES)))
            raise ValueError(f"bitrate must be one of {rates}, got {bitrate}")
        super().__init__(faults, latency_s)
        self.bitrate, self.fd, self.one_shot = bitrate, fd, one_shot
        self._random = random.Random(3 * seed)
        self._free_s = 0.0  # when the bus has finished its frame
        self._flight, self._ground = (
            _Adapter(self, master, 3 * seed + number + 1) for number, master in enumerate(self._masters)
        )
        self._flight.partner, self._ground.partner = self._ground, self._flight

    @property
    def flight_url(self) -> str:  # type: ignore[override]
        return f"slcan://{self.flight_device}?bitrate={self.bitrate}&fd={int(self.fd)}"

    @property
    def ground_url(self) -> str:  # type: ignore[override]
        return f"slcan://{self.ground_device}?bitrate={self.bitrate}&fd={int(self.fd)}"

    def statistics(self) -> dict[str, BusLaneStatistics]:
        return {"down": self._flight.statistics, "up": self._ground.statistics}

    def _run(self) -> None:
        adapters = (self._flight, self._ground)
        while not self._stop:
            readers = [adapter.master for adapter in adapters if adapter.wants_text]
            busy = any(adapter.queue or adapter.has_unwritten for adapter in adapters)
            readable, _, _ = select.select(readers, [], [], TICK_S if busy else 0.02)
            now_s = time.monotonic()
            for adapter in adapters:
                if adapter.master in readable:
                    adapter.read(now_s)
            self._transmit(time.monotonic())
            now_s = time.monotonic()
            for adapter in adapters:
                adapter.write(now_s)
            if readable:
                time.sleep(TICK_S / 2)  # lets text gather; a turn a line would cost a core

    def _transmit(self, now_s: float) -> None:
        """Let the bus run until now."""
        while self._free_s <= now_s:
            senders = [
                adapter
                for adapter in (self._flight, self._ground)
                if adapter.queue and (adapter.partner.is_open or self.is_cut)
            ]
            if not senders:
                return
            sender = min(senders, key=lambda adapter: adapter.queue[0][1].arbitration_id)
            came_s, frame = sender.queue[0]
            lane, began_s = sender.statistics, max(self._free_s, came_s)
            duration_s = frame_s(frame, self.bitrate)
            if self._random.random() < self.faults.loss:
                lane.frames_destroyed += 1
                if self.one_shot:
                    lane.frames_lost += 1
                    sender.queue.popleft()
                duration_s = duration_s * self._random.random() + ERROR_FRAME_BITS / self.bitrate
            else:
                sender.queue.popleft()
                if self.is_cut:
                    lane.frames_cut += 1
                else:
                    sender.partner.receive(frame, began_s + duration_s)
            lane.bus_busy_s += duration_s
            self._free_s = began_s + duration_s


# ---- how long a frame takes (ISO 11898-1) ----

CRC15 = 0x4599  # CRC-15/CAN
TRAILER_BITS = 13  # CRC delimiter, acknowledge and its delimiter, end of frame 7, pause 3


def frame_s(frame: CanMessage, bitrate: int) -> float:
    """Return the seconds that a frame occupies the bus, pause included."""
    nominal_bits, data_phase_bits = frame_bits(frame)
    return nominal_bits / bitrate + data_phase_bits / (DATA_BITRATE if frame.bitrate_switch else bitrate)


def frame_bits(frame: CanMessage) -> tuple[int, int]:
    """Return a data frame's bits at the nominal rate and, of CAN FD, in the data phase, stuff bits included."""
    if not frame.is_fd:
        header, header_bits = _classic_header(frame.arbitration_id, frame.is_extended_id, len(frame.data))
        crc = _crc15_bits(header, header_bits)
        for byte in frame.data:
            crc = (crc << 8 & 0x7FFF) ^ _crc15_byte(crc >> 7 ^ byte)
        state, stuff_bits = _stuff((0, 0), header, header_bits)
        for value, bits in [*((byte, 8) for byte in frame.data), (crc >> 8, 7), (crc & 0xFF, 8)]:
            state, more = _stuff(state, value, bits)
            stuff_bits += more
        return header_bits + 8 * len(frame.data) + 15 + stuff_bits + TRAILER_BITS, 0
    # start, identifier, then (FD) RRS or SRR, IDE, FDF 1, res 0, BRS
    if frame.is_extended_id:
        base, extension = frame.arbitration_id >> 18, frame.arbitration_id & 0x3FFFF
        header, header_bits = ((base << 2 | 3) << 18 | extension) << 4 | 0b0100 | frame.bitrate_switch, 36
    else:
        header, header_bits = frame.arbitration_id << 5 | 0b00100 | frame.bitrate_switch, 17
    state, header_stuff = _stuff((0, 0), header, header_bits)
    state, data_stuff = _stuff(state, frame.dlc, 5)  # error state indicator 0, then the length code
    for byte in frame.data:
        state, more = _stuff(state, byte, 8)
        data_stuff += more
    # stuff count 4, CRC 17 or 21, and their fixed stuff bits: one before, one after every fourth bit
    check_bits = 4 + 17 + 6 if len(frame.data) <= 16 else 4 + 21 + 7
    data_phase_bits = 5 + 8 * len(frame.data) + data_stuff + check_bits
    return header_bits + header_stuff + TRAILER_BITS, data_phase_bits


@lru_cache(256)
def _classic_header(arbitration_id: int, extended: bool, size: int) -> tuple[int, int]:
    if extended:  # start 0, base identifier, SRR 1, IDE 1, rest, RTR 0, r1 r0, length
        base, extension = arbitration_id >> 18, arbitration_id & 0x3FFFF
        return ((base << 2 | 3) << 18 | extension) << 7 | size, 39
    return arbitration_id << 7 | size, 19  # start 0, identifier, RTR 0, IDE 0, r0, length


@lru_cache(256)
def _crc15_bits(value: int, bits: int) -> int:
    crc = 0
    for at in reversed(range(bits)):
        crc = (crc << 1 & 0x7FFF) ^ (CRC15 if (crc >> 14 ^ value >> at) & 1 else 0)
    return crc


@lru_cache(256)
def _crc15_byte(high: int) -> int:
    crc = 0
    for at in reversed(range(8)):
        crc = (crc << 1 & 0x7FFF) ^ (CRC15 if (crc >> 14 ^ high >> at) & 1 else 0)
    return crc


@lru_cache(16_384)
def _stuff(state: tuple[int, int], value: int, bits: int) -> tuple[tuple[int, int], int]:
    """Return the state (last bit, its run's length) after some bits, and the stuff bits they brought.

    After five equal bits comes one of the other kind, which is the first of the next run.
    """
    last, run = state
    stuff_bits = 0
    for at in reversed(range(bits)):
        bit = value >> at & 1
        run = run + 1 if bit == last else 1
        last = bit
        if run == 5:
            stuff_bits += 1
            last, run = 1 - last, 1
    return (last, run), stuff_bits
