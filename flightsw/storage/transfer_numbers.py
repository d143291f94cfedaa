"""What a frame store gives its file transfers: its identity, numbers that never come twice, and what is in flight."""

import json
import logging
import secrets
from collections.abc import Callable, Iterable
from pathlib import Path

from flightsw.icd.transfer import STORE_BYTES
from obbgs_base.checked import checked_line, has_checksum, parse_checked_line, read_twice, write_twice
from obbgs_base.errors import in_words

log = logging.getLogger(__name__)
FILE = "transaction"
IDENTITY = "store.json"
Write = Callable[[Path, bytes], None]


def parse_numbers(content: bytes) -> tuple[int, frozenset[int]]:
    """Return the last number given, and the frames that were in flight then.

    Raises:
        ValueError: neither a line with a checksum that fits, nor the bare number of an earlier version.
    """
    line = content.removesuffix(b"\n")
    if not has_checksum(line):
        if not (line.isdigit() and int(line) < 1 << 32):
            raise ValueError(f"expected a number with its checksum, got {content[:20]!r}")
        return int(line), frozenset()
    tree = parse_checked_line(line)
    try:
        return int(tree["number"]), frozenset(int(frame_id) for frame_id in tree["in_flight"])
    except (KeyError, TypeError) as error:
        raise ValueError(f"expected number and in_flight, got {json.dumps(tree)[:80]}") from error


def numbers_line(number: int, in_flight: Iterable[int]) -> bytes:
    """Return what the file of the numbers holds."""
    return checked_line({"number": number, "in_flight": sorted(in_flight)}) + b"\n"


def random_number() -> int:
    """Return where the numbers of a new store begin, and those after one that cannot be read: they never fall back."""
    return secrets.randbits(32)


class TransferNumbers:
    """The numbers of a store's transfers, in the file `transaction`; the caller holds the store's lock."""

    def __init__(self, folder: Path, write: Write):
        self._path, self._write = folder / FILE, write

    def give(self, in_flight: Iterable[int]) -> int:
        """Return a number that was never given before; it and the frames in flight are on the disk first.

        Raises:
            OSError: the disk refuses.
        """
        last, _ = self._read()
        number = (last + 1) % (1 << 32)
        self._write(self._path, numbers_line(number, in_flight))
        return number

    @property
    def in_flight(self) -> frozenset[int] | None:
        """The frames that may have arrived without this side knowing; those of a run that was killed too.

        None where the file is damaged: then it may be any.

        Raises:
            OSError: the disk refuses.
        """
        return self._read()[1]

    def _read(self) -> tuple[int, frozenset[int] | None]:
        try:
            return parse_numbers(self._path.read_bytes())
        except FileNotFoundError:
            return random_number(), frozenset()
        except ValueError as error:
            log.warning("the number of the last transfer is damaged, they go on at random: %s", error)
            return random_number(), None


def store_identity(folder: Path, write: Write) -> bytes:
    """Return the `STORE_BYTES` by which the ground tells this store from any other, made when they are asked for first.

    They stand twice, with a checksum. Where neither copy is good, or the disk does not take them, others are drawn.
    """
    path = folder / IDENTITY
    try:
        known = read_twice(path, log.warning)
        if known is not None:
            store = bytes.fromhex(known["store"])
            if len(store) == STORE_BYTES:
                return store
    except (OSError, ValueError, KeyError, TypeError) as error:
        log.error("the store's identity is lost and drawn again: %s", in_words(error))
    store = secrets.token_bytes(STORE_BYTES)
    try:
        write_twice(path, {"store": store.hex()}, write)
    except OSError as error:
        log.error("the store's identity cannot be kept: %s", in_words(error))
    return store
