"""Pixels as a JPEG-LS codestream (ISO 14495-1, 16 bits, interleaved if colour) and back, by CharLS.

pyjpegls holds the interpreter meanwhile: some 40 ms per megapixel on a server processor.
"""

import struct

import _CharLS
import jpeg_ls
import numpy as np

from flightsw.icd.packet import PacketError

END_OF_IMAGE = b"\xff\xd9"
START_OF_FRAME = 0xF7
BITS = 16
SPARE_BYTES = 512  # pyjpegls gives a codestream twice the room of its pixels: too little for a dozen of them


def encode_pixels(dn: np.ndarray, max_error_dn: int) -> bytes:
    """Return the codestream of a picture.

    Args:
        dn: [H, W] or [H, W, 3] uint16.
        max_error_dn: the largest error of a pixel, which JPEG-LS calls NEAR; 0 is lossless.
    """
    height, width, channels = (*dn.shape, 1)[:3]
    interleave = 2 if channels == 3 else 0  # by pixel; a single channel has nothing to interleave
    pixels = dn.astype("<u2").tobytes() + bytes(SPARE_BYTES)
    return bytes(_CharLS._encode(pixels, max_error_dn, interleave, height, width, channels, BITS))


def decode_pixels(codestream: bytes, shape: tuple[int, int, int]) -> np.ndarray:
    """Return the picture [H, W] or [H, W, 3] uint16 of a codestream.

    Args:
        shape: height, width and channels that it must have; checked first, since hostile sizes must not take memory.

    Raises:
        PacketError: another size or depth, or no codestream of JPEG-LS.
    """
    if _announced_size(codestream) != shape:
        raise PacketError(f"the header says {shape}, the codestream {_announced_size(codestream)}")
    if not codestream.endswith(END_OF_IMAGE):
        raise PacketError("the JPEG-LS codestream does not end: the decoder would search for seconds")
    try:
        dn = jpeg_ls.jlsread(codestream)
    except (ValueError, RuntimeError) as error:
        raise PacketError(f"the JPEG-LS codestream cannot be decoded: {error}") from error
    expected_shape = shape[:2] if shape[2] == 1 else shape
    if dn.shape != expected_shape or dn.dtype.itemsize != 2:
        raise PacketError(
            f"the header says {expected_shape} of 16 bits, the codestream {dn.shape} {dn.dtype}"
        )
    return dn.astype(np.uint16)


def _announced_size(codestream: bytes) -> tuple[int, int, int] | None:
    """Return height, width and components that a codestream announces, None if it announces none."""
    at = 2  # after the start-of-image marker
    while at + 10 <= len(codestream) and codestream[at] == 0xFF:
        marker, length = codestream[at + 1], int.from_bytes(codestream[at + 2 : at + 4], "big")
        if marker == START_OF_FRAME:
            _, height, width, components = struct.unpack_from(">BHHB", codestream, at + 4)
            return height, width, components
        at += 2 + length
    return None
