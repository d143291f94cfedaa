"""Records with a checksum, so that no flipped bit passes for a value: lines of JSON, and small files that stand twice.

A checked line is a JSON object whose last key, `crc32`, holds the CRC-32 of the bytes before it in eight digits.
"""

import contextlib
import json
import os
import re
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from obbgs_base.errors import reason
from obbgs_base.files import append_line, write_whole

CHECKED = re.compile(rb'(\{.*),(?: |\n  )"crc32": "([0-9a-f]{8})"\n?\}', re.DOTALL)

LIKE_CHECKSUM = re.compile(rb'"[^"]{5}": "[0-9a-f]{8}"\n?\}\s*\Z')


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


def names_checksum(content: bytes) -> bool:
    """Return whether it names a checksum, or has a name there that one bit may have made of it.

    What earlier versions or people wrote has none.
    """
    return b'"crc32"' in content or LIKE_CHECKSUM.search(content) is not None


def parse_line(line: bytes) -> dict[str, Any]:
    """Return the object of a line without its checksum, which must fit if it names one.

    Raises:
        ValueError: it is no JSON object, or the checksum does not fit.
    """
    if names_checksum(line):
        return parse_checked_line(line)
    try:
        tree = json.loads(line)
    except RecursionError as error:
        raise ValueError("it is nested too deeply") from error
    if not isinstance(tree, dict):
        raise ValueError("expected an object")
    return tree


def parse_checked_line(line: bytes) -> dict[str, Any]:
    """Return the object of a line without its checksum.

    Raises:
        ValueError: it has no checksum, or one that does not fit.
    """
    found = CHECKED.fullmatch(line)
    if found is None:
        raise ValueError(f"expected a line of JSON that ends with its checksum, got {line[-40:]!r}")
    if int(found[2], 16) != zlib.crc32(found[1]):
        raise ValueError(f"the checksum does not fit the line, which begins with {_beginning(line)}")
    return json.loads(found[1] + b"}")


def _beginning(line: bytes) -> str:
    """Return the first characters of a line as one that can be shown."""
    return " ".join(line[:40].decode(errors="replace").split())


@dataclass(frozen=True)
class Lines:
    """What the whole lines of a file say.

    raw: the whole lines, without line feeds, in the order in which they were written; `trees` are their objects without
        checksums.
    problems: what is wrong with each line that is damaged and left out.
    unfinished: whether something stands behind the last line feed.
    restored: how many of the lines only the file's copy still has.
    lost: how many lines are damaged in both.
    unchecked: how many of the lines have no checksum: earlier versions and other programs write none.
    """

    raw: tuple[bytes, ...] = ()
    trees: tuple[dict[str, Any], ...] = ()
    problems: tuple[str, ...] = ()
    restored: int = 0
    lost: int = 0
    unchecked: int = 0
    unfinished: bool = False


def parse_lines(content: bytes) -> Lines:
    """Return the whole lines of a file; a line feed ends each, and what stands behind the last one is unfinished.

    A line that names no checksum is taken as it is.
    """
    *lines, unfinished = content.split(b"\n")
    raw, trees, problems, unchecked = [], [], [], 0
    for number, line in enumerate(lines, start=1):
        try:
            tree = parse_line(line)
        except ValueError as error:
            problems.append(f"line {number}: {error}")
            continue
        raw.append(line)
        trees.append(tree)
        unchecked += not names_checksum(line)
    return Lines(tuple(raw), tuple(trees), tuple(problems), 0, len(problems), unchecked, bool(unfinished))


def read_lines(path: Path) -> Lines:
    """Return the whole lines of a file, none where it is not there.

    Raises:
        OSError: it cannot be read.
    """
    try:
        return parse_lines(path.read_bytes())
    except FileNotFoundError:
        return Lines()


def append_twice(path: Path, tree: Mapping[str, Any]) -> None:
    """Append an object as a checked line to a file and then to its copy.

    Raises:
        OSError: the disk refuses; the file is as it was before.
    """
    line, before_bytes = checked_line(tree), path.stat().st_size if path.exists() else 0
    append_line(path, line)
    try:
        append_line(copy_of(path), line)
    except OSError:
        os.truncate(path, before_bytes)
        raise


def read_lines_twice(path: Path, name: str) -> Lines:
    """Return the whole lines that `append_twice` wrote, each at its place; nothing is written.

    A line that is damaged or missing in one of the two files comes from the other. A file of which no line names a
    checksum was written by hand, and its copy is not looked at.

    Args:
        name: of the entry that tells whether two lines say the same.

    Raises:
        OSError: neither of the files can be read, or one of them not.
    """
    content, copied = (each.read_bytes() if each.exists() else b"" for each in (path, copy_of(path)))
    here = parse_lines(content)
    if content.startswith(copied):  # as after each write, and after a power cut between the two
        return here
    if here.raw and here.unchecked == len(here.raw) and content.endswith(b"\n"):
        return here  # written anew by hand
    there = parse_lines(copied)
    raw, trees = list(here.raw), list(here.trees)
    place = {repr(tree.get(name)): at for at, tree in enumerate(trees)}
    inserted = at = 0  # so many came from the copy; the next one belongs there
    for line, tree in zip(there.raw, there.trees, strict=True):
        known = place.get(repr(tree.get(name)))
        if known is not None:
            at = max(at, known + inserted + 1)
            continue
        raw.insert(at, line)
        trees.insert(at, tree)
        inserted, at = inserted + 1, at + 1
    not_whole = len(there.problems) + (not copied.endswith(b"\n"))
    lost = max(0, min(len(here.problems) - inserted, not_whole))
    problems = here.problems + tuple(f"{copy_of(path).name} {problem}" for problem in there.problems)
    return Lines(tuple(raw), tuple(trees), problems, inserted, lost, here.unchecked, here.unfinished)


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


def read_twice(path: Path, on_damage: Callable[[str], None], mend: bool = True) -> dict[str, Any] | None:
    """Return the object that `write_twice` wrote, None where neither file is there.

    Where one of the two is damaged or gone, or older than the other since the power went between them, it is written
    again if the disk lets it, and `on_damage` is told of damage. A file of an earlier version, which has neither a
    checksum nor a copy, is taken as it is.

    Args:
        mend: whether to write; False for a reader of what another process writes.

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
        if mend and content != good:
            with contextlib.suppress(OSError):  # on a disk that is full or read-only one is enough
                write_whole(each, good)
    if problems:
        on_damage(f"{path.name} or its copy was damaged ({problems[0]}); the good one of the two is used")
    return parse_checked_line(good.removesuffix(b"\n"))


def each_copy(path: Path, parse: Callable[[str], int]) -> tuple[list[int], list[str]]:
    """Return the numbers in a file and in its copy as `parse` reads them, and why it cannot read the others, in words.

    For a number that must never fall: the caller takes the larger. A copy that is not there yet is no problem.
    """
    values: list[int] = []
    problems: list[str] = []
    for each in (path, copy_of(path)):
        try:
            values.append(parse(each.read_text()))
        except (OSError, ValueError) as error:  # of an encoding too
            if each == path or not isinstance(error, FileNotFoundError):
                problems.append(reason(error))
    return values, problems


def _without_checksum(path: Path, copy: Path) -> dict[str, Any] | None:
    """Return the object of a file of an earlier version, None if this is none."""
    try:
        content = path.read_bytes()
        tree = json.loads(content)
    except (OSError, ValueError):
        return None
    return tree if isinstance(tree, dict) and b"crc32" not in content and not copy.exists() else None
