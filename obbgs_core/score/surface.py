"""Points with normals on the surface that the cameras see, fused from depth maps of the model."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from scipy.spatial import KDTree
from torch import Tensor

from obbgs_core.model.cameras import Cameras
from obbgs_core.model.gaussians import Gaussians
from obbgs_core.model.rotations import quats_to_matrices
from obbgs_core.render import project, render
from obbgs_core.render.lighting import constant_radiance, mean_radiance

MIN_RADIANCE = 3e-4  # of the bright surface's; of a fainter one no image shows anything
BRIGHT_QUANTILE = 0.97
MAX_TANGENT = 4.0  # of the angle between the line of sight and a Gaussian's normal: 76 degrees
MAX_DEPTH_TANGENT = 24.0  # the same of the depth map itself; steeper is an edge
SAME_DEPTH_PX = 2.0  # depths agree if they differ by no more than this many pixels' width
AGREEING_VIEWS = 2  # that must confirm a point, besides its own
# of each Gaussian, in pixels that are not solid: what covers three tenths of one counts, a strut thinner than a pixel
THIN_COPIES = 2
NORMAL_NEIGHBOURS = 64  # fewer follow the noise of the depth maps, more round off the edges
CANDIDATES = 900_000  # pixels of all views together that are compared with every view
OVERSAMPLING = 4  # points before they are thinned out, at least, for each that is returned
# share of the views on whose images a point lies, in whose planes it must be: of the points of fewer views, most lay
# more than .01 off (experiment 106)
PLANAR_VIEWS = 0.1
# pixels' width before or behind what a lit view sees, within which a dark face is taken for the same surface
LIT_WITHIN_PX = 4.0
# of the mean light, which a view's planes have as weight where it shows none
LEAST_LIGHT = 0.003
FINEST_CELL = 1e-5  # of the surface's extent
BISECTIONS = 18  # of the logarithm of the cell size


@torch.no_grad()
def surface_points(
    gaussians: Gaussians, cameras: Cameras, count: int = 100_000, seed: int = 0
) -> tuple[Tensor, Tensor]:
    """Return points [P, 3] m and unit normals [P, 3] towards the cameras, evenly spread over the seen surface.

    A pixel of a depth map is used if it is solid, or covered by three tenths by something thin, if it is on no depth
    edge and not seen at a grazing angle, if two other views see a surface at its depth, and if no more views see
    through it than see it. Each gives points at random places on its patch of plane; of those, one is kept in every
    cell of a cubic grid that is as fine as the count allows. They then move towards where views with more light see
    the surface, and those that lie in the planes of less than a tenth of the views are left out (`_where_lit`). The
    same seed gives the same points. Both are empty, [0, 3], if no pixel is left.

    Args:
        gaussians: on the CPU, as the cameras.
        cameras: the training cameras, or any others; one for each bracket is enough, since its frames see the same.
        count: of points, at most.

    Raises:
        ValueError: no camera, or a count under 1; the radiance depends on the Sun's direction, and the cameras do not
            hold it.
    """
    gaussians = bright(gaussians, cameras)
    if len(gaussians) == 0:
        return torch.zeros(0, 3), torch.zeros(0, 3)
    return fused_points(lambda c: _seen(gaussians, cameras.one(c)), cameras, count, seed)


@torch.no_grad()
def surface_positions(gaussians: Gaussians, cameras: Cameras, count: int = 100_000, seed: int = 0) -> Tensor:
    """Return the points [P, 3] of `surface_points` without their normals, which take most of its time.

    Raises:
        ValueError: as there.
    """
    gaussians = bright(gaussians, cameras)
    if len(gaussians) == 0:
        return torch.zeros(0, 3)
    return _fused(lambda c: _seen(gaussians, cameras.one(c)), cameras, count, seed)[0]


def _seen(gaussians: Gaussians, camera: Cameras) -> tuple[Tensor, Tensor, Tensor]:
    """Return the depth map of one camera, its slopes, and how far the light [H, W] is from that of the background."""
    light = render(gaussians, camera).radiance[0].mean(dim=-1) - camera.background
    return *with_thin_parts(gaussians, camera), light.abs()


@torch.no_grad()
def fused_points(
    seen: Callable[[int], tuple[Tensor, Tensor, Tensor]], cameras: Cameras, count: int, seed: int = 0
) -> tuple[Tensor, Tensor]:
    """Return points and normals as `surface_points` does, of whatever gives the depths of each camera.

    Args:
        seen: from the index of a camera to depths [H, W] m, infinite where nothing solid is seen, their slopes
            [H, W, 2] m/px, and the light [H, W] in any unit, 0 where a pixel is as the background is.

    Raises:
        ValueError: no camera, or a count under 1.
    """
    points, seen_by = _fused(seen, cameras, count, seed)
    if len(points) == 0:
        return points, torch.zeros(0, 3)
    return points, _fitted_normals(points, cameras.centres[seen_by] - points)


def _fused(
    seen: Callable[[int], tuple[Tensor, Tensor, Tensor]], cameras: Cameras, count: int, seed: int
) -> tuple[Tensor, Tensor]:
    """Return points [P, 3] on the seen surface, at most `count`, and the index [P] of the camera that sees each."""
    if len(cameras) == 0 or count < 1:
        raise ValueError(f"expected a camera and a count of at least 1, got {len(cameras)} and {count}")
    generator = torch.Generator().manual_seed(seed)
    views, patches = [], []
    for c in range(len(cameras)):
        depth, slope, light = seen(c)
        low_m, high_m = _neighbourhood(depth)
        pixels = _candidates(
            depth, slope, low_m, high_m, cameras.K[c], -(-CANDIDATES // len(cameras)), generator
        )
        tangents = slope * cameras.K[c].diagonal()[:2] / depth[:, :, None]
        views.append(_View(low_m, high_m, depth, tangents.half(), light.half()))
        patches.append(torch.cat([torch.full((len(pixels), 1), float(c)), pixels], dim=1))
    patch = torch.cat(patches)  # [P, 6]: camera, u, v, depth, slopes
    patch = patch[_confirmed(_back_project(patch, cameras), views, cameras)]
    if len(patch) == 0:
        return torch.zeros(0, 3), torch.zeros(0, dtype=torch.long)
    patch = patch.repeat(math.ceil(OVERSAMPLING * count / len(patch)), 1)
    shift = torch.rand(len(patch), 2, generator=generator) - 0.5
    patch[:, 3] += (patch[:, 4:] * shift).sum(dim=1)
    patch[:, 1:3] += shift
    points = _back_project(patch, cameras)
    chosen = _evenly(points, count, generator)
    moved, sure = _where_lit(points[chosen], patch[chosen], views, cameras)
    return moved[sure], patch[chosen[sure], 0].long()


def with_thin_parts(
    gaussians: Gaussians, camera: Cameras, copies: int = 1, thin_copies: int = THIN_COPIES
) -> tuple[Tensor, Tensor]:
    """Return the depth map of one camera and its slopes, with depths also in pixels that thin parts cover in part.

    The rims of what is at least three pixels wide are covered in part as well and stay as they are.

    Args:
        copies, thin_copies: of each Gaussian, as for `depth_map`, in pixels that are solid and in the others.
    """
    depth, slope = depth_map(gaussians, camera, copies)
    thin_depth, thin_slope = depth_map(gaussians, camera, thin_copies)
    solid = depth.isfinite()
    wide = -F.max_pool2d(-solid[None].float(), 3, 1, 1)  # in the middle of 3x3 solid pixels
    near_wide = F.max_pool2d(wide, 5, 1, 2)[0] > 0
    taken = solid | near_wide
    return torch.where(taken, depth, thin_depth), torch.where(taken[:, :, None], slope, thin_slope)


def bright(gaussians: Gaussians, cameras: Cameras) -> Gaussians:
    """Return the Gaussians that differ from the background: black ones in front of a black sky change no image."""
    if len(gaussians) == 0:
        return gaussians
    light = (mean_radiance(gaussians, cameras).mean(dim=-1) - cameras.background).abs()
    return constant_radiance(gaussians).select(light > MIN_RADIANCE * light.quantile(BRIGHT_QUANTILE))


@torch.no_grad()
def depth_map(gaussians: Gaussians, camera: Cameras, copies: int = 1) -> tuple[Tensor, Tensor]:
    """Return the depth [H, W] m (infinite where the pixel is not solid) and its slope [H, W, 2] m/px of one camera.

    The depth is that of the Gaussian at which the transmittance falls to one half, one sigma in front of its maximum
    along the ray, where the surface of a solid lies. The maxima of all rays form, to first order, a plane; for a thin
    disc that is the disc itself.

    Args:
        copies: of each Gaussian, which make the transmittance of k copies the k-th power of that of one. The depth is
            then where the transmittance of the model falls to 0.5^(1/copies), nearer to the camera.

    Source: Zhang et al., RaDe-GS: Rasterizing Depth in Gaussian Splatting, 2024.
    """
    drawn = gaussians if copies == 1 else gaussians.select(torch.arange(len(gaussians)).repeat(copies))
    median = render(drawn, camera).median_depth[0]
    projected = project(gaussians, camera)
    depths, order = projected.depths[0].sort()
    middles = (depths[1:] + depths[:-1]) / 2
    stopping = order[torch.searchsorted(middles, median.contiguous())]  # [H, W] the Gaussian at the median
    slopes, sigmas_m = _planes(gaussians, camera)
    slope = slopes[stopping]  # [H, W, 2]
    v, u = torch.meshgrid(torch.arange(camera.height) + 0.5, torch.arange(camera.width) + 0.5, indexing="ij")
    from_centre = torch.stack([u, v], dim=-1) - projected.means2d[0][stopping]
    depth = median + (slope * from_centre).sum(dim=-1) - sigmas_m[stopping]
    return torch.where((median > 0) & (depth > camera.near_m), depth, torch.inf), slope


def _planes(gaussians: Gaussians, camera: Cameras) -> tuple[Tensor, Tensor]:
    """Return how the depth of each Gaussian's maximum changes across the image [N, 2] m/px, and its sigma in depth.

    The sigma [N] m is that along the ray to the Gaussian's centre. The slope is reduced the rounder a Gaussian is,
    since the tilt of a round one is noise of the training (completeness of a model whose shortest sigma was 0.6 of the
    middle one: 77 % with reduced, 76 % with full slopes).
    """
    R, t, K = camera.world_to_camera[0, :3, :3], camera.world_to_camera[0, :3, 3], camera.K[0]
    p = gaussians.means @ R.T + t
    axes = R @ quats_to_matrices(gaussians.quats)  # in the camera frame
    along = (axes.transpose(1, 2) @ p[..., None])[..., 0]  # the ray in each Gaussian's axes
    scales = (gaussians.log_scales - gaussians.log_scales.max(dim=1, keepdim=True).values).clamp(min=-9).exp()
    # the plane's normal is Sigma^-1 p, here times the square of the largest sigma
    normal = (axes @ (along / scales**2)[..., None])[..., 0]
    slope = -normal[:, :2] * p[:, 2:] / (normal * p).sum(dim=1, keepdim=True)  # over depth, per tangent
    shortest, middle, _ = scales.sort(dim=1).values.unbind(dim=1)
    slope = slope * (1 - (shortest / middle) ** 2)[:, None]
    slope = slope * (MAX_TANGENT / slope.norm(dim=1, keepdim=True).clamp(min=MAX_TANGENT))
    slopes = (slope * p[:, 2:] / torch.stack([K[0, 0], K[1, 1]])).nan_to_num(0, 0, 0)
    return slopes, p[:, 2] / (along / gaussians.scales).norm(dim=1)


@dataclass(frozen=True)
class _View:
    """The depths of one view, with which points of the others are compared."""

    low_m: Tensor  # [H, W] m, least depth of a pixel and its neighbours; infinite if all are sky
    high_m: Tensor  # [H, W] m, greatest such depth; 0 if all are sky
    depth_m: Tensor  # [H, W], infinite in the sky
    tangents: Tensor  # [H, W, 2] of the angle between the surface and the image plane
    light: Tensor  # [H, W]

    def plane(self, index: Tensor, p: Tensor, uv: Tensor, K: Tensor) -> tuple[Tensor, Tensor]:
        """Return how far behind places the planes are that are seen there, and by which gradient that changes.

        Args:
            index: [P] of the pixel; p: [P, 3] m, places in the camera's frame; uv: [P, 2] px, where they project.

        Returns:
            [P] m along the line of sight, not finite in the sky, and [P, 3], across the plane, in the camera's frame.
        """
        depth_m, focal = self.depth_m.flatten()[index], K.diagonal()[:2]
        slope = self.tangents.flatten(0, 1)[index].float() * depth_m[:, None] / focal  # m/px
        behind_m = depth_m + (slope * (uv - uv.floor() - 0.5)).sum(dim=1) - p[:, 2]
        across = slope / p[:, 2:]
        along = -1 - (across * (uv - K[:2, 2])).sum(dim=1)
        return behind_m, torch.cat([across * focal, along[:, None]], dim=1)


def _evenly(points: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """Return the indices of `count` points [P, 3] to keep: those nearest to the centres of a cubic grid's cells.

    The grid is rotated at random, since a plate between two layers of cells would get twice as many points.
    """
    points = points @ quats_to_matrices(torch.randn(1, 4, generator=generator))[0]
    corner = points.amin(dim=0)
    extent = max(1e-9, float((points - corner).max()))
    finest, coarsest = FINEST_CELL * extent, extent
    for _ in range(BISECTIONS):
        size = math.sqrt(finest * coarsest)
        enough = len(_cells((points - corner) / size).unique()) >= count
        finest, coarsest = (size, coarsest) if enough else (finest, size)
    place = (points - corner) / finest
    order = (place - place.floor() - 0.5).norm(dim=1).argsort()
    cells, order_in = _cells(place)[order].sort(stable=True)
    first = torch.ones(len(points), dtype=torch.bool)
    first[1:] = cells[1:] != cells[:-1]
    # the first of each cell precede all others
    rank = torch.rand(len(points), generator=generator) - first.float()
    return order[order_in[rank.argsort()[:count]]]


def _cells(place: Tensor) -> Tensor:
    """Return the number [P] of the cell of width 1 in which each place [P, 3] lies; places are positive."""
    column = place.long()
    wide = column.amax(dim=0) + 1
    return (column[:, 0] * wide[1] + column[:, 1]) * wide[2] + column[:, 2]


def _confirmed(points: Tensor, views: list[_View], cameras: Cameras) -> Tensor:
    """Return which points [P] enough views confirm."""
    agreeing, through = torch.zeros(len(points)), torch.zeros(len(points))
    for c, view in enumerate(views):
        p, _, index, seen = _on_image(points, cameras, c)
        z = p[:, 2]
        low_m, high_m = view.low_m.flatten()[index], view.high_m.flatten()[index]
        tolerance_m = SAME_DEPTH_PX * z / cameras.K[c, 0, 0]
        agrees = seen & (z >= low_m - tolerance_m) & (z <= high_m + tolerance_m)
        agreeing += agrees
        through += seen & (z < low_m - tolerance_m)
    # a point's own view is among those that agree
    others = min(AGREEING_VIEWS, len(cameras) - 1)
    return (agreeing > others) & (through <= agreeing)


def _where_lit(points: Tensor, patch: Tensor, views: list[_View], cameras: Cameras) -> tuple[Tensor, Tensor]:
    """Return points [P, 3] of patches [P, 6], moved towards the planes that views see near them, and which are sure.

    A face that shows no light may lie anywhere behind a lit one, or before it, without a trace in the pictures. Planes
    therefore have weight by the light that shows them, and a point moves to their mean by the share of the light that
    its own view lacks, against the view with the most. Sure are points in the planes of enough views.

    Source: Curless and Levoy, A volumetric method for building complex models from range images, 1996, who weight the
    depths of scans by how sure they are.
    """
    least_light = LEAST_LIGHT * sum(float(view.light.float().mean()) for view in views) / len(views)
    moved, weights, most = torch.zeros_like(points), torch.zeros(len(points)), torch.zeros(len(points))
    own, planar, on_image = (torch.zeros(len(points)) for _ in range(3))
    for c, view in enumerate(views):
        p, uv, index, seen = _on_image(points, cameras, c)
        behind_m, gradient = view.plane(index, p, uv, cameras.K[c])
        light = view.light.flatten()[index].float() + least_light
        off_px = behind_m.abs() * cameras.K[c, 0, 0] / p[:, 2]
        near = seen & (off_px < LIT_WITHIN_PX)
        planar += seen & (off_px < SAME_DEPTH_PX)
        on_image += seen
        squares = gradient.square().sum(dim=1)
        weight = torch.where(near, light / squares, 0.0)
        to_plane = -(behind_m / squares)[:, None] * gradient @ cameras.world_to_camera[c, :3, :3]
        moved += torch.where(near[:, None], weight[:, None] * to_plane, 0.0)
        weights += weight
        most = torch.where(near, torch.maximum(most, light), most)
        own = torch.where(patch[:, 0] == c, light, own)
    share = (1 - own / most.clamp(min=1e-30)).clamp(0, 1)
    moved = points + (share / weights.clamp(min=1e-30))[:, None] * moved
    return moved, planar >= PLANAR_VIEWS * on_image


def _on_image(points: Tensor, cameras: Cameras, c: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return points [P, 3] in one camera's frame, where they project [P, 2] px, the index of their pixel [P], and
    whether they lie on the image [P]."""
    R, t, K = cameras.world_to_camera[c, :3, :3], cameras.world_to_camera[c, :3, 3], cameras.K[c]
    p = points @ R.T + t
    uv = ((p / p[:, 2:]) @ K.T)[:, :2]
    column, row = uv.floor().unbind(dim=1)
    seen = (p[:, 2] > cameras.near_m) & (column >= 0) & (column < cameras.width)
    seen &= (row >= 0) & (row < cameras.height)
    return p, uv, torch.where(seen, row * cameras.width + column, 0).long(), seen


