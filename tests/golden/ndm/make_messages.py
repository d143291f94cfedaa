"""Write the navigation data messages of this folder, and `read.json`: what two other implementations read from them.

Orekit (orekit-jpype, needs Java) reads orbits and attitudes and interpolates both, `oem` interpolates orbits, and
`ccsds-ndm` turns two of the messages into XML. None of them is a dependency of this project:

    python -m venv other && other/bin/pip install orekit-jpype oem ccsds-ndm sgp4 scipy
    other/bin/python tests/golden/ndm/make_messages.py
"""

import json
import tempfile
from datetime import UTC, datetime, timedelta
from pathlib import Path

import erfa
import numpy as np
import oem
import orekit_jpype
from astropy.time import Time
from ccsds_ndm.ndm_io import NDMFileFormats, NdmIo
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation
from sgp4.api import Satrec, jday

orekit_jpype.initVM()

from java.lang import StringBuilder  # noqa: E402
from java.util import ArrayList  # noqa: E402
from org.orekit.bodies import CelestialBodyFactory  # noqa: E402
from org.orekit.data import DataContext, DataSource  # noqa: E402
from org.orekit.files.ccsds.ndm import ParserBuilder, WriterBuilder  # noqa: E402
from org.orekit.files.ccsds.utils.generation import XmlGenerator  # noqa: E402
from org.orekit.frames import FramesFactory  # noqa: E402
from org.orekit.time import AbsoluteDate, DateComponents, OffsetModel, TimeScalesFactory  # noqa: E402
from org.orekit.utils import IERSConventions  # noqa: E402

HERE = Path(__file__).parent
TLES = {
    "target": (
        "1 31698U 07026A   26202.44324132  .00000200  00000+0  12714-4 0  9997",
        "2 31698  97.4457 209.6623 0001808  80.3305 279.8134 15.19148901 58421",
    ),
    "chaser": (
        "1 36605U 10030A   26202.44323971  .00000080  00000+0  69995-5 0  9999",
        "2 36605  97.4466 209.6630 0001785 100.1073 260.0363 15.19148789891840",
    ),
}
IDS = {"target": "2007-026A", "chaser": "2010-030A"}
START = datetime(2026, 7, 21, 10, 50, tzinfo=UTC)
LEAPS = list(erfa.leap_seconds.get())


def paths() -> dict[str, np.ndarray]:
    """Positions and velocities [61, 6] (km, km/s) each minute, of a numerical integration with the Earth's oblateness.

    It starts at what SGP4 says, whose own velocities are not quite the slopes of its positions.
    """
    jd = jday(START.year, START.month, START.day, START.hour, START.minute, 0)

    def slope(_t: float, at: np.ndarray) -> np.ndarray:
        r2, z = at[:3] @ at[:3], np.array([0.0, 0.0, at[2]])
        ratio = 1.5 * 1.08262668e-3 * 6378.1363**2 / r2
        pull = at[:3] * (1 + ratio * (1 - 5 * at[2] ** 2 / r2)) + 2 * ratio * z
        return np.concatenate([at[3:], -398600.4418 / r2**1.5 * pull])

    found = {}
    for role, tle in TLES.items():
        _, r, v = Satrec.twoline2rv(*tle).sgp4(*jd)
        times = np.arange(0, 3601, 60.0)
        run = solve_ivp(slope, (0, 3600), [*r, *v], "DOP853", times, rtol=1e-12, atol=1e-10)
        found[role] = run.y.T
    return found


PATHS = paths()


def state(role: str, seconds: float) -> np.ndarray:
    """Position and velocity (km, km/s) of a satellite at a whole minute."""
    return PATHS[role][round(seconds / 60)]


def text_of(seconds: float, system: str) -> str:
    shift = {"UTC": 0.0, "GPS": 18.0, "TT": 69.184, "TAI": 37.0}[system]
    return (START + timedelta(seconds=seconds + shift)).strftime("%Y-%m-%dT%H:%M:%S.%f")


def header(kind: str, version: str) -> list[str]:
    lines = [f"CCSDS_{kind}_VERS = {version}", "COMMENT made by tests/golden/ndm/make_messages.py"]
    return [*lines, "CREATION_DATE = 2026-11-27T00:00:00", "ORIGINATOR = OBBGS"]


