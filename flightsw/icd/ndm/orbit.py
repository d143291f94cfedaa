"""The orbit of one object: an ephemeris (OEM), one state (OPM), or mean elements (OMM), at any time that they cover.

States are in metres in GCRS axes, relative to the centre that the message names.
"""

import bisect
import functools
import re
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from sgp4 import omm
from sgp4.api import SGP4_ERRORS, Satrec
from sgp4.exporter import export_tle

from flightsw.icd.config import ConfigError
from flightsw.icd.ndm.axes import INERTIAL, LOCAL, inertial_frame, local_axes, to_gcrs
from flightsw.icd.ndm.interpolation import hermite, lagrange, neighbours
from flightsw.icd.ndm.text import Message, Row, Section, Segment, read_messages
from flightsw.icd.ndm.times import NS, SYSTEMS, epoch_text, parse_epoch, tai_ns, utc_ns
from flightsw.icd.reference_frames import julian_date, teme_to_gcrs
from obbgs_base.errors import ObbgsError

META_KEYS = {
    **dict.fromkeys(("OBJECT_NAME", "OBJECT_ID", "CENTER_NAME", "REF_FRAME", "TIME_SYSTEM"), True),
    "REF_FRAME_EPOCH": False,
}
SPAN_KEYS = {"START_TIME": True, "STOP_TIME": True, "USEABLE_START_TIME": False, "USEABLE_STOP_TIME": False}
OEM_KEYS = {**META_KEYS, **SPAN_KEYS, "INTERPOLATION": False, "INTERPOLATION_DEGREE": False}
AXES = ("X", "Y", "Z", "X_DOT", "Y_DOT", "Z_DOT")
STATE_UNITS = {**dict.fromkeys(AXES[:3], "km"), **dict.fromkeys(AXES[3:], "km/s")}
WITH_ACCELERATION = {**STATE_UNITS, **dict.fromkeys(("X_DDOT", "Y_DDOT", "Z_DDOT"), "km/s**2")}
COVARIANCE_UNITS = {
    f"C{AXES[i]}_{AXES[j]}": ("km**2", "km**2/s", "km**2/s**2")[(i > 2) + (j > 2)]
    for i in range(6)
    for j in range(i + 1)
}
MOST_DEGREE = 25
DEFAULT_DEGREE = 3  # of Hermite, where the file names none
SPACECRAFT_KEYS = ("MASS", "SOLAR_RAD_AREA", "SOLAR_RAD_COEFF", "DRAG_AREA", "DRAG_COEFF")
OPM_KEYS = {
    **META_KEYS,
    **dict.fromkeys(("EPOCH", *AXES), True),
    **dict.fromkeys(("SEMI_MAJOR_AXIS", "ECCENTRICITY", "INCLINATION", "RA_OF_ASC_NODE"), False),
    **dict.fromkeys(("ARG_OF_PERICENTER", "TRUE_ANOMALY", "MEAN_ANOMALY", "GM", "COV_REF_FRAME"), False),
    **dict.fromkeys((*SPACECRAFT_KEYS, *COVARIANCE_UNITS), False),
}
ELEMENTS = {
    "MEAN_MOTION": "rev/day",
    "ECCENTRICITY": "",
    "INCLINATION": "deg",
    "RA_OF_ASC_NODE": "deg",
    "ARG_OF_PERICENTER": "deg",
    "MEAN_ANOMALY": "deg",
    "BSTAR": "1/ER",
    "MEAN_MOTION_DOT": "rev/day**2",
    "MEAN_MOTION_DDOT": "rev/day**3",
}
# what SGP4 does not use, as two-line elements have it by default
UNUSED_ELEMENTS = {
    "EPHEMERIS_TYPE": "0",
    "CLASSIFICATION_TYPE": "U",
    "ELEMENT_SET_NO": "999",
    "REV_AT_EPOCH": "0",
}
OMM_KEYS = {
    **META_KEYS,
    **dict.fromkeys(("MEAN_ELEMENT_THEORY", "EPOCH", "NORAD_CAT_ID", *ELEMENTS), True),
    **dict.fromkeys((*UNUSED_ELEMENTS, *SPACECRAFT_KEYS, "GM", "COV_REF_FRAME", *COVARIANCE_UNITS), False),
}
GM_M3_S2 = 3.986004418e14
J2, EARTH_RADIUS_M = 1.08262668e-3, 6_378_136.3  # EGM96
STEP_S = 5.0  # of the fourth-order method
LONGEST_S = 7200.0  # from a single state; drag and the Earth's shape beyond J2 then count


