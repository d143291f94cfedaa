"""Points on the surface that the cameras see, with normals: depth maps of the model, fused."""

import math
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

BLACKEST = 3e-4  # of the bright surface's radiance; fainter Gaussians show no light, so no surface was measured there
BRIGHT_QUANTILE = 0.97
STEEPEST = 4.0  # tangent of the largest angle between line of sight and a Gaussian's normal, 76 degrees
STEEPEST_DEPTH = 24.0  # the same of the depth map itself; steeper is an edge
SAME_DEPTH_PX = 2.0  # depths agree within so many pixels' width
AGREEING_VIEWS = 2  # that must see a point, besides its own
NORMAL_NEIGHBOURS = 64  # fewer follow the noise of the depth maps, more round the edges off
CANDIDATES = 900_000  # pixels that are looked up in every view
POINTS_TO_CHOOSE_FROM = 4  # at least so many for each that is returned
FINEST_CELL = 1e-5  # of the surface's extent
CELL_HALVINGS = 18  # of the ratio of the two cell sizes between which the right one lies


@torch.no_grad()
def surface_points(
    gaussians: Gaussians, cameras: Cameras, count: int = 100_000, seed: int = 0
) -> tuple[Tensor, Tensor]:
    """Return points [count, 3] m and unit normals [count, 3] towards the cameras, evenly spread over the seen surface.

    A pixel of a depth map counts where it is solid, on no depth edge and not seen at a grazing angle, where two other
    views see a surface at its depth, and no more views look through it than see it. Each gives points at random places
    on its patch of plane; of those, one is kept in every cell of a cubic grid as fine as the count allows. The same
    seed gives the same points. Both are empty, [0, 3], where no surface passes.

    Args:
        gaussians: on the CPU, as the cameras.
        cameras: the training cameras, or any others; frames of one bracket see the same, one of them is enough.

    Raises:
        ValueError: no camera, or a count under 1; the radiance turns with the Sun, and the cameras do not say where
            it is.
    """
    if len(cameras) == 0 or count < 1:
        raise ValueError(f"expected a camera and a count of at least 1, got {len(cameras)} and {count}")
    gaussians = _lit(gaussians, cameras)
    if len(gaussians) == 0:
        return torch.zeros(0, 3), torch.zeros(0, 3)
    generator = torch.Generator().manual_seed(seed)
    views, patches = [], []
    for c in range(len(cameras)):
        depth, slope = depth_map(gaussians, cameras.one(c))
        near, far = _neighbourhood(depth)
        pixels = _candidates(depth, slope, near, far, cameras.K[c], -(-CANDIDATES // len(cameras)), generator)
        views.append(_View(near, far))
        patches.append(torch.cat([torch.full((len(pixels), 1), float(c)), pixels], dim=1))
    patch = torch.cat(patches)  # [P, 6]: camera, u, v, depth, slopes
    patch = patch[_confirmed(_back_project(patch, cameras), views, cameras)]
    if len(patch) == 0:
        return torch.zeros(0, 3), torch.zeros(0, 3)
    patch = patch.repeat(math.ceil(POINTS_TO_CHOOSE_FROM * count / len(patch)), 1)
    shift = torch.rand(len(patch), 2, generator=generator) - 0.5
    patch[:, 3] += (patch[:, 4:] * shift).sum(dim=1)
    patch[:, 1:3] += shift
    points = _back_project(patch, cameras)
    chosen = _evenly(points, count, generator)
    points, patch = points[chosen], patch[chosen]
    return points, _fitted_normals(points, cameras.centres[patch[:, 0].long()] - points)


def _lit(gaussians: Gaussians, cameras: Cameras) -> Gaussians:
    """Return the Gaussians that shine at all: black ones in front of black sky contradict no picture."""
    if len(gaussians) == 0:
        return gaussians
    light = mean_radiance(gaussians, cameras).mean(dim=-1)
    return constant_radiance(gaussians).select(light > BLACKEST * light.quantile(BRIGHT_QUANTILE))


@torch.no_grad()
def depth_map(gaussians: Gaussians, camera: Cameras) -> tuple[Tensor, Tensor]:
    """Return the depth [H, W] m (infinite where the pixel is not solid) and its slope [H, W, 2] m/px of one camera.

    The depth is where the ray meets the Gaussian that stops half the light: not at its centre's depth, but one
    deviation before its peak along the ray, where a solid's surface lies. The peaks of all rays form, to first order,
    a plane; for a thin disc that is the disc itself.

    Source: Zhang et al., RaDe-GS: Rasterizing Depth in Gaussian Splatting, 2024.
    """
    median = render(gaussians, camera).median_depth[0]
    projected = project(gaussians, camera)
    depths, order = projected.depths[0].sort()
    middles = (depths[1:] + depths[:-1]) / 2
    stopping = order[torch.searchsorted(middles, median.contiguous())]  # [H, W] whose depth the median is
    slopes, deviations_m = _planes(gaussians, camera)
    slope = slopes[stopping]  # [H, W, 2]
    v, u = torch.meshgrid(torch.arange(camera.height) + 0.5, torch.arange(camera.width) + 0.5, indexing="ij")
    from_centre = torch.stack([u, v], dim=-1) - projected.means2d[0][stopping]
    depth = median + (slope * from_centre).sum(dim=-1) - deviations_m[stopping]
    return torch.where((median > 0) & (depth > camera.near_m), depth, torch.inf), slope


def _planes(gaussians: Gaussians, camera: Cameras) -> tuple[Tensor, Tensor]:
    """Return how the depth of each Gaussian's peak changes across the image [N, 2] m/px, and its deviation in depth.

    The deviation [N] m is of the Gaussian along the ray to its centre. The slope counts in full for a disc and less the
    rounder a Gaussian is: the tilt of a round one is noise of the training (completeness of a model whose shortest
    sigma was 0.6 of the middle one: 77 % so, 76 % with full slopes).
    """
    R, t, K = camera.world_to_camera[0, :3, :3], camera.world_to_camera[0, :3, 3], camera.K[0]
    p = gaussians.means @ R.T + t
    axes = R @ quats_to_matrices(gaussians.quats)  # of each Gaussian, in the camera
    along = (axes.transpose(1, 2) @ p[..., None])[..., 0]  # the ray in each Gaussian's axes
    scales = (gaussians.log_scales - gaussians.log_scales.max(dim=1, keepdim=True).values).clamp(min=-9).exp()
    # the plane's normal is Sigma^-1 p, here times the square of the largest sigma
    normal = (axes @ (along / scales**2)[..., None])[..., 0]
    slope = -normal[:, :2] * p[:, 2:] / (normal * p).sum(dim=1, keepdim=True)  # over depth, per tangent
    shortest, middle, _ = scales.sort(dim=1).values.unbind(dim=1)
    slope = slope * (1 - (shortest / middle) ** 2)[:, None]
    slope = slope * (STEEPEST / slope.norm(dim=1, keepdim=True).clamp(min=STEEPEST))
    slopes = (slope * p[:, 2:] / torch.stack([K[0, 0], K[1, 1]])).nan_to_num(0, 0, 0)
    return slopes, p[:, 2] / (along / gaussians.scales).norm(dim=1)


@dataclass(frozen=True)
class _View:
    """What one camera says about points of others."""

    near: Tensor  # [H, W] m, least depth of a pixel and its neighbours, infinite where all is sky
    far: Tensor  # [H, W] m, greatest such depth, 0 where all is sky


def _evenly(points: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """Return which `count` of the points [P, 3] to keep: those nearest to the middles of a cubic grid's cells.

    The grid is turned at random: a plate that lay between two layers of cells would get twice its share.
    """
    points = points @ quats_to_matrices(torch.randn(1, 4, generator=generator))[0]
    corner = points.amin(dim=0)
    extent = max(1e-9, float((points - corner).max()))
    finest, coarsest = FINEST_CELL * extent, extent
    for _ in range(CELL_HALVINGS):
        size = math.sqrt(finest * coarsest)
        enough = len(_cells((points - corner) / size).unique()) >= count
        finest, coarsest = (size, coarsest) if enough else (finest, size)
    place = (points - corner) / finest
    order = (place - place.floor() - 0.5).norm(dim=1).argsort()
    cells, order_in = _cells(place)[order].sort(stable=True)
    first = torch.ones(len(points), dtype=torch.bool)
    first[1:] = cells[1:] != cells[:-1]
    rank = torch.rand(len(points), generator=generator) - first.float()  # those of a cell come first
    return order[order_in[rank.argsort()[:count]]]


def _cells(place: Tensor) -> Tensor:
    """Return one number [P] for each cell of width 1 that places [P, 3], all positive, fall in."""
    column = place.long()
    wide = column.amax(dim=0) + 1
    return (column[:, 0] * wide[1] + column[:, 1]) * wide[2] + column[:, 2]


def _confirmed(points: Tensor, views: list[_View], cameras: Cameras) -> Tensor:
    """Return which points [P] the views confirm."""
    agreeing, through = torch.zeros(len(points)), torch.zeros(len(points))
    for c, view in enumerate(views):
        R, t, K = cameras.world_to_camera[c, :3, :3], cameras.world_to_camera[c, :3, 3], cameras.K[c]
        p = points @ R.T + t
        z = p[:, 2]
        uv = (p / z[:, None]) @ K.T
        column, row = uv[:, 0].floor(), uv[:, 1].floor()
        seen = (z > cameras.near_m) & (column >= 0) & (column < cameras.width)
        seen &= (row >= 0) & (row < cameras.height)
        index = torch.where(seen, row * cameras.width + column, 0).long()
        near, far = view.near.flatten()[index], view.far.flatten()[index]
        tolerance_m = SAME_DEPTH_PX * z / K[0, 0]
        agrees = seen & (z >= near - tolerance_m) & (z <= far + tolerance_m)
        agreeing += agrees
        through += seen & (z < near - tolerance_m)
    # a point's own view is among those that agree
    others = min(AGREEING_VIEWS, len(cameras) - 1)
    return (agreeing > others) & (through <= agreeing)


def _fitted_normals(points: Tensor, to_camera: Tensor) -> Tensor:
    """Return normals [M, 3] of planes through each point's neighbours, on the camera's side.

    Planes of single Gaussians would do where all are thin discs; a model of rounder ones has no normal of its own.
    """
    _, nearest = KDTree(points.numpy()).query(points.numpy(), k=min(NORMAL_NEIGHBOURS, len(points)))
    neighbours = torch.from_numpy(nearest).reshape(len(points), -1)
    offsets = points[neighbours]
    offsets = offsets - offsets.mean(dim=1, keepdim=True)
    spreads = torch.linalg.eigh(offsets.transpose(1, 2) @ offsets)
    normals = spreads.eigenvectors[..., 0]  # of the smallest
    # the neighbours' cameras decide for a point that its own sees edge-on
    to_camera = F.normalize(to_camera, dim=1)
    to_camera = to_camera + to_camera[neighbours].mean(dim=1)
    return torch.where((normals * to_camera).sum(dim=1, keepdim=True) < 0, -normals, normals)


def _neighbourhood(depth: Tensor) -> tuple[Tensor, Tensor]:
    """Return the least and greatest finite depth of each pixel's 3 x 3 neighbours: infinite and 0 where all is sky."""
    near = -F.max_pool2d(-depth[None], 3, stride=1, padding=1)[0]
    far = F.max_pool2d(torch.where(depth.isfinite(), depth, 0)[None], 3, stride=1, padding=1)[0]
    return near, far


def _candidates(
    depth: Tensor, slope: Tensor, near: Tensor, far: Tensor, K: Tensor, limit: int, generator: torch.Generator
) -> Tensor:
    """Return pixels on no depth edge [P, 5] (u, v, depth, slopes), at most `limit`."""
    pixel_m = depth / K[0, 0]
    flat = depth.isfinite() & (far - near <= 2 * STEEPEST_DEPTH * pixel_m)  # across two pixels
    flat &= slope.norm(dim=-1) < 0.99 * STEEPEST * pixel_m  # not held to it
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
