"""Materials of the target: the shipped meshes, crinkled foil, and cell glass against the published formula of GGX."""

import io

import numpy as np
import pytest
import trimesh
from PIL import Image
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from hil import cli
from hil.sky import SHIPPED, SHIPPED_FOIL, crinkles, spacecraft
from hil.sky.blender import Worker
from tests.hil.test_blender import camera_mission, pose_at, render

BASE_LUMINANCE = 0.2126 * 0.012 + 0.7152 * 0.015 + 0.0722 * 0.03  # of the cells behind the glass (Rec. 709)
SHIPPED_BY = {"own": SHIPPED, "foil": SHIPPED_FOIL}


@pytest.mark.parametrize("materials", SHIPPED_BY)
def test_the_target_command_writes_the_shipped_mesh_byte_for_byte(tmp_path, materials):
    """A shipped mesh is recognised by its SHA-256 and keeps its size; with other rounding it would be rescaled."""
    command = ["target", "--materials", materials, "--out", str(tmp_path / "mine.glb")]
    asked = CliRunner().invoke(cli.app, command)
    assert asked.exit_code == 0
    assert (tmp_path / "mine.glb").read_bytes() == SHIPPED_BY[materials].read_bytes()


@pytest.mark.parametrize("materials", SHIPPED_BY)
def test_the_shipped_target_is_what_the_code_builds(tmp_path, materials):
    spacecraft.write(tmp_path / "again.glb", materials)
    built, shipped = (
        trimesh.load(path, process=False) for path in (tmp_path / "again.glb", SHIPPED_BY[materials])
    )
    names = set(spacecraft.MATERIALS[materials])
    assert set(built.geometry) == set(shipped.geometry) == names
    assert set(built.graph.nodes_geometry) == set(shipped.graph.nodes_geometry) == names
    for name, expected in shipped.geometry.items():
        mesh, (placed, geometry) = built.geometry[name], built.graph[name]
        assert geometry == shipped.graph[name][1] == name
        np.testing.assert_allclose(placed, shipped.graph[name][0], atol=1e-6)
        for value in ("name", "baseColorFactor", "metallicFactor", "roughnessFactor"):  # colours in 8 bits
            ours, theirs = (getattr(each.visual.material, value) for each in (mesh, expected))
            np.testing.assert_array_equal(ours, theirs, err_msg=f"{value} of {name}")
        np.testing.assert_array_equal(mesh.faces, expected.faces)
        # processors add up rotations in float64 in other orders, and the file keeps float32: 2e-7 m at the panels' tips
        np.testing.assert_allclose(mesh.vertices, expected.vertices, rtol=0, atol=1e-6)
        np.testing.assert_allclose(mesh.vertex_normals, expected.vertex_normals, rtol=0, atol=1e-5)
    assert SHIPPED_BY[materials].stat().st_size < 300_000
    scene = spacecraft.build(materials)
    np.testing.assert_allclose(np.ptp(scene.bounds, axis=0).max(), 6.0)


def test_the_foil_carries_a_normal_map_in_lengths_on_each_side():
    foil = trimesh.load(SHIPPED_FOIL, process=False).geometry["gold_foil"]
    picture = np.asarray(foil.visual.material.normalTexture)
    # another processor may round a normal to the neighbouring of 256 steps
    assert np.abs(picture.astype(int) - crinkles.normal_map().astype(int)).max() <= 1
    corners, uv = foil.vertices[foil.faces], foil.visual.uv[foil.faces]
    lengths = np.linalg.norm(np.roll(corners, 1, axis=1) - corners, axis=2)
    in_texture = np.linalg.norm(np.roll(uv, 1, axis=1) - uv, axis=2) * crinkles.TILE_M
    np.testing.assert_allclose(in_texture, lengths, atol=1e-5)


def test_crinkles_are_flat_facets_that_repeat_without_a_seam():
    heights = crinkles.heights_m()
    pixel_m = crinkles.TILE_M / crinkles.TILE_PX
    slopes = (
        np.stack([np.roll(heights, -1, axis) - heights for axis in (0, 1)]) / pixel_m
    )  # the seam is one of them
    assert np.sqrt((slopes**2).sum(axis=0).mean()) == pytest.approx(crinkles.SLOPE, rel=1e-9)
    assert np.abs(slopes[:, -1]).max() <= np.abs(slopes[:, :-1]).max() + 1e-9
    bends = np.abs(np.roll(slopes, -1, 1) - slopes).max(axis=0)
    assert (bends < 1e-9).mean() > 0.5  # most of it is plane; folds bend it


