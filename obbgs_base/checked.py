"""Records with a checksum, so that no flipped bit passes for a value: lines of JSON, and small files that stand twice.

A checked line is a JSON object whose last key, `crc32`, holds the CRC-32 of the bytes before it in eight digits.
"""

import contextlib
import json
import re
import zlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from obbgs_base.files import write_whole

CHECKED = re.compile(rb'(\{.*),(?: |\n  )"crc32": "([0-9a-f]{8})"\n?\}', re.DOTALL)


def checked_line(tree: Mapping[str, Any]) -> bytes:
    """Return an object with at least one key as a line of JSON with its checksum, without a line feed.

    Raises:
        ValueError: a number is not finite.
    """
    content = json.dumps(tree, allow_nan=False).encode()[:-1]
    return content + b', "crc32": "%08x"}' % zlib.crc32(content)


def checked_text(tree: Mapping[str, Any]) -> bytes:
    """Return an object as a checked line does, but in lines that a person reads."""
    content = json.dumps(tree, allow_nan=False, indent=2).encode()[:-2]
    return content + b',\n  "crc32": "%08x"\n}' % zlib.crc32(content)


def has_checksum(line: bytes) -> bool:
    """Return whether a line ends as a checked line does; lines of earlier versions have no checksum."""
    return CHECKED.fullmatch(line) is not None


def parse_checked_line(line: bytes) -> dict[str, Any]:
    """Return the object of a line without its checksum.

    Raises:
        ValueError: it has no checksum, or one that does not fit.
    """
    found = CHECKED.fullmatch(line)
    if found is None:
        raise ValueError(f"expected a line of JSON that ends with its checksum, got {line[-40:]!r}")
    if int(found[2], 16) != zlib.crc32(found[1]):
        raise ValueError(f"the checksum does not fit the line {line[:40]!r}")
    return json.loads(found[1] + b"}")


def copy_of(path: Path) -> Path:
    """Return the name of the second copy of a file that stands twice."""
    return path.with_name(path.name + ".copy")


def write_twice(
    path: Path,
    tree: Mapping[str, Any],
    write: Callable[[Path, bytes], None] = write_whole,
    form: Callable[[Mapping[str, Any]], bytes] = checked_line,
) -> None:
    """Write an object with its checksum to a file and then to its copy.

    Raises:
        OSError: the disk refuses; each of the two holds what it held before, or the new object.
    """
    content = form(tree) + b"\n"
    write(path, content)
    write(copy_of(path), content)


def read_twice(path: Path, on_damage: Callable[[str], None]) -> dict[str, Any] | None:
    """Return the object that `write_twice` wrote, None where neither file is there.

    Where one of the two is damaged or gone, or older than the other since the power went between them, it is written
    again if the disk lets it, and `on_damage` is told of damage. A file of an earlier version, which has neither a
    checksum nor a copy, is taken as it is.

    Raises:
        ValueError: neither of them is whole.
        OSError: neither of them can be read.
    """
    both = (path, copy_of(path))
    contents: list[bytes | None] = []  # None: damaged or not there
    problems: list[Exception] = []
    for each in both:
        try:
            content = each.read_bytes()
            parse_checked_line(content.removesuffix(b"\n"))
        except FileNotFoundError:
            contents.append(None)
        except (OSError, ValueError) as error:
            contents.append(None)
            problems.append(error)
        else:
            contents.append(content)
    good = next((content for content in contents if content is not None), None)
    if good is None:
        earlier = _without_checksum(*both)
        if problems and earlier is None:
            raise problems[0]
        return earlier
    for each, content in zip(both, contents, strict=True):
        if content != good:
            with contextlib.suppress(OSError):  # on a disk that is full or read-only one is enough
                write_whole(each, good)
    if problems:
        on_damage(f"{path.name} or its copy was damaged ({problems[0]}); the good one of the two is used")
    return parse_checked_line(good.removesuffix(b"\n"))


def each_copy(path: Path, parse: Callable[[str], int]) -> tuple[list[int], list[Exception]]:
    """Return the numbers in a file and in its copy as `parse` reads them, and what is wrong with what it cannot read.

    For a number that must never fall: the caller takes the larger. A copy that is not there yet is no problem.
    """
    values: list[int] = []
    problems: list[Exception] = []
    for each in (path, copy_of(path)):
        try:
            values.append(parse(each.read_text()))
        except (OSError, ValueError) as error:  # of an encoding too
            if each == path or not isinstance(error, FileNotFoundError):
                problems.append(error)
    return values, problems


def _without_checksum(path: Path, copy: Path) -> dict[str, Any] | None:
    """Return the object of a file of an earlier version, None if this is none."""
    try:
        content = path.read_bytes()
        tree = json.loads(content)
    except (OSError, ValueError):
        return None
    return tree if isinstance(tree, dict) and b"crc32" not in content and not copy.exists() else None
