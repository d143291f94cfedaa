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


class RunningChecksum:
    """The checksum of a file whose parts come one after the other.

    The modular one (CCSDS 727.0-B, 4.2.2) is the sum of the file's big-endian 32-bit words, the last one filled up with
    zeros: words that changed places keep it, so it is for other systems that know no CRC.
    """

    def __init__(self, kind: Checksum):
        self._kind, self._number = kind, 0
        self._unfinished = b""  # up to three bytes of the modular checksum's next word

    def add(self, part: bytes) -> None:
        """Take the next part of the file."""
        match self._kind:
            case "crc-32":
                self._number = zlib.crc32(part, self._number)
            case "crc-32c":
                self._number = crc32.iscsi(part, self._number)
            case "modular":
                words = self._unfinished + part
                whole_bytes = len(words) // 4 * 4
                self._unfinished = words[whole_bytes:]
                self._number += int(np.frombuffer(words[:whole_bytes], ">u4").sum(dtype=np.uint64))

    def value(self) -> bytes:
        """Return the four bytes of the checksum of all parts so far."""
        last_word = int.from_bytes(self._unfinished.ljust(4, b"\0"), "big")
        return ((self._number + last_word) % (1 << 32)).to_bytes(4, "big")