def _fitted_normals(points: Tensor, to_camera: Tensor) -> Tensor:
    """Return normals [M, 3] of planes through each point's neighbours, on the camera's side.

    The planes of single Gaussians would be enough if all were thin discs; rounder ones have no reliable normal.
    """
    tree = KDTree(
        points.numpy(), leafsize=NORMAL_NEIGHBOURS // 2
    )  # faster than the default of 10 for so many
    _, nearest = tree.query(points.numpy(), k=min(NORMAL_NEIGHBOURS, len(points)))
    neighbours = torch.from_numpy(nearest).reshape(len(points), -1)
    offsets = points[neighbours]
    offsets = offsets - offsets.mean(dim=1, keepdim=True)
    spreads = torch.linalg.eigh(offsets.transpose(1, 2) @ offsets)
    normals = spreads.eigenvectors[..., 0]  # of the smallest eigenvalue
    # the cameras of the neighbours decide where the point's own camera sees it edge-on
    to_camera = F.normalize(to_camera, dim=1)
    to_camera = to_camera + to_camera[neighbours].mean(dim=1)
    return torch.where((normals * to_camera).sum(dim=1, keepdim=True) < 0, -normals, normals)


def _neighbourhood(depth: Tensor) -> tuple[Tensor, Tensor]:
    """Return the least and greatest finite depth of each pixel's 3 x 3 neighbours: infinite and 0 if all are sky."""
    low_m = -F.max_pool2d(-depth[None], 3, stride=1, padding=1)[0]
    high_m = F.max_pool2d(torch.where(depth.isfinite(), depth, 0)[None], 3, stride=1, padding=1)[0]
    return low_m, high_m


