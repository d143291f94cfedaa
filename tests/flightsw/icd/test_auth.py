"""Sealed packets: against GCM by its definition, and against whoever lacks the key."""

import pytest
from cryptography.hazmat.primitives.ciphers import Cipher, algorithms, modes
from hypothesis import given
from hypothesis import strategies as st

from flightsw.icd.config import ConfigError
from flightsw.icd.link.auth import (
    SECURITY_HEADER,
    TAG_BYTES,
    AuthError,
    Key,
    seal,
    seal_file,
    unseal,
    unseal_file,
)

KEY = Key(1, bytes(range(32)))
contents = st.binary(max_size=300)
counters = st.integers(0, (1 << 64) - 1)


def gcm_by_definition(secret: bytes, iv: bytes, plain: bytes, aad: bytes) -> bytes:
    """Return ciphertext and tag of AES-GCM as NIST SP 800-38D writes it, from single AES blocks."""
    encryptor = Cipher(algorithms.AES(secret), modes.ECB()).encryptor()

    def block(data: bytes) -> int:
        return int.from_bytes(encryptor.update(data), "big")

    def times(x: int, y: int) -> int:  # in GF(2^128), the first bit is the lowest power
        product = 0
        for bit in range(127, -1, -1):
            product ^= y * (x >> bit & 1)
            y = y >> 1 ^ (0xE1 << 120) * (y & 1)
        return product

    def padded(data: bytes) -> bytes:
        return data + bytes(-len(data) % 16)

    cipher = b""
    for number, at in enumerate(range(0, len(plain), 16), start=2):
        piece = plain[at : at + 16]
        stream = block(iv + number.to_bytes(4, "big")).to_bytes(16, "big")
        cipher += bytes(a ^ b for a, b in zip(piece, stream, strict=False))
    lengths = (8 * len(aad)).to_bytes(8, "big") + (8 * len(cipher)).to_bytes(8, "big")
    hashed, subkey = 0, block(bytes(16))
    text = padded(aad) + padded(cipher) + lengths
    for at in range(0, len(text), 16):
        hashed = times(hashed ^ int.from_bytes(text[at : at + 16], "big"), subkey)
    return cipher + (hashed ^ block(iv + b"\0\0\0\1")).to_bytes(16, "big")


@given(counters, contents)
def test_sealed_packets_open_with_the_key_and_give_their_counter(counter, content):
    assert unseal(KEY, seal(KEY, counter, content)) == (counter, content)


@pytest.mark.parametrize("content", [b"", b"ping", bytes(100)])
def test_a_sealed_packet_is_gcm_with_the_header_as_its_vector_and_its_authenticated_data(content):
    header = (513).to_bytes(2, "big") + bytes(4) + (7).to_bytes(8, "big")
    expected = header + gcm_by_definition(KEY.secret, header[2:], content, header)
    assert seal(Key(513, KEY.secret), 7, content) == expected


@given(counters, contents, st.data())
def test_a_flipped_bit_anywhere_is_refused(counter, content, data):
    packet = bytearray(seal(KEY, counter, content))
    bit = data.draw(st.integers(0, 8 * len(packet) - 1))
    packet[bit // 8] ^= 1 << bit % 8
    with pytest.raises(AuthError):
        unseal(KEY, bytes(packet))


@given(contents, st.data())
def test_a_truncated_packet_is_refused(content, data):
    packet = seal(KEY, 1, content)
    with pytest.raises(AuthError):
        unseal(KEY, packet[: data.draw(st.integers(0, len(packet) - 1))])


@given(st.binary(max_size=200))
def test_nothing_made_without_the_key_is_accepted(data):
    with pytest.raises(AuthError):
        unseal(KEY, data)
    with pytest.raises(AuthError):
        unseal(KEY, SECURITY_HEADER.pack(KEY.spi, 1) + data)


def test_another_key_and_another_number_are_refused_by_name():
    packet = seal(KEY, 1, b"ping")
    with pytest.raises(AuthError, match="the tag does not fit"):
        unseal(Key(1, bytes(32)), packet)
    with pytest.raises(AuthError, match="sealed with key 1, this is key 2"):
        unseal(Key(2, KEY.secret), packet)
    assert len(packet) == SECURITY_HEADER.size + len(b"ping") + TAG_BYTES


@given(st.binary(min_size=32, max_size=32), contents)
def test_files_open_with_their_own_key_only(file_key, content):
    sealed = seal_file(file_key, content)
    assert unseal_file(file_key, sealed) == content
    other = bytes([file_key[0] ^ 1]) + file_key[1:]
    for bad_key, data in ((other, sealed), (file_key, sealed[:-1]), (file_key, b"")):
        with pytest.raises(AuthError):
            unseal_file(bad_key, data)


def test_key_and_counter_survive_their_files():
    assert Key.parse(KEY.text, "k") == KEY
    assert KEY.parse_counter(KEY.counter_text(12), "c") == 12
    assert KEY.secret.hex() not in repr(KEY) + KEY.counter_text(0)


@pytest.mark.parametrize("text", ["", "1 abc\n", KEY.text[:-1], KEY.text * 2, KEY.text.replace("1", "0", 1)])
def test_a_damaged_key_file_is_refused_without_showing_it(text):
    with pytest.raises(ConfigError, match=r"mission\.key") as caught:
        Key.parse(text, "mission.key")
    assert "abc" not in str(caught.value)


@pytest.mark.parametrize(
    "text", ["", "5\n", "x\n", Key(1, bytes(32)).counter_text(5), f"{1 << 64} {KEY.fingerprint}\n"]
)
def test_a_counter_that_is_damaged_or_another_keys_is_refused(text):
    with pytest.raises(ConfigError, match="not this key's counter"):
        KEY.parse_counter(text, "mission.key.received")
