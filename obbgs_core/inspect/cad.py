"""A body as it was designed: a triangle mesh in parts, and points spread evenly over it."""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from obbgs_core.errors import ReconstructionError

MAX_SAMPLES = 150_000
PLANAR_COS = float(
    np.cos(np.radians(8.0))
)  # neighbouring triangles that bend less belong to one planar segment
DRACO = "KHR_draco_mesh_compression"


class CadError(ReconstructionError, ValueError):
    """A mesh of a design that cannot be used; the message says why and what to do."""

    exit_code = 2  # like any other file that was given and is not what is asked for


@dataclass(frozen=True)
class CadMesh:
    """Triangles in parts, in the units and axes of their file.

    vertices [V, 3] float64; triangles [F, 3]; part [F], the index of each triangle's part in `names`.
    """

    vertices: np.ndarray
    triangles: np.ndarray
    part: np.ndarray
    names: tuple[str, ...]

    def corners(self) -> np.ndarray:
        """Return the corners [F, 3, 3] of the triangles."""
        return self.vertices[self.triangles]

    def moved(self, matrix: np.ndarray) -> "CadMesh":
        """Return the mesh after an affine map [4, 4]."""
        vertices = self.vertices @ matrix[:3, :3].T + matrix[:3, 3]
        return CadMesh(vertices, self.triangles, self.part, self.names)


@dataclass(frozen=True)
class Samples:
    """Points spread over a mesh: points [N, 3], unit normals [N, 3], part [N], and the area [N] of each."""

    points: np.ndarray
    normals: np.ndarray
    part: np.ndarray
    area: np.ndarray

    def select(self, chosen: np.ndarray) -> "Samples":
        return Samples(self.points[chosen], self.normals[chosen], self.part[chosen], self.area[chosen])


def read_cad(path: Path) -> CadMesh:
    """Return the mesh of a design: GLB, glTF, OBJ, STL, PLY or whatever else trimesh reads.

    Its parts are the nodes of the file that have triangles. Where there is one node only, they are its connected
    pieces, and where there is one piece only, its planar segments.

    Raises:
        CadError: it cannot be read, holds no triangles, or is compressed by Draco, which needs a decoder.
    """
    # loaded here: half a second, and most users of the library read no design
    import trimesh

    if not path.is_file():
        raise CadError(f"{path} is not there: expected a mesh of the design (GLB, OBJ, STL or PLY)")
    with path.open("rb") as file:
        head = file.read(1 << 22)
    if DRACO.encode() in head:
        raise CadError(
            f"{path} is compressed by Draco, which is not read here: write it again without compression, in Blender "
            "(export glTF, Compression off) or by `gltf-transform copy`"
        )
    try:
        scene = trimesh.load_scene(path)
        pieces = [
            (
                _plain_name(str(node), geometry),
                geometry.vertices @ matrix[:3, :3].T + matrix[:3, 3],
                np.asarray(geometry.faces),
            )
            for node in scene.graph.nodes_geometry
            for matrix, name in [scene.graph[node]]
            if isinstance(geometry := scene.geometry[name], trimesh.Trimesh) and len(geometry.faces)
        ]
    # whatever a reader of foreign files stumbles over means the same to the user
    except Exception as error:
        raise CadError(f"{path} cannot be read as a mesh: {error}; expected GLB, OBJ, STL or PLY") from error
    if not pieces:
        raise CadError(f"{path} holds no triangles: expected a mesh of the design")
    mesh = _put_together(pieces)
    if not np.isfinite(mesh.vertices).all() or len(mesh.triangles) == 0:
        raise CadError(f"{path} holds no triangles with an area and finite corners: write it again")
    return mesh if len(mesh.names) > 1 else _divided(mesh)


def _plain_name(node: str, geometry: Any) -> str:
    """Return the name of a node and of its material, without the random digits that trimesh puts after it."""
    plain = re.sub(r"_[0-9a-f]{6}$", "", node)
    material = getattr(getattr(geometry.visual, "material", None), "name", None)
    return plain if not material or material == plain else f"{plain} ({material})"


