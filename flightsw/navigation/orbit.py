"""Where target, chaser and Sun are: SGP4 states in GCRS, the Sun from DE421, and the Earth's shadow.

TEME, kilometres and Julian dates stay in this file and in flightsw/icd.
"""

import atexit
import functools
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jplephem.spk import SPK
from sgp4.api import SGP4_ERRORS, Satrec

from flightsw.errors import OrbitError
from flightsw.icd.reference_frames import EARTH_RADIUS_M, TT_MINUS_UTC_S, julian_date, teme_to_gcrs

SUN_RADIUS_M = 6.957e8  # IAU 2015 nominal
# Sun, Earth and their barycentres, cut out of JPL's DE421 without a change of the coefficients (file size 2 of 17 MB):
# python -m jplephem excerpt --targets 3,10,399 2000/1/1 2053/10/9 de421.bsp de421_sun_2000_2053.bsp
EPHEMERIS = Path(__file__).parent / "de421_sun_2000_2053.bsp"
SHADOW_STEP_NS = 30_000_000_000


@dataclass(frozen=True)
class OrbitState:
    """A satellite's state in GCRS at one time."""

    position_m: np.ndarray  # [3]
    velocity_m_s: np.ndarray  # [3]
    utc_ns: int
    element_age_days: float  # time from the elements' epoch, negative before it


def propagate(tle: tuple[str, ...], utc_ns: int) -> OrbitState:
    """Return the SGP4 state of a TLE at a UTC time.

    Raises:
        OrbitError: SGP4 cannot read the elements, or refuses, for example because the orbit has decayed.
    """
    satellite = _satellite(tle)
    jd, fr = julian_date(utc_ns)
    code, position_km, velocity_km_s = satellite.sgp4(jd, fr)
    if code:
        reason = SGP4_ERRORS.get(code, f"error {code}")
        raise OrbitError(f"object {satellite.satnum} cannot be propagated to JD {jd + fr:.5f}: {reason}")
    if not np.isfinite(position_km).all():  # what SGP4 makes of a field that is no number
        raise OrbitError(f"the elements of object {satellite.satnum} are unreadable: {tle}")
    rotation = teme_to_gcrs(utc_ns)
    return OrbitState(
        position_m=rotation @ np.array(position_km) * 1e3,
        velocity_m_s=rotation @ np.array(velocity_km_s) * 1e3,
        utc_ns=utc_ns,
        element_age_days=(jd - satellite.jdsatepoch) + (fr - satellite.jdsatepochF),
    )


def sun_position_gcrs(utc_ns: int) -> np.ndarray:
    """Return the Sun's geometric position [3], m, GCRS, from DE421 (aberration, 20 arcsec, is left out).

    Raises:
        OrbitError: the time is outside the ephemeris (2000 to 2053).
    """
    jd, fr = julian_date(utc_ns)
    fr += TT_MINUS_UTC_S / 86_400
    kernel = _ephemeris()
    segments = (kernel[0, 10], kernel[0, 3], kernel[3, 399])
    if not all(segment.start_jd <= jd + fr <= segment.end_jd for segment in segments):
        raise OrbitError(
            f"the excerpt of DE421 covers JD {segments[0].start_jd} to {segments[0].end_jd}, not {jd + fr:.5f}"
        )
    sun, earth_moon, earth = (segment.compute(jd, fr) for segment in segments)
    return (sun - earth_moon - earth) * 1e3


def sun_direction_gcrs(utc_ns: int) -> np.ndarray:
    """Return the unit vector [3] from the Earth to the Sun in GCRS."""
    position_m = sun_position_gcrs(utc_ns)
    return position_m / np.linalg.norm(position_m)


def in_eclipse(position_m: np.ndarray, utc_ns: int) -> bool:
    """Tell whether the Earth hides more than half of the Sun's disc from a GCRS position [3]."""
    return sunlit_fraction(position_m, utc_ns) < 0.5


def sunlit_fraction(position_m: np.ndarray, utc_ns: int) -> float:
    """Return the part of the Sun's disc that is seen from a GCRS position [3]: 0 in the umbra, 1 in full sunlight.

    The Earth is a sphere without an atmosphere, which bends light into the umbra for some seconds more.

    Source: Montenbruck and Gill, Satellite Orbits, 3.4.2 (two overlapping circles on the sky).
    """
    to_sun = sun_position_gcrs(utc_ns) - position_m
    a = np.arcsin(SUN_RADIUS_M / np.linalg.norm(to_sun))  # apparent radius of the Sun, rad
    b = np.arcsin(min(1.0, EARTH_RADIUS_M / np.linalg.norm(position_m)))  # and of the Earth
    sine, cosine = np.linalg.norm(np.cross(to_sun, position_m)), -(to_sun @ position_m)
    c = np.arctan2(sine, cosine)  # angle between their centres
    if c >= a + b:
        return 1.0
    if c <= b - a:
        return 0.0
    if c <= a - b:  # annular, far behind the Earth
        return float(1 - (b / a) ** 2)
    x = (c**2 + a**2 - b**2) / (2 * c)
    y = np.sqrt(max(a**2 - x**2, 0.0))
    hidden = a**2 * np.arccos(np.clip(x / a, -1, 1)) + b**2 * np.arccos(np.clip((c - x) / b, -1, 1)) - c * y
    return float(1 - hidden / (np.pi * a**2))


def shadow_crossings(tle: tuple[str, ...], start_utc_ns: int, end_utc_ns: int) -> list[tuple[int, bool]]:
    """Return when a satellite enters (True) or leaves the Earth's shadow between two times, to 0.1 s.

    Shadows shorter than half a minute may be missed.

    Raises:
        OrbitError: as `propagate` and `sun_position_gcrs`.
    """

    def dark(utc_ns: int) -> bool:
        return in_eclipse(propagate(tle, utc_ns).position_m, utc_ns)

    crossings = []
    low, was_dark = start_utc_ns, dark(start_utc_ns)
    while low < end_utc_ns:
        high = min(low + SHADOW_STEP_NS, end_utc_ns)
        is_dark = dark(high)
        if is_dark != was_dark:
            lit_or_dark, at = low, high
            while at - lit_or_dark > 100_000_000:
                middle = (lit_or_dark + at) // 2
                lit_or_dark, at = (middle, at) if dark(middle) == was_dark else (lit_or_dark, middle)
            crossings.append((at, is_dark))
        low, was_dark = high, is_dark
    return crossings


@functools.lru_cache(maxsize=8)
def _satellite(tle: tuple[str, ...]) -> Satrec:
    try:
        return Satrec.twoline2rv(*tle)
    except ValueError as error:
        raise OrbitError(f"the elements cannot be read: {error}: {tle}") from error


@functools.lru_cache(maxsize=1)
def _ephemeris() -> SPK:
    kernel = SPK.open(str(EPHEMERIS))
    atexit.register(kernel.close)  # the file stays mapped for as long as the program runs
    return kernel
