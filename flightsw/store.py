"""The crash-safe frame store: a frame is there whole or not at all, its number is never used twice."""

import contextlib
import hashlib
import json
import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from flightsw.errors import StoreError
from flightsw.icd.frame import Frame, encode_frame


@dataclass(frozen=True)
class StoredFrame:
    frame_id: int
    bracket_id: int
    bracket_index: int
    sha256: str
    size_bytes: int


class FrameStore:
    """A folder of frame containers, their index, and the outbox: what the ground has not confirmed yet.

    frames/00000012.obf holds the container, index.jsonl a line for each stored frame, outbox/00000012 an empty file
    for each frame still to be delivered. After a power cut the store opens again: an unfinished line is cut off, and
    a container without its index line is removed, so that its exposure is taken again.

    Raises:
        StoreError: the disk refuses, or the index is damaged other than at its end.
    """

    def __init__(self, folder: Path):
        self.folder = folder
        self._frames, self._outbox, self._index = folder / "frames", folder / "outbox", folder / "index.jsonl"
        self._stored: dict[int, StoredFrame] = {}
        with _disk_errors("open"):
            self._frames.mkdir(parents=True, exist_ok=True)
            self._outbox.mkdir(exist_ok=True)
            for part in self._frames.glob("*.part"):
                part.unlink()
            self._read_index()
            self._drop_unindexed()

    @property
    def next_frame_id(self) -> int:
        return max(self._stored, default=-1) + 1

    @property
    def frames(self) -> list[StoredFrame]:
        return [self._stored[frame_id] for frame_id in sorted(self._stored)]

    def holds(self, bracket_id: int, bracket_index: int) -> bool:
        """Tell whether this exposure of the pass is stored already."""
        return any((f.bracket_id, f.bracket_index) == (bracket_id, bracket_index) for f in self._stored.values())

    def put(self, frame: Frame, *, near: int = 0, roi_mask: np.ndarray | None = None) -> StoredFrame:
        """Store a frame and put it into the outbox; when this returns, a power cut cannot lose it.

        Raises:
            StoreError: the disk refuses, or the frame's number is taken.
        """
        if frame.frame_id in self._stored:
            raise StoreError(f"frame {frame.frame_id} is stored already; the next free number is {self.next_frame_id}")
        container = encode_frame(frame, near=near, roi_mask=roi_mask)
        stored = StoredFrame(
            frame.frame_id,
            frame.bracket_id,
            frame.bracket_index,
            hashlib.sha256(container).hexdigest(),
            len(container),
        )
        with _disk_errors(f"store frame {frame.frame_id}"):
            (self._outbox / f"{frame.frame_id:08d}").touch()
            write_whole(self.path(frame.frame_id), container)
            with open(self._index, "ab") as index:
                index.write(json.dumps(vars(stored)).encode() + b"\n")
                index.flush()
                os.fsync(index.fileno())
        self._stored[frame.frame_id] = stored
        return stored

    def path(self, frame_id: int) -> Path:
        return self._frames / f"{frame_id:08d}.obf"

    def outbox(self) -> list[int]:
        """Return the numbers of the frames still to be delivered, oldest first."""
        waiting = (int(p.name) for p in self._outbox.iterdir() if p.name.isdigit())
        return sorted(frame_id for frame_id in waiting if frame_id in self._stored)

    def mark_delivered(self, frame_id: int) -> None:
        """Take a frame out of the outbox; the frame itself stays."""
        with _disk_errors(f"mark frame {frame_id}"):
            (self._outbox / f"{frame_id:08d}").unlink(missing_ok=True)
            sync_folder(self._outbox)

    def _read_index(self) -> None:
        if not self._index.exists():
            return
        lines = self._index.read_bytes().split(b"\n")
        whole = 0
        for number, line in enumerate(lines[:-1]):  # what follows the last newline was cut off in writing
            try:
                stored = StoredFrame(**json.loads(line))
            except (ValueError, TypeError) as error:
                raise StoreError(f"{self._index} line {number + 1} is damaged: {error}") from error
            self._stored[stored.frame_id] = stored
            whole += len(line) + 1
        if lines[-1]:
            os.truncate(self._index, whole)

    def _drop_unindexed(self) -> None:
        """Remove containers whose index line never reached the disk: that exposure is taken again."""
        for path in self._frames.glob("*.obf"):
            if int(path.stem) not in self._stored:
                path.unlink()


def write_whole(path: Path, content: bytes) -> None:
    """Write a file whole or not at all, surviving a power cut: temporary name, sync, rename, sync the folder."""
    part = path.with_name(path.name + ".part")
    with open(part, "wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
    os.replace(part, path)
    sync_folder(path.parent)


def sync_folder(folder: Path) -> None:
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


@contextlib.contextmanager
def _disk_errors(action: str):
    try:
        yield
    except OSError as error:
        raise StoreError(f"cannot {action}: {error}") from error
