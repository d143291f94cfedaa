"""Relative orbits about a target: designed by the linear solution, and turned into a TLE for the chaser.

TEME, kilometres and SGP4's mean elements occur in this file and in flightsw/navigation/orbit.py only.
"""

import math
from dataclasses import dataclass

import numpy as np
from sgp4.api import WGS72, Satrec

from flightsw.icd.config import ConfigError
from flightsw.icd.tle import tle_checksum

CATALOGUE_NUMBER = 90001  # of the designed chaser; not assigned to any object
UNIX_EPOCH_JD = 2_440_587.5
SGP4_EPOCH_JD = 2_433_281.5  # 1949-12-31 00:00 UT
SAMPLES_PER_ORBIT = 72
EPOCH_TICK_DAYS = 1e-8  # last digit of a TLE's epoch: 0.9 ms, or 6.5 m along the orbit
ANGLE_TICK_DEG = 1e-4  # last digit of a TLE's angles: 12 m along the orbit
EPOCH_TICKS = 400  # enough epochs for one whose mean anomaly is within centimetres of a multiple of the tick


@dataclass(frozen=True)
class RelativeElements:
    """Relative orbital elements times the target's semi-major axis, m, at the scenario's start.

    Differences of semi-major axis, relative mean longitude, eccentricity vector (x, y) and inclination vector (x, y).

    Source: D'Amico, Autonomous Formation Flying in Low Earth Orbit, PhD thesis, TU Delft, 2010.
    """

    da_m: float = 0.0
    dlambda_m: float = 0.0
    dex_m: float = 0.0
    dey_m: float = 0.0
    dix_m: float = 0.0
    diy_m: float = 0.0


@dataclass(frozen=True)
class FlyAround:
    """A natural fly-around: a closed ellipse about the target, twice as long along the track as it is high.

    With the default out-of-plane amplitude (sqrt(3) times the radial one, in phase with it) the range is constant.
    Without drift the linear solution has no other closed orbits (Clohessy and Wiltshire, 1960).
    """

    radial_m: float  # half of the height; half of the length is twice as much
    out_of_plane_m: float = -1.0  # half of the width; negative: sqrt(3) times radial_m
    phase_deg: float = 0.0  # at the start; 0 is the highest point
    out_of_plane_phase_deg: float = 0.0  # how far the out-of-plane oscillation leads the radial one

    def __post_init__(self):
        if not self.radial_m > 0:
            raise ConfigError("scenario.fly_around.radial_m", f"must be positive, got {self.radial_m}")

    @property
    def half_width_m(self) -> float:
        return self.out_of_plane_m if self.out_of_plane_m >= 0 else math.sqrt(3) * self.radial_m

    def elements(self, latitude_rad: float) -> RelativeElements:
        """Return the relative elements of this ellipse if the target starts at this argument of latitude."""
        phi = latitude_rad - math.radians(self.phase_deg) + math.pi
        theta = phi + math.pi / 2 - math.radians(self.out_of_plane_phase_deg)
        return RelativeElements(
            dex_m=self.radial_m * math.cos(phi),
            dey_m=self.radial_m * math.sin(phi),
            dix_m=self.half_width_m * math.cos(theta),
            diy_m=self.half_width_m * math.sin(theta),
        )


@dataclass(frozen=True)
class Design:
    """A chaser's TLE, and how well its SGP4 motion follows the linear solution it was designed with."""

    chaser_tle: tuple[str, str]
    elements: RelativeElements
    period_s: float
    error_rms_m: float  # of the TLE's motion against the linear solution, over the whole span
    error_max_m: float
    unrounded_error_max_m: float  # without the rounding to a TLE's digits: the error of the linear solution
    drift_error_m_per_orbit: float  # of the mean along-track offset, against the intended drift


def linear_motion(
    elements: RelativeElements, latitude_rad: np.ndarray, elapsed_s: np.ndarray, rate_rad_s: float
) -> np.ndarray:
    """Return the chaser's position [N, 3], m, in the target's RTN frame, by the linear (Clohessy-Wiltshire) solution.

    Args:
        latitude_rad: [N] the target's argument of latitude.
        elapsed_s: [N] since the elements' time.
        rate_rad_s: the target's mean motion.

    Source: Clohessy and Wiltshire, Terminal Guidance System for Satellite Rendezvous, 1960; in relative orbital
    elements D'Amico and Montenbruck, Proximity Operations of Formation-Flying Spacecraft Using an
    Eccentricity/Inclination Vector Separation, 2006.
    """
    e, c, s = elements, np.cos(latitude_rad), np.sin(latitude_rad)
    radial = e.da_m - e.dex_m * c - e.dey_m * s
    along = e.dlambda_m - 1.5 * rate_rad_s * elapsed_s * e.da_m + 2 * (e.dex_m * s - e.dey_m * c)
    return np.stack([radial, along, e.dix_m * s - e.diy_m * c], axis=1)


