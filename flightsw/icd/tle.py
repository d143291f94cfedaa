"""Two-line element sets: their checksum, the form of each field, and the axes of the orbit that they describe."""

import re

import numpy as np
from sgp4.api import SGP4_ERRORS, Satrec

from flightsw.icd.config import ConfigError, require
from flightsw.icd.reference_frames import julian_date, teme_to_gcrs

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


def position_gcrs_m(tle: tuple[str, ...], utc_ns: int) -> np.ndarray:
    """Return where a satellite is at a UTC time by SGP4: [3] m from the Earth's centre, GCRS.

    Raises:
        ConfigError: SGP4 cannot propagate the elements so far.
    """
    position_km, _ = _state(Satrec.twoline2rv(*tle), utc_ns)
    return teme_to_gcrs(utc_ns) @ position_km * 1e3


def orbit_axes(tle: tuple[str, ...], utc_ns: int) -> tuple[float, np.ndarray]:
    """Return the mean motion (rad/s) and the rotation [3, 3] from inertial to radial, transverse and normal axes.

    The inertial axes are those of SGP4 (true equator, mean equinox), which differ from GCRS by the precession since
    2000, 0.4 degrees in 2026: enough for the relative motion of two neighbouring orbits, not for their positions.

    Raises:
        ConfigError: SGP4 cannot propagate the elements so far.
    """
    satellite = Satrec.twoline2rv(*tle)
    position_km, velocity_km_s = _state(satellite, utc_ns)
    radial = position_km / np.linalg.norm(position_km)
    normal = np.cross(position_km, velocity_km_s)
    normal /= np.linalg.norm(normal)
    return satellite.no_kozai / 60, np.stack([radial, np.cross(normal, radial), normal])


def _state(satellite: Satrec, utc_ns: int) -> tuple[np.ndarray, np.ndarray]:
    """Return position (km) and velocity (km/s) in SGP4's axes."""
    code, position_km, velocity_km_s = satellite.sgp4(*julian_date(utc_ns))
    if code or not np.isfinite(position_km).all():
        reason = SGP4_ERRORS.get(code, f"error {code}")
        raise ConfigError("mission.orbit.target_tle", f"cannot be propagated: {reason}; load newer elements")
    return np.array(position_km), np.array(velocity_km_s)
