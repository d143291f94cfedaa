"""Where a row of figures comes from: commit, machine, threads, load, date and command."""

import functools
import importlib.metadata
import os
import platform
import shlex
import subprocess
import sys
from datetime import UTC, datetime
from pathlib import Path

import torch

from obbgs_core.render import native_kernels

ROOT = Path(__file__).parents[2]  # of a clone of the project


def with_origin(row: dict, bench: str, command: str) -> dict:
    """Return a row with the benchmark, commit, machine, threads, load, date and command that it comes from.

    What the row says itself stays, such as threads that were set for it alone.
    """
    return {"bench": bench} | row | origin(command) | row


def origin(command: str) -> dict:
    """Return the fields of a row that say how it was made."""
    return {
        "commit": commit(),
        "machine": machine(),
        "threads": torch.get_num_threads(),
        "load": round(os.getloadavg()[0], 1),
        "utc": datetime.now(UTC).strftime("%Y-%m-%dT%H:%MZ"),
        "command": command,
    }


def this_command(name: str) -> str:
    """Return the command that runs, by the name under which a user would call it."""
    return shlex.join([*name.split(), *sys.argv[1:]])


@functools.cache
def commit() -> str:
    """Return the commit that was checked out when this was first asked, `+changes` where files differ from it.

    Of an installed package, which is no clone, it is the version.
    """
    if not (ROOT / ".git").exists():
        return f"version {importlib.metadata.version('obbgs')}"

    def git(*arguments: str) -> str:
        command = ["git", "-C", str(ROOT), *arguments]
        return subprocess.run(command, capture_output=True, text=True, check=False).stdout.strip()

    known = git("rev-parse", "--short", "HEAD") or "unknown"
    if git("status", "--porcelain", "--untracked-files=no", "--", ":!results"):
        known += "+changes"
    return known


@functools.cache
def machine() -> str:
    """Return the processor, its number of cores, and which kernels the rasterizer runs."""
    kernels = native_kernels()
    return f"{_processor()}, {os.cpu_count()} cores, kernel {kernels[0] if kernels else 'reference'}"


def _processor() -> str:
    """Return the processor's name as the system tells it."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.machine()
