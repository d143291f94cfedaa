"""The crash-safe frame store: a frame is stored whole or not at all, and its number is never used twice."""

import contextlib
import errno
import fcntl
import hashlib
import json
import logging
import os
from collections.abc import Iterable, Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Literal

import numpy as np

from flightsw.errors import StoreError, StoreFull
from flightsw.icd.frame import Frame, encode_frame
from flightsw.icd.mission import Mission
from flightsw.icd.packet import PacketError
from flightsw.store_index import StoredFrame, index_entry, parse_index_line
from flightsw.transfer_numbers import TransferNumbers, store_identity
from obbgs_base.files import append_line, sync_folder, write_whole

log = logging.getLogger(__name__)
PUT_BACK = b"again\n"  # in the outbox: the frame was delivered once and put back by command
DISK_FULL = (errno.ENOSPC, errno.EDQUOT)
RESERVE = "reserve"  # the file that is given up for transfer numbers and settings
RESERVE_BYTES = 64 * 1024  # so that a full disk cannot stop the downlink that empties it, nor commands


class FrameStore:
    """A folder of frame containers, their index, and the outbox: what the ground has not confirmed yet.

    frames/00000012.obf holds the container, index.jsonl a line for each stored frame and one for each that was deleted
    (`{"frame_id": 12, "dropped": REASON}`), outbox/00000012 an empty file for each frame still to be delivered. After a
    power cut the store opens again: an unfinished line is cut off, a whole container without its line gets one, a torn
    one goes to quarantine/. One process may capture, another send.

    Args:
        quota_bytes: what the containers may take in all; None: what the disk holds.
        when_full: what is deleted for a new frame after all confirmed frames: nothing, or the oldest waiting ones.

    Raises:
        StoreError: the disk refuses, or the index is damaged other than at its end.
    """

    def __init__(
        self,
        folder: Path,
        quota_bytes: int | None = None,
        when_full: Literal["refuse", "drop-oldest"] = "refuse",
    ):
        self.folder, self.quota_bytes, self.when_full = folder, quota_bytes, when_full
        self.refused = 0  # frames of this run that found no room
        self.times_put_back = 0  # frames into the outbox, by command
        self._numbers, self._identity = TransferNumbers(folder, self._write_small), b""
        self._frames, self._outbox, self._index = folder / "frames", folder / "outbox", folder / "index.jsonl"
        self._forget_index()
        with _disk_errors("open the store"):
            self._frames.mkdir(parents=True, exist_ok=True)
            self._outbox.mkdir(exist_ok=True)
            with self.locked():
                for part in self._frames.glob("*.part"):
                    part.unlink()
                self._read_index()
                if self._index_read_bytes < self._index_bytes:  # the power went in the middle of a line
                    os.truncate(self._index, self._index_read_bytes)
                self._index_unindexed()
                try:
                    keep_reserve(self.folder / RESERVE, RESERVE_BYTES)
                except OSError as error:
                    log.warning("no reserve for transfer numbers and settings: %s", error)

    @property
    def next_frame_id(self) -> int:
        return self._last_id + 1

    @property
    def frames(self) -> list[StoredFrame]:
        return [self._stored[frame_id] for frame_id in sorted(self._stored)]

    def holds(self, bracket_id: int, bracket_index: int) -> bool:
        """Tell whether this exposure of the pass was stored, even if it has been deleted since."""
        return (bracket_id, bracket_index) in self._exposures

    def put(self, frame: Frame, *, max_error_dn: int = 0, roi_mask: np.ndarray | None = None) -> StoredFrame:
        """Store a frame and put it into the outbox; when this returns, a power cut cannot lose it.

        Raises:
            StoreFull: no room, and the policy lets nothing be deleted for it; the frame is counted as refused.
            StoreError: the disk refuses, or the frame's number is taken.
        """
        container = encode_frame(frame, max_error_dn=max_error_dn, roi_mask=roi_mask)
        with _disk_errors(f"store frame {frame.frame_id}"), self.locked():
            self._read_index()
            if frame.frame_id <= self._last_id:
                raise StoreError(
                    f"frame {frame.frame_id} is stored already or its number was used; "
                    f"the next free number is {self.next_frame_id}"
                )
            used_limit = float("inf") if self.quota_bytes is None else self.quota_bytes - len(container)
            if used_limit < 0:
                self._refuse(frame.frame_id, f"its {len(container)} bytes exceed the quota")
            while self.used_bytes > used_limit:
                self._make_room(frame.frame_id, f"the quota of {self.quota_bytes} bytes")
            while True:
                try:
                    return self._write(frame, container)
                except OSError as error:
                    if error.errno not in DISK_FULL:
                        raise
                    self._make_room(frame.frame_id, f"the disk ({os.strerror(error.errno or 0)})")

    def drop(self, frame_id: int, reason: str = "command") -> None:
        """Delete a frame and its place in the outbox; its number and its exposure are not used again.

        Raises:
            StoreError: the frame is not there, or the disk refuses.
        """
        with _disk_errors(f"delete frame {frame_id}"), self.locked():
            self._read_index()
            if frame_id not in self._stored:
                raise StoreError(f"there is no frame {frame_id} to delete")
            self._drop(frame_id, reason)
            with contextlib.suppress(OSError):  # not yet
                keep_reserve(self.folder / RESERVE, RESERVE_BYTES)

    def path(self, frame_id: int) -> Path:
        return self._frames / f"{frame_id:08d}.obf"

    def read(self, frame_id: int) -> bytes:
        """Return a frame's container.

        Raises:
            StoreError: it is not there, or not what was stored.
        """
        with _disk_errors(f"read frame {frame_id}"):
            container = self.path(frame_id).read_bytes()
        if frame_id not in self._stored:  # another process captures
            with _disk_errors("read the index"):
                self._read_index()
        stored = self._stored.get(frame_id)
        if stored is None or hashlib.sha256(container).hexdigest() != stored.sha256:
            raise StoreError(f"frame {frame_id} has changed on the disk; run flightsw fsck")
        return container

    def outbox(self) -> list[int]:
        """Return the numbers of the frames still to be delivered, oldest first."""
        with _disk_errors("read the outbox"):
            waiting = self._waiting()
            if any(frame_id not in self._stored for frame_id in waiting):  # another process captures
                self._read_index()
        return [frame_id for frame_id in waiting if frame_id in self._stored]

    @property
    def identity(self) -> bytes:
        """The random bytes by which the ground tells this store from any other."""
        if not self._identity:
            with _disk_errors("read the store's identity"), self.locked():
                self._identity = store_identity(self.folder, self._write_small)
        return self._identity

    def next_transaction(self, in_flight: Iterable[int] = ()) -> int:
        """Return a file transfer's number, never given before, not even before a power cut.

        Args:
            in_flight: frames that may arrive, or have arrived, without a confirmation; none is dropped for room.
        """
        with _disk_errors("number a transfer"), self.locked():
            return self._numbers.give(in_flight)

    def in_flight(self) -> frozenset[int]:
        """Return the frames that `next_transaction` was told last."""
        with _disk_errors("read the last transfer's number"), self.locked():
            return self._numbers.in_flight

    def put_back(self, first_frame: int, last_frame: int) -> int:
        """Put the stored frames of these numbers into the outbox again and return how many were not in it."""
        with _disk_errors("put frames into the outbox"), self.locked():
            self._read_index()
            waiting = set(self._waiting())
            again = [n for n in self._stored if first_frame <= n <= last_frame and n not in waiting]
            for frame_id in again:
                (self._outbox / f"{frame_id:08d}").write_bytes(PUT_BACK)
            sync_folder(self._outbox)
        self.times_put_back += 1
        return len(again)

    def hold_pass(self, first_trigger_utc_ns: int) -> None:
        """Note which pass the frames are of; exposures are told apart by their number in the pass.

        Raises:
            StoreError: the store holds exposures of a pass that begins at another time, or the disk refuses.
        """
        path, begins = self.folder / "pass.json", _iso(first_trigger_utc_ns)
        with _disk_errors("note the pass"), self.locked():
            try:
                known = json.loads(path.read_bytes())["first_trigger_utc"] if path.exists() else None
            except (ValueError, TypeError, KeyError) as error:
                log.warning("%s is damaged and written again: %r", path, error)
                known = None
            if known is not None and known != begins and self._exposures:
                raise StoreError(
                    f"{self.folder} holds exposures of the pass that begins at {known}, and this one begins at "
                    f"{begins}: name another --store, or go on with that pass by --start {known}"
                )
            if known != begins:
                content = json.dumps({"first_trigger_utc": begins}).encode()
                write_with_reserve(path, content, self.folder / RESERVE)

    def mark_delivered(self, frame_id: int) -> None:
        """Take a frame out of the outbox; the frame itself stays until its room is needed."""
        with _disk_errors(f"mark frame {frame_id}"):
            (self._outbox / f"{frame_id:08d}").unlink(missing_ok=True)
            sync_folder(self._outbox)

    def _write_small(self, path: Path, content: bytes) -> None:
        write_with_reserve(path, content, self.folder / RESERVE)

    @contextlib.contextmanager
    def locked(self) -> Iterator[None]:
        """Keep other processes from writing to the store at the same time."""
        with lock_store(self.folder):
            yield

    def _waiting(self) -> list[int]:
        return sorted(int(path.name) for path in self._outbox.iterdir() if path.name.isdigit())

    def _write(self, frame: Frame, container: bytes) -> StoredFrame:
        marker, path = self._outbox / f"{frame.frame_id:08d}", self.path(frame.frame_id)
        try:
            marker.touch()
            sync_folder(self._outbox)
            write_whole(path, container)
            return self._add_line(
                StoredFrame(
                    frame.frame_id,
                    frame.bracket_id,
                    frame.bracket_index,
                    hashlib.sha256(container).hexdigest(),
                    len(container),
                )
            )
        except OSError:  # leave nothing half done: what stays would take the room that is missing
            path.unlink(missing_ok=True)
            marker.unlink(missing_ok=True)
            raise

    def _make_room(self, for_frame: int, what_is_full: str) -> None:
        """Delete one frame: the oldest confirmed one, or if there is none what the policy says."""
        waiting = set(self._waiting())
        confirmed = sorted(frame_id for frame_id in self._stored if frame_id not in waiting)
        if confirmed:
            log.info("frame %d deleted, the ground has it: %s is full", confirmed[0], what_is_full)
            self._drop(confirmed[0], "delivered")
        elif self.when_full == "drop-oldest" and (free := set(self._stored) - self._numbers.in_flight):
            oldest = min(free)  # frames in flight may be on the ground already
            if (self._outbox / f"{oldest:08d}").stat().st_size:  # delivered once; in the outbox by command
                log.info("frame %d deleted, the ground had it: %s is full", oldest, what_is_full)
                self._drop(oldest, "delivered")
                return
            log.warning(
                "frame %d deleted undelivered for frame %d: %s is full", oldest, for_frame, what_is_full
            )
            self._drop(oldest, "oldest")
        else:
            self._refuse(for_frame, f"{what_is_full} is full")

    def _refuse(self, frame_id: int, reason: str) -> None:
        self.refused += 1
        raise StoreFull(f"frame {frame_id} refused: {reason}, policy {self.when_full}")

    def _drop(self, frame_id: int, reason: str) -> None:
        (self._outbox / f"{frame_id:08d}").unlink(missing_ok=True)
        self.path(frame_id).unlink(missing_ok=True)
        # a line that is lost here is written at the next start
        self._append({"frame_id": frame_id, "dropped": reason})
        self._read_index()

    @property
    def _index_bytes(self) -> int:
        return self._index.stat().st_size if self._index.exists() else 0

    def _forget_index(self) -> None:
        self.used_bytes = 0
        self.dropped_undelivered = 0  # by drop-oldest, since the store was made
        self._stored: dict[int, StoredFrame] = {}
        self._exposures: set[tuple[int, int]] = set()
        self._last_id = -1
        self._index_read_bytes = self._index_inode = 0

    def _read_index(self) -> None:
        """Read what the index has gained, whole lines only."""
        if not self._index.exists():
            return
        with open(self._index, "rb") as index:
            inode = os.fstat(index.fileno()).st_ino
            if inode != self._index_inode:  # the first time, or fsck has written it again
                self._forget_index()
                self._index_inode = inode
            index.seek(self._index_read_bytes)
            *lines, _unfinished = index.read().split(b"\n")
        for line in lines:
            try:
                entry = parse_index_line(line)
            except ValueError as error:
                at = self._index_read_bytes
                raise StoreError(
                    f"{self._index} is damaged at byte {at}: {error}; run flightsw fsck"
                ) from error
            if isinstance(entry, StoredFrame):
                self._stored[entry.frame_id] = entry
                self._exposures.add((entry.bracket_id, entry.bracket_index))
                self.used_bytes += entry.size_bytes
                self._last_id = max(self._last_id, entry.frame_id)
            else:
                frame_id, reason = entry
                dropped = self._stored.pop(frame_id, None)
                self.used_bytes -= dropped.size_bytes if dropped else 0
                self.dropped_undelivered += reason == "oldest"
                self._last_id = max(self._last_id, frame_id)
            self._index_read_bytes += len(line) + 1

    def _index_unindexed(self) -> None:
        """Give a line to each container whose line never reached the disk, and to each line whose container is gone."""
        for path in sorted(self._frames.glob("*.obf")):
            if not path.stem.isdigit() or int(path.stem) in self._stored:
                continue
            container = path.read_bytes()
            try:
                self._add_line(index_entry(path, container))
            except PacketError as error:
                log.warning("%s goes to quarantine: %s", path, error)
                quarantine(self.folder, path)
        for frame_id in list(self._stored):
            if not self.path(frame_id).exists():
                log.warning("frame %d is gone from the disk", frame_id)
                self._drop(frame_id, "lost")

    def _add_line(self, stored: StoredFrame) -> StoredFrame:
        self._append(vars(stored))
        self._read_index()
        return stored

    def _append(self, entry: dict) -> None:
        append_line(self._index, json.dumps(entry).encode())