def _candidates(
    depth: Tensor,
    slope: Tensor,
    low_m: Tensor,
    high_m: Tensor,
    K: Tensor,
    limit: int,
    generator: torch.Generator,
) -> Tensor:
    """Return pixels on no depth edge [P, 5] (u, v, depth, slopes), at most `limit`."""
    pixel_m = depth / K[0, 0]
    flat = depth.isfinite() & (high_m - low_m <= 2 * MAX_DEPTH_TANGENT * pixel_m)  # over two pixels
    flat &= (
        slope.norm(dim=-1) < 0.99 * MAX_TANGENT * pixel_m
    )  # below the limit, to which steeper ones were clamped
    rows, columns = torch.nonzero(flat, as_tuple=True)
    chosen = torch.randperm(len(rows), generator=generator)[:limit]
    rows, columns = rows[chosen], columns[chosen]
    pixels = torch.stack([columns + 0.5, rows + 0.5, depth[rows, columns]], dim=1)
    return torch.cat([pixels, slope[rows, columns]], dim=1)


def _back_project(patch: Tensor, cameras: Cameras) -> Tensor:
    """Return body-frame points [P, 3] of patches [P, 6] (camera, u, v, depth, slopes)."""
    camera = patch[:, 0].long()
    K, pose = cameras.K[camera], cameras.world_to_camera[camera]
    u, v, z = patch[:, 1:4].unbind(dim=1)
    ray = torch.stack(
        [(u - K[:, 0, 2]) / K[:, 0, 0], (v - K[:, 1, 2]) / K[:, 1, 1], torch.ones_like(u)], dim=1
    )
    R, t = pose[:, :3, :3], pose[:, :3, 3]
    return (R.transpose(1, 2) @ (z[:, None] * ray - t)[..., None])[..., 0]
