"""The radiance of `render.lighting` in an ONNX graph."""

import numpy as np

from obbgs_core.io.onnx.graph import Graph, to_numpy
from obbgs_core.io.onnx.projection import View
from obbgs_core.io.onnx.shadow import lit_shares
from obbgs_core.model.gaussians import Gaussians
from obbgs_core.model.sh import (
    C0,
    C1,
    C2_XX_YY,
    C2_XY,
    C2_ZZ,
    C3_XYZ,
    C3_YXX,
    C3_YZZ,
    C3_ZXX,
    C3_ZZZ,
    SOFTNESS,
)
from obbgs_core.render.highlights import lobe_axes, shortest_axes

# The harmonics of `sh.sh_basis` as polynomials of the direction: terms (coefficient, powers of x, y and z).
SH_TERMS = [
    [(C0, 0, 0, 0)],
    [(-C1, 0, 1, 0)],
    [(C1, 0, 0, 1)],
    [(-C1, 1, 0, 0)],
    [(C2_XY, 1, 1, 0)],
    [(-C2_XY, 0, 1, 1)],
    [(2 * C2_ZZ, 0, 0, 2), (-C2_ZZ, 2, 0, 0), (-C2_ZZ, 0, 2, 0)],
    [(-C2_XY, 1, 0, 1)],
    [(C2_XX_YY, 2, 0, 0), (-C2_XX_YY, 0, 2, 0)],
    [(-3 * C3_YXX, 2, 1, 0), (C3_YXX, 0, 3, 0)],
    [(C3_XYZ, 1, 1, 1)],
    [(-4 * C3_YZZ, 0, 1, 2), (C3_YZZ, 2, 1, 0), (C3_YZZ, 0, 3, 0)],
    [(2 * C3_ZZZ, 0, 0, 3), (-3 * C3_ZZZ, 2, 0, 1), (-3 * C3_ZZZ, 0, 2, 1)],
    [(-4 * C3_YZZ, 1, 0, 2), (C3_YZZ, 3, 0, 0), (C3_YZZ, 1, 2, 0)],
    [(C3_ZXX, 2, 0, 1), (-C3_ZXX, 0, 2, 1)],
    [(-C3_YXX, 3, 0, 0), (3 * C3_YXX, 1, 2, 0)],
]


def radiance_towards(g: Graph, gaussians: Gaussians, camera: View) -> str:
    """Return the radiance [N, C] towards the camera, as `render.lighting.radiance_along`."""
    sunlit = lit_shares(g, gaussians) if gaussians.shading == "lambert" else None
    matt = _matt(g, gaussians, camera, sunlit)
    return g.op("Add", matt, _highlights(g, gaussians, camera, sunlit)) if gaussians.has_highlights else matt


def _highlights(g: Graph, gaussians: Gaussians, camera: View, sunlit: str | None) -> str:
    """Return the radiance [N, C] of the lobes, as `render.highlights.highlights_along`."""
    towards = g.op("Neg", _directions(g, gaussians, camera))
    axis = to_numpy(lobe_axes(gaussians))
    if gaussians.shading != "view":
        sun = g.op("Reshape", "sun_dir", g.ints(1, 3))
    else:
        sun = to_numpy(gaussians.static_sun[None]) if len(gaussians.static_sun) else None
    if sun is None:
        cosine = g.op("ReduceSum", g.op("Mul", towards, axis), g.ints(1), keepdims=1)
        cos2 = g.op("Mul", g.op("Add", cosine, 1.0), 0.5)
    else:
        half = _unit(g, g.op("Add", towards, sun))
        cosine = g.op("ReduceSum", g.op("Mul", half, axis), g.ints(1), keepdims=1)
        cos2 = g.op("Mul", cosine, cosine)
    alpha2 = float(gaussians.gloss[0].exp() ** 2)
    below = g.op("Max", g.op("Sub", 1.0, g.op("Mul", cos2, 1 - alpha2)), 1e-12)
    root = g.op("Div", alpha2, below)
    peak = to_numpy(gaussians.lobes[:, -1:].exp() * gaussians.gloss[1:].exp())
    light = g.op("Mul", g.op("Mul", root, root), peak)
    return light if sunlit is None else g.op("Mul", light, g.op("Unsqueeze", sunlit, g.ints(1)))


def _matt(g: Graph, gaussians: Gaussians, camera: View, sunlit: str | None) -> str:
    """Return the radiance [N, C] towards the camera without highlights."""
    harmonics = _harmonics(g, gaussians, camera)
    if sunlit is None:
        return harmonics
    return g.op("Mul", harmonics, g.op("Unsqueeze", _light(g, gaussians, camera, sunlit), g.ints(1)))


def _harmonics(g: Graph, gaussians: Gaussians, camera: View) -> str:
    """Return what the harmonics say [N, C]: radiance, or under Lambert's law the albedo."""
    sh = to_numpy(gaussians.sh)
    if sh.shape[1] == 1:
        return g.value((np.logaddexp(0, SOFTNESS * C0 * sh[:, 0]) / SOFTNESS).astype(np.float32))
    if gaussians.shading != "view":
        direction = g.op("Reshape", "sun_dir", g.ints(1, 3))
    else:
        direction = _directions(g, gaussians, camera)
    basis = _sh_basis(g, direction, sh.shape[1])  # [N, K, 1], or [1, K, 1] for the Sun's direction
    return _softplus(g, g.op("ReduceSum", g.op("Mul", basis, sh), g.ints(1), keepdims=0))


def _directions(g: Graph, gaussians: Gaussians, camera: View) -> str:
    """Return unit vectors from the camera to each Gaussian [N, 3]."""
    centre = g.op("Neg", g.op("MatMul", camera.t, camera.R))  # [1, 3]
    return _unit(g, g.op("Sub", to_numpy(gaussians.means), centre))


def _unit(g: Graph, vectors: str) -> str:
    """Return vectors [N, 3] over their lengths."""
    length = g.op("Sqrt", g.op("ReduceSum", g.op("Mul", vectors, vectors), g.ints(1), keepdims=1))
    return g.op("Div", vectors, g.op("Max", length, 1e-12))


def _light(g: Graph, gaussians: Gaussians, camera: View, sunlit: str) -> str:
    """Return the irradiance of each Gaussian [N] over that of a surface that faces the Sun, ambient light included."""
    normals = to_numpy(shortest_axes(gaussians))
    along = g.op("ReduceSum", g.op("Mul", _directions(g, gaussians, camera), normals), g.ints(1), keepdims=0)
    facing = g.op("Neg", g.op("Sign", along))
    cosine = g.op("Mul", g.op("MatMul", normals, "sun_dir"), facing)
    light = g.op("Mul", _softplus(g, cosine), sunlit)
    return g.op("Add", light, float(gaussians.ambient))


def _softplus(g: Graph, value: str) -> str:
    return g.op("Div", g.op("Softplus", g.op("Mul", value, SOFTNESS)), SOFTNESS)


def _sh_basis(g: Graph, direction: str, count: int) -> str:
    """Return the first `count` harmonics [N, count, 1] at directions [N, 3]: all monomials times a matrix."""
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
