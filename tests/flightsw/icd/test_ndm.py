"""Navigation data messages against other implementations: Orekit and `oem` (recorded), skyfield, SciPy, sgp4."""

import json
import re
from datetime import UTC, datetime, timedelta
from fractions import Fraction
from pathlib import Path

import erfa
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from scipy.interpolate import KroghInterpolator
from scipy.spatial.transform import Rotation
from sgp4.api import jday
from skyfield.api import load
from skyfield.framelib import ICRS_to_J2000
from skyfield.sgp4lib import TEME

from flightsw.icd.config import ConfigError
from flightsw.icd.mission import load_mission
from flightsw.icd.ndm.attitude import read_attitude
from flightsw.icd.ndm.axes import local_axes, to_gcrs
from flightsw.icd.ndm.formation import Formation
from flightsw.icd.ndm.interpolation import hermite, lagrange, neighbours
from flightsw.icd.ndm.orbit import NoState, read_orbit, two_lines
from flightsw.icd.ndm.text import Value, read_messages
from flightsw.icd.ndm.times import NS, parse_epoch, utc_ns
from flightsw.icd.quaternion import quat_to_matrix
from flightsw.icd.reference_frames import teme_to_gcrs
from flightsw.icd.tle import check_tle
from flightsw.navigation.orbit import propagate

GOLDEN = Path(__file__).parents[2] / "golden" / "ndm"  # made by make_messages.py there
READ = json.loads((GOLDEN / "read.json").read_text())
MISSION = load_mission(Path(__file__).parents[3] / "mission.yaml")
POSITION_M, ANGLE_RAD = 1e-3, 1e-9  # what the issue asks for
TIMES = load.timescale(builtin=True)
START_NS = READ["orekit"]["target.oem"][0][0]
OEM, AEM = (GOLDEN / "target.oem").read_text(), (GOLDEN / "target.aem").read_text()


def orbit_of(text: str | bytes):
    return read_orbit(read_messages(text.encode() if isinstance(text, str) else text)[0])


def attitude_of(text: str | bytes):
    return read_attitude(read_messages(text.encode() if isinstance(text, str) else text)[0])


def angle(a: np.ndarray, b: np.ndarray) -> float:
    """Between two rotations [3, 3], rad, also a tiny one."""
    turn = a @ b.T
    return float(np.linalg.norm(turn - turn.T)) / 2**1.5


ORBITS = [(who, name) for who, files in READ.items() for name in files if ".oem" in name]


@pytest.mark.parametrize(("who", "name"), ORBITS)
def test_an_ephemeris_is_what_others_read(who, name):
    orbit = orbit_of((GOLDEN / name).read_bytes())
    # `oem` gives positions in the file's own axes
    turn = to_gcrs("EME2000", 0) if who == "oem" and name == "target.oem" else np.eye(3)
    for at_ns, *expected in READ[who][name]:
        state = orbit.at(at_ns)
        np.testing.assert_allclose(state.position_m, turn @ expected[:3], rtol=0, atol=POSITION_M)
        np.testing.assert_allclose(state.velocity_m_s, turn @ expected[3:], rtol=0, atol=1e-5)


@pytest.mark.parametrize("name", [name for name in READ["orekit"] if ".aem" in name])
def test_an_attitude_is_what_orekit_reads(name):
    attitude = attitude_of((GOLDEN / name).read_bytes())
    for at_ns, expected in READ["orekit"][name]:
        assert angle(quat_to_matrix(attitude.at(at_ns, None)), np.array(expected)) < ANGLE_RAD


def test_between_rows_an_even_rotation_stays_even():
    turn = Rotation.from_rotvec(np.radians(2.0) * 123.456 * np.array([0.6, -0.64, 0.48]))
    body_to_eme2000 = Rotation.from_euler("ZYX", [30.0, -40.0, 110.0], degrees=True) * turn
    expected = body_to_eme2000.as_matrix().T @ ICRS_to_J2000
    for name in ("target.aem", "target.aem.xml", "backwards.aem", "euler.aem"):
        attitude = attitude_of((GOLDEN / name).read_bytes())
        assert angle(quat_to_matrix(attitude.at(START_NS + 123_456_000_000, None)), expected) < ANGLE_RAD