class NoState(ObbgsError):
    """A message does not cover the time that was asked for."""


@dataclass(frozen=True, eq=False)
class State:
    """Position and velocity in GCRS axes relative to a centre at one time."""

    position_m: np.ndarray  # [3]
    velocity_m_s: np.ndarray  # [3]
    covariance: np.ndarray | None  # [6, 6] position m, velocity m/s


@dataclass(frozen=True)
class Orbit:
    """The orbit of one object about a centre, which is `EARTH` or another object."""

    kind: str
    object_name: str
    object_id: str
    centre: str
    at: Callable[[int], State]  # UTC, Unix ns; raises NoState
    spans: tuple[tuple[int, int], ...]  # UTC, Unix ns, first and last of each


@dataclass(frozen=True, eq=False)
class _Table:
    """A segment of an OEM."""

    tai_ns: list[int]  # [N]
    states: np.ndarray  # [N, 6] m, m/s, in its frame
    frame: str
    is_hermite: bool
    count: int  # of the neighbours in use
    start_ns: int
    stop_ns: int
    covariances: list[tuple[int, str, np.ndarray]]  # time, frame, [6, 6] m and m/s


def read_orbit(message: Message) -> Orbit:
    """Return the orbit in an OEM, OPM or OMM.

    Raises:
        ConfigError: a key or value is missing, unknown or not one that we can use; the message says what was expected.
    """
    first = message.segments[0].meta
    if message.kind == "OEM":
        _same_object(message)
        tables = [_table(segment) for segment in message.segments]
        check_order([(t.start_ns, t.stop_ns) for t in tables], message)
        spans = tuple((utc_ns(t.start_ns), utc_ns(t.stop_ns)) for t in tables)
        at = functools.partial(_interpolated, tables)
    elif message.kind == "OPM":
        at, spans = _of_state(first)
    else:
        at, spans = _of_elements(first)
    centre = " ".join(first.text("CENTER_NAME").upper().split())
    return Orbit(message.kind, first.text("OBJECT_NAME"), first.text("OBJECT_ID"), centre, at, spans)


def _same_object(message: Message) -> None:
    first = message.segments[0].meta
    for segment in message.segments:
        for key in ("OBJECT_NAME", "OBJECT_ID", "CENTER_NAME"):
            if segment.meta.text(key) != first.text(key):
                got = f"expected {first.text(key)!r} as before, got {segment.meta.text(key)!r}"
                raise ConfigError(f"{segment.meta.where}, {key}", got)


def check_order(spans: list[tuple[int, int]], message: Message) -> None:
    """Check that the useable spans of segments follow one another; they may share an end.

    Raises:
        ConfigError: they do not.
    """
    for (_, stop), (start, _), segment in zip(spans, spans[1:], message.segments[1:], strict=False):
        if start < stop:
            raise ConfigError(
                segment.meta.where,
                f"this segment begins at {epoch_text(start)} UTC, before the one before it ends; expected segments "
                "in the order of time, with USEABLE_START_TIME and USEABLE_STOP_TIME where they overlap",
            )


def span(segment: Segment, times: list[int], system: str) -> tuple[int, int]:
    """Return from when to when a segment may be used: what its metadata say, within its own rows.

    Raises:
        ConfigError: times do not increase, or nothing is left.
    """
    meta = segment.meta
    for (epoch, _), before, now in zip(segment.data.rows[1:], times, times[1:], strict=False):
        if now <= before:
            raise ConfigError(epoch.where, f"expected a time after the one before it, got {epoch.text}")
    said = {key: parse_epoch(meta.values[key], system) for key in SPAN_KEYS if key in meta.values}
    start = max(times[0], said["START_TIME"], said.get("USEABLE_START_TIME", times[0]))
    stop = min(times[-1], said["STOP_TIME"], said.get("USEABLE_STOP_TIME", times[-1]))
    if start > stop:
        raise ConfigError(
            meta.where,
            f"nothing of the segment is useable: it starts at {epoch_text(start)} and stops before that",
        )
    return start, stop


