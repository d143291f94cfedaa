"""Axes that point to the stars: TEME, the axes of J2000 (EME2000) and those of GCRS, at a UTC time."""

import numpy as np

UNIX_EPOCH_JD = 2_440_587.5
DAY_NS = 86_400_000_000_000
TT_MINUS_UTC_S = 69.184  # 37 leap seconds + 32.184 s; true since 2017-01-01
ARCSEC_RAD = np.pi / 648_000
EARTH_RADIUS_M = 6_378_137.0  # WGS 84
# where the pole and the origin of right ascension of J2000 lie in GCRS (IERS Conventions 2010, 5.21 and 5.33), arcsec
POLE_X, POLE_Y, RIGHT_ASCENSION = -0.016617, -0.0068192, -0.0146

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


def julian_date(utc_ns: int) -> tuple[float, float]:
    """Return the Julian date of a UTC time as days and the rest, which together have no rounding of days."""
    days, rest_ns = divmod(utc_ns, DAY_NS)
    return UNIX_EPOCH_JD + days, rest_ns / DAY_NS


def eme2000_to_gcrs() -> np.ndarray:
    """Return the rotation [3, 3] from the mean equator and equinox of J2000 to GCRS: the frame bias, 0.02 arcsec."""
    bias = (
        _rotation(0, -POLE_Y * ARCSEC_RAD)
        @ _rotation(1, POLE_X * ARCSEC_RAD)
        @ _rotation(2, RIGHT_ASCENSION * ARCSEC_RAD)
    )
    return bias.T


def teme_to_gcrs(utc_ns: int) -> np.ndarray:
    """Return the rotation [3, 3] from TEME to GCRS (J2000; the 0.02 arcsec frame bias is left out).

    Source: Vallado, Fundamentals of Astrodynamics, IAU 1976 precession and IAU 1980 nutation (truncated, above).
    """
    jd, fr = julian_date(utc_ns)
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


def low_precision_sun(utc_ns: int) -> np.ndarray:
    """Return the unit vector [3] from the Earth to the Sun, GCRS, within 0.01 degrees from 1950 to 2050.

    Source: Astronomical Almanac, low-precision formulas, with the longitude counted from the equinox of J2000. Flight
    has the Sun from DE421 (flightsw/navigation/orbit.py).
    """
    jd, fr = julian_date(utc_ns)
    days = (jd - 2_451_545.0) + fr
    anomaly = np.radians(357.528 + 0.9856003 * days)
    longitude = np.radians(280.460 + 0.9856474 * days - 3.8246e-5 * days)
    longitude += np.radians(1.915 * np.sin(anomaly) + 0.020 * np.sin(2 * anomaly))
    obliquity = np.radians(23.4393)
    return np.array(
        [np.cos(longitude), np.cos(obliquity) * np.sin(longitude), np.sin(obliquity) * np.sin(longitude)]
    )
