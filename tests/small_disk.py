"""Disks that misbehave: one that is small enough to become truly full, one that cannot be written to."""

import contextlib
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest


@contextlib.contextmanager
def small_disk(folder: Path, size: str) -> Iterator[Path]:
    """Make the folder a file system in memory of that size, such as 256k, while in the context.

    The test is skipped where mounting is not permitted.
    """
    folder.mkdir()
    if subprocess.run(
        ["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", folder], check=False
    ).returncode:
        pytest.skip("no right to mount a tmpfs here")
    try:
        yield folder
    finally:
        subprocess.run(["umount", folder], check=True)


def fill_disk(file: Path) -> None:
    """Write the file until the disk is full."""
    with open(file, "wb", buffering=0) as opened, contextlib.suppress(OSError):
        while True:
            opened.write(bytes(512))


@contextlib.contextmanager
def read_only(folder: Path) -> Iterator[None]:
    """Let the kernel refuse every write below the folder while in the context.

    The test is skipped where mounting is not permitted.
    """
    if subprocess.run(["mount", "--bind", folder, folder], check=False).returncode:
        pytest.skip("no right to mount here")
    try:
        subprocess.run(["mount", "-o", "remount,ro,bind", folder], check=True)
        yield
    finally:
        subprocess.run(["umount", folder], check=True)
