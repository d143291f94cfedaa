"""PLY files as tables of named columns, read and written with NumPy alone.

Byte order, order of the columns and their names are read, not assumed: ASCII and both byte orders, every scalar type
and lists whose rows have one length. Source: Turk, The PLY Polygon File Format, 1994.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from obbgs_base.files import write_whole

FORMATS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
TYPES = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("float", "float32"), "f4"),
    **dict.fromkeys(("double", "float64"), "f8"),
}
NAMES = {"i4": "int", "f4": "float"}  # what is written
LONGEST_HEADER = 1 << 20  # bytes


class PlyError(ValueError):
    """A file is not a PLY, or is damaged; the message says what was expected."""


@dataclass(frozen=True, eq=False)
class Ply:
    """The content of a file: its tables by name, each with its columns [N] (of lists [N, L]), and its comments."""

    tables: dict[str, dict[str, np.ndarray]]
    comments: tuple[str, ...] = ()


@dataclass
class _Element:
    name: str
    count: int
    properties: list[tuple[str, str, str | None]]  # name, type, type of the list's length


def read_ply(path: Path) -> Ply:
    """Return the tables of a PLY file.

    Raises:
        PlyError: it is no PLY, is cut off, has bytes left over, or rows of a list differ in length.
        OSError: it cannot be read.
    """
    content = path.read_bytes()
    end = content.find(b"end_header", 0, LONGEST_HEADER)
    line_end = content.find(b"\n", end)
    if not content.startswith(b"ply") or end < 0 or line_end < 0:
        raise PlyError("expected a PLY file: lines from 'ply' to 'end_header'")
    lines = [line.strip() for line in content[:end].decode("ascii", "replace").splitlines()]
    order, elements = _elements(lines)
    body = memoryview(content)[line_end + 1 :]
    tables = _ascii_tables(body, elements) if order == "" else _binary_tables(body, elements, order)
    comments = tuple(line.removeprefix("comment ") for line in lines if line.startswith("comment "))
    return Ply(tables, comments)


def write_ply(path: Path, tables: dict[str, dict[str, np.ndarray]], *comments: str) -> None:
    """Write tables of columns [N], or lists [N, L] of at most 255, float32 or int32; whole or not at all."""
    header, parts = ["ply", "format binary_little_endian 1.0", *(f"comment {text}" for text in comments)], []
    for name, columns in tables.items():
        count = len(next(iter(columns.values())))
        header.append(f"element {name} {count}")
        fields = []
        for column, values in columns.items():
            kind = "i4" if values.dtype.kind in "iu" else "f4"
            if values.ndim == 2:
                header.append(f"property list uchar {NAMES[kind]} {column}")
                fields.append((f"length of {column}", "u1"))
                fields.append((column, f"<{kind}", values.shape[1:]))
            else:
                header.append(f"property {NAMES[kind]} {column}")
                fields.append((column, f"<{kind}"))
        rows = np.zeros(count, dtype=fields)
        for column, values in columns.items():
            rows[column] = values
            if values.ndim == 2:
                rows[f"length of {column}"] = values.shape[1]
        parts.append(rows.tobytes())
    write_whole(path, "\n".join([*header, "end_header\n"]).encode("ascii") + b"".join(parts))


def _elements(lines: list[str]) -> tuple[str, list[_Element]]:
    """Return the byte order, "" for ASCII, and what the header says of the elements."""
    order, elements = None, []
    for line in lines[1:]:
        match line.split():
            case [] | ["comment" | "obj_info", *_]:
                continue
            case ["format", name, "1.0"] if name in FORMATS:
                order = FORMATS[name]
            case ["element", name, count] if count.isdecimal() and count.isascii() and len(count) < 19:
                elements.append(_Element(name, int(count), []))
            case ["property", "list", length, kind, name] if elements and {length, kind} <= TYPES.keys():
                elements[-1].properties.append((name, TYPES[kind], TYPES[length]))
            case ["property", kind, name] if elements and kind in TYPES:
                elements[-1].properties.append((name, TYPES[kind], None))
            case _:
                raise PlyError(f"the header has a line that is not understood: {line[:80]!r}")
    if order is None:
        raise PlyError(f"expected a format of {', '.join(FORMATS)}, version 1.0")
    for element in elements:
        names = [name for name, _, _ in element.properties]
        if len(set(names)) < len(names):
            raise PlyError(f"element {element.name} has two columns of one name")
    return order, elements


def _binary_tables(
    body: memoryview, elements: list[_Element], order: str
) -> dict[str, dict[str, np.ndarray]]:
    tables, at = {}, 0
    for element in elements:
        fields = []
        offset = at  # the first row's lists say how long they are; the others must agree
        for name, kind, length_kind in element.properties:
            shape = ()
            if length_kind is not None:
                length = 0 if element.count == 0 else int(_values(body, offset, order + length_kind, 1)[0])
                if not 0 <= length <= len(body):
                    raise PlyError(f"a list {name} says that it has {length} entries")
                fields.append((f"length of {name}", order + length_kind))
                offset += np.dtype(length_kind).itemsize
                shape = (length,)
            fields.append((name, order + kind, shape))
            offset += np.dtype(kind).itemsize * (shape[0] if shape else 1)
        rows = _values(body, at, np.dtype(fields), element.count)
        at += rows.nbytes
        columns = {}
        for name, kind, length_kind in element.properties:
            columns[name] = rows[name].astype(kind)
            if length_kind is not None and (rows[f"length of {name}"] != columns[name].shape[1]).any():
                raise PlyError(f"the lists {name} differ in length, which is not supported")
        tables[element.name] = columns
    if at != len(body):
        raise PlyError(f"the header describes {at} bytes of numbers, the file has {len(body)}")
    return tables


def _values(body: memoryview, at: int, dtype, count: int) -> np.ndarray:
    dtype = np.dtype(dtype)
    if at + count * dtype.itemsize > len(body):
        raise PlyError(
            f"the header describes {at + count * dtype.itemsize} bytes of numbers or more, the file has {len(body)}"
        )
    return np.frombuffer(body, dtype, count, at) if count else np.zeros(0, dtype)


def _ascii_tables(body: memoryview, elements: list[_Element]) -> dict[str, dict[str, np.ndarray]]:
    try:
        numbers, at = np.array(bytes(body).split(), dtype=np.float64), 0
    except ValueError as error:
        raise PlyError(f"expected numbers after the header: {error}") from error
    tables = {}
    for element in elements:
        widths, columns, offset = [], {}, at
        for name, _, length_kind in element.properties:
            length = 1
            if length_kind is not None:
                value = numbers[offset] if offset < len(numbers) else 0.0
                if not (0 <= value <= len(numbers) and value == int(value)):
                    raise PlyError(f"a list {name} says that it has {value} entries")
                length = 1 + int(value) if element.count else 1
            widths.append(length)
            offset += length
        if at + element.count * sum(widths) > len(numbers):
            raise PlyError(f"expected {element.count} rows of {element.name}, the file ends before")
        rows = numbers[at : at + element.count * sum(widths)].reshape(element.count, sum(widths))
        at += rows.size
        ends = np.cumsum(widths)
        for (name, kind, length_kind), width, stop in zip(element.properties, widths, ends, strict=True):
            values = rows[:, stop - width : stop]
            if length_kind is not None and (values[:, 0] != width - 1).any():
                raise PlyError(f"the lists {name} differ in length, which is not supported")
            columns[name] = (values[:, 0] if length_kind is None else values[:, 1:]).astype(kind)
        tables[element.name] = columns
    if at != len(numbers):
        raise PlyError(f"the header describes {at} numbers, the file has {len(numbers)}")
    return tables