def test_a_covariance_turns_from_the_orbit_s_axes_to_gcrs():
    text = (GOLDEN / "chaser.oem").read_text()
    block = text.split("COV_REF_FRAME = RTN\n")[1].split("EPOCH")[0]
    matrix = np.zeros((6, 6))
    matrix[np.tril_indices(6)] = [float(number) for number in block.split()]
    matrix = 1e6 * (matrix + np.tril(matrix, -1).T)
    at_ns, *vector = READ["orekit"]["chaser.oem"][0]
    r, v = np.array(vector[:3]), np.array(vector[3:])
    radial, normal = r / np.linalg.norm(r), np.cross(r, v) / np.linalg.norm(np.cross(r, v))
    axes = np.kron(np.eye(2), np.stack([radial, np.cross(normal, radial), normal], axis=1))
    for name in ("chaser.oem", "chaser.oem.xml"):
        found = orbit_of((GOLDEN / name).read_bytes()).at(at_ns).covariance
        np.testing.assert_allclose(found, axes @ matrix @ axes.T, rtol=1e-6, atol=1e-9 * matrix.max())


def test_gaps_and_useable_times_are_kept_to():
    orbit = orbit_of(OEM)  # its segments end and begin a minute apart
    with pytest.raises(NoState, match=r"11:05:30\.0+ UTC: the message covers 2026-07-21T10:50:00"):
        orbit.at(START_NS + 930 * NS)
    narrowed = OEM.replace("INTERPOLATION =", "USEABLE_START_TIME = 2026-07-21T10:52:00\nINTERPOLATION =", 1)
    with pytest.raises(NoState, match="covers 2026-07-21T10:52:00"):
        orbit_of(narrowed).at(START_NS + 60 * NS)
    with pytest.raises(ConfigError, match="before the one before it ends"):
        orbit_of(OEM + "META_START" + OEM.split("META_START")[1])


@settings(max_examples=60, deadline=None)
@given(st.integers(2, 9), st.integers(0, 10**6), st.data())
def test_polynomials_are_those_of_scipy_and_of_fractions(count, seed, data):
    rng = np.random.default_rng(seed)
    times = np.cumsum(rng.uniform(5.0, 60.0, count))
    values, rates = rng.normal(size=(2, count, 3))
    at = data.draw(st.floats(float(times[0]), float(times[-1])))
    np.testing.assert_allclose(
        lagrange(times, values, at), KroghInterpolator(times, values)(at), rtol=1e-6, atol=1e-6
    )
    value, rate = hermite(times, values, rates, at)
    expected, expected_rate = exact_hermite(times, values, rates, at)
    np.testing.assert_allclose(value, expected, rtol=0, atol=1e-7 * (1 + np.abs(expected).max()))
    np.testing.assert_allclose(rate, expected_rate, rtol=0, atol=1e-7 * (1 + np.abs(expected_rate).max()))


