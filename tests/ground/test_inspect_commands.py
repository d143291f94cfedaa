"""`ground inspect`, `ground measure` and the report's sizes, from the small shipped session to their files."""

import json
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from ground import cli
from ground.run.runs import open_run
from ground.show.measure import _is_known
from ground.show.page import unbroken
from ground.show.report.sizes import sizes_section
from ground.show.sizes import with_deviation
from tests.commands import call

GOLDEN = Path(__file__).parents[1] / "golden"
UNIT = 25.4  # of the design's file, per metre
PART_M = 1.6  # 12 pixels


def ground(*arguments: object) -> dict:
    done = CliRunner().invoke(cli.app, [*map(str, arguments), "--json"])
    assert done.exit_code == 0, done.output
    return json.loads(done.stdout)


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Path:
    """A short run of the shipped session, copied without its truth."""
    session = tmp_path_factory.mktemp("pass") / "session"
    (session / "frames").mkdir(parents=True)
    for path in (GOLDEN / "session").glob("*.json*"):
        (session / path.name).write_bytes(path.read_bytes())
    for path in (GOLDEN / "session" / "frames").iterdir():
        (session / "frames" / path.name).write_bytes(path.read_bytes())
    options = ["--set", "steps=60", "--set", "start.count=300", "--set", "growth.max_gaussians=400"]
    done = CliRunner().invoke(
        cli.app, ["reconstruct", "--session", str(session), "--name", "first", *options]
    )
    assert done.exit_code == 0, done.output
    return session / "runs" / "first"


def seen_mesh(run: Path) -> trimesh.Trimesh:
    """Return what the frames show of a run's mesh, body axes, m, by trimesh alone."""
    (mesh,) = trimesh.load_scene(run / "model.glb").geometry.values()
    seen_by = np.asarray(mesh.vertex_attributes["_SEEN_BY_VIEWS"]).ravel()
    return trimesh.Trimesh(mesh.vertices, mesh.faces[(seen_by[mesh.faces] >= 2).all(axis=1)])


def test_sizes_are_those_of_the_mesh(run):
    mesh = seen_mesh(run)
    corners = np.unique(mesh.vertices[mesh.faces].reshape(-1, 3), axis=0)
    far = np.array([corners[corners[:, 0].argmin()], corners[corners[:, 0].argmax()]])
    places = ":".join(",".join(f"{x:.6f}" for x in place) for place in far)
    values = ground("measure", run, f"--between={places}")
    assert values["unit"] == "m"
    hull = trimesh.PointCloud(corners).convex_hull.vertices
    largest = np.linalg.norm(hull[:, None] - hull[None], axis=2).max()
    apart = np.linalg.norm(far[1] - far[0])
    pixel = values["pixel"]
    assert values["largest_dimension"]["value"] == pytest.approx(largest, abs=2 * pixel)
    assert values["distances"][0]["value"] == pytest.approx(apart, abs=2 * pixel)
    assert all(face["area"]["value"] <= mesh.area for face in values["faces"])
    text = sizes_section(open_run(run.parents[1], run.name))
    told = values["largest_dimension"]
    assert unbroken(with_deviation(told["value"], told["half_width_90"])) in text
    assert " ±" not in text and "± " not in text  # no number and its deviation are in two lines, on a phone


def test_a_place_that_is_far_from_the_body_is_refused(run):
    done = call("ground", "measure", str(run), "--between=1000,0,1:0,0,-1")
    assert done.returncode == 2 and "1000,0,1 is 9" in done.stderr and len(done.stderr.splitlines()) == 1
    assert " m from the surface" in done.stderr and " m large: give a place" in done.stderr


def test_a_part_of_the_design_that_is_not_there_is_told(run):
    """The design is the run's own mesh, moved, in another unit, with a box that stands on it."""
    mesh = seen_mesh(run)
    box = trimesh.creation.box([PART_M] * 3)
    top = mesh.vertices[mesh.faces].reshape(-1, 3)
    box.apply_translation(top[top[:, 2].argmax()] + [0, 0, PART_M / 2])
    turn = np.eye(4)
    turn[:3, :3] = UNIT * Rotation.from_euler("xyz", [30, 50, -20], degrees=True).as_matrix()
    turn[:3, 3] = [3, -2, 7]
    scene = trimesh.Scene()
    for name, part in (("body", mesh), ("box", box)):
        part.apply_transform(turn)
        scene.add_geometry(part, node_name=name, geom_name=name)
    design = run.parent / "design.glb"
    design.write_bytes(scene.export(file_type="glb"))
    values = ground("inspect", run, "--against", design)
    assert values["scale"] == pytest.approx(1 / UNIT, rel=0.05)
    assert "box" in {region["part"] for region in values["regions"] if region["kind"] == "missing"}
    assert json.loads((run / "inspection.json").read_text()) == values
    assert {part for part in ("box", "missing") if part in (run / "inspection.html").read_text()} == {
        "box",
        "missing",
    }
    coloured = trimesh.load_scene(run / "inspection.glb")
    assert {"body", "box"} <= {node.split("_")[0] for node in coloured.geometry}


def test_a_face_whose_width_is_known_to_less_than_a_quarter_is_a_crumb():
    assert _is_known({"value": 1.0, "half_width_90": 0.25})
    assert not _is_known({"value": 0.19, "half_width_90": 0.05})


def test_a_design_that_cannot_be_used_is_wrong_usage_like_any_other_file(run, tmp_path):
    (tmp_path / "no mesh.glb").write_bytes(b"no mesh")
    for name, told in (("missing.glb", "is not there"), ("no mesh.glb", "cannot be read as a mesh")):
        done = call("ground", "inspect", str(run), "--against", str(tmp_path / name))
        assert done.returncode == 2 and told in done.stderr and "Traceback" not in done.stderr
