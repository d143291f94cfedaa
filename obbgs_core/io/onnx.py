"""The model as an ONNX renderer of standard operators: a view and an exposure time in, the expected image out.

The graph is the rasterizer of `render`, written for a runtime: project all Gaussians, sort them by depth once, and for
each 16x16 tile that any Gaussian reaches composite just the ones that reach it. No tile has a capacity, so nothing
overflows; memory grows with the fullest tile, about 4 kB a Gaussian in it.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper
from torch import Tensor

from obbgs_base.files import write_whole
from obbgs_core.errors import ExportError
from obbgs_core.model.gaussians import Gaussians
from obbgs_core.model.sh import C0, SOFTNESS
from obbgs_core.render import DILATION_PX2, FOV_MARGIN, MAX_ALPHA, MIN_ALPHA, MIN_TRANSMITTANCE
from obbgs_core.render.lighting import (
    DARK_FROM,
    LIT_UNTIL,
    SHADOW_MAP_PX,
    SUN_DISTANCE,
    shortest_axes,
    solid_ball,
)
from obbgs_core.sensor import Sensor

OPSET = 18
TILE = 16  # px: 8 costs more calls, 32 more pixels that a Gaussian does not reach
FORMAT_VERSION = "1"
MAX_PROTOBUF_BYTES = 2**31 - 1  # a protobuf message, and so an ONNX file, is no longer
NEAR_M = 0.01


@dataclass(frozen=True)
class Exported:
    path: Path
    size_bytes: int
    gaussians: int


def export_onnx(
    gaussians: Gaussians,
    sensor: Sensor,
    path: Path,
    width: int,
    height: int,
    exposures_s: Sequence[float],
) -> Exported:
    """Write the renderer; the file appears whole or not at all.

    Inputs: world_to_camera [4, 4], K [3, 3] px, exposure_time_s [] and, where the radiance turns with the Sun, sun_dir
    [3] (towards it, unit, body frame), all float32. Outputs: image [H, W, C], expected digital numbers over full scale,
    0..1; alpha [H, W]; depth [H, W] m (0 where nothing is). By Lambert's law the graph casts that Sun's shadows first.

    Args:
        exposures_s: the exposure times the model was trained on; their range goes into the metadata.

    Raises:
        ExportError: the model is empty, not finite or larger than an ONNX file can be, or there is no exposure time.
    """
    if len(gaussians) == 0:
        raise ExportError("there is no Gaussian to export")
    if not exposures_s or not all(math.isfinite(e) and e > 0 for e in exposures_s):
        raise ExportError(f"exposures_s must be positive times, got {list(exposures_s)}")
    for name, tensor in {**gaussians.tensors(), "scales": gaussians.scales}.items():
        if not tensor.isfinite().all():
            raise ExportError(f"{name} holds values that are not finite")
    graph = _Graph()
    camera = _camera_view(graph, width, height)
    projected = _project(graph, gaussians, camera)
    radiance = _radiance(graph, gaussians, camera)
    ones = np.ones((len(gaussians), 1), dtype=np.float32)
    depth = graph.op("Unsqueeze", projected.depth, graph.ints(1))
    features = graph.op("Concat", radiance, depth, ones, axis=1)
    composed = _composite(graph, projected, features, gaussians.sh.shape[2] + 2, camera)
    _finish(graph, composed, gaussians.sh.shape[2], sensor)
    size_bytes = sum(len(constant.raw_data) for constant in graph.constants)
    if size_bytes > MAX_PROTOBUF_BYTES:
        raise ExportError(
            f"{len(gaussians):,} Gaussians make an ONNX file of {size_bytes:,} bytes; the format ends at "
            f"{MAX_PROTOBUF_BYTES:,}: train with a smaller budget"
        )
    turns_with_sun = gaussians.shading != "view"
    model = helper.make_model(
        helper.make_graph(
            graph.nodes,
            "gaussian renderer",
            [
                helper.make_tensor_value_info("world_to_camera", TensorProto.FLOAT, [4, 4]),
                helper.make_tensor_value_info("K", TensorProto.FLOAT, [3, 3]),
                helper.make_tensor_value_info("exposure_time_s", TensorProto.FLOAT, []),
                *(
                    [helper.make_tensor_value_info("sun_dir", TensorProto.FLOAT, [3])]
                    if turns_with_sun
                    else []
                ),
            ],
            [
                helper.make_tensor_value_info(
                    "image", TensorProto.FLOAT, [height, width, gaussians.sh.shape[2]]
                ),
                helper.make_tensor_value_info("alpha", TensorProto.FLOAT, [height, width]),
                helper.make_tensor_value_info("depth", TensorProto.FLOAT, [height, width]),
            ],
            graph.constants,
        ),
        producer_name="obbgs",
        ir_version=9,
        opset_imports=[helper.make_opsetid("", OPSET)],
    )
    facts = {**vars(sensor), "width": width, "height": height, "gaussians": len(gaussians)}
    facts |= {
        "exposure_min_s": min(exposures_s),
        "exposure_max_s": max(exposures_s),
        "format": FORMAT_VERSION,
    }
    helper.set_model_props(model, {name: str(value) for name, value in facts.items()})
    onnx.checker.check_model(model, full_check=True)
    content = model.SerializeToString()
    write_whole(path, content)
    return Exported(path, len(content), len(gaussians))


class _Graph:
    """Collects nodes and constants; a value is its name, an operator a method call by its ONNX name."""

    def __init__(self, prefix: str = "v"):
        self.nodes: list[onnx.NodeProto] = []
        self.constants: list[onnx.TensorProto] = []
        self.prefix, self.count = prefix, 0
        self.known: dict[tuple[str, tuple[int, ...], bytes], str] = {}  # constants that are there already

    def op(
        self, kind: str, *inputs: "str | float | np.ndarray", outputs: int = 1, name: str = "", **attributes
    ) -> str:
        names = [self._name(i) for i in inputs]
        results = [name] if name else [self._fresh() for _ in range(outputs)]
        self.nodes.append(helper.make_node(kind, names, results, **attributes))
        return results[-1]  # of TopK: the indices

    def ints(self, *values: int) -> str:
        return self._name(np.array(values, dtype=np.int64))

    def _name(self, value: "str | float | np.ndarray") -> str:
        if isinstance(value, str):
            return value
        array = np.asarray(value, dtype=np.float32) if not isinstance(value, np.ndarray) else value
        key = (array.dtype.str, array.shape, array.tobytes())
        if key not in self.known:
            self.known[key] = self._fresh()
            self.constants.append(numpy_helper.from_array(array, self.known[key]))
        return self.known[key]

    def _fresh(self) -> str:
        self.count += 1
        return f"{self.prefix}{self.count}"

    def split(self, value: str, *widths: int) -> list[str]:
        """Return the columns of a matrix in blocks of the given widths."""
        results = [self._fresh() for _ in widths]
        self.nodes.append(helper.make_node("Split", [value, self.ints(*widths)], results, axis=1))
        return results

    def column(self, matrix: str, *index: int) -> str:
        """Return an element of a matrix as a scalar [1]."""
        flat = self.op("Reshape", matrix, self.ints(-1))
        width = 4 if matrix == "world_to_camera" else 3
        return self.op("Gather", flat, self.ints(index[0] * width + index[1]), axis=0)


def _numpy(tensor: Tensor) -> np.ndarray:
    return np.ascontiguousarray(tensor.detach().cpu().numpy(), dtype=np.float32)


@dataclass(frozen=True)
class _View:
    """Names of a pinhole camera's numbers, and its size."""

    R: str  # [3, 3]
    t: str  # [1, 3] m
    fx: str
    fy: str
    cx: str
    cy: str
    width: int
    height: int


