"""Commands and the reports on them, packed and unpacked as dictionary.yaml describes them."""

from dataclasses import dataclass
from typing import Any, Self

from flightsw.icd.telemetry import DICTIONARY, Layout

ENDED = ("refused", "completed", "failed")  # the stages after which nothing more is reported
REPORT = DICTIONARY.reports["report"]


@dataclass(frozen=True)
class Command:
    """One command with its arguments."""

    name: str
    arguments: dict[str, Any]

    def __post_init__(self):
        if self.name not in DICTIONARY.commands:
            known = ", ".join(DICTIONARY.commands)
            raise ValueError(f"no command {self.name!r}; there are {known}")

    @property
    def layout(self) -> Layout:
        return DICTIONARY.commands[self.name]

    def pack(self) -> bytes:
        """Return the command's bytes, to be sealed.

        Raises:
            ValueError: an argument is missing, unknown or out of range.
        """
        return self.layout.pack(**self.arguments)

    @classmethod
    def unpack(cls, data: bytes) -> Self:
        """Return the command in an unsealed packet.

        Raises:
            PacketError: no command of the dictionary, or an argument out of range.
        """
        layout, arguments = DICTIONARY.unpack("commands", data)
        return cls(layout.name, arguments)


@dataclass(frozen=True)
class Report:
    """What became of the command in one sealed packet."""

    utc_ns: int
    counter: int
    digest: bytes  # of the packet: another one with the same counter has another
    stage: str  # accepted, refused, started, completed or failed
    text: str

    def pack(self) -> bytes:
        return REPORT.pack(**vars(self))

    @classmethod
    def unpack(cls, data: bytes) -> Self:
        """Return the report in a packet's data.

        Raises:
            PacketError: no report.
        """
        return cls(**REPORT.unpack(data))


def model_file_name(counter: int) -> str:
    """Return the name under which the model file of a command is sent: it is compared, never opened."""
    return f"model-{counter}"