def exact_hermite(times, values, rates, at: float) -> np.ndarray:
    """Return value and rate [2, 3] by Newton's divided differences of fractions, exactly."""
    nodes, found = [Fraction(time) for time in np.repeat(times, 2)], []
    for value, rate in zip(values.T, rates.T, strict=True):
        column = [Fraction(each) for each in np.repeat(value, 2)]
        coefficients = [column[0]]
        for order in range(1, len(nodes)):
            column = [
                Fraction(rate[(i + order) // 2])
                if nodes[i + order] == nodes[i]
                else (column[i + 1] - column[i]) / (nodes[i + order] - nodes[i])
                for i in range(len(nodes) - order)
            ]
            coefficients.append(column[0])
        polynomial = slope = Fraction(0)
        for node, coefficient in zip(reversed(nodes), reversed(coefficients), strict=True):
            slope = slope * (Fraction(at) - node) + polynomial
            polynomial = polynomial * (Fraction(at) - node) + coefficient
        found.append((float(polynomial), float(slope)))
    return np.array(found).T


@given(st.integers(1, 8), st.integers(0, 100))
def test_neighbours_lie_about_the_time(count, at):
    times = [0, 10, 20, 30, 40, 50, 60, 100]
    near = times[neighbours(times, at, count)]
    assert len(near) == count
    nearest = sorted(abs(t - at) for t in times)[0]
    assert min(abs(t - at) for t in near) == nearest


@settings(max_examples=60)
@given(st.datetimes(datetime(1972, 1, 2), datetime(2028, 1, 1)))
def test_time_systems_are_those_of_sofa(moment):
    def at(system: str) -> int:
        return parse_epoch(Value(moment.isoformat(timespec="microseconds"), "here"), system)

    unix = (moment - datetime(1970, 1, 1)) // timedelta(microseconds=1) * 1000
    assert utc_ns(at("UTC")) == unix
    assert at("UTC") - unix == erfa.dat(moment.year, moment.month, moment.day, 0.5) * NS
    assert at("TAI") == unix
    assert at("TAI") - at("TT") == 32_184_000_000
    assert at("GPS") - at("TAI") == 19 * NS
    jd = jday(moment.year, moment.month, moment.day, moment.hour, moment.minute, moment.second)
    # the full series of Fairhead and Bretagnon, of which ours has the largest terms
    assert (at("TT") - at("TDB")) / NS == pytest.approx(erfa.dtdb(*jd, 0.5, 0.0, 0.0, 0.0), abs=2e-5)


def test_leap_seconds_and_days_of_the_year():
    def at(text: str, system: str = "UTC") -> int:
        return parse_epoch(Value(text, "here"), system)

    assert at("2017-01-01T00:00:00") - at("2016-12-31T23:59:59") == 2 * NS
    assert at("2017-01-01T00:00:00") - at("2016-12-31T23:59:60") == NS
    assert at("2026-202T10:52:30.5Z") == at("2026-07-21T10:52:30.5")
    assert at("1980-01-06T00:00:00") == at("1980-01-06T00:00:00", "GPS")  # where GPS time began
    for wrong in (
        "2026-02-30T00:00:00",
        "2026-366T00:00:00",
        "2026-01-01T24:00:00",
        "2026-01-01",
        "1950-01-01T00:00:00",
    ):
        with pytest.raises(ConfigError, match="expected a time"):
            at(wrong)


def test_frames_are_skyfield_s():
    np.testing.assert_allclose(to_gcrs("EME2000", 0), ICRS_to_J2000.T, rtol=0, atol=1e-13)
    as_j2000 = orbit_of(OEM).at(START_NS).position_m
    as_gcrf = orbit_of(OEM.replace("EME2000", "GCRF")).at(START_NS).position_m
    np.testing.assert_allclose(as_j2000, ICRS_to_J2000.T @ as_gcrf, rtol=0, atol=1e-6)


def test_axes_that_go_along_with_an_orbit():
    r, v = np.array([7e6, 0, 0]), np.array([10.0, 7.5e3, 0])
    np.testing.assert_allclose(local_axes("RTN", r, v), np.eye(3), atol=1e-15)
    np.testing.assert_allclose(local_axes("LVLH", r, v), [[0, 1, 0], [0, 0, -1], [-1, 0, 0]], atol=1e-15)
    np.testing.assert_allclose(local_axes("TNW", r, v)[0], v / np.linalg.norm(v), atol=1e-15)
    for frame in ("RTN", "TNW", "LVLH"):
        assert np.linalg.det(local_axes(frame, r, v)) == pytest.approx(1)


OPM = """CCSDS_OPM_VERS = 2.0
CREATION_DATE = 2026-07-21T00:00:00
ORIGINATOR = TEST
OBJECT_NAME = TARGET
OBJECT_ID = 2007-026A
CENTER_NAME = EARTH
REF_FRAME = GCRF
TIME_SYSTEM = UTC
EPOCH = 2026-07-21T10:50:00
X = 7000.0 [km]
Y = 10.0 [km]
Z = -20.0 [km]
X_DOT = 0.01 [km/s]
Y_DOT = 1.0 [km/s]
Z_DOT = 7.4 [km/s]
MASS = 1000 [kg]
USER_DEFINED_MOOD = good
"""


def test_a_single_state_goes_on_as_in_an_integration_of_the_potential():
    orbit, pole = orbit_of(OPM), teme_to_gcrs(START_NS)[:, 2]

    def potential(r: np.ndarray) -> complex:
        distance = np.sqrt(r @ r)
        oblate = 1.08262668e-3 * (6_378_136.3 / distance) ** 2 * (1.5 * (r @ pole / distance) ** 2 - 0.5)
        return -3.986004418e14 / distance * (1 - oblate)

    def slope(
        _t: float, y: np.ndarray
    ) -> np.ndarray:  # derivatives by a step along the imaginary axis have no error
        return np.concatenate([y[3:], [-potential(y[:3] + 1e-10j * h).imag / 1e-10 for h in np.eye(3)]])

    start = 1e3 * np.array([7000.0, 10.0, -20.0, 0.01, 1.0, 7.4])
    for seconds in (-600.0, 1800.0):
        run = solve_ivp(slope, (0, seconds), start, "DOP853", rtol=1e-12, atol=1e-7)
        found = orbit.at(START_NS + round(seconds * NS))
        np.testing.assert_allclose(found.position_m, run.y[:3, -1], rtol=0, atol=POSITION_M)
    with pytest.raises(NoState, match="send an OEM"):
        orbit.at(START_NS + 10_000 * NS)


OMM = """CCSDS_OMM_VERS = 2.0
CREATION_DATE = 2026-07-21T00:00:00
ORIGINATOR = TEST
OBJECT_NAME = TERRASAR-X
OBJECT_ID = 2007-026A
CENTER_NAME = EARTH
REF_FRAME = TEME
TIME_SYSTEM = UTC
MEAN_ELEMENT_THEORY = SGP4
EPOCH = 2026-07-21T10:38:16.050048
MEAN_MOTION = 15.19148901
ECCENTRICITY = .0001808
INCLINATION = 97.4457
RA_OF_ASC_NODE = 209.6623
ARG_OF_PERICENTER = 80.3305
MEAN_ANOMALY = 279.8134
EPHEMERIS_TYPE = 0
CLASSIFICATION_TYPE = U
NORAD_CAT_ID = 31698
ELEMENT_SET_NO = 999
REV_AT_EPOCH = 5842
BSTAR = .12714E-4
MEAN_MOTION_DOT = .00000200
MEAN_MOTION_DDOT = 0
"""


def test_mean_elements_are_those_of_the_two_lines():
    tle, orbit = MISSION.orbit.target_tle, orbit_of(OMM)
    first, second = two_lines(OMM.encode())
    check_tle((first, second), "OMM")
    assert (first[:68].replace("00000-0", "00000+0"), second) == (tle[0][:68], tle[1])  # a zero has two signs
    for seconds in (0, 3000):
        expected = propagate(tle, START_NS + seconds * NS)
        state = orbit.at(START_NS + seconds * NS)
        # eight decimals of a day in the two lines are 0.4 ms, 3 m of the path
        np.testing.assert_allclose(state.position_m, expected.position_m, rtol=0, atol=4.0)


def test_an_attitude_in_the_axes_of_an_orbit_turns_with_it():
    files = {"target.oem": OEM.encode(), "chaser.oem": (GOLDEN / "chaser.oem").read_bytes()}
    along = AEM.replace("EME2000", "RTN").encode()
    found = Formation.of({**files, "target.aem": along}).at(START_NS + 45 * NS)
    assert found.target is not None and found.quat_gcrs_to_body is not None
    axes = local_axes("RTN", found.target.position_m, found.target.velocity_m_s)
    alone = attitude_of(AEM.replace("EME2000", "GCRF")).at(START_NS + 45 * NS, None)
    assert angle(quat_to_matrix(found.quat_gcrs_to_body), quat_to_matrix(alone) @ axes) < ANGLE_RAD


def relative_oem() -> bytes:
    """The chaser's way about the target, as the difference of the two golden orbits in GCRF axes."""
    rows, target, chaser = [], orbit_of(OEM), orbit_of((GOLDEN / "chaser.oem").read_bytes())
    for seconds in range(0, 901, 60):
        states = [orbit.at(START_NS + seconds * NS) for orbit in (chaser, target)]
        difference = np.concatenate(
            [states[0].position_m - states[1].position_m, states[0].velocity_m_s - states[1].velocity_m_s]
        )
        epoch = datetime.fromtimestamp(START_NS / NS + seconds, UTC).strftime("%Y-%m-%dT%H:%M:%S")
        rows.append(f"{epoch} " + " ".join(f"{x / 1e3:.12f}" for x in difference))
    head = OEM.split("META_STOP")[0].replace("EARTH", "TARGET").replace("EME2000", "GCRF")
    head = head.replace("NAME = TARGET\nOBJECT_ID = 2007-026A", "NAME = CHASER\nOBJECT_ID = 2010-030A")
    return "\n".join([head + "META_STOP", *rows, ""]).encode()


def test_an_orbit_about_the_target_is_the_difference_of_both():
    both = Formation.of({"target.oem": OEM.encode(), "chaser.oem": (GOLDEN / "chaser.oem").read_bytes()})
    relative = Formation.of({"chaser.oem": relative_oem(), "README.md": b"not looked at"})
    for seconds in (30.5, 600.0):
        a, b = (formation.at(START_NS + round(seconds * NS)) for formation in (both, relative))
        np.testing.assert_allclose(a.chaser_from_target_m, b.chaser_from_target_m, rtol=0, atol=POSITION_M)
        assert a.target is not None and b.target is None


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("REF_FRAME = EME2000", "REF_FRAME = ITRF2000", "REF_FRAME: expected one of GCRF, .* got 'ITRF2000'"),
        (
            "TIME_SYSTEM = UTC",
            "TIME_SYSTEM = UT1",
            "TIME_SYSTEM: expected one of UTC, TAI, TT, GPS, TDB, got 'UT1'",
        ),
        (
            "INTERPOLATION_DEGREE = 7",
            "INTERPOLATION_DEGREE = 99",
            "INTERPOLATION_DEGREE: expected a whole number",
        ),
        ("INTERPOLATION_DEGREE = 7", "INTERPOLATION_DEGREE = 25", None),
        ("INTERPOLATION = HERMITE", "INTERPOLATION = SPLINE", "expected one of LAGRANGE, HERMITE, LINEAR"),
        ("CENTER_NAME = EARTH", "CENTRE_NAME = EARTH", "CENTRE_NAME: unknown key in the metadata of OEM"),
        ("ORIGINATOR = OBBGS", "", "ORIGINATOR: is missing in the header of OEM"),
        ("_VERS = 2.0", "_VERS = 7.0", "CCSDS_OEM_VERS: expected 1.0 or 2.0 or 3.0, got '7.0'"),
        ("META_STOP", "", "expected KEY = value or META_STOP"),
        ("10:51:00.000000 ", "10:50:00.000000 ", "expected a time after the one before it"),
        ("10:51:00.000000 ", "10:51:00.000000 1.0 ", "expected 6 numbers"),
        ("10:51:00.000000 -", "10:51:00.000000 x", "X: expected a number"),
    ],
)
def test_what_is_wrong_is_said_in_a_line(old, new, said):
    assert old in OEM
    if said is None:
        orbit_of(OEM.replace(old, new))
        return
    with pytest.raises(ConfigError, match=said) as caught:
        orbit_of(OEM.replace(old, new))
    assert "\n" not in str(caught.value)