def _camera_view(g: _Graph, width: int, height: int) -> _View:
    """The camera that the inputs describe."""
    pose = "world_to_camera"
    R = g.op("Slice", pose, g.ints(0, 0), g.ints(3, 3), g.ints(0, 1))
    t = g.op("Reshape", g.op("Slice", pose, g.ints(0, 3), g.ints(3, 4), g.ints(0, 1)), g.ints(1, 3))
    fx, fy, cx, cy = (g.column("K", *at) for at in ((0, 0), (1, 1), (0, 2), (1, 2)))
    return _View(R, t, fx, fy, cx, cy, width, height)


def _sun_view(g: _Graph, gaussians: Gaussians) -> _View:
    """The camera at the Sun, as `shading.sun_camera` places it."""
    centre, radius = solid_ball(gaussians)
    forward = g.op("Neg", g.op("Div", "sun_dir", g.op("ReduceL2", "sun_dir", g.ints(0))))
    upright = g.op("Less", g.op("Abs", g.op("Gather", forward, g.ints(0), axis=0)), 0.9)
    x_axis, y_axis = np.eye(3, dtype=np.float32)[:2]
    right = _cross(g, g.op("Where", upright, x_axis, y_axis), forward)
    right = g.op("Div", right, g.op("ReduceL2", right, g.ints(0)))
    rows = [g.op("Unsqueeze", row, g.ints(0)) for row in (right, _cross(g, forward, right), forward)]
    R = g.op("Concat", *rows, axis=0)
    place = g.op("Sub", _numpy(centre), g.op("Mul", SUN_DISTANCE * radius, forward))
    t = g.op("Reshape", g.op("Neg", g.op("MatMul", R, place)), g.ints(1, 3))
    half_px = SHADOW_MAP_PX / 2
    focal, middle = (g._name(np.array([v], dtype=np.float32)) for v in (half_px * SUN_DISTANCE, half_px))
    return _View(R, t, focal, focal, middle, middle, SHADOW_MAP_PX, SHADOW_MAP_PX)


