"""Check and repair a frame store after a crash, a bad sector or a change by hand, also while flight runs."""

import threading
from dataclasses import dataclass, field
from pathlib import Path

from flightsw.errors import StoreError
from flightsw.icd.packet import PacketError
from flightsw.storage.index import (
    DELETED_FOR_GOOD,
    DroppedFrame,
    Entry,
    IndexState,
    StoredFrame,
    entries_of,
    index_entry,
)
from flightsw.storage.store import lock_store, quarantine, require_store
from flightsw.storage.transfer_numbers import FILE, numbers_line, parse_numbers, random_number
from obbgs_base.checked import checked_line, copy_of, parse_checked_line, read_twice
from obbgs_base.errors import counted, in_words, reason
from obbgs_base.files import sync_folder, write_whole

TWICE = (
    "boots.json",
    "deletions.json",
    "pass.json",
    "settings.json",
    "store.json",
)  # files with a checksum and a copy


@dataclass
class FsckReport:
    """What was found. `problems` has a line for each; all are repaired unless only a check was asked for."""

    frames: int = 0  # containers whose every checksum fits
    waiting: int = 0  # of them still to be delivered
    quarantined: int = 0  # containers that were moved away
    missing: int = 0  # frames of the index that are gone from the disk, those in quarantine not counted
    problems: list[str] = field(default_factory=list)

    def sentence(self, done: str = "repaired") -> str:
        """Return the counts in words."""
        return (
            f"{counted(self.frames, 'good frame')}, {self.waiting} to be delivered, {self.quarantined} quarantined, "
            f"{self.missing} missing, {counted(len(self.problems), 'problem')} {done}"
        )


def fsck(folder: Path, repair: bool = True) -> FsckReport:
    """Check every file of a frame store, and repair what is wrong.

    Temporary files are deleted. A container is decoded whole (its own CRC-32, that of its pixels, the number in its
    name); what fails goes to quarantine/ and out of the outbox. The index is written again if a line is unreadable
    or repeated or contradicts the containers, which take precedence; the numbers of deleted frames are kept. A
    damaged transfer number is replaced by one drawn at random. Of files that stand twice the good one replaces the
    other. Unknown files are left.

    Raises:
        StoreError: there is no store here, or the disk refuses.
    """
    return _Check(folder, repair).run(is_running=False)


class RunningCheck:
    """A check and repair of the store of a flight software that runs, in a thread of its own: `outcome` ends it.

    The store is locked only after all containers have been read: until then frames are taken and sent as ever.
    """

    def __init__(self, folder: Path):
        self._folder = folder
        self._report: FsckReport | None = None
        self._problem = ""
        self._thread = threading.Thread(target=self._run, name="fsck", daemon=True)
        self._thread.start()

    def outcome(self) -> FsckReport | None:
        """Return the report once there is one.

        Raises:
            StoreError: the disk refused.
        """
        if self._thread.is_alive():
            return None
        if self._report is None:
            raise StoreError(self._problem)
        return self._report

    def _run(self) -> None:
        try:
            self._report = _Check(self._folder, repair=True).run(is_running=True)
        except Exception as error:  # it would be lost with this thread
            self._problem = str(error) or repr(error)


