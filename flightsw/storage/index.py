"""The lines of a frame store's index: one for each stored frame, and one for each that was deleted."""

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from flightsw.icd.frame import decode_frame, numbers_of
from flightsw.icd.packet import PacketError
from obbgs_base.checked import has_checksum, parse_checked_line

DELETED_FOR_GOOD = ("command", "oldest", "delivered")  # other reasons end when the container is good again


@dataclass(frozen=True)
class StoredFrame:
    """The line of a frame that was stored."""

    frame_id: int
    bracket_id: int
    bracket_index: int
    sha256: str
    size_bytes: int


@dataclass(frozen=True)
class DroppedFrame:
    """The line of a frame that is not there any more: its number and its exposure are not used again.

    dropped: the reason: by command, oldest (to make room, undelivered), delivered (to make room), lost (the container
        is gone), damaged (it is in quarantine, or cannot be read).
    bracket_id, bracket_index: None in lines of earlier versions, and where the container was damaged.
    """

    frame_id: int
    dropped: str
    bracket_id: int | None = None
    bracket_index: int | None = None


Entry = StoredFrame | DroppedFrame


class IndexState:
    """What an index says in all: each frame that was ever stored, and those that are not there any more."""

    def __init__(self):
        self.stored: dict[int, StoredFrame] = {}
        self.dropped: dict[int, DroppedFrame] = {}

    @classmethod
    def of(cls, listed: list[Entry], deleted: list[Entry]) -> "IndexState":
        """Return what the lines of an index say together with the second copy of its lines of deleted frames."""
        state = cls()
        for entry in listed:
            state.add(entry)
        for entry in deleted:
            is_final = isinstance(entry, DroppedFrame) and entry.dropped in DELETED_FOR_GOOD
            is_known = entry.frame_id in state.dropped or entry.frame_id in state.stored
            if not is_known or (is_final and entry.frame_id not in state.dropped):
                state.add(entry)
        return state

    def add(self, entry: Entry) -> None:
        """Take in a line that comes after the others."""
        if isinstance(entry, DroppedFrame):
            self.dropped[entry.frame_id] = entry
        else:
            self.stored[entry.frame_id] = entry
            self.dropped.pop(entry.frame_id, None)

    def missing_from(self, deleted: list[Entry]) -> list[DroppedFrame]:
        """Return the lines of deleted frames that their second copy lacks."""
        known = {entry.frame_id for entry in deleted}
        return [entry for frame_id, entry in sorted(self.dropped.items()) if frame_id not in known]

    def added_to(self, listed: list[Entry]) -> list[Entry]:
        """Return the lines that are to follow `listed` so that an index says this, in the order of the frames."""
        before = IndexState.of(listed, [])
        added: list[Entry] = []
        for frame_id in sorted(self.stored.keys() | self.dropped.keys()):
            stored, dropped = self.stored.get(frame_id), self.dropped.get(frame_id)
            revived = dropped is None and frame_id in before.dropped
            if stored is not None and (stored != before.stored.get(frame_id) or revived):
                added.append(stored)
            if dropped is not None and (dropped != before.dropped.get(frame_id) or stored in added):
                added.append(dropped)
        return added


def parse_entry(line: bytes) -> Entry:
    """Return what a line says.

    Raises:
        ValueError: its checksum does not fit, or it is no line of an index.
    """
    return _entry(parse_checked_line(line))


def entries_of(content: bytes) -> tuple[list[Entry], list[str]]:
    """Return what the whole lines of an index say, in their order, and what is wrong with the others.

    An index of which no line has a checksum was written by an earlier version.
    """
    *lines, _unfinished = content.split(b"\n")
    parse = parse_entry if any(map(has_checksum, lines)) else _parse_without_checksum
    entries, problems = [], []
    for number, line in enumerate(lines, start=1):
        try:
            entries.append(parse(line))
        except ValueError as error:
            problems.append(f"line {number}: {error}")
    if lines and parse is _parse_without_checksum and not problems:
        problems.append("it has no checksums")
    return entries, problems


def index_entry(path: Path, container: bytes, decode: bool = False) -> StoredFrame:
    """Return the index line of a container after checking every byte of it, and if asked for after decoding it.

    Raises:
        PacketError: it is no whole container, or not the one that its name says.
    """
    frame_id, bracket_id, bracket_index = numbers_of(container)
    if f"{frame_id:08d}" != path.stem:
        raise PacketError(f"the file is called {path.name} but holds frame {frame_id}")
    if decode:
        decode_frame(container)
    return StoredFrame(
        frame_id, bracket_id, bracket_index, hashlib.sha256(container).hexdigest(), len(container)
    )


def _parse_without_checksum(line: bytes) -> Entry:
    return _entry(json.loads(line))


def _entry(tree: Any) -> Entry:
    if not isinstance(tree, dict):
        raise ValueError(f"expected an object, got {tree!r}")
    try:
        entry = DroppedFrame(**tree) if "dropped" in tree else StoredFrame(**tree)
    except TypeError as error:
        raise ValueError(str(error)) from error
    if isinstance(entry, StoredFrame):
        numbers = (entry.frame_id, entry.bracket_id, entry.bracket_index, entry.size_bytes)
        text = entry.sha256
    else:
        exposure = (entry.bracket_id, entry.bracket_index)
        numbers, text = (entry.frame_id, *(n for n in exposure if n is not None)), entry.dropped
    if not all(type(n) is int and n >= 0 for n in numbers) or not isinstance(text, str):
        raise ValueError(f"values out of range: {tree}")
    return entry