def _cross(g: _Graph, a: str, b: str, axis: int = 0) -> str:
    after, before = np.array([1, 2, 0]), np.array([2, 0, 1])
    left, right = (
        g.op("Mul", g.op("Gather", a, i, axis=axis), g.op("Gather", b, j, axis=axis))
        for i, j in ((after, before), (before, after))
    )
    return g.op("Sub", left, right)


@dataclass(frozen=True)
class _Projected:
    """Names of what every Gaussian is on the image plane."""

    depth: str  # [N] m
    centres: list[str]  # x and y, [N] px
    reaches: list[str]  # half width and height of its box, [N] px; negative where it is not drawn
    splats: str  # [N, 7]: centre, square root of the conic (2 x 2), logarithm of the opacity
    toward: str  # [N, 3] m: what each axis, one sigma long, reaches in depth


def _project(g: _Graph, gaussians: Gaussians, view: _View) -> _Projected:
    """EWA projection of every Gaussian, as `render.project`."""
    Rt = g.op("Transpose", view.R, perm=[1, 0])
    p = g.op("Add", g.op("MatMul", _numpy(gaussians.means), Rt), view.t)  # [N, 3]
    px, py, pz = (g.op("Gather", p, np.array(i, dtype=np.int64), axis=1) for i in range(3))
    drawn = g.op("Greater", pz, NEAR_M)
    z = g.op("Where", drawn, pz, 1.0)
    fx, fy, cx, cy = view.fx, view.fy, view.cx, view.cy
    x, y = g.op("Div", px, z), g.op("Div", py, z)
    mean_x = g.op("Add", g.op("Mul", fx, x), cx)
    mean_y = g.op("Add", g.op("Mul", fy, y), cy)
    x, y = _clamped(g, x, fx, cx, view.width), _clamped(g, y, fy, cy, view.height)
    # rows of J W R S, [N, 3]: J = [[fx/z, 0, -fx x/z], [0, fy/z, -fy y/z]]
    turned = g.op("MatMul", view.R, _numpy(gaussians.axes))  # [N, 3, 3]
    rows = [g.op("Gather", turned, np.array(i, dtype=np.int64), axis=1) for i in range(3)]
    M = []
    for f, tangent, row in ((fx, x, rows[0]), (fy, y, rows[1])):
        scale = g.op("Unsqueeze", g.op("Div", f, z), g.ints(1))
        slope = g.op("Unsqueeze", tangent, g.ints(1))
        M.append(g.op("Mul", scale, g.op("Sub", row, g.op("Mul", slope, rows[2]))))
    last = g.ints(1)
    xx = g.op("Add", g.op("ReduceSum", g.op("Mul", M[0], M[0]), last, keepdims=0), DILATION_PX2)
    xy = g.op("ReduceSum", g.op("Mul", M[0], M[1]), last, keepdims=0)
    yy = g.op("Add", g.op("ReduceSum", g.op("Mul", M[1], M[1]), last, keepdims=0), DILATION_PX2)
    # det(M Mᵀ + dI) as a sum of squares: xx·yy - xy² would cancel for needles
    cross = g.op("ReduceSumSquare", _cross(g, M[0], M[1], axis=1), last, keepdims=0)
    dilated = g.op("Mul", g.op("Sub", g.op("Add", xx, yy), DILATION_PX2), DILATION_PX2)
    determinant = g.op("Add", cross, dilated)
    opacities = np.maximum(_numpy(gaussians.opacities), np.float32(1e-12))  # its logarithm is finite
    q = g._name(2 * np.log(np.maximum(opacities / np.float32(MIN_ALPHA), 1e-6)).astype(np.float32))
    drawn = g.op("And", drawn, g._name(opacities >= MIN_ALPHA))
    # a Gaussian too large for float32 is not drawn, as in `render`
    drawn = g.op("And", drawn, g.op("LessOrEqual", determinant, float(np.finfo(np.float32).max)))
    # an undrawn Gaussian reaches nothing: its box has negative size everywhere
    q_drawn = g.op("Where", drawn, q, 0.0)
    nothing = g.op("Where", drawn, 0.0, 1e9)
    reach_x = g.op("Sub", g.op("Sqrt", g.op("Mul", q_drawn, xx)), nothing)
    reach_y = g.op("Sub", g.op("Sqrt", g.op("Mul", q_drawn, yy)), nothing)
    # with these, (x, y)·conic·(x, y) = (steep·x + skew·y)² + (flat·y)²
    steep = g.op("Sqrt", g.op("Div", yy, determinant))
    skew = g.op("Neg", g.op("Mul", steep, g.op("Div", xy, yy)))
    flat = g.op("Reciprocal", g.op("Sqrt", yy))
    columns = (mean_x, mean_y, steep, skew, g.op("Mul", flat, 0.0), flat, np.log(opacities))
    return _Projected(
        depth=pz,
        centres=[mean_x, mean_y],
        reaches=[reach_x, reach_y],
        splats=g.op("Concat", *(g.op("Unsqueeze", column, last) for column in columns), axis=1),
        toward=rows[2],
    )