def ephemeris(role: str, frame: str, system: str, method: str, degree: int, parts, covariance=()) -> str:
    lines = header("OEM", "2.0")
    for start, stop in parts:
        times = np.arange(start, stop + 1, 60.0)
        lines += ["", "META_START", f"OBJECT_NAME = {role.upper()}", f"OBJECT_ID = {IDS[role]}"]
        lines += ["CENTER_NAME = EARTH", f"REF_FRAME = {frame}", f"TIME_SYSTEM = {system}"]
        lines += [f"START_TIME = {text_of(start, system)}", f"STOP_TIME = {text_of(stop, system)}"]
        lines += [f"INTERPOLATION = {method}", f"INTERPOLATION_DEGREE = {degree}", "META_STOP", ""]
        lines += [f"{text_of(t, system)} " + " ".join(f"{x:.12f}" for x in state(role, t)) for t in times]
        if covariance:
            lines += ["", "COVARIANCE_START"]
            for t, matrix in zip((start, stop), covariance, strict=True):
                lines += [f"EPOCH = {text_of(t, system)}", "COV_REF_FRAME = RTN"]
                lines += [" ".join(f"{x:.9e}" for x in row[: i + 1]) for i, row in enumerate(matrix)]
            lines += ["COVARIANCE_STOP"]
    return "\n".join(lines) + "\n"


def turned(role: str, seconds: float) -> Rotation:
    """How a body's axes lie in EME2000: it turns evenly about an axis of its own, 2 degrees a second."""
    axis = np.array([0.6, -0.64, 0.48]) if role == "target" else np.array([0.0, 0.6, 0.8])
    start = Rotation.from_euler("ZYX", [30.0, -40.0, 110.0], degrees=True)
    return start * Rotation.from_rotvec(axis * np.radians(2.0) * seconds)


def attitude(
    role: str, version: str, kind: str, more: list[str], rows, frames=("EME2000", "SC_BODY_1")
) -> str:
    times = np.arange(0.0, 601.0, 10.0)
    lines = [
        *header("AEM", version),
        "",
        "META_START",
        f"OBJECT_NAME = {role.upper()}",
        f"OBJECT_ID = {IDS[role]}",
    ]
    lines += [
        "CENTER_NAME = EARTH",
        f"REF_FRAME_A = {frames[0]}",
        f"REF_FRAME_B = {frames[1]}",
        "TIME_SYSTEM = UTC",
    ]
    lines += [
        f"START_TIME = {text_of(0, 'UTC')}",
        f"STOP_TIME = {text_of(600, 'UTC')}",
        f"ATTITUDE_TYPE = {kind}",
    ]
    lines += [*more, "META_STOP", "", "DATA_START"]
    lines += [f"{text_of(t, 'UTC')} " + " ".join(f"{x:.15f}" for x in rows(t)) for t in times]
    return "\n".join([*lines, "DATA_STOP"]) + "\n"


def quaternion(turn: Rotation) -> np.ndarray:
    """Q1, Q2, Q3, QC of the turn that makes the axes of A those of B."""
    return turn.as_quat()


def write_all() -> None:
    rng = np.random.default_rng(3)
    covariances = []
    for scale in (1.0, 2.0):
        root = rng.normal(size=(6, 6)) * np.repeat([2e-5, 3e-8], 3)[:, None] * scale
        covariances.append(root @ root.T)
    files = {
        "target.oem": ephemeris("target", "EME2000", "UTC", "HERMITE", 7, [(0, 900), (960, 1800)]),
        "chaser.oem": ephemeris("chaser", "GCRF", "GPS", "LAGRANGE", 8, [(0, 1800)], covariances),
        "target.aem": attitude(
            "target",
            "1.0",
            "QUATERNION",
            [
                "ATTITUDE_DIR = A2B",
                "QUATERNION_TYPE = LAST",
                "INTERPOLATION_METHOD = LAGRANGE",
                "INTERPOLATION_DEGREE = 7",
            ],
            lambda t: quaternion(turned("target", t)),
        ),
        "backwards.aem": attitude(
            "target",
            "1.0",
            "QUATERNION",
            ["ATTITUDE_DIR = B2A", "QUATERNION_TYPE = FIRST"],
            lambda t: np.roll(quaternion(turned("target", t).inv()), 1),
        ),
        "euler.aem": attitude(
            "target",
            "1.0",
            "EULER_ANGLE",
            ["ATTITUDE_DIR = A2B", "EULER_ROT_SEQ = 321"],
            lambda t: turned("target", t).as_euler("ZYX", degrees=True),
        ),
        "chaser.aem": attitude(
            "chaser",
            "2.0",
            "QUATERNION/ANGVEL",
            ["ANGVEL_FRAME = SC_BODY_1", "INTERPOLATION_METHOD = HERMITE", "INTERPOLATION_DEGREE = 7"],
            lambda t: [*quaternion(turned("chaser", t)), 0.0, 1.2, 1.6],
        ),
    }
    for name, text in files.items():
        (HERE / name).write_text(text)
    for name in ("target.oem", "chaser.oem"):
        NdmIo().to_file(NdmIo().from_path(HERE / name), NDMFileFormats.XML, HERE / f"{name}.xml")


