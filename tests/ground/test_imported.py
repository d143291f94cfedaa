"""What a stranger's data set says is kept: its splits, background, encoding, and the intrinsics of each picture."""

import json
import math
import re
import shutil
from pathlib import Path

import imagecodecs
import numpy as np
import pycolmap
import pytest
import torch
from PIL import Image
from skimage import color
from skimage.color import colorconv  # of itself: color loads it lazily
from skimage.metrics import peak_signal_noise_ratio

from ground.commands.options import PixelValues
from ground.formats.axes import world_to_camera_to_opengl
from ground.formats.colmap import read_colmap
from ground.formats.nerf import export_nerf, read_nerf
from ground.formats.nerfstudio import export_nerfstudio, read_nerfstudio
from ground.formats.pictures.judgement import judge
from ground.formats.pictures.views import (
    FormatError,
    Intrinsics,
    Values,
    View,
    first_of_each_split,
    write_session,
)
from ground.run.evaluate import evaluate
from ground.run.reconstruct import reconstruct
from ground.run.runs import open_run
from ground.session.cameras import cameras_of, predicted_image
from ground.session.folder import SessionCorrupt, SessionError, open_session
from ground.session.training_frames import split, training_frame
from ground.show.report.document import write_report
from obbgs_base.srgb import from_srgb, to_srgb
from obbgs_core.model.cameras import Cameras
from obbgs_core.render import render
from obbgs_core.score.metrics import ssim
from tests.commands import call
from tests.scenes import intrinsics, photographed, pose, target

SIZE_PX = 24


def picture(rng: np.random.Generator, channels: int = 4) -> np.ndarray:
    return rng.integers(0, 256, (SIZE_PX, SIZE_PX, channels), dtype=np.uint8)