def design(
    target_tle: tuple[str, ...], wanted: RelativeElements | FlyAround, start_utc_ns: int, span_s: float
) -> Design:
    """Return the chaser whose SGP4 motion follows a relative orbit from the start over a span (at least one orbit).

    The chaser's mean elements are fitted to the linear solution by least squares, then rounded to a TLE's digits. Its
    angles have steps of 12 m. Along the track the choice of the epoch compensates for that; in the node and in the
    inclination rounding errors of up to 6 m each remain.

    Raises:
        ConfigError: SGP4 cannot propagate the target.
    """
    target = _Target(target_tle, start_utc_ns, span_s)
    if isinstance(wanted, FlyAround):
        wanted = wanted.elements(target.latitude_rad[0])
    goal = linear_motion(wanted, target.latitude_rad, target.elapsed_s, target.rate_rad_s)
    start = np.array(list(vars(wanted).values()))
    values = start.copy()
    for _ in range(3):  # Gauss-Newton; nearly linear, so that the second step is below a millimetre
        here = target.relative_motion(target.chaser(values))
        columns = [
            (target.relative_motion(target.chaser(values + step)) - here).ravel() for step in np.eye(6)
        ]
        values += np.linalg.lstsq(np.stack(columns, axis=1), (goal - here).ravel())[0]
    unrounded = np.linalg.norm(target.relative_motion(target.chaser(values)) - goal, axis=1)
    tle = target.rounded_tle(values)
    flown = target.relative_motion(Satrec.twoline2rv(*tle))
    error = np.linalg.norm(flown - goal, axis=1)
    period_s = 2 * np.pi / target.rate_rad_s
    # A line through the moving average, over one orbit, of the along-track offset.
    offset = np.convolve(flown[:, 1] - goal[:, 1], np.ones(SAMPLES_PER_ORBIT) / SAMPLES_PER_ORBIT, "valid")
    drift = np.polyfit(np.arange(len(offset)), offset, 1)[0] * SAMPLES_PER_ORBIT if len(offset) > 1 else 0.0
    return Design(
        tle,
        wanted,
        float(period_s),
        float(np.sqrt((error**2).mean())),
        float(error.max()),
        float(unrounded.max()),
        float(drift),
    )


