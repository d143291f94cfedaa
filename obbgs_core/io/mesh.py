"""Meshes as files for other software: glTF with a texture, OBJ, STL and PLY.

Coordinates are metres in the target's body frame. glTF has its y axis up, so there a node turns the body's z axis
upwards; software whose own z axis is up, such as Blender, turns it back.
"""

from pathlib import Path
from typing import TYPE_CHECKING, get_args

import numpy as np

from obbgs_base.files import write_whole
from obbgs_base.srgb import to_srgb
from obbgs_core.io.ply import DISPLAY_GAMMA
from obbgs_core.model.mesh import MeshFormat, SurfaceMesh

if TYPE_CHECKING:
    import trimesh

SEEN_BY = "SEEN_BY_VIEWS"  # the vertex attribute; glTF puts an underscore in front of such names
Z_UP_TO_Y_UP = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])


def save_mesh(mesh: SurfaceMesh, path: Path, white_radiance: float) -> None:
    """Write a mesh in the format that the file's ending names; the file appears whole or not at all.

    glTF and PLY hold the number of views that see each vertex (`_SEEN_BY_VIEWS`, `SEEN_BY_VIEWS`). glTF has a texture
    of 8 bits, sRGB-coded as it asks; its vertices are there once for each piece of the texture that they belong to.
    OBJ and PLY have display values at their vertices, STL no colours.

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
    if file_type == "glb":
        scene = trimesh.Scene()
        scene.add_geometry(_textured(mesh, white_radiance), geom_name="target", transform=Z_UP_TO_Y_UP)
        content = scene.export(
            file_type="glb",
            include_normals=True,
            tree_postprocessor=None if mesh.is_albedo else _shown_as_it_is,
        )
    else:
        solid = trimesh.Trimesh(mesh.vertices, mesh.triangles, process=False)
        solid.vertex_attributes[SEEN_BY] = mesh.seen_by.astype(np.float32)
        if file_type != "stl":
            colours = _of_white(mesh.colours, white_radiance)
            display = np.round(255 * colours ** (1 / DISPLAY_GAMMA)).astype(np.uint8)
            solid.visual = trimesh.visual.ColorVisuals(solid, vertex_colors=display)
        content = solid.export(file_type=file_type)
    assert isinstance(content, (bytes, str))  # formats of several files give a dict
    write_whole(path, content.encode() if isinstance(content, str) else content)


def _of_white(colours: np.ndarray, white_radiance: float) -> np.ndarray:
    """Return colours [..., 3] from 0 to 1, where 1 is white, of radiances [..., C]."""
    colours = (colours / white_radiance).clip(0, 1)
    return np.broadcast_to(colours, (*colours.shape[:-1], 3))


def _textured(mesh: SurfaceMesh, white_radiance: float) -> "trimesh.Trimesh":
    """Return a mesh with its texture, whose vertices have one place in it each."""
    import trimesh
    import trimesh.visual.material
    from PIL import Image

    corners = np.concatenate([mesh.triangles.reshape(-1, 1), mesh.corners.reshape(-1, 2)], axis=1)
    _, first, number = np.unique(corners, axis=0, return_index=True, return_inverse=True)
    vertex, (u, v) = mesh.triangles.ravel()[first], mesh.corners.reshape(-1, 2)[first].T
    coded = np.round(255 * to_srgb(_of_white(mesh.texture, white_radiance))).astype(np.uint8)
    material = trimesh.visual.material.PBRMaterial(
        name="albedo" if mesh.is_albedo else "radiance",
        baseColorTexture=Image.fromarray(coded),
        metallicFactor=0.0,
        roughnessFactor=1.0,
    )
    solid = trimesh.Trimesh(mesh.vertices[vertex], number.reshape(-1, 3), process=False)
    # trimesh counts v from below
    solid.visual = trimesh.visual.TextureVisuals(np.stack([u, 1 - v], axis=1), material=material)
    solid.vertex_attributes[SEEN_BY] = mesh.seen_by[vertex].astype(np.float32)
    return solid


def _shown_as_it_is(tree: dict) -> None:
    """Say that the light is part of the colours: viewers add none."""
    for material in tree["materials"]:
        material["extensions"] = {"KHR_materials_unlit": {}}
    tree["extensionsUsed"] = ["KHR_materials_unlit"]
