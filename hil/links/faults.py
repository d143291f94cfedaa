"""The faults that a virtual link can have, and the set that the demo and the benchmarks call standard."""

import random
from dataclasses import asdict, dataclass


@dataclass(frozen=True)
class Faults:
    """Probability of each fault for one unit of either direction.

    A unit is a packet (the bytes up to a zero byte) on a serial line and a frame on a CAN bus; virtual_can.py says
    what each fault means there.
    """

    loss: float = 0.0
    bit_flip: float = 0.0  # one random bit of the unit
    duplicate: float = 0.0
    reorder: float = 0.0  # changes places with the next unit

    def __post_init__(self):
        for name, value in asdict(self).items():
            if not 0 <= value <= 1:
                raise ValueError(f"{name} must be 0 to 1, got {value}")

    @property
    def any(self) -> bool:
        return any(asdict(self).values())


def flip_a_bit(data: bytes, source: random.Random) -> bytes:
    """Return `data` with one random bit changed."""
    bit = source.randrange(8 * len(data))
    damaged = bytearray(data)
    damaged[bit // 8] ^= 1 << bit % 8
    return bytes(damaged)


STANDARD_FAULTS = Faults(loss=0.02, bit_flip=0.02, duplicate=0.02, reorder=0.02)
STANDARD_CUT_S = 5.0  # length of one cut, made when half of the frames have arrived
