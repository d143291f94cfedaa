"""The faults that a virtual link can have, their names on a command line, and the set that is called standard."""

import random
from dataclasses import asdict, dataclass, fields, replace


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


@dataclass(frozen=True)
class LinkFaults:
    """What a virtual link does to what it carries, as one text of a command line says it."""

    faults: Faults = Faults()
    latency_s: float = 0.0
    overrun: bool = False  # serial: no flow control, so that bytes which are not read in time are lost
    one_shot: bool = False  # CAN: a frame that is destroyed on the bus is not repeated
    seed: int = 1
    cut_s: float = 0.0  # one cut of this length in the middle of a pass

    @classmethod
    def parse(cls, text: str) -> "LinkFaults":
        """Return what a text says: `none`, `standard`, or fractions and others, such as `loss=0.02,latency=0.2`.

        Raises:
            ValueError: another name, or a value that cannot be.
        """
        if text in ("none", "standard"):
            return cls() if text == "none" else cls(STANDARD_FAULTS, cut_s=STANDARD_CUT_S)
        found, shares = cls(), [field.name for field in fields(Faults)]
        for part in text.split(","):
            name, equals, value = part.strip().partition("=")
            try:
                if name in shares and equals:
                    found = replace(found, faults=replace(found.faults, **{name: float(value)}))
                elif name == "latency" and 0 <= float(value) < 3600:
                    found = replace(found, latency_s=float(value))
                elif name == "seed" and int(value) >= 0:
                    found = replace(found, seed=int(value))
                elif name in ("overrun", "one_shot") and not equals:
                    found = replace(found, **{name: True})
                else:
                    raise ValueError
            except ValueError as error:
                raise ValueError(
                    f"--faults: expected none, standard, or {', '.join(shares)} with a fraction of 0 to 1, latency "
                    f"with seconds, seed with a number, overrun and one_shot, as in loss=0.02,seed=3; got {part!r}"
                ) from error
        return found