@settings(max_examples=80)
@given(st.sampled_from(["target.oem", "target.aem", "chaser.aem.xml", "chaser.oem.xml"]), st.data())
def test_every_changed_key_is_refused_or_read_the_same(name, data):
    """A key that is taken out, renamed or given twice, in a header or in metadata."""
    lines = (GOLDEN / name).read_text().splitlines()
    keys = [
        i
        for i, line in enumerate(lines[:60])
        if re.search(r"^(?!CCSDS).*[A-Z]{3} =|^ +<[A-Z_]{3,}>.*</", line)
    ]
    at = data.draw(st.sampled_from(keys))
    key = re.search(r"[A-Z][A-Z_0-9]+", lines[at]).group()
    how = data.draw(st.sampled_from(["out", "renamed", "twice"]))
    lines[at : at + 1] = {
        "out": [],
        "renamed": [lines[at].replace(key, f"{key}X")],
        "twice": [lines[at]] * 2,
    }[how]
    read = attitude_of if ".aem" in name else orbit_of
    optional = (
        "INTERPOLATION",
        "INTERPOLATION_DEGREE",
        "INTERPOLATION_METHOD",
        "CENTER_NAME",
        "QUATERNION_TYPE",
    )
    if "COMMENT" in key or (how == "out" and (key in optional[:3] or (key in optional and "aem" in name))):
        return
    with pytest.raises(ConfigError) as caught:
        read("\n".join(lines))
    assert key in str(caught.value) and "\n" not in str(caught.value)


