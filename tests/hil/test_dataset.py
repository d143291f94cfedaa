"""A data set of a few tiny frames: its layout read as plain JSON, its truth against its frames, resuming."""

import dataclasses
import json
import subprocess
import time
from pathlib import Path

import imagecodecs
import numpy as np
import pytest
import trimesh
import yaml
from typer.testing import CliRunner

from flightsw.icd.mission import ConfigError
from ground.formats.nerf import SPLIT_PATTERN
from ground.session.folder import open_session
from hil import cli, dataset, truth
from hil.dataset import DatasetConfig, DatasetError, load_dataset_config, make_dataset, target_meshes
from hil.processes import installed
from hil.sky import SHIPPED
from hil.sky.blender import MeshError
from hil.sky.sensor import PRESETS
from tests.commands import call

POINTS = 5000
SMALL = DatasetConfig(frames=33, size_px=40, bracket_ms=(0.05, 0.1, 0.2), sensor="paper")


@pytest.fixture(scope="module")
def cache(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("renders")


@pytest.fixture(scope="module")
def made(tmp_path_factory, cache) -> tuple[Path, dict]:
    out = tmp_path_factory.mktemp("set") / "one"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(truth, "CLOUD_POINTS", POINTS)
        return out, make_dataset(SMALL, SHIPPED, out, cache)


@pytest.fixture(autouse=True)
def few_points(monkeypatch):
    """Casting rays for 100,000 points takes seconds."""
    monkeypatch.setattr(truth, "CLOUD_POINTS", POINTS)


def opengl_projection(frame: dict, tree: dict, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return pixel coordinates [N, 2] and depths [N] by the NeRF convention: x right, y up, looking along -z."""
    c2w = np.array(frame["transform_matrix"])
    p = (points - c2w[:3, 3]) @ c2w[:3, :3]
    focal_px = tree["w"] / 2 / np.tan(tree["camera_angle_x"] / 2)
    u = tree["w"] / 2 + focal_px * p[:, 0] / -p[:, 2]
    v = tree["h"] / 2 - focal_px * p[:, 1] / -p[:, 2]
    return np.stack([u, v], axis=1), -p[:, 2]


def test_the_splits_have_the_published_proportion_and_hold_every_frame_once(made):
    out, facts = made
    trees = {split: json.loads((out / f"transforms_{split}.json").read_text()) for split in facts["split"]}
    assert facts["split"] == {"train": 18, "val": 6, "test": 9}
    ids = [frame["frame_id"] for tree in trees.values() for frame in tree["frames"]]
    assert sorted(ids) == list(range(33))
    exposures = [frame["exposure_time_s"] for frame in trees["train"]["frames"]]
    assert sorted(set(exposures)) == [5e-5, 1e-4, 2e-4] and exposures.count(1e-4) == 6
    for split, tree in trees.items():
        for frame in tree["frames"]:
            assert frame["file_path"].startswith(f"./{split}/") and frame["time"] >= 0
            picture = imagecodecs.imread(out / (frame["file_path"] + ".png"))
            assert picture.shape == (40, 40, 4) and picture.dtype == np.uint8


def test_the_published_size_gives_the_published_counts():
    counts = np.bincount([SPLIT_PATTERN[bracket % len(SPLIT_PATTERN)] for bracket in range(121)]) * 3
    assert counts.tolist() == [198, 66, 99]
    config = load_dataset_config("obr-st")
    assert (config.frames, config.size_px, len(config.targets)) == (363, 800, 6)


def test_the_cloud_projects_onto_the_mask_and_nowhere_in_front_of_the_depth(made):
    out, _ = made
    folder = out / "session" / "truth"
    cloud = np.asarray(trimesh.load(folder / "cloud.ply").vertices)
    assert len(cloud) == POINTS
    tree = json.loads((out / "transforms_test.json").read_text())
    entries = {entry["id"]: entry for entry in json.loads((folder / "truth.json").read_text())["frames"]}
    for frame in tree["frames"][::4]:
        places, depths = opengl_projection(frame, tree, cloud)
        with np.load(folder / entries[frame["frame_id"]]["radiance"]) as light:
            alpha = light["alpha"]
        with np.load(folder / entries[frame["frame_id"]]["geometry"]) as shape:
            depth = shape["depth"]
        columns, rows = np.floor(places).astype(int).T
        inside = (columns >= 0) & (columns < 40) & (rows >= 0) & (rows < 40)
        assert inside.mean() > 0.99
        assert (alpha[rows[inside], columns[inside]] > 0).mean() > 0.995  # 16 samples may miss a thin edge
        # no true point lies in front of what the pixel's centre sees, except by the slope within a pixel of 23 cm
        in_front = depth[rows[inside], columns[inside]] - depths[inside]
        assert (in_front[np.isfinite(in_front)] > 1.0).mean() < 0.02
        seen = np.isfinite(depth)
        assert (alpha[seen] > 0).all() and seen.sum() > 50


def test_frames_are_the_true_radiance_through_the_sensor(made):
    out, facts = made
    session = open_session(out / "session")
    assert session.camera.dn_per_radiance_s == facts["dn_per_radiance_s"]
    assert session.frames_captured == facts["frames"] == len(session.frames)
    residuals = []
    for record in session.frames:
        with np.load(out / "session" / "truth" / "radiance" / f"{record.id:06d}.npz") as light:
            expected = light["radiance"].astype(float) * facts["dn_per_radiance_s"] * record.exposure_time_s
        middle = (expected > 30) & (expected < 200)  # where no clipping bends the noise
        residuals.append(session.dn(record)[middle] - expected[middle])
    residual = np.concatenate(residuals)
    assert len(residual) > 1000 and residual.std() == pytest.approx(0.025 * 255, rel=0.1)
    assert abs(residual.mean()) < 4 * 6.4 / np.sqrt(len(residual))


def test_a_second_run_needs_no_blender(made, cache, monkeypatch):
    out, facts = made
    monkeypatch.setenv("OBBGS_BLENDER_PYTHON", "/nowhere/python")
    monkeypatch.setattr(dataset, "RenderFarm", None)
    again = make_dataset(SMALL, SHIPPED, out, cache)
    assert again == json.loads(json.dumps(facts))


def test_an_interrupted_run_goes_on_to_the_same_frames(made, cache, tmp_path):
    out, _ = made

    class Killed(Exception):
        pass

    def kill(progress):
        if progress.step == "expose" and progress.done == 20:
            raise Killed

    with pytest.raises(Killed):
        make_dataset(SMALL, SHIPPED, tmp_path / "cut", cache, 1, kill)
    steps = []
    make_dataset(SMALL, SHIPPED, tmp_path / "cut", cache, 1, steps.append)
    assert steps[-1].done == steps[-1].total == 33
    for name in ("session/frames.jsonl", "transforms_val.json", "train/r_0000.png"):
        assert (tmp_path / "cut" / name).read_bytes() == (out / name).read_bytes()


def test_another_sensor_or_seed_needs_no_new_rendering_of_the_same_channels(made, cache, tmp_path):
    pictures = set(cache.iterdir())
    config = dataclasses.replace(SMALL, sensor="spacecam")
    make_dataset(config, SHIPPED, tmp_path / "spacecam", cache, 1)
    new = set(cache.iterdir()) - pictures
    # one channel instead of three is rendered anew; the same sensor again is not
    assert len(new) == 2 * 33 and open_session(tmp_path / "spacecam" / "session").camera.channels == 1
    pictures = set(cache.iterdir())
    make_dataset(dataclasses.replace(config, seed=2), SHIPPED, tmp_path / "noise", cache, 1)
    assert set(cache.iterdir()) == pictures
    assert PRESETS["spacecam"].channels == 1


def test_other_settings_do_not_overwrite_a_data_set(made, cache):
    out, _ = made
    with pytest.raises(DatasetError, match="other settings"):
        make_dataset(dataclasses.replace(SMALL, seed=5), SHIPPED, out, cache)


def test_a_second_command_with_the_same_folder_is_refused_and_the_first_one_ends_well(tmp_path):
    """The second one comes while the first waits for Blender."""
    out = tmp_path / "one"
    arguments = [
        "dataset",
        "--out",
        str(out),
        "--set",
        "frames=3",
        "--set",
        "size_px=16",
    ]
    first = subprocess.Popen(
        [installed("hil"), *arguments], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )
    try:
        while not (out / "dataset.json").exists():
            assert first.poll() is None
            time.sleep(0.01)
        second = call("hil", *arguments)
        assert (second.returncode, second.stderr.splitlines()[-1]) == (
            1,
            f"hil: another hil command works in {out}: wait for its end, or choose another folder",
        )
        said, _ = first.communicate()
        assert first.returncode == 0, said
    finally:
        first.kill()
        first.wait()
    assert len(open_session(out / "session").frames) == 3 and not (out / "lock").exists()
    assert json.loads((out / "dataset.json").read_text())["complete"]


def test_the_meshes_of_a_set_are_found_and_a_missing_one_is_named(tmp_path):
    config = load_dataset_config("obr-st-small")
    assert config.frames == 120 and config.size_px == 200
    for name in config.targets[:-1]:
        (tmp_path / f"{name}.glb").write_bytes(b"")
    with pytest.raises(ConfigError, match="TDRS"):
        target_meshes(config, tmp_path)
    (tmp_path / "TDRS.obj").write_bytes(b"")
    assert [path.stem for path in target_meshes(config, tmp_path)] == list(config.targets)


def test_a_set_of_two_targets_is_one_command_and_one_file(tmp_path):
    meshes = tmp_path / "meshes"
    meshes.mkdir()
    for name, size in (("Cube", (6, 6, 6)), ("Plank", (6, 2, 1))):
        trimesh.creation.box(extents=size).export(meshes / f"{name}.stl")
    tree = {"scenario": "sparse", "frames": 3, "size_px": 16, "targets": ["Cube", "Plank"]}
    (tmp_path / "two.yaml").write_text(yaml.safe_dump(tree))
    arguments = ["dataset", "--targets", str(tmp_path / "two.yaml"), "--mesh", str(meshes), "--json"]
    arguments += ["--out", str(tmp_path / "out")]
    done = CliRunner().invoke(cli.app, arguments)
    assert done.exit_code == 0 and set(json.loads(done.stdout)) == {"Cube", "Plank"}
    refused = CliRunner().invoke(cli.app, [*arguments, "--set", "size_px=2"])
    assert "dataset.size_px: expected 8 to 8192, got 2" in str(refused.exception)
    assert (tmp_path / "renders").is_dir()
    assert open_session(tmp_path / "out" / "Plank" / "session").frames[2].exposure_time_s == 2e-4


@pytest.mark.parametrize(
    ("wrong", "key"),
    [
        ({"frames": 10}, "frames"),
        ({"size_px": 4}, "size_px"),
        ({"bracket_ms": (0.1, -1.0, 0.2)}, "bracket_ms"),
    ],
)
def test_a_wrong_configuration_is_named(wrong, key):
    with pytest.raises(ConfigError, match=f"dataset.{key}"):
        DatasetConfig(**{"frames": 33, **wrong})


def test_a_list_without_brackets_is_shown_as_it_is_written():
    told = r"dataset.bracket_ms: expected a list such as \[0.1,0.2,0.4\], got '0.1,0.2,0.4'"
    with pytest.raises(ConfigError, match=told):
        load_dataset_config(None, ["bracket_ms=0.1,0.2,0.4"])
    assert load_dataset_config(None, ["bracket_ms=[0.1,0.2,0.4]"]).bracket_ms == (0.1, 0.2, 0.4)


def test_a_data_set_that_cannot_be_begun_is_refused_in_one_line(tmp_path):
    done = call("hil", "dataset", "--mesh", tmp_path / "none.glb", "--out", tmp_path / "out")
    assert done.returncode == 2 and done.stderr == f"hil: {tmp_path / 'none.glb'}: no such file\n"
    assert not (tmp_path / "out").exists()


def test_a_mesh_that_blender_refuses_leaves_no_folder(tmp_path):
    (tmp_path / "junk.glb").write_bytes(b"glTF and nothing more")
    config = load_dataset_config(None, ["frames=3", "size_px=16", "scenario=sparse"])
    with pytest.raises(MeshError):
        make_dataset(config, tmp_path / "junk.glb", tmp_path / "out", tmp_path / "renders", workers=1)
    assert [path.name for path in tmp_path.iterdir()] == ["junk.glb"]
