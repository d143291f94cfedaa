"""The kernels of the device path, in Warp: which tiles each Gaussian touches, compositing over them, and its gradient.

Warp makes CUDA code of them, and code for this processor, on which the tests run them. A tile is a square of pixels
and, on a GPU, a block of threads, one a pixel. A splat is a Gaussian in one camera; splats are sorted by depth. At the
offset (dx, dy) px from its mean its alpha is opacity·exp(-(u² + v²) / 2), u = k1·dx + k2·dy and v = k3·dy, where k1,
k2 and k3 are `Projected.factors`. A pair is one splat in one tile.
"""

import warp as wp

from obbgs_core.render.reference import MAX_ALPHA, MIN_TRANSMITTANCE

TILE_PX = 16
LANES = TILE_PX * TILE_PX  # pixels of a tile
# numbers of a gradient: by the mean (2), the factors (3), the opacity and the features (4); then the pixels touched
GRADIENT = 11

wp.set_module_options({"enable_backward": False})  # the gradient is written out below

_TILE_PX = wp.constant(TILE_PX)
_LANES = wp.constant(LANES)
_MAX_ALPHA = wp.constant(wp.float32(MAX_ALPHA))
_MIN_TRANSMITTANCE = wp.constant(wp.float32(MIN_TRANSMITTANCE))
Gradient = wp.types.vector(length=GRADIENT, dtype=wp.float32)


@wp.struct
class Splats:
    """The splats of one camera in the order of their depths, S of them."""

    means2d: wp.array(dtype=wp.vec2)  # [S] px
    factors: wp.array(dtype=wp.vec3)  # [S] px⁻¹
    opacities: wp.array(dtype=wp.float32)  # [S]
    cutoffs: wp.array(dtype=wp.float32)  # [S] alphas below which nothing is drawn
    depths: wp.array(dtype=wp.float32)  # [S] m
    features: wp.array(dtype=wp.vec4)  # [S] of which a pixel composites the first ones
    across: wp.int32  # tiles in a row of tiles
    down: wp.int32


@wp.struct
class Reach:
    """How far an ellipse reaches at which a splat is cut off."""

    root: wp.float32  # of u² + v² there
    widest: wp.float32  # px along x from the mean
    tallest: wp.float32  # px along y
    turn: wp.float32  # its rightmost point lies at dy = -turn
    slack: wp.float32  # px, covers rounding
    first: wp.int32  # row of tiles
    last: wp.int32


@wp.func
def tile_of(place: wp.float32, count: wp.int32):
    """Return the tile [0, count) of a place in the picture, px; the nearest one of places outside."""
    return wp.int32(wp.clamp(wp.floor(place / wp.float32(_TILE_PX)), 0.0, wp.float32(count - 1)))


@wp.func
def reach_of(s: Splats, i: wp.int32):
    """Return how far a splat reaches; its rows are none where it is never above its cutoff or beside the picture."""
    reach = Reach()
    k = s.factors[i]
    y = s.means2d[i][1]
    reach.root = wp.sqrt(wp.max(2.0 * wp.log(s.opacities[i] / s.cutoffs[i]), 0.0))
    tilt = k[1] / k[2]
    stretch = wp.sqrt(1.0 + tilt * tilt)
    reach.widest = reach.root / k[0] * stretch
    reach.tallest = reach.root / k[2]
    reach.turn = tilt * reach.tallest / stretch
    reach.slack = 0.01 + 1e-6 * (wp.abs(s.means2d[i][0]) + wp.abs(y) + reach.widest + reach.tallest)
    half = reach.tallest + reach.slack
    height = wp.float32(s.down * _TILE_PX)
    reach.first = 0
    reach.last = -1
    if s.opacities[i] >= s.cutoffs[i] and y + half >= 0.0 and y - half <= height:
        reach.first = tile_of(y - half, s.down)
        reach.last = tile_of(y + half, s.down)
    return reach


