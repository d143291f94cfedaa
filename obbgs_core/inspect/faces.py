"""Flat faces of a surface, and lengths and areas with their stated errors."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import ConvexHull, KDTree
from scipy.spatial.distance import cdist

from obbgs_core.inspect.alignment import Surface
from obbgs_core.inspect.cad import CadMesh, Samples, groups_within, principal_axes, sampled
from obbgs_core.inspect.plates import Z_90

EDGE_PX = 0.6  # standard deviation of where an edge of a model lies, at each end of a length
TRIES = 200  # planes that are looked at for each face
OFF_PX = 1.0  # from its plane, at most
FACING = 0.9  # cosine between the normals of a face and of its points, at least
LEAST_AREA_PX = 60.0  # of a face, in squares of a pixel
MOST_FACES = 16
LINKED_PX = 1.5
# by which a face bends at most: those of bodies with flat ones bend by 0.15, strips of dishes and hulls by 0.6 and more
BEND_PX = 0.3
NARROW = 0.5  # of a face's usual width: a strip of it that is narrower is something that joins it


@dataclass(frozen=True)
class Face:
    """A flat face: indices of its points, middle [3] m, axes [3, 3] (rows: length, width, normal), extent [2] m."""

    members: np.ndarray
    middle: np.ndarray
    axes: np.ndarray
    extent: np.ndarray
    area_m2: float


def flat_faces(surface: Surface, seed: int = 0) -> list[Face]:
    """Return the flat faces of a surface, largest first (sequential RANSAC, Fischler and Bolles 1981).

    A face hangs together, and its area is what its points cover of its plane.
    """
    rng = np.random.default_rng(seed)
    left, faces, pixel_m = np.arange(len(surface.points)), [], surface.pixel_m
    while len(left) >= 20 and len(faces) < MOST_FACES:
        points, normals, area = surface.points[left], surface.normals[left], surface.area[left]
        chosen = _best_plane(points, normals, area, pixel_m, rng)
        groups = groups_within(points[chosen], LINKED_PX * pixel_m)
        if not len(groups):
            break
        largest = np.argmax(np.bincount(groups, area[chosen]))
        members = chosen[groups == largest]
        face = _face(left[members], points[members], normals[members], area[members], pixel_m)
        if face.area_m2 < LEAST_AREA_PX * pixel_m**2:
            break
        faces.append(face)
        left = np.delete(left, members)
    return sorted(faces, key=lambda face: -face.area_m2)


def _best_plane(
    points: np.ndarray, normals: np.ndarray, area: np.ndarray, pixel_m: float, rng: np.random.Generator
) -> np.ndarray:
    """Return the indices of the points of the plane, of some that points and their normals give, that covers most."""
    some = rng.choice(len(points), min(len(points), 3000), replace=False)
    best, normal, level = -1.0, normals[0], 0.0
    for i in rng.choice(len(points), min(TRIES, len(points)), replace=False):
        inside = np.abs((points[some] - points[i]) @ normals[i]) < OFF_PX * pixel_m
        inside &= normals[some] @ normals[i] > FACING
        if (covered := float(area[some][inside].sum())) > best:
            best, normal, level = covered, normals[i], float(points[i] @ normals[i])
    chosen = np.zeros(0, dtype=np.int64)
    for _ in range(3):
        off = np.abs(points @ normal - level)
        chosen = np.flatnonzero((off < OFF_PX * pixel_m) & (normals @ normal > FACING))
        if len(chosen) < 4:
            break
        middle = points[chosen].mean(axis=0)
        fitted = np.linalg.svd(points[chosen] - middle, full_matrices=False)[2][2]
        normal = fitted * (np.sign(fitted @ normal) or 1.0)
        level = float(middle @ normal)
    return chosen


def _face(
    members: np.ndarray, points: np.ndarray, normals: np.ndarray, area: np.ndarray, pixel_m: float
) -> Face:
    """Return a face with its smallest rectangle: one of its sides lies along the hull (Freeman and Shapira 1975)."""
    middle = points.mean(axis=0)
    axes = principal_axes(points)
    normal = axes[2] * (np.sign(axes[2] @ normals.mean(axis=0)) or 1.0)
    flat = (points - middle) @ axes[:2].T
    hull = flat[ConvexHull(flat).vertices]
    sides = np.roll(hull, -1, axis=0) - hull
    sides /= np.linalg.norm(sides, axis=1, keepdims=True)
    boxes = []
    for side in sides:
        frame = np.stack([side, [-side[1], side[0]]])
        along = hull @ frame.T
        boxes.append((float(np.ptp(along, axis=0).prod()), frame))
    _, frame = min(boxes, key=lambda box: box[0])
    covers = area * np.abs(normals @ normal)
    ends = np.array([_ends(along, covers, pixel_m) for along in (flat @ frame.T).T])
    if np.ptp(ends[0]) < np.ptp(ends[1]):
        frame, ends = frame[::-1], ends[::-1]
    in_space = frame @ axes[:2]
    axes = np.stack([in_space[0], np.cross(normal, in_space[0]), normal])
    centre = middle + ends.mean(axis=1) @ in_space
    return Face(members, centre, axes, ends[:, 1] - ends[:, 0], float(covers.sum()))


def _ends(along: np.ndarray, covers: np.ndarray, pixel_m: float) -> tuple[float, float]:
    """Return where a face begins and ends along one of its sides, m, without what stands off narrower, as a yoke does.

    Args:
        along: [N] m, of its points. covers: [N] m², what each of them covers.
    """
    low = float(along.min())
    strips = np.bincount(((along - low) / pixel_m).astype(int), covers)
    share = np.minimum(1.0, strips / np.median(strips))  # of its usual width
    wide = np.flatnonzero(share > NARROW)
    first, last = int(wide[0]), int(wide[-1]) + 1
    before = share[first - 1] if first else 0.0
    after = share[last] if last < len(share) else 0.0
    begin, end = low + (first - before) * pixel_m, low + (last + after) * pixel_m
    return max(begin, low), min(end, float(along.max()))


def is_flat(face: Face, surface: Surface) -> bool:
    """Return whether a face is flat, and no strip of a curved surface that lies within the errors of a plane."""
    along, across, off = ((surface.points[face.members] - face.middle) @ face.axes.T).T / surface.pixel_m
    bends = np.stack([along**2, along * across, across**2], axis=1)
    plane = np.stack([np.ones(len(off)), along, across], axis=1)
    fitted = np.linalg.lstsq(np.concatenate([plane, bends], axis=1), off)[0]
    return bool(np.ptp(bends @ fitted[3:]) < BEND_PX)


def faces_as_parts(mesh: CadMesh, pixel_m: float) -> CadMesh:
    """Return a mesh whose parts are its flat faces, and what is left as the last one."""
    samples = sampled(mesh, 0.5 * pixel_m)
    surface = Surface(samples.points, samples.normals, samples.area, pixel_m)
    faces = flat_faces(surface)
    number = np.full(len(samples.points), len(faces))
    for k, face in enumerate(faces):
        number[face.members] = k
    centres = mesh.corners().mean(axis=1)
    part = number[KDTree(samples.points).query(centres)[1]]
    names = (*(f"face {k + 1}" for k in range(len(faces))), "rest")
    return CadMesh(mesh.vertices, mesh.triangles, part, names)


def largest_dimension(points: np.ndarray) -> tuple[float, np.ndarray]:
    """Return the largest distance between two of the points [N, 3] m, and these two [2, 3]."""
    corners = points[ConvexHull(points).vertices]
    apart = cdist(corners, corners)
    i, j = np.unravel_index(int(apart.argmax()), apart.shape)
    return float(apart[i, j]), corners[[i, j]]


def length_half_width(length_m: float, pixel_m: float, size_deviation: float) -> float:
    """Return half the width of the 90 % interval of a length between two edges or points of a model, m."""
    return Z_90 * float(np.hypot(size_deviation * length_m, np.sqrt(2) * EDGE_PX * pixel_m))


def area_half_width(face: Face, pixel_m: float, size_deviation: float) -> float:
    """Return half the width of the 90 % interval of a face's area, m²: its size and the places of its four edges."""
    edges = np.sqrt(2) * EDGE_PX * pixel_m * np.linalg.norm(face.extent)
    return Z_90 * float(np.hypot(2 * size_deviation * face.area_m2, edges))


def nearest_on(surface: Surface | Samples, places: np.ndarray) -> np.ndarray:
    """Return the points [N, 3] of a surface that are nearest to places [N, 3], m."""
    return surface.points[KDTree(surface.points).query(places)[1]]