@settings(max_examples=100)
@given(st.sampled_from([OEM, AEM, OPM, OMM, (GOLDEN / "target.aem.xml").read_text()]), st.data())
def test_damage_is_refused_in_a_line_or_read(text, data):
    at = data.draw(st.integers(0, len(text) - 1))
    more = data.draw(st.text(alphabet=st.sampled_from("=<>[]/ \n.-+eE0129AZ_\0é"), max_size=4))
    damaged = text[:at] + more + text[at + data.draw(st.integers(0, 40)) :]
    try:
        for message in read_messages(damaged.encode()):
            read = read_attitude if message.kind == "AEM" else read_orbit
            read(message)
    except ConfigError as error:
        assert "\n" not in str(error)


def test_xml_that_could_stand_for_anything_is_refused():
    bomb = '<!DOCTYPE a [<!ENTITY b "c">]>' + (GOLDEN / "target.oem.xml").read_text().partition("?>")[2]
    with pytest.raises(ConfigError, match="document type"):
        read_messages(bomb.encode())


def test_files_that_do_not_go_together_are_refused():
    chaser, target = (GOLDEN / "chaser.oem").read_bytes(), OEM.encode()
    for files, said in (
        ({"target.oem": target}, "its orbit is missing"),
        ({"chaser.oem": chaser}, "is EARTH: add target.oem"),
        (
            {"chaser.oem": chaser, "target.oem": target, "target.xml": target},
            "target.xml: message: expected one orbit",
        ),
        (
            {"chaser.oem": chaser, "target.oem": target, "chaser.aem": AEM.encode()},
            "OBJECT_ID: expected '2010-030A'",
        ),
        (
            {"chaser.oem": chaser.replace(b"EARTH", b"MOON"), "target.oem": target},
            "expected EARTH or .*, got 'MOON'",
        ),
        (
            {"chaser.oem": relative_oem(), "target.aem": AEM.replace("EME2000", "RTN").encode()},
            "add target.oem",
        ),
        (
            {"chaser.oem": chaser, "target.oem": target.replace(b"EARTH", b"MOON")},
            "target, CENTER_NAME: expected EARTH, got 'MOON'",
        ),
    ):
        with pytest.raises(ConfigError, match=said):
            Formation.of(files)


