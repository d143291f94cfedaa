"""Two-line element sets: their checksum and the form of each field."""

import re

from flightsw.icd.config import require

# The fields of a two-line element set that SGP4 reads: line, first and last column (from 1), name, form.
DECIMAL = r" *-?\d*\.\d+ *"
TLE_FIELDS = (
    (1, 19, 32, "epoch", r"\d\d[ \d]{2}\d\.\d+ *"),
    (1, 34, 43, "first derivative of mean motion", r"[ +-]*\d?\.\d+ *"),
    (1, 45, 52, "second derivative of mean motion", r"[ +-]*\d+[ +-]\d"),
    (1, 54, 61, "drag term", r"[ +-]*\d+[ +-]\d"),
    (2, 9, 16, "inclination", DECIMAL),
    (2, 18, 25, "right ascension", DECIMAL),
    (2, 27, 33, "eccentricity", r"\d{7}"),
    (2, 35, 42, "argument of perigee", DECIMAL),
    (2, 44, 51, "mean anomaly", DECIMAL),
    (2, 53, 63, "mean motion", DECIMAL),
)


def tle_checksum(line: str) -> int:
    """Return the modulo-10 checksum of a TLE line's first 68 columns (digits, and 1 for each minus)."""
    return sum(int(c) if c.isdigit() else c == "-" for c in line[:68]) % 10


def check_tle(lines: tuple[str, ...], path: str) -> None:
    """Check every column of a two-line element set that SGP4 reads.

    Raises:
        ConfigError: a line is not what it should be; the message names `path` and the columns.
    """
    require(len(lines) == 2, path, f"expected two lines, got {len(lines)}")
    for number, line in enumerate(lines, start=1):
        where = f"{path}[{number - 1}]"
        require(line.isascii(), where, "a TLE line is plain ASCII text")
        require(len(line) == 69, where, f"a TLE line has 69 columns, got {len(line)}")
        require(line.startswith(f"{number} "), where, f"expected line {number}, got {line[:2]!r}")
        require(line[68].isdigit(), where, f"column 69 must be the checksum digit, got {line[68]!r}")
        expected = tle_checksum(line)
        require(
            expected == int(line[68]),
            where,
            f"checksum is {line[68]}, but the line adds up to {expected}: copy the elements again",
        )
    require(
        lines[0][2:7] == lines[1][2:7],
        path,
        f"the lines belong to different objects: {lines[0][2:7]} and {lines[1][2:7]}",
    )
    for number, first, last, name, form in TLE_FIELDS:
        text = lines[number - 1][first - 1 : last]
        where = f"{path}[{number - 1}]"
        require(
            re.fullmatch(form, text) is not None, where, f"columns {first}-{last} hold no {name}: {text!r}"
        )
