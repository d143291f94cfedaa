"""The rows of a comparison: one JSON line a training, appended whole; a row is done when its digest is in the file."""

import contextlib
import fcntl
import json
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from compare.errors import CompareError
from obbgs_base.files import append_line

ROWS, LOCK = "rows.jsonl", "lock"


class Rows:
    """The rows in a comparison's folder, which one command at a time may extend.

    Raises:
        CompareError: a line is damaged.
    """

    def __init__(self, folder: Path):
        self.path = folder / ROWS
        self.rows: dict[str, dict[str, Any]] = {}  # by digest
        content = self.path.read_bytes() if self.path.exists() else b""
        *lines, unfinished = content.split(b"\n")
        for number, line in enumerate(lines, start=1):
            try:
                row = json.loads(line)
                self.rows[row["digest"]] = row
            except (ValueError, KeyError, TypeError) as error:
                raise CompareError(
                    f"{self.path} line {number} is no row ({error}): remove the line, and its cell is made again"
                ) from error
        if unfinished:
            os.truncate(self.path, len(content) - len(unfinished))

    def add(self, row: dict[str, Any]) -> None:
        """Append a row, whole or not at all.

        Raises:
            OSError: the disk does not take it.
        """
        append_line(self.path, json.dumps(row, allow_nan=False).encode())
        self.rows[row["digest"]] = row


@contextlib.contextmanager
def locked(folder: Path, wait: bool = False) -> Iterator[None]:
    """Hold a folder for one process; the system releases it when the process ends, also when it is killed.

    Args:
        wait: for the end of another process that holds it, instead of raising.

    Raises:
        CompareError: another process holds it, or it is a file.
        OSError: the folder cannot be made.
    """
    if folder.exists() and not folder.is_dir():
        raise CompareError(f"{folder} is a file: give a folder with --out")
    folder.mkdir(parents=True, exist_ok=True)
    descriptor = os.open(folder / LOCK, os.O_RDWR | os.O_CREAT, 0o666)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
        except BlockingIOError as error:
            raise CompareError(
                f"another command works in {folder}: wait for its end, or give another --out"
            ) from error
        yield
    finally:
        os.close(descriptor)
