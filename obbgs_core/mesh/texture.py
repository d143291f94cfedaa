"""Where the triangles of a mesh lie in its texture: one rectangle for each set of triangles in one plane."""

import math
from dataclasses import dataclass

import numpy as np

from obbgs_core.mesh.triangles import geometry_of, neighbours_of, pieces_of

IN_ONE_PLANE = 1 - 1e-6  # cosine between the normals of neighbours, at least: 0.08 degrees
MARGIN = 1  # texels around each chart, so that viewers that interpolate find no colour of another
LARGEST = 2048  # texels along a side; beyond it texels grow


@dataclass(frozen=True)
class Layout:
    """A texture whose texels are about `texel_m` wide.

    corners: [F, 3, 2] texels from the left and from the top, of each triangle's corners.
    places: [T, 3] m, of the middles of the texels that charts cover; outwards: [T, 3] the unit normal there; texels:
    [T] their indices in the image, row by row.
    """

    width: int
    height: int
    corners: np.ndarray
    places: np.ndarray
    outwards: np.ndarray
    texels: np.ndarray

    def image(self, colours: np.ndarray) -> np.ndarray:
        """Return the image [height, width, C] of the texels' colours [T, C]; 0 where no chart is."""
        image = np.zeros((self.height * self.width, colours.shape[1]), dtype=np.float32)
        image[self.texels] = colours
        return image.reshape(self.height, self.width, -1)


def layout_of(vertices: np.ndarray, triangles: np.ndarray, texel_m: float) -> Layout:
    """Return where the triangles [F, 3] of a closed mesh lie in a texture; sides are powers of two."""
    _, normals, areas = geometry_of(vertices, triangles)
    pairs = neighbours_of(triangles)
    pairs = pairs[(normals[pairs[:, 0]] * normals[pairs[:, 1]]).sum(axis=1) > IN_ONE_PLANE]
    chart = pieces_of(len(triangles), pairs)
    members = np.split(np.argsort(chart, kind="stable"), np.cumsum(np.bincount(chart))[:-1])
    charts = [_Chart(vertices[triangles[m]], normals[m], areas[m]) for m in members]
    while True:
        sizes = np.array([c.size(texel_m) for c in charts])
        width, height, places = _packed(sizes)
        if max(width, height) <= LARGEST:
            break
        texel_m *= 1.25
    corners = np.zeros((len(triangles), 3, 2))
    covered, outwards, texels = [], [], []
    for c, m, (left, top), (wide, high) in zip(charts, members, places, sizes, strict=True):
        corners[m] = c.plane / texel_m + MARGIN + [left, top]
        row, column = (n.ravel() for n in np.indices((high, wide)))
        covered.append(c.at(np.stack([column, row], axis=1) + 0.5 - MARGIN, texel_m))
        outwards.append(np.broadcast_to(c.normal, covered[-1].shape))
        texels.append((top + row) * width + left + column)
    return Layout(width, height, corners, *(np.concatenate(parts) for parts in (covered, outwards, texels)))


class _Chart:
    """Triangles in one plane: `plane` [n, 3, 2] m are their corners in it, from the least along its two axes."""

    def __init__(self, corners: np.ndarray, normals: np.ndarray, areas: np.ndarray):
        self.normal = areas @ normals
        self.normal /= np.linalg.norm(self.normal).clip(1e-300)
        sides = (np.roll(corners, -1, axis=1) - corners).reshape(-1, 3)
        along = sides[np.argmax(np.linalg.norm(sides, axis=1))]
        along = along - (along @ self.normal) * self.normal
        along = along / np.linalg.norm(along).clip(1e-300)
        self.axes = np.stack([along, np.cross(self.normal, along)])
        flat = corners @ self.axes.T
        least = flat.min(axis=(0, 1))
        self.plane = flat - least
        self._corner = least @ self.axes + (corners.mean(axis=(0, 1)) @ self.normal) * self.normal

    def size(self, texel_m: float) -> tuple[int, int]:
        """Return how many texels wide and high it is, with its margins."""
        wide, high = np.ceil(self.plane.max(axis=(0, 1)) / texel_m).astype(int) + 2 * MARGIN
        return int(wide), int(high)

    def at(self, texels: np.ndarray, texel_m: float) -> np.ndarray:
        """Return the places [N, 3] m of texels [N, 2] that are counted from its corner."""
        return self._corner + texels * texel_m @ self.axes


def _packed(sizes: np.ndarray) -> tuple[int, int, np.ndarray]:
    """Return width and height of a texture, powers of two, and left and top [N, 2] of rectangles: shelf by shelf."""
    width = 2 ** math.ceil(math.log2(max(int(sizes[:, 0].max()), sizes.prod(axis=1).sum() ** 0.5)))
    places = np.zeros((len(sizes), 2), dtype=int)
    left = top = shelf = 0
    for index in np.argsort(-sizes[:, 1], kind="stable"):
        wide, high = sizes[index].tolist()
        if left + wide > width:
            left, top, shelf = 0, top + shelf, 0
        places[index] = left, top
        left, shelf = left + wide, max(shelf, high)
    return width, 2 ** math.ceil(math.log2(top + shelf)), places
