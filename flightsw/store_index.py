"""The lines of a frame store's index: one for each stored frame, and one for each that was deleted."""

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path

from flightsw.icd.frame import decode_frame
from flightsw.icd.packet import PacketError


@dataclass(frozen=True)
class StoredFrame:
    """One line of the index."""

    frame_id: int
    bracket_id: int
    bracket_index: int
    sha256: str
    size_bytes: int


def parse_index_line(line: bytes) -> StoredFrame | tuple[int, str]:
    """Return a line of the index: a stored frame, or the number of a deleted one and the reason.

    Raises:
        ValueError: it is neither.
    """
    entry = json.loads(line)
    try:
        if set(entry) == {"frame_id", "dropped"}:
            return int(entry["frame_id"]), str(entry["dropped"])
        stored = StoredFrame(**entry)
    except TypeError as error:
        raise ValueError(str(error)) from error
    numbers = (stored.frame_id, stored.bracket_id, stored.bracket_index, stored.size_bytes)
    if not all(isinstance(n, int) and n >= 0 for n in numbers) or not isinstance(stored.sha256, str):
        raise ValueError(f"values out of range: {entry}")
    return stored


def index_entry(path: Path, container: bytes) -> StoredFrame:
    """Return the index line of a container, after decoding all of it.

    Raises:
        PacketError: it is no whole container, or not the one that its name says.
    """
    frame = decode_frame(container)
    if f"{frame.frame_id:08d}" != path.stem:
        raise PacketError(f"the file is called {path.name} but holds frame {frame.frame_id}")
    sha256 = hashlib.sha256(container).hexdigest()
    return StoredFrame(frame.frame_id, frame.bracket_id, frame.bracket_index, sha256, len(container))
