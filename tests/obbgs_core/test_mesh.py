"""Meshes of models whose surface is known, and their files as other software reads them."""

import dataclasses
import json
import math
import subprocess
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import KDTree

from obbgs_core.errors import ExportError
from obbgs_core.io.mesh import save_mesh
from obbgs_core.mesh.flat_faces import flat_faces
from obbgs_core.mesh.solid import _apart, _outwards, _where_seen, surface_mesh
from obbgs_core.mesh.texture import layout_of
from obbgs_core.model.gaussians import Gaussians
from obbgs_core.model.mesh import SurfaceMesh
from obbgs_core.render import render
from tests import readers
from tests.obbgs_core.test_surface import PIXEL_M, SIZE, cameras_around, discs, sphere, thin_struts

ROOT = Path(__file__).parents[2]


def solid(mesh: SurfaceMesh) -> trimesh.Trimesh:
    return trimesh.Trimesh(mesh.vertices, mesh.triangles, process=False)


@pytest.fixture(scope="module")
def ball() -> SurfaceMesh:
    return surface_mesh(sphere(), cameras_around(20), max_triangles=6000)


def test_a_sphere_of_discs_gives_a_closed_sphere_of_few_triangles(ball):
    shape = solid(ball)
    assert shape.is_watertight and shape.is_winding_consistent and shape.body_count == 1
    assert 1000 < len(ball.triangles) <= 6000
    radii = np.linalg.norm(ball.vertices, axis=1)
    thickened_m = 0.2 * 1.5 * PIXEL_M * 4 / 3  # voxels are as wide as 1.5 pixels at the median depth
    assert abs(np.median(radii) - 1 - thickened_m) < 0.5 * PIXEL_M
    assert shape.volume == pytest.approx(4 / 3 * math.pi * np.mean(radii) ** 3, rel=0.03)
    assert (ball.seen_by > 0).all() and ball.seen_by.max() <= ball.views == 20


def test_a_plate_without_thickness_keeps_its_area_and_place():
    grid = torch.linspace(-0.8, 0.8, 24)
    x, y = (t.flatten() for t in torch.meshgrid(grid, grid, indexing="ij"))
    centres = torch.stack([x, y, torch.zeros_like(x)], dim=1)
    plate = discs(centres, torch.tensor([[0.0, 0.0, 1.0]]).expand(len(x), 3), 0.04)
    shape = solid(surface_mesh(plate, cameras_around(20)))
    assert shape.is_watertight
    gaps, _ = KDTree(shape.sample(20_000, seed=0)).query(centres.numpy())
    inner = (centres[:, :2].abs() < 0.65).all(dim=1).numpy()  # its rim, seen edge-on, is rounded
    assert gaps[inner].max() < 2 * PIXEL_M and gaps.max() < 5 * PIXEL_M
    assert np.abs(shape.vertices[:, 2]).max() < 2 * PIXEL_M


def test_a_sheet_that_is_lit_from_one_side_is_hardly_thicker_than_a_voxel():
    """Its dark side, ten layers behind the lit one, hardly tells where it lies."""
    grid = torch.linspace(-0.8, 0.8, 40)
    x, y = (t.flatten() for t in torch.meshgrid(grid, grid, indexing="ij"))
    lit = torch.stack([x, y, torch.zeros_like(x)], dim=1)
    voxel_m = 1.5 * PIXEL_M * 4 / 3
    layers = [lit - torch.tensor([0.0, 0.0, depth * voxel_m]) for depth in np.linspace(0.2, 2.8, 10)]
    sheet = discs(torch.cat([lit, *layers]), torch.tensor([[0.0, 0.0, 1.0]]).expand(11 * len(x), 3), 0.03)
    sheet.sh[len(lit) :] = -0.3
    shape = solid(surface_mesh(sheet, cameras_around(40)))
    assert shape.is_watertight
    middle = shape.vertices[(np.abs(shape.vertices[:, :2]) < 0.5).all(axis=1)]
    assert np.ptp(middle[:, 2]) < 1.7 * voxel_m and np.abs(middle[:, 2]).max() < 1.7 * voxel_m
    inner = (np.abs(shape.triangles_center[:, :2]) < 0.75).all(axis=1)
    assert shape.area_faces[inner].sum() / 2 == pytest.approx(1.5**2, rel=0.05)  # flat, and no hole