@wp.func
def columns_of(s: Splats, i: wp.int32, reach: Reach, row: wp.int32):
    """Return the first and the last tile of a row of tiles in which a splat may be drawn; last < first: none."""
    k = s.factors[i]
    x = s.means2d[i][0]
    top = wp.float32(row * _TILE_PX) + 0.5 - s.means2d[i][1]  # its first pixel centre, from the mean
    low = wp.max(top, -reach.tallest - reach.slack)
    high = wp.min(top + wp.float32(_TILE_PX - 1), reach.tallest + reach.slack)
    if low > high:
        return wp.vec2i(0, -1)
    at_right = wp.clamp(-reach.turn, low, high)
    at_left = wp.clamp(reach.turn, low, high)
    q = reach.root * reach.root
    u_right = wp.sqrt(wp.max(q - at_right * k[2] * at_right * k[2], 0.0))
    u_left = wp.sqrt(wp.max(q - at_left * k[2] * at_left * k[2], 0.0))
    right = (u_right - at_right * k[1]) / k[0] + x + reach.slack
    left = (-u_left - at_left * k[1]) / k[0] + x - reach.slack
    if right < 0.0 or left > wp.float32(s.across * _TILE_PX):
        return wp.vec2i(0, -1)
    return wp.vec2i(tile_of(left, s.across), tile_of(right, s.across))


@wp.kernel
def count_tiles(s: Splats, counts: wp.array(dtype=wp.int32)):
    """Count the tiles [S] that each splat touches."""
    i = wp.tid()
    reach = reach_of(s, i)
    count = wp.int32(0)
    for row in range(reach.first, reach.last + 1):
        columns = columns_of(s, i, reach, row)
        count += wp.max(columns[1] - columns[0] + 1, 0)
    counts[i] = count


@wp.kernel
def list_tiles(
    s: Splats,
    ends: wp.array(dtype=wp.int32),
    tiles: wp.array(dtype=wp.int32),
    splats: wp.array(dtype=wp.int32),
):
    """Write each splat's pairs, their tile and their splat, up to `ends` [S]: the running sum of the counts."""
    i = wp.tid()
    at = wp.int32(0)
    if i > 0:
        at = ends[i - 1]
    reach = reach_of(s, i)
    for row in range(reach.first, reach.last + 1):
        columns = columns_of(s, i, reach, row)
        for column in range(columns[0], columns[1] + 1):
            tiles[at] = row * s.across + column
            splats[at] = i
            at += 1