def degree(meta: Section, default: int) -> int:
    """Return INTERPOLATION_DEGREE.

    Raises:
        ConfigError: it is no whole number from 1 to 25.
    """
    key = "INTERPOLATION_DEGREE"
    if key not in meta.values:
        return default
    text = meta.text(key)
    if not (text.isascii() and text.isdecimal() and 1 <= int(text) <= MOST_DEGREE):
        raise ConfigError(
            f"{meta.values[key].where}, {key}",
            f"expected a whole number from 1 to {MOST_DEGREE}, got {text[:20]!r}",
        )
    return int(text)


def enough(segment: Segment, count: int) -> None:
    if len(segment.data.rows) < count:
        raise ConfigError(
            segment.meta.where,
            f"its interpolation needs {count} rows, but the segment has {len(segment.data.rows)}: give more, or a "
            "lower INTERPOLATION_DEGREE",
        )


def _table(segment: Segment) -> _Table:
    meta = segment.meta
    meta.check(OEM_KEYS)
    system, frame = meta.choice("TIME_SYSTEM", SYSTEMS), _orbit_frame(meta)
    if not segment.data.rows:
        raise ConfigError(meta.where, "a segment without states")
    times = [parse_epoch(epoch, system) for epoch, _ in segment.data.rows]
    states = np.array([_state(row) for _, row in segment.data.rows])
    start, stop = span(segment, times, system)
    method = meta.choice("INTERPOLATION", ("LAGRANGE", "HERMITE", "LINEAR"), "HERMITE")
    count = degree(meta, 1 if method == "LINEAR" else DEFAULT_DEGREE) + 1
    if method == "LINEAR" and count != 2:
        raise ConfigError(meta.where, f"expected LINEAR to have INTERPOLATION_DEGREE 1, got {count - 1}")
    if method == "HERMITE":
        count = (count + 1) // 2  # each with its velocity
    if "INTERPOLATION" not in meta.values and len(times) == 1:
        count = 1
    enough(segment, count)
    covariances = [_covariance(section, frame, system) for section in segment.covariances]
    covariances.sort(key=lambda covariance: covariance[0])
    return _Table(times, states, frame, method == "HERMITE", count, start, stop, covariances)


def _orbit_frame(meta: Section) -> str:
    frame = inertial_frame(meta, "REF_FRAME")
    if frame == "TEME" and "REF_FRAME_EPOCH" in meta.values:
        raise ConfigError(
            f"{meta.where}, REF_FRAME_EPOCH", "TEME is read as that of date: convert to EME2000 or GCRF"
        )
    return frame


def _state(row: Row) -> np.ndarray:
    """Return a row's position (m) and velocity (m/s) [6]; accelerations are not used."""
    names = row.names or ()
    units = WITH_ACCELERATION if len(row.values) == 9 or "X_DDOT" in names else STATE_UNITS
    return 1e3 * np.array(row.numbers(units)[:6])


def _covariance(section: Section, frame: str, system: str) -> tuple[int, str, np.ndarray]:
    """Return time, frame and covariance [6, 6], m and m/s, of a block of an OEM."""
    section.check({"EPOCH": True, "COV_REF_FRAME": False})
    frame = _covariance_frame(section, frame)
    if len(section.rows) == 1 and section.rows[0][1].names is not None:
        numbers = section.rows[0][1].numbers(COVARIANCE_UNITS)
    else:
        sizes = [len(row.values) for _, row in section.rows]
        if sizes != [1, 2, 3, 4, 5, 6]:
            raise ConfigError(
                section.where, f"expected rows of 1, 2, 3, 4, 5 and 6 numbers, got rows of {sizes}"
            )
        numbers = [value.number() for _, row in section.rows for value in row.values]
    return parse_epoch(section.values["EPOCH"], system), frame, _symmetric(numbers, section.where)


def _covariance_frame(section: Section, frame: str) -> str:
    return section.choice("COV_REF_FRAME", (*INERTIAL, *LOCAL), frame)


def _symmetric(lower: list[float], where: str) -> np.ndarray:
    matrix = np.zeros((6, 6))
    matrix[np.tril_indices(6)] = lower
    matrix = 1e6 * (matrix + np.tril(matrix, -1).T)
    deviations = np.sqrt(np.maximum(np.diag(matrix), 1e-30))
    if np.linalg.eigvalsh(matrix / np.outer(deviations, deviations))[0] < -1e-6:
        raise ConfigError(where, "expected a positive semi-definite covariance (km, km/s)")
    return matrix