def _put_together(pieces: list[tuple[str, np.ndarray, np.ndarray]]) -> CadMesh:
    """Return one mesh of named pieces of vertices and triangles, without triangles that have no area."""
    vertices, triangles, part, first = [], [], [], 0
    for number, (_, places, faces) in enumerate(pieces):
        vertices.append(np.asarray(places, dtype=np.float64))
        triangles.append(np.asarray(faces, dtype=np.int64) + first)
        part.append(np.full(len(faces), number))
        first += len(places)
    mesh = CadMesh(
        np.concatenate(vertices),
        np.concatenate(triangles),
        np.concatenate(part),
        tuple(name for name, _, _ in pieces),
    )
    areas = _areas(mesh.corners())
    kept = areas > 1e-12 * np.nanmax(areas, initial=0.0)
    return CadMesh(mesh.vertices, mesh.triangles[kept], mesh.part[kept], mesh.names)


def _divided(mesh: CadMesh) -> CadMesh:
    """Return a mesh of one part in connected pieces, or, where it is one piece, in planar segments."""
    size = float(np.ptp(mesh.vertices, axis=0).max())
    _, same = np.unique(np.round(mesh.vertices / (1e-6 * size)).astype(np.int64), axis=0, return_inverse=True)
    corners = same.reshape(-1)[mesh.triangles]
    edges = np.sort(corners[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    owner = np.repeat(np.arange(len(corners)), 3)
    order = np.lexsort(edges.T)
    beside = (edges[order[1:]] == edges[order[:-1]]).all(axis=1)
    first, second = owner[order[1:]][beside], owner[order[:-1]][beside]
    pieces = _linked(first, second, len(corners))
    kind = "piece"
    if pieces.max() == 0:
        normals = _normals(mesh.corners())
        flat = (normals[first] * normals[second]).sum(axis=1) > PLANAR_COS
        pieces, kind = _linked(first[flat], second[flat], len(corners)), "face"
    names = tuple(f"{kind} {number + 1}" for number in range(pieces.max() + 1))
    return CadMesh(mesh.vertices, mesh.triangles, pieces, names)


def _linked(first: np.ndarray, second: np.ndarray, count: int) -> np.ndarray:
    """Return the number [count] of the connected group of each element, by pairs of linked elements."""
    links = coo_array((np.ones(len(first)), (first, second)), shape=(count, count))
    return connected_components(links, directed=False)[1]


def principal_axes(points: np.ndarray) -> np.ndarray:
    """Return the axes [3, 3] (rows) along which points [N, 3] spread most, second most and least."""
    return np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2]


def groups_within(points: np.ndarray, reach: float) -> np.ndarray:
    """Return the number [N] of the group of each point [N, 3]: points within reach of each other are of one group."""
    if len(points) == 0:
        return np.zeros(0, dtype=np.int64)
    pairs = KDTree(points).query_pairs(reach, output_type="ndarray")
    return _linked(pairs[:, 0], pairs[:, 1], len(points))


def sampled(mesh: CadMesh, spacing: float, seed: int = 0, most: int = MAX_SAMPLES) -> Samples:
    """Return points about `spacing` apart, at random places of the area; the same seed gives the same points.

    The points of a triangle lie in strata, one for each of equal shares of the whole area, so that none is left out
    that is larger than a share.
    """
    corners = mesh.corners()
    areas = _areas(corners)
    total = float(areas.sum())
    count = int(np.clip(total / spacing**2, 100, most))
    rng = np.random.default_rng(seed)
    at = (np.arange(count) + rng.random(count)) * (total / count)
    triangle = np.minimum(np.searchsorted(np.cumsum(areas), at), len(areas) - 1)
    u, v = rng.random((2, count))
    root = np.sqrt(u)
    weights = np.stack([1 - root, root * (1 - v), root * v], axis=1)
    points = (weights[:, :, None] * corners[triangle]).sum(axis=1)
    return Samples(points, _normals(corners)[triangle], mesh.part[triangle], np.full(count, total / count))


def _areas(corners: np.ndarray) -> np.ndarray:
    """Return the areas [F] of triangles with corners [F, 3, 3]."""
    return 0.5 * np.linalg.norm(
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
    )


def _normals(corners: np.ndarray) -> np.ndarray:
    """Return the unit normals [F, 3] of triangles with corners [F, 3, 3], outwards by the right-hand rule.

    That of a triangle without area is zero.
    """
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    return np.divide(normals, lengths, out=np.zeros_like(normals), where=lengths > 0)
