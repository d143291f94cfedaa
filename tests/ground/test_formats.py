"""Import and export: small folders in the exact layouts, and readers and writers that are not ours."""

import dataclasses
import json
import math
import shutil
from collections import Counter
from pathlib import Path

import cv2
import imagecodecs
import numpy as np
import pycolmap
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flightsw.icd.frame import encode_frame
from flightsw.icd.quaternion import quat_to_matrix
from ground.formats.axes import opengl_to_world_to_camera, world_to_camera_to_opengl
from ground.formats.colmap import read_colmap, read_colmap_and_export
from ground.formats.colmap_export import export_colmap
from ground.formats.nerf import export_nerf, read_nerf, split_frames
from ground.formats.nerfstudio import export_nerfstudio, read_nerfstudio
from ground.formats.pictures.placement import placed
from ground.formats.pictures.views import (
    FormatError,
    Intrinsics,
    PoseSigmas,
    Values,
    View,
    undistort,
    write_session,
)
from ground.formats.shirt import read_shirt
from ground.session.folder import SessionError, open_session
from ground.session.writer import SessionWriter
from tests.commands import call

RNG = np.random.default_rng(3)
unit_quats = st.lists(st.floats(-1, 1), min_size=4, max_size=4).filter(lambda q: np.linalg.norm(q) > 0.1)


def random_pose(rng=RNG) -> np.ndarray:
    quat = rng.normal(size=4)
    matrix = np.eye(4)
    matrix[:3, :3] = quat_to_matrix(quat / np.linalg.norm(quat))
    matrix[:3, 3] = rng.normal(size=3) * 5
    return matrix


