"""Check and repair a frame store after a crash, a bad sector or a change by hand."""

import json
from dataclasses import dataclass, field
from pathlib import Path

from flightsw.errors import StoreError
from flightsw.icd.packet import PacketError
from flightsw.store import lock_store, quarantine
from flightsw.store_index import StoredFrame, index_entry, parse_index_line
from flightsw.transfer_numbers import FILE, numbers_line, parse_numbers, random_number
from obbgs_base.files import sync_folder, write_whole


@dataclass
class FsckReport:
    """What was found. `problems` has a line for each; all are repaired unless only a check was asked for."""

    frames: int = 0  # containers whose every checksum fits
    waiting: int = 0  # of them still to be delivered
    quarantined: int = 0  # containers that were moved away
    missing: int = 0  # frames of the index that are gone from the disk
    problems: list[str] = field(default_factory=list)


def fsck(folder: Path, repair: bool = True) -> FsckReport:
    """Check every file of a frame store, and repair what is wrong.

    Temporary files are deleted. A container is decoded whole (its own CRC-32, that of its pixels, the number in its
    name); what fails goes to quarantine/ and out of the outbox. The index is written again if a line is unreadable
    or repeated or contradicts the containers, which take precedence; the numbers of deleted frames are kept. A
    damaged transfer number is replaced by one drawn at random. Unknown files are left.

    Raises:
        StoreError: there is no store here, or the disk refuses.
    """
    if not (folder / "frames").is_dir():
        raise StoreError(f"{folder} is no frame store: it has no folder frames/")
    try:
        with lock_store(folder):
            return _Check(folder, repair).run()
    except OSError as error:
        raise StoreError(f"cannot check {folder}: {error}") from error


class _Check:
    def __init__(self, folder: Path, repair: bool):
        self.folder, self.repair, self.report = folder, repair, FsckReport()

    def run(self) -> FsckReport:
        self._temporary_files()
        found = self._containers()
        self._index(found)
        self._outbox(found)
        self._transaction()
        self.report.frames = len(found)
        return self.report

    def _note(self, problem: str) -> bool:
        self.report.problems.append(problem)
        return self.repair

    def _temporary_files(self) -> None:
        for part in [*self.folder.glob("*.part"), *(self.folder / "frames").glob("*.part")]:
            if self._note(f"{part.relative_to(self.folder)}: left by an unfinished write, deleted"):
                part.unlink()

    def _containers(self) -> dict[int, StoredFrame]:
        found: dict[int, StoredFrame] = {}
        for path in sorted((self.folder / "frames").glob("*.obf")):
            try:
                stored = index_entry(path, path.read_bytes())
                found[stored.frame_id] = stored
            except (PacketError, OSError) as error:
                self.report.quarantined += 1
                if self._note(f"frames/{path.name}: {error}; moved to quarantine/"):
                    quarantine(self.folder, path)
        return found

    def _index(self, found: dict[int, StoredFrame]) -> None:
        path = self.folder / "index.jsonl"
        *lines, unfinished = path.read_bytes().split(b"\n") if path.exists() else [b""]
        listed: dict[int, StoredFrame] = {}
        dropped: dict[int, str] = {}
        known: dict[int, StoredFrame] = {}  # listed at any time: deleted frames keep their exposure
        before = len(self.report.problems)
        if unfinished:
            self._note("index.jsonl: the last line is cut off")
        for number, line in enumerate(lines, start=1):
            try:
                entry = parse_index_line(line)
            except ValueError as error:
                self._note(f"index.jsonl line {number}: {error}")
                continue
            if not isinstance(entry, StoredFrame):
                dropped[entry[0]] = entry[1]
                listed.pop(entry[0], None)
                continue
            if entry.frame_id in known:
                self._note(f"index.jsonl line {number}: frame {entry.frame_id} is listed twice")
            known[entry.frame_id] = listed[entry.frame_id] = entry
        for frame_id, stored in found.items():
            if listed.get(frame_id) != stored:
                self._note(f"frame {frame_id}: the index does not have it as it is on the disk")
        for frame_id in sorted(set(listed) - set(found)):
            self.report.missing += 1
            dropped[frame_id] = "lost"
            self._note(f"frame {frame_id}: in the index, but not on the disk")
        if self.repair and len(self.report.problems) > before:
            entries: list[dict] = []
            for frame_id in sorted(known.keys() | found.keys() | dropped.keys()):
                if stored := found.get(frame_id) or known.get(frame_id):
                    entries.append(vars(stored))
                if frame_id not in found:
                    entries.append({"frame_id": frame_id, "dropped": dropped.get(frame_id, "lost")})
            write_whole(path, b"".join(json.dumps(entry).encode() + b"\n" for entry in entries))

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
            if self._note(f"transaction: {error}; replaced by a number drawn at random"):
                write_whole(path, numbers_line(random_number(), ()))
