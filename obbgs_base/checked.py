"""Records with a checksum, so that no flipped bit passes for a value: lines of JSON, and small files that stand twice.

A checked line is a JSON object whose last key, `crc32`, holds the CRC-32 of the bytes before it in eight digits.
"""

import json
import re
import zlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from obbgs_base.files import write_whole

CHECKED = re.compile(rb'(\{.*), "crc32": "([0-9a-f]{8})"\}', re.DOTALL)


def checked_line(tree: Mapping[str, Any]) -> bytes:
    """Return an object with at least one key as a line of JSON with its checksum, without a line feed.

    Raises:
        ValueError: a number is not finite.
    """
    content = json.dumps(tree, allow_nan=False).encode()[:-1]
    return content + b', "crc32": "%08x"}' % zlib.crc32(content)


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
    path: Path, tree: Mapping[str, Any], write: Callable[[Path, bytes], None] = write_whole
) -> None:
    """Write an object as a checked line to a file and then to its copy.

    Raises:
        OSError: the disk refuses; each of the two holds what it held before, or the new object.
    """
    content = checked_line(tree) + b"\n"
    write(path, content)
    write(copy_of(path), content)


def read_twice(path: Path, on_damage: Callable[[str], None]) -> dict[str, Any] | None:
    """Return the object that `write_twice` wrote, None where neither file is there.

    Where one of the two is damaged or gone, or older than the other since the power went between them, it is written
    again if the disk lets it, and `on_damage` is told of damage.

    Raises:
        ValueError: neither of them is whole.
        OSError: neither of them can be read.
    """
    contents: list[bytes] = []
    problems: list[Exception] = []
    for each in (path, copy_of(path)):
        try:
            content = each.read_bytes()
            parse_checked_line(content.removesuffix(b"\n"))
            contents.append(content)
        except FileNotFoundError:
            contents.append(b"")
        except (OSError, ValueError) as error:
            problems.append(error)
            contents.append(b"")
    good = next((content for content in contents if content), None)
    if good is None:
        if problems:
            raise problems[0]
        return None
    for each, content in zip((path, copy_of(path)), contents, strict=True):
        if content != good:
            try:
                write_whole(each, good)
            except OSError as error:
                problems.append(error)
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
