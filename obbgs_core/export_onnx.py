"""The model as an ONNX renderer of standard operators: a view and an exposure time in, the expected image out.

The graph is the rasterizer of `render`, written for a runtime: project all Gaussians, sort by depth, and for each 8x8
tile that any Gaussian reaches composite just the ones that reach it. No tile has a capacity, so nothing overflows.
"""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper
from torch import Tensor

from obbgs_core.errors import ExportError
from obbgs_core.gaussians import Gaussians
from obbgs_core.render import DILATION_PX2, FOV_MARGIN, MAX_ALPHA, MIN_ALPHA, MIN_TRANSMITTANCE
from obbgs_core.rotations import quats_to_matrices
from obbgs_core.sensor import Sensor
from obbgs_core.sh import C0, SOFTNESS

OPSET = 18
TILE = 8  # px
FORMAT_VERSION = "1"
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

    Inputs: world_to_camera [4, 4], K [3, 3] px, exposure_time_s [], all float32. Outputs: image [H, W, C], expected
    digital numbers over full scale, 0..1; alpha [H, W]; depth [H, W] m (0 where nothing is).

    Args:
        exposures_s: the exposure times the model was trained on; their range goes into the metadata.

    Raises:
        ExportError: the model is empty or not finite.
    """
    if len(gaussians) == 0:
        raise ExportError("there is no Gaussian to export")
    for name, tensor in gaussians.tensors().items():
        if not tensor.isfinite().all():
            raise ExportError(f"{name} holds values that are not finite")
    graph = _Graph()
    projected = _project(graph, gaussians, width, height)
    composed = _composite(graph, projected, gaussians.sh.shape[2], width, height)
    _finish(graph, composed, gaussians.sh.shape[2], sensor)
    model = helper.make_model(
        helper.make_graph(
            graph.nodes,
            "gaussian renderer",
            [
                helper.make_tensor_value_info("world_to_camera", TensorProto.FLOAT, [4, 4]),
                helper.make_tensor_value_info("K", TensorProto.FLOAT, [3, 3]),
                helper.make_tensor_value_info("exposure_time_s", TensorProto.FLOAT, []),
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
    part = path.with_name(path.name + ".part")
    with open(part, "wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
    os.replace(part, path)
    return Exported(path, len(content), len(gaussians))


class _Graph:
    """Collects nodes and constants; a value is its name, an operator a method call by its ONNX name."""

    def __init__(self, prefix: str = "v"):
        self.nodes: list[onnx.NodeProto] = []
        self.constants: list[onnx.TensorProto] = []
        self.prefix, self.count = prefix, 0

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
        name = self._fresh()
        self.constants.append(numpy_helper.from_array(array, name))
        return name

    def _fresh(self) -> str:
        self.count += 1
        return f"{self.prefix}{self.count}"

    def column(self, matrix: str, *index: int) -> str:
        """Return an element of a matrix as a scalar [1]."""
        flat = self.op("Reshape", matrix, self.ints(-1))
        width = 4 if matrix == "world_to_camera" else 3
        return self.op("Gather", flat, self.ints(index[0] * width + index[1]), axis=0)


def _numpy(tensor: Tensor) -> np.ndarray:
    return np.ascontiguousarray(tensor.detach().cpu().numpy(), dtype=np.float32)


def _project(g: _Graph, gaussians: Gaussians, width: int, height: int) -> dict[str, str]:
    """EWA projection of every Gaussian: names of [N] vectors, and the features [N, C + 1]."""
    RS = quats_to_matrices(gaussians.quats) * gaussians.scales[:, None, :]
    means = g._name(_numpy(gaussians.means))
    pose = "world_to_camera"
    R = g.op("Slice", pose, g.ints(0, 0), g.ints(3, 3), g.ints(0, 1))
    t = g.op("Reshape", g.op("Slice", pose, g.ints(0, 3), g.ints(3, 4), g.ints(0, 1)), g.ints(1, 3))
    Rt = g.op("Transpose", R, perm=[1, 0])
    p = g.op("Add", g.op("MatMul", means, Rt), t)  # [N, 3]
    px, py, pz = (g.op("Gather", p, np.array(i, dtype=np.int64), axis=1) for i in range(3))
    drawn = g.op("Greater", pz, NEAR_M)
    z = g.op("Where", drawn, pz, 1.0)
    fx, fy, cx, cy = g.column("K", 0, 0), g.column("K", 1, 1), g.column("K", 0, 2), g.column("K", 1, 2)
    x, y = g.op("Div", px, z), g.op("Div", py, z)
    mean_x = g.op("Add", g.op("Mul", fx, x), cx)
    mean_y = g.op("Add", g.op("Mul", fy, y), cy)
    x, y = _clamped(g, x, fx, cx, width), _clamped(g, y, fy, cy, height)
    # rows of J W R S, [N, 3]: J = [[fx/z, 0, -fx x/z], [0, fy/z, -fy y/z]]
    turned = g.op("MatMul", R, g._name(_numpy(RS)))  # [N, 3, 3]
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
    determinant = g.op("Sub", g.op("Mul", xx, yy), g.op("Mul", xy, xy))
    opacities = _numpy(gaussians.opacities)
    q = g._name(2 * np.log(np.maximum(opacities / np.float32(MIN_ALPHA), 1e-6)).astype(np.float32))
    drawn = g.op("And", drawn, g._name(opacities >= MIN_ALPHA))
    # an undrawn Gaussian reaches nothing: its box has negative size everywhere
    q_drawn = g.op("Where", drawn, q, 0.0)
    nothing = g.op("Where", drawn, 0.0, 1e9)
    reach_x = g.op("Sub", g.op("Sqrt", g.op("Mul", q_drawn, xx)), nothing)
    reach_y = g.op("Sub", g.op("Sqrt", g.op("Mul", q_drawn, yy)), nothing)
    return {
        "mean_x": mean_x,
        "mean_y": mean_y,
        "a": g.op("Div", yy, determinant),
        "b": g.op("Neg", g.op("Div", xy, determinant)),
        "c": g.op("Div", xx, determinant),
        "opacity": g._name(opacities),
        "reach_x": reach_x,
        "reach_y": reach_y,
        "depth": pz,
        "radiance": _radiance(g, gaussians, means, R, t),
    }


def _clamped(g: _Graph, tangent: str, focal: str, centre: str, size: int) -> str:
    """Clamp a tangent to a little outside the field of view, as `render.project` does."""
    limit = g.op("Max", centre, g.op("Sub", float(size), centre))
    limit = g.op("Div", g.op("Mul", FOV_MARGIN, limit), focal)
    return g.op("Max", g.op("Min", tangent, limit), g.op("Neg", limit))


def _radiance(g: _Graph, gaussians: Gaussians, means: str, R: str, t: str) -> str:
    """Radiance [N, C] seen from the camera; a constant when the model does not depend on direction."""
    sh = _numpy(gaussians.sh)
    if sh.shape[1] == 1:
        value = np.logaddexp(0, SOFTNESS * C0 * sh[:, 0]) / SOFTNESS
        return g._name(value.astype(np.float32))
    centre = g.op("Neg", g.op("MatMul", t, R))  # [1, 3]
    direction = g.op("Sub", means, centre)
    length = g.op("Sqrt", g.op("ReduceSum", g.op("Mul", direction, direction), g.ints(1), keepdims=1))
    direction = g.op("Div", direction, g.op("Max", length, 1e-12))
    basis = _sh_basis(g, direction, sh.shape[1])  # [N, K, 1]
    value = g.op("ReduceSum", g.op("Mul", basis, sh), g.ints(1), keepdims=0)
    return g.op("Div", g.op("Softplus", g.op("Mul", value, SOFTNESS)), SOFTNESS)


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


def _composite(g: _Graph, projected: dict[str, str], channels: int, width: int, height: int) -> str:
    """Composite every tile that is reached; return the image [H, W, C + 2]: radiance, depth sum, alpha."""
    tiles_x, tiles_y = -(-width // TILE), -(-height // TILE)
    count = g.op("Shape", projected["depth"])
    order = g.op("TopK", projected["depth"], count, outputs=2, axis=0, largest=0, sorted=1)
    names = ("mean_x", "mean_y", "a", "b", "c", "opacity", "reach_x", "reach_y", "depth")
    s = {name: g.op("Gather", projected[name], order, axis=0) for name in names}
    features = g.op(
        "Concat",
        g.op("Gather", projected["radiance"], order, axis=0),
        g.op("Unsqueeze", s["depth"], g.ints(1)),
        axis=1,
    )
    rows = [g.op("Unsqueeze", s[name], g.ints(0)) for name in ("mean_x", "mean_y", "a", "b", "c", "opacity")]
    splats = g.op("Concat", *rows, axis=0)  # [6, N]
    reached = []
    for mean, reach, tiles in ((s["mean_x"], s["reach_x"], tiles_x), (s["mean_y"], s["reach_y"], tiles_y)):
        start = (np.arange(tiles, dtype=np.float32) * TILE)[:, None]  # [tiles, 1]
        low = g.op("Sub", mean, reach)
        high = g.op("Add", mean, reach)
        reached.append(
            g.op("And", g.op("Less", low, start + TILE), g.op("Greater", high, start))
        )  # [tiles, N]
    in_columns, in_rows = reached
    as_numbers = [g.op("Cast", mask, to=TensorProto.FLOAT) for mask in (in_rows, in_columns)]
    members = g.op(
        "MatMul", as_numbers[0], g.op("Transpose", as_numbers[1], perm=[1, 0])
    )  # [tiles_y, tiles_x]
    active = g.op("NonZero", g.op("Cast", g.op("Greater", members, 0.5), to=TensorProto.INT64))  # [2, A]
    # the first tile is always composited, so that the loop is never empty
    active = g.op("Concat", g._name(np.zeros((2, 1), dtype=np.int64)), active, axis=1)
    tile_y, tile_x = (g.op("Gather", active, np.array(i, dtype=np.int64), axis=0) for i in range(2))
    body = _tile_body(splats, features, in_rows, in_columns, channels)
    tiles = g.op("Scan", tile_y, tile_x, body=body, num_scan_inputs=2)  # [A, TILE², C + 2]
    index = g.op("Unsqueeze", g.op("Add", g.op("Mul", tile_y, g.ints(tiles_x)), tile_x), g.ints(1))
    sky = np.zeros((tiles_y * tiles_x, TILE * TILE, channels + 2), dtype=np.float32)
    image = g.op("ScatterND", sky, index, tiles)
    image = g.op("Reshape", image, g.ints(tiles_y, tiles_x, TILE, TILE, channels + 2))
    image = g.op("Transpose", image, perm=[0, 2, 1, 3, 4])
    image = g.op("Reshape", image, g.ints(tiles_y * TILE, tiles_x * TILE, channels + 2))
    return g.op("Slice", image, g.ints(0, 0), g.ints(height, width), g.ints(0, 1))


def _tile_body(splats: str, features: str, in_rows: str, in_columns: str, channels: int) -> onnx.GraphProto:
    """One tile: the Gaussians that reach it, already in depth order, composited front to back."""
    b = _Graph("tile_")
    both = b.op(
        "And", b.op("Gather", in_rows, "tile_row", axis=0), b.op("Gather", in_columns, "tile_column", axis=0)
    )
    chosen = b.op("Squeeze", b.op("NonZero", b.op("Cast", both, to=TensorProto.INT64)), b.ints(0))  # [M]
    local = b.op("Gather", splats, chosen, axis=1)  # [6, M]
    x, y, a, bb, c, opacity = (b.op("Gather", local, np.array(i, dtype=np.int64), axis=0) for i in range(6))
    pixel = np.arange(TILE * TILE, dtype=np.float32)[:, None]
    corner_x = b.op("Mul", b.op("Cast", "tile_column", to=TensorProto.FLOAT), float(TILE))
    corner_y = b.op("Mul", b.op("Cast", "tile_row", to=TensorProto.FLOAT), float(TILE))
    dx = b.op("Sub", b.op("Add", pixel % TILE + np.float32(0.5), corner_x), x)  # [TILE², M]
    dy = b.op("Sub", b.op("Add", pixel // TILE + np.float32(0.5), corner_y), y)
    along_x = b.op("Mul", dx, b.op("Add", b.op("Mul", a, dx), b.op("Mul", b.op("Mul", bb, 2.0), dy)))
    power = b.op("Mul", b.op("Add", along_x, b.op("Mul", c, b.op("Mul", dy, dy))), -0.5)
    alpha = b.op("Min", b.op("Mul", opacity, b.op("Exp", b.op("Min", power, 0.0))), MAX_ALPHA)
    alpha = b.op("Where", b.op("Less", alpha, MIN_ALPHA), 0.0, alpha)
    passed = b.op("Log", b.op("Sub", 1.0, alpha))
    after = b.op("CumSum", passed, np.array(1, dtype=np.int64))
    before = b.op("Sub", after, passed)
    alpha = b.op("Where", b.op("Less", after, float(np.log(MIN_TRANSMITTANCE))), 0.0, alpha)
    weight = b.op("Mul", alpha, b.op("Exp", before))
    colour = b.op("MatMul", weight, b.op("Gather", features, chosen, axis=0))
    coverage = b.op("ReduceSum", weight, b.ints(1), keepdims=1)
    b.op("Concat", colour, coverage, axis=1, name="tile_image")
    return helper.make_graph(
        b.nodes,
        "tile",
        [helper.make_tensor_value_info(n, TensorProto.INT64, []) for n in ("tile_row", "tile_column")],
        [helper.make_tensor_value_info("tile_image", TensorProto.FLOAT, [TILE * TILE, channels + 2])],
        b.constants,
    )


def _finish(g: _Graph, composed: str, channels: int, sensor: Sensor) -> None:
    """Turn the composed image into the outputs."""
    parts = []
    for start, end in ((0, channels), (channels, channels + 1), (channels + 1, channels + 2)):
        parts.append(g.op("Slice", composed, g.ints(start), g.ints(end), g.ints(2)))
    radiance, depth_sum, alpha = parts
    signal = g.op("Mul", radiance, g.op("Mul", "exposure_time_s", sensor.dn_per_radiance_s))
    g.op("Clip", g.op("Div", g.op("Add", signal, sensor.black_dn), sensor.white_dn), 0.0, 1.0, name="image")
    g.op("Squeeze", alpha, g.ints(2), name="alpha")
    depth = g.op("Div", depth_sum, g.op("Max", alpha, 1e-6))
    depth = g.op("Where", g.op("Greater", alpha, 1e-6), depth, 0.0)
    g.op("Squeeze", depth, g.ints(2), name="depth")
