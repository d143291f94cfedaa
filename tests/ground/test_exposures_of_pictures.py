"""How much light imported pictures took: EXIF, headers, tables, estimates, brackets; the walks of the documents."""

import dataclasses
import json
import re
import shlex
from datetime import UTC, datetime
from pathlib import Path

import imagecodecs
import numpy as np
import pytest
import tifffile
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image
from PIL.TiffImagePlugin import ImageFileDirectory_v2
from scipy.spatial.transform import Rotation

from flightsw.icd.ndm.formation import Formation
from flightsw.icd.ndm.write import Object, write_aem, write_oem
from flightsw.icd.quaternion import matrix_to_quat
from ground.formats.axes import world_to_camera_to_opengl
from ground.formats.photographs.brackets import brackets_of, in_brackets_of_places
from ground.formats.photographs.exposures import estimated, light_s, read_table, with_exposures
from ground.formats.photographs.poses import read_photographs
from ground.formats.pictures.files import FormatError, Light, decode, read_header
from ground.formats.pictures.lens import Intrinsics
from ground.formats.pictures.view import View
from ground.formats.pictures.views import Values
from ground.session.folder import open_session
from obbgs_base.srgb import to_srgb
from tests import raycast
from tests.commands import call

TIME_S, F_NUMBER, ISO, SHUTTER, APERTURE, TAKEN = 0x829A, 0x829D, 0x8827, 0x9201, 0x9202, 0x9003
SIZE_PX, FOCAL_PX = 160, 375.0
BOXES = [dataclasses.replace(raycast.spacecraft(5)[0], half_m=np.array([0.7, 0.6, 0.5]), cells=12)]
POSES = raycast.looking_at_origin(raycast.directions(10, 30), 4.5)
LENS = Intrinsics(SIZE_PX, SIZE_PX, FOCAL_PX, FOCAL_PX, SIZE_PX / 2, SIZE_PX / 2)
BRACKET_S = (0.01, 0.02, 0.04)
RNG = np.random.default_rng(2)


def exif(**entries) -> Image.Exif:
    made = Image.Exif()
    made[0x010F] = "a maker of cameras"
    for tag, value in entries.items():
        made.get_ifd(0x8769)[int(tag[1:])] = value
    return made


def photograph(path: Path, light: np.ndarray, **entries) -> Path:
    """Write a colour photograph of light 0 to 1 with EXIF entries by name."""
    numbers = {
        "time": TIME_S,
        "f": F_NUMBER,
        "iso": ISO,
        "shutter": SHUTTER,
        "aperture": APERTURE,
        "taken": TAKEN,
    }
    tags = exif(**{f"t{numbers[name]}": value for name, value in entries.items()})
    path.parent.mkdir(parents=True, exist_ok=True)
    shown = np.rint(255 * to_srgb(np.clip(light, 0, 1))).astype(np.uint8)
    image = Image.fromarray(np.repeat(shown[..., None], 3, axis=2))
    if path.suffix == ".tif":  # to which Pillow writes no EXIF folder by itself
        below = ImageFileDirectory_v2()
        below[0x8769] = dict(tags.get_ifd(0x8769))
        image.save(path, tiffinfo=below)
    else:
        image.save(path, exif=tags, quality=97)
    return path


def plain(path: Path, **entries) -> View:
    photograph(path, np.full((8, 8), 0.5), **entries)
    return View(path, np.eye(4), Intrinsics(8, 8, 9.0, 9.0, 4.0, 4.0))


@pytest.fixture(scope="module")
def scene() -> list[np.ndarray]:
    """Light of a textured box from ten places, 0 to 1, at an exposure of 0.02 s."""
    K = np.array(LENS.K)
    return [0.7 * raycast.cast(BOXES, pose, K, SIZE_PX, 2)[0] for pose in POSES]


# --- what pictures say ---


@pytest.mark.parametrize("suffix", ["jpg", "png", "webp", "tif"])
def test_exif_of_every_kind_gives_time_sensitivity_and_aperture(tmp_path, suffix):
    path = photograph(tmp_path / f"a.{suffix}", np.zeros((8, 8)), time=0.02, f=2.5, iso=800)
    light = read_header(path).light
    assert (light.time_s, light.f_number, light.iso) == pytest.approx((0.02, 2.5, 800))


