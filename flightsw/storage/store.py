"""The crash-safe frame store: a frame is stored whole or not at all, and its number is never used twice."""

import contextlib
import errno
import fcntl
import hashlib
import itertools
import logging
import os
import secrets
import shutil
from collections.abc import Iterable, Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Literal

import numpy as np

from flightsw.errors import StoreError, StoreFull
from flightsw.icd.frame import Frame, encode_frame
from flightsw.icd.mission import Mission
from flightsw.icd.packet import PacketError
from flightsw.icd.transfer import STORE_BYTES
from flightsw.storage.index import (
    DELETED_FOR_GOOD,
    DroppedFrame,
    Entry,
    IndexState,
    StoredFrame,
    entries_of,
    index_entry,
    parse_entry,
)
from flightsw.storage.transfer_numbers import TransferNumbers, random_number, store_identity
from obbgs_base.checked import checked_line, read_twice, write_twice
from obbgs_base.errors import counted, in_words
from obbgs_base.files import append_line, sync_folder, write_whole

log = logging.getLogger(__name__)
PUT_BACK = b"again\n"  # in the outbox: the frame was delivered once and put back by command
DISK_FULL = (errno.ENOSPC, errno.EDQUOT)
RESERVE = "reserve"  # the file that is given up for transfer numbers and settings
RESERVE_BYTES = 64 * 1024  # so that a full disk cannot stop the downlink that empties it, nor commands


