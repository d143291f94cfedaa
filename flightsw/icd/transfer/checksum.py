"""The checksums of a file that CFDP knows and the mission file can choose (SANA registry of CFDP checksum types)."""

import zlib

import numpy as np
from fastcrc import crc32
from spacepackets.cfdp import ChecksumType

from flightsw.icd.mission import Checksum

TYPES: dict[Checksum, ChecksumType] = {
    "crc-32": ChecksumType.CRC_32,
    "crc-32c": ChecksumType.CRC_32C,
    "modular": ChecksumType.MODULAR,
}


def file_checksum(kind: ChecksumType, content: bytes | bytearray) -> bytes:
    """Return the four bytes of a file's checksum.

    The modular one (CCSDS 727.0-B, 4.2.2) is the sum of the file's big-endian 32-bit words, the last one filled up with
    zeros: words that changed places keep it, so it is for other systems that know no CRC.

    Raises:
        ValueError: another kind.
    """
    match kind:
        case ChecksumType.CRC_32:
            number = zlib.crc32(content)
        case ChecksumType.CRC_32C:
            number = crc32.iscsi(bytes(content))
        case ChecksumType.MODULAR:
            words = np.frombuffer(bytes(content) + bytes(-len(content) % 4), ">u4")
            number = int(words.sum(dtype=np.uint64)) % (1 << 32)
        case _:
            raise ValueError(f"expected CRC-32, CRC-32C or the modular checksum, got {kind!r}")
    return number.to_bytes(4, "big")