def _interpolated(tables: list[_Table], utc: int) -> State:
    at_ns = tai_ns(utc)
    table = tables[covering([(t.start_ns, t.stop_ns) for t in tables], at_ns)]
    near = neighbours(table.tai_ns, at_ns, table.count)
    times_s = np.array([t - table.tai_ns[near.start] for t in table.tai_ns[near]]) / NS
    at_s, states = (at_ns - table.tai_ns[near.start]) / NS, table.states[near]
    if table.is_hermite:
        position, velocity = hermite(times_s, states[:, :3], states[:, 3:], at_s)
    else:
        position, velocity = np.split(lagrange(times_s, states, at_s), 2)
    turn = to_gcrs(table.frame, utc)
    state = State(turn @ position, turn @ velocity, None)
    return State(state.position_m, state.velocity_m_s, _covariance_at(table.covariances, at_ns, utc, state))


def covering(spans: list[tuple[int, int]], at_ns: int) -> int:
    """Return the last of the segments that cover a time.

    Raises:
        NoState: none does.
    """
    found = [number for number, (start, stop) in enumerate(spans) if start <= at_ns <= stop]
    if not found:
        shown = "; ".join(f"{epoch_text(start)} to {epoch_text(stop)}" for start, stop in spans[:3])
        more = f" and {len(spans) - 3} more" if len(spans) > 3 else ""
        raise NoState(f"nothing at {epoch_text(at_ns)} UTC: the message covers {shown}{more}")
    return found[-1]


def _covariance_at(
    covariances: list[tuple[int, str, np.ndarray]], at_ns: int, utc: int, state: State
) -> np.ndarray | None:
    """Return the weighted mean of the covariances around a time, or the nearest, in GCRS axes; None without any."""
    if not covariances:
        return None
    times = [time for time, _, _ in covariances]
    after = bisect.bisect_left(times, at_ns)
    around = covariances[max(after - 1, 0) : after + 1]
    turned = [_turned(matrix, frame, utc, state) for _, frame, matrix in around]
    if len(turned) == 1:
        return turned[0]
    share = (at_ns - around[0][0]) / (around[1][0] - around[0][0]) if around[1][0] > around[0][0] else 1.0
    return (1 - share) * turned[0] + share * turned[1]


def _turned(covariance: np.ndarray, frame: str, utc: int, state: State) -> np.ndarray:
    if frame in LOCAL:
        turn = local_axes(frame, state.position_m, state.velocity_m_s).T
    else:
        turn = to_gcrs(frame, utc)
    both = np.kron(np.eye(2), turn)
    return both @ covariance @ both.T


def _of_state(meta: Section) -> tuple[Callable[[int], State], tuple[tuple[int, int], ...]]:
    """Return how an OPM's state goes on, by the Earth's attraction and its oblateness, and for how long."""
    meta.check({**OPM_KEYS, **_user_defined(meta)})
    epoch_ns = parse_epoch(meta.values["EPOCH"], meta.choice("TIME_SYSTEM", SYSTEMS))
    epoch_utc, frame = utc_ns(epoch_ns), _orbit_frame(meta)
    turn = to_gcrs(frame, epoch_utc)
    numbers = [meta.values[name].number(unit, name) for name, unit in STATE_UNITS.items()]
    start = np.concatenate([turn @ numbers[:3], turn @ numbers[3:]]) * 1e3
    state, covariance = State(start[:3], start[3:], None), None
    if set(COVARIANCE_UNITS) & set(meta.values):
        meta.check({**dict.fromkeys(meta.values, False), **dict.fromkeys(COVARIANCE_UNITS, True)})
        lower = [meta.values[name].number(unit, name) for name, unit in COVARIANCE_UNITS.items()]
        covariance = _turned(_symmetric(lower, meta.where), _covariance_frame(meta, frame), epoch_utc, state)
    pole = teme_to_gcrs(epoch_utc)[:, 2]

    def at(utc: int) -> State:
        seconds = (tai_ns(utc) - epoch_ns) / NS
        if abs(seconds) > LONGEST_S:
            raise NoState(
                f"{abs(seconds):.0f} s from the state of {epoch_text(epoch_ns)} UTC; expected at most {LONGEST_S:.0f} "
                "s: send an OEM"
            )
        moved = _with_oblateness(start, seconds, pole)
        return State(moved[:3], moved[3:], covariance if seconds == 0 else None)

    return at, ((epoch_utc - round(LONGEST_S * NS), epoch_utc + round(LONGEST_S * NS)),)


