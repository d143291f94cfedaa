"""How long a CAN frame occupies the bus: its bits, the CRC and the stuff bits included.

Source: ISO 11898-1:2015, Controller area network, data link layer and physical coding sublayer.
"""

from functools import lru_cache

from isotp import CanMessage

DATA_BITRATE = 5_000_000  # of CAN FD's data phase
CRC15 = 0x4599  # CRC-15/CAN
TRAILER_BITS = 13  # CRC delimiter, acknowledgement and its delimiter, end of frame 7, intermission 3


def frame_s(frame: CanMessage, bitrate: int) -> float:
    """Return how long a frame occupies the bus, s, the pause after it included."""
    nominal_bits, data_phase_bits = frame_bits(frame)
    return nominal_bits / bitrate + data_phase_bits / (DATA_BITRATE if frame.bitrate_switch else bitrate)


def frame_bits(frame: CanMessage) -> tuple[int, int]:
    """Return a data frame's number of bits at the nominal rate and in CAN FD's data phase, stuff bits included."""
    return _fd_frame_bits(frame) if frame.is_fd else (_classic_frame_bits(frame), 0)


def _classic_frame_bits(frame: CanMessage) -> int:
    header, header_bits = _classic_header(frame.arbitration_id, frame.is_extended_id, len(frame.data))
    crc = _crc15_bits(header, header_bits)
    for byte in frame.data:
        crc = (crc << 8 & 0x7FFF) ^ _crc15_byte(crc >> 7 ^ byte)
    state, stuff_bits = _stuff((0, 0), header, header_bits)
    for value, bits in [*((byte, 8) for byte in frame.data), (crc >> 8, 7), (crc & 0xFF, 8)]:
        state, more = _stuff(state, value, bits)
        stuff_bits += more
    return header_bits + 8 * len(frame.data) + 15 + stuff_bits + TRAILER_BITS


def _fd_frame_bits(frame: CanMessage) -> tuple[int, int]:
    # start, identifier, then RRS (SRR if extended), IDE, FDF 1, res 0, BRS
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
    """Return the state (last bit, length of its run) after `bits` bits of `value`, and how many were stuffed.

    Five equal bits are followed by one stuff bit of opposite value, which begins the next run.
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
