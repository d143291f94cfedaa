"""Pictures with times and SPICE kernels become a session and a model; the kernels are made by SPICE's own writers."""

from pathlib import Path

import numpy as np
import pytest
import spiceypy
import tifffile
from scipy.spatial.transform import Rotation

from flightsw.icd.quaternion import quat_to_matrix
from flightsw.navigation.orbit import propagate, sun_direction_gcrs
from flightsw.navigation.pose import target_attitude
from ground.formats.photographs.exposures import read_table
from ground.formats.spice import read_spice
from ground.run.runs import open_run
from ground.session.folder import open_session
from tests.golden_pass import (
    GRID_NS,
    MISSION,
    SESSION,
    TAKEN_NS,
    check_poses,
    gcrs_to_cameras,
    ground,
    imported_from,
    utc,
    write_pictures,
)

EARTH, SUN, TARGET, CHASER, CAMERA = 399, 10, -900, -901, -901_000  # NAIF's numbers, and our own below zero
ANGLE_RAD = 1e-7  # the target turns by 4e-8 while the light is under way
LIGHT_KM_S = 299_792.458
AROUND_SUN = np.array([0.0, 29.8, 0.0]), np.array([1.496e8, 0.0, 0.0])  # km/s, km: the Earth's

LEAP_SECONDS = r"""KPL/LSK
\begindata
DELTET/DELTA_T_A = 32.184
DELTET/K         = 1.657D-3
DELTET/EB        = 1.671D-2
DELTET/M         = ( 6.239996D0 1.99096871D-7 )
DELTET/DELTA_AT  = ( 10, @1972-JAN-1, 37, @2017-JAN-1 )
"""
CLOCKS = "KPL/SCLK\n\\begindata\nSCLK_KERNEL_ID = ( @2026-JUL-01 )\n" + "".join(
    rf"""
SCLK_DATA_TYPE_{n}       = ( 1 )
SCLK01_TIME_SYSTEM_{n}   = ( 1 )
SCLK01_N_FIELDS_{n}      = ( 2 )
SCLK01_MODULI_{n}        = ( 4294967296 1000000 )
SCLK01_OFFSETS_{n}       = ( 0 0 )
SCLK01_OUTPUT_DELIM_{n}  = ( 1 )
SCLK_PARTITION_START_{n} = ( 0.0 )
SCLK_PARTITION_END_{n}   = ( 4294967296000000 )
SCLK01_COEFFICIENTS_{n}  = ( 0.0 0.0 1.0 )
"""
    for n in (900, 901)
)
FRAMES = r"""KPL/FK
\begindata
NAIF_BODY_NAME += ( 'TARGET', 'CHASER', 'CHASER_CAMERA' )
NAIF_BODY_CODE += ( -900, -901, -901100 )
""" + "".join(
    rf"""
FRAME_{name}           = {number}
FRAME_{number}_NAME     = '{name}'
FRAME_{number}_CLASS    = 3
FRAME_{number}_CLASS_ID = {number}
FRAME_{number}_CENTER   = {centre}
CK_{number}_SCLK        = {centre}
CK_{number}_SPK         = {centre}
"""
    for name, number, centre in (("TARGET_FIXED", -900_000, TARGET), ("CHASER_BODY", CAMERA, CHASER))
)
# the camera looks along the chaser's x axis, its columns run along -y and its rows along -z
MOUNTED = Rotation.from_matrix([[0, -1, 0], [0, 0, -1], [1, 0, 0]])
FRAMES += r"""
FRAME_CHASER_CAMERA       = -901100
FRAME_-901100_NAME        = 'CHASER_CAMERA'
FRAME_-901100_CLASS       = 4
FRAME_-901100_CLASS_ID    = -901100
FRAME_-901100_CENTER      = -901
TKFRAME_-901100_SPEC      = 'MATRIX'
TKFRAME_-901100_RELATIVE  = 'CHASER_BODY'
TKFRAME_-901100_MATRIX    = ( 0 -1 0  0 0 -1  1 0 0 )
"""
FIELD_OF_VIEW = r"""KPL/IK
\begindata
INS-901100_FOV_CLASS_SPEC  = 'CORNERS'
INS-901100_FOV_SHAPE       = 'RECTANGLE'
INS-901100_FOV_FRAME       = 'CHASER_CAMERA'
INS-901100_BORESIGHT       = ( 0 0 1 )
INS-901100_FOV_BOUNDARY_CORNERS = ( {x0} {y0} 1
                                    {x1} {y0} 1
                                    {x1} {y1} 1
                                    {x0} {y1} 1 )
"""
SCENE = """kernels: [leap.tls, clocks.tsc, frames.tf, camera.ti, paths.bsp, target.bc, chaser.bc]
spacecraft: CHASER
body: TARGET
body_frame: TARGET_FIXED
instrument: CHASER_CAMERA
"""