def orekit_parsers() -> ParserBuilder:
    import jpype

    @jpype.JImplements("org.orekit.time.UTCTAIOffsetsLoader")
    class Loader:
        @jpype.JOverride
        def loadOffsets(self):
            found = ArrayList()
            for year, month, offset in LEAPS:
                if float(offset).is_integer():
                    found.add(OffsetModel(DateComponents(int(year), int(month), 1), int(offset)))
            return found

    class Earth:  # Orekit asks the centre for no more than this
        def getName(self):
            return "Earth"

        def getGM(self):
            return 3.986004418e14

    class Bodies:
        def loadCelestialBody(self, name):
            return jpype.JProxy("org.orekit.bodies.CelestialBody", inst=Earth())

    bodies = jpype.JProxy("org.orekit.bodies.CelestialBodyLoader", inst=Bodies())
    CelestialBodyFactory.addCelestialBodyLoader("Earth", bodies)
    CelestialBodyFactory.addCelestialBodyLoader("earth", bodies)
    TimeScalesFactory.addUTCTAIOffsetsLoader(Loader())
    return ParserBuilder(DataContext.getDefault()).withConventions(IERSConventions.IERS_2010)


def source(name: str) -> DataSource:
    return DataSource(str(HERE / name))


def write_attitude_xml(builder: ParserBuilder, name: str) -> None:
    """Write an AEM as Orekit writes it in XML."""
    message, text = builder.buildAemParser().parseMessage(source(name)), StringBuilder()
    generator = XmlGenerator(text, 2, name, 1e6, True, None)
    WriterBuilder().buildAemWriter().writeMessage(generator, message)
    (HERE / f"{name}.xml").write_text(str(text.toString()))


def matrix_of(rotation) -> list[list[float]]:
    """The rotation of coordinates from the frame of reference to the body's axes."""
    return [list(map(float, row)) for row in rotation.getMatrix()]


def main() -> None:
    write_all()
    builder = orekit_parsers()
    for name in ("target.aem", "chaser.aem"):
        write_attitude_xml(builder, name)
    utc, gcrf = TimeScalesFactory.getUTC(), FramesFactory.getGCRF()
    read: dict = {"orekit": {}, "oem": {}}

    def date(seconds: float) -> AbsoluteDate:
        return AbsoluteDate(text_of(seconds, "UTC"), utc)

    def utc_ns(seconds: float) -> int:
        return round((START.timestamp() + seconds) * 1e3) * 1_000_000

    orbit_times = [0.0, 17.25, 444.5, 899.0, 961.0, 1333.3, 1800.0]
    for name in ("target.oem", "chaser.oem", "target.oem.xml", "chaser.oem.xml"):
        file = builder.buildOemParser().parseMessage(source(name))
        propagator = file.getSatellites().values().iterator().next().getPropagator()
        rows = []
        for seconds in orbit_times:
            pv = propagator.getPVCoordinates(date(seconds), gcrf)
            rows.append([utc_ns(seconds), *pv.getPosition().toArray(), *pv.getVelocity().toArray()])
        read["orekit"][name] = [[row[0], *map(float, row[1:])] for row in rows]
    for name in ("target.oem", "chaser.oem"):
        content = (HERE / name).read_text()
        if name == "chaser.oem":  # `oem` does not know GPS time
            content = ephemeris("chaser", "GCRF", "UTC", "LAGRANGE", 8, [(0, 1800)])
        with tempfile.NamedTemporaryFile("w", suffix=".oem") as file:
            file.write(content)
            file.flush()
            ephemeris_ = oem.OrbitEphemerisMessage.open(file.name)
            rows = []
            for seconds in orbit_times:
                found = ephemeris_(Time(text_of(seconds, "UTC"), scale="utc", format="isot"))
                rows.append([utc_ns(seconds), *map(float, 1e3 * found.vector)])
        read["oem"][name] = rows
    to_eme2000 = np.array(matrix_of(gcrf.getTransformTo(FramesFactory.getEME2000(), date(0.0)).getRotation()))
    for name in (
        "target.aem",
        "backwards.aem",
        "euler.aem",
        "chaser.aem",
        "target.aem.xml",
        "chaser.aem.xml",
    ):
        file = builder.buildAemParser().parseMessage(source(name))
        segment = file.getSatellites().values().iterator().next().getSegments().get(0)
        if name.startswith("chaser"):  # between rows too: it interpolates by rates, as this file asks for
            times, provider = (0.0, 10.0, 123.456, 299.5, 600.0), segment.getAttitudeProvider()
            turns = [provider.getAttitude(None, date(t), gcrf).withReferenceFrame(gcrf) for t in times]
            found = [matrix_of(turn.getRotation()) for turn in turns]
        else:  # at rows; its provider would turn B2A around a second time
            times, rows = (0.0, 10.0, 300.0, 600.0), segment.getAngularCoordinates()
            turns = [np.array(matrix_of(rows.get(round(t / 10)).getRotation())) for t in times]
            found = [(turn @ to_eme2000).tolist() for turn in turns]
        read["orekit"][name] = [[utc_ns(t), turn] for t, turn in zip(times, found, strict=True)]
    (HERE / "read.json").write_text(json.dumps(read, indent=1) + "\n")


if __name__ == "__main__":
    main()
