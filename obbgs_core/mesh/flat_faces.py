"""Flat faces of a mesh, and the mesh with them: planes by sequential RANSAC (Fischler and Bolles 1981)."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.spatial import KDTree

from obbgs_core.mesh.triangles import geometry_of, neighbours_of, pieces_of, smoothed

OFF_VOXELS = 0.75  # from its plane, at most, of a triangle's middle
FACING = 0.85  # cosine between the normals of a face and its triangles, at least
LEAST_AREA_VOXELS = 30.0  # of a face, in squares of a voxel
TRIES = 20  # planes that are looked at for each face
AROUND_VOXELS = 4.0  # of a triangle lie those that tell its plane
FITS = 3  # of a plane to what lies on it
FAILURES = 3  # in a row end the search
MOST_FACES = 300
# Of the variance about its plane that a paraboloid explains: faces of true planes have up to a quarter, pieces of a
# dish more than half.
BENT = 0.5
AT_EDGES_VOXELS = 1.0  # from its plane, at most, of a triangle at the rim of a face: edges come out bevelled
RIM_ROUNDS = 3
MOVED_VOXELS = 1.5  # at most, of a vertex that is put onto its planes
SAME_PLACE = 0.15  # singular values of planes below it, of the largest, are those of planes that hardly cut
NORMAL_ROUNDS = 3


@dataclass(frozen=True)
class FlatFaces:
    """The planes of faces, largest first: a point [P, 3] m and a unit normal [P, 3] of each, outwards; areas [P] m²."""

    points: np.ndarray
    normals: np.ndarray
    areas: np.ndarray

    def off(self, places: np.ndarray, faces: np.ndarray) -> np.ndarray:
        """Return how far [N] m places [N, 3] lie from the planes of faces [N], positive outwards."""
        return ((places - self.points[faces]) * self.normals[faces]).sum(axis=1)


class _Search:
    """The triangles of a mesh of which none, or some, belong to a face; `face` [F], -1: to none, -2: to a bent one."""

    def __init__(self, vertices: np.ndarray, triangles: np.ndarray, voxel_m: float, seed: int):
        self.middles, normals, self.areas = geometry_of(vertices, triangles)
        self.neighbours = neighbours_of(triangles)
        self.normals = smoothed(normals, self.areas, self.neighbours, NORMAL_ROUNDS)
        self.face = np.full(len(triangles), -1)
        self.voxel_m, self.rng = voxel_m, np.random.default_rng(seed)
        self._tree = KDTree(self.middles)

    def best(self) -> tuple[np.ndarray, np.ndarray] | None:
        """Return point and normal of the plane, of some that triangles and those around them give, that has most."""
        free = np.flatnonzero(self.face == -1)
        if len(free) == 0:
            return None
        tries, share = min(TRIES, len(free)), self.areas[free] / self.areas[free].sum()
        planes = [self._around(k) for k in self.rng.choice(free, tries, p=share)]
        planes = [plane for plane in planes if plane is not None]
        return max(planes, key=lambda plane: self.areas[self.on(*plane)].sum(), default=None)

    def _around(self, triangle: int) -> tuple[np.ndarray, np.ndarray] | None:
        around = np.array(self._tree.query_ball_point(self.middles[triangle], AROUND_VOXELS * self.voxel_m))
        around = around[(self.face[around] == -1) & (self.normals[around] @ self.normals[triangle] > FACING)]
        return self.fitted(around) if len(around) >= 3 else None

    def on(self, point: np.ndarray, normal: np.ndarray) -> np.ndarray:
        """Return the free triangles that lie on a plane and face as it does."""
        near = np.abs((self.middles - point) @ normal) < OFF_VOXELS * self.voxel_m
        return np.flatnonzero(near & (self.normals @ normal > FACING) & (self.face == -1))

    def largest_piece(self, chosen: np.ndarray) -> np.ndarray:
        """Return those of the triangles that hang together in the piece of the largest area."""
        number = np.full(len(self.face), -1)
        number[chosen] = np.arange(len(chosen))
        pairs = number[self.neighbours]
        piece = pieces_of(len(chosen), pairs[(pairs >= 0).all(axis=1)])
        return chosen[piece == np.argmax(np.bincount(piece, self.areas[chosen]))]

    def fitted(self, chosen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return point and normal, outwards, of the plane with the least squares, weighted by area."""
        weights = self.areas[chosen]
        point = weights @ self.middles[chosen] / weights.sum()
        off = self.middles[chosen] - point
        normal = np.linalg.eigh((weights[:, None] * off).T @ off)[1][:, 0]
        return point, -normal if weights @ (self.normals[chosen] @ normal) < 0 else normal

    def is_bent(self, chosen: np.ndarray, point: np.ndarray, normal: np.ndarray) -> bool:
        """Return whether a paraboloid explains more than `BENT` of what deviates from the plane."""
        axes = np.linalg.svd(normal[None])[2][1:]
        x, y = ((self.middles[chosen] - point) @ axes.T / self.voxel_m).T
        weights = np.sqrt(self.areas[chosen])
        columns = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1)
        basis = np.linalg.qr(columns * weights[:, None])[0]
        off = (self.middles[chosen] - point) @ normal * weights
        return bool(np.square(basis.T[3:] @ off).sum() > BENT * np.square(off).sum())