def write_texts(folder: Path, width: int, height: int, focal_px: float) -> None:
    """Write the leap seconds, clocks, frames, and an instrument whose axis meets the picture's middle."""
    x, y = width / 2 / focal_px, height / 2 / focal_px
    corners = FIELD_OF_VIEW.format(x0=repr(-x), x1=repr(x), y0=repr(-y), y1=repr(y))
    for name, text in {
        "leap.tls": LEAP_SECONDS,
        "clocks.tsc": CLOCKS,
        "frames.tf": FRAMES,
        "camera.ti": corners,
    }.items():
        (folder / name).write_text(text)


def write_paths(path: Path, segments: list[tuple[int, int, np.ndarray, np.ndarray]]) -> None:
    """Write an SPK: of each body its centre, times [N] TDB s, and states [N, 6] km, km/s; Lagrange or Hermite."""
    handle = spiceypy.spkopn(str(path), "made by a test", 0)
    for number, (body, centre, et, states) in enumerate(segments):
        ends = (handle, body, centre, "J2000", et[0], et[-1], f"path {number}")
        if number % 2:
            spiceypy.spkw13(*ends, 7, len(et), states, et)
        else:
            spiceypy.spkw08(*ends, 7, len(et), states, et[0], et[1] - et[0])
    spiceypy.spkcls(handle)


def write_attitude(path: Path, number: int, clock: int, et: np.ndarray, matrices: np.ndarray) -> None:
    """Write a CK of matrices [N, 3, 3] from J2000, between which SPICE turns at a constant rate."""
    ticks = np.array([spiceypy.sce2c(clock, t) for t in et])
    quats = np.array([spiceypy.m2q(matrix) for matrix in matrices])
    handle = spiceypy.ckopn(str(path), "made by a test", 0)
    rates, starts = np.zeros((len(et), 3)), ticks[:1]
    spiceypy.ckw03(
        *(handle, ticks[0], ticks[-1], number, "J2000", False, "made by a test"),
        *(len(et), ticks, quats, rates, 1, starts),
    )
    spiceypy.ckcls(handle)


def uniform(et: np.ndarray, velocity_km_s: np.ndarray, place_km: np.ndarray) -> np.ndarray:
    """Return states [N, 6] of a straight path, from the first time on."""
    return np.hstack([place_km + np.outer(et - et[0], velocity_km_s), np.tile(velocity_km_s, (len(et), 1))])


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """The golden pass as SPICE has it: chaser about target about Earth about the Sun."""
    folder = tmp_path_factory.mktemp("pass")
    write_pictures(folder)
    (folder / "spice.yaml").write_text(SCENE)
    camera = SESSION.camera
    write_texts(folder, camera.width, camera.height, camera.fx_px)
    taken, grid = TAKEN_NS, GRID_NS
    with spiceypy.KernelPool([str(folder / name) for name in ("leap.tls", "clocks.tsc")]):
        et, shots = (np.array([spiceypy.utc2et(utc(t)) for t in times]) for times in (grid, taken))
        target, chaser = (
            np.array([np.concatenate([s.position_m, s.velocity_m_s]) / 1e3 for s in states])
            for states in (
                [propagate(tle, t) for t in grid]
                for tle in (MISSION.orbit.target_tle, MISSION.orbit.chaser_tle)
            )
        )
        earth = uniform(et, *AROUND_SUN)
        sun_km = earth[:, :3] + 1.496e8 * np.array([sun_direction_gcrs(t) for t in grid])
        sun = np.hstack([sun_km, np.tile(AROUND_SUN[0], (len(et), 1))])
        paths = [(EARTH, 0, et, earth), (TARGET, EARTH, et, target), (CHASER, TARGET, et, chaser - target)]
        write_paths(folder / "paths.bsp", [*paths, (SUN, 0, et, sun)])
        attitudes = np.array([target_attitude(MISSION, t) for t in grid])
        write_attitude(folder / "target.bc", -900_000, TARGET, et, attitudes)
        turned = MOUNTED.as_matrix().T @ gcrs_to_cameras()
        write_attitude(folder / "chaser.bc", CAMERA, CHASER, shots, turned)
    return folder


@pytest.fixture(scope="module")
def imported(folder, tmp_path_factory) -> Path:
    return imported_from(folder, "spice", tmp_path_factory.mktemp("imported") / "session")