def _clamped(g: _Graph, tangent: str, focal: str, centre: str, size: int) -> str:
    """Clamp a tangent to a little outside the field of view, as `render.project` does."""
    limit = g.op("Max", centre, g.op("Sub", float(size), centre))
    limit = g.op("Div", g.op("Mul", FOV_MARGIN, limit), focal)
    return g.op("Max", g.op("Min", tangent, limit), g.op("Neg", limit))


def _radiance(g: _Graph, gaussians: Gaussians, camera: _View) -> str:
    """Radiance [N, C] towards the camera, as `shading.radiance_along`; a constant where it depends on nothing."""
    sh = _numpy(gaussians.sh)
    constant = (np.logaddexp(0, SOFTNESS * C0 * sh[:, 0]) / SOFTNESS).astype(np.float32)
    if gaussians.shading == "lambert":
        return g.op("Mul", constant, g.op("Unsqueeze", _light(g, gaussians, camera), g.ints(1)))
    if sh.shape[1] == 1:
        return g._name(constant)
    if gaussians.shading == "sun":
        direction = g.op("Reshape", "sun_dir", g.ints(1, 3))
    else:
        direction = _directions(g, gaussians, camera)
    basis = _sh_basis(g, direction, sh.shape[1])  # [N, K, 1], or [1, K, 1] under the Sun
    return _softplus(g, g.op("ReduceSum", g.op("Mul", basis, sh), g.ints(1), keepdims=0))