def test_apex_values_stand_in_for_missing_ones(tmp_path):
    path = photograph(tmp_path / "a.jpg", np.zeros((8, 8)), shutter=6.0, aperture=4.0)
    light = read_header(path).light
    assert (light.time_s, light.f_number) == pytest.approx((1 / 64, 4.0))


def test_the_time_of_a_photograph_is_read(tmp_path):
    path = photograph(tmp_path / "a.jpg", np.zeros((8, 8)), taken="2016:05:24 15:30:55")
    assert read_header(path).light.taken_utc_ns == 1_464_103_855_000_000_000


@given(st.lists(st.tuples(*[st.floats(1e-3, 1e3)] * 3), min_size=1, max_size=9))
def test_light_is_time_times_sensitivity_over_the_square_of_the_f_number(entries):
    seconds = light_s([Light(time_s=t, iso=iso, f_number=f) for t, iso, f in entries])
    products = np.array([t * iso / f**2 for t, iso, f in entries])
    np.testing.assert_allclose(np.array(seconds) / seconds[0], products / products[0])


def test_exposure_times_of_equal_settings_are_those_of_the_pictures(tmp_path):
    views = [plain(tmp_path / f"{i}.jpg", time=t, iso=200, f=4.0) for i, t in enumerate(BRACKET_S)]
    assert [v.exposure_time_s for v in with_exposures(views)] == pytest.approx(BRACKET_S)


@pytest.mark.parametrize("said", [0, 2])
def test_that_pictures_do_not_say_it_is_told(tmp_path, said, caplog):
    views = [plain(tmp_path / f"{i}.jpg", **({"time": 0.02} if i < said else {})) for i in range(3)]
    assert {v.exposure_time_s for v in with_exposures(views)} == {1.0}
    told = "nothing states" if said == 0 else "1 of 3 pictures state no exposure time"
    assert told in caplog.text and "--exposures" in caplog.text


def test_dng_is_linear_and_says_its_exposure(tmp_path):
    pytest.importorskip("rawpy")
    raw = np.full((64, 80), 1000, np.uint16)
    raw[::2, ::2], raw[1::2, 1::2] = 4000, 2000  # red and blue of a Bayer pattern
    nine = tuple(n for row in np.eye(3, dtype=int) for v in row for n in (int(v), 1))
    tags = [
        (50706, "B", 4, bytes([1, 4, 0, 0]), True), (50708, "s", 0, "test", True),
        (33421, "H", 2, (2, 2), True), (33422, "B", 4, bytes([0, 1, 1, 2]), True), (50721, "2i", 9, nine, True),
        (50717, "I", 1, 16383, True), (50778, "H", 1, 21, True), (TIME_S, "2I", 1, (1, 50), True),
    ]  # fmt: skip
    tifffile.imwrite(tmp_path / "a.dng", raw, photometric=32803, extratags=tags)
    np.testing.assert_allclose(
        decode(tmp_path / "a.dng")[32, 40] / 65535, np.array([4, 1, 2]) / 16.383, rtol=2e-3
    )
    header = read_header(tmp_path / "a.dng")
    assert (header.width, header.height, header.light.time_s) == (80, 64, pytest.approx(0.02))


def test_gains_of_fits_headers_that_differ_need_a_table(tmp_path):
    fits = pytest.importorskip("astropy.io.fits")
    views = []
    for i in range(2):
        unit = fits.PrimaryHDU(np.full((8, 8), 99, np.uint16))
        unit.header["EXPTIME"], unit.header["GAIN"] = 0.5, 100 * (i + 1)
        unit.writeto(tmp_path / f"{i}.fits")
        views.append(View(tmp_path / f"{i}.fits", np.eye(4), Intrinsics(8, 8, 9.0, 9.0, 4.0, 4.0)))
    with pytest.raises(FormatError, match=r"gains that differ.*--exposures FILE\.csv"):
        with_exposures(views)
    table = {"0.fits": Light(time_s=0.5, gain=1.0), "1.fits": Light(time_s=0.5, gain=2.0)}
    seconds = [v.exposure_time_s for v in with_exposures(views, table)]
    assert seconds[1] / seconds[0] == pytest.approx(2)