def test_an_import_has_the_poses_that_flight_tags(imported):
    """Satellites side by side share their motion about the Sun, so that light time and aberration cancel: 5 cm each."""
    session = open_session(imported)
    check_poses(session, ANGLE_RAD)
    assert session.camera.fx_px == pytest.approx(SESSION.camera.fx_px)
    for ours, flight in zip(session.frames, SESSION.frames, strict=True):
        body = quat_to_matrix(ours.quat_inertial_to_body)
        np.testing.assert_allclose(body, target_attitude(MISSION, flight.mid_exposure_utc_ns), atol=ANGLE_RAD)
    assert spiceypy.ktotal("ALL") == 0  # nothing stays in the pool of the process


def test_one_import_and_one_reconstruct_make_a_model(imported):
    options = ["--set", "steps=30", "--set", "start.count=300", "--set", "growth.max_gaussians=400"]
    done = ground("reconstruct", "--session", imported, "--name", "run", *options)
    assert done.exit_code == 0, done.output
    assert len(open_run(imported, "run").gaussians.means) > 100


@pytest.fixture(scope="module")
def flyby(tmp_path_factory) -> Path:
    """A body with a pole and a prime meridian, which a spacecraft passes at 12 km/s; one picture."""
    folder = tmp_path_factory.mktemp("flyby")
    write_texts(folder, 32, 24, 1000.0)
    (folder / "pole.tpc").write_text(
        "KPL/PCK\n\\begindata\nBODY-900_POLE_RA = ( 40 0 0 )\nBODY-900_POLE_DEC = ( 60 0 0 )\n"
        "BODY-900_PM = ( 10 90000 0 )\n"
    )
    (folder / "spin.tf").write_text(
        "KPL/FK\n\\begindata\nFRAME_SPINNING = 1900900\nFRAME_1900900_NAME = 'SPINNING'\nFRAME_1900900_CLASS = 2\n"
        "FRAME_1900900_CLASS_ID = -900\nFRAME_1900900_CENTER = -900\n"
    )
    with spiceypy.KernelPool([str(folder / name) for name in ("leap.tls", "clocks.tsc")]):
        et = spiceypy.utc2et("2026-07-21T10:00:00") + np.arange(0.0, 1000.0, 100.0)
        paths = [(TARGET, 0, et, uniform(et, *BODY)), (CHASER, 0, et, uniform(et, *PASSING))]
        write_paths(folder / "paths.bsp", paths)
        looking = np.tile((MOUNTED.inv() * AIM).as_matrix(), (len(et), 1, 1))
        write_attitude(folder / "chaser.bc", CAMERA, CHASER, et, looking)
    tifffile.imwrite(folder / "a.tif", np.ones((24, 32), np.uint16))
    (folder / "table.csv").write_text("name,mid_exposure_utc\na.tif,2026-07-21T10:05:00\n")
    return folder


BODY = np.array([-20.0, 10.0, 5.0]), np.array([2e8, 1e7, -3e7])  # km/s, km
PASSING = np.array([-28.0, 18.0, 9.0]), BODY[1] + np.array([-5000.0, 300.0, 80.0])
AIM = Rotation.from_euler("xyz", [100, 20, 30], degrees=True)  # J2000 to camera


def test_a_body_is_seen_where_it_was_when_the_light_left_it(flyby):
    """By hand, from straight paths and a uniform spin, and as SPICE corrects for light time and aberration."""
    (flyby / "spice.yaml").write_text(
        "kernels: [leap.tls, clocks.tsc, frames.tf, spin.tf, pole.tpc, paths.bsp, chaser.bc]\nspacecraft: CHASER\n"
        "body: '-900'\nbody_frame: SPINNING\ncamera_frame: CHASER_CAMERA\nfx_px: 1000\n"
    )
    (view,) = read_spice(flyby, read_table(flyby / "table.csv"))
    since, light_s = 300.0, 0.0
    for _ in range(5):
        apart = (BODY[1] - PASSING[1]) + (BODY[0] - PASSING[0]) * (since - light_s)
        light_s = np.linalg.norm(apart) / LIGHT_KM_S
    with spiceypy.KernelPool([str(flyby / name) for name in ("leap.tls", "frames.tf", "paths.bsp")]):
        et = spiceypy.utc2et("2026-07-21T10:05:00")
        apparent, _ = spiceypy.spkpos("TARGET", et, "J2000", "LT+S", "CHASER")
        geometric, _ = spiceypy.spkpos("TARGET", et, "J2000", "NONE", "CHASER")
    et -= light_s
    spin = Rotation.from_euler("ZXZ", [90 + 40, 90 - 60, 10 + 90000 * et / 86400], degrees=True)
    expected = AIM * spin  # body axes to camera
    np.testing.assert_allclose(view.world_to_camera[:3, 3], 1e3 * AIM.apply(apart), rtol=0, atol=0.01)
    turn = (Rotation.from_matrix(view.world_to_camera[:3, :3]) * expected.inv()).magnitude()
    assert turn < 1e-8  # of 9,000 turns since 2000
    assert not view.sun_dir_body.any()  # no kernel has the Sun
    seen = AIM.inv().apply(view.world_to_camera[:3, 3])
    squared_speed_over_light = 2e-8  # what orders are left out
    assert np.linalg.norm(np.cross(seen, apparent)) < squared_speed_over_light * np.linalg.norm(
        seen
    ) * np.linalg.norm(apparent)
    assert np.linalg.norm(np.cross(seen, geometric)) > 1e-5 * np.linalg.norm(seen) * np.linalg.norm(geometric)


