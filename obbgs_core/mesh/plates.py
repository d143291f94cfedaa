"""Plates have two sides; that of which the pictures show no light goes to the other."""

import numpy as np
from scipy.spatial import KDTree

from obbgs_core.mesh.triangles import edges_of, geometry_of, neighbours_of, smoothed, vertex_normals

DARKER = 0.35  # of the light of the opposite side, at most, of a side that is moved
# of a plate: dark sides were found 2 to 3.5 voxels behind lit ones where truth has a sheet
THICKEST_VOXELS = 4.0
# is left of it: with half as much, sides went through each other when triangles were merged
THINNEST_VOXELS = 1.3
BESIDE_VOXELS = 1.0  # from a vertex's normal, at most, of what counts as opposite
OPPOSITE = -0.7  # cosine between the normals of two sides, at most
LOOKED_AT = 8  # triangles around each of some places behind a vertex
ROUNDS = 2  # the second moves the rims of what the first has moved
SMOOTHINGS = 2  # of the shift along edges, so that it ends without a step
NORMAL_ROUNDS = 3


def thinned(
    vertices: np.ndarray, triangles: np.ndarray, light: np.ndarray, voxel_m: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return the vertices [V, 3] m with the dark sides of plates close behind lit ones, and how far they went [V].

    Where no light is, nothing shows where a face lies: any Gaussian behind a lit face that is dark explains the
    pictures. A sheet that is lit from one side alone so becomes a plate of some voxels, all on the dark side.

    Args:
        triangles: [F, 3] of a closed mesh, outwards by the right-hand rule.
        light: [V] mean radiance towards the views, in any unit.
    """
    whole = np.zeros(len(vertices))
    edges = np.unique(edges_of(triangles)[0], axis=0)
    for _ in range(ROUNDS):
        middles, normals, areas = geometry_of(vertices, triangles)
        normals = smoothed(normals, areas, neighbours_of(triangles), NORMAL_ROUNDS)
        outwards = vertex_normals(len(vertices), triangles, normals, areas)
        shift = _too_thick(
            vertices, outwards, middles, normals, light, light[triangles].mean(axis=1), voxel_m
        )
        for _ in range(SMOOTHINGS):
            total, count = shift.copy(), np.ones(len(shift))
            for one, other in ((0, 1), (1, 0)):
                np.add.at(total, edges[:, one], shift[edges[:, other]])
                np.add.at(count, edges[:, one], 1)
            shift = total / count
        vertices, whole = vertices - outwards * shift[:, None], whole + shift
    return vertices, whole


def _too_thick(
    vertices: np.ndarray,
    outwards: np.ndarray,
    middles: np.ndarray,
    normals: np.ndarray,
    light: np.ndarray,
    light_there: np.ndarray,
    voxel_m: float,
) -> np.ndarray:
    """Return how far [V] m each vertex is to go inwards: 0 where it has light of its own, or nothing opposite."""
    count, tree = min(LOOKED_AT, len(middles)), KDTree(middles)
    depths_m = voxel_m * np.arange(0.5, THICKEST_VOXELS, 0.75)
    found = [tree.query(vertices - d * outwards, k=count)[1].reshape(-1, count) for d in depths_m]
    index = np.concatenate(found, axis=1)
    to = middles[index] - vertices[:, None]
    below = -(to * outwards[:, None]).sum(axis=2)
    beside = np.linalg.norm(to + below[..., None] * outwards[:, None], axis=2)
    cosine = (normals[index] * outwards[:, None]).sum(axis=2)
    # to the plane of the triangle, since its middle lies beside the normal
    depth = (to * normals[index]).sum(axis=2) / -cosine.clip(max=OPPOSITE)
    opposite = (cosine < OPPOSITE) & (depth > 0) & (depth < THICKEST_VOXELS * voxel_m)
    opposite &= beside < BESIDE_VOXELS * voxel_m
    rows, chosen = np.arange(len(vertices)), np.where(opposite, beside, np.inf).argmin(axis=1)
    is_dark = light < DARKER * light_there[index[rows, chosen]]
    excess = depth[rows, chosen] - THINNEST_VOXELS * voxel_m
    return np.where(opposite.any(axis=1) & is_dark, excess.clip(min=0), 0.0)
