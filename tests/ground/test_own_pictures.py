"""Pictures as people have them: damaged, large, oddly coded, from other systems; taken right, told of, or refused."""

import contextlib
import dataclasses
import json
import math
import os
import struct
import tracemalloc
import zlib
from pathlib import Path

import imagecodecs
import numpy as np
import pytest
import tifffile
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from ground.formats.colmap import read_colmap
from ground.formats.llff import read_llff
from ground.formats.middlebury import read_middlebury
from ground.formats.nerf import read_nerf
from ground.formats.nerfstudio import read_nerfstudio
from ground.formats.pictures.files import KINDS, FormatError, decode, pictures_in, read_header, within
from ground.formats.pictures.lens import Intrinsics, pinhole_of, undistort
from ground.formats.pictures.masks import with_masks
from ground.formats.pictures.view import View
from ground.formats.pictures.views import Values, write_session
from ground.session.folder import open_session
from tests.commands import call

LENS = {"w": 16, "h": 16, "fl_x": 20.0, "fl_y": 20.0, "cx": 8.0, "cy": 8.0}
RNG = np.random.default_rng(5)


def png(path: Path, image: np.ndarray) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(imagecodecs.png_encode(image))
    return path


def view(path: Path, **changes) -> View:
    header = read_header(path)
    width, height = header.width, header.height
    lens = Intrinsics(width, height, 20.0, 20.0, width / 2, height / 2)
    return dataclasses.replace(View(path, np.eye(4), lens), **changes)


def transforms(folder: Path, frames: list[dict], **keys) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    posed = [{"transform_matrix": np.eye(4).tolist(), **frame} for frame in frames]
    (folder / "transforms.json").write_text(json.dumps({**LENS, **keys, "frames": posed}))
    return folder


def session_of(views: list[View], folder: Path, *arguments, **named):
    write_session(views, folder, "test", *arguments, **named)
    return open_session(folder)


# --- files that are damaged, too large or of another kind ---


def bomb(width: int, height: int) -> bytes:
    """Return a PNG of black pixels, small as a file."""

    def chunk(kind: bytes, content: bytes) -> bytes:
        crc = struct.pack(">I", zlib.crc32(kind + content))
        return struct.pack(">I", len(content)) + kind + content + crc

    stream = zlib.compressobj(9)
    row = bytes(3 * width + 1)
    packed = b"".join(stream.compress(row) for _ in range(min(height, 600))) + stream.flush()
    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", packed) + chunk(b"IEND", b"")