# --- tables ---


def test_a_table_gives_what_the_pictures_do_not_say(tmp_path):
    (tmp_path / "t.csv").write_text(
        "name,exposure_time_s,iso\r\nimages/a.jpg,0.01,100\r\nb.jpg,0.02,400\r\n\r\n"
    )
    views = [plain(tmp_path / name, time=9.0) for name in ("a.jpg", "b.jpg")]
    seconds = [v.exposure_time_s for v in with_exposures(views, read_table(tmp_path / "t.csv"))]
    assert seconds[1] / seconds[0] == pytest.approx(8)
    with pytest.raises(FormatError, match=r"lacks 1 picture: c\.jpg"):
        with_exposures([*views, plain(tmp_path / "c.jpg")], read_table(tmp_path / "t.csv"))
    with pytest.raises(
        FormatError, match=r"none of the 1 pictures: it has a\.jpg, .* first picture is c\.jpg"
    ):
        with_exposures([plain(tmp_path / "c.jpg")], read_table(tmp_path / "t.csv"))


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("", "first line with name"),
        ("name\na.jpg\n", "first line with name"),
        ("name,time\na.jpg,1\n", "first line with name"),
        ("name,iso,comment\na.jpg,1,dark\n", "got 'name,iso,comment'; there is no column 'comment'"),
        ("name,iso,iso\na.jpg,1,1\n", "first line with name"),
        ("name,iso\na.jpg\n", "line 2: expected 2 values, got 1"),
        ("name,iso\na.jpg,1\nx/a.jpg,1\n", "line 3: a.jpg is listed twice"),
        ("name,exposure_time_s\na.jpg,fast\n", "line 2: exposure_time_s: expected a number"),
        ("name,exposure_time_s\na.jpg,-1\n", "expected a positive number, got -1"),
        ("name,exposure_time_s\na.jpg,nan\n", "expected a positive number"),
        ("name,exposure_time_s\na.jpg,1e400\n", "expected a positive number"),
        ('name,iso\n"a,1\n', "cannot be read"),
    ],
)
def test_a_table_that_cannot_be_right_is_refused_by_its_line(tmp_path, text, told):
    (tmp_path / "t.csv").write_text(text)
    with pytest.raises(FormatError, match=re.escape(told)):
        read_table(tmp_path / "t.csv")


def test_a_table_that_is_no_text_is_refused_by_its_first_wrong_byte(tmp_path):
    (tmp_path / "t.csv").write_bytes(b"name,iso\n\xff\xd8\n")
    with pytest.raises(FormatError, match=r"t.csv: byte 9 is no text in UTF-8; expected a table"):
        read_table(tmp_path / "t.csv")


@settings(max_examples=100, deadline=None)
@given(content=st.binary(max_size=80), whole=st.booleans())
def test_no_bytes_of_a_table_end_in_anything_but_a_named_error(tmp_path_factory, content, whole):
    path = tmp_path_factory.mktemp("table") / "t.csv"
    path.write_bytes(b"name,exposure_time_s\n" * whole + content)
    try:
        assert all(light.time_s and light.time_s > 0 for light in read_table(path).values())
    except FormatError as error:
        assert "t.csv" in str(error)


# --- estimates ---


def test_unknown_exposures_are_estimated_from_what_neighbours_share(tmp_path, scene, caplog):
    factors = np.array([1.0, 0.5, 0.7, 1.0, 0.35, 0.5, 1.2, 0.8, 0.6, 0.9])
    views = []
    for i, (light, factor) in enumerate(zip(scene, factors, strict=True)):
        views.append(View(photograph(tmp_path / f"{i}.png", factor * light), POSES[i], LENS))
    seconds = np.array([v.exposure_time_s for v in estimated(views, None)])
    np.testing.assert_allclose(seconds / seconds.max(), factors / factors.max(), rtol=0.05)
    assert seconds.max() == 1 and "exposures were estimated" in caplog.text
    grey = [dataclasses.replace(v, image=tmp_path / f"g{i}.png") for i, v in enumerate(views)]
    for v, light, factor in zip(grey, scene, factors, strict=True):
        dn = np.rint(np.minimum(4000 * factor * light, 2500))  # of 12 bits, saturated early
        v.image.write_bytes(imagecodecs.png_encode(dn.astype(np.uint16)))
    seconds = np.array([v.exposure_time_s for v in estimated(grey, Values.LINEAR)])
    np.testing.assert_allclose(seconds / seconds.max(), factors / factors.max(), rtol=0.05)