class FrameStore:
    """A folder of frame containers, their index, and the outbox: what the ground has not confirmed yet.

    frames/00000012.obf holds the container, index.jsonl a line for each stored frame and one for each that was deleted,
    outbox/00000012 an empty file for each frame still to be delivered. Each line has a checksum. The lines of deleted
    frames stand in deleted.jsonl as well; all else of the index is made again from the containers, which have checksums
    of their own, where a line is damaged or missing: the damaged index then goes to quarantine/. After a power cut the
    store opens again; a torn container goes to quarantine/. One process may capture, another send.

    On a disk that cannot be written to, what can be read is sent all the same: see `next_transaction` and
    `mark_delivered`.

    Args:
        quota_bytes: what the containers may take in all; None: what the disk holds.
        when_full: what is deleted for a new frame after all confirmed frames: nothing, or the oldest waiting ones.
        open_now: whether to call `open` at once; before it, the store is as if empty.

    Raises:
        StoreError: the store cannot be read.
    """

    def __init__(
        self,
        folder: Path,
        quota_bytes: int | None = None,
        when_full: Literal["refuse", "drop-oldest"] = "refuse",
        open_now: bool = True,
    ):
        self.folder, self.quota_bytes, self.when_full = folder, quota_bytes, when_full
        self.refused = 0  # frames of this run that found no room
        self.times_put_back = 0  # frames into the outbox, by command
        self._numbers, self._identity = TransferNumbers(folder, self._write_small), b""
        self._frames, self._outbox, self._index = folder / "frames", folder / "outbox", folder / "index.jsonl"
        self._deleted = folder / "deleted.jsonl"  # the second copy of the lines of deleted frames
        self.is_open = self._is_locked = self._refusal_told = False
        self.waiting: dict[int, None] = {}  # the outbox as of the last look, in the order of the numbers
        self._listed = False  # whether `waiting` follows from the outbox by what the index has gained
        self._arrived: list[int] = []  # stored since the last look
        self._confirmed: set[int] = set()  # whose markers the disk would not let go
        self._forget_index()
        if open_now:
            self.open()

    def open(self) -> None:
        """Make or open the store; what a power cut or a flipped bit has left is put in order.

        Raises:
            StoreError: the disk refuses to be read.
        """
        with _disk_errors("open the store"):
            self._frames.mkdir(parents=True, exist_ok=True)
            self._outbox.mkdir(exist_ok=True)
            with self.locked():
                with self._told("delete what unfinished writes have left"):
                    for part in self._frames.glob("*.part"):
                        part.unlink()
                self._load()
                with self._told("keep a reserve for transfer numbers and settings"):
                    keep_reserve(self.folder / RESERVE, RESERVE_BYTES)
        self.is_open = True

    @property
    def next_frame_id(self) -> int:
        return self._last_id + 1

    @property
    def frame_count(self) -> int:
        return len(self._stored)

    @property
    def frames(self) -> list[StoredFrame]:
        """The frames on the disk, in the order of their numbers.

        Raises:
            StoreError: the store is not open.
        """
        if not self.is_open:
            raise StoreError("the frame store is not open; the events say why")
        return [self._stored[frame_id] for frame_id in sorted(self._stored)]

    def holds(self, bracket_id: int, bracket_index: int) -> bool:
        """Tell whether this exposure of the pass was stored, even if it has been deleted since."""
        return (bracket_id, bracket_index) in self._exposures

    def begun_brackets(self) -> dict[int, int]:
        """Return the brackets of which exposures were stored, deleted ones too, and the least that each consists of."""
        least: dict[int, int] = {}
        for bracket_id, bracket_index in self._exposures:
            least[bracket_id] = max(least.get(bracket_id, 0), bracket_index + 1)
        return least

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
                self._make_room(frame.frame_id, f"the quota of {self.quota_bytes} bytes is full")
            while True:
                try:
                    if self._leaves_reserve(len(container)):
                        return self._write(frame, container)
                    self._make_room(frame.frame_id, "the disk is full but for what is kept for commands")
                except OSError as error:
                    if error.errno not in DISK_FULL:
                        raise
                    self._make_room(frame.frame_id, f"the disk is full ({os.strerror(error.errno or 0)})")

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
            waiting = self._markers()
            if any(frame_id not in self._stored for frame_id in waiting):  # another process captures
                self._read_index()
        return [frame_id for frame_id in waiting if frame_id in self._stored]

    def look(self) -> list[int]:
        """Bring `waiting` up to date and return the numbers that are new in it, oldest first.

        Only the first look lists the outbox; later ones read what the index has gained, however many frames wait.

        Raises:
            StoreError: the disk refuses.
        """
        with _disk_errors("read the outbox"):
            self._read_index()
            if self._listed:
                arrived = [frame_id for frame_id in self._arrived if frame_id in self._stored]
            else:
                arrived = [frame_id for frame_id in self._markers() if frame_id in self._stored]
                known, self.waiting = self.waiting, dict.fromkeys(arrived)
                arrived = [frame_id for frame_id in arrived if frame_id not in known]
        self._listed, self._arrived = True, []
        self.waiting.update(dict.fromkeys(arrived))
        return arrived

    @property
    def identity(self) -> bytes:
        """The random bytes by which the ground tells this store from any other; before it is open they do not last."""
        if not self.is_open:
            return secrets.token_bytes(STORE_BYTES)
        if not self._identity:
            with _disk_errors("read the store's identity"), self.locked():
                self._identity = store_identity(self.folder, self._write_small)
        return self._identity

    def next_transaction(self, in_flight: Iterable[int] = ()) -> int:
        """Return a file transfer's number, never given before, not even before a power cut.

        Where the disk does not keep it, it is drawn at random.

        Args:
            in_flight: frames that may arrive, or have arrived, without a confirmation; none is dropped for room.
        """
        try:
            with self.locked():
                return self._numbers.give(in_flight)
        except OSError as error:
            self._tell_refusal("number a transfer", error)
            return random_number()

    def in_flight(self) -> frozenset[int]:
        """Return the frames that `next_transaction` was told last; all that wait where this cannot be read."""
        if not self.is_open:
            return frozenset()
        with _disk_errors("read the last transfer's number"), self.locked():
            in_flight = self._numbers.in_flight
            return frozenset(self._markers()) if in_flight is None else in_flight

    def put_back(self, first_frame: int, last_frame: int) -> int:
        """Put the stored frames of these numbers into the outbox again and return how many were not in it."""
        with _disk_errors("put frames into the outbox"), self.locked():
            self._read_index()
            waiting = set(self._markers())
            again = [n for n in self._stored if first_frame <= n <= last_frame and n not in waiting]
            for frame_id in again:
                (self._outbox / f"{frame_id:08d}").write_bytes(PUT_BACK)
            sync_folder(self._outbox)
        self._confirmed.difference_update(again)
        self._listed = False
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
                tree = read_twice(path, log.warning)
                known = None if tree is None else str(tree["first_trigger_utc"])
            except (ValueError, KeyError) as error:
                log.error("%s and its copy are damaged and written again: %r", path, error)
                known = None
            if known is not None and known != begins and self._exposures:
                raise StoreError(
                    f"{self.folder} holds exposures of the pass that begins at {known}, and this one begins at "
                    f"{begins}: name another --store, or go on with that pass by --start {known}"
                )
            if known != begins:
                write_twice(
                    path,
                    {"first_trigger_utc": begins},
                    lambda file, data: write_with_reserve(file, data, self.folder / RESERVE),
                )

    def mark_delivered(self, frame_id: int) -> None:
        """Take a frame out of the outbox; the frame itself stays until its room is needed.

        Where the disk refuses, it is known for this run only and sent again in the next one.
        """
        self.waiting.pop(frame_id, None)
        with self._told(f"take frame {frame_id} out of the outbox"):
            try:
                (self._outbox / f"{frame_id:08d}").unlink(missing_ok=True)
                sync_folder(self._outbox)
            except OSError:
                self._confirmed.add(frame_id)
                raise

    def _write_small(self, path: Path, content: bytes) -> None:
        write_with_reserve(path, content, self.folder / RESERVE)

    @contextlib.contextmanager
    def locked(self) -> Iterator[None]:
        """Keep other processes from writing to the store at the same time."""
        if self._is_locked:
            yield
            return
        with lock_store(self.folder):
            self._is_locked = True
            try:
                yield
            finally:
                self._is_locked = False

    @contextlib.contextmanager
    def capturing(self) -> Iterator[None]:
        """Keep other processes from taking frames into the store; one that is killed lets go of it.

        Raises:
            StoreError: another process takes frames into it, or the disk refuses to be read.
        """
        with _disk_errors("hold the store for its frames"):
            held = os.open(self._frames, os.O_RDONLY)
        try:
            try:
                fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise StoreError(
                    f"another process takes frames into {self.folder}: end it, which `fuser {self._frames}` names, "
                    "or give another --store"
                ) from None
            yield
        finally:
            os.close(held)

    @contextlib.contextmanager
    def _told(self, action: str) -> Iterator[None]:
        """Go on where the disk refuses to be written to; an event says so once."""
        try:
            yield
        except OSError as error:
            self._tell_refusal(action, error)

    def _tell_refusal(self, action: str, error: OSError) -> None:
        if not self._refusal_told:
            self._refusal_told = True
            log.error(
                "the store cannot be written to, what it holds is sent: cannot %s: %s",
                action,
                in_words(error),
            )

    def _markers(self) -> list[int]:
        names = (entry.name for entry in os.scandir(self._outbox))
        return sorted({int(name) for name in names if name.isdigit()} - self._confirmed)

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

    def _leaves_reserve(self, size_bytes: int) -> bool:
        """Return whether commands have room beside so much more: the reserve, made again if it fits, or half of it."""
        with contextlib.suppress(OSError):
            keep_reserve(self.folder / RESERVE, RESERVE_BYTES)
            return True
        return shutil.disk_usage(self.folder).free >= size_bytes + RESERVE_BYTES // 2

    def _make_room(self, for_frame: int, why: str) -> None:
        """Delete one frame: the oldest confirmed one, or if there is none what the policy says."""
        waiting = set(self._markers())
        confirmed = sorted(frame_id for frame_id in self._stored if frame_id not in waiting)
        if confirmed:
            log.info("frame %d deleted, the ground has it: %s", confirmed[0], why)
            self._drop(confirmed[0], "delivered")
        elif self.when_full == "drop-oldest" and (free := self._not_in_flight()):
            oldest = min(free)  # frames in flight may be on the ground already
            if (self._outbox / f"{oldest:08d}").stat().st_size:  # delivered once; in the outbox by command
                log.info("frame %d deleted, the ground had it: %s", oldest, why)
                self._drop(oldest, "delivered")
                return
            log.warning("frame %d deleted undelivered for frame %d: %s", oldest, for_frame, why)
            self._drop(oldest, "oldest")
        else:
            self._refuse(for_frame, why)

    def _not_in_flight(self) -> set[int]:
        """Return the stored frames that cannot have arrived yet; none where it cannot be read which are in flight."""
        in_flight = self._numbers.in_flight
        return set() if in_flight is None else set(self._stored) - in_flight

    def _refuse(self, frame_id: int, reason: str) -> None:
        self.refused += 1
        raise StoreFull(f"frame {frame_id} refused: {reason}, and store.when_full is {self.when_full}")

    def _drop(self, frame_id: int, reason: str) -> None:
        """Delete a frame; its line is on the disk first, so that the reason is never lost."""
        stored = self._stored[frame_id]
        entry = DroppedFrame(frame_id, reason, stored.bracket_id, stored.bracket_index)
        try:
            self._append_dropped(entry)
        except OSError as error:
            if error.errno not in DISK_FULL:
                raise
            self._unlink(frame_id)  # without any room the file makes it
            self._append_dropped(entry)
        self._unlink(frame_id)
        self._read_index()

    def _unlink(self, frame_id: int) -> None:
        (self._outbox / f"{frame_id:08d}").unlink(missing_ok=True)
        self.path(frame_id).unlink(missing_ok=True)

    def _append_dropped(self, entry: DroppedFrame) -> None:
        for path in (self._deleted, self._index):
            try:
                append_line(path, checked_line(vars(entry)))
            except OSError as error:
                if error.errno not in DISK_FULL:
                    raise
                (self.folder / RESERVE).unlink(missing_ok=True)
                append_line(path, checked_line(vars(entry)))

    def _forget_index(self) -> None:
        self.used_bytes = 0
        self.dropped_undelivered = 0  # by drop-oldest, since the store was made
        self._stored: dict[int, StoredFrame] = {}
        self._exposures: set[tuple[int, int]] = set()
        self._last_id = -1
        self._index_read_bytes = self._index_inode = 0
        self._listed = False

    def _load(self) -> None:
        """Read index and containers; where the index is not as they are it is written again."""
        content, deleted = _content(self._index), _content(self._deleted)
        listed, problems = entries_of(content)
        gone, gone_problems = entries_of(deleted)
        state = IndexState.of(listed, gone)
        if not content and (gone or next(self._frames.glob("*.obf"), None)):
            problems = ["it is empty or gone"]
        if b"\0" in content.rpartition(b"\n")[2]:  # a power cut leaves the beginning of a line
            problems = [*problems, "it ends with zeros"]
        self._compare_with_containers(state, bool(problems))
        added = state.added_to(listed)
        if problems:
            log.error("%s is made again from the containers: %s", self._index.name, problems[0])
        elif added:
            numbers = sorted({entry.frame_id for entry in added})
            log.warning(
                "%s lacked frames %s, the containers say what they are", self._index.name, numbers[:20]
            )
        if problems or added or (content and not content.endswith(b"\n")):
            self._write_again(self._index, content if problems else b"", [*listed, *added])
        missing = state.missing_from(gone)
        lacked = sum(entry in listed for entry in missing)
        if gone_problems or lacked:
            problem = gone_problems[0] if gone_problems else f"it lacked {counted(lacked, 'frame')}"
            log.error("%s is made again from the index: %s", self._deleted.name, problem)
        if gone_problems or missing or (deleted and not deleted.endswith(b"\n")):
            self._write_again(self._deleted, deleted if gone_problems else b"", [*gone, *missing])
        self._forget_index()
        for entry in [*listed, *added]:
            self._take(entry)
        if self._index.exists():
            status = self._index.stat()
            self._index_inode, self._index_read_bytes = status.st_ino, status.st_size

    def _compare_with_containers(self, state: IndexState, is_damaged: bool) -> None:
        """Bring what the index says into line with the containers, which take precedence."""
        present = {int(path.stem): path for path in self._frames.glob("*.obf") if path.stem.isdigit()}
        for frame_id, path in sorted(present.items()):
            dropped = state.dropped.get(frame_id)
            if (
                dropped is not None and dropped.dropped in DELETED_FOR_GOOD
            ):  # the power went before the file did
                with self._told(f"delete frame {frame_id}"):
                    self._unlink(frame_id)
                continue
            if frame_id in state.stored and dropped is None:
                continue
            try:
                state.add(index_entry(path, path.read_bytes()))
            except OSError as error:  # a bad sector costs this frame alone
                log.warning("frame %d cannot be read: %s", frame_id, in_words(error))
                if dropped is None:
                    state.add(DroppedFrame(frame_id, "damaged"))
            except PacketError as error:
                log.warning("%s goes to quarantine: %s", path, error)
                with self._told(f"move {path.name} to quarantine"):
                    quarantine(self.folder, path)
                if is_damaged and dropped is None:  # it may have been sent under this number
                    state.add(DroppedFrame(frame_id, "damaged"))
        for frame_id, stored in state.stored.items():
            if frame_id not in present and frame_id not in state.dropped:
                log.warning("frame %d is gone from the disk", frame_id)
                state.add(DroppedFrame(frame_id, "lost", stored.bracket_id, stored.bracket_index))

    def _write_again(self, path: Path, damaged: bytes, entries: Iterable[Entry]) -> None:
        """Write a file of lines whole; what was damaged goes to quarantine/ first."""
        with self._told(f"write {path.name} again"):
            if damaged:
                with contextlib.suppress(OSError):  # a disk that is full has no room for it
                    write_whole(quarantine_place(self.folder, path), damaged)
            content = b"".join(checked_line(vars(entry)) + b"\n" for entry in entries)
            write_with_reserve(path, content, self.folder / RESERVE)

    def _read_index(self) -> None:
        """Read what the index has gained, whole lines only; all of it where it was written again or is damaged."""
        try:
            with open(self._index, "rb") as index:
                inode = os.fstat(index.fileno()).st_ino
                index.seek(self._index_read_bytes)
                *lines, _unfinished = index.read().split(b"\n")
        except FileNotFoundError:
            if self._index_inode == 0:
                return  # nothing was stored yet
            inode, lines = -1, []
        try:
            entries = [parse_entry(line) for line in lines]
        except ValueError:
            entries = None
        if entries is None or (self._index_inode and inode != self._index_inode):
            with self.locked():
                self._load()
            return
        self._index_inode = inode
        for line, entry in zip(lines, entries, strict=True):
            self._take(entry)
            self._index_read_bytes += len(line) + 1

    def _take(self, entry: Entry) -> None:
        frame_id = entry.frame_id
        self._last_id = max(self._last_id, frame_id)
        before = self._stored.pop(frame_id, None)
        self.used_bytes -= before.size_bytes if before else 0
        if entry.bracket_id is not None and entry.bracket_index is not None:
            self._exposures.add((entry.bracket_id, entry.bracket_index))
        if isinstance(entry, StoredFrame):
            self._stored[frame_id] = entry
            self.used_bytes += entry.size_bytes
            self._arrived.append(frame_id)
        else:
            self.dropped_undelivered += entry.dropped == "oldest"
            self.waiting.pop(frame_id, None)

    def _add_line(self, stored: StoredFrame) -> StoredFrame:
        append_line(self._index, checked_line(vars(stored)))
        self._read_index()
        return stored