def write_png(path: Path, image: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(imagecodecs.png_encode(image))


@pytest.fixture
def session(tmp_path, small_mission, make_frame):
    """Twelve frames of noise in four brackets, as flight sends them."""
    writer = SessionWriter(tmp_path / "original", small_mission)
    for number in range(12):
        frame = make_frame(number)
        writer.add(frame, encode_frame(frame))
    return open_session(tmp_path / "original")


# --- axes ---


@settings(max_examples=50)
@given(quat=unit_quats, place=st.tuples(*[st.floats(-1e3, 1e3)] * 3))
def test_opengl_poses_come_back_to_rounding(quat, place):
    pose = np.eye(4)
    pose[:3, :3] = quat_to_matrix(np.array(quat) / np.linalg.norm(quat))
    pose[:3, 3] = place
    again = opengl_to_world_to_camera(world_to_camera_to_opengl(pose).tolist(), "here")
    np.testing.assert_array_equal(again[:3, :3], pose[:3, :3])  # signs only
    np.testing.assert_allclose(again, pose, atol=1e-9)


def test_an_opengl_camera_looks_along_minus_z_with_y_up():
    c2w = np.eye(4)
    c2w[:3, 3] = [0, 0, 5]  # Blender's camera at +5 z sees the origin
    np.testing.assert_array_equal(opengl_to_world_to_camera(c2w, "here") @ [0, 0, 0, 1], [0, 0, 5, 1])
    np.testing.assert_array_equal(opengl_to_world_to_camera(c2w, "here") @ [1, 2, 0, 1], [1, -2, 5, 1])


# --- NeRF-synthetic ---


def nerf_folder(folder: Path, suffix: str = "") -> dict[str, np.ndarray]:
    """The layout of the original NeRF data: RGBA, no size, no suffix, three splits."""
    poses = {}
    for split, count in (("train", 3), ("val", 1), ("test", 2)):
        frames = []
        for i in range(count):
            rgba = RNG.integers(0, 256, (20, 24, 4), dtype=np.uint8)
            write_png(folder / split / f"r_{i}.png", rgba)
            c2w = random_pose()
            poses[f"{split}/r_{i}"] = c2w
            frames.append(
                {
                    "file_path": f"./{split}/r_{i}{suffix}",
                    "rotation": 0.0126,
                    "transform_matrix": c2w.tolist(),
                }
            )
        tree = {"camera_angle_x": 0.6911112070083618, "frames": frames}
        (folder / f"transforms_{split}.json").write_text(json.dumps(tree))
    return poses


@pytest.mark.parametrize("suffix", ["", ".png"])
def test_nerf_synthetic_becomes_a_session(tmp_path, suffix):
    poses = nerf_folder(tmp_path / "lego", suffix)
    views, exported = read_nerf(tmp_path / "lego")
    assert exported is None and write_session(views, tmp_path / "s", "lego") == 6
    session = open_session(tmp_path / "s")
    assert session.camera.fx_px == pytest.approx(12 / math.tan(0.6911112070083618 / 2))
    assert (session.camera.cx_px, session.camera.cy_px, session.camera.channels) == (12, 10, 3)
    for record, (name, c2w) in zip(session.frames, poses.items(), strict=True):
        rgba = imagecodecs.imread(tmp_path / "lego" / f"{name}.png").astype(float)
        np.testing.assert_array_equal(session.dn(record), np.rint(rgba[..., :3] * rgba[..., 3:] / 255))
        # three.js, Blender and NeRF agree on these axes; inverse by NumPy, signs written out
        expected = np.linalg.inv(c2w) * np.array([[1], [-1], [-1], [1]])
        np.testing.assert_allclose(record.world_to_camera, expected, atol=1e-12)


def test_the_lens_of_a_nerf_camera_is_read_and_another_is_refused(tmp_path):
    nerf_folder(tmp_path / "lego")
    path = tmp_path / "lego" / "transforms_train.json"
    tree = json.loads(path.read_text())
    path.write_text(json.dumps(tree | {"k1": 0.2, "k2": -0.1}))
    trained = [view for view in read_nerf(tmp_path / "lego")[0] if view.split == "train"]
    assert {view.intrinsics.distortion for view in trained} == {(0.2, -0.1, 0.0, 0.0, 0.0)}
    for wrong, told in (
        ({"camera_model": "OPENCV_FISHEYE"}, "OPENCV_FISHEYE"),
        ({"camera_angle_x": 0}, "the intrinsics are not valid"),
    ):
        path.write_text(json.dumps(tree | wrong))
        with pytest.raises(FormatError, match=told):
            read_nerf(tmp_path / "lego")


def test_srgb_is_undone_on_request(tmp_path):
    nerf_folder(tmp_path / "lego")
    views, _ = read_nerf(tmp_path / "lego")
    write_session(views, tmp_path / "s", "lego", Values.DECODE)
    session = open_session(tmp_path / "s")
    rgba = imagecodecs.imread(views[0].image) / 255
    linear = np.where(rgba <= 0.04045, rgba / 12.92, ((rgba + 0.055) / 1.055) ** 2.4)[..., :3] * rgba[..., 3:]
    assert session.camera.bit_depth == 16
    np.testing.assert_allclose(session.dn(session.frames[0]) / 65535, linear, atol=1e-5)


def test_a_session_survives_export_and_import(tmp_path, session):
    counts = export_nerf(session, tmp_path / "nerf")
    assert counts == {"train": 6, "val": 3, "test": 3}
    views, exported = read_nerf(tmp_path / "nerf")
    write_session(views, tmp_path / "exact", "nerf", exported=exported)
    exact = open_session(tmp_path / "exact")
    assert exact.camera == session.camera
    for a, b in zip(session.frames, exact.frames, strict=True):
        np.testing.assert_array_equal(session.dn(a), exact.dn(b))
    shutil.rmtree(tmp_path / "nerf" / "readings")  # then the pictures of 8 bits are all there is
    views, exported = read_nerf(tmp_path / "nerf")
    write_session(views, tmp_path / "again", "nerf", exported=exported)
    again = open_session(tmp_path / "again")
    step_dn = (session.camera.white_dn - session.camera.black_dn) / 255
    for a, b in zip(session.frames, again.frames, strict=True):
        np.testing.assert_allclose(a.world_to_camera, b.world_to_camera, atol=1e-9)
        for name in (
            "id",
            "bracket",
            "bracket_index",
            "exposure_time_s",
            "mid_exposure_utc_ns",
            "in_eclipse",
        ):
            assert getattr(a, name) == getattr(b, name)
        np.testing.assert_allclose(a.sun_dir_body, b.sun_dir_body)
        above_black = np.maximum(session.dn(a).astype(float), session.camera.black_dn)
        assert np.abs(above_black - again.dn(b)).max() <= step_dn / 2 + 0.5
    assert again.camera.dn_per_radiance_s == session.camera.dn_per_radiance_s
    assert again.camera.read_noise_dn == pytest.approx(math.hypot(8.0, step_dn / math.sqrt(12)))


def test_damaged_readings_are_named(tmp_path, session):
    export_nerf(session, tmp_path / "nerf")
    views, exported = read_nerf(tmp_path / "nerf")
    path = next((tmp_path / "nerf" / "readings").iterdir())
    path.write_bytes(bytes(imagecodecs.png_encode(np.full((48, 48), 60_000, np.uint16))))
    with pytest.raises(
        FormatError, match=rf"{path.name}: expected readings of 16 bits .* at most 4095.*again"
    ):
        write_session(views, tmp_path / "again", "nerf", exported=exported)


def test_what_is_not_exported_is_told_once(tmp_path, session, caplog):
    records = (dataclasses.replace(session.frames[0], pose_valid=False), *session.frames[1:])
    export_colmap(dataclasses.replace(session, frames=records), tmp_path / "c")
    assert caplog.messages == ["left out: 1 frame without a valid pose"]


@pytest.mark.parametrize("name", ["--from", "--masks"])
def test_a_folder_that_is_not_there_is_told_first(tmp_path, name):
    options = {"--from": str(tmp_path), "--masks": str(tmp_path), name: str(tmp_path / "nowhere")}
    arguments = [word for pair in options.items() for word in pair]
    done = call("ground", "import", "--format", "images", *arguments, "--session", str(tmp_path / "s"))
    assert done.returncode == 2 and done.stderr.startswith(f"ground: {name}: expected a folder")
    assert not (tmp_path / "s").exists()


@pytest.mark.parametrize("cameras", [1, 2])
def test_colmap_reads_what_we_export(tmp_path, session, cameras):
    """pycolmap, COLMAP's own library, finds our poses, lenses and pictures; so do our two readers."""

    def change(number, line):
        if cameras == 2 and number % 2:
            line["K"] = [[90.0, 0, 24.0], [0, 91.0, 23.0], [0, 0, 1]]

    session = changed_frames(session, change)
    counts = export_colmap(session, tmp_path / "c")
    model = pycolmap.Reconstruction(str(tmp_path / "c" / "sparse" / "0"))
    assert len(model.images) == len(session.frames) == sum(counts.values())
    assert len(model.cameras) == cameras and len(model.points3D) == 0
    for record in session.frames:
        image = model.images[record.id + 1]
        np.testing.assert_allclose(image.cam_from_world().matrix(), record.world_to_camera[:3], atol=1e-9)
        lens = model.cameras[image.camera_id]
        np.testing.assert_allclose(lens.calibration_matrix(), session.K(record), rtol=1e-6)
        assert (lens.width, lens.height) == (48, 48)
        assert pycolmap.Bitmap.read(str(tmp_path / "c" / "images" / image.name), True) is not None
    views = {view.image.name: view for view in read_colmap(tmp_path / "c")}
    assert {view.split for view in views.values()} == {"train", "test"}
    exact, exported = read_nerfstudio(tmp_path / "c")
    assert exported is not None and exported.camera == session.camera
    for view in exact:
        same = views[view.image.name]
        np.testing.assert_allclose(same.world_to_camera, view.world_to_camera, atol=1e-9)
        assert same.split == ("train" if view.split == "train" else "test")


def test_a_colmap_export_comes_back_with_its_exposures_and_readings_and_the_cameras_of_its_model(
    tmp_path, session
):
    """One of the cameras is moved by COLMAP's own library, as its bundle adjustment would."""
    export_colmap(session, tmp_path / "c")
    place = tmp_path / "c" / "sparse" / "0"
    model = pycolmap.Reconstruction(str(place))
    moved = session.frames[0]
    changed = moved.world_to_camera[:3] + np.array([[0, 0, 0, 0.25]] * 3)
    model.frames[model.images[moved.id + 1].frame_id].rig_from_world = pycolmap.Rigid3d(changed)
    model.write(str(place))
    views, exported = read_colmap_and_export(tmp_path / "c")
    assert exported is not None and exported.camera == session.camera
    write_session(views, tmp_path / "again", "colmap", exported=exported)
    again = open_session(tmp_path / "again")
    for before, after in zip(session.frames, again.frames, strict=True):
        assert after.exposure_time_s == before.exposure_time_s and after.bracket == before.bracket
        np.testing.assert_array_equal(again.dn(after), session.dn(before))
        expected = changed if before is moved else before.world_to_camera[:3]
        np.testing.assert_allclose(after.world_to_camera[:3], expected, atol=1e-9)
        if before is not moved:
            np.testing.assert_allclose(after.covariance, before.covariance)
    assert again.frames[0].covariance.any()  # of the moved one nobody states it: about a pixel


def test_exact_poses_stay_exact_through_a_colmap_model_and_its_counts_are_those_of_the_import(tmp_path):
    shipped = open_session(Path(__file__).parents[2] / "examples" / "small_session")
    counts = export_colmap(shipped, tmp_path / "c")
    views, exported = read_colmap_and_export(tmp_path / "c")
    write_session(views, tmp_path / "again", "colmap", exported=exported)
    assert not any(record.covariance.any() for record in open_session(tmp_path / "again").frames)
    assert Counter(counts) == Counter(view.split for view in views)


def test_the_points_of_a_colmap_export_lie_on_the_surface_and_colmap_reads_them(tmp_path, session):
    export_colmap(session, tmp_path / "none")
    assert len(pycolmap.Reconstruction(str(tmp_path / "none" / "sparse" / "0")).points3D) == 0
    surface = np.random.default_rng(0).normal(size=(25_000, 3))
    export_colmap(session, tmp_path / "c", surface)
    points = pycolmap.Reconstruction(str(tmp_path / "c" / "sparse" / "0")).points3D
    np.testing.assert_allclose([point.xyz for _, point in sorted(points.items())], surface[::3])


def changed_frames(session, change):
    """Return the session with its frames' lines changed."""
    lines = [json.loads(line) for line in (session.path / "frames.jsonl").read_text().splitlines()]
    for number, line in enumerate(lines):
        line.pop("crc32", None)  # as someone who edits it by hand
        change(number, line)
    (session.path / "frames.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    return open_session(session.path)


FORMATS = pytest.mark.parametrize(
    ("export", "read"), [(export_nerf, read_nerf), (export_nerfstudio, read_nerfstudio)]
)


@FORMATS
def test_poses_that_are_not_valid_are_not_exported_and_others_keep_how_far_they_err(
    tmp_path, session, export, read, caplog
):
    def change(number, line):
        line["pose_valid"] = number not in (2, 7)
        line["covariance"] = (np.eye(6) * (number + 1) * 1e-6).tolist()

    session = changed_frames(session, change)
    assert sum(export(session, tmp_path / "out").values()) == 10
    assert "left out: 2 frames without a valid pose" in caplog.text
    views, exported = read(tmp_path / "out")
    write_session(views, tmp_path / "again", "out", exported=exported)
    kept = [record for record in session.frames if record.pose_valid]
    for a, b in zip(kept, open_session(tmp_path / "again").frames, strict=True):
        np.testing.assert_array_equal(a.covariance, b.covariance)
    write_session(views, tmp_path / "told", "out", exported=exported, sigmas=PoseSigmas(0.01, 0.1))
    told = open_session(tmp_path / "told").frames[0].covariance
    np.testing.assert_allclose(np.diag(told), [0.01] * 3 + [1e-4] * 3)


@FORMATS
def test_masks_of_the_frames_are_read(tmp_path, session, export, read):
    export(session, tmp_path / "out")
    write_png(tmp_path / "out/masks/left.png", np.pad(np.full((48, 24), 255, np.uint8), ((0, 0), (0, 24))))
    for path in (tmp_path / "out").glob("transforms*.json"):
        tree = json.loads(path.read_text())
        for frame in tree["frames"]:
            frame["mask_path"] = "masks/left.png"
        path.write_text(json.dumps(tree))
    views, exported = read(tmp_path / "out")
    write_session(views, tmp_path / "again", "out", exported=exported, white_background=False)
    again = open_session(tmp_path / "again")
    for record in again.frames:
        assert (again.dn(record)[:, 24:] == again.camera.black_dn).all()  # what they leave out is sky
        assert (again.dn(record)[:, :24] > again.camera.black_dn).any()
    (tmp_path / "out/masks/left.png").unlink()
    with pytest.raises(FormatError, match=r"left\.png"):
        write_session(views, tmp_path / "third", "out", exported=exported)


@pytest.mark.parametrize("key", ["w", "bracket", "bracket_index", "mid_exposure_utc_ns", "pose_covariance"])
def test_a_number_without_end_is_one_named_error(tmp_path, session, key):
    export_nerfstudio(session, tmp_path / "out")
    tree = json.loads((tmp_path / "out" / "transforms.json").read_text())
    (tree if key == "w" else tree["frames"][0])[key] = 0
    text = json.dumps(tree).replace(f'"{key}": 0', f'"{key}": 1e400', 1)
    (tmp_path / "out" / "transforms.json").write_text(text)
    with pytest.raises(FormatError, match=r"transforms\.json"):
        read_nerfstudio(tmp_path / "out")


def ring(origin: np.ndarray, folder: Path, parallel: bool = False) -> list[View]:
    """Views of a bright square at `origin`, from a ring about it, or from a plane of cameras that look alike."""
    intrinsics = Intrinsics(64, 48, 80.0, 80.0, 32.0, 24.0)
    views = []
    for number, angle in enumerate(np.linspace(0, 2 * np.pi, 8, endpoint=False)):
        towards = np.array([0.0, 0.0, 1.0]) if parallel else np.array([np.cos(angle), 0.3, np.sin(angle)])
        towards /= np.linalg.norm(towards)
        right = np.cross([0.0, 1.0, 0.0], towards)
        right /= np.linalg.norm(right)
        rotation = np.stack([right, np.cross(towards, right), towards])
        aside = np.array([0.6 * np.cos(angle), 0.6 * np.sin(angle), 0.0]) if parallel else np.zeros(3)
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = rotation, -rotation @ (origin - 5 * towards + aside)
        seen = np.array(intrinsics.K) @ (pose[:3, :3] @ origin + pose[:3, 3])
        u, v = seen[:2] / seen[2]
        picture = np.zeros((48, 64), np.uint8)
        picture[round(v - 0.5) - 3 : round(v - 0.5) + 4, round(u - 0.5) - 3 : round(u - 0.5) + 4] = 200
        path = folder / f"{number}.png"
        write_png(path, picture)
        views.append(View(path, pose, intrinsics))
    return views


@pytest.mark.parametrize("parallel", [False, True])
@pytest.mark.parametrize("origin", [(20.0, -3.0, 8.0), (0.0, 40.0, 5.0), (0.0, 0.0, 6.0)])
def test_an_origin_out_of_sight_is_moved_into_the_target(tmp_path, parallel, origin):
    target = np.array(origin)
    moved, where = placed(ring(target, tmp_path, parallel))
    seen = sum(view.world_to_camera[2, 3] > 0 for view in moved)
    assert seen == 8
    if where is None:  # the ring of (0, 0, 6) and the plane see the origin themselves
        assert origin == (0.0, 0.0, 6.0) and parallel
    else:
        np.testing.assert_allclose(where, target, atol=0.15)  # two pixels
        for view in moved:
            assert np.linalg.norm(view.world_to_camera[:3, 3]) == pytest.approx(5.0, abs=0.8)


def test_an_origin_that_pictures_show_stays_and_even_pictures_do_not_tell_it(tmp_path, caplog):
    views = ring(np.zeros(3), tmp_path)
    same, where = placed(views)
    assert where is None and same == views and not caplog.messages
    for view in views:
        write_png(view.image, np.full((48, 64), 7, np.uint8))
    far = [
        dataclasses.replace(view, world_to_camera=view.world_to_camera @ shift(np.array([0.0, 90.0, 0.0])))
        for view in views
    ]
    assert placed(far) == (far, None) and "do not tell where the target is" in caplog.text


def shift(by: np.ndarray) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, 3] = by
    return matrix


def test_whole_brackets_go_to_one_split(session):
    by_bracket = {0: "train", 1: "val", 2: "train", 3: "test"}
    assert split_frames(session) == {record.id: by_bracket[record.bracket] for record in session.frames}


def test_what_we_export_is_what_a_plain_nerf_loader_expects(tmp_path, session):
    """After load_blender.py of the original NeRF: json, imread, stack, focal from the angle."""
    export_nerf(session, tmp_path / "nerf")
    for split in ("train", "val", "test"):
        meta = json.loads((tmp_path / "nerf" / f"transforms_{split}.json").read_text())
        images = [
            cv2.imread(str(tmp_path / "nerf" / (f["file_path"] + ".png")), cv2.IMREAD_UNCHANGED)
            for f in meta["frames"]
        ]
        stack = (np.array(images) / 255.0).astype(np.float32)
        assert stack.shape[1:] == (48, 48, 4) and (stack[..., 3] == 1).all()
        focal = 0.5 * stack.shape[2] / np.tan(0.5 * meta["camera_angle_x"])
        assert focal == pytest.approx(session.camera.fx_px)
        for frame in meta["frames"]:
            record = next(r for r in session.frames if r.id == frame["frame_id"])
            c2w = np.array(frame["transform_matrix"])
            np.testing.assert_allclose(c2w[:3, 3], record.position_body_m, atol=1e-6)
            ahead = -c2w[:3, 2]  # OpenGL looks along -z
            np.testing.assert_allclose(ahead, record.world_to_camera[2, :3], atol=1e-12)


# --- nerfstudio ---


def test_nerfstudio_export_holds_what_its_documentation_asks_for(tmp_path, session):
    counts = export_nerfstudio(session, tmp_path / "ns")
    tree = json.loads((tmp_path / "ns" / "transforms.json").read_text())
    assert {"camera_model", "fl_x", "fl_y", "cx", "cy", "w", "h", "k1", "k2", "p1", "p2", "frames"} <= set(
        tree
    )
    assert tree["camera_model"] == "OPENCV" and tree["w"] == 48 and tree["fl_x"] == session.camera.fx_px
    names = [frame["file_path"] for frame in tree["frames"]]
    assert sorted(tree["train_filenames"] + tree["val_filenames"] + tree["test_filenames"]) == sorted(names)
    assert counts == {"train": 6, "val": 3, "test": 3}
    for frame, record in zip(tree["frames"], session.frames, strict=True):
        assert imagecodecs.imread(tmp_path / "ns" / frame["file_path"]).shape == (48, 48, 4)
        inverse = np.linalg.inv(np.array(frame["transform_matrix"]) @ np.diag([1, -1, -1, 1]))
        np.testing.assert_allclose(inverse, record.world_to_camera, atol=1e-6)
    views, camera = read_nerfstudio(tmp_path / "ns")
    assert camera is not None and len(views) == 12
    np.testing.assert_allclose(views[7].world_to_camera, session.frames[7].world_to_camera, atol=1e-9)


def test_nerfstudio_cameras_of_frames_and_lens_distortion_are_read(tmp_path):
    image = RNG.integers(0, 256, (30, 40), dtype=np.uint8)
    write_png(tmp_path / "images/a.png", image)
    frame = {"file_path": "images/a.png", "transform_matrix": np.eye(4).tolist()[:3], "fl_x": 50.0}
    tree = {"fl_x": 1.0, "fl_y": 51.0, "cx": 20.5, "cy": 15.5, "w": 40, "h": 30, "k1": -0.1, "p2": 0.01}
    (tmp_path / "transforms.json").write_text(json.dumps({**tree, "frames": [frame]}))
    views, camera = read_nerfstudio(tmp_path)
    assert camera is None
    assert views[0].intrinsics == Intrinsics(40, 30, 50.0, 51.0, 20.5, 15.5, (-0.1, 0.0, 0.0, 0.01, 0.0))
    (tmp_path / "transforms.json").write_text(
        json.dumps({**tree, "camera_model": "OPENCV_FISHEYE", "frames": [frame]})
    )
    with pytest.raises(FormatError, match="OPENCV_FISHEYE"):
        read_nerfstudio(tmp_path)


def test_undistortion_agrees_with_opencv():
    smooth = cv2.GaussianBlur(RNG.random((120, 160)), (0, 0), 3)
    camera = Intrinsics(160, 120, 150.0, 148.0, 82.0, 58.0, (-0.22, 0.3, -0.004, 0.003, -0.1))
    K = np.array(
        [[150.0, 0, 81.5], [0, 148.0, 57.5], [0, 0, 1]]
    )  # OpenCV's first pixel centre is 0, ours 0.5
    expected = cv2.undistort(smooth, K, np.array(camera.distortion))
    ours = undistort(smooth[..., None], camera)[..., 0]
    # OpenCV rounds places to 1/32 px
    assert np.abs(ours - expected)[2:-2, 2:-2].max() < 0.05 * np.ptp(smooth)
    assert np.abs(ours - expected)[2:-2, 2:-2].mean() < 1e-3 < np.abs(smooth - expected).mean()


# --- COLMAP ---


def colmap_model(folder: Path, model: str, parameters: list[float]) -> dict[str, np.ndarray]:
    """A model made by COLMAP's own library."""
    reconstruction = pycolmap.Reconstruction()
    camera = pycolmap.Camera(camera_id=5, model=model, width=40, height=30, params=parameters)
    reconstruction.add_camera_with_trivial_rig(camera)
    poses = {}
    for number in (3, 1, 2):
        name = f"shot {number}.png"
        pose = random_pose()
        rigid = pycolmap.Rigid3d(pose[:3])
        image = pycolmap.Image(name=name, camera_id=5, image_id=number)
        image.points2D = pycolmap.Point2DList([pycolmap.Point2D(np.array([1.5, 2.5]))] * (number - 1))
        reconstruction.add_image_with_trivial_frame(image, rigid)
        poses[name] = pose
        write_png(folder / "images" / name, RNG.integers(0, 256, (30, 40, 3), dtype=np.uint8))
    model_folder = folder / "sparse" / "0"
    model_folder.mkdir(parents=True)
    reconstruction.write_binary(str(model_folder))
    reconstruction.write_text(str(model_folder))
    return poses


@pytest.mark.parametrize("kind", ["bin", "txt"])
@pytest.mark.parametrize(
    ("model", "parameters", "intrinsics"),
    [
        ("SIMPLE_PINHOLE", [50, 20, 15], (50, 50, 20, 15, (0, 0, 0, 0, 0))),
        ("PINHOLE", [50, 51, 20, 15], (50, 51, 20, 15, (0, 0, 0, 0, 0))),
        ("SIMPLE_RADIAL", [50, 20, 15, 0.1], (50, 50, 20, 15, (0.1, 0, 0, 0, 0))),
        ("RADIAL", [50, 20, 15, 0.1, 0.2], (50, 50, 20, 15, (0.1, 0.2, 0, 0, 0))),
        ("OPENCV", [50, 51, 20, 15, 0.1, 0.2, 0.3, 0.4], (50, 51, 20, 15, (0.1, 0.2, 0.3, 0.4, 0))),
    ],
)
def test_models_that_colmap_wrote_are_read(tmp_path, kind, model, parameters, intrinsics):
    poses = colmap_model(tmp_path, model, parameters)
    for path in (tmp_path / "sparse/0").glob("*.txt" if kind == "bin" else "*.bin"):
        path.unlink()
    views = read_colmap(tmp_path)
    assert [view.image.name for view in views] == ["shot 1.png", "shot 2.png", "shot 3.png"]
    for view in views:
        np.testing.assert_allclose(view.world_to_camera, poses[view.image.name], atol=1e-9)
        assert view.intrinsics == Intrinsics(40, 30, *intrinsics)
    assert write_session(views, tmp_path / "s", "colmap") == 3
    assert open_session(tmp_path / "s").camera.channels == 3


def test_a_damaged_or_unsupported_colmap_model_is_refused(tmp_path):
    with pytest.raises(FormatError, match="no cameras and images"):
        read_colmap(tmp_path)
    colmap_model(tmp_path, "OPENCV_FISHEYE", [50, 51, 20, 15, 0, 0, 0, 0])
    with pytest.raises(FormatError, match="camera model"):
        read_colmap(tmp_path)
    content = (tmp_path / "sparse/0/images.bin").read_bytes()
    (tmp_path / "sparse/0/images.bin").write_bytes(content[:50])
    with pytest.raises(FormatError, match="damaged"):
        read_colmap(tmp_path)


@pytest.mark.parametrize("pose", ["0 0 0 0 0 0 4", "1 0 0 0 0 nan 4"])
def test_a_colmap_pose_that_is_none_is_refused(tmp_path, pose):
    colmap_model(tmp_path, "SIMPLE_PINHOLE", [50, 20, 15])
    for path in (tmp_path / "sparse/0").glob("*.bin"):
        path.unlink()
    (tmp_path / "sparse/0/images.txt").write_text(f"1 {pose} 5 shot 1.png\n\n")
    with pytest.raises(FormatError, match="expected a unit quaternion and a finite translation"):
        read_colmap(tmp_path)


# --- SHIRT ---


def shirt_folder(root: Path, mounting: tuple[list[float], list[float]]) -> tuple[Path, list[np.ndarray]]:
    roe, poses, entries = root / "shirtv1" / "roe1", [], []
    for number in range(4):
        pose = random_pose()
        quat = RNG.normal(size=4)
        quat /= np.linalg.norm(quat)
        pose[:3, :3] = quat_to_matrix(quat)
        name = f"img{number + 1:06d}.jpg"
        for domain in ("synthetic", "lightbox"):
            (roe / domain / "images").mkdir(parents=True, exist_ok=True)
            jpeg = imagecodecs.jpeg_encode(RNG.integers(0, 256, (24, 32), dtype=np.uint8), level=95)
            (roe / domain / "images" / name).write_bytes(jpeg)
        entries.append(
            {"filename": name, "q_vbs2tango_true": quat.tolist(), "r_Vo2To_vbs_true": pose[:3, 3].tolist()}
        )
        poses.append(pose)
    (roe / "roe1.json").write_text(json.dumps(entries))
    q, r = mounting
    metadata = {"pSim": {"cam_step": 5, "num_images": 4}, "pMdl": {"q_pri2cam": q, "r_pri2cam_pri": r}}
    (roe / "metadata.json").write_text(json.dumps(metadata))
    camera = {
        "Nu": 32,
        "Nv": 24,
        "cameraMatrix": [[60.0, 0, 16], [0, 61.0, 12], [0, 0, 1]],
        "distCoeffs": [-0.2, 0.5, -6e-4, -2e-4, -0.13],
    }
    (root / "shirtv1" / "camera.json").write_text(json.dumps(camera))
    return roe, poses


@pytest.mark.parametrize("domain", ["synthetic", "lightbox"])
def test_shirt_becomes_a_session_with_its_poses_and_times(tmp_path, domain):
    roe, poses = shirt_folder(tmp_path, ([1.0, 0, 0, 0], [0.0, 0, 0]))
    views = read_shirt(roe / domain)
    assert views[0].intrinsics == Intrinsics(32, 24, 60.0, 61.0, 16.0, 12.0, (-0.2, 0.5, -6e-4, -2e-4, -0.13))
    write_session(views, tmp_path / "s", "shirt")
    session = open_session(tmp_path / "s")
    for record, pose in zip(session.frames, poses, strict=True):
        np.testing.assert_allclose(record.world_to_camera, pose, atol=1e-12)
        assert record.mid_exposure_utc_ns == record.id * 5_000_000_000 and record.exposure_time_s == 1.0
    decoded = imagecodecs.imread(views[1].image)
    expected = undistort(decoded[..., None] / 255.0, views[1].intrinsics)[..., 0]
    np.testing.assert_allclose(session.dn(session.frames[1]) / 255, expected, atol=0.51 / 255)


def test_a_shirt_camera_that_is_mounted_askew_is_taken_into_account(tmp_path):
    half = math.sqrt(0.5)
    roe, poses = shirt_folder(tmp_path, ([half, 0, 0, half], [0.1, 0.2, 0.3]))
    in_servicer = poses[0] @ [1.0, 2.0, 3.0, 1.0]
    x, y, z = in_servicer[:3] - [0.1, 0.2, 0.3]
    # the camera's axes are the servicer's turned by 90 degrees about z: its x is their y
    expected = [y, -x, z]
    np.testing.assert_allclose(
        (read_shirt(roe / "synthetic")[0].world_to_camera @ [1, 2, 3, 1])[:3], expected
    )


# --- refusals and the command line ---


def test_what_cannot_be_one_session_is_refused(tmp_path):
    nerf_folder(tmp_path / "lego")
    views, _ = read_nerf(tmp_path / "lego")
    write_session(views, tmp_path / "s", "lego")
    with pytest.raises(SessionError, match="holds a session already"):
        write_session(views, tmp_path / "s", "lego")
    told = call("ground", "import", "--format", "nerf", "--from", "nowhere", "--session", tmp_path / "s")
    # before anything is read or checked
    assert told.returncode == 1 and "holds a session already" in told.stderr
    write_png(tmp_path / "lego/val/r_0.png", np.zeros((5, 5, 3), dtype=np.uint8))
    views, _ = read_nerf(tmp_path / "lego")
    with pytest.raises(FormatError, match="have one size"):
        write_session(views, tmp_path / "t", "lego")
    (tmp_path / "lego/val/r_0.png").write_bytes(b"no picture")
    with pytest.raises(FormatError, match="cannot be read"):
        read_nerf(tmp_path / "lego")
    with pytest.raises(FormatError, match="no pictures"):
        write_session([], tmp_path / "t", "nothing")


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"[]",
        b"{}",
        b'{"frames": [3]}',
        b'{"frames": [{"file_path": 4}], "camera_angle_x": 1}',
        b"\xff\xfe",
    ]
    + [
        b'{"frames": [{"file_path": "a", "transform_matrix": %s}], "camera_angle_x": 1, "w": 4, "h": 4}'
        % matrix
        for matrix in (b"3", b'"x"', b"[[1]]", b"[[2,0,0,0],[0,2,0,0],[0,0,2,0],[0,0,0,1]]")
    ],
)
def test_a_damaged_transforms_file_is_one_named_error(tmp_path, content):
    (tmp_path / "transforms_train.json").write_bytes(content)
    with pytest.raises(FormatError, match="transforms_train"):
        read_nerf(tmp_path)