def edit(name: str, old: str, new: str):
    return lambda folder: (folder / name).write_text((folder / name).read_text().replace(old, new))


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (
            lambda f: (f / "spice.yaml").unlink(),
            r"spice\.yaml: No such file or directory; expected spice\.yaml",
        ),
        (edit("spice.yaml", "spacecraft", "craft"), r"spice\.yaml: spice\.craft: unknown key"),
        (edit("spice.yaml", "paths.bsp, ", ""), r"shot_000\.tif: .* do not say where TARGET is from CHASER"),
        (edit("spice.yaml", "chaser.bc", "gone.bc"), r"gone\.bc: there is no such kernel"),
        (edit("spice.yaml", "chaser.bc", "../x.bc"), "leads out of the data set's folder"),
        (edit("spice.yaml", "chaser.bc", "table.csv"), r"table\.csv: "),
        (edit("spice.yaml", ", chaser.bc", ""), "do not say how CHASER_CAMERA is turned"),
        (edit("spice.yaml", "leap.tls, ", ""), r"do not say how UTC differs from TDB, .*naif0012\.tls"),
        (
            edit("spice.yaml", "camera.ti, ", ""),
            "no kernel gives the field of view of the instrument CHASER_CAMERA",
        ),
        (edit("spice.yaml", "TARGET_FIXED", "TARGET_FIX"), "no kernel defines the frame TARGET_FIX"),
        (edit("spice.yaml", "body: TARGET", "body: TARGETS"), "no kernel names the body TARGETS"),
        (edit("camera.ti", "RECTANGLE", "POLYGON"), None),
        (edit("camera.ti", "( 0 0 1 )", "( 0 0 -1 )"), None),
        (
            edit("table.csv", "2026-07-21", "2026-07-22"),
            r"paths\.bsp: TARGET 2026-07-21T\d\d:.* to 2026-07-21T",
        ),
        (
            edit("table.csv", "T10:52:30.0", "T10:52:29.9"),
            r"chaser\.bc: CHASER_BODY 2026-07-21T\d\d:.* to 2026-07-21T",
        ),
    ],
)
def test_what_the_kernels_lack_is_said_in_a_line(folder, tmp_path, change, said):
    (tmp_path / "images").mkdir()
    (tmp_path / "images" / "shot_000.tif").write_bytes((folder / "images" / "shot_000.tif").read_bytes())
    for path in folder.glob("*.*"):
        (tmp_path / path.name).write_bytes(path.read_bytes())
    (tmp_path / "table.csv").write_text("\n".join((folder / "table.csv").read_text().splitlines()[:2]) + "\n")
    change(tmp_path)
    options = ("--exposures", tmp_path / "table.csv", "--session", tmp_path / "s", "--poses", "stated")
    done = ground("import", "--format", "spice", "--from", tmp_path, *options)
    if said is None:
        assert done.exit_code == 0, done.output
        return
    assert done.exit_code in (1, 2) and isinstance(done.exception, Exception)
    assert len(str(done.exception).splitlines()) == 1
    with pytest.raises(type(done.exception), match=said):
        raise done.exception
    assert not (tmp_path / "s").exists() and spiceypy.ktotal("ALL") == 0


def test_without_axes_of_the_body_its_attitude_is_unknown(folder, tmp_path):
    for path in folder.iterdir():
        (tmp_path / path.name).symlink_to(path) if path.is_dir() else (tmp_path / path.name).write_bytes(
            path.read_bytes()
        )
    edit("spice.yaml", "body_frame: TARGET_FIXED\n", "")(tmp_path)
    options = ("--exposures", folder / "table.csv", "--session", tmp_path / "s", "--frames", 3)
    done = ground("import", "--format", "spice", "--from", tmp_path, *options)
    assert done.exit_code == 0, done.output
    assert open_session(tmp_path / "s").navigation.attitude == "unknown"
