"""The affine (EWA) projection of `render.projection` in an ONNX graph."""

from dataclasses import dataclass

import numpy as np

from obbgs_core.io.onnx.graph import Graph, to_numpy
from obbgs_core.model.cameras import Cameras
from obbgs_core.model.footprint import lowers_peak
from obbgs_core.model.gaussians import Gaussians
from obbgs_core.render.projection import FOV_MARGIN, MIN_PEAK_SHARE
from obbgs_core.render.reference import MIN_ALPHA

# subtracted from the extent of Gaussians that are not drawn: a negative box reaches no tile
NOT_REACHED_PX = 1e9


@dataclass(frozen=True)
class View:
    """Names of a pinhole camera's numbers, and its size."""

    R: str  # [3, 3]
    t: str  # [1, 3] m
    fx: str  # [1] px, and so on
    fy: str
    cx: str
    cy: str
    width: int
    height: int
    footprint_px2: float  # added to both axes of every projected Gaussian


@dataclass(frozen=True)
class Projected:
    """Names of the Gaussians' values on the image plane."""

    depth: str  # [N] m
    centres: list[str]  # x and y, [N] px
    extents: list[str]  # half width and half height of the bounding box, [N] px; negative if not drawn
    # [N, 7]: centre, square root of the conic (2 x 2), logarithm of the opacity; and where peaks are lowered an eighth
    # column, the share of the opacity that is left
    splats: str
    peak_lowered: bool
    depth_axes: str  # [N, 3] m: change of depth along each axis of the Gaussian, over one sigma


def camera_view(g: Graph, width: int, height: int, footprint_px2: float) -> View:
    """Return the camera that the inputs world_to_camera and K describe."""
    pose = "world_to_camera"
    R = g.op("Slice", pose, g.ints(0, 0), g.ints(3, 3), g.ints(0, 1))
    t = g.op("Reshape", g.op("Slice", pose, g.ints(0, 3), g.ints(3, 4), g.ints(0, 1)), g.ints(1, 3))
    fx, fy, cx, cy = (_intrinsic(g, row, column) for row, column in ((0, 0), (1, 1), (0, 2), (1, 2)))
    return View(R, t, fx, fy, cx, cy, width, height, footprint_px2)


def _intrinsic(g: Graph, row: int, column: int) -> str:
    """Return an element of the input K as [1]."""
    return g.op("Gather", g.op("Reshape", "K", g.ints(-1)), g.ints(row * 3 + column), axis=0)


def project(g: Graph, gaussians: Gaussians, view: View) -> Projected:
    """Project every Gaussian, as `render.project` does."""
    Rt = g.op("Transpose", view.R, perm=[1, 0])
    p = g.op("Add", g.op("MatMul", to_numpy(gaussians.means), Rt), view.t)  # [N, 3]
    px, py, pz = (g.op("Gather", p, np.array(i, dtype=np.int64), axis=1) for i in range(3))
    in_front = g.op("Greater", pz, Cameras.near_m)
    z = g.op("Where", in_front, pz, 1.0)
    x, y = g.op("Div", px, z), g.op("Div", py, z)
    mean_x = g.op("Add", g.op("Mul", view.fx, x), view.cx)
    mean_y = g.op("Add", g.op("Mul", view.fy, y), view.cy)
    x, y = _clamped(g, x, view.fx, view.cx, view.width), _clamped(g, y, view.fy, view.cy, view.height)
    # the rows of J W R S, [N, 3], where J = [[fx/z, 0, -fx x/z], [0, fy/z, -fy y/z]]
    axes = g.op("MatMul", view.R, to_numpy(gaussians.axes))  # [N, 3, 3]
    rows = [g.op("Gather", axes, np.array(i, dtype=np.int64), axis=1) for i in range(3)]
    M = []
    for f, tangent, row in ((view.fx, x, rows[0]), (view.fy, y, rows[1])):
        scale = g.op("Unsqueeze", g.op("Div", f, z), g.ints(1))
        slope = g.op("Unsqueeze", tangent, g.ints(1))
        M.append(g.op("Mul", scale, g.op("Sub", row, g.op("Mul", slope, rows[2]))))
    extents, splats = _ellipses(g, gaussians, M, in_front, mean_x, mean_y, view.footprint_px2)
    peak_lowered = lowers_peak(gaussians)
    return Projected(pz, [mean_x, mean_y], extents, splats, peak_lowered, depth_axes=rows[2])


