"""A simulated slcan adapter: lines of text to and from its computer, CAN frames to and from the bus."""

import contextlib
import os
import random
from collections import deque
from dataclasses import dataclass

from isotp import CanMessage

from flightsw.icd.link.link_url import SLCAN_BITRATES
from flightsw.icd.link.slcan import SlcanText, format_slcan, parse_slcan
from hil.links.faults import flip_a_bit
from hil.links.virtual_link import VirtualLink

QUEUE_FRAMES = 128  # an adapter takes no more text until the bus has taken some
ADAPTER_BUFFER_BYTES = 32_768  # of text that a computer has not read, besides the terminal's own


@dataclass
class BusLaneStatistics:
    """Counts of one direction, in CAN frames.

    frames_in + frames_duplicated = frames_out + frames_lost + frames_cut + frames_overrun + frames_abandoned +
    frames_held, at all times; a destroyed frame that is sent again is held until then.
    """

    frames_in: int = 0  # accepted by the sending adapter
    frames_out: int = 0  # read by the receiving computer
    bytes_out: int = 0  # data bytes of those
    frames_destroyed: int = 0  # on the bus
    frames_lost: int = 0  # destroyed and not sent again
    frames_flipped: int = 0
    frames_duplicated: int = 0
    frames_reordered: int = 0
    frames_cut: int = 0
    frames_overrun: int = 0  # the receiving computer did not read in time
    frames_abandoned: int = 0  # in an adapter whose own computer closed it
    frames_held: int = 0  # accepted and still on the way
    commands: int = 0  # understood by the sending adapter
    refused: int = 0  # lines that it did not understand, or frames while it was not open
    bus_busy_s: float = 0.0  # this direction's share of the bus


class SlcanAdapter:
    """One end of a virtual CAN bus: a computer's text on a pseudo-terminal, and the frames that the bus takes from it.

    Args:
        link: gives the faults and the latency, which may change while it runs.
        bitrate: the only one at which the adapter opens, that of the bus.
        master: file descriptor of the pseudo-terminal's side that is not the computer's.
        seed: of the faults.
    """

    def __init__(self, link: VirtualLink, bitrate: int, master: int, seed: int):
        self.master = master
        self.statistics = BusLaneStatistics()  # of the direction that it sends
        self.queue: deque[tuple[float, CanMessage]] = deque()  # for the bus, with times of arrival
        self.is_open = False
        self._link, self._bus_bitrate = link, bitrate
        self._random = random.Random(seed)
        self._bitrate, self._fd = 0, False  # as the computer has set them
        self._line = bytearray()  # of text from the computer, until it ends
        self._travelling: deque[tuple[float, CanMessage]] = deque()  # when each frame reaches the computer
        self._held_back: tuple[bytes, int] | None = None  # a frame that the next overtakes
        self._out = bytearray()
        # For each line in `_out`: the bytes of text that are left, and the data bytes of its frame (-1: an answer).
        self._out_frames: deque[list[int]] = deque()
        self.partner: SlcanAdapter = self  # the other end, set by the bus

    @property
    def wants_text(self) -> bool:
        return len(self.queue) < QUEUE_FRAMES

    @property
    def has_unwritten(self) -> bool:
        return bool(self._out or self._travelling)

    def read(self, now_s: float) -> None:
        """Take the lines that the computer has written."""
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
            self._bitrate, self._fd = SLCAN_BITRATES[int(line[1:])], False
        elif line == b"Y5":
            self._fd = True
        elif line == b"O" and self._bitrate == self._bus_bitrate:
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
        self._travelling.append((at_s + self._link.latency_s, frame))

    def write(self, now_s: float) -> None:
        """Give the computer the text of the frames that have arrived, as much as its terminal takes."""
        arrived = 0
        while self._travelling and self._travelling[0][0] <= now_s:
            self._hand_over(self._travelling.popleft()[1])
            arrived += 1
        if not arrived and self._held_back is not None:  # the bus is quiet: no frame will overtake it
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
        draw, faults, lane = self._random.random, self._link.faults, self.partner.statistics
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
