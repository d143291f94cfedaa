"""The target that comes with the project: a parametric spacecraft made of simple solids.

Body axes: +z faces the Sun (as the solar panels do), +y along the panels, +x towards the dish; metres.
"""

from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from PIL import Image
from trimesh.transformations import rotation_matrix, translation_matrix
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

from hil.sky import Materials, crinkles

# base colour (linear), metallic, roughness
MATT = {
    "gold_foil": ((0.75, 0.48, 0.12), 0.3, 0.35),
    "white_paint": ((0.80, 0.80, 0.78), 0.0, 0.6),
    "solar_cell": ((0.05, 0.07, 0.18), 0.1, 0.25),
    "panel_frame": ((0.55, 0.55, 0.58), 0.2, 0.5),
    "black_radiator": ((0.12, 0.12, 0.13), 0.0, 0.7),
    "aluminium": ((0.62, 0.64, 0.66), 0.3, 0.4),
}
FOIL = MATT | {  # what reflects the Sun like a mirror that is more or less rough
    "gold_foil": ((0.83, 0.54, 0.16), 1.0, 0.3),
    "solar_cell": ((0.012, 0.015, 0.03), 0.0, 0.15),
    "aluminium": ((0.62, 0.64, 0.66), 1.0, 0.35),
    "dish": ((0.75, 0.75, 0.73), 1.0, 0.3),
}
MATERIALS = {"own": MATT, "foil": FOIL}


def build(materials: Materials = "own") -> trimesh.Scene:
    """Return the spacecraft as a scene with one mesh for each material; it is 6.0 m from panel tip to panel tip.

    With materials `foil`, gold foil is crinkled by a normal map, along texture coordinates that are lengths on each of
    the body's six sides.
    """
    outfit = MATERIALS[materials]
    parts: dict[str, list[trimesh.Trimesh]] = {name: [] for name in FOIL}
    _bus(parts)
    for side in (-1, 1):
        _solar_panel(parts, side)
    _dish(parts)
    _boom_and_antennas(parts)
    if "dish" not in outfit:
        parts["white_paint"] += parts.pop("dish")
    scene = trimesh.Scene()
    for name, meshes in parts.items():
        mesh: Any = trimesh.util.concatenate(meshes)
        colour, metallic, roughness = outfit[name]
        material = PBRMaterial(
            name=name, baseColorFactor=[*colour, 1.0], metallicFactor=metallic, roughnessFactor=roughness
        )
        uv = None
        if name == "gold_foil" and materials == "foil":
            material.normalTexture = Image.fromarray(crinkles.normal_map())
            uv = _lengths_on_sides(mesh) / crinkles.TILE_M
        mesh.visual = TextureVisuals(uv=uv, material=material)
        scene.add_geometry(mesh, node_name=name, geom_name=name)
    return scene


def write(path: Path, materials: Materials = "own") -> None:
    """Write the spacecraft as binary glTF."""
    content: Any = build(materials).export(file_type="glb", include_normals=True)
    path.write_bytes(content)


def _lengths_on_sides(mesh: trimesh.Trimesh) -> np.ndarray:
    """Return each vertex's coordinates [V, 2] m in the plane of its side, for boxes along the axes."""
    across = np.abs(mesh.vertex_normals).argmax(axis=1)
    in_plane = np.array([[1, 2], [0, 2], [0, 1]])[across]
    return np.take_along_axis(mesh.vertices, in_plane, axis=1)


def _box(size: tuple[float, float, float], centre: tuple[float, float, float]) -> trimesh.Trimesh:
    # Vertices that faces do not share keep the edges sharp where a viewer smooths normals.
    mesh = trimesh.creation.box(extents=size, transform=translation_matrix(centre))
    mesh.unmerge_vertices()
    return mesh


def _rod(
    start: tuple[float, float, float], end: tuple[float, float, float], radius_m: float
) -> trimesh.Trimesh:
    return trimesh.creation.cylinder(radius=radius_m, segment=[start, end], sections=12)


