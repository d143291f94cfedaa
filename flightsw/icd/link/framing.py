"""Packets in a serial byte stream: COBS + CRC-16 between zero bytes; every byte is delivered or counted.

On a wired link this takes the place of the radio's transfer frames; the packets inside stay the same. The
CRC is CCITT's with the final inversion (CRC-16/GENIBUS): without it a packet followed by zeros fits its CRC
too, and COBS makes such a zero of a delimiter with its lowest bit flipped.
"""

from collections.abc import Callable

from cobs import cobs
from fastcrc import crc16

from flightsw.icd.packet import APIDS, HEADER, PacketError, pack_packet, unpack_packet

DELIMITER = b"\0"
CRC_BYTES = 2
SEQ_COUNTS = 1 << 14
LATE_COUNTS = 64  # a packet so far behind the newest is late or comes twice: links mix up fewer, CAN FD 16
ALL_HEARD = (1 << LATE_COUNTS) - 1
START_COUNTS = 1024  # a side that has started anew is heard again before it has sent so many packets


def frame_packet(packet: bytes) -> bytes:
    """Return a packet as it goes on the wire: COBS of packet and CRC-16, then one zero byte."""
    return cobs.encode(packet + crc16.genibus(packet).to_bytes(CRC_BYTES, "big")) + DELIMITER


def max_frame_bytes(max_packet_bytes: int) -> int:
    """Return the most bytes that a packet takes on the wire, its delimiter left out."""
    content = max_packet_bytes + CRC_BYTES
    return content + content // 254 + 1


class DelimitedBytes:
    """Cuts a byte stream at a delimiter; what is too long is dropped and counted as it comes, so memory is bounded."""

    def __init__(self, delimiter: bytes, longest_bytes: int):
        self.skipped_bytes = 0  # too long, damaged or nothing that is known
        self._delimiter, self._longest_bytes = delimiter, longest_bytes
        self._pending = bytearray()
        self._too_long = False  # the bytes since the last delimiter are already dropped

    @property
    def pending_bytes(self) -> int:
        """Bytes that are kept since the last delimiter."""
        return len(self._pending)

    def split(self, data: bytes) -> list[bytes | None]:
        """Return the parts that end in `data`, without their delimiters; None for a part that was too long."""
        *ended, rest = data.split(self._delimiter)
        parts = []
        for piece in ended:
            self._collect(piece)
            parts.append(None if self._too_long else bytes(self._pending))
            self._pending.clear()
            self._too_long = False
        self._collect(rest)
        return parts

    def _collect(self, piece: bytes) -> None:
        if self._too_long or len(self._pending) + len(piece) > self._longest_bytes:
            self._too_long = True
            self.skipped_bytes += len(self._pending) + len(piece)
            self._pending.clear()
        else:
            self._pending += piece


class Deframer(DelimitedBytes):
    """Finds packets in a byte stream that may start, break and lie anywhere.

    What ends before the first delimiter and is no packet counts as the rest of one that was under way, not as damage.
    At all times `packet_bytes + idle_bytes + joined_bytes + skipped_bytes + pending_bytes` is the number of bytes fed.
    """

    def __init__(self, max_packet_bytes: int):
        super().__init__(DELIMITER, max_frame_bytes(max_packet_bytes))
        self.packet_bytes = 0  # of packets delivered, as framed
        self.idle_bytes = 0  # delimiters with nothing between them
        self.joined_bytes = 0  # the rest of a packet that was under way when the stream began
        self.crc_errors = 0  # runs of bytes between delimiters that are no packet
        self._is_first = True  # no delimiter has come yet

    def feed(self, data: bytes) -> list[bytes]:
        """Return the packets that `data` completes; memory is bounded by the longest packet."""
        packets = map(self._packet_of, self.split(data))
        return [packet for packet in packets if packet is not None]

    def _packet_of(self, frame: bytes | None) -> bytes | None:
        is_first, self._is_first = self._is_first, False
        if frame == b"":
            self.idle_bytes += 1
            return None
        packet = None if frame is None else _packet_in(frame)
        size_bytes = len(frame or b"") + 1
        if packet is None and frame is not None and is_first:
            self.joined_bytes += size_bytes
        elif packet is None:
            self.skipped_bytes += size_bytes
            self.crc_errors += 1
        else:
            self.packet_bytes += size_bytes
        return packet


