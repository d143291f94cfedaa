"""The crash-safe frame store: a frame is there whole or not at all, its number is never used twice."""

import contextlib
import fcntl
import hashlib
import json
import logging
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from flightsw.errors import StoreError
from flightsw.icd.frame import Frame, decode_frame, encode_frame
from flightsw.icd.packet import PacketError

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class StoredFrame:
    """One line of the index."""

    frame_id: int
    bracket_id: int
    bracket_index: int
    sha256: str
    size_bytes: int


class FrameStore:
    """A folder of frame containers, their index, and the outbox: what the ground has not confirmed yet.

    frames/00000012.obf holds the container, index.jsonl a line for each stored frame, outbox/00000012 an
    empty file for each frame still to be delivered. After a power cut the store opens again: an unfinished
    line is cut off, a whole container without its line gets one. One process may capture, another send.

    Raises:
        StoreError: the disk refuses, or the index is damaged other than at its end.
    """

    def __init__(self, folder: Path):
        self.folder = folder
        self._frames, self._outbox, self._index = folder / "frames", folder / "outbox", folder / "index.jsonl"
        self._stored: dict[int, StoredFrame] = {}
        self._index_read_bytes = 0
        with _disk_errors("open the store"):
            self._frames.mkdir(parents=True, exist_ok=True)
            self._outbox.mkdir(exist_ok=True)
            with self._locked():
                for part in self._frames.glob("*.part"):
                    part.unlink()
                self._read_index()
                if self._index_read_bytes < self._index_bytes:  # the power went in the middle of a line
                    os.truncate(self._index, self._index_read_bytes)
                self._index_unindexed()

    @property
    def next_frame_id(self) -> int:
        return max(self._stored, default=-1) + 1

    @property
    def frames(self) -> list[StoredFrame]:
        return [self._stored[frame_id] for frame_id in sorted(self._stored)]

    def holds(self, bracket_id: int, bracket_index: int) -> bool:
        """Tell whether this exposure of the pass is stored already."""
        return any(
            (f.bracket_id, f.bracket_index) == (bracket_id, bracket_index) for f in self._stored.values()
        )

    def put(self, frame: Frame, *, near: int = 0, roi_mask: np.ndarray | None = None) -> StoredFrame:
        """Store a frame and put it into the outbox; when this returns, a power cut cannot lose it.

        Raises:
            StoreError: the disk refuses, or the frame's number is taken.
        """
        if frame.frame_id in self._stored:
            raise StoreError(
                f"frame {frame.frame_id} is stored already; the next free number is {self.next_frame_id}"
            )
        container = encode_frame(frame, near=near, roi_mask=roi_mask)
        with _disk_errors(f"store frame {frame.frame_id}"), self._locked():
            (self._outbox / f"{frame.frame_id:08d}").touch()
            sync_folder(self._outbox)
            write_whole(self.path(frame.frame_id), container)
            return self._add_to_index(frame, container)

    def path(self, frame_id: int) -> Path:
        return self._frames / f"{frame_id:08d}.obf"

    def read(self, frame_id: int) -> bytes:
        """Return a frame's container.

        Raises:
            StoreError: it is not there, or not what was stored.
        """
        with _disk_errors(f"read frame {frame_id}"):
            container = self.path(frame_id).read_bytes()
        if hashlib.sha256(container).hexdigest() != self._stored[frame_id].sha256:
            raise StoreError(f"frame {frame_id} has changed on the disk")
        return container

    def outbox(self) -> list[int]:
        """Return the numbers of the frames still to be delivered, oldest first."""
        with _disk_errors("read the outbox"):
            waiting = sorted(int(path.name) for path in self._outbox.iterdir() if path.name.isdigit())
            if any(frame_id not in self._stored for frame_id in waiting):  # another process captures
                self._read_index()
        return [frame_id for frame_id in waiting if frame_id in self._stored]

    def next_transaction(self) -> int:
        """Return a file transfer's number, never given before, not even before a power cut."""
        path = self.folder / "transaction"
        with _disk_errors("number a transfer"), self._locked():
            text = path.read_text() if path.exists() else "0"
            if not text.strip().isdigit():
                raise StoreError(f"{path} should hold a number, it holds {text[:20]!r}")
            number = (int(text) + 1) % (1 << 32)
            write_whole(path, f"{number}\n".encode())
        return number

    def mark_delivered(self, frame_id: int) -> None:
        """Take a frame out of the outbox; the frame itself stays."""
        with _disk_errors(f"mark frame {frame_id}"):
            (self._outbox / f"{frame_id:08d}").unlink(missing_ok=True)
            sync_folder(self._outbox)

    @property
    def _index_bytes(self) -> int:
        return self._index.stat().st_size if self._index.exists() else 0

    def _read_index(self) -> None:
        """Read what the index has gained, whole lines only."""
        if not self._index.exists():
            return
        with open(self._index, "rb") as index:
            index.seek(self._index_read_bytes)
            *lines, _unfinished = index.read().split(b"\n")
        for line in lines:
            try:
                stored = StoredFrame(**json.loads(line))
            except (ValueError, TypeError) as error:
                at = self._index_read_bytes
                raise StoreError(f"{self._index} is damaged at byte {at}: {error}") from error
            self._stored[stored.frame_id] = stored
            self._index_read_bytes += len(line) + 1

    def _index_unindexed(self) -> None:
        """Give a line to each container whose line never reached the disk; drop what is no container."""
        for path in sorted(self._frames.glob("*.obf")):
            if not path.stem.isdigit() or int(path.stem) in self._stored:
                continue
            container = path.read_bytes()
            try:
                frame = decode_frame(container)
            except PacketError as error:
                log.warning("%s dropped: %s", path, error)
                path.unlink()
            else:
                self._add_to_index(frame, container)

    def _add_to_index(self, frame: Frame, container: bytes) -> StoredFrame:
        stored = StoredFrame(
            frame.frame_id,
            frame.bracket_id,
            frame.bracket_index,
            hashlib.sha256(container).hexdigest(),
            len(container),
        )
        before_bytes = self._index_bytes
        try:
            with open(self._index, "ab") as index:
                index.write(json.dumps(vars(stored)).encode() + b"\n")
                index.flush()
                os.fsync(index.fileno())
        except OSError:
            if self._index.exists():  # a full disk: half a line would damage the index for good
                os.truncate(self._index, before_bytes)
            raise
        self._read_index()
        return stored

    @contextlib.contextmanager
    def _locked(self) -> Iterator[None]:
        """Keep other processes from writing to the store at the same time."""
        with open(self.folder / "lock", "wb") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            yield


def write_whole(path: Path, content: bytes) -> None:
    """Write a file whole or not at all, power cuts included: temporary name, sync, rename, sync folder."""
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
def _disk_errors(action: str) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise StoreError(f"cannot {action}: {error}") from error
