"""CCSDS space packets (133.0-B): the header, and the errors of everything that comes over the link."""

import struct
from dataclasses import dataclass
from typing import Self

from obbgs_base.errors import ObbgsError

HEADER = struct.Struct(">HHH")
TELEMETRY, TELECOMMAND = 0, 1
UNSEGMENTED = 3
APID_FILES = 0x0C0  # CFDP PDUs of files to the ground, both directions
APID_HOUSEKEEPING = 0x0C1  # to the ground
APID_EVENTS = 0x0C2  # to the ground
APID_REPORTS = 0x0C3  # what became of commands, to the ground
APID_FRAME_HEADERS = 0x0C4  # a frame's header as soon as it is stored, to the ground
APID_COMMANDS = 0x0C5  # sealed commands, to the spacecraft
APID_UPLINK_FILES = 0x0C6  # CFDP PDUs of files to the spacecraft, both directions
APIDS = range(APID_FILES, APID_UPLINK_FILES + 1)


class PacketError(ObbgsError, ValueError):
    """Bytes from the link are not what they claim to be."""


class PacketTooShort(PacketError):
    """Fewer bytes than the header promises."""


class CrcMismatch(PacketError):
    """A checksum does not fit its bytes."""


@dataclass(frozen=True, slots=True)
class PacketHeader:
    """The six bytes before every packet's data."""

    packet_type: int  # 1 bit: TELEMETRY or TELECOMMAND
    apid: int  # 11 bits
    seq_count: int  # 14 bits, counted per APID
    data_length: int  # 16 bits, bytes in the data field minus one
    seq_flags: int = UNSEGMENTED  # 2 bits

    def __post_init__(self):
        for name, bits in (
            ("packet_type", 1),
            ("apid", 11),
            ("seq_count", 14),
            ("data_length", 16),
            ("seq_flags", 2),
        ):
            if not 0 <= getattr(self, name) < 1 << bits:
                raise PacketError(f"{name}={getattr(self, name)} does not fit {bits} bits")

    def pack(self) -> bytes:
        """Return the header's six bytes: packet version 0, no secondary header."""
        return HEADER.pack(
            self.packet_type << 12 | self.apid, self.seq_flags << 14 | self.seq_count, self.data_length
        )

    @classmethod
    def unpack(cls, data: bytes) -> Self:
        """Return the header at the start of `data`.

        Raises:
            PacketTooShort: fewer than six bytes.
            PacketError: another packet version, or a secondary header, which this link does not use.
        """
        if len(data) < HEADER.size:
            raise PacketTooShort(f"a packet header has {HEADER.size} bytes, got {len(data)}")
        first, second, data_length = HEADER.unpack_from(data)
        if first >> 13 or first & 0x0800:
            raise PacketError(f"expected packet version 0 without secondary header, got 0x{first:04x}")
        return cls(first >> 12, first & 0x07FF, second & 0x3FFF, data_length, second >> 14)


def pack_packet(packet_type: int, apid: int, seq_count: int, data: bytes) -> bytes:
    """Return `data` (1 to 65536 bytes) behind its header."""
    return PacketHeader(packet_type, apid, seq_count, len(data) - 1).pack() + data


def unpack_packet(packet: bytes) -> tuple[PacketHeader, bytes]:
    """Return the header and the data of exactly one packet.

    Raises:
        PacketError: the header is not valid, or its length is not that of the bytes.
    """
    header = PacketHeader.unpack(packet)
    data = packet[HEADER.size :]
    if len(data) != header.data_length + 1:
        raise PacketTooShort(f"the header promises {header.data_length + 1} data bytes, got {len(data)}")
    return header, data