def test_the_commands_import_and_export(tmp_path):
    nerf_folder(tmp_path / "lego")
    done = call(
        "ground",
        "import",
        "--format",
        "nerf",
        "--from",
        str(tmp_path / "lego"),
        "--session",
        str(tmp_path / "s"),
        "--json",
    )
    assert json.loads(done.stdout)["frames"] == 6
    done = call("ground", "export", str(tmp_path / "s"), "--out", str(tmp_path / "out"), "--json")
    assert sum(json.loads(done.stdout).values()) == 6
    before = sorted(path for path in (tmp_path / "out").rglob("*"))
    for out, told in (
        (tmp_path / "s", "is a session"),
        (tmp_path / "s" / "session.json", "is a file"),
        (tmp_path / "out", "is not empty"),  # what an export of other frames left would be imported with it
    ):
        refused = call("ground", "export", str(tmp_path / "s"), "--out", str(out))
        assert refused.returncode == 1 and told in " ".join(refused.stderr.split())
    (tmp_path / "file").write_text("")
    refused = call("ground", "export", str(tmp_path / "s"), "--out", str(tmp_path / "file" / "x"))
    assert refused.returncode == 1 and "give --out a folder that can be written" in refused.stderr
    (tmp_path / "file").unlink()
    assert not (tmp_path / "s" / "train").exists()
    assert sorted(path for path in (tmp_path / "out").rglob("*")) == before
    wrong = call(
        "ground", "import", "--format", "obj", "--from", str(tmp_path), "--session", str(tmp_path / "t")
    )
    said = wrong.stderr
    assert wrong.returncode == 2 and "not one of 'nerf', 'nerfstudio', 'colmap', 'shirt'" in said
    empty = call(
        "ground", "import", "--format", "colmap", "--from", str(tmp_path), "--session", str(tmp_path / "t")
    )
    assert empty.returncode == 1 and "no cameras" in empty.stderr