def flat_faces(
    vertices: np.ndarray, triangles: np.ndarray, voxel_m: float, seed: int = 0
) -> tuple[FlatFaces, np.ndarray]:
    """Return the flat faces of a closed mesh, and the face of each triangle [F], -1 where it belongs to none.

    A face hangs together. What a paraboloid explains far better than a plane is a piece of something curved.

    Args:
        triangles: [F, 3], outwards by the right-hand rule, small beside a voxel.
        voxel_m: by about which the vertices err.
    """
    search, planes, areas, failures = _Search(vertices, triangles, voxel_m, seed), [], [], 0
    while len(planes) < MOST_FACES and failures < FAILURES:
        plane = search.best()
        if plane is None:
            break
        chosen = np.array([], dtype=int)
        for _ in range(FITS):
            chosen = search.on(*plane)
            if len(chosen) < 3:
                break
            chosen = search.largest_piece(chosen)
            plane = search.fitted(chosen)
        area = search.areas[chosen].sum()
        if len(chosen) < 3 or area < LEAST_AREA_VOXELS * voxel_m**2:
            failures += 1
            continue
        failures = 0
        if search.is_bent(chosen, *plane):
            search.face[chosen] = -2
            continue
        search.face[chosen] = len(planes)
        planes.append(plane)
        areas.append(area)
    points, normals = (np.array([plane[k] for plane in planes]).reshape(-1, 3) for k in range(2))
    faces = FlatFaces(points, normals, np.array(areas))
    return faces, _with_rims(vertices, triangles, search.face.clip(min=-1), faces, search.neighbours, voxel_m)


def _with_rims(
    vertices: np.ndarray,
    triangles: np.ndarray,
    face: np.ndarray,
    faces: FlatFaces,
    neighbours: np.ndarray,
    voxel_m: float,
) -> np.ndarray:
    """Return the face of each triangle [F] with those of its bevelled edges, each at the nearest plane beside it."""
    face = face.copy()
    for _ in range(RIM_ROUNDS):
        pairs = np.concatenate([neighbours, neighbours[:, ::-1]])
        pairs = pairs[(face[pairs[:, 0]] < 0) & (face[pairs[:, 1]] >= 0)]
        beside = face[pairs[:, 1]]
        corners = triangles[pairs[:, 0]]
        off = np.max([np.abs(faces.off(vertices[corners[:, k]], beside)) for k in range(3)], axis=0)
        near = off < AT_EDGES_VOXELS * voxel_m
        order = np.flatnonzero(near)[
            np.argsort(-off[near], kind="stable")
        ]  # of several the nearest is written last
        if len(order) == 0:
            break
        face[pairs[order, 0]] = beside[order]
    return face


def faces_of_simplified(
    fine: tuple[np.ndarray, np.ndarray, np.ndarray],
    simple: tuple[np.ndarray, np.ndarray],
    faces: FlatFaces,
    voxel_m: float,
) -> np.ndarray:
    """Return the face of each triangle of a simplified mesh [F'], -1 where it belongs to none.

    Args:
        fine: vertices, triangles and the face of each triangle; simple: vertices and triangles.
    """
    middles, normals, _ = geometry_of(*fine[:2])
    there, facing, _ = geometry_of(*simple)
    count = min(8, len(middles))
    index = KDTree(middles).query(there, k=count)[1].reshape(-1, count)
    alike = (normals[index] * facing[:, None]).sum(axis=2) > 0.5
    nearest = np.take_along_axis(index, alike.argmax(axis=1)[:, None], axis=1)[:, 0]
    face = np.where(alike.any(axis=1), fine[2][nearest], -1)
    chosen = np.flatnonzero(face >= 0)
    corners = simple[0][simple[1][chosen]]
    off = np.max([np.abs(faces.off(corners[:, k], face[chosen])) for k in range(3)], axis=0)
    turned = (facing[chosen] * faces.normals[face[chosen]]).sum(axis=1) < 0.7
    face[chosen[(off > AT_EDGES_VOXELS * voxel_m) | turned]] = -1
    return face


def flattened(
    vertices: np.ndarray, triangles: np.ndarray, face: np.ndarray, faces: FlatFaces, voxel_m: float
) -> np.ndarray:
    """Return the vertices [V, 3] m with those of faces [F] on their planes: on an edge where two meet, at a corner.

    Where planes hardly cut, or too far away, a vertex goes to those of the larger faces alone.
    """
    pairs = np.unique(np.stack([triangles.ravel(), np.repeat(face, 3)], axis=1), axis=0)
    pairs = pairs[pairs[:, 1] >= 0]
    moved = vertices.copy()
    if len(pairs) == 0:
        return moved
    for vertex, among in _grouped(pairs):
        among = among[np.argsort(-faces.areas[among], kind="stable")]
        while len(among):
            off = -((vertices[vertex] - faces.points[among]) * faces.normals[among]).sum(axis=1)
            step = np.linalg.pinv(faces.normals[among], rcond=SAME_PLACE) @ off
            if np.linalg.norm(step) < MOVED_VOXELS * voxel_m:
                moved[vertex] += step
                break
            among = among[:-1]
    return moved


def _grouped(pairs: np.ndarray) -> Iterator[tuple[int, np.ndarray]]:
    """Return the different first values of pairs [N, 2], which are sorted, and the second values that go with each."""
    first, starts = np.unique(pairs[:, 0], return_index=True)
    return zip(first.tolist(), np.split(pairs[:, 1], starts[1:]), strict=True)