def test_normals_of_the_map_are_those_of_the_heights():
    """Of a picture as glTF defines it: x to the right, y upwards, the middle of the range 0."""
    with io.BytesIO() as file:
        Image.fromarray(crinkles.normal_map()).save(file, "PNG")
        normals = np.asarray(Image.open(file), dtype=float) / 255 * 2 - 1
    np.testing.assert_allclose(np.linalg.norm(normals, axis=2), 1, atol=0.01)  # 8 bits
    heights = crinkles.heights_m()
    dy, dx = np.gradient(np.pad(heights, 1, mode="wrap"), crinkles.TILE_M / crinkles.TILE_PX)
    np.testing.assert_allclose(-normals[..., 0] / normals[..., 2], dx[1:-1, 1:-1], atol=0.03)
    np.testing.assert_allclose(normals[..., 1] / normals[..., 2], dy[1:-1, 1:-1], atol=0.03)


def ggx_radiance(half_angle_rad: float, incidence_rad: float, roughness: float) -> float:
    """Return the specular radiance of a plane of index 1.5 under irradiance pi, view and Sun in one plane.

    Walter et al., Microfacet Models for Refraction through Rough Surfaces, 2007: F D G / (4 cos cos), Smith's G.
    """
    alpha2 = roughness**4
    to_sun, to_view = incidence_rad + half_angle_rad, incidence_rad - half_angle_rad
    density = alpha2 / (np.pi * (np.cos(half_angle_rad) ** 2 * (alpha2 - 1) + 1) ** 2)
    masking = np.prod([2 / (1 + np.sqrt(1 + alpha2 * np.tan(angle) ** 2)) for angle in (to_sun, to_view)])
    fresnel = 0.04 + 0.96 * (1 - np.cos(incidence_rad)) ** 5  # Schlick
    return np.pi * fresnel * density * masking / (4 * np.cos(to_view))


def test_cell_glass_reflects_the_sun_as_ggx_says(tmp_path):
    """Away from the peak the Sun's own size does not matter."""
    (tmp_path / "dark.mtl").write_text("newmtl dark\nKd 0.01 0.01 0.01\n")
    plate = "mtllib dark.mtl\nv -3 -3 0\nv 3 -3 0\nv 3 3 0\nv -3 3 0\nusemtl dark\nf 1 2 3 4\n"
    (tmp_path / "plate.obj").write_text(plate)
    mission = camera_mission(24, 2000.0, 12.0)
    worker = Worker(tmp_path / "plate.obj", samples=16, ambient=0.0, materials="foil")
    try:
        for half_angle_deg in (2.0, 4.0, 8.0):
            incidence, half_angle = np.radians(25.0), np.radians(half_angle_deg)
            to_sun, to_view = (
                Rotation.from_euler("x", angle).apply((0, 0, 1))
                for angle in (incidence + half_angle, half_angle - incidence)
            )
            pose = pose_at(tuple(300 * to_view), tuple(to_sun))
            radiance = render(worker, mission, pose, tmp_path / "o.npz", float32=True)["radiance"]
            measured = float(radiance[8:16, 8:16].mean())
            matt = BASE_LUMINANCE * np.cos(incidence + half_angle)
            expected = ggx_radiance(half_angle, incidence, roughness=0.15) + matt
            assert measured == pytest.approx(expected, rel=0.1), half_angle_deg
    finally:
        worker.close()


def test_a_bright_mesh_becomes_foil_whose_glints_outshine_it(tmp_path):
    trimesh.creation.box(extents=(6, 6, 6)).export(tmp_path / "box.stl")
    mission, pose = camera_mission(48, 700.0, 24.0), pose_at((90.0, 20.0, 60.0), (0.3, -0.2, 1.0))
    contrast = {}
    for materials in SHIPPED_BY:
        worker = Worker(tmp_path / "box.stl", samples=64, materials=materials)
        try:
            image = render(worker, mission, pose, tmp_path / "o.npz", float32=True)
        finally:
            worker.close()
        lit = image["radiance"][..., 0][image["alpha"] == 255]
        contrast[materials] = lit.max() / np.median(lit)
    assert contrast["foil"] > 2 * contrast["own"], contrast  # 14 against 3