def _clamped(g: Graph, tangent: str, focal: str, centre: str, size: int) -> str:
    """Clamp the tangent of a viewing angle to a little outside the field of view, as `render.project` does."""
    limit = g.op("Max", centre, g.op("Sub", float(size), centre))
    limit = g.op("Div", g.op("Mul", FOV_MARGIN, limit), focal)
    return g.op("Max", g.op("Min", tangent, limit), g.op("Neg", limit))


def _ellipses(
    g: Graph,
    gaussians: Gaussians,
    M: list[str],
    in_front: str,
    mean_x: str,
    mean_y: str,
    footprint_px2: float,
) -> tuple[list[str], str]:
    """Return `Projected.extents` and `Projected.splats` from the two rows [N, 3] of M; the covariance is M Mᵀ + fI."""
    last = g.ints(1)
    xx = g.op("Add", g.op("ReduceSum", g.op("Mul", M[0], M[0]), last, keepdims=0), footprint_px2)
    xy = g.op("ReduceSum", g.op("Mul", M[0], M[1]), last, keepdims=0)
    yy = g.op("Add", g.op("ReduceSum", g.op("Mul", M[1], M[1]), last, keepdims=0), footprint_px2)
    # its determinant as a sum of squares: xx·yy - xy² would cancel for long thin Gaussians
    squared_cross = g.op("ReduceSumSquare", cross_product(g, M[0], M[1], axis=1), last, keepdims=0)
    widened = g.op("Mul", g.op("Sub", g.op("Add", xx, yy), footprint_px2), footprint_px2)
    determinant = g.op("Add", squared_cross, widened)
    opacities = np.maximum(
        to_numpy(gaussians.opacities), np.float32(1e-12)
    )  # so that the logarithm is finite
    over_cutoff = np.maximum(opacities / np.float32(MIN_ALPHA), 1e-6)
    squared_radius = g.value(
        2 * np.log(over_cutoff).astype(np.float32)
    )  # in sigmas, where alpha is MIN_ALPHA
    drawn = g.op("And", in_front, g.value(opacities >= MIN_ALPHA))
    # a Gaussian too large for float32 is not drawn, as in `render`
    drawn = g.op("And", drawn, g.op("LessOrEqual", determinant, float(np.finfo(np.float32).max)))
    share = None
    if lowers_peak(gaussians):
        share = g.op("Sqrt", g.op("Div", squared_cross, determinant))
        drawn = g.op("And", drawn, g.op("GreaterOrEqual", share, MIN_PEAK_SHARE))
    squared_radius = g.op("Where", drawn, squared_radius, 0.0)
    nothing = g.op("Where", drawn, 0.0, NOT_REACHED_PX)
    extent_x = g.op("Sub", g.op("Sqrt", g.op("Mul", squared_radius, xx)), nothing)
    extent_y = g.op("Sub", g.op("Sqrt", g.op("Mul", squared_radius, yy)), nothing)
    # the root of the conic: (x, y)·conic·(x, y) = (a·x + b·y)² + (c·y)²
    a = g.op("Sqrt", g.op("Div", yy, determinant))
    b = g.op("Neg", g.op("Mul", a, g.op("Div", xy, yy)))
    c = g.op("Reciprocal", g.op("Sqrt", yy))
    columns = [mean_x, mean_y, a, b, g.op("Mul", c, 0.0), c, np.log(opacities)]
    columns += [] if share is None else [share]
    splats = g.op("Concat", *(g.op("Unsqueeze", column, last) for column in columns), axis=1)
    return [extent_x, extent_y], splats


def cross_product(g: Graph, a: str, b: str, axis: int = 0) -> str:
    """Return the cross product of vectors whose coordinates lie along `axis`."""
    after, before = np.array([1, 2, 0]), np.array([2, 0, 1])
    left, right = (
        g.op("Mul", g.op("Gather", a, i, axis=axis), g.op("Gather", b, j, axis=axis))
        for i, j in ((after, before), (before, after))
    )
    return g.op("Sub", left, right)
