"""Navigation data messages against other implementations: Orekit and `oem` (recorded), skyfield, SciPy, sgp4."""

import json
import re
from datetime import UTC, datetime, timedelta
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
from skyfield.framelib import ICRS_to_J2000

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
from flightsw.orbit import propagate

GOLDEN = Path(__file__).parents[2] / "golden" / "ndm"  # made by make_messages.py there
READ = json.loads((GOLDEN / "read.json").read_text())
MISSION = load_mission(Path(__file__).parents[3] / "mission.yaml")
POSITION_M, ANGLE_RAD = 1e-3, 1e-9  # what the issue asks for
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
def test_polynomials_are_scipy_s(count, seed, data):
    rng = np.random.default_rng(seed)
    times = np.cumsum(rng.uniform(5.0, 60.0, count))
    values, rates = rng.normal(size=(2, count, 3))
    at = data.draw(st.floats(float(times[0]), float(times[-1])))
    np.testing.assert_allclose(
        lagrange(times, values, at), KroghInterpolator(times, values)(at), rtol=1e-6, atol=1e-6
    )
    both = KroghInterpolator(np.repeat(times, 2), np.stack([values, rates], axis=1).reshape(-1, 3))
    value, rate = hermite(times, values, rates, at)
    scale = 1 + np.abs(both(at)).max()
    np.testing.assert_allclose(value, both(at), rtol=0, atol=1e-5 * scale)
    np.testing.assert_allclose(
        rate, both.derivative(at), rtol=0, atol=1e-5 * (1 + np.abs(both.derivative(at)).max())
    )


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
    ):
        with pytest.raises(ConfigError, match=said):
            Formation.of(files)