def message(name: str) -> str:
    return {"OPM": OPM, "OMM": OMM}.get(name) or (GOLDEN / name).read_text()


def read(text: str):
    (found,) = read_messages(text.encode())
    return read_attitude(found) if found.kind == "AEM" else read_orbit(found)


ROW_OF_XML = "<X>-4569.104812572969</X>"
UNUSABLE = [  # message, regular expression, what takes its place, what is said
    ("OPM", r"7000.0 \[km\]", "7000.0 [m]", "X: expected the unit km, got m"),
    ("OPM", r"X = 7000.0", "X = 1e400", "X: expected a number, got '1e400'"),
    ("OPM", "MASS = 1000 .kg.", "MAN_DURATION = 1", "manoeuvres are not computed"),
    ("OPM", "MASS = 1000 .kg.", "a heavy one", "expected KEY = value, got 'a heavy one'"),
    ("OPM", "MASS = 1000 .kg.", "CX_X = 1e-6", "CY_X: is missing"),
    ("OMM", "NORAD_CAT_ID = 31698", "NORAD_CAT_ID = A1698", "expected a whole number, got 'A1698'"),
    ("OMM", "= SGP4", "= DSST", "MEAN_ELEMENT_THEORY: expected one of SGP4"),
    ("target.oem", "CCSDS_OEM_VERS = 2.0", "HELLO", "line 1: expected CCSDS_OEM_VERS = 2.0"),
    ("target.oem", "CCSDS_OEM", "CCSDS_CDM", "expected one of the messages OEM, AEM, OPM, OMM, got 'CDM'"),
    ("target.oem", "(?s)META_START.*", "", "an OEM without segments"),
    ("target.oem", "ORIGINATOR = OBBGS", "ORIGINATOR =", "ORIGINATOR: has no value"),
    ("target.oem", "META_STOP", "META_START", "META_START inside META_START"),
    ("target.oem", "META_START\n", "", "META_STOP without META_START"),
    ("target.oem", "(?s)META_START.*", "hello", "expected KEY = value or META_START, got 'hello'"),
    ("target.oem", "META_STOP\n", "META_STOP\nX = 1\n", "expected a row of numbers or META_START"),
    ("target.oem", "(?s)META_STOP.*", "META_STOP\n", "a segment without states"),
    ("target.oem", "= HERMITE", "= LINEAR", "expected LINEAR to have INTERPOLATION_DEGREE 1, got 7"),
    (
        "target.oem",
        "(?s)(META_STOP\n\n[^\n]*\n).*",
        r"\1",
        "its interpolation needs 4 rows, but the segment has 1",
    ),
    (
        "target.oem",
        "START_TIME = .*",
        "START_TIME = 2026-07-21T12:00:00",
        "nothing of the segment is useable",
    ),
    ("target.oem", "OBJECT_ID = 2007-026A((?s:.*)META_START)", r"OBJECT_ID = 1\1", "expected '1' as before"),
    (
        "target.oem",
        "= EME2000",
        "= TEME\nREF_FRAME_EPOCH = 2000-01-01T00:00:00",
        "TEME is read as that of date",
    ),
    ("chaser.oem", "(?<=COVARIANCE_START\n)EPOCH.*\n", "", "expected EPOCH = ..., got 'COV_REF_FRAME = RTN'"),
    ("chaser.oem", "\n4.578126841e-09", "", "expected rows of 1, 2, 3, 4, 5 and 6 numbers, got rows of"),
    ("chaser.oem", "\n4.578126841e-09", "\n-4.578126841e-09", "expected a positive semi-definite covariance"),
    ("target.aem", "DATA_STOP", "", "DATA_START without DATA_STOP; the file may be cut off"),
    ("target.aem", "(?s)DATA_START.*", "DATA_START\nDATA_STOP\n", "a segment without attitudes"),
    ("target.aem", "= LAGRANGE", "= LINEAR", "expected LINEAR to have INTERPOLATION_DEGREE 1, got 7"),
    ("target.aem", "= LAGRANGE", "= HERMITE", "HERMITE needs quaternions with rates, got rows of QUATERNION"),
    ("target.aem", "= QUATERNION\n", "= SPIN\n", "ATTITUDE_TYPE: expected one of QUATERNION, .*got 'SPIN'"),
    ("target.aem", "= EME2000", "= ITRF", "REF_FRAME_A: expected one of GCRF, .*got 'ITRF'"),
    ("target.aem", "= SC_BODY_1", "= GCRF", "expected a frame such as EME2000 and one of the spacecraft"),
    ("target.aem", " 0.794296244782429", " 0.9", "expected a unit quaternion, got a length of 1.0"),
    ("euler.aem", "= 321", "= 331", "expected three axes such as ZYX or 321, got '331'"),
    ("chaser.aem", "ANGVEL_FRAME.*\n", "", "ANGVEL_FRAME: is missing, in which angular velocities are given"),
    ("target.oem.xml", "</oem>", "", "is not valid XML"),
    ("target.oem.xml", ROW_OF_XML, "", "X: is missing; got Y Z"),
    ("target.oem.xml", ROW_OF_XML, ROW_OF_XML + "<W>1</W>", "W: unknown; expected X Y Z"),
    (
        "target.oem.xml",
        "<EPOCH>2026-07-21T10:50:00.000000</EPOCH>",
        "",
        "segment 1, stateVector 1, EPOCH: is missing",
    ),
    ("target.oem.xml", "stateVector", "vector", "segment 1, vector 1: unknown in the data of an OEM"),
    ("target.oem.xml", "header>", "head>", "<oem>: expected <header> in it"),
    ("target.oem.xml", ">OBBGS<", "> <", "ORIGINATOR: has no value"),
]