def save(path: Path, image: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(imagecodecs.png_encode(image))


def nerf_folder(folder: Path, counts: dict[str, int], channels: int = 4, **keys) -> Path:
    """Return a NeRF-synthetic folder of noise; `keys` are added to each transforms file."""
    rng = np.random.default_rng(0)
    for name, count in counts.items():
        frames = []
        for i in range(count):
            save(folder / name / f"r_{i}.png", picture(rng, channels))
            c2w = world_to_camera_to_opengl(pose(np.eye(3)).double().numpy())
            frames.append({"file_path": f"./{name}/r_{i}", "transform_matrix": c2w.tolist()})
        tree = {"camera_angle_x": 0.7, **keys, "frames": frames}
        (folder / f"transforms_{name}.json").write_text(json.dumps(tree))
    return folder


def nerfstudio_folder(folder: Path, count: int, per_frame=lambda i: {}, **keys) -> Path:
    rng, frames = np.random.default_rng(0), []
    for i in range(count):
        save(folder / f"images/{i}.png", picture(rng, 3))
        frame = {"file_path": f"images/{i}.png", "transform_matrix": np.eye(4).tolist()}
        frames.append({**frame, **per_frame(i)})
    tree = {"fl_x": 30.0, "fl_y": 31.0, "cx": 12.0, "cy": 11.0, "w": SIZE_PX, "h": SIZE_PX}
    (folder / "transforms.json").write_text(json.dumps({**tree, **keys, "frames": frames}))
    return folder


def splits_of(session) -> list[str | None]:
    return [record.split for record in session.frames]


def rewrite_frames(session: Path, change) -> None:
    lines = [json.loads(line) for line in (session / "frames.jsonl").read_text().splitlines()]
    for i, line in enumerate(lines):
        change(i, line)
    (session / "frames.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))


# --- splits ---


@pytest.mark.parametrize(
    ("counts", "training", "held_out"),
    [
        ({"train": 3, "val": 2, "test": 2}, [0, 1, 2], [5, 6]),  # val is in neither
        ({"train": 3, "val": 2}, [0, 1, 2], [3, 4]),
        ({"train": 9}, [0, 1, 2, 3, 4, 5, 6, 8], [7]),  # nothing to test on was stated: every eighth
    ],
)
def test_stated_splits_decide_what_is_trained_on(tmp_path, counts, training, held_out):
    views, _ = read_nerf(nerf_folder(tmp_path / "d", counts))
    write_session(views, tmp_path / "s", "nerf")
    session = open_session(tmp_path / "s")
    assert splits_of(session) == [name for name, count in counts.items() for _ in range(count)]
    assert [[r.id for r in part] for part in split(session)] == [training, held_out]


def test_without_training_pictures_nothing_is_trained(tmp_path):
    views, _ = read_nerf(nerf_folder(tmp_path / "d", {"val": 1, "test": 4}))
    write_session(views, tmp_path / "s", "nerf")
    with pytest.raises(SessionError, match="5 usable frames is in the split train"):
        split(open_session(tmp_path / "s"))


@pytest.mark.parametrize(("export", "read"), [(export_nerf, read_nerf), (export_nerfstudio, read_nerfstudio)])
def test_splits_background_and_encoding_survive_export_and_import(tmp_path, export, read):
    views, _ = read_nerf(nerf_folder(tmp_path / "d", {"train": 3, "val": 2, "test": 2}))
    write_session(views, tmp_path / "s", "nerf", white_background=True)
    session = open_session(tmp_path / "s")
    assert (session.background, session.encoding) == (1.0, "srgb")
    assert export(session, tmp_path / "out") == {"train": 3, "val": 2, "test": 2}
    views, exported = read(tmp_path / "out")
    write_session(views, tmp_path / "again", "out", exported=exported)
    again = open_session(tmp_path / "again")
    assert splits_of(again) == splits_of(session)
    assert (again.background, again.encoding, again.camera) == (1.0, "srgb", session.camera)
    for a, b in zip(session.frames, again.frames, strict=True):
        np.testing.assert_array_equal(session.dn(a), again.dn(b))


def test_nerfstudio_lists_name_the_splits_and_held_out_pictures_are_not_trained_on(tmp_path, caplog):
    lists = {"train_filenames": ["images/0.png", "images/1.png", "images/2.png"]}
    lists |= {"val_filenames": ["images/2.png", "images/3.png"], "test_filenames": ["images/3.png"]}
    views, _ = read_nerfstudio(nerfstudio_folder(tmp_path, 5, **lists))
    assert [(v.image.name, v.split) for v in views] == [
        ("0.png", "train"),
        ("1.png", "train"),
        ("2.png", "val"),
        ("3.png", "test"),
    ]
    assert "images/2.png is in train and in val" in caplog.text and "1 picture in none" in caplog.text


@pytest.mark.parametrize("names", [["images/9.png"], [4], "images/0.png", {"images/0.png": 1}])
def test_a_list_that_names_no_frames_is_refused(tmp_path, names):
    with pytest.raises(FormatError, match=r"transforms\.json"):
        read_nerfstudio(nerfstudio_folder(tmp_path, 2, train_filenames=names))


def test_the_first_pictures_of_each_split_are_imported(tmp_path):
    views, _ = read_nerf(nerf_folder(tmp_path / "d", {"train": 4, "test": 3}))
    assert [v.split for v in first_of_each_split(views, 2)] == ["train", "train", "test", "test"]
    assert first_of_each_split(views, None) == views


# --- background ---


def test_transparent_pictures_are_put_on_white_as_pillow_does(tmp_path):
    views, _ = read_nerf(nerf_folder(tmp_path / "d", {"train": 3}))
    write_session(views, tmp_path / "s", "nerf", white_background=True)
    session = open_session(tmp_path / "s")
    for record, view in zip(session.frames, views, strict=True):
        with Image.open(view.image) as opened:
            white = Image.new("RGBA", opened.size, "white")
            expected = np.asarray(Image.alpha_composite(white, opened))[..., :3]
        # both round to whole numbers
        assert np.abs(session.dn(record).astype(int) - expected.astype(int)).max() <= 1
    assert training_frame(session, session.frames[0]).background == 1.0
    assert cameras_of(session, list(session.frames)).background == 1.0


def test_a_white_background_is_darker_in_a_shorter_exposure(tmp_path):
    folder = nerf_folder(tmp_path / "d", {"train": 2})
    tree = json.loads((folder / "transforms_train.json").read_text())
    for frame, exposure_s in zip(tree["frames"], (2.0, 0.5), strict=True):
        frame["exposure_time_s"] = exposure_s
        save(folder / f"{frame['file_path']}.png", np.zeros((SIZE_PX, SIZE_PX, 4), dtype=np.uint8))
    (folder / "transforms_train.json").write_text(json.dumps(tree))
    views, _ = read_nerf(folder)
    write_session(views, tmp_path / "s", "nerf", Values.LINEAR, white_background=True)
    session = open_session(tmp_path / "s")
    assert [session.dn(r).min() for r in session.frames] == [255, 64]  # 255 and a quarter of it, rounded
    assert session.background * session.camera.dn_per_radiance_s * 2.0 == pytest.approx(255)


def test_only_pictures_that_are_seen_through_count_as_transparent(tmp_path):
    rng = np.random.default_rng(0)
    for name, image, expected in (
        ("rgb", picture(rng, 3), False),
        ("opaque", np.full((4, 4, 4), 255, dtype=np.uint8), False),
        ("rgba", picture(rng, 4), True),
    ):
        save(tmp_path / f"{name}.png", image)
        height, width = image.shape[:2]
        view = View(tmp_path / f"{name}.png", np.eye(4), Intrinsics(width, height, 9.0, 9.0, 2.0, 2.0))
        assert judge([view]).transparent is expected


# --- sRGB ---


def test_the_srgb_curve_is_that_of_scikit_image():
    coded = np.random.default_rng(0).random((16, 16, 3))
    light = color.rgb2xyz(coded) @ np.linalg.inv(color.colorconv.xyz_from_rgb).T
    np.testing.assert_allclose(from_srgb(coded), light, atol=1e-9)
    np.testing.assert_allclose(
        to_srgb(from_srgb(coded)), coded, atol=1e-6
    )  # the standard's limits are rounded


@pytest.mark.parametrize(
    ("channels", "values", "encoding", "bit_depth"),
    [
        (3, None, "srgb", 8),
        (1, None, "linear", 8),
        (3, Values.LINEAR, "linear", 8),
        (3, Values.DISPLAY, "srgb", 8),
        (3, Values.DECODE, "linear", 16),
    ],
)
def test_a_session_knows_what_its_values_stand_for(tmp_path, channels, values, encoding, bit_depth):
    views, _ = read_nerf(nerf_folder(tmp_path / "d", {"train": 1}, channels))
    write_session(views, tmp_path / "s", "nerf", values)
    session = open_session(tmp_path / "s")
    assert (session.encoding, session.camera.bit_depth) == (encoding, bit_depth)
    kept = imagecodecs.imread(views[0].image).squeeze()
    if values is not Values.DECODE:
        np.testing.assert_array_equal(session.dn(session.frames[0]), kept)


def test_the_command_offers_what_the_import_knows():
    assert [value.value for value in PixelValues] == [value.value for value in Values]


@pytest.fixture(scope="module")
def rendered(tmp_path_factory) -> Path:
    """A NeRF-synthetic folder of eleven transparent pictures of a small scene, display values."""
    folder = tmp_path_factory.mktemp("rendered")
    frames = photographed(target(), 11, size_px=32, focal_px=65.0)
    for name, part in (("train", frames[:8]), ("test", frames[8:])):
        tree = {"camera_angle_x": 2 * np.arctan(16 / 65.0), "frames": []}
        for f in part:
            seen = render(target(), Cameras(f.world_to_camera[None], intrinsics(32, 65.0)[None], 32, 32))
            alpha = seen.alpha[0, ..., None]
            colour = (seen.radiance[0] / alpha.clamp(min=1e-6)).clamp(0, 1).expand(-1, -1, 3)
            rgba = torch.cat([colour, alpha], dim=-1)
            save(folder / name / f"r_{f.id}.png", (255 * rgba).round().to(torch.uint8).numpy())
            c2w = world_to_camera_to_opengl(f.world_to_camera.double().numpy())
            tree["frames"].append({"file_path": f"{name}/r_{f.id}", "transform_matrix": c2w.tolist()})
        (folder / f"transforms_{name}.json").write_text(json.dumps(tree))
    return folder


@pytest.mark.parametrize("values", [Values.DISPLAY, Values.DECODE])
def test_a_run_on_white_is_scored_in_display_values_and_in_light(tmp_path, rendered, values):
    views, _ = read_nerf(rendered)
    write_session(views, tmp_path / "s", "nerf", values, white_background=True)
    changes = {"steps": 300, "start.count": 600, "growth.max_gaussians": 600}
    reconstruct(tmp_path / "s", "run", "3dgs", changes)
    metrics = evaluate(tmp_path / "s", "run")
    run = open_run(tmp_path / "s", "run")
    assert (metrics["frames_trained"], metrics["frames_held_out"]) == (8, 3)
    display, similar = [], []
    for record in run.scored:
        truth = run.session.dn(record) / run.sensor.white_dn
        ours = predicted_image(run.gaussians, run.session, record, run.sensor, 1.0).numpy()
        if values is Values.DECODE:  # scikit-image's curve
            matrix = colorconv.rgb_from_xyz.T
            truth, ours = (
                color.xyz2rgb(np.linalg.solve(matrix.T, image.reshape(-1, 3).T).T.reshape(image.shape))
                for image in (truth, ours)
            )
        display.append(peak_signal_noise_ratio(truth, ours, data_range=1.0))
        similar.append(ssim(*(torch.from_numpy(image).double() for image in (ours, truth))))
    assert metrics["psnr_srgb_db"] == pytest.approx(np.mean(display), abs=1e-3)
    assert metrics["ssim_srgb"] == pytest.approx(np.mean(similar), abs=1e-3)
    kept = "psnr_srgb_db" if values is Values.DISPLAY else "psnr_linear_db"
    assert metrics[kept] == pytest.approx(metrics["psnr_noisy_db"], abs=1e-4)
    # a white picture without the target is what the background alone would give
    blank = np.mean(
        [-10 * np.log10(np.mean((run.session.dn(r) / run.sensor.white_dn - 1) ** 2)) for r in run.scored]
    )
    assert metrics["psnr_noisy_db"] > blank + 5
    assert metrics["onnx_parity_db"] > 50
    page = write_report(tmp_path / "s", "run").read_text()
    shown = re.sub(r"<[^>]*>", " ", re.sub(r"<(script|style).*?</\1>", "", page, flags=re.DOTALL))
    assert "display values (sRGB)" in shown and "11 imported pictures" in shown
    # nobody received, captured or bracketed these pictures, and what noise they have nobody stated
    said = shown + call("ground", "list", tmp_path).stdout
    assert not re.findall(r".{20}\b(?:received|captured|[Bb]rackets?|noisy|nothing)\b.{20}", said)
    assert "11 pictures" in said
    card = (run.folder / "model_card.md").read_text()
    assert "display values (sRGB)" in card and "a background of radiance 1" in card


# --- intrinsics ---


@pytest.mark.parametrize(("export", "read"), [(export_nerf, read_nerf), (export_nerfstudio, read_nerfstudio)])
def test_every_frame_keeps_its_own_intrinsics(tmp_path, export, read):
    folder = nerfstudio_folder(tmp_path / "d", 4, lambda i: {"fl_x": 30.0 + i, "cy": 11.0 - i / 2})
    expected = [[[30.0 + i, 0, 12], [0, 31, 11 - i / 2], [0, 0, 1]] for i in range(4)]
    views, _ = read_nerfstudio(folder)
    write_session(views, tmp_path / "s", "nerfstudio")
    session = open_session(tmp_path / "s")
    export(session, tmp_path / "out")
    views, exported = read(tmp_path / "out")
    write_session(views, tmp_path / "again", "out", exported=exported)
    for opened in (session, open_session(tmp_path / "again")):
        assert [r.K is None for r in opened.frames] == [True, False, False, False]
        frames = [training_frame(opened, record).K.tolist() for record in opened.frames]
        assert frames == expected == cameras_of(opened, list(opened.frames)).K.tolist()


def test_colmap_cameras_differ_and_a_list_of_test_pictures_is_read(tmp_path):
    model = pycolmap.Reconstruction()
    for number, focal_px in ((1, 30.0), (2, 40.0)):
        params = [focal_px, focal_px + 1, 12.0, 11.0]
        camera = pycolmap.Camera(
            camera_id=number, model="PINHOLE", width=SIZE_PX, height=SIZE_PX, params=params
        )
        model.add_camera_with_trivial_rig(camera)
        image = pycolmap.Image(name=f"{number}.png", camera_id=number, image_id=number)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(np.eye(4)[:3]))
        save(tmp_path / f"images/{number}.png", picture(np.random.default_rng(number), 3))
    (tmp_path / "sparse/0").mkdir(parents=True)
    model.write_binary(str(tmp_path / "sparse/0"))
    (tmp_path / "sparse/0/test.txt").write_text("2.png\n")
    write_session(read_colmap(tmp_path), tmp_path / "s", "colmap")
    session = open_session(tmp_path / "s")
    assert [session.K(r)[:2, :2].diagonal().tolist() for r in session.frames] == [[30, 31], [40, 41]]
    assert splits_of(session) == ["train", "test"]


# --- hostile input ---


@pytest.fixture(scope="module")
def imported(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("imported")
    views, _ = read_nerf(nerf_folder(folder / "d", {"train": 2, "test": 1}, channels=3))
    write_session(views, folder / "s", "nerf")
    return folder / "s"


@pytest.mark.parametrize(
    ("key", "value", "said"),
    [
        ("split", "testing", "train, val, test"),
        ("split", 3, "train, val, test"),
        ("split", ["train"], "train, val, test"),
        ("K", "x", "line 2"),
        ("K", [[1, 0], [0, 1]], r"\(3, 3\) finite"),
        ("K", [[30, 0, 12], [0, float("nan"), 12], [0, 0, 1]], "finite"),
        ("K", [[-30, 0, 12], [0, 30, 12], [0, 0, 1]], "positive"),
        ("K", [[30, 1, 12], [0, 30, 12], [0, 0, 1]], "positive"),
        ("K", [[30, 0, 12], [0, 30, 12], [0, 0, 2]], "positive"),
    ],
)
def test_a_damaged_frame_line_is_one_named_error(tmp_path, imported, key, value, said):
    shutil.copytree(imported, tmp_path / "s")
    rewrite_frames(tmp_path / "s", lambda i, line: line.update({key: value} if i == 1 else {}))
    with pytest.raises(SessionCorrupt, match=said):
        open_session(tmp_path / "s")


def test_some_frames_without_a_split_are_refused_and_all_of_them_are_not(tmp_path, imported):
    shutil.copytree(imported, tmp_path / "s")
    rewrite_frames(tmp_path / "s", lambda i, line: line.pop("split") if i == 1 else None)
    with pytest.raises(SessionCorrupt, match="1 of 3 have none, the first of them frame 1"):
        open_session(tmp_path / "s")
    rewrite_frames(tmp_path / "s", lambda i, line: line.pop("split", None))
    assert [len(part) for part in split(open_session(tmp_path / "s"))] == [2, 1]


@pytest.mark.parametrize(
    ("key", "value"),
    [
        *(("background", wrong) for wrong in (-1, "white", float("inf"), True)),
        *(("encoding", wrong) for wrong in ("adobe", ["srgb"])),
    ],
)
def test_a_damaged_header_or_export_is_one_named_error(tmp_path, imported, key, value):
    shutil.copytree(imported, tmp_path / "s")
    header = json.loads((tmp_path / "s/session.json").read_text())
    (tmp_path / "s/session.json").write_text(json.dumps(header | {key: value}))
    with pytest.raises(SessionCorrupt, match=key):
        open_session(tmp_path / "s")
    folder = nerf_folder(tmp_path / "d", {"train": 1}, calibration=header["camera"], **{key: value})
    with pytest.raises(FormatError, match="transforms_train"):
        read_nerf(folder)


@pytest.mark.parametrize("own", [{"fl_x": -3.0}, {"fl_x": "wide"}, {"cx": None}, {"fl_y": 0}, {"k1": "x"}])
def test_intrinsics_that_no_camera_has_are_refused(tmp_path, own):
    with pytest.raises(FormatError, match=r"transforms\.json"):
        read_nerfstudio(nerfstudio_folder(tmp_path / "ns", 2, lambda i: own))


def test_pictures_of_two_sizes_are_refused_with_both_named(tmp_path):
    folder = nerf_folder(tmp_path / "d", {"train": 2}, channels=3)
    save(folder / "train/r_1.png", np.zeros((SIZE_PX, 2 * SIZE_PX, 3), dtype=np.uint8))
    views, _ = read_nerf(folder)
    with pytest.raises(FormatError, match=r"r_1\.png.*48x24 and the first is 24x24"):
        write_session(views, tmp_path / "s", "nerf")
    assert not (tmp_path / "s").exists()


# --- stated cameras ---


@pytest.mark.parametrize(("given", "deviation_px"), [((), 1.0), (("--pose-sigma", "0,0"), 0.0)])
def test_stated_cameras_may_err_by_a_pixel_unless_someone_says_that_they_are_exact(
    tmp_path, given, deviation_px
):
    nerf_folder(tmp_path / "d", {"train": 3, "test": 2}, camera_angle_x=0.7)
    command = ("import", "--format", "nerf", "--from", tmp_path / "d", "--session", tmp_path / "s")
    assert call("ground", *command, "--poses", "stated", *given).returncode == 0
    session = open_session(tmp_path / "s")
    for record in session.frames:
        camera = record.world_to_camera
        moved_px = []
        for axis in range(2):  # of the target's picture by the camera's turn and by its place
            away = np.linalg.norm(camera[:3, 3])
            turn, place = (math.sqrt(record.covariance[i, i]) for i in (3 + axis, axis))
            moved_px += [session.camera.fx_px * turn, session.camera.fx_px * place / away]
        np.testing.assert_allclose(moved_px, deviation_px)


def test_what_an_export_of_ours_does_not_state_is_exact(tmp_path):
    views, _ = read_nerf(nerf_folder(tmp_path / "d", {"train": 3, "test": 2}))
    write_session(views, tmp_path / "s", "nerf")
    for format_ in ("nerf", "nerfstudio"):
        where = ("--from", tmp_path / format_, "--session", tmp_path / f"again-{format_}")
        call("ground", "export", tmp_path / "s", "--out", tmp_path / format_, "--format", format_)
        assert call("ground", "import", "--format", format_, *where).returncode == 0
        assert not any(r.covariance.any() for r in open_session(tmp_path / f"again-{format_}").frames)
