"""What meshes of triangles are asked: neighbours, normals, areas."""

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components


def geometry_of(vertices: np.ndarray, triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the middles [F, 3], unit normals [F, 3] (right-hand rule) and areas [F] of triangles."""
    a, b, c = (vertices[triangles[:, corner]] for corner in range(3))
    normals = np.cross(b - a, c - a)
    doubled = np.linalg.norm(normals, axis=1)
    return (a + b + c) / 3, normals / doubled.clip(1e-300)[:, None], doubled / 2


def edges_of(triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the edges of triangles [3F, 2], the lower vertex first, and the triangle of each [3F]; sorted by edge."""
    edges = np.sort(
        np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]]), axis=1
    )
    owners = np.tile(np.arange(len(triangles)), 3)
    order = np.lexsort((edges[:, 1], edges[:, 0]))
    return edges[order], owners[order]


def neighbours_of(triangles: np.ndarray) -> np.ndarray:
    """Return the pairs [E, 2] of triangles of a closed mesh that share an edge."""
    edges, owners = edges_of(triangles)
    same = (edges[1:] == edges[:-1]).all(axis=1)
    return np.stack([owners[:-1][same], owners[1:][same]], axis=1)


def pieces_of(count: int, pairs: np.ndarray) -> np.ndarray:
    """Return the number [count] of the piece that each triangle is in: `pairs` [E, 2] of them hang together."""
    links = coo_array((np.ones(len(pairs)), pairs.T), shape=(count, count))
    return connected_components(links, directed=False)[1]


def smoothed(normals: np.ndarray, areas: np.ndarray, neighbours: np.ndarray, rounds: int) -> np.ndarray:
    """Return unit normals [F, 3], each the mean of its own and its neighbours', weighted by area, so many times."""
    sums = normals * areas[:, None]
    for _ in range(rounds):
        around = sums.copy()
        np.add.at(around, neighbours[:, 0], sums[neighbours[:, 1]])
        np.add.at(around, neighbours[:, 1], sums[neighbours[:, 0]])
        sums = around
    return _unit(sums)


def vertex_normals(count: int, triangles: np.ndarray, normals: np.ndarray, areas: np.ndarray) -> np.ndarray:
    """Return unit normals [V, 3] of vertices: the mean of their triangles', weighted by area."""
    sums = np.zeros((count, 3))
    for corner in range(3):
        np.add.at(sums, triangles[:, corner], normals * areas[:, None])
    return _unit(sums)


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True).clip(1e-300)