def keep_reserve(reserve: Path, size_bytes: int) -> None:
    """Make the file that `write_with_reserve` may delete, unless it is there.

    Raises:
        OSError: the disk refuses.
    """
    if not reserve.exists():
        write_whole(reserve, bytes(size_bytes))


def write_with_reserve(path: Path, data: bytes, reserve: Path, like: Path | None = None) -> None:
    """Write a small file whole or not at all; where the disk is full, the file `reserve` is deleted for it.

    Args:
        like: a file whose mode a new one has.

    Raises:
        OSError: the disk refuses.
    """
    try:
        write_whole(path, data, like)
    except OSError as error:
        if error.errno not in DISK_FULL:
            raise
        reserve.unlink(missing_ok=True)
        write_whole(path, data, like)


def open_store(folder: Path, mission: Mission, open_now: bool = True) -> FrameStore:
    """Return the store with the mission's quota and policy."""
    return FrameStore(folder, mission.store.quota_bytes, mission.store.when_full, open_now)


def require_store(folder: Path) -> None:
    """Raise what is wrong with a folder that must be a frame store already.

    Raises:
        StoreError: it is none, or not there.
    """
    if not (folder / "frames").is_dir():
        raise StoreError(
            f"{folder} is no frame store: it has no folder frames/; give flight's store with --store"
        )
    if (folder / "session.json").exists():
        raise StoreError(
            f"{folder} is a session of the ground, no frame store: give flight's store with --store"
        )


