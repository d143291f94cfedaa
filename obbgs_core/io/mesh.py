"""Meshes as files for other software: glTF, OBJ, STL and PLY.

Coordinates are metres in the target's body frame. glTF has its y axis up, so there a node turns the body's z axis
upwards; software whose own z axis is up, such as Blender, turns it back.
"""

from pathlib import Path
from typing import get_args

import numpy as np

from obbgs_base.files import write_whole
from obbgs_core.io.ply import DISPLAY_GAMMA
from obbgs_core.model.mesh import MeshFormat, SurfaceMesh

SEEN_BY = "SEEN_BY_VIEWS"  # the vertex attribute; glTF puts an underscore in front of such names
COLOUR = "_LINEAR_COLOUR"  # until it is renamed to glTF's COLOR_0, which trimesh would round to 8 bits
Z_UP_TO_Y_UP = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])


def save_mesh(mesh: SurfaceMesh, path: Path, white_radiance: float) -> None:
    """Write a mesh in the format that the file's ending names; the file appears whole or not at all.

    glTF and PLY hold the number of views that see each vertex (`_SEEN_BY_VIEWS`, `SEEN_BY_VIEWS`). Colours are linear
    in glTF and display values in OBJ and PLY; STL has none.

    Args:
        white_radiance: is shown as white.

    Raises:
        ValueError: the ending is none of glb, obj, stl and ply.
    """
    # loaded here because it takes half a second, and most users of this package write no mesh
    import trimesh
    import trimesh.visual

    file_type = path.suffix.removeprefix(".")
    if file_type not in get_args(MeshFormat):
        raise ValueError(
            f"a mesh is written as {', '.join(get_args(MeshFormat))}; {path} ends in none of them"
        )
    colours = (mesh.colours / white_radiance).clip(0, 1)
    colours = np.broadcast_to(colours, (len(colours), 3)).astype(np.float32)
    solid = trimesh.Trimesh(mesh.vertices, mesh.triangles, process=False)
    solid.vertex_attributes[SEEN_BY] = mesh.seen_by.astype(np.float32)
    if file_type == "glb":
        solid.vertex_attributes[COLOUR] = colours
        scene = trimesh.Scene()
        scene.add_geometry(solid, geom_name="target", transform=Z_UP_TO_Y_UP)
        content = scene.export(
            file_type="glb",
            include_normals=True,
            tree_postprocessor=lambda tree: _finish_gltf(tree, mesh.is_albedo),
        )
    else:
        if file_type != "stl":
            display = np.round(255 * colours ** (1 / DISPLAY_GAMMA)).astype(np.uint8)
            solid.visual = trimesh.visual.ColorVisuals(solid, vertex_colors=display)
        content = solid.export(file_type=file_type)
    assert isinstance(content, (bytes, str))  # formats of several files give a dict
    write_whole(path, content.encode() if isinstance(content, str) else content)


def _finish_gltf(tree: dict, is_albedo: bool) -> None:
    """Name the colours as glTF does, and add the material: matt, or shown as it is where the light is part of it."""
    material: dict = {
        "name": "albedo" if is_albedo else "radiance",
        "pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 1.0},
    }
    if not is_albedo:
        material["extensions"] = {"KHR_materials_unlit": {}}
        tree["extensionsUsed"] = ["KHR_materials_unlit"]
    tree["materials"] = [material]
    for mesh in tree["meshes"]:
        for primitive in mesh["primitives"]:
            primitive["attributes"]["COLOR_0"] = primitive["attributes"].pop(COLOUR)
            primitive["material"] = 0