def _packet_in(frame: bytes) -> bytes | None:
    try:
        content = cobs.decode(frame)
    except cobs.DecodeError:
        return None
    packet, crc = content[:-CRC_BYTES], content[-CRC_BYTES:]
    if not packet or crc16.genibus(packet) != int.from_bytes(crc, "big"):
        return None
    return packet


class PacketStream:
    """Both directions of our packets on a wire, with gaps in the other side's counts noticed.

    Args:
        packet_type: of the packets that this side sends.
    """

    def __init__(self, packet_type: int, max_packet_bytes: int):
        self.deframer = Deframer(max_packet_bytes)
        self.max_data_bytes = max_packet_bytes - HEADER.size
        self.packets_sent = 0
        self.bytes_sent = 0
        self.packets_received = 0
        self.packets_missing = 0  # by gaps in the sequence count of each APID, see `_count`
        self.packets_foreign = 0  # whole, but no packet of the other side's
        self.on_packet: Callable[[bytes], None] = lambda packet: (
            None
        )  # given each of the other side's, with its header
        self._packet_type = packet_type
        self._next_count = dict.fromkeys(APIDS, 0)
        # by APID: the count after the newest, and which of the LATE_COUNTS before it were heard, the newest in bit 0
        self._expected: dict[int, tuple[int, int]] = {}

    def encode(self, apid: int, data: bytes) -> bytes:
        """Return `data` as the APID's next packet, framed for the wire."""
        framed = frame_packet(pack_packet(self._packet_type, apid, self._next_count[apid], data))
        self._next_count[apid] = (self._next_count[apid] + 1) % SEQ_COUNTS
        self.packets_sent += 1
        self.bytes_sent += len(framed)
        return framed

    def decode(self, wire_bytes: bytes) -> list[tuple[int, bytes]]:
        """Return APID and data of the packets that `wire_bytes` completes."""
        data = []
        for packet in self.deframer.feed(wire_bytes):
            try:
                header, content = unpack_packet(packet)
            except PacketError:
                self.packets_foreign += 1
                continue
            if header.apid not in APIDS or header.packet_type == self._packet_type:
                self.packets_foreign += 1
                continue
            self._count(header.apid, header.seq_count)
            self.on_packet(packet)
            data.append((header.apid, content))
        return data

    def _count(self, apid: int, seq_count: int) -> None:
        """Count the packets that are missing before this one; one that comes late is missing no more.

        A cut of the link can lose any number. Up to 8,191, half the range, are counted: a minute and a half at 921,600
        baud with packets of 1,100 bytes. A longer jump is none, and neither is one of more than START_COUNTS that ends
        below START_COUNTS: the other side has started anew and counts from 0.
        """
        self.packets_received += 1
        expected, heard = self._expected.get(apid, (seq_count, ALL_HEARD))
        jump = (seq_count - expected) % SEQ_COUNTS
        behind = SEQ_COUNTS - jump
        if behind <= LATE_COUNTS:
            bit = 1 << (behind - 1)
            if not heard & bit:
                self.packets_missing -= 1
            self._expected[apid] = expected, heard | bit
            return
        if jump >= SEQ_COUNTS // 2 or (jump > START_COUNTS and seq_count < START_COUNTS):
            heard = ALL_HEARD
        else:
            self.packets_missing += jump
            heard = (heard << (jump + 1) | 1) & ALL_HEARD
        self._expected[apid] = (seq_count + 1) % SEQ_COUNTS, heard
