"""Where target, chaser and Sun are: SGP4 states in GCRS, the Sun from DE421, and the Earth's shadow.

The only file that sees TEME, kilometres and Julian dates.
"""

import atexit
import functools
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jplephem.spk import SPK
from sgp4.api import SGP4_ERRORS, Satrec

from flightsw.errors import OrbitError

UNIX_EPOCH_JD = 2_440_587.5
DAY_NS = 86_400_000_000_000
TT_MINUS_UTC_S = 69.184  # 37 leap seconds + 32.184 s; true since 2017-01-01
EARTH_RADIUS_M = 6_378_137.0  # WGS 84
SUN_RADIUS_M = 6.957e8  # IAU 2015 nominal
ARCSEC_RAD = np.pi / 648_000
# Sun, Earth and their barycentres, cut out of JPL's DE421 without a change of the coefficients (file size 2 of 17 MB):
# python -m jplephem excerpt --targets 3,10,399 2000/1/1 2053/10/9 de421.bsp de421_sun_2000_2053.bsp
EPHEMERIS = Path(__file__).parent / "de421_sun_2000_2053.bsp"
SHADOW_STEP_NS = 30_000_000_000

# The 13 largest terms of the IAU 1980 nutation (D, M, M', F, node; psi, psi per century, eps, eps per century, 1e-4
# arcsec); the rest adds up to less than 0.03 arcsec. Source: Seidelmann 1982, as tabulated by Meeus, ch. 22.
NUTATION_TERMS = np.array(
    [
        (0, 0, 0, 0, 1, -171996, -174.2, 92025, 8.9),
        (-2, 0, 0, 2, 2, -13187, -1.6, 5736, -3.1),
        (0, 0, 0, 2, 2, -2274, -0.2, 977, -0.5),
        (0, 0, 0, 0, 2, 2062, 0.2, -895, 0.5),
        (0, 1, 0, 0, 0, 1426, -3.4, 54, -0.1),
        (0, 0, 1, 0, 0, 712, 0.1, -7, 0),
        (-2, 1, 0, 2, 2, -517, 1.2, 224, -0.6),
        (0, 0, 0, 2, 1, -386, -0.4, 200, 0),
        (0, 0, 1, 2, 2, -301, 0, 129, -0.1),
        (-2, -1, 0, 2, 2, 217, -0.5, -95, 0.3),
        (-2, 0, 1, 0, 0, -158, 0, 0, 0),
        (-2, 0, 0, 2, 1, 129, 0.1, -70, 0),
        (0, 0, -1, 2, 2, 123, 0, -53, 0),
    ]
)


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
    jd, fr = _julian_date(utc_ns)
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
    jd, fr = _julian_date(utc_ns)
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


def teme_to_gcrs(utc_ns: int) -> np.ndarray:
    """Return the rotation [3, 3] from TEME to GCRS (J2000; the 0.02 arcsec frame bias is left out).

    Source: Vallado, Fundamentals of Astrodynamics, IAU 1976 precession and IAU 1980 nutation (truncated, above).
    """
    jd, fr = _julian_date(utc_ns)
    T = ((jd - 2_451_545.0) + fr + TT_MINUS_UTC_S / 86_400) / 36_525
    zeta = (2306.2181 * T + 0.30188 * T**2 + 0.017998 * T**3) * ARCSEC_RAD
    z = (2306.2181 * T + 1.09468 * T**2 + 0.018203 * T**3) * ARCSEC_RAD
    theta = (2004.3109 * T - 0.42665 * T**2 - 0.041833 * T**3) * ARCSEC_RAD
    j2000_to_mod = _rotation(2, -z) @ _rotation(1, theta) @ _rotation(2, -zeta)

    arguments = np.radians(
        [
            297.85036 + 445267.111480 * T - 0.0019142 * T**2,
            357.52772 + 35999.050340 * T - 0.0001603 * T**2,
            134.96298 + 477198.867398 * T + 0.0086972 * T**2,
            93.27191 + 483202.017538 * T - 0.0036825 * T**2,
            125.04452 - 1934.136261 * T + 0.0020708 * T**2,
        ]
    )
    phase = NUTATION_TERMS[:, :5] @ arguments
    dpsi = float(np.sin(phase) @ (NUTATION_TERMS[:, 5] + NUTATION_TERMS[:, 6] * T)) * 1e-4 * ARCSEC_RAD
    deps = float(np.cos(phase) @ (NUTATION_TERMS[:, 7] + NUTATION_TERMS[:, 8] * T)) * 1e-4 * ARCSEC_RAD
    epsilon = (84381.448 - 46.8150 * T) * ARCSEC_RAD
    mod_to_tod = _rotation(0, -epsilon - deps) @ _rotation(2, -dpsi) @ _rotation(0, epsilon)
    teme_to_tod = _rotation(2, -dpsi * np.cos(epsilon))
    return (mod_to_tod @ j2000_to_mod).T @ teme_to_tod


def _rotation(axis: int, angle_rad: float) -> np.ndarray:
    """Return the rotation [3, 3] of the coordinate axes by an angle about axis 0, 1 or 2."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    matrix = np.eye(3)
    matrix[i, i] = matrix[j, j] = c
    matrix[i, j], matrix[j, i] = s, -s
    return matrix


def _julian_date(utc_ns: int) -> tuple[float, float]:
    days, rest_ns = divmod(utc_ns, DAY_NS)
    return UNIX_EPOCH_JD + days, rest_ns / DAY_NS


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