def test_pictures_that_share_nothing_have_no_estimate(tmp_path):
    views = [
        View(photograph(tmp_path / f"{i}.png", np.zeros((SIZE_PX, SIZE_PX))), POSES[i], LENS)
        for i in range(3)
    ]
    with pytest.raises(FormatError, match="no two pictures share enough"):
        estimated(views, None)


# --- brackets ---


def shots(times_s: list[float], taken_s: list[float] | None = None) -> list[View]:
    times_ns = [None] * len(times_s) if taken_s is None else [round(t * 1e9) for t in taken_s]
    return [
        View(Path(f"{i:03d}.jpg"), np.eye(4), LENS, exposure_time_s=t, mid_exposure_utc_ns=ns)
        for i, (t, ns) in enumerate(zip(times_s, times_ns, strict=True))
    ]


def numbers(views: list[View]) -> list[int]:
    return [number for number, group in enumerate(brackets_of(views)) for _ in group]


def test_exposures_that_come_again_in_the_same_order_are_brackets():
    assert numbers(shots(list(BRACKET_S) * 3)) == [0, 0, 0, 1, 1, 1, 2, 2, 2]
    lost = [*BRACKET_S * 4, 0.01, 0.04, *BRACKET_S * 4]  # a frame is missing
    assert numbers(shots(lost)) == [b for b in range(4) for _ in "123"] + [4, 4] + [
        b for b in range(5, 9) for _ in "123"
    ]
    paused = shots([0.01, 0.02] * 5, [20 * (i // 2) + i % 2 for i in range(10)])
    assert numbers(paused) == [i // 2 for i in range(10)]
    members = brackets_of(shots(list(BRACKET_S) * 3))[1]
    assert [(v.bracket, v.bracket_index) for v in members] == [(1, 0), (1, 1), (1, 2)]


def posed(places: list[int], shift_m: float = 0.0) -> list[View]:
    """Return views of exposures that come again in the same order, from places on a circle, each moved a little."""
    views = shots(list(BRACKET_S) * (len(places) // 3))
    moved = []
    for number, (view, place) in enumerate(zip(views, places, strict=True)):
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_euler("y", 20.0 * place, degrees=True).as_matrix()
        pose[:3, 3] = [shift_m * (number % 3), 0.0, 5.0]
        moved.append(dataclasses.replace(view, world_to_camera=pose))
    return moved


def test_pictures_with_known_cameras_are_brackets_where_each_was_taken_from_one_place():
    brackets = in_brackets_of_places(posed([i // 3 for i in range(18)], shift_m=0.005))
    assert [view.bracket for view in brackets] == [i // 3 for i in range(18)]
    assert all(view.bracket is None for view in in_brackets_of_places(posed(list(range(18)))))
    assert all(
        view.bracket is None for view in in_brackets_of_places(posed([i // 3 for i in range(18)], 0.1))
    )
    stated = [dataclasses.replace(view, split="train") for view in posed([i // 3 for i in range(18)])]
    assert all(view.bracket is None for view in in_brackets_of_places(stated))


@settings(max_examples=50)
@given(st.integers(0, 10**6))
def test_automatic_exposure_is_no_bracket(seed):
    times_s = np.random.default_rng(seed).choice([0.0125, 0.016, 0.02, 0.025, 0.033, 0.04], 40)
    groups = brackets_of(shots(list(times_s)))
    assert all(len(group) == 1 for group in groups) and all(group[0].bracket is None for group in groups)


def test_pictures_of_one_exposure_are_no_brackets():
    assert numbers(shots([0.02] * 7)) == list(range(7))


@pytest.fixture(scope="module")
def bracketed(tmp_path_factory, scene) -> Path:
    """Ten brackets of three photographs with EXIF, of which the longest saturates and the shortest is dim."""
    folder = tmp_path_factory.mktemp("data") / "photographs"
    for i, light in enumerate(scene):
        for k, time_s in enumerate(BRACKET_S):
            taken = f"2026:01:02 03:{i:02d}:{2 * k:02d}"
            photograph(
                folder / f"IMG_{3 * i + k:03d}.jpg", light * time_s / 0.02, time=time_s, iso=100, taken=taken
            )
    return folder


def test_photographs_of_brackets_are_registered_once_a_bracket(bracketed, tmp_path):
    found = read_photographs(bracketed, tmp_path / "work")
    assert not found.left_out and len(found.views) == 30
    for i in range(10):
        members = found.views[3 * i : 3 * i + 3]
        assert [v.exposure_time_s for v in members] == pytest.approx(BRACKET_S)
        assert {v.bracket for v in members} == {i} and [v.bracket_index for v in members] == [0, 1, 2]
        assert all((v.world_to_camera == members[0].world_to_camera).all() for v in members)
    centres = np.array([-v.world_to_camera[:3, :3].T @ v.world_to_camera[:3, 3] for v in found.views[::3]])
    true = np.array([-p[:3, :3].T @ p[:3, 3] for p in POSES])
    apart, true_apart = (np.linalg.norm(c[:, None] - c[None], axis=2) for c in (centres, true))
    scale = (apart * true_apart).sum() / (true_apart**2).sum()
    np.testing.assert_allclose(apart, scale * true_apart, atol=0.03 * scale * true_apart.max())
    assert not (tmp_path / "work").exists()


# --- the walks of docs/own-pictures.md ---


@pytest.fixture(scope="module")
def data(bracketed, scene) -> Path:
    """The folders that the page's commands name."""
    folder = bracketed.parent
    (folder / "colmap/sparse/0").mkdir(parents=True)
    (folder / "colmap/images").mkdir()
    rows, frames, table, poses = [], [], ["name,exposure_time_s"], []
    for number, path in enumerate(sorted(bracketed.iterdir())):
        (folder / f"colmap/images/{path.name}").write_bytes(path.read_bytes())
        pose = POSES[number // 3]
        quat = Rotation.from_matrix(pose[:3, :3]).as_quat(scalar_first=True)
        rows.append(f"{number + 1} {' '.join(map(str, [*quat, *pose[:3, 3]]))} 1 {path.name}\n\n")
    (folder / "colmap/sparse/0/images.txt").write_text("".join(rows))
    (folder / "colmap/sparse/0/cameras.txt").write_text(f"1 PINHOLE {SIZE_PX} {SIZE_PX} 375 375 80 80\n")
    for i, light in enumerate(scene):
        pose, gain = POSES[i], 0.5 + 0.05 * i
        opengl = world_to_camera_to_opengl(pose)
        for k, time_s in enumerate(BRACKET_S):
            name = f"f{3 * i + k:03d}.fits"
            write_fits(
                folder / "fits" / name, np.clip(4095 * light * time_s / 0.02, 0, 4095).astype(np.uint16)
            )
            frames.append({"file_path": name, "transform_matrix": opengl.tolist(), "bracket": i})
            table.append(f"{name},{time_s}")
        photograph(folder / f"llff/images/{i}.png", gain * light)
        (folder / "outlines").mkdir(exist_ok=True)
        outline = (255 * (light > 0)).astype(np.uint8)
        (folder / f"outlines/{i}.png").write_bytes(imagecodecs.png_encode(outline))
        right, up, backwards, place = opengl[:3].T
        poses.append(
            [*np.column_stack([-up, right, backwards, place, [SIZE_PX, SIZE_PX, 375.0]]).ravel(), 1, 9]
        )
    lens = {"w": SIZE_PX, "h": SIZE_PX, "fl_x": 375.0, "fl_y": 375.0, "cx": 80.0, "cy": 80.0}
    (folder / "fits/transforms.json").write_text(json.dumps({**lens, "frames": frames}))
    (folder / "fits/exposures.csv").write_text("\n".join(table) + "\n")
    np.save(folder / "llff/poses_bounds.npy", np.array(poses, dtype=float))
    write_pass(folder / "pass", sorted(bracketed.iterdir()))
    return folder


def write_pass(folder: Path, pictures: list[Path]) -> None:
    """Write pictures, their times, and messages of a camera on its way about a target that rests."""
    (folder / "images").mkdir(parents=True)
    start_ns, rows, times, quats, places = 1_784_631_150_000_000_000, ["name,mid_exposure_utc"], [], [], []
    for number, path in enumerate(pictures):
        (folder / "images" / path.name).write_bytes(path.read_bytes())
        times.append(start_ns + (number // 3) * 20_000_000_000 + (number % 3) * 500_000_000)
        taken = datetime.fromtimestamp(times[-1] / 1e9, UTC)
        rows.append(f"{path.name},{taken:%Y-%m-%dT%H:%M:%S.%f}")
        pose = POSES[number // 3]
        quats.append(matrix_to_quat(pose[:3, :3]))
        places.append(-pose[:3, :3].T @ pose[:3, 3])
    rest, chaser, target = np.tile([1.0, 0, 0, 0], (len(times), 1)), Object("CHASER"), Object("TARGET")
    way = (times, np.stack(places), np.zeros((len(times), 3)), None, start_ns, ("LINEAR", 1))
    files = {
        "chaser.oem": write_oem(chaser, "TARGET", *way),
        "chaser.aem": write_aem(chaser, "CAMERA", times, np.stack(quats), None, start_ns),
        "target.aem": write_aem(target, "SC_BODY_1", times, rest, None, start_ns),
        "camera.yaml": b"fx_px: 375.0\n",
        "table.csv": "\n".join(rows).encode() + b"\n",
    }
    for name, content in files.items():
        (folder / name).write_bytes(content)


def write_fits(path: Path, image: np.ndarray) -> None:
    fits = pytest.importorskip("astropy.io.fits")
    path.parent.mkdir(exist_ok=True)
    fits.PrimaryHDU(image[::-1]).writeto(path)  # rows count from the bottom


def test_every_command_of_the_page_does_what_the_page_says(data, monkeypatch):
    page = (Path(__file__).parents[2] / "docs/own-pictures.md").read_text()
    commands = [shlex.split(block) for block in re.findall(r"```sh\n(.*?)```", page, re.S)]
    # a video and kernels are made and imported by tests of their own
    commands = [command for command in commands if not {"video", "spice"} & set(command)]
    assert len(commands) == 7
    monkeypatch.chdir(data)
    for tool, *arguments in commands:
        quick = ["--set", "steps=20"] if arguments[0] == "reconstruct" else []
        done = call(tool, *arguments, *quick)
        assert done.returncode == 0, done.stderr
    expected = {"photographed": 30, "with-colmap": 30, "with-fits": 30, "with-masks": 10, "with-orbits": 30}
    sessions = {name: open_session(data / name) for name in expected}
    assert {name: len(session.frames) for name, session in sessions.items()} == expected
    for name in ("photographed", "with-colmap", "with-fits", "with-orbits"):
        assert sorted({r.exposure_time_s for r in sessions[name].frames}) == pytest.approx(BRACKET_S), name
        assert sessions[name].encoding == "linear"
    assert sessions["with-fits"].camera.bit_depth == 12 and sessions["with-fits"].frames[5].saturated > 0
    gains = [record.exposure_time_s for record in sessions["with-masks"].frames]
    np.testing.assert_allclose(np.array(gains) / gains[-1], (0.5 + 0.05 * np.arange(10)) / 0.95, rtol=0.05)
    assert (data / "with-masks/runs/first/model.ply").is_file()
    one, other = (sessions["with-fits"].dn(sessions["with-fits"].frames[i]).astype(float) for i in (0, 1))
    known = (other < 4095) & (one > 50)
    np.testing.assert_allclose(other[known] / one[known], 2, rtol=0.05)
    found = Formation.of({path.name: path.read_bytes() for path in (data / "found").glob("*em")})
    assert found.chaser.centre == "TARGET" and found.target_attitude is not None
    for name in ("with-colmap", "with-fits", "with-masks", "with-orbits"):  # the poses are those of the scene
        session = sessions[name]
        for record in session.frames[:: len(session.frames) // 10]:
            number = record.id * 10 // len(session.frames)
            np.testing.assert_allclose(record.world_to_camera, POSES[number], atol=1e-9)
