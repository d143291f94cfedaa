"""PLY files read by trimesh, whose reader is not ours: the oracle of tests of files that we write."""

from pathlib import Path

import numpy as np
from trimesh.exchange.ply import load_ply


def read(path: Path, element: str = "vertex") -> np.ndarray:
    """Return the rows [N] of an element, a structured array with the columns' names."""
    with open(path, "rb") as file:
        return load_ply(file)["metadata"]["_ply_raw"][element]["data"]


def comments(path: Path) -> list[str]:
    """Return the comments of a file's header."""
    head = path.read_bytes().partition(b"end_header\n")[0].decode("ascii")
    return [line.removeprefix("comment ") for line in head.splitlines() if line.startswith("comment ")]