@wp.func
def place_of(tile: wp.int32, lane: wp.int32, across: wp.int32):
    """Return the column and row of a tile's pixel."""
    x = (tile % across) * _TILE_PX + lane % _TILE_PX
    y = (tile // across) * _TILE_PX + lane // _TILE_PX
    return wp.vec2i(x, y)


@wp.func
def alpha_of(s: Splats, i: wp.int32, dx: wp.float32, dy: wp.float32):
    """Return u, v and the alpha of a splat, not yet cut off at either end, at an offset from its mean, px."""
    k = s.factors[i]
    u = k[0] * dx + k[1] * dy
    v = k[2] * dy
    return wp.vec3(u, v, s.opacities[i] * wp.exp(-0.5 * (u * u + v * v)))


@wp.kernel
def composite(
    s: Splats,
    begins: wp.array(dtype=wp.int32),
    pairs: wp.array(dtype=wp.int32),
    splats: wp.array(dtype=wp.int32),
    images: wp.array2d(dtype=wp.vec4),
    transmittances: wp.array2d(dtype=wp.float32),
    medians: wp.array2d(dtype=wp.float32),
    lasts: wp.array2d(dtype=wp.int32),
):
    """Composite the splats of each tile front to back, a thread a pixel.

    Args:
        begins: [tiles + 1] into `pairs`: which pairs each tile has, by depth; splats: [pairs] of each pair.
        images, transmittances, medians: [H, W] composited features, transmittance and median depth.
        lasts: [H, W] the place in `pairs` behind the last one that the pixel shows.
    """
    thread = wp.tid()
    tile = thread // _LANES
    place = place_of(tile, thread % _LANES, s.across)
    x = place[0]
    y = place[1]
    if x >= images.shape[1] or y >= images.shape[0]:
        return
    light = wp.vec4()
    T = wp.float32(1.0)
    median = wp.float32(0.0)
    last = begins[tile]
    for p in range(begins[tile], begins[tile + 1]):
        i = splats[pairs[p]]
        there = alpha_of(s, i, wp.float32(x) + 0.5 - s.means2d[i][0], wp.float32(y) + 0.5 - s.means2d[i][1])
        alpha = wp.min(there[2], _MAX_ALPHA)
        if alpha >= s.cutoffs[i]:
            after = T * (1.0 - alpha)
            if after < _MIN_TRANSMITTANCE:
                break
            light += alpha * T * s.features[i]
            if T > 0.5 and after <= 0.5:
                median = s.depths[i]
            T = after
            last = p + 1
    images[y, x] = light
    transmittances[y, x] = T
    medians[y, x] = median
    lasts[y, x] = last


@wp.kernel
def composite_backward(
    s: Splats,
    begins: wp.array(dtype=wp.int32),
    pairs: wp.array(dtype=wp.int32),
    splats: wp.array(dtype=wp.int32),
    lasts: wp.array2d(dtype=wp.int32),
    by_image: wp.array2d(dtype=wp.vec4),
    behind_all: wp.array2d(dtype=wp.float32),
    gradients: wp.array(dtype=Gradient),
):
    """Add up each pair's gradient over the pixels of its tile, front to back like compositing itself.

    The threads of a block add theirs up together, in one order, and the first of them writes the sum: the result is
    the same every time. Where a block is a single thread, each adds its own.

    Args:
        by_image: [H, W] gradient of the loss by the composited features.
        behind_all: [H, W] that gradient times the features, plus the gradient by the transmittance times this.
        gradients: [pairs] in the order in which they were listed; zero before.
    """
    thread = wp.tid()
    tile = thread // _LANES
    place = place_of(tile, thread % _LANES, s.across)
    x = place[0]
    y = place[1]
    behind = wp.float32(0.0)
    by_feature = wp.vec4()
    last = begins[tile]
    if x < lasts.shape[1] and y < lasts.shape[0]:
        behind = behind_all[y, x]
        by_feature = by_image[y, x]
        last = lasts[y, x]
    first_of_block = thread % wp.block_dim() == 0
    T = wp.float32(1.0)
    # the same for all threads of a block, which add up together
    end = wp.tile_max(wp.tile(last))[0]
    p = begins[tile]
    while p < end:
        pair = pairs[p]
        i = splats[pair]
        gradient = Gradient()
        if p < last:
            dx = wp.float32(x) + 0.5 - s.means2d[i][0]
            dy = wp.float32(y) + 0.5 - s.means2d[i][1]
            there = alpha_of(s, i, dx, dy)
            alpha = wp.min(there[2], _MAX_ALPHA)
            if alpha >= s.cutoffs[i]:
                weight = alpha * T
                share = weight * wp.dot(by_feature, s.features[i])
                behind -= share
                T = T * (1.0 - alpha)
                k = s.factors[i]
                for f in range(4):
                    gradient[6 + f] = weight * by_feature[f]
                gradient[10] = 1.0
                if there[2] < _MAX_ALPHA:  # where alpha is clamped, the shape has no gradient
                    slope = share - behind * weight / T  # by the logarithm of alpha
                    by_u = -slope * there[0]
                    by_v = -slope * there[1]
                    gradient[0] = -by_u * k[0]
                    gradient[1] = -by_u * k[1] - by_v * k[2]
                    gradient[2] = by_u * dx
                    gradient[3] = by_u * dy
                    gradient[4] = by_v * dy
                    gradient[5] = slope / s.opacities[i]
        of_block = wp.tile_sum(wp.tile(gradient, preserve_type=True))[0]
        if first_of_block:
            gradients[pair] = gradients[pair] + of_block
        p += 1


@wp.kernel
def add_up(
    ends: wp.array(dtype=wp.int32), gradients: wp.array(dtype=Gradient), of_splats: wp.array(dtype=Gradient)
):
    """Add up the gradients of each splat's pairs in their order; `ends` as in `list_tiles`."""
    i = wp.tid()
    begin = wp.int32(0)
    if i > 0:
        begin = ends[i - 1]
    total = Gradient()
    for p in range(begin, ends[i]):
        total += gradients[p]
    of_splats[i] = total