@pytest.mark.parametrize(("name", "old", "new", "said"), UNUSABLE)
def test_a_message_that_cannot_be_used_says_what_was_expected(name, old, new, said):
    changed = re.sub(old, new, message(name))
    assert changed != message(name)
    with pytest.raises(ConfigError, match=said) as caught:
        read(changed)
    assert "\n" not in str(caught.value)


def test_what_is_no_text_or_too_large_is_refused(monkeypatch):
    with pytest.raises(ConfigError, match="expected KVN or XML as UTF-8"):
        read_messages(b"\xff\xfe")
    monkeypatch.setattr("flightsw.icd.ndm.text.MAX_NDM_BYTES", 100)
    with pytest.raises(ConfigError, match="at most 100 are read"):
        read_messages(OEM.encode())


def test_a_single_state_or_attitude_holds_at_its_time_alone():
    for text, at in ((OEM, 0), (AEM, 1)):
        alone = re.sub(r"INTERPOLATION.*\n", "", re.sub(r"(?s)(\n2026[^\n]*\n).*", r"\1", text))
        alone += "DATA_STOP\n" * ("DATA_START" in alone)
        found, whole = read(alone), read(text)
        assert found.spans == ((START_NS, START_NS),)
        if at == 0:
            np.testing.assert_allclose(
                found.at(START_NS).position_m, whole.at(START_NS).position_m, atol=POSITION_M
            )
        else:
            matrices = [quat_to_matrix(each.at(START_NS, None)) for each in (found, whole)]
            assert angle(*matrices) < ANGLE_RAD


def test_a_state_in_xml_among_others_is_that_in_keys():
    pairs = [line.split(" = ") for line in OPM.replace(" [km/s]", "").replace(" [km]", "").splitlines()]
    leaves = [f"<{key}>{value.partition(' [')[0]}</{key}>" for key, value in pairs]
    own = '<USER_DEFINED parameter="MOOD">good</USER_DEFINED>'
    header, meta, state = "".join(leaves[1:3]), "".join(leaves[3:8]), "".join(leaves[8:15])
    body = (
        f"<metadata>{meta}</metadata><data><COMMENT>x</COMMENT><stateVector>{state}</stateVector>{own}</data>"
    )
    body = f"<body><segment>{body}</segment></body>"
    opm = f'<opm id="CCSDS_OPM_VERS" version="2.0"><header>{header}</header>{body}</opm>'
    both = read_messages(f"<ndm><MESSAGE_ID>1</MESSAGE_ID>{opm}{opm}</ndm>".encode())
    for found in both:
        np.testing.assert_array_equal(
            read_orbit(found).at(START_NS).position_m, read(OPM).at(START_NS).position_m
        )
    commented = re.sub("<data>", "<data><COMMENT>x</COMMENT>", message("target.oem.xml"))
    state = read(commented).at(START_NS)
    np.testing.assert_array_equal(state.position_m, read(message("target.oem.xml")).at(START_NS).position_m)