def _with_oblateness(state: np.ndarray, seconds: float, pole: np.ndarray) -> np.ndarray:
    """Return a state [6] some seconds later under the Earth's attraction with J2, by Runge and Kutta's method."""

    def slope(at: np.ndarray) -> np.ndarray:
        r2 = at[:3] @ at[:3]
        up = at[:3] @ pole
        ratio = 1.5 * J2 * EARTH_RADIUS_M**2 / r2
        pull = at[:3] * (1 + ratio * (1 - 5 * up**2 / r2)) + 2 * ratio * up * pole
        return np.concatenate([at[3:], -GM_M3_S2 / r2**1.5 * pull])

    steps = max(1, int(np.ceil(abs(seconds) / STEP_S)))
    h = seconds / steps
    for _ in range(steps):
        a = slope(state)
        b = slope(state + h / 2 * a)
        c = slope(state + h / 2 * b)
        d = slope(state + h * c)
        state = state + h / 6 * (a + 2 * b + 2 * c + d)
    return state


def satellite(meta: Section) -> Satrec:
    """Return the SGP4 satellite of an OMM.

    Raises:
        ConfigError: its elements are not those of SGP4.
    """
    meta.check({**OMM_KEYS, **_user_defined(meta)})
    meta.choice("MEAN_ELEMENT_THEORY", ("SGP4", "SGP/SGP4"))
    meta.choice("REF_FRAME", ("TEME",))
    meta.choice("CENTER_NAME", ("EARTH",))
    epoch_ns = parse_epoch(meta.values["EPOCH"], meta.choice("TIME_SYSTEM", ("UTC",)))
    fields = {name: str(meta.values[name].number(unit, name)) for name, unit in ELEMENTS.items()}
    for name, default in {"NORAD_CAT_ID": "", **UNUSED_ELEMENTS}.items():
        fields[name] = meta.text(name, default)
    digits = [name for name in ("NORAD_CAT_ID", "EPHEMERIS_TYPE", "ELEMENT_SET_NO", "REV_AT_EPOCH")]
    for name in digits:
        if not re.fullmatch(r"\d{1,9}", fields[name], re.ASCII):
            raise ConfigError(f"{meta.where}, {name}", f"expected a whole number, got {fields[name][:20]!r}")
    fields["OBJECT_ID"] = meta.text("OBJECT_ID")
    fields["EPOCH"] = epoch_text(epoch_ns)[:-3]  # microseconds
    found = Satrec()
    try:
        omm.initialize(found, fields)
    except ValueError as error:
        raise ConfigError(meta.where, f"SGP4 does not take these elements: {error}") from error
    return found


def two_lines(content: bytes) -> tuple[str, str]:
    """Return the two-line elements that say what an OMM says, in their fewer digits.

    Raises:
        ConfigError: it is no OMM, or not of SGP4.
    """
    message = read_messages(content)[0]
    if message.kind != "OMM":
        raise ConfigError("message", f"expected an OMM, which has mean elements, got an {message.kind}")
    try:
        first, second = export_tle(satellite(message.segments[0].meta))
    except ValueError as error:
        raise ConfigError("message", f"has no two-line elements: {error}") from error
    return first, second


def _of_elements(meta: Section) -> tuple[Callable[[int], State], tuple[tuple[int, int], ...]]:
    found = satellite(meta)

    def at(utc: int) -> State:
        code, position_km, velocity_km_s = found.sgp4(*julian_date(utc))
        if code or not np.isfinite(position_km).all():
            raise NoState(
                f"SGP4 refuses the elements at {epoch_text(tai_ns(utc))}: {SGP4_ERRORS.get(code, code)}"
            )
        turn = teme_to_gcrs(utc)
        return State(1e3 * turn @ np.array(position_km), 1e3 * turn @ np.array(velocity_km_s), None)

    return at, ()


def _user_defined(meta: Section) -> dict[str, bool]:
    return {key: False for key in meta.values if key.startswith("USER_DEFINED_")}
