"""A closed triangle mesh of the target, and how well each of its vertices was seen."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

MeshFormat = Literal["glb", "obj", "stl", "ply"]


@dataclass(frozen=True)
class SurfaceMesh:
    """Triangles that enclose a volume, outwards by the right-hand rule.

    vertices [V, 3] float64 m, body frame; triangles [F, 3] int64; colours [V, C] float32, C = 1 or 3, scene-linear:
    the albedo in units of the Sun's light if `is_albedo`, otherwise the mean radiance towards the views that see the
    vertex; seen_by [V] int64, the number of views, of `views`, that see it. Where that is 0 the surface only bounds
    what no view could see, and its colour is that of the nearest place that was seen.

    texture [H, W, C] float32, the same colours over the whole surface; corners [F, 3, 2] float32, where the corners of
    the triangles lie in it, from 0 at the left and the top to 1.
    """

    vertices: np.ndarray
    triangles: np.ndarray
    colours: np.ndarray
    seen_by: np.ndarray
    views: int
    is_albedo: bool
    corners: np.ndarray
    texture: np.ndarray