@pytest.mark.parametrize(("width", "height"), [(30_000, 30_000), (8193, 10), (10, 2**31 - 1)])
def test_a_picture_that_is_too_large_is_refused_by_its_header(tmp_path, width, height):
    path = tmp_path / "a.png"
    path.write_bytes(bomb(width, height))
    tracemalloc.start()
    with pytest.raises(FormatError, match=r"a\.png: expected at most 8192 pixels a side"):
        decode(path)
    assert tracemalloc.get_traced_memory()[1] < 10e6  # bytes
    tracemalloc.stop()


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".bmp", ".webp", ".tif"])
def test_a_file_that_was_cut_off_is_refused_in_one_line(tmp_path, suffix):
    Image.fromarray(RNG.integers(0, 255, (64, 64, 3), dtype=np.uint8)).save(tmp_path / f"whole{suffix}")
    whole = (tmp_path / f"whole{suffix}").read_bytes()
    assert decode(tmp_path / f"whole{suffix}").shape == (64, 64, 3)
    for kept in (0, 1, 9, len(whole) // 3, len(whole) // 2, len(whole) - 40):
        path = tmp_path / f"cut{suffix}"
        path.write_bytes(whole[:kept])
        with pytest.raises(FormatError, match=r"^\S+cut\.\w+: .*copy it again$") as caught:
            decode(path)
        assert "\n" not in str(caught.value)


def test_a_picture_of_another_kind_than_its_suffix_says_is_refused_by_name(tmp_path):
    Image.new("RGB", (8, 8)).save(tmp_path / "a.jpg")
    (tmp_path / "a.jpg").rename(tmp_path / "a.png")
    with pytest.raises(FormatError, match="suffix says PNG, its first bytes are those of JPEG: rename it"):
        decode(tmp_path / "a.png")
    (tmp_path / "a.img").write_bytes(b"PDS_VERSION_ID = PDS3")
    with pytest.raises(FormatError, match="convert PDS pictures to FITS or TIFF"):
        decode(tmp_path / "a.img")
    with pytest.raises(FormatError, match="none\\.png: the picture cannot be read: No such file"):
        decode(tmp_path / "none.png")


def test_what_is_no_file_does_not_keep_the_import_waiting(tmp_path):
    os.mkfifo(tmp_path / "a.png")
    (tmp_path / "b.png").mkdir()
    for name in ("a.png", "b.png"):
        with pytest.raises(FormatError, match="it is no file"):
            decode(tmp_path / name)


def test_a_tiff_of_more_values_a_pixel_than_pictures_have_is_refused_by_its_header(tmp_path):
    tifffile.imwrite(
        tmp_path / "a.tif", np.zeros((4, 4, 9), np.uint8), photometric="minisblack", planarconfig="contig"
    )
    with pytest.raises(FormatError, match="9 values of 8 bits a pixel are too many"):
        read_header(tmp_path / "a.tif")


@settings(max_examples=200, deadline=None)
@given(suffix=st.sampled_from(sorted(KINDS)), content=st.binary(max_size=300), whole=st.booleans())
def test_no_bytes_end_in_anything_but_a_named_error(tmp_path_factory, suffix, content, whole):
    path = tmp_path_factory.mktemp("any") / f"a{suffix}"
    starts = {
        ".png": b"\x89PNG\r\n\x1a\n",
        ".jpg": b"\xff\xd8\xff",
        ".tif": b"II*\0",
        ".hdr": b"#?RADIANCE\n",
    }
    path.write_bytes(starts.get(suffix, b"") * whole + content)
    with contextlib.suppress(FormatError, ModuleNotFoundError):
        decode(path)


@settings(max_examples=150, deadline=None)
@given(at=st.integers(0, 400), bit=st.integers(0, 7), kind=st.sampled_from(["png", "tif", "bmp"]))
def test_a_flipped_bit_in_a_header_ends_in_a_picture_or_a_named_error(tmp_path_factory, at, bit, kind):
    path = tmp_path_factory.mktemp("flip") / f"a.{kind}"
    Image.fromarray(np.arange(192, dtype=np.uint8).reshape(8, 8, 3)).save(path)
    content = bytearray(path.read_bytes())
    content[at % len(content)] ^= 1 << bit
    path.write_bytes(bytes(content))
    with contextlib.suppress(FormatError):
        assert decode(path).ndim == 3


def test_hidden_files_are_passed_over_and_windows_paths_understood(tmp_path):
    for i in range(3):
        png(tmp_path / f"images/{i}.png", np.zeros((16, 16, 3), np.uint8))
    (tmp_path / "images/._0.png").write_bytes(b"\x00\x05\x16\x07" + bytes(90))
    assert pictures_in(tmp_path / "images") == ["0.png", "1.png", "2.png"]
    views, _ = read_nerfstudio(transforms(tmp_path, [{"file_path": f"images\\{i}.png"} for i in range(3)]))
    assert [v.image.resolve() for v in views] == [tmp_path.resolve() / f"images/{i}.png" for i in range(3)]
    views, _ = read_nerfstudio(transforms(tmp_path, [{"file_path": "images/9.png"}]))
    with pytest.raises(FormatError, match=r"images/9\.png: the picture cannot be read: No such file"):
        session_of(views, tmp_path / "s")


@pytest.mark.parametrize(
    "name", ["../secret.png", "/etc/hostname", "images/../../secret.png", "link/a.png", "a\0"]
)
def test_no_path_of_a_data_set_leads_out_of_it(tmp_path, name):
    data = tmp_path / "data"
    png(tmp_path / "secret.png", np.zeros((16, 16), np.uint8))
    png(tmp_path / "elsewhere/a.png", np.zeros((16, 16), np.uint8))
    data.mkdir()
    (data / "link").symlink_to(tmp_path / "elsewhere")
    for keys in ({"file_path": name}, {"file_path": "a.png", "mask_path": name}):
        with pytest.raises(FormatError, match=r"leads out of the data set|byte 0"):
            read_nerfstudio(transforms(data, [keys]))
    if "\0" in name or name.startswith("/"):
        return
    (data / "cameras.txt").write_text("1 PINHOLE 16 16 9 9 8 8\n")
    (data / "images.txt").write_text(f"1 1 0 0 0 0 0 5 1 ../{name}\n\n")
    with pytest.raises(FormatError, match="leads out of the data set"):
        read_colmap(data)


@given(name=st.text(max_size=40))
def test_a_name_stays_within_the_folder_or_is_refused(tmp_path_factory, name):
    folder = tmp_path_factory.mktemp("within")
    with contextlib.suppress(FormatError, OSError):
        assert within(folder, name, "here").resolve().is_relative_to(folder.resolve())


KEYS = st.sampled_from([*LENS, "k1", "k4", "camera_model", "is_fisheye", "camera_angle_x", "skew", "frames"])
FRAME_KEYS = st.sampled_from(
    ["file_path", "mask_path", "transform_matrix", "exposure_time_s", "bracket", "frame_id", "k1", "w"]
)
JSON = st.recursive(
    st.none() | st.booleans() | st.integers(-(10**30), 10**30) | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=3), inner, max_size=3),
    max_leaves=6,
)