class _Check:
    def __init__(self, folder: Path, repair: bool):
        self.folder, self.repair, self.report = folder, repair, FsckReport()
        self._good: dict[int, StoredFrame] = {}
        self._damaged: set[int] = set()  # numbers of the containers that are moved away

    def run(self, is_running: bool) -> FsckReport:
        """Check and repair; the files that a running flight software may be writing are left where it runs."""
        require_store(self.folder)
        try:
            for path in self._container_paths():  # without the lock, since it takes long
                self._look_at(path)
            with lock_store(self.folder):
                if not is_running:
                    self._temporary_files()
                found = self._containers()
                self._index(found)
                self._outbox(found)
                self._transaction()
                self._files_that_stand_twice()
        except OSError as error:
            raise StoreError(f"cannot check {self.folder}: {in_words(error)}") from error
        self.report.frames = len(found)
        return self.report

    def _note(self, problem: str) -> bool:
        self.report.problems.append(problem)
        return self.repair

    def _temporary_files(self) -> None:
        for part in [*self.folder.glob("*.part"), *(self.folder / "frames").glob("*.part")]:
            if self._note(f"{part.relative_to(self.folder)}: left by an unfinished write, deleted"):
                part.unlink()

    def _container_paths(self) -> list[Path]:
        return sorted((self.folder / "frames").glob("*.obf"))

    def _look_at(self, path: Path) -> Exception | None:
        """Note a good container; return what is wrong with another."""
        try:
            stored = index_entry(path, path.read_bytes(), decode=True)
        except (PacketError, OSError) as error:
            return error
        self._good[stored.frame_id] = stored
        return None

    def _containers(self) -> dict[int, StoredFrame]:
        found: dict[int, StoredFrame] = {}
        for path in self._container_paths():
            known = int(path.stem) in self._good if path.stem.isdigit() else False
            error = (
                None if known else self._look_at(path)
            )  # another look: it may have come, or gone, since the first
            if error is None:
                frame_id = int(path.stem)
                found[frame_id] = self._good[frame_id]
                continue
            self.report.quarantined += 1
            if path.stem.isdigit():
                self._damaged.add(int(path.stem))
            if self._note(f"frames/{path.name}: {error}; a repair moves it to quarantine/"):
                quarantine(self.folder, path)
        return found

    def _index(self, found: dict[int, StoredFrame]) -> None:
        files = (self.folder / "index.jsonl", self.folder / "deleted.jsonl")
        contents = [path.read_bytes() if path.exists() else b"" for path in files]
        (listed, problems), (gone, gone_problems) = map(entries_of, contents)
        before = len(self.report.problems)
        for path, content, lines in zip(files, contents, (problems, gone_problems), strict=True):
            if content and not content.endswith(b"\n"):
                self._note(f"{path.name}: the last line is cut off")
            for problem in lines:
                self._note(f"{path.name} {problem}")
        state = IndexState.of(listed, gone)
        self._repeated(listed)
        for frame_id, stored in list(found.items()):
            dropped = state.dropped.get(frame_id)
            if dropped is not None and dropped.dropped in DELETED_FOR_GOOD:
                del found[frame_id]
                if self._note(f"frame {frame_id}: was deleted, but its container was still there"):
                    (self.folder / "frames" / f"{frame_id:08d}.obf").unlink()
            elif frame_id in state.dropped or state.stored.get(frame_id) != stored:
                self._note(f"frame {frame_id}: the index does not have it as it is on the disk")
                state.add(stored)
        for frame_id, stored in sorted(state.stored.items()):
            if frame_id not in found and frame_id not in state.dropped:
                is_damaged = frame_id in self._damaged
                self.report.missing += not is_damaged  # a damaged one is counted as quarantined
                where = "its container is damaged" if is_damaged else "not on the disk"
                self._note(f"frame {frame_id}: in the index, but {where}")
                why = "damaged" if is_damaged else "lost"
                state.add(DroppedFrame(frame_id, why, stored.bracket_id, stored.bracket_index))
        for entry in state.missing_from(gone):
            if len(self.report.problems) == before:
                self._note(f"frame {entry.frame_id}: deleted.jsonl does not have that it was deleted")
        if self.repair and len(self.report.problems) > before:
            deleted: list[Entry] = sorted(state.dropped.values(), key=lambda entry: entry.frame_id)
            for path, entries in zip(files, (state.added_to([]), deleted), strict=True):
                write_whole(path, b"".join(checked_line(vars(entry)) + b"\n" for entry in entries))

    def _repeated(self, listed: list[Entry]) -> None:
        state = IndexState()
        for entry in listed:
            known = entry.frame_id in state.stored and entry.frame_id not in state.dropped
            if known and isinstance(entry, StoredFrame):
                self._note(f"index.jsonl: frame {entry.frame_id} is listed twice")
            state.add(entry)

    def _outbox(self, found: dict[int, StoredFrame]) -> None:
        outbox = self.folder / "outbox"
        if not outbox.is_dir() and self._note("outbox/: missing; every frame is put into it again"):
            outbox.mkdir()
            for frame_id in found:
                (outbox / f"{frame_id:08d}").touch()
            sync_folder(outbox)
        for marker in sorted(outbox.iterdir()) if outbox.is_dir() else []:
            if marker.name.isdigit() and int(marker.name) in found:
                self.report.waiting += 1
            elif marker.name.isdigit() and self._note(f"outbox/{marker.name}: there is no such frame"):
                marker.unlink()

    def _transaction(self) -> None:
        path = self.folder / FILE
        try:
            if path.exists():
                parse_numbers(path.read_bytes())
        except ValueError as error:
            if self._note(
                f"transaction: {error}; replaced by a number drawn at random, all waiting frames as sent"
            ):
                waiting = [
                    int(marker.name) for marker in (self.folder / "outbox").iterdir() if marker.name.isdigit()
                ]
                write_whole(path, numbers_line(random_number(), waiting))

    def _files_that_stand_twice(self) -> None:
        for name in TWICE:
            path, damaged = self.folder / name, []
            for each in (path, copy_of(path)):
                try:
                    parse_checked_line(each.read_bytes().removesuffix(b"\n"))
                except FileNotFoundError:
                    continue
                except (OSError, ValueError) as error:
                    damaged.append(f"{each.name}: {reason(error)}")
            if len(damaged) == 1 and self._note(f"{damaged[0]}; the good one of the two replaces it"):
                read_twice(path, lambda problem: None)
            elif len(damaged) == 2:
                self._note(f"{damaged[0]}; so is its copy, and flight says what it does without them")
                for each in (path, copy_of(path)):
                    if self.repair:
                        quarantine(self.folder, each)
