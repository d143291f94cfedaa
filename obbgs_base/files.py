"""Writes files whole or not at all, even through a power cut; every part writes with these functions."""

import contextlib
import errno
import itertools
import os
import stat
from pathlib import Path

UNUSED = ".unused-"  # between the name of a file that was set aside and a number


def write_whole(path: Path, content: bytes, like: Path | None = None) -> None:
    """Write under a temporary name beside `path`, sync, rename, and sync the folder.

    A file that is written anew keeps its mode, and its owner where this user may give files away; where there was none,
    it has those of the file `like`.

    Raises:
        OSError: the disk does not take it; then nothing is left behind, and what `path` held before is still there.
    """
    part = path.with_name(path.name + ".part")
    try:
        part.unlink(missing_ok=True)  # of a command that was killed, with whatever mode
        with open(part, "wb") as file:
            # before there is anything to read in it
            keep_mode(path if like is None or path.exists() else like, part)
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(part, path)
    except OSError as error:
        with contextlib.suppress(OSError):
            part.unlink(missing_ok=True)
        # the error names the part, which nobody asked for; Python chooses its class by the number
        raise OSError(error.errno, error.strerror, str(path)) from error
    sync_folder(path.parent)


def read_bounded(path: Path, most_bytes: int) -> bytes:
    """Return the content of a file; of one that has more than `most_bytes`, so many and one more.

    Raises:
        OSError: it cannot be read.
    """
    with open(path, "rb") as file:
        return file.read(most_bytes + 1)


def keep_mode(path: Path, part: Path) -> None:
    """Give a file that is about to replace `path` the mode and the owner of what is there, as far as that is allowed.

    Some file systems have no modes, and only root gives files away: then the file has those of a new one.
    """
    try:
        before = path.stat()
    except FileNotFoundError:
        return
    with contextlib.suppress(PermissionError):
        os.chown(part, before.st_uid, before.st_gid)
    with contextlib.suppress(PermissionError):
        os.chmod(part, stat.S_IMODE(before.st_mode))


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