@settings(max_examples=150, deadline=None)
@given(keys=st.dictionaries(KEYS, JSON, max_size=3), frame=st.dictionaries(FRAME_KEYS, JSON, max_size=3))
def test_no_value_of_any_key_ends_in_anything_but_a_named_error(tmp_path_factory, keys, frame):
    folder = tmp_path_factory.mktemp("keys")
    png(folder / "a.png", np.zeros((16, 16), np.uint8))
    tree = {
        **LENS,
        "frames": [{"file_path": "a.png", "transform_matrix": np.eye(4).tolist(), **frame}],
        **keys,
    }
    for name, read in (("transforms.json", read_nerfstudio), ("transforms_train.json", read_nerf)):
        (folder / name).write_text(json.dumps(tree))
        with contextlib.suppress(FormatError):
            read(folder)


@pytest.mark.parametrize("kind", ["empty picture", "no frames", "no pictures in the model", "cut picture"])
def test_a_broken_data_set_is_one_line_and_no_traceback(tmp_path, kind):
    for i in range(4):
        png(tmp_path / f"images/{i}.png", RNG.integers(0, 255, (16, 16, 3), dtype=np.uint8))
    frames = [{"file_path": f"images/{i}.png"} for i in range(4)]
    whole = (tmp_path / "images/2.png").read_bytes()
    if "picture" in kind and "model" not in kind:
        (tmp_path / "images/2.png").write_bytes(b"" if kind == "empty picture" else whole[: len(whole) // 2])
    transforms(tmp_path, [] if kind == "no frames" else frames)
    (tmp_path / "cameras.txt").write_text("1 PINHOLE 16 16 20 20 8 8\n")
    (tmp_path / "images.txt").write_text("# no images\n")
    format_ = "colmap" if "model" in kind else "nerfstudio"
    command = (
        "import",
        "--format",
        format_,
        "--from",
        tmp_path,
        "--session",
        tmp_path / "s",
        "--poses",
        "stated",
    )
    done = call("ground", *command)
    lines = [s for s in done.stderr.splitlines() if s.startswith("ground:")]
    assert done.returncode == 1 and len(lines) == 1 and "Traceback" not in done.stderr
    assert not (tmp_path / "s/session.json").exists()


# --- what the pictures are, judged on all of them ---


@pytest.mark.parametrize("first", [np.zeros((16, 16), np.uint8), np.zeros((16, 16, 3), np.uint16)])
def test_one_odd_picture_does_not_decide_for_all(tmp_path, first, caplog):
    picture = np.zeros((16, 16, 3), np.uint8)
    picture[4:12, 4:12] = (200, 100, 20)
    for order in ("first", "last"):
        views = [view(png(tmp_path / f"{order}{i}.png", picture)) for i in range(4)]
        odd = view(png(tmp_path / f"{order}-odd.png", first))
        session = session_of([odd, *views] if order == "first" else [*views, odd], tmp_path / order)
        assert (session.camera.channels, session.encoding) == (3, "srgb")
        share = session.dn(session.frames[2])[8, 8] / session.camera.white_dn
        np.testing.assert_allclose(share, np.array([200, 100, 20]) / 255, atol=1e-4)
    assert "the pictures are not all alike" in caplog.text


@pytest.mark.parametrize(
    ("full", "bits"),
    [(4095, 12), (1023, 10), (16383, 14), (65535, 16), (4000, 12), (65520, 16), (65535 - 63, 16)],
)
def test_full_scale_is_where_values_pile_up(tmp_path, full, bits, caplog):
    views = []
    for i in range(4):
        picture = RNG.integers(0, full // 2, (32, 32)).astype(np.uint16)
        picture[8:24, 8:24] = np.clip(RNG.integers(full // 4, int(1.5 * full), (16, 16)), 0, full)
        views.append(view(png(tmp_path / f"{i}.png", picture)))
    session = session_of(views, tmp_path / "s")
    assert session.camera.bit_depth == bits
    for record, source in zip(session.frames, views, strict=True):
        clipped = imagecodecs.imread(source.image) == full
        assert record.saturated == clipped.sum() > 20
        np.testing.assert_array_equal(session.dn(record) == session.camera.white_dn, clipped)
    assert (f"full scale is taken to be {full}" in caplog.text) == (full < 65535)


def test_a_flat_bright_surface_is_not_taken_for_full_scale(tmp_path):
    picture = np.zeros((32, 32), np.uint16)
    picture[8:24, 8:24] = 40_000
    session = session_of([view(png(tmp_path / f"{i}.png", picture)) for i in range(3)], tmp_path / "s")
    assert session.camera.bit_depth == 16 and all(record.saturated == 0 for record in session.frames)
    eight = [view(png(tmp_path / f"e{i}.png", (picture >> 8).astype(np.uint8))) for i in range(3)]
    assert all(r.saturated == 0 for r in session_of(eight, tmp_path / "e").frames)


def test_values_that_pile_up_at_several_exposures_are_clipped_wherever_that_is(tmp_path):
    views = []
    for i, time_s in enumerate((0.1, 0.2, 0.4)):
        light = RNG.uniform(200, 2000, (32, 32))
        picture = np.minimum(light * time_s, 200).astype(np.uint8)
        views.append(view(png(tmp_path / f"{i}.png", picture), exposure_time_s=time_s))
    session = session_of(views, tmp_path / "s")
    assert [r.saturated > 50 for r in session.frames] == [False, True, True]


def test_bright_borders_are_told_unless_the_background_is_white_or_a_mask_says_what_it_is(tmp_path, caplog):
    picture = np.full((16, 16, 3), 250, np.uint8)
    picture[4:12, 4:12] = 40
    mask = png(tmp_path / "mask.png", np.pad(np.full((8, 8), 255, np.uint8), 4))
    views = [view(png(tmp_path / f"{i}.png", picture)) for i in range(3)]
    session_of(views, tmp_path / "told")
    assert "the borders of 3 of 3 pictures are bright" in caplog.text and "--background white" in caplog.text
    caplog.clear()
    session_of(views, tmp_path / "white", white_background=True)
    session = session_of([dataclasses.replace(v, mask=mask) for v in views], tmp_path / "masked")
    assert "bright" not in caplog.text and session.dn(session.frames[0])[0, 0].tolist() == [0, 0, 0]
    lit_at_the_border = np.dstack([picture, np.full((16, 16), 255, np.uint8)])
    lit_at_the_border[4:12, 4:12, 3] = 0
    session_of(
        [view(png(tmp_path / f"clear{i}.png", lit_at_the_border)) for i in range(3)], tmp_path / "clear"
    )
    assert "bright" not in caplog.text


def test_masks_of_a_folder_have_the_names_of_the_pictures(tmp_path):
    views = [
        view(png(tmp_path / f"images/{name}", np.full((8, 8), 200, np.uint8))) for name in ("a.png", "b.png")
    ]
    png(tmp_path / "masks/a.png.png", np.eye(8, dtype=np.uint8))  # 0 and 1, as some tools write
    with pytest.raises(FormatError, match=r"no mask is there of 1 picture: b\.png"):
        with_masks(views, tmp_path / "masks")
    png(tmp_path / "masks/b.png", np.zeros((4, 4), np.uint8))
    masked = with_masks(views, tmp_path / "masks")
    with pytest.raises(FormatError, match="expected a mask of 8x8 pixels"):
        session_of(masked, tmp_path / "s")
    png(tmp_path / "masks/b.png", np.full((8, 8), 255, np.uint8))
    session = session_of(masked, tmp_path / "s")
    np.testing.assert_array_equal(session.dn(session.frames[0]), 200 * np.eye(8))
    Image.new("L", (8, 8)).save(tmp_path / "masks/a.png.bmp")
    with pytest.raises(FormatError, match=r"two masks for a\.png"):
        with_masks(views, tmp_path / "masks")


@pytest.mark.parametrize("mode", ["P", "1", "LA", "CMYK", "RGBA"])
def test_every_way_of_storing_a_picture_gives_its_colours(tmp_path, mode):
    colours = np.zeros((8, 8, 3), np.uint8)
    colours[2:6, 2:6] = 255
    suffix = "tif" if mode == "CMYK" else "png"
    Image.fromarray(colours).convert(mode).save(tmp_path / f"a.{suffix}")
    if mode == "CMYK":
        with pytest.raises(FormatError, match="SEPARATED"):
            decode(tmp_path / f"a.{suffix}")
        return
    image = decode(tmp_path / f"a.{suffix}")
    assert (image[4, 4, : 1 if image.shape[2] <= 2 else 3] == 255).all()
    assert (image[0, 0, : 1 if image.shape[2] <= 2 else 3] == 0).all()


# --- lenses ---


def test_a_lens_that_folds_back_leaves_no_ghosts_and_is_cropped_to_what_it_saw(tmp_path, caplog):
    side, focal_px, k1 = 96, 34.0, -0.33
    y, x = np.mgrid[0.5:side, 0.5:side]
    radius = np.hypot(x - side / 2, y - side / 2)
    disc = (radius < 10).astype(float)[..., None]
    lens = Intrinsics(side, side, focal_px, focal_px, 48.0, 48.0, (k1, 0.0, 0.0, 0.0, 0.0))
    assert lens.largest_radius == pytest.approx(1 / math.sqrt(-3 * k1))
    out = undistort(disc, lens)[..., 0]
    assert not (out[radius > focal_px * lens.largest_radius] > 0).any()
    path = png(tmp_path / "a.png", np.full((side, side), 200, np.uint8))
    session = session_of([view(path, intrinsics=lens)], tmp_path / "s")
    assert (session.dn(session.frames[0]) == 200).all()  # nothing that nobody saw
    assert session.camera.fx_px > focal_px and "cropped to what it saw" in caplog.text


@settings(max_examples=40, deadline=None)
@given(
    k1=st.floats(-0.4, 0.4),
    k2=st.floats(-0.2, 0.2),
    p1=st.floats(-0.02, 0.02),
    skew=st.floats(-3, 3),
    focal=st.floats(25, 100),
)
def test_every_pixel_of_a_corrected_picture_was_seen(k1, k2, p1, skew, focal):
    lens = Intrinsics(40, 30, focal, 1.1 * focal, 19.0, 16.0, (k1, k2, p1, 0.0, 0.0), skew)
    try:
        camera = pinhole_of(lens)
    except ValueError:
        return
    assert undistort(np.ones((30, 40, 1)), lens, 0.0, camera).min() > 1 - 1e-9
    assert camera.is_pinhole and camera.fx_px >= lens.fx_px


def test_skew_is_warped_away(tmp_path):
    """A dot at each of some places of a skewed picture is where a camera without skew sees its ray."""
    K = np.array([[60.0, 6.0, 31.5], [0.0, 55.0, 23.5], [0.0, 0.0, 1.0]])
    lines = []
    for i, ray in enumerate(([0.1, 0.2, 1.0], [-0.3, -0.25, 1.0], [0.2, -0.1, 1.0])):
        u, v, _ = K @ ray  # the centre of the first pixel is at 0 there
        y, x = np.mgrid[0:48, 0:64]
        dot = 255 * np.exp(-((x - u) ** 2 + (y - v) ** 2) / 8)
        png(tmp_path / f"p{i}.png", dot.astype(np.uint8))
        lines.append(f"p{i}.png " + " ".join(map(str, [*K.ravel(), *np.eye(3).ravel(), 0, 0, 5])))
    (tmp_path / "p_par.txt").write_text("3\n" + "\n".join(lines) + "\n")
    session = session_of(read_middlebury(tmp_path), tmp_path / "s")
    for record, ray in zip(session.frames, ([0.1, 0.2], [-0.3, -0.25], [0.2, -0.1]), strict=True):
        dn = session.dn(record).astype(float)
        y, x = np.mgrid[0.5:48, 0.5:64]
        seen = [(axis * dn).sum() / dn.sum() for axis in (x, y)]
        fx, fy, cx, cy = (getattr(session.camera, name) for name in ("fx_px", "fy_px", "cx_px", "cy_px"))
        np.testing.assert_allclose(seen, [fx * ray[0] + cx, fy * ray[1] + cy], atol=0.2)


def test_a_camera_of_more_pixels_than_any_is_refused_before_it_costs_memory(tmp_path):
    png(tmp_path / "a.png", np.zeros((16, 16), np.uint8))
    transforms(tmp_path, [{"file_path": "a.png"}], w=10**9, h=10**9, k1=0.1)
    with pytest.raises(FormatError, match="1 to 8192 pixels a side"):
        read_nerfstudio(tmp_path)


@pytest.mark.parametrize("keys", [{"is_fisheye": True}, {"k5": 0.1}, {"k6": 0.1}, {"k4": 0.1}, {"s1": 0.1}])
def test_a_lens_that_is_not_modelled_is_refused_with_the_remedy(tmp_path, keys):
    png(tmp_path / "a.png", np.zeros((16, 16), np.uint8))
    for name, read in (("transforms.json", read_nerfstudio), ("transforms_train.json", read_nerf)):
        transforms(tmp_path, [{"file_path": "a.png"}], **keys)
        if name != "transforms.json":
            (tmp_path / "transforms.json").rename(tmp_path / name)
        with pytest.raises(FormatError, match=f"{next(iter(keys))} belongs to a lens .* undistort"):
            read(tmp_path)


def test_pixels_that_are_not_square_are_read(tmp_path):
    png(tmp_path / "a.png", np.zeros((40, 40), np.uint8))
    frames = [{"file_path": "a.png", "transform_matrix": np.eye(4).tolist()}]
    angles = {"camera_angle_x": 2 * math.atan(20 / 60), "camera_angle_y": 2 * math.atan(20 / 45)}
    (tmp_path / "transforms_train.json").write_text(json.dumps({**angles, "frames": frames}))
    lens = read_nerf(tmp_path)[0][0].intrinsics
    assert (lens.fx_px, lens.fy_px) == pytest.approx((60, 45))


# --- COLMAP and LLFF ---

ROWS = [f"{i + 1} 1 0 0 0 {0.1 * i} 0 5 1 {i}.png" for i in range(6)]


def colmap(folder: Path, images: str) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "cameras.txt").write_text("1 PINHOLE 8 8 9 9 4 4\n")
    (folder / "images.txt").write_text(images)
    return folder


@pytest.mark.parametrize(
    "text",
    [
        "# header\n" + "\n".join(ROWS),
        "# header\n\n" + "\n\n".join(ROWS),
        "\n\n".join(ROWS[:3]) + "\n\n\n\n" + "\n".join(ROWS[3:]),
        "\n".join(f"{row}\n1.5 2.5 -1 3 4 7" for row in ROWS),
        "\r\n\r\n".join(ROWS),
    ],
)
def test_no_picture_of_a_text_model_is_lost(tmp_path, text):
    views = read_colmap(colmap(tmp_path, text))
    assert [v.image.name for v in views] == [f"{i}.png" for i in range(6)]
    assert [v.world_to_camera[0, 3] for v in views] == pytest.approx([0.1 * i for i in range(6)])


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("\n".join([*ROWS, ROWS[0]]), "listed twice"),
        ("1 1 0 0 0 0 0 5 9 a.png", "camera 9, which is not listed"),
        ("1 1 0 0 0 0 0 5 1", "line 1: expected a picture"),
        ("1 1 0 0 0 0 nan 5 1 a.png", "finite"),
        ("", "has no pictures"),
    ],
)
def test_a_text_model_that_cannot_be_right_is_refused(tmp_path, text, told):
    with pytest.raises(FormatError, match=told):
        read_colmap(colmap(tmp_path, text))


def test_the_larger_of_two_models_is_taken_and_the_other_named(tmp_path, caplog):
    colmap(tmp_path / "sparse/0", "\n\n".join(ROWS[:2]))
    colmap(tmp_path / "sparse/1", "\n\n".join(ROWS))
    assert len(read_colmap(tmp_path)) == 6
    assert "sparse/0 has 2" in caplog.text and "6, is taken" in caplog.text


@pytest.fixture(scope="module")
def binary_model(tmp_path_factory) -> dict[str, bytes]:
    """A model of two cameras and five pictures as COLMAP's own library writes it, by file name."""
    import pycolmap

    folder = tmp_path_factory.mktemp("colmap")
    colmap(folder, "\n\n".join(ROWS[:5]) + "\n\n")
    (folder / "points3D.txt").write_text("")
    pycolmap.Reconstruction(str(folder)).write_binary(str(folder))
    return {path.name: path.read_bytes() for path in folder.glob("*.bin")}


@settings(max_examples=150, deadline=None)
@given(
    name=st.sampled_from(["cameras.bin", "images.bin"]),
    at=st.integers(0, 10_000),
    bit=st.integers(0, 7),
    kept=st.floats(0, 1) | st.just(1.0),
)
def test_no_damage_of_a_binary_model_ends_in_anything_but_a_named_error(
    tmp_path_factory, binary_model, name, at, bit, kept
):
    folder = tmp_path_factory.mktemp("bits")
    for other, content in binary_model.items():
        (folder / other).write_bytes(content)
    assert len(read_colmap(folder)) == 5
    content = bytearray(binary_model[name])
    content[at % len(content)] ^= 1 << bit
    (folder / name).write_bytes(bytes(content[: round(kept * len(content))]))
    with contextlib.suppress(FormatError):
        read_colmap(folder)


@settings(max_examples=150, deadline=None)
@given(
    lines=st.lists(st.sampled_from(ROWS) | st.text(max_size=30) | st.just("") | st.just("1 2 -1"), max_size=6)
)
def test_no_text_of_a_model_ends_in_anything_but_a_named_error(tmp_path_factory, lines):
    folder = colmap(tmp_path_factory.mktemp("text"), "")
    (folder / "images.txt").write_text("\n".join(lines), encoding="utf-8", errors="replace")
    with contextlib.suppress(FormatError):
        read_colmap(folder)


def llff(folder: Path, count: int = 3, size: int = 24, stated: int = 48) -> np.ndarray:
    """Write a folder whose cameras look at the origin from random places, and return these places."""
    rows, places = [], RNG.normal(size=(count, 3)) * 3
    for i, place in enumerate(places):
        backwards = place / np.linalg.norm(place)
        right = np.cross([0.0, 0.0, 1.0], backwards)
        right /= np.linalg.norm(right)
        down = np.cross(right, backwards)
        matrix = np.column_stack([down, right, backwards, place, [stated, stated, 60.0]])
        rows.append([*matrix.ravel(), 1.0, 9.0])
        png(folder / f"images/{i}.png", np.full((size, size), 99, np.uint8))
    np.save(folder / "poses_bounds.npy", np.array(rows))
    return places


def test_llff_cameras_see_the_origin_in_the_middle_and_shrink_with_their_pictures(tmp_path):
    places = llff(tmp_path)
    png(tmp_path / "masks/1.png", np.zeros((24, 24), np.uint8))
    views = read_llff(tmp_path)
    for v, place in zip(views, places, strict=True):
        seen = v.world_to_camera @ [0, 0, 0, 1]
        np.testing.assert_allclose(seen[:3], [0, 0, np.linalg.norm(place)], atol=1e-9)
        above = v.world_to_camera[:3, :3] @ [0, 0, 1]
        assert above[1] < 0  # y points down, the world's z up
        assert v.intrinsics.K[0][0] == pytest.approx(30.0) and v.intrinsics.cx_px == 12
    assert [v.mask and v.mask.name for v in views] == [None, "1.png", None]


@pytest.mark.parametrize(
    ("spoil", "told"),
    [
        (lambda f: (f / "images/2.png").unlink(), "3 poses, but images/ has 2 pictures"),
        (lambda f: np.save(f / "poses_bounds.npy", np.zeros((3, 15))), "rows of 17"),
        (lambda f: np.save(f / "poses_bounds.npy", np.zeros((3, 17))), "holds no rotation"),
        (lambda f: np.save(f / "poses_bounds.npy", np.array([{}]), allow_pickle=True), "cannot be read"),
        (lambda f: (f / "poses_bounds.npy").unlink(), "cannot be read"),
        (lambda f: png(f / "images/0.png", np.zeros((24, 12), np.uint8)), "of another shape"),
    ],
)
def test_an_llff_folder_that_cannot_be_right_is_refused(tmp_path, spoil, told):
    llff(tmp_path)
    spoil(tmp_path)
    with pytest.raises(FormatError, match=told):
        read_llff(tmp_path)


# --- other kinds of pictures ---


@pytest.mark.parametrize("kind", ["plain", "scaled", "top-down", "float"])
def test_fits_is_read_with_its_scale_and_from_the_bottom(tmp_path, kind):
    fits = pytest.importorskip("astropy.io.fits")
    data = RNG.integers(0, 4000, (6, 9)).astype(np.float32 if kind == "float" else np.uint16)
    unit = fits.PrimaryHDU(data)
    if kind == "scaled":
        unit = fits.PrimaryHDU(data.astype(np.int16))
        unit.header["BSCALE"], unit.header["BZERO"] = 0.5, 10.0
    if kind == "top-down":
        unit.header["ROWORDER"] = "TOP-DOWN"
    unit.header["EXPTIME"], unit.header["DATE-OBS"] = 0.25, "2026-01-02T03:04:05.5"
    unit.writeto(tmp_path / "a.fits")
    image, header = decode(tmp_path / "a.fits")[..., 0], read_header(tmp_path / "a.fits")
    expected = fits.getdata(tmp_path / "a.fits").astype(float)
    np.testing.assert_allclose(image, expected if kind == "top-down" else expected[::-1])
    assert (header.width, header.height, header.light.time_s) == (9, 6, 0.25)
    assert header.light.taken_utc_ns == 1_767_323_045_500_000_000


@pytest.mark.parametrize("suffix", [".exr", ".hdr", ".tif"])
def test_linear_pictures_of_floats_stay_linear(tmp_path, suffix):
    light = RNG.uniform(0, 20, (10, 12, 3)).astype(np.float32)
    path = tmp_path / f"a{suffix}"
    if suffix == ".exr":
        exr = pytest.importorskip("OpenEXR")
        header = {"compression": exr.ZIP_COMPRESSION, "type": exr.scanlineimage}
        with exr.File(header, {"RGB": light}) as file:
            file.write(str(path))
    elif suffix == ".hdr":
        path.write_bytes(imagecodecs.rgbe_encode(light))
    else:
        tifffile.imwrite(path, light, photometric="rgb")
    np.testing.assert_allclose(decode(path), light, rtol=0.01, atol=20 / 128)
    session = session_of([view(path)], tmp_path / "s")
    assert session.encoding == "linear" and session.camera.bit_depth == 16
    share = session.dn(session.frames[0]) / session.camera.white_dn
    np.testing.assert_allclose(share, decode(path) / decode(path).max(), atol=1e-4)


def test_transparent_exr_is_put_on_the_background_once(tmp_path):
    exr = pytest.importorskip("OpenEXR")
    image = np.zeros((8, 8, 4), np.float32)
    image[2:6, 2:6] = (1.0, 0.5, 0.25, 0.5)  # colours times alpha, as the format has them
    header = {"compression": exr.ZIP_COMPRESSION, "type": exr.scanlineimage}
    with exr.File(header, {"RGBA": image}) as file:
        file.write(str(tmp_path / "a.exr"))
    np.testing.assert_allclose(decode(tmp_path / "a.exr")[4, 4], [2, 1, 0.5, 0.5])
    session = session_of([view(tmp_path / "a.exr")], tmp_path / "s")
    dn = session.dn(session.frames[0])
    np.testing.assert_allclose(dn[4, 4] / session.camera.white_dn, [0.5, 0.25, 0.125], atol=1e-4)
    assert dn[0, 0].tolist() == [0, 0, 0]


def test_a_float_that_is_none_is_refused(tmp_path):
    image = np.ones((4, 4), np.float32)
    image[1, 2] = np.nan
    tifffile.imwrite(tmp_path / "a.tif", image)
    with pytest.raises(FormatError, match="1 values that are not finite"):
        decode(tmp_path / "a.tif")
    tifffile.imwrite(tmp_path / "b.tif", np.array([[1.0, -2.0]], np.float32))
    assert decode(tmp_path / "b.tif").min() == 0


def test_decode_is_asked_for_where_display_values_have_exposure_times(tmp_path, caplog):
    views = [
        view(png(tmp_path / f"{i}.png", np.full((8, 8, 3), 90, np.uint8)), exposure_time_s=0.01 * (i + 1))
        for i in range(2)
    ]
    assert session_of(views, tmp_path / "s").encoding == "linear" and "as with --values decode" in caplog.text
    caplog.clear()
    assert session_of(views, tmp_path / "d", Values.DISPLAY).encoding == "srgb"
    assert "not proportional to light" in caplog.text