def _directions(g: _Graph, gaussians: Gaussians, camera: _View) -> str:
    """Unit vectors from the camera to each Gaussian [N, 3]."""
    centre = g.op("Neg", g.op("MatMul", camera.t, camera.R))  # [1, 3]
    direction = g.op("Sub", _numpy(gaussians.means), centre)
    length = g.op("Sqrt", g.op("ReduceSum", g.op("Mul", direction, direction), g.ints(1), keepdims=1))
    return g.op("Div", direction, g.op("Max", length, 1e-12))


def _softplus(g: _Graph, value: str) -> str:
    return g.op("Div", g.op("Softplus", g.op("Mul", value, SOFTNESS)), SOFTNESS)


def _light(g: _Graph, gaussians: Gaussians, camera: _View) -> str:
    """Light that arrives at each Gaussian [N], in units of the Sun's: Lambert's law, shadows, ambient light."""
    normals = _numpy(shortest_axes(gaussians))
    along = g.op("ReduceSum", g.op("Mul", _directions(g, gaussians, camera), normals), g.ints(1), keepdims=0)
    facing = g.op("Neg", g.op("Sign", along))
    cosine = g.op("Mul", g.op("MatMul", normals, "sun_dir"), facing)
    light = g.op("Mul", _softplus(g, cosine), _lit_shares(g, gaussians))
    return g.op("Add", light, float(gaussians.ambient))


def _lit_shares(g: _Graph, gaussians: Gaussians) -> str:
    """Share of the Sun that reaches each Gaussian [N], as `shading.lit_shares`."""
    view = _sun_view(g, gaussians)
    projected = _project(g, gaussians, view)
    depth = g.op("Unsqueeze", projected.depth, g.ints(1))
    surface = _composite(g, projected, depth, 1, view, median=True)  # [1, H, W]
    first = g.op("Where", g.op("Greater", surface, 0.0), surface, 3e38)
    first = g.op("Pad", first, g.ints(0, 2, 2, 0, 2, 2), np.array(3e38, dtype=np.float32))
    first = g.op("Reshape", first, g.ints(-1))
    pixel = g.op("Div", g.op("Gather", g.op("Reshape", view.t, g.ints(-1)), g.ints(2), axis=0), view.fx)
    deviation = g.op("ReduceL2", projected.toward, g.ints(1), keepdims=0)
    unit = g.op("Add", deviation, pixel)
    side = SHADOW_MAP_PX + 4
    u, v = (g.op("Clip", g.op("Add", centre, 2.0), 1.5, side - 1.5) for centre in projected.centres)
    row_and_column = g.op("Add", g.op("Mul", g.op("Floor", v), float(side)), g.op("Floor", u))
    at = g.op("Cast", row_and_column, to=TensorProto.INT64)
    around = np.array([[dv * side + du] for dv in (-1, 0, 1) for du in (-1, 0, 1)])
    near = g.op("Gather", first, g.op("Add", around, g.op("Unsqueeze", at, g.ints(0))), axis=0)  # [9, N]
    behind = g.op("Div", g.op("Sub", projected.depth, near), unit)
    lit = g.op("Div", g.op("Sub", DARK_FROM, behind), DARK_FROM - LIT_UNTIL)
    lit = g.op("Clip", lit, 0.0, 1.0)
    rows, columns = (_spline_weights(g, place, axis) for place, axis in ((v, 1), (u, 0)))
    weights = g.op("Reshape", g.op("Mul", rows, columns), g.ints(9, -1))
    return g.op("ReduceSum", g.op("Mul", lit, weights), g.ints(0), keepdims=0)


