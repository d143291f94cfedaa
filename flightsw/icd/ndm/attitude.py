"""The attitude of one object: the rows of an AEM at any time that they cover.

An AEM's quaternion turns the axes of A into those of B; as the rotation of coordinates that this project uses
(`quat_a_to_b`) it is the conjugate. Rows are interpolated as quaternions, whatever form they have in the file: LINEAR
along the shortest arc, LAGRANGE and HERMITE component by component.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from flightsw.icd.config import ConfigError
from flightsw.icd.ndm.axes import INERTIAL, LOCAL, RADIAL, is_other, local_axes, to_gcrs
from flightsw.icd.ndm.interpolation import hermite, lagrange, neighbours
from flightsw.icd.ndm.orbit import SPAN_KEYS, State, check_order, covering, degree, enough, span
from flightsw.icd.ndm.text import Message, Section, Segment
from flightsw.icd.ndm.times import NS, SYSTEMS, parse_epoch, tai_ns, utc_ns
from flightsw.icd.quaternion import matrix_to_quat, quat_to_matrix, slerp

COMMON_KEYS = {
    **dict.fromkeys(
        ("OBJECT_NAME", "OBJECT_ID", "REF_FRAME_A", "REF_FRAME_B", "TIME_SYSTEM", "ATTITUDE_TYPE"), True
    ),
    **SPAN_KEYS,
    **dict.fromkeys(("CENTER_NAME", "EULER_ROT_SEQ", "INTERPOLATION_METHOD", "INTERPOLATION_DEGREE"), False),
}
KEYS = {
    "1.0": {**COMMON_KEYS, "ATTITUDE_DIR": True, "QUATERNION_TYPE": False, "RATE_FRAME": False},
    "2.0": {**COMMON_KEYS, "ANGVEL_FRAME": False},
}
QUATERNION = dict.fromkeys(("Q1", "Q2", "Q3", "QC"), "")
QUATERNION_RATE = dict.fromkeys(("Q1_DOT", "Q2_DOT", "Q3_DOT", "QC_DOT"), "1/s")
ANGLES = dict.fromkeys(("ANGLE_1", "ANGLE_2", "ANGLE_3"), "deg")
ANGLE_RATES = dict.fromkeys(("ANGLE_1_DOT", "ANGLE_2_DOT", "ANGLE_3_DOT"), "deg/s")
TURN_RATE = dict.fromkeys(("ANGVEL_X", "ANGVEL_Y", "ANGVEL_Z"), "deg/s")
COLUMNS = {  # of each ATTITUDE_TYPE
    "QUATERNION": QUATERNION,
    "QUATERNION/DERIVATIVE": {**QUATERNION, **QUATERNION_RATE},
    "QUATERNION/RATE": {**QUATERNION, **TURN_RATE},
    "QUATERNION/ANGVEL": {**QUATERNION, **TURN_RATE},
    "EULER_ANGLE": ANGLES,
    "EULER_ANGLE/RATE": {**ANGLES, **ANGLE_RATES},
    "EULER_ANGLE/DERIVATIVE": {**ANGLES, **ANGLE_RATES},
    "EULER_ANGLE/ANGVEL": {**ANGLES, **TURN_RATE},
}
TYPES = {  # by version
    "1.0": ("QUATERNION", "QUATERNION/DERIVATIVE", "QUATERNION/RATE", "EULER_ANGLE", "EULER_ANGLE/RATE"),
    "2.0": tuple(name for name in COLUMNS if not name.endswith("/RATE")),
}
WITH_RATE = ("QUATERNION/DERIVATIVE", "QUATERNION/ANGVEL", "QUATERNION/RATE")
SEQUENCE_LETTERS = {"X": 0, "Y": 1, "Z": 2, "1": 0, "2": 1, "3": 2}
OrbitAt = Callable[[int], State]


@dataclass(frozen=True)
class Attitude:
    """The attitude of one object."""

    object_name: str
    object_id: str
    at: Callable[[int, OrbitAt | None], np.ndarray]  # UTC, Unix ns -> quat_gcrs_to_body [4]; raises NoState
    needs_orbit: bool  # the file gives it relative to axes that go along with the object's own orbit
    spans: tuple[tuple[int, int], ...]  # UTC, Unix ns


@dataclass(frozen=True, eq=False)
class _Table:
    """A segment of an AEM."""

    tai_ns: list[int]  # [N]
    quats: np.ndarray  # [N, 4] w, x, y, z from the outer frame to the body's, each near the one before it
    rates: np.ndarray | None  # [N, 4] of these, 1/s; None where rows state none or they are not used
    frame: str
    method: str
    count: int  # of the neighbours in use
    start_ns: int
    stop_ns: int


def read_attitude(message: Message) -> Attitude:
    """Return the attitude in an AEM.

    Raises:
        ConfigError: a key or value is missing, unknown or not one that we can use; the message says what was expected.
    """
    first = message.segments[0].meta
    tables = [_table(segment, message.version) for segment in message.segments]
    check_order([(t.start_ns, t.stop_ns) for t in tables], message)

    def at(utc: int, orbit_at: OrbitAt | None) -> np.ndarray:
        return _interpolated(tables, utc, orbit_at)

    spans = tuple((utc_ns(t.start_ns), utc_ns(t.stop_ns)) for t in tables)
    local = any(table.frame in LOCAL for table in tables)
    return Attitude(first.text("OBJECT_NAME"), first.text("OBJECT_ID"), at, local, spans)


def _table(segment: Segment, version: str) -> _Table:
    meta = segment.meta
    meta.check(KEYS[version])
    system, kind = meta.choice("TIME_SYSTEM", SYSTEMS), _type(meta, version)
    if not segment.data.rows:
        raise ConfigError(meta.where, "a segment without attitudes")
    times = [parse_epoch(epoch, system) for epoch, _ in segment.data.rows]
    start, stop = span(segment, times, system)
    method = meta.choice("INTERPOLATION_METHOD", ("LINEAR", "LAGRANGE", "HERMITE"), "LINEAR")
    count = degree(meta, DEFAULT_DEGREES[method]) + 1
    if method == "LINEAR" and count != 2:
        raise ConfigError(meta.where, f"expected LINEAR to have INTERPOLATION_DEGREE 1, got {count - 1}")
    if method == "HERMITE":
        count = (count + 1) // 2
        if kind not in WITH_RATE:
            raise ConfigError(
                f"{meta.where}, INTERPOLATION_METHOD",
                f"HERMITE needs quaternions with rates, got rows of {kind}",
            )
    if len(times) == 1 and "INTERPOLATION_METHOD" not in meta.values:
        count = 1
    enough(segment, count)
    frame, outwards = _frames(meta, version)
    quats, rates = _rows(segment, kind, method == "HERMITE", version)
    if outwards:  # the rows lead from the body to the frame
        quats, rates = (None if q is None else q * [1, -1, -1, -1] for q in (quats, rates))
        assert quats is not None
    signs = np.cumprod(np.append(1, np.where((quats[1:] * quats[:-1]).sum(axis=1) < 0, -1, 1)))[:, None]
    return _Table(
        times, quats * signs, None if rates is None else rates * signs, frame, method, count, start, stop
    )


DEFAULT_DEGREES = {"LINEAR": 1, "LAGRANGE": 1, "HERMITE": 3}


def _type(meta: Section, version: str) -> str:
    text = "/".join(part.strip() for part in meta.text("ATTITUDE_TYPE").upper().split("/")).replace(" ", "_")
    if text not in TYPES[version]:
        value = meta.values["ATTITUDE_TYPE"]
        raise ConfigError(
            f"{value.where}, ATTITUDE_TYPE",
            f"expected one of {', '.join(TYPES[version])}, got {value.text!r}: write the attitude as quaternions",
        )
    return text


def _frames(meta: Section, version: str) -> tuple[str, bool]:
    """Return the frame that the body turns in, and whether the quaternions lead from the body to it."""
    names = [meta.text(key).upper().replace(" ", "") for key in ("REF_FRAME_A", "REF_FRAME_B")]
    outer = [name in INERTIAL or name in LOCAL for name in names]
    for key, name in zip(("REF_FRAME_A", "REF_FRAME_B"), names, strict=True):
        if is_other(name):
            raise ConfigError(
                f"{meta.values[key].where}, {key}",
                f"expected one of {', '.join((*INERTIAL, *LOCAL))} or a frame of the spacecraft, got {name!r}",
            )
    if outer[0] == outer[1]:
        raise ConfigError(
            f"{meta.where}, REF_FRAME_A and REF_FRAME_B",
            f"expected a frame such as EME2000 and one of the spacecraft such as SC_BODY_1, got {' and '.join(names)}",
        )
    backwards = version == "1.0" and meta.choice("ATTITUDE_DIR", ("A2B", "B2A")) == "B2A"
    return names[0] if outer[0] else names[1], outer[1] != backwards


def _rows(
    segment: Segment, kind: str, with_rates: bool, version: str
) -> tuple[np.ndarray, np.ndarray | None]:
    """Return the rotations [N, 4] of coordinates that the rows state, and their rates of change [N, 4] where wanted."""
    meta, columns = segment.meta, COLUMNS[kind]
    scalar_first = False
    if version == "1.0" and kind.startswith("QUATERNION"):
        scalar_first = meta.choice("QUATERNION_TYPE", ("FIRST", "LAST"), "LAST") == "FIRST"
    if scalar_first:  # in KVN the rows then have this order
        columns = {name: columns[name] for name in sorted(columns, key=lambda name: _scalar_first(name))}
    numbers = np.array([row.numbers(columns) for _, row in segment.data.rows])
    named = {name: numbers[:, place] for place, name in enumerate(columns)}
    if kind.startswith("EULER"):
        return _of_euler(meta, np.stack([named[name] for name in ANGLES], axis=1)), None
    quats = np.stack([named[name] for name in ("QC", "Q1", "Q2", "Q3")], axis=1)
    lengths = np.linalg.norm(quats, axis=1)
    if (bad := np.flatnonzero(np.abs(lengths - 1) > 1e-3)).size:
        raise ConfigError(
            segment.data.rows[bad[0]][1].where,
            f"expected a unit quaternion, got a length of {lengths[bad[0]]:.4g}",
        )
    quats = quats / lengths[:, None] * [1, -1, -1, -1]
    if not with_rates:
        return quats, None
    if kind == "QUATERNION/DERIVATIVE":
        rates = np.stack([named[name] for name in ("QC_DOT", "Q1_DOT", "Q2_DOT", "Q3_DOT")], axis=1)
        return quats, rates * [1, -1, -1, -1]
    rate = np.radians(np.stack([named[name] for name in TURN_RATE], axis=1))
    return quats, _quat_rates(quats, rate, _rate_in_b(meta, version))


def _scalar_first(name: str) -> tuple[int, int]:
    group = 0 if name in QUATERNION else 1
    return group, 0 if name.startswith("QC") else int(name[1]) if name.startswith("Q") else 4


def _rate_in_b(meta: Section, version: str) -> bool:
    """Return whether angular velocities are given along the axes of B; otherwise those of A."""
    key = "RATE_FRAME" if version == "1.0" else "ANGVEL_FRAME"
    names = {"REF_FRAME_A": False, "REF_FRAME_B": True}
    names |= {meta.text(name).upper(): is_b for name, is_b in names.items()}
    if key not in meta.values:
        raise ConfigError(f"{meta.where}, {key}", "is missing, in which angular velocities are given")
    return names[meta.choice(key, tuple(names))]


def _quat_rates(quats: np.ndarray, rate: np.ndarray, in_b: bool) -> np.ndarray:
    """Return how quat_a_to_b [N, 4] changes, 1/s, when B turns in A with a rate [N, 3] rad/s along axes of B or A."""
    if not in_b:
        rate = np.stack([quat_to_matrix(q) @ w for q, w in zip(quats, rate, strict=True)])
    w, v = quats[:, :1], quats[:, 1:]  # R' = -[rate x] R
    return -0.5 * np.concatenate(
        [-(rate * v).sum(axis=1, keepdims=True), w * rate + np.cross(rate, v)], axis=1
    )


def _of_euler(meta: Section, angles_deg: np.ndarray) -> np.ndarray:
    """Return quat_a_to_b [N, 4] of three turns one after another, about axes as EULER_ROT_SEQ names them."""
    text = meta.text("EULER_ROT_SEQ").upper()
    if len(text) != 3 or not set(text) <= set(SEQUENCE_LETTERS) or text[0] == text[1] or text[1] == text[2]:
        raise ConfigError(
            f"{meta.where}, EULER_ROT_SEQ", f"expected three axes such as ZYX or 321, got {text[:20]!r}"
        )
    quats = []
    for row in np.radians(angles_deg) / 2:
        matrix = np.eye(3)
        for letter, half in zip(text, row, strict=True):
            quat = np.zeros(4)
            quat[0], quat[1 + SEQUENCE_LETTERS[letter]] = np.cos(half), -np.sin(half)
            matrix = quat_to_matrix(quat) @ matrix
        quats.append(matrix_to_quat(matrix))
    return np.stack(quats)


def _interpolated(tables: list[_Table], utc: int, orbit_at: OrbitAt | None) -> np.ndarray:
    at_ns = tai_ns(utc)
    table = tables[covering([(t.start_ns, t.stop_ns) for t in tables], at_ns)]
    near = neighbours(table.tai_ns, at_ns, table.count)
    times_s = np.array([t - table.tai_ns[near.start] for t in table.tai_ns[near]]) / NS
    at_s, quats = (at_ns - table.tai_ns[near.start]) / NS, table.quats[near]
    if table.method == "HERMITE":
        assert table.rates is not None
        quat = hermite(times_s, quats, table.rates[near], at_s)[0]
    elif len(quats) == 2:
        quat = slerp(quats[0], quats[1], at_s / times_s[1])
    else:
        quat = lagrange(times_s, quats, at_s)
    to_body = quat_to_matrix(quat)
    if table.frame in LOCAL:
        assert orbit_at is not None
        state = orbit_at(utc)
        frame = "RTN" if table.frame in RADIAL else table.frame
        return matrix_to_quat(to_body @ local_axes(frame, state.position_m, state.velocity_m_s))
    return matrix_to_quat(to_body @ to_gcrs(table.frame, utc).T)