def keep_reserve(reserve: Path, size_bytes: int) -> None:
    """Make the file that `write_with_reserve` may delete, unless it is there.

    Raises:
        OSError: the disk refuses.
    """
    if not reserve.exists():
        write_whole(reserve, bytes(size_bytes))


def write_with_reserve(path: Path, data: bytes, reserve: Path) -> None:
    """Write a small file whole or not at all; where the disk is full, the file `reserve` is deleted for it.

    Raises:
        OSError: the disk refuses.
    """
    try:
        write_whole(path, data)
    except OSError as error:
        if error.errno not in DISK_FULL:
            raise
        reserve.unlink(missing_ok=True)
        write_whole(path, data)


def open_store(folder: Path, mission: Mission) -> FrameStore:
    """Return the store with the mission's quota and policy."""
    return FrameStore(folder, mission.store.quota_bytes, mission.store.when_full)


def quarantine(store: Path, path: Path) -> Path:
    """Move a damaged file to the store's quarantine folder, where nothing is ever overwritten, and return its place."""
    folder = store / "quarantine"
    folder.mkdir(exist_ok=True)
    number = sum(1 for _ in folder.iterdir())
    moved = folder / f"{number:04d}-{path.name}"
    os.replace(path, moved)
    sync_folder(folder)
    return moved


@contextlib.contextmanager
def lock_store(folder: Path) -> Iterator[None]:
    """Hold the store's lock; waits for another process that holds it."""
    with open(folder / "lock", "wb") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield


def _iso(utc_ns: int) -> str:
    return (datetime.fromtimestamp(0, UTC) + timedelta(microseconds=utc_ns // 1000)).isoformat()


@contextlib.contextmanager
def _disk_errors(action: str) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise StoreError(f"cannot {action}: {error}") from error