class _Target:
    """The target's SGP4 states over a span, and its mean elements."""

    def __init__(self, tle: tuple[str, ...], start_utc_ns: int, span_s: float):
        self.tle = tle
        self.satellite = Satrec.twoline2rv(*tle)
        period_s = 2 * np.pi / (self.satellite.no_kozai / 60)
        count = int(np.ceil(max(span_s / period_s, 1.25) * SAMPLES_PER_ORBIT)) + 1
        self.elapsed_s = np.arange(count) * period_s / SAMPLES_PER_ORBIT
        days, rest_ns = divmod(start_utc_ns, 86_400_000_000_000)
        self._jd = np.full(count, UNIX_EPOCH_JD + days)
        self._fr = rest_ns / 86_400e9 + self.elapsed_s / 86_400
        self.position_m, velocity_m_s = self._propagate(self.satellite)
        normal = np.cross(self.position_m, velocity_m_s)
        radial, normal = _unit(self.position_m), _unit(normal)
        self.rtn = np.stack([radial, np.cross(normal, radial), normal], axis=1)  # [N, 3, 3], TEME to RTN
        node = _unit(np.cross([0.0, 0.0, 1.0], normal))
        sine = (np.cross(node, radial) * normal).sum(axis=1)
        latitude = np.unwrap(np.arctan2(sine, (node * radial).sum(axis=1)))
        self.rate_rad_s, first = np.polyfit(self.elapsed_s, latitude, 1)
        self.latitude_rad = first + self.rate_rad_s * self.elapsed_s
        self.semi_major_m = self.satellite.a * self.satellite.radiusearthkm * 1e3
        epoch_jd = self.satellite.jdsatepoch + self.satellite.jdsatepochF
        self.start_after_epoch_s = float((self._jd[0] - epoch_jd + self._fr[0]) * 86_400)

    def _propagate(self, satellite: Satrec) -> tuple[np.ndarray, np.ndarray]:
        codes, position_km, velocity_km_s = satellite.sgp4_array(self._jd, self._fr)
        if codes.any() or not np.isfinite(position_km).all():
            raise ConfigError("scenario.target_tle", "SGP4 cannot propagate these elements over the scenario")
        return position_km * 1e3, velocity_km_s * 1e3

    def relative_motion(self, chaser: Satrec) -> np.ndarray:
        """Return a chaser's place [N, 3], m, RTN."""
        return np.einsum("nij,nj->ni", self.rtn, self._propagate(chaser)[0] - self.position_m)

    def chaser(self, values: np.ndarray) -> Satrec:
        """Return the chaser with these relative elements [6], m, at the target's epoch, without rounding."""
        n, e, i, raan, argp, anomaly = self._mean_elements(values)
        s, satellite = self.satellite, Satrec()
        epoch_days = s.jdsatepoch - SGP4_EPOCH_JD + s.jdsatepochF
        satellite.sgp4init(
            WGS72, "i", CATALOGUE_NUMBER, epoch_days, s.bstar, s.ndot, s.nddot, e, argp, i, anomaly, n, raan
        )
        return satellite

    def _mean_elements(self, values: np.ndarray) -> tuple[float, ...]:
        """Return mean motion rad/min, eccentricity, inclination, node, perigee and mean anomaly, rad."""
        s = self.satellite
        da, dlambda, dex, dey, dix, diy = values / self.semi_major_m
        dlambda += 1.5 * self.rate_rad_s * self.start_after_epoch_s * da  # back to the epoch
        ex, ey = s.ecco * np.cos(s.argpo) + dex, s.ecco * np.sin(s.argpo) + dey
        raan = s.nodeo + diy / np.sin(s.inclo)
        argp = np.arctan2(ey, ex)
        latitude = s.argpo + s.mo + dlambda - (raan - s.nodeo) * np.cos(s.inclo)
        n = s.no_kozai * (1 + da) ** -1.5
        return n, float(np.hypot(ex, ey)), s.inclo + dix, raan, float(argp), latitude - float(argp)

    def rounded_tle(self, values: np.ndarray) -> tuple[str, str]:
        """Return these elements as a TLE whose epoch is up to 0.4 s later, where the anomaly is rounded least."""
        n, e, i, raan, argp, anomaly = self._mean_elements(values)
        degrees = np.degrees([i, raan, argp])
        i_deg, raan_deg, argp_deg = np.round(degrees / ANGLE_TICK_DEG) * ANGLE_TICK_DEG
        # Rounding the node and the perigee moves the chaser along its track: the anomaly compensates for it.
        anomaly_deg = np.degrees(anomaly) + (degrees[2] - argp_deg) + (degrees[1] - raan_deg) * np.cos(i)
        ticks = np.arange(EPOCH_TICKS)
        # The rate of the argument of latitude, J2 included; perigee and node hardly change in milliseconds.
        rate_deg_day = np.degrees(self.satellite.mdot + self.satellite.argpdot) * 1440
        at_epochs = anomaly_deg + rate_deg_day * EPOCH_TICK_DAYS * ticks
        steps = at_epochs / ANGLE_TICK_DEG
        best = int(np.abs(steps - np.round(steps)).argmin())
        first, second = self.tle
        year, day = first[18:20], float(first[20:32]) + EPOCH_TICK_DAYS * best
        line1 = f"1 {CATALOGUE_NUMBER:05d}{first[7:18]}{year}{day:012.8f}{first[32:68]}"
        line2 = (
            f"2 {CATALOGUE_NUMBER:05d} {i_deg:8.4f} {raan_deg % 360:8.4f} {round(e * 1e7):07d} {argp_deg % 360:8.4f} "
            f"{np.round(steps[best]) * ANGLE_TICK_DEG % 360:8.4f} {n * 1440 / (2 * np.pi):11.8f}{second[63:68]}"
        )
        return line1 + str(tle_checksum(line1)), line2 + str(tle_checksum(line2))


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)