def _spline_weights(g: _Graph, place: str, axis: int) -> str:
    """Weights [3, 1, N] or [1, 3, N] of the pixel that holds a place [N] and its neighbours, as `shading` has them."""
    off = g.op("Sub", g.op("Sub", place, g.op("Floor", place)), 0.5)
    before, after = g.op("Sub", 0.5, off), g.op("Add", 0.5, off)
    sides = [g.op("Mul", 0.5, g.op("Mul", each, each)) for each in (before, after)]
    weights = [sides[0], g.op("Sub", 0.75, g.op("Mul", off, off)), sides[1]]
    stacked = g.op("Concat", *(g.op("Unsqueeze", each, g.ints(0)) for each in weights), axis=0)  # [3, N]
    return g.op("Unsqueeze", stacked, g.ints(axis))


# Real spherical harmonics as polynomials: for each one the terms (coefficient, powers of x, y, z), as in `sh.sh_basis`.
_C1, _C2, _C2Z, _C2X = 0.4886025119029199, 1.0925484305920792, 0.31539156525252005, 0.5462742152960396
_C3A, _C3B, _C3C, _C3D, _C3E = (
    0.5900435899266435,
    2.890611442640554,
    0.4570457994644658,
    0.3731763325901154,
    1.445305721320277,
)
SH_TERMS = [
    [(C0, 0, 0, 0)],
    [(-_C1, 0, 1, 0)],
    [(_C1, 0, 0, 1)],
    [(-_C1, 1, 0, 0)],
    [(_C2, 1, 1, 0)],
    [(-_C2, 0, 1, 1)],
    [(2 * _C2Z, 0, 0, 2), (-_C2Z, 2, 0, 0), (-_C2Z, 0, 2, 0)],
    [(-_C2, 1, 0, 1)],
    [(_C2X, 2, 0, 0), (-_C2X, 0, 2, 0)],
    [(-3 * _C3A, 2, 1, 0), (_C3A, 0, 3, 0)],
    [(_C3B, 1, 1, 1)],
    [(-4 * _C3C, 0, 1, 2), (_C3C, 2, 1, 0), (_C3C, 0, 3, 0)],
    [(2 * _C3D, 0, 0, 3), (-3 * _C3D, 2, 0, 1), (-3 * _C3D, 0, 2, 1)],
    [(-4 * _C3C, 1, 0, 2), (_C3C, 3, 0, 0), (_C3C, 1, 2, 0)],
    [(_C3E, 2, 0, 1), (-_C3E, 0, 2, 1)],
    [(-_C3A, 3, 0, 0), (3 * _C3A, 1, 2, 0)],
]


def _sh_basis(g: _Graph, direction: str, count: int) -> str:
    """Basis [N, count, 1]: all monomials up to degree 3 as one tensor, then one matrix of coefficients."""
    monomials = sorted(
        {powers for terms in SH_TERMS[:count] for _, *rest in terms for powers in [tuple(rest)]}
    )
    axes = [g.op("Gather", direction, g.ints(i), axis=1) for i in range(3)]  # [N, 1]
    columns = []
    for powers in monomials:
        column = g.op("Add", g.op("Mul", axes[0], 0.0), 1.0)
        for axis, power in zip(axes, powers, strict=True):
            for _ in range(power):
                column = g.op("Mul", column, axis)
        columns.append(column)
    matrix = np.zeros((len(monomials), count), dtype=np.float32)
    for k, terms in enumerate(SH_TERMS[:count]):
        for coefficient, *powers in terms:
            matrix[monomials.index(tuple(powers)), k] += coefficient
    basis = g.op("MatMul", g.op("Concat", *columns, axis=1), matrix)
    return g.op("Unsqueeze", basis, g.ints(2))


