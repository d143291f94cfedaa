"""Writes files whole or not at all, even through a power cut; every part writes with these functions."""

import errno
import itertools
import os
from pathlib import Path

UNUSED = ".unused-"  # between the name of a file that was set aside and a number


def write_whole(path: Path, content: bytes) -> None:
    """Write under a temporary name beside `path`, sync, rename, and sync the folder.

    Raises:
        OSError: the disk does not take it; then nothing is left behind, and what `path` held before is still there.
    """
    part = path.with_name(path.name + ".part")
    try:
        with open(part, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(part, path)
    except OSError:
        part.unlink(missing_ok=True)
        raise
    sync_folder(path.parent)


def set_aside(path: Path) -> Path:
    """Rename a file to a name beside it that nothing has, so that what is written next does not replace it."""
    names = (path.with_name(f"{path.name}{UNUSED}{number}") for number in itertools.count(1))
    kept = next(other for other in names if not other.exists())
    os.replace(path, kept)
    sync_folder(path.parent)
    return kept


def append_line(path: Path, line: bytes) -> None:
    """Append a line, which lacks its line feed, and sync the file; sync the folder as well if the file is new.

    Raises:
        OSError: the disk does not take it; then `path` is as it was before, without half a line.
    """
    before_bytes = path.stat().st_size if path.exists() else None
    try:
        with open(path, "ab") as file:
            file.write(line + b"\n")
            file.flush()
            os.fsync(file.fileno())
    except OSError:
        if path.exists():  # after half a line, the next one would be damaged too
            os.truncate(path, before_bytes or 0)
        raise
    if before_bytes is None:
        sync_folder(path.parent)


def sync_folder(folder: Path) -> None:
    """Force a folder's entries (created, renamed and removed files) to the disk.

    Some file systems cannot do that for a folder and say EINVAL (CIFS before Linux 4.17, VirtualBox shares, some of
    FUSE): there a power cut may undo the newest entries, but nothing else is less safe.

    Raises:
        OSError: the disk failed.
    """
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    except OSError as error:
        if error.errno != errno.EINVAL:
            raise
    finally:
        os.close(descriptor)
