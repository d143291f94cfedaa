"""Sealed commands: AES-256-GCM in the shape of CCSDS 355.0-B. Bytes in, bytes out; keeps no counter and no file.

A sealed packet is the security header (key number, initialisation vector), the encrypted command and the tag. The
vector is a counter that never comes again under the same key, so it is also what replays are recognised by. Reports on
a packet carry its digest, so that none is taken for the report on another packet.
"""

import hashlib
import re
import struct
from dataclasses import dataclass, field
from typing import Self

from cryptography.exceptions import InvalidTag
from cryptography.hazmat.primitives.ciphers.aead import AESGCM

from flightsw.icd.config import ConfigError
from flightsw.icd.packet import PacketError
from obbgs_base.checked import checked_line, parse_checked_line

SECURITY_HEADER = struct.Struct(">H4xQ")  # SPI; IV of 12 bytes: zeros, counter
TAG_BYTES = 16
DIGEST_BYTES = 8  # of a sealed packet
MAX_COUNTER = (1 << 64) - 1
KEY_TEXT = re.compile(r"(\d{1,5}) ([0-9a-f]{64})\n", re.ASCII)
# of earlier versions, without a checksum
EARLIER_COUNTER = re.compile(r"(\d{1,20}) ([0-9a-f]{16})\n", re.ASCII)


class AuthError(PacketError):
    """A packet is not from somebody who has the key, or was changed on its way."""


@dataclass(frozen=True)
class Key:
    """The mission's secret and its number."""

    spi: int  # security parameter index, 16 bits
    secret: bytes = field(repr=False)  # 32 bytes

    def __post_init__(self):
        if not 0 < self.spi < 0xFFFF or len(self.secret) != 32:  # 0 and 65535 are reserved (355.0-B)
            raise ValueError("a key has a number of 1 to 65534 and 32 bytes")

    @classmethod
    def parse(cls, text: str, path: str) -> Self:
        """Return the key in a key file's text; `path` names it in the error.

        Raises:
            ConfigError: no key; the message does not repeat what is there.
        """
        match = KEY_TEXT.fullmatch(text)
        try:
            if match:
                return cls(int(match[1]), bytes.fromhex(match[2]))
        except ValueError as error:
            raise ConfigError(path, str(error)) from error
        raise ConfigError(path, "expected a key number and 64 hexadecimal digits: make one with `ground key`")

    @property
    def text(self) -> str:
        return f"{self.spi} {self.secret.hex()}\n"

    @property
    def fingerprint(self) -> str:
        """16 hexadecimal digits that tell keys apart and give nothing away."""
        return hashlib.sha256(b"fingerprint" + self.secret).hexdigest()[:16]

    def __str__(self) -> str:
        return f"{self.spi} ({self.fingerprint})"

    def counter_text(self, counter: int) -> str:
        """Return what a counter file of this key holds: a line of JSON with a checksum."""
        return checked_line({"counter": counter, "key": self.fingerprint}).decode() + "\n"

    def parse_counter(self, text: str, path: str) -> int:
        """Return the counter in a counter file's text.

        Raises:
            ConfigError: damaged, or another key's. Starting again from 0 would repeat vectors and admit replays.
        """
        try:
            tree = parse_checked_line(text.removesuffix("\n").encode())
            counter, fingerprint = tree["counter"], tree["key"]
        except (ValueError, KeyError) as error:
            earlier = EARLIER_COUNTER.fullmatch(text)
            if earlier is None:
                raise ConfigError(path, "is damaged: it is not this key's counter") from error
            counter, fingerprint = int(earlier[1]), earlier[2]
        if fingerprint != self.fingerprint or type(counter) is not int or not 0 <= counter <= MAX_COUNTER:
            raise ConfigError(
                path, f"is not this key's counter, which has the fingerprint {self.fingerprint}"
            )
        return counter


def digest(packet: bytes) -> bytes:
    """Return what tells a sealed packet from all others in the reports on it."""
    return hashlib.sha256(packet).digest()[:DIGEST_BYTES]


def seal(key: Key, counter: int, content: bytes) -> bytes:
    """Return the content encrypted and authenticated. The counter must never be used again with this key."""
    header = SECURITY_HEADER.pack(key.spi, counter)
    return header + AESGCM(key.secret).encrypt(header[2:], content, header)


def unseal(key: Key, data: bytes) -> tuple[int, bytes]:
    """Return the counter and the content of a sealed packet. Whether the counter is new is the caller's to say.

    Raises:
        AuthError: too short, another key's, or changed.
    """
    spi, counter = claimed(data)
    if spi != key.spi:
        raise AuthError(f"sealed with key {spi}, this is key {key.spi}")
    header, sealed = data[: SECURITY_HEADER.size], data[SECURITY_HEADER.size :]
    try:
        return counter, AESGCM(key.secret).decrypt(header[2:], sealed, header)
    except InvalidTag as error:
        raise AuthError("the tag does not fit: forged or changed") from error


def claimed(data: bytes) -> tuple[int, int]:
    """Return the key number and the counter that a sealed packet says it has; anybody can say so.

    Raises:
        AuthError: too short to be sealed.
    """
    if len(data) < SECURITY_HEADER.size + TAG_BYTES:
        raise AuthError(
            f"a sealed packet has at least {SECURITY_HEADER.size + TAG_BYTES} bytes, got {len(data)}"
        )
    return SECURITY_HEADER.unpack_from(data)


def seal_file(file_key: bytes, content: bytes) -> bytes:
    """Return a file encrypted and authenticated with a key of 32 bytes that is used for nothing else."""
    return AESGCM(file_key).encrypt(bytes(12), content, None)


def unseal_file(file_key: bytes, data: bytes) -> bytes:
    """Return the content of a sealed file.

    Raises:
        AuthError: another key's, or changed.
    """
    try:
        return AESGCM(file_key).decrypt(bytes(12), data, None)
    except (InvalidTag, ValueError) as error:
        raise AuthError("the file's tag does not fit: forged or changed") from error