@pytest.fixture(scope="module")
def box() -> SurfaceMesh:
    """A cube of 1.2 m, its upper half three times as bright."""
    grid = torch.linspace(-0.6, 0.6, 28)
    u, v = (t.flatten() for t in torch.meshgrid(grid, grid, indexing="ij"))
    centres, normals = [], []
    for axis in range(3):
        for side in (-1.0, 1.0):
            face = torch.stack([u, v, torch.full_like(u, side * 0.6)], dim=1).roll(axis + 1, dims=1)
            centres.append(face)
            normals.append(torch.eye(3)[axis].expand(len(u), 3))
    cube = discs(torch.cat(centres), torch.cat(normals), 0.026)
    cube.sh[cube.means[:, 2] > 0] = 3.0
    return surface_mesh(cube, cameras_around(40))


def test_the_faces_of_a_box_are_planes_and_its_edges_are_sharp(box):
    shape = solid(box)
    assert shape.is_watertight
    largest = np.abs(shape.face_normals).max(axis=1)
    straight = largest > np.cos(np.radians(2))
    assert shape.area_faces[straight].sum() > 0.9 * shape.area
    for axis in range(3):
        for side in (-1, 1):
            facing = side * shape.face_normals[:, axis] > np.cos(np.radians(2))
            away, area = side * shape.triangles_center[facing, axis], shape.area_faces[facing]
            plane = np.median(np.repeat(away, np.ceil(area / area.mean()).astype(int)))
            assert abs(plane - 0.6) < 0.5 * PIXEL_M
            assert area[np.abs(away - plane) < 0.3 * PIXEL_M].sum() > 0.95 * area.sum()
    corners = np.array(np.meshgrid(*[[-0.6, 0.6]] * 3)).reshape(3, -1).T
    gaps, _ = KDTree(shape.vertices).query(corners)
    assert gaps.max() < 2 * PIXEL_M


def test_sheets_that_touch_along_an_edge_stay_closed_when_vertices_are_merged():
    first, second = trimesh.creation.box(), trimesh.creation.box().apply_translation([1.0, 1.0, 0.0])
    vertices = np.concatenate([first.vertices, second.vertices])
    triangles = np.concatenate([first.faces, second.faces + len(first.vertices)])
    assert not trimesh.Trimesh(vertices, triangles, process=True).is_watertight
    apart = _apart(vertices, _outwards(vertices, triangles), voxel_m=0.1)
    merged = trimesh.Trimesh(apart, triangles, process=True)
    assert merged.is_watertight and len(merged.vertices) == 16
    assert np.abs(apart - vertices).max() < 0.001  # a hundredth of a voxel


def test_the_texture_shows_what_lies_between_the_vertices(box):
    """Interpolated as viewers do, at random places; a pixel beside where the light changes."""
    height, width = box.texture.shape[:2]
    rng = np.random.default_rng(0)
    weights = rng.dirichlet([1, 1, 1], len(box.triangles))
    places = np.einsum("fk,fkj->fj", weights, box.vertices[box.triangles])
    at = np.einsum("fk,fkj->fj", weights, box.corners) * [width, height]
    column, row = np.floor(at).astype(int).T
    seen = box.texture[row, column, 0]
    plain = (np.abs(places[:, 2]) > 3 * PIXEL_M) & (np.abs(places[:, 2]) < 0.5)
    dark, bright = (0.2820948 * level for level in (1.0, 3.0))
    expected = np.where(places[:, 2] > 0, bright, dark)
    assert plain.sum() > 200
    assert np.median(np.abs(seen / expected - 1)[plain]) < 0.05
    assert (np.abs(seen / expected - 1)[plain] < 0.3).mean() > 0.95


def test_a_ball_has_no_flat_face(ball):
    faces, face = flat_faces(ball.vertices, ball.triangles, 1.5 * PIXEL_M)
    assert (face >= 0).mean() < 0.3 and faces.areas.sum() < 0.3 * solid(ball).area


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 1000), st.floats(0.01, 0.3))
def test_charts_of_a_texture_do_not_overlap_and_know_where_they_lie(seed, texel_m):
    shape = trimesh.convex.convex_hull(np.random.default_rng(seed).normal(size=(12, 3)))
    layout = layout_of(shape.vertices, shape.faces, texel_m)
    assert len(np.unique(layout.texels)) == len(layout.texels)
    assert (layout.corners >= 0).all() and (layout.corners <= [layout.width, layout.height]).all()
    place = np.full((layout.width * layout.height, 3), np.nan)
    place[layout.texels] = layout.places
    middles, at = shape.triangles_center, layout.corners.mean(axis=1)
    column, row = np.floor(at).astype(int).T
    edges_m = np.linalg.norm(np.diff(shape.vertices[shape.edges], axis=1), axis=2).max()
    edges = np.linalg.norm(layout.corners - np.roll(layout.corners, 1, axis=1), axis=2).max()
    gaps = np.linalg.norm(place[row * layout.width + column] - middles, axis=1)
    assert gaps.max() <= 0.5**0.5 * 1.001 * edges_m / edges


