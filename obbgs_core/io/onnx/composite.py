"""Front-to-back compositing in an ONNX graph, tile by tile: a Scan over the tiles that any Gaussian reaches."""

import math

import numpy as np
import onnx
from onnx import TensorProto, helper

from obbgs_core.io.onnx.graph import Graph
from obbgs_core.io.onnx.projection import Projected, View
from obbgs_core.render.reference import MAX_ALPHA, MIN_ALPHA, MIN_TRANSMITTANCE

# px: with 8 there are more calls, with 32 more pixels that a Gaussian does not reach; both are slower
TILE = 16


def composite(
    g: Graph, projected: Projected, features: str, channels: int, view: View, median: bool = False
) -> str:
    """Composite features [N, channels] and return the image [channels, H, W].

    With `median`, a pixel takes the features of the Gaussian where the transmittance falls to one half, 0 if none.
    """
    tiles_x, tiles_y = -(-view.width // TILE), -(-view.height // TILE)
    count = g.op("Shape", projected.depth)
    order = g.op("TopK", projected.depth, count, outputs=2, axis=0, largest=0, sorted=1)
    splats, features = (g.op("Gather", v, order, axis=0) for v in (projected.splats, features))
    in_columns, in_rows = (
        _tiles_reached(g, centre, extent, order, tiles)
        for centre, extent, tiles in zip(
            projected.centres, projected.extents, (tiles_x, tiles_y), strict=True
        )
    )
    as_numbers = [g.op("Cast", mask, to=TensorProto.FLOAT) for mask in (in_rows, in_columns)]
    # how many Gaussians reach each tile, [tiles_y, tiles_x]
    members = g.op("MatMul", as_numbers[0], g.op("Transpose", as_numbers[1], perm=[1, 0]))
    active = g.op("NonZero", g.op("Greater", members, 0.5))  # [2, A]
    # the first tile is always composited, so that the loop is never empty
    active = g.op("Concat", g.value(np.zeros((2, 1), dtype=np.int64)), active, axis=1)
    tile_y, tile_x = (g.op("Gather", active, np.array(i, dtype=np.int64), axis=0) for i in range(2))
    body = _tile_body(splats, features, in_rows, in_columns, channels, projected.peak_lowered, median)
    tiles = g.op("Scan", tile_y, tile_x, body=body, num_scan_inputs=2)  # [A, channels, TILE²]
    index = g.op("Unsqueeze", g.op("Add", g.op("Mul", tile_y, g.ints(tiles_x)), tile_x), g.ints(1))
    background = np.zeros((tiles_y * tiles_x, channels, TILE * TILE), dtype=np.float32)
    image = g.op("ScatterND", background, index, tiles)
    image = g.op("Reshape", image, g.ints(tiles_y, tiles_x, channels, TILE, TILE))
    image = g.op("Transpose", image, perm=[2, 0, 3, 1, 4])
    image = g.op("Reshape", image, g.ints(channels, tiles_y * TILE, tiles_x * TILE))
    return g.op("Slice", image, g.ints(0, 0), g.ints(view.height, view.width), g.ints(1, 2))


def _tiles_reached(g: Graph, centre: str, extent: str, order: str, tiles: int) -> str:
    """Return which tiles along one axis the boxes of the sorted Gaussians overlap: bool [tiles, N]."""
    start = (np.arange(tiles, dtype=np.float32) * TILE)[:, None]  # [tiles, 1] px
    centre, extent = (g.op("Gather", value, order, axis=0) for value in (centre, extent))
    begins = g.op("Less", g.op("Sub", centre, extent), start + TILE)
    return g.op("And", begins, g.op("Greater", g.op("Add", centre, extent), start))


def _tile_body(
    splats: str,
    features: str,
    in_rows: str,
    in_columns: str,
    channels: int,
    peak_lowered: bool,
    median: bool,
) -> onnx.GraphProto:
    """Return the loop's body: the Gaussians that reach one tile, sorted by depth, composited front to back."""
    b = Graph("tile_")
    in_row, in_column = (
        b.op("Gather", mask, tile, axis=0)
        for mask, tile in ((in_rows, "tile_row"), (in_columns, "tile_column"))
    )
    chosen = b.op("Squeeze", b.op("NonZero", b.op("And", in_row, in_column)), b.ints(0))  # [M]
    columns = b.split(b.op("Gather", splats, chosen, axis=0), 2, 4, 1, *([1] if peak_lowered else []))
    log_alpha = _log_alpha(b, *columns[:3])
    if not peak_lowered:
        log_alpha = b.op("Min", log_alpha, math.log(MAX_ALPHA))
    alpha = b.op("ThresholdedRelu", b.op("Exp", log_alpha), alpha=MIN_ALPHA)  # [M, TILE²]
    if peak_lowered:  # afterwards, because the cutoff is lowered with the peak
        alpha = b.op("Min", b.op("Mul", alpha, columns[3]), MAX_ALPHA)
    before = b.op("CumSum", b.op("Log", b.op("Sub", 1.0, alpha)), np.array(0, dtype=np.int64), exclusive=1)
    before = b.op("Exp", before)  # the transmittance in front of each Gaussian
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


def _log_alpha(b: Graph, mean: str, root: str, log_opacity: str) -> str:
    """Return the logarithm of alpha [M, TILE²], before its clamp, in the tile's pixels.

    Args:
        mean: [M, 2]; root: [M, 4] of the conic; log_opacity: [M, 1].
    """
    tile = b.op("Concat", *(b.op("Unsqueeze", n, b.ints(0)) for n in ("tile_column", "tile_row")), axis=0)
    middle = b.op("Add", b.op("Mul", b.op("Cast", tile, to=TensorProto.FLOAT), float(TILE)), TILE / 2)
    # two linear forms of the pixel's place, measured from the tile's middle; the exponent is the sum of their squares
    root = b.op("Reshape", root, b.ints(-1, 2, 2))
    offset = b.op("Unsqueeze", b.op("Sub", middle, mean), b.ints(1))  # [M, 1, 2]
    constant = b.op("ReduceSum", b.op("Mul", root, offset), b.ints(2), keepdims=1)
    pixel = np.arange(TILE * TILE, dtype=np.float32)
    x, y = pixel % TILE + np.float32(0.5 - TILE / 2), pixel // TILE + np.float32(0.5 - TILE / 2)
    pixels = np.stack([x, y, np.ones_like(x)]) * np.float32(math.sqrt(0.5))
    forms = b.op("Reshape", b.op("Concat", root, constant, axis=2), b.ints(-1, 6))
    squares = []
    for form in b.split(forms, 3, 3):
        value = b.op("MatMul", form, pixels)  # [M, TILE²]
        squares.append(b.op("Mul", value, value))
    return b.op("Sub", b.op("Sub", log_opacity, squares[0]), squares[1])