def test_accelerations_are_read_over_and_teme_is_skyfield_s_to_a_second_of_arc():
    rows = re.sub(r"(?m)^(2026.*)$", r"\1 1.0 2.0 3.0", OEM)
    np.testing.assert_array_equal(read(rows).at(START_NS).position_m, read(OEM).at(START_NS).position_m)
    as_teme = read(OEM.replace("EME2000", "TEME")).at(START_NS).position_m
    as_gcrf = read(OEM.replace("EME2000", "GCRF")).at(START_NS).position_m
    moment = TIMES.from_datetime(datetime.fromtimestamp(START_NS / NS, UTC))
    np.testing.assert_allclose(as_teme, TEME.rotation_at(moment).T @ as_gcrf, rtol=0, atol=35.0)


@pytest.mark.parametrize("how", ["along the axes of A", "as derivatives"])
def test_rates_may_be_given_in_other_ways(how):
    """The same turn: its velocity along the other frame's axes by SciPy, or the quaternion's derivative."""
    text, whole = message("chaser.aem"), read(message("chaser.aem"))

    def turned(row: re.Match) -> str:
        epoch, *numbers = row[0].split()
        quat, rate = np.array(numbers[:4], float), np.array(numbers[4:], float)
        if how == "as derivatives":  # q' = q * (0, rate) / 2, scalar last
            vector, scalar, half = quat[:3], quat[3], np.radians(rate) / 2
            rate = np.append(scalar * half + np.cross(vector, half), -vector @ half)
        else:
            rate = Rotation.from_quat(quat).apply(rate)
        return " ".join([epoch, *(f"{x:.15f}" for x in (*quat, *rate))])

    changed = re.sub(r"(?m)^2026.*$", turned, text)
    if how == "as derivatives":
        changed = changed.replace("QUATERNION/ANGVEL", "QUATERNION/DERIVATIVE").replace(
            "ANGVEL_FRAME = SC_BODY_1\n", ""
        )
    else:
        changed = changed.replace("ANGVEL_FRAME = SC_BODY_1", "ANGVEL_FRAME = REF_FRAME_A")
    for seconds in (13.7, 311.0):
        at_ns = START_NS + round(seconds * NS)
        matrices = [quat_to_matrix(each.at(at_ns, None)) for each in (read(changed), whole)]
        assert angle(*matrices) < ANGLE_RAD


def test_elements_that_sgp4_cannot_carry_on_have_no_state():
    orbit = read(OMM.replace("= 15.19148901", "= 17.9"))  # below the ground
    with pytest.raises(NoState, match="SGP4 refuses the elements"):
        orbit.at(START_NS)
    with pytest.raises(ConfigError, match="expected an OMM, which has mean elements, got an OPM"):
        two_lines(OPM.encode())


def test_a_covariance_without_directions_stays_what_it_is_in_other_axes():
    axes = ("X", "Y", "Z", "X_DOT", "Y_DOT", "Z_DOT")
    entries = "".join(f"C{a}_{b} = {1e-6 * (a == b)}\n" for i, a in enumerate(axes) for b in axes[: i + 1])
    found = read(OPM.replace("= GCRF", "= EME2000") + entries)
    np.testing.assert_allclose(found.at(START_NS).covariance, np.eye(6), rtol=0, atol=1e-12)
    assert found.at(START_NS + NS).covariance is None


def test_the_chaser_s_attitude_in_the_axes_of_its_orbit_turns_with_it():
    chaser, along = (
        (GOLDEN / "chaser.oem").read_bytes(),
        message("chaser.aem").replace("EME2000", "RTN").encode(),
    )
    state = read(chaser.decode()).at(START_NS + 45 * NS)
    alone = read(message("chaser.aem").replace("EME2000", "GCRF")).at(START_NS + 45 * NS, None)
    expected = quat_to_matrix(alone) @ local_axes("RTN", state.position_m, state.velocity_m_s)
    for orbit in (chaser, relative_oem()):  # about the Earth, and about the target
        files = {"target.oem": OEM.encode(), "chaser.oem": orbit, "chaser.aem": along}
        found = Formation.of(files).at(START_NS + 45 * NS).quat_gcrs_to_chaser
        assert angle(quat_to_matrix(found), expected) < ANGLE_RAD