def test_struts_thinner_than_a_pixel_stay_whole():
    struts, lines = thin_struts()
    shape = solid(surface_mesh(struts, cameras_around(20)))
    assert shape.is_watertight and shape.body_count == 3
    gaps, _ = KDTree(shape.sample(20_000, seed=0)).query(lines)
    assert (gaps < 2 * PIXEL_M).mean() > 0.9
    beside, _ = KDTree(lines).query(shape.vertices)
    assert beside.max() < 4 * PIXEL_M


def test_a_target_of_very_few_pixels_has_no_mesh():
    speck, cameras = sphere(100), cameras_around(6)
    speck.means *= 0.001
    speck.log_scales[:] = math.log(0.001)
    K = cameras.K.clone()
    K[:, :2, 2] = 10.5  # within three pixels beside every fourth one, which are looked at first
    with pytest.raises(ExportError, match="a few pixels wide"):
        surface_mesh(speck, dataclasses.replace(cameras, K=K))


def test_the_side_that_no_view_sees_is_marked_and_closed():
    around = cameras_around(40)
    above = torch.nonzero(around.centres[:, 2] > 1.0)[:, 0]
    cameras = type(around)(around.world_to_camera[above], around.K[above], SIZE, SIZE)
    mesh = surface_mesh(sphere(), cameras)
    assert solid(mesh).is_watertight
    heights = mesh.vertices[:, 2]
    below = heights < heights.min() + PIXEL_M  # the flat end of what is known
    assert (mesh.seen_by[heights > 0.7] > 0).all() and (mesh.seen_by[below] == 0).all()


def test_what_no_view_shows_has_no_mesh():
    faint = sphere(100)
    faint.opacity_logits[:] = -5.0
    for gaussians in (faint, faint.select(torch.tensor([], dtype=torch.long))):
        with pytest.raises(ExportError, match="nothing to make a mesh of"):
            surface_mesh(gaussians, cameras_around(4))
    with pytest.raises(ValueError, match="at least 100 triangles"):
        surface_mesh(faint, cameras_around(4), max_triangles=3)


def test_the_colour_is_that_of_the_body_and_not_of_what_is_behind_its_outline():
    around = cameras_around(20)
    expected = (
        render(sphere(), around.one(0)).radiance.max().item()
    )  # in its middle, where nothing shines through
    for background in (0.0, 2.0):
        mesh = surface_mesh(sphere(), dataclasses.replace(around, background=background))
        np.testing.assert_allclose(mesh.colours, expected, rtol=1e-3)


def test_vertices_go_to_the_middle_of_what_the_views_in_front_see():
    above, voxel_m = cameras_around(20), 0.05
    errors_m = 0.02 * torch.randn(
        20, generator=torch.Generator().manual_seed(2)
    )  # one for each view's whole depth
    maps = []
    for c, error_m in enumerate(errors_m.tolist()):  # each sees the plane z = 0 a little above or below it
        R, t = above.world_to_camera[c, :3, :3], above.world_to_camera[c, :3, 3]
        normal, offset = R[:, 2], (R[:, 2] * t).sum() + error_m  # normal . x = offset, in the camera's axes
        v, u = torch.meshgrid(torch.arange(SIZE) + 0.5, torch.arange(SIZE) + 0.5, indexing="ij")
        K = above.K[c]
        tangents = torch.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], torch.ones_like(u)], dim=-1)
        depth = offset / (tangents @ normal)
        slope = -(depth**2 / offset)[..., None] * normal[:2] / K[[0, 1], [0, 1]]
        maps.append((depth, slope))
    seen = torch.nonzero(above.centres[:, 2] > 0.3 * above.centres.norm(dim=1))[:, 0]
    vertices = np.random.default_rng(1).uniform(-0.3, 0.3, (50, 3)) * [1, 1, 0] - [0, 0, 0.03]
    moved = _where_seen(vertices, np.tile([0.0, 0.0, 1.0], (50, 1)), maps, above, voxel_m)
    np.testing.assert_allclose(moved[:, :2], vertices[:, :2])
    np.testing.assert_allclose(moved[:, 2], errors_m[seen].median().item(), atol=2e-3)


