"""The shadow map of `render.shadows` in an ONNX graph: how much of the Sun each Gaussian sees."""

import numpy as np
from onnx import TensorProto

from obbgs_core.io.onnx.composite import composite
from obbgs_core.io.onnx.graph import Graph, to_numpy
from obbgs_core.io.onnx.projection import View, cross_product, project
from obbgs_core.model.footprint import variance_px2
from obbgs_core.model.gaussians import Gaussians
from obbgs_core.render.shadows import (
    DARK_FROM,
    LIT_UNTIL,
    SHADOW_MAP_PX,
    SHADOW_MARGIN_PX,
    SHADOW_PSF_SIGMA_PX,
    SUN_DISTANCE,
    bounding_ball,
)

NO_SURFACE_M = 3e38  # stands for infinity, of which the interpolation would make NaN


def lit_shares(g: Graph, gaussians: Gaussians) -> str:
    """Return the visibility of the Sun from each Gaussian [N], as `render.shadows.lit_shares`."""
    view = _sun_view(g, gaussians)
    projected = project(g, gaussians, view)
    depth = g.op("Unsqueeze", projected.depth, g.ints(1))
    surface = composite(g, projected, depth, 1, view, median=True)  # [1, H, W]
    surface = g.op("Where", g.op("Greater", surface, 0.0), surface, NO_SURFACE_M)
    margin = SHADOW_MARGIN_PX
    pads = g.ints(0, margin, margin, 0, margin, margin)
    surface = g.op("Pad", surface, pads, np.array(NO_SURFACE_M, dtype=np.float32))
    surface = g.op("Reshape", surface, g.ints(-1))
    pixel = g.op("Div", g.op("Gather", g.op("Reshape", view.t, g.ints(-1)), g.ints(2), axis=0), view.fx)
    sigma = g.op("ReduceL2", projected.depth_axes, g.ints(1), keepdims=0)
    tolerance = g.op("Add", sigma, pixel)
    side = SHADOW_MAP_PX + 2 * margin
    u, v = (g.op("Clip", g.op("Add", centre, float(margin)), 1.5, side - 1.5) for centre in projected.centres)
    row_and_column = g.op("Add", g.op("Mul", g.op("Floor", v), float(side)), g.op("Floor", u))
    at = g.op("Cast", row_and_column, to=TensorProto.INT64)
    neighbours = np.array([[dv * side + du] for dv in (-1, 0, 1) for du in (-1, 0, 1)])
    index = g.op("Add", neighbours, g.op("Unsqueeze", at, g.ints(0)))
    around = g.op("Gather", surface, index, axis=0)  # [9, N]
    behind = g.op("Div", g.op("Sub", projected.depth, around), tolerance)
    lit = g.op("Div", g.op("Sub", DARK_FROM, behind), DARK_FROM - LIT_UNTIL)
    lit = g.op("Clip", lit, 0.0, 1.0)
    rows, columns = (_spline_weights(g, place, axis) for place, axis in ((v, 1), (u, 0)))
    weights = g.op("Reshape", g.op("Mul", rows, columns), g.ints(9, -1))
    return g.op("ReduceSum", g.op("Mul", lit, weights), g.ints(0), keepdims=0)


def _sun_view(g: Graph, gaussians: Gaussians) -> View:
    """Return the camera in the Sun's place, as `render.shadows.sun_camera`."""
    centre, radius = bounding_ball(gaussians)
    forward = g.op("Neg", g.op("Div", "sun_dir", g.op("ReduceL2", "sun_dir", g.ints(0))))
    off_x_axis = g.op("Less", g.op("Abs", g.op("Gather", forward, g.ints(0), axis=0)), 0.9)
    x_axis, y_axis = np.eye(3, dtype=np.float32)[:2]
    right = cross_product(g, g.op("Where", off_x_axis, x_axis, y_axis), forward)
    right = g.op("Div", right, g.op("ReduceL2", right, g.ints(0)))
    rows = [g.op("Unsqueeze", row, g.ints(0)) for row in (right, cross_product(g, forward, right), forward)]
    R = g.op("Concat", *rows, axis=0)
    place = g.op("Sub", to_numpy(centre), g.op("Mul", SUN_DISTANCE * radius, forward))
    t = g.op("Reshape", g.op("Neg", g.op("MatMul", R, place)), g.ints(1, 3))
    half_px = SHADOW_MAP_PX / 2
    focal, middle = (g.value(np.array([v], dtype=np.float32)) for v in (half_px * SUN_DISTANCE, half_px))
    footprint = float(variance_px2(gaussians, SHADOW_PSF_SIGMA_PX))
    return View(R, t, focal, focal, middle, middle, SHADOW_MAP_PX, SHADOW_MAP_PX, footprint)


def _spline_weights(g: Graph, place: str, axis: int) -> str:
    """Return the weights of the three pixels around places [N] px, as in `render.shadows`: [3, 1, N] or [1, 3, N]."""
    off = g.op("Sub", g.op("Sub", place, g.op("Floor", place)), 0.5)
    before, after = g.op("Sub", 0.5, off), g.op("Add", 0.5, off)
    sides = [g.op("Mul", 0.5, g.op("Mul", each, each)) for each in (before, after)]
    weights = [sides[0], g.op("Sub", 0.75, g.op("Mul", off, off)), sides[1]]
    stacked = g.op("Concat", *(g.op("Unsqueeze", each, g.ints(0)) for each in weights), axis=0)  # [3, N]
    return g.op("Unsqueeze", stacked, g.ints(axis))