def _bus(parts: dict[str, list[trimesh.Trimesh]]) -> None:
    parts["gold_foil"].append(_box((1.2, 1.1, 1.5), (0, 0, 0)))
    parts["white_paint"].append(_box((1.0, 0.9, 0.06), (0, 0, 0.78)))
    for y in (-0.28, 0.28):
        parts["black_radiator"].append(_box((0.03, 0.42, 1.0), (-0.615, y, 0.1)))
    for x in (-0.35, 0.35):
        parts["white_paint"].append(_box((0.3, 0.02, 0.9), (x, 0.56, -0.15)))
        parts["black_radiator"].append(_box((0.3, 0.02, 0.6), (x, -0.56, -0.2)))
    parts["aluminium"].append(_box((0.5, 0.4, 0.25), (0.2, 0.1, -0.875)))
    nozzle = trimesh.creation.cone(radius=0.22, height=0.4, sections=24)
    nozzle.apply_transform(translation_matrix((-0.25, -0.2, -1.1)))
    parts["aluminium"].append(nozzle)
    for x in (-0.6, 0.6):  # star trackers: two baffles on the Sun side, tilted outwards
        baffle = trimesh.creation.cylinder(radius=0.09, height=0.35, sections=20)
        baffle.apply_transform(
            translation_matrix((0.55 * x, 0.3, 0.95)) @ rotation_matrix(0.5 * x, (0, 1, 0))
        )
        parts["black_radiator"].append(baffle)


def _solar_panel(parts: dict[str, list[trimesh.Trimesh]], side: int) -> None:
    """Add one side's three hinged segments: frames with a grid of cells on the Sun side and white paint behind."""
    parts["aluminium"].append(_rod((0, side * 0.55, 0.1), (0, side * 0.9, 0.1), 0.035))
    length_m, width_m = 0.68, 1.3
    for segment in range(3):
        y = side * (0.9 + length_m / 2 + segment * (length_m + 0.03))
        parts["panel_frame"].append(_box((width_m, length_m, 0.03), (0, y, 0.1)))
        parts["white_paint"].append(_box((width_m - 0.06, length_m - 0.06, 0.006), (0, y, 0.084)))
        columns, rows = 6, 3
        cell_x, cell_y = (width_m - 0.04) / columns, (length_m - 0.04) / rows
        for i in range(columns):
            for j in range(rows):
                centre = (
                    (i + 0.5) * cell_x - (width_m - 0.04) / 2,
                    y + (j + 0.5) * cell_y - (length_m - 0.04) / 2,
                )
                parts["solar_cell"].append(_box((cell_x - 0.025, cell_y - 0.025, 0.006), (*centre, 0.118)))


def _dish(parts: dict[str, list[trimesh.Trimesh]]) -> None:
    """Add a parabolic reflector with a feed on three struts, which points along +x and slightly upwards."""
    radius_m, depth_m = 0.55, 0.18
    r = np.linspace(0.0, radius_m, 12)
    outline = np.stack([r, depth_m * (r / radius_m) ** 2], axis=1)
    back = np.add(outline[::-1], (0.0, -0.02))
    reflector = trimesh.creation.revolve(np.vstack([outline, back]), sections=36)
    trimesh.repair.fix_normals(reflector)
    place = translation_matrix((0.75, 0.0, 0.25)) @ rotation_matrix(np.radians(70), (0, 1, 0))
    reflector.apply_transform(place)
    parts["dish"].append(reflector)
    feed = (place @ (0, 0, 0.42, 1))[:3]
    for angle in np.radians((30, 150, 270)):
        rim = (place @ (0.45 * np.cos(angle), 0.45 * np.sin(angle), 0.12, 1))[:3]
        parts["aluminium"].append(_rod(tuple(rim), tuple(feed), 0.012))
    horn = trimesh.creation.icosphere(subdivisions=2, radius=0.06)
    horn.apply_translation(feed)
    parts["aluminium"].append(horn)
    parts["aluminium"].append(_rod((0.55, 0, 0.2), tuple((place @ (0, 0, -0.01, 1))[:3]), 0.05))


def _boom_and_antennas(parts: dict[str, list[trimesh.Trimesh]]) -> None:
    """Add a magnetometer boom along -x and two whip antennas: thin parts, which are hard to reconstruct."""
    parts["panel_frame"].append(_rod((-0.6, 0.0, -0.5), (-2.6, 0.0, -0.8), 0.022))
    parts["aluminium"].append(_box((0.14, 0.1, 0.1), (-2.65, 0.0, -0.81)))
    for y in (-0.45, 0.45):
        parts["aluminium"].append(_rod((0.45, y, -0.75), (0.75, 1.6 * y, -1.7), 0.014))