def test_the_colour_is_the_radiance_and_under_lamberts_law_the_albedo(ball):
    assert not ball.is_albedo
    np.testing.assert_allclose(
        ball.colours, 0.2820948, rtol=0.15
    )  # the harmonic of degree 0 of coefficient 1
    one = sphere()
    lit = Gaussians(**one.tensors(), shading="lambert", ambient=torch.tensor(0.1))
    cameras = cameras_around(20)
    suns = torch.tensor([[0.0, 0.0, 1.0]]).expand(20, 3)
    views_of_it = type(cameras)(cameras.world_to_camera, cameras.K, SIZE, SIZE, sun_dir=suns)
    mesh = surface_mesh(lit, views_of_it)
    assert mesh.is_albedo
    dark_side = mesh.vertices[:, 2] < -0.5  # the same albedo as the lit one
    np.testing.assert_allclose(mesh.colours[dark_side].mean(), ball.colours.mean(), rtol=0.02)
    corrected = dataclasses.replace(lit, sh=torch.cat([lit.sh, torch.zeros(len(lit), 3, 1)], dim=1))
    corrected.sh[:, 2] = -0.5  # darker towards the Sun of +z
    with pytest.raises(ValueError, match="give sun_dir"):
        surface_mesh(corrected, views_of_it)
    darker = surface_mesh(corrected, views_of_it, sun_dir=suns[0])
    raw = torch.tensor([0.2820948 - 0.5 * 0.4886025, 0.2820948])
    expected, before = torch.nn.functional.softplus(10 * raw).tolist()
    np.testing.assert_allclose(darker.colours.mean() / mesh.colours.mean(), expected / before, rtol=0.02)


@pytest.mark.parametrize("file_type", ["glb", "obj", "stl", "ply"])
def test_trimesh_reads_the_same_closed_body_from_every_format(ball, tmp_path, file_type):
    path = tmp_path / f"mesh.{file_type}"
    save_mesh(ball, path, float(ball.colours.max()))
    read = trimesh.load_scene(path).to_mesh()
    read.merge_vertices(merge_norm=True, merge_tex=True)
    assert read.is_watertight and len(read.faces) == len(ball.triangles)
    assert read.volume == pytest.approx(solid(ball).volume, rel=1e-4)


def test_the_files_keep_how_many_views_saw_each_vertex(ball, tmp_path):
    save_mesh(ball, tmp_path / "mesh.glb", 1.0)
    (geometry,) = trimesh.load_scene(tmp_path / "mesh.glb").geometry.values()
    gaps, vertex = KDTree(ball.vertices).query(geometry.vertices)  # one stands for each piece of the texture
    assert gaps.max() < 1e-6 and len(np.unique(vertex)) == len(ball.vertices)
    read = geometry.vertex_attributes["_SEEN_BY_VIEWS"].ravel()
    np.testing.assert_array_equal(read, ball.seen_by[vertex])
    save_mesh(ball, tmp_path / "mesh.ply", 1.0)
    assert b"SEEN_BY_VIEWS" in (tmp_path / "mesh.ply").read_bytes()[:600]
    with pytest.raises(ValueError, match="glb, obj, stl, ply"):
        save_mesh(ball, tmp_path / "mesh.fbx", 1.0)
    assert {path.name for path in tmp_path.iterdir()} == {"mesh.glb", "mesh.ply"}


def test_khronos_own_validator_has_nothing_to_say(ball, tmp_path):
    programs = readers.installed()
    save_mesh(ball, tmp_path / "mesh.glb", 1.0)
    issues = readers.gltf_issues(programs, tmp_path / "mesh.glb")
    assert (issues["numErrors"], issues["numWarnings"], issues["numInfos"]) == (0, 0, 0), issues["messages"]


def test_blender_opens_it_in_the_bodys_own_axes(ball, tmp_path):
    python = ROOT / ".venv-blender" / "bin" / "python"
    if not python.exists():
        pytest.skip("Blender's Python is not installed: ./setup.sh installs it")
    save_mesh(ball, tmp_path / "mesh.glb", 1.0)
    code = f"""
import bpy, json
bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.ops.import_scene.gltf(filepath={str(tmp_path / "mesh.glb")!r})
(body,) = [o for o in bpy.data.objects if o.type == "MESH"]
corners = [body.matrix_world @ v.co for v in body.data.vertices]
names = sorted(a.name for a in body.data.attributes)
names += [image.name for image in bpy.data.images if tuple(image.size) == {ball.texture.shape[1::-1]!r}]
print("READ", json.dumps([[list(c) for c in corners[:50]], names, len(body.data.polygons)]))
"""
    done = subprocess.run(
        [str(python), "-c", code], capture_output=True, text=True, check=True, timeout=120, cwd=tmp_path
    )
    (line,) = [line for line in done.stdout.splitlines() if line.startswith("READ ")]
    corners, names, polygons = json.loads(line.removeprefix("READ "))
    gaps, _ = KDTree(ball.vertices).query(np.array(corners))
    assert gaps.max() < 1e-5 and polygons == len(ball.triangles)
    assert {"_SEEN_BY_VIEWS", "UVMap"} < set(names) and names[-1] not in ("UVMap", "sharp_face")