def remove_unused(folder: Path) -> None:
    """Remove a store that holds nothing but what is made at a start; one with frames, settings or an index stays."""
    at_start = {"frames", "outbox", "lock", RESERVE}
    at_start |= {f"{name}.json{copy}" for name in ("store", "boots") for copy in ("", ".copy")}
    with contextlib.suppress(OSError):
        names = {path.name for path in folder.iterdir()}
        if names <= at_start and not any(path.is_dir() and any(path.iterdir()) for path in folder.iterdir()):
            shutil.rmtree(folder)


def quarantine(store: Path, path: Path) -> Path:
    """Move a damaged file to the store's quarantine folder, where nothing is ever overwritten, and return its place."""
    moved = quarantine_place(store, path)
    os.replace(path, moved)
    sync_folder(moved.parent)
    return moved


def quarantine_place(store: Path, path: Path) -> Path:
    """Return a name in the store's quarantine folder that nothing has."""
    folder = store / "quarantine"
    folder.mkdir(exist_ok=True)
    places = (
        folder / f"{number:04d}-{path.name}" for number in itertools.count(sum(1 for _ in folder.iterdir()))
    )
    return next(place for place in places if not place.exists())


@contextlib.contextmanager
def lock_store(folder: Path) -> Iterator[None]:
    """Hold the store's lock; waits for another process that holds it."""
    with contextlib.ExitStack() as opened:
        try:
            lock = opened.enter_context(open(folder / "lock", "wb"))
        except OSError:  # the disk cannot be written to
            with contextlib.suppress(FileNotFoundError):  # then nobody can hold it
                lock = opened.enter_context(open(folder / "lock", "rb"))
                fcntl.flock(lock, fcntl.LOCK_EX)
        else:
            fcntl.flock(lock, fcntl.LOCK_EX)
        yield


def _content(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except FileNotFoundError:
        return b""


def _iso(utc_ns: int) -> str:
    return (datetime.fromtimestamp(0, UTC) + timedelta(microseconds=utc_ns // 1000)).isoformat()


@contextlib.contextmanager
def _disk_errors(action: str) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise StoreError(f"cannot {action}: {in_words(error)}") from error
