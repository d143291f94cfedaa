"""A folder that one command at a time works in; the lock ends with its process, also when that is killed."""

import contextlib
import errno
import fcntl
import os
from collections.abc import Iterator
from pathlib import Path

from obbgs_base.errors import ObbgsError

LOCK = "lock"  # name of the file in a folder that is held


class InUse(ObbgsError):
    """Another process holds the folder; the message says what to do."""


@contextlib.contextmanager
def one_command_in(folder: Path, tool: str) -> Iterator[None]:
    """Hold a folder, which is made if need be, for one command of a tool; another one is refused meanwhile.

    Afterwards the lock file is removed, and the folder if it was made and nothing is in it. What a killed command left
    behind holds nobody up.

    Args:
        tool: named in the message, such as `hil`.

    Raises:
        InUse: another process holds it.
        OSError: the folder or the file in it cannot be made.
    """
    found = folder.exists()
    descriptor = _open_locked(folder, tool)
    try:
        yield
    finally:
        # before the lock ends: later the file may be that of the next command
        with contextlib.suppress(OSError):
            (folder / LOCK).unlink()
            if not found:
                folder.rmdir()
        os.close(descriptor)


def _open_locked(folder: Path, tool: str) -> int:
    """Return the descriptor of a folder's lock file, locked by this process; processes that it starts lack it."""
    while True:
        if folder.exists() and not folder.is_dir():
            raise NotADirectoryError(errno.ENOTDIR, "is a file: give a folder", str(folder))
        folder.mkdir(parents=True, exist_ok=True)
        try:
            descriptor = os.open(folder / LOCK, os.O_RDWR | os.O_CREAT, 0o666)
        except FileNotFoundError:  # another process has just removed the folder
            continue
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if _is_at(descriptor, folder / LOCK):
                return descriptor
        except BlockingIOError as error:
            os.close(descriptor)
            raise InUse(
                f"another {tool} command works in {folder}: wait for its end, or choose another folder"
            ) from error
        os.close(descriptor)


def _is_at(descriptor: int, path: Path) -> bool:
    """Return whether an open file is the one at a path: the process that held it before may have removed it."""
    try:
        return os.path.samestat(os.fstat(descriptor), os.stat(path))
    except FileNotFoundError:
        return False