def _composite(
    g: _Graph, projected: _Projected, features: str, channels: int, view: _View, median: bool = False
) -> str:
    """Composite features [N, channels] in every tile that is reached; return the image [channels, H, W].

    With `median`, a pixel takes the features of the Gaussian that stops half of the light instead, 0 where none does.
    """
    width, height = view.width, view.height
    tiles_x, tiles_y = -(-width // TILE), -(-height // TILE)
    count = g.op("Shape", projected.depth)
    order = g.op("TopK", projected.depth, count, outputs=2, axis=0, largest=0, sorted=1)
    splats, features = (g.op("Gather", v, order, axis=0) for v in (projected.splats, features))
    reached = []
    for centre, reach, tiles in zip(projected.centres, projected.reaches, (tiles_x, tiles_y), strict=True):
        start = (np.arange(tiles, dtype=np.float32) * TILE)[:, None]  # [tiles, 1]
        mean, reach = (g.op("Gather", value, order, axis=0) for value in (centre, reach))
        begins = g.op("Less", g.op("Sub", mean, reach), start + TILE)
        reached.append(g.op("And", begins, g.op("Greater", g.op("Add", mean, reach), start)))  # [tiles, N]
    in_columns, in_rows = reached
    as_numbers = [g.op("Cast", mask, to=TensorProto.FLOAT) for mask in (in_rows, in_columns)]
    members = g.op(
        "MatMul", as_numbers[0], g.op("Transpose", as_numbers[1], perm=[1, 0])
    )  # [tiles_y, tiles_x]
    active = g.op("NonZero", g.op("Greater", members, 0.5))  # [2, A]
    # the first tile is always composited, so that the loop is never empty
    active = g.op("Concat", g._name(np.zeros((2, 1), dtype=np.int64)), active, axis=1)
    tile_y, tile_x = (g.op("Gather", active, np.array(i, dtype=np.int64), axis=0) for i in range(2))
    body = _tile_body(splats, features, in_rows, in_columns, channels, median)
    tiles = g.op("Scan", tile_y, tile_x, body=body, num_scan_inputs=2)  # [A, channels, TILE²]
    index = g.op("Unsqueeze", g.op("Add", g.op("Mul", tile_y, g.ints(tiles_x)), tile_x), g.ints(1))
    sky = np.zeros((tiles_y * tiles_x, channels, TILE * TILE), dtype=np.float32)
    image = g.op("ScatterND", sky, index, tiles)
    image = g.op("Reshape", image, g.ints(tiles_y, tiles_x, channels, TILE, TILE))
    image = g.op("Transpose", image, perm=[2, 0, 3, 1, 4])
    image = g.op("Reshape", image, g.ints(channels, tiles_y * TILE, tiles_x * TILE))
    return g.op("Slice", image, g.ints(0, 0), g.ints(height, width), g.ints(1, 2))


def _tile_body(
    splats: str, features: str, in_rows: str, in_columns: str, channels: int, median: bool
) -> onnx.GraphProto:
    """One tile: the Gaussians that reach it, already in depth order, composited front to back."""
    b = _Graph("tile_")
    in_row, in_column = (
        b.op("Gather", mask, tile, axis=0)
        for mask, tile in ((in_rows, "tile_row"), (in_columns, "tile_column"))
    )
    chosen = b.op("Squeeze", b.op("NonZero", b.op("And", in_row, in_column)), b.ints(0))  # [M]
    mean, root, log_opacity = b.split(b.op("Gather", splats, chosen, axis=0), 2, 4, 1)
    tile = b.op("Concat", *(b.op("Unsqueeze", n, b.ints(0)) for n in ("tile_column", "tile_row")), axis=0)
    middle = b.op("Add", b.op("Mul", b.op("Cast", tile, to=TensorProto.FLOAT), float(TILE)), TILE / 2)
    # two linear forms of each pixel, measured from the tile's middle; their squares add up to the exponent
    root = b.op("Reshape", root, b.ints(-1, 2, 2))
    towards = b.op("Unsqueeze", b.op("Sub", middle, mean), b.ints(1))  # [M, 1, 2]
    constant = b.op("ReduceSum", b.op("Mul", root, towards), b.ints(2), keepdims=1)
    pixel = np.arange(TILE * TILE, dtype=np.float32)
    x, y = pixel % TILE + np.float32(0.5 - TILE / 2), pixel // TILE + np.float32(0.5 - TILE / 2)
    pixels = np.stack([x, y, np.ones_like(x)]) * np.float32(math.sqrt(0.5))
    forms = b.op("Reshape", b.op("Concat", root, constant, axis=2), b.ints(-1, 6))
    squares = []
    for form in b.split(forms, 3, 3):
        value = b.op("MatMul", form, pixels)  # [M, TILE²]
        squares.append(b.op("Mul", value, value))
    log_alpha = b.op("Sub", b.op("Sub", log_opacity, squares[0]), squares[1])
    alpha = b.op("Exp", b.op("Min", log_alpha, math.log(MAX_ALPHA)))  # [M, TILE²]
    alpha = b.op("ThresholdedRelu", alpha, alpha=MIN_ALPHA)
    before = b.op("CumSum", b.op("Log", b.op("Sub", 1.0, alpha)), np.array(0, dtype=np.int64), exclusive=1)
    before = b.op("Exp", before)
    weight = b.op("Mul", alpha, before)
    after = b.op("Sub", before, weight)
    if median:
        crossing = b.op("And", b.op("Greater", before, 0.5), b.op("LessOrEqual", after, 0.5))
        weight = b.op("Cast", crossing, to=TensorProto.FLOAT)
    else:
        weight = b.op("Where", b.op("Less", after, MIN_TRANSMITTANCE), 0.0, weight)
    chosen_features = b.op("Transpose", b.op("Gather", features, chosen, axis=0), perm=[1, 0])
    b.op("MatMul", chosen_features, weight, name="tile_image")
    return helper.make_graph(
        b.nodes,
        "tile",
        [helper.make_tensor_value_info(n, TensorProto.INT64, []) for n in ("tile_row", "tile_column")],
        [helper.make_tensor_value_info("tile_image", TensorProto.FLOAT, [channels, TILE * TILE])],
        b.constants,
    )


def _finish(g: _Graph, composed: str, channels: int, sensor: Sensor) -> None:
    """Turn the composed image into the outputs."""
    parts = []
    for start, end in ((0, channels), (channels, channels + 1), (channels + 1, channels + 2)):
        parts.append(g.op("Slice", composed, g.ints(start), g.ints(end), g.ints(0)))
    radiance, depth_sum, alpha = parts
    radiance = g.op("Transpose", radiance, perm=[1, 2, 0])
    signal = g.op("Mul", radiance, g.op("Mul", "exposure_time_s", sensor.dn_per_radiance_s))
    g.op("Clip", g.op("Div", g.op("Add", signal, sensor.black_dn), sensor.white_dn), 0.0, 1.0, name="image")
    g.op("Squeeze", alpha, g.ints(0), name="alpha")
    depth = g.op("Div", depth_sum, g.op("Max", alpha, 1e-6))
    depth = g.op("Where", g.op("Greater", alpha, 1e-6), depth, 0.0)
    g.op("Squeeze", depth, g.ints(0), name="depth")
