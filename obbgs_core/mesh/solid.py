"""A closed mesh of what the model's depth maps leave solid."""

import dataclasses

import fast_simplification
import manifold3d
import numpy as np
import torch
import torch.nn.functional as F
from scipy import ndimage
from scipy.spatial import KDTree
from skimage.measure import marching_cubes
from torch import Tensor

from obbgs_core.errors import ExportError
from obbgs_core.mesh.flat_faces import faces_of_simplified, flat_faces, flattened
from obbgs_core.mesh.plates import thinned
from obbgs_core.mesh.texture import layout_of
from obbgs_core.mesh.triangles import geometry_of, vertex_normals
from obbgs_core.model.cameras import Cameras
from obbgs_core.model.gaussians import Gaussians
from obbgs_core.model.mesh import SurfaceMesh
from obbgs_core.render import lit_from, render
from obbgs_core.score.surface import bright, with_thin_parts

MAX_TRIANGLES = 5_000
FINE_TRIANGLES = 50_000  # are looked at for dark sides and flat faces
VIEWS = 24  # are compared, evenly chosen of those given
VOXEL_PX = 1.5  # width of a voxel in pixels, at the median depth
CHUNK = 30_000  # nodes at a time, such that their distances stay in the processor's cache
MAX_NODES = 2_000_000  # wider voxels are used if there would be more
BAND_VOXELS = 1.5  # a view says nothing of what lies deeper than this behind the surface that it sees
# of each Gaussian in the depth maps: the Gaussians of a face lie in layers, of which the outer ones are nearest to it
COPIES = 2
THIN_COPIES = 5  # the same in pixels that are covered in part: a strut may cover a seventh of one
SEEN_THROUGH = 0.3  # of the views that see a place; if so many see past it, it is empty
THICKER_VOXELS = 0.8  # on each side, so that a plate thinner than a voxel is not lost between two nodes
DRAWN_BACK_VOXELS = 0.6  # of that, when triangles are made
AT_LEAST_SEEING = 2  # views; what fewer see is taken for solid
# cosine of the angle between a vertex's normal and the way to a view that decides where it lies, at least
IN_FRONT = 0.3
BLOCK = 8  # nodes along a side that are decided on together first
FEWEST_NODES = 8  # of a piece that is kept
COLLAPSE_RATE = 7  # of fast_simplification: how fast its threshold grows
SAME_DEPTH_VOXELS = 2.0  # within which a place counts as seen
SEEN_AT = 0.05  # cosine between a place's normal and the way to a view that sees it, at least
# the same of a vertex: its normal is the mean of its triangles', of which one may be seen
SEEN_AT_VERTEX = -0.3
APART_VOXELS = 0.01  # by which vertices at one place are moved into the solid, each on its own side


@torch.no_grad()
def surface_mesh(
    gaussians: Gaussians, cameras: Cameras, sun_dir: Tensor | None = None, max_triangles: int = MAX_TRIANGLES
) -> SurfaceMesh:
    """Return a closed mesh of all that the views do not see through.

    Two triangles share an edge, also when vertices at equal places are merged.

    Each place of a grid gets its distances from the planes that the views see there, positive in front, and far in
    front where a view sees past it. The distance that SEEN_THROUGH of them exceed is 0 on the surface, also of a thin
    plate, of which half of the views look at the other side. Marching cubes make triangles of the zeros, after hollows
    that no view sees into were filled, and specks and pieces that no view sees were removed. Their vertices then go to
    the middle of what the views in front of them see, dark sides of plates to their lit ones, those of flat faces onto
    their planes, and the triangles are merged until there are few enough, such that the mesh stays closed.

    Args:
        gaussians: on the CPU, as the cameras.
        cameras: the training cameras, one for each bracket is enough.
        sun_dir: [3] unit, body frame: the illumination under which models are shown whose harmonics turn with the Sun.

    Raises:
        ValueError: no camera, or fewer than 100 triangles asked for; the model turns with the Sun and sun_dir is None.
        ExportError: the views see nothing solid.
    """
    if len(cameras) == 0 or max_triangles < 100:
        raise ValueError(
            f"expected a camera and at least 100 triangles, got {len(cameras)} and {max_triangles}"
        )
    cameras = _evenly_chosen(cameras)
    solid = bright(gaussians, cameras)
    if len(solid) == 0:
        raise ExportError(
            "the model has no Gaussian that is brighter than the sky: there is nothing to make a mesh of"
        )
    seen = [with_thin_parts(solid, cameras.one(c), COPIES, THIN_COPIES) for c in range(len(cameras))]
    maps = [_wider(*depth_and_slope) for depth_and_slope in seen]
    if not any(depth.isfinite().any() for depth, _ in seen):
        raise ExportError(
            "the model has no opaque surface in any view, so there is nothing to make a mesh of"
        )
    corner, nodes, voxel_m = _blocks([depth for depth, _ in maps], cameras)
    if len(nodes) == 0:
        raise ExportError("no surface lies in the images of half of the views: no mesh can be made of it")
    values = torch.cat([_fused(corner + n * voxel_m, maps, cameras, voxel_m) for n in nodes.split(CHUNK)])
    volume, first = _without_specks(values, nodes, voxel_m)
    if not (volume < 0).any():
        raise ExportError("the views see through all that the model shows: no mesh can be made of it")
    vertices, triangles, inwards, _ = marching_cubes(volume, 0.0)
    vertices = (vertices + DRAWN_BACK_VOXELS * inwards) * voxel_m + (corner + first * voxel_m).numpy()
    vertices = _where_seen(vertices, -inwards, maps, cameras, voxel_m)
    vertices, triangles = _collapsed(vertices, triangles.astype(np.int64), FINE_TRIANGLES, voxel_m)
    looks = _Looks(gaussians, [depth for depth, _ in seen], cameras, sun_dir, voxel_m)
    outwards = _outwards(vertices, triangles)
    light = looks.at(vertices, outwards, np.zeros(len(vertices)))[0].mean(axis=1)
    vertices, shifts = thinned(vertices, triangles, light, voxel_m)
    behind = KDTree(vertices)  # of what was moved inwards, views see what was in front of it
    vertices, triangles = _simplified(vertices, triangles, max_triangles, voxel_m)
    vertices = _apart(vertices, _outwards(vertices, triangles), voxel_m)
    outwards = _outwards(vertices, triangles)
    colours, seen_by = looks.at(vertices, outwards, shifts[behind.query(vertices)[1]], SEEN_AT_VERTEX)
    layout = layout_of(vertices, triangles, voxel_m / VOXEL_PX)
    texture, _ = looks.at(layout.places, layout.outwards, shifts[behind.query(layout.places)[1]])
    sides = [layout.width, layout.height]
    return SurfaceMesh(
        vertices,
        triangles,
        colours,
        seen_by,
        len(cameras),
        gaussians.shading == "lambert",
        (layout.corners / sides).astype(np.float32),
        layout.image(texture),
    )


def _evenly_chosen(cameras: Cameras) -> Cameras:
    """Return at most VIEWS of the cameras."""
    chosen = torch.linspace(0, len(cameras) - 1, min(VIEWS, len(cameras))).round().long()
    sun_dir = None if cameras.sun_dir is None else cameras.sun_dir[chosen]
    return dataclasses.replace(
        cameras, world_to_camera=cameras.world_to_camera[chosen], K=cameras.K[chosen], sun_dir=sun_dir
    )


def _wider(depth: Tensor, slopes: Tensor) -> tuple[Tensor, Tensor]:
    """Return a depth map whose outlines reach one pixel further, at the least depth beside them.

    A strut thinner than a pixel lies in the pixel beside the one it is looked up in for too many views to be kept.
    What is wide keeps its place, since other views see its edge from the front.

    Args:
        depth: [H, W] m, infinite where nothing solid is seen; slopes: [H, W, 2] m/px.
    """
    around = F.pad(depth, (1, 1, 1, 1), value=torch.inf)
    beside = torch.stack([around[1:-1, :-2], around[1:-1, 2:], around[:-2, 1:-1], around[2:, 1:-1]]).amin(
        dim=0
    )
    sky = depth.isinf()
    return torch.where(sky, beside, depth), torch.where(sky[:, :, None], 0.0, slopes)


def _blocks(depths: list[Tensor], cameras: Cameras) -> tuple[Tensor, Tensor, float]:
    """Return corner [3] m, nodes [P, 3] (integers) of blocks that are not surely empty, and the width of a voxel m."""
    seen = torch.cat([_back_projected(depth, cameras.one(c)) for c, depth in enumerate(depths)])
    if len(seen) == 0:
        raise ExportError("the target is a few pixels wide, too few to make a mesh of")
    lower, upper = seen.amin(dim=0), seen.amax(dim=0)
    z = torch.cat([depth[depth.isfinite()] for depth in depths])
    voxel_m = VOXEL_PX * float(z.median() / cameras.K[:, 0, 0].mean())
    voxel_m = max(voxel_m, float((upper - lower).prod() / (64 * MAX_NODES)) ** (1 / 3))
    inside = torch.stack(torch.meshgrid(*[torch.arange(BLOCK)] * 3, indexing="ij"), dim=-1).reshape(-1, 3)
    while True:
        corner, width_m = lower - 2 * voxel_m, BLOCK * voxel_m
        counts = ((upper - corner + 2 * voxel_m) / width_m).ceil().long()
        blocks = torch.cartesian_prod(*[torch.arange(n) for n in counts.tolist()]).reshape(-1, 3)
        blocks = blocks[~_surely_empty(corner + (blocks + 0.5) * width_m, width_m, depths, cameras)]
        if len(blocks) * BLOCK**3 <= MAX_NODES:
            return corner, (blocks[:, None] * BLOCK + inside).reshape(-1, 3), voxel_m
        voxel_m *= 1.25


def _surely_empty(centres: Tensor, width_m: float, depths: list[Tensor], cameras: Cameras) -> Tensor:
    """Return which blocks [P] lie, whole, in front of all that enough views see, or outside of most images."""
    radius_m = width_m * 3**0.5 / 2
    past, inside = torch.zeros(len(centres)), torch.zeros(len(centres))
    for c, depth in enumerate(depths):
        z, index, within, _ = _on_image(centres, cameras.one(c))
        nearest_m = max(radius_m, float(z[within].amin()) - radius_m) if within.any() else radius_m
        reach = min(int(radius_m * float(cameras.K[c, :2, :2].max()) / nearest_m) + 1, max(depth.shape))
        least = -F.max_pool2d(-depth[None], (2 * reach + 1, 1), 1, (reach, 0))
        least = -F.max_pool2d(-least, (1, 2 * reach + 1), 1, (0, reach))[0]
        past += within & (least.flatten()[index] - z > radius_m)
        inside += within
    return (past > SEEN_THROUGH * len(cameras)) | (inside < len(cameras) / 2)


def _fused(places: Tensor, maps: list[tuple[Tensor, Tensor]], cameras: Cameras, voxel_m: float) -> Tensor:
    """Return how far outside of the solid each place [P] is, m, and below 0 inside."""
    in_front = torch.full((len(places), len(cameras)), torch.inf)
    for c, depth_and_slope in enumerate(maps):
        distance, within = _in_front(places, depth_and_slope, cameras.one(c))
        in_front[:, c] = torch.where(
            within & (distance > -BAND_VOXELS * voxel_m), distance.clamp(max=3 * voxel_m), torch.inf
        )
    seeing = in_front.isfinite().sum(dim=1)
    exceeded = ((seeing - 1).clamp(min=0) * (1 - SEEN_THROUGH)).round().long()
    value = in_front.sort(dim=1).values.gather(1, exceeded[:, None])[:, 0]
    return torch.where(seeing >= AT_LEAST_SEEING, value, -3 * voxel_m) - THICKER_VOXELS * voxel_m


def _in_front(
    places: Tensor, depth_and_slope: tuple[Tensor, Tensor], camera: Cameras
) -> tuple[Tensor, Tensor]:
    """Return how far in front of the plane that a camera sees there each place [P] is, m, and which it has in view."""
    depth, slopes = depth_and_slope
    z, index, within, from_centre = _on_image(places, camera)
    slope = slopes.flatten(0, 1)[index]
    tilt = slope * (camera.K[0].diagonal()[:2] / z[:, None])  # of the surface against the image plane
    along_sight = depth.flatten()[index] + (slope * from_centre).sum(dim=1) - z
    return along_sight / (1 + tilt.square().sum(dim=1)).sqrt(), within


def _where_seen(
    vertices: np.ndarray,
    normals: np.ndarray,
    maps: list[tuple[Tensor, Tensor]],
    cameras: Cameras,
    voxel_m: float,
) -> np.ndarray:
    """Return the vertices [V, 3] m, moved along their normals to the middle one of the planes that views in front see.

    What a share of the views exceeds is as deep as that share sees: where depths scatter, as on curved even faces, it
    lies deeper than most of them say.
    """
    places, outwards = torch.from_numpy(vertices).float(), torch.from_numpy(normals).float()
    in_front = torch.full((len(places), len(cameras)), torch.nan)
    for c, depth_and_slope in enumerate(maps):
        distance, within = _in_front(places, depth_and_slope, cameras.one(c))
        cosine = (F.normalize(cameras.centres[c] - places, dim=1) * outwards).sum(dim=1)
        near = within & (distance.abs() < BAND_VOXELS * voxel_m)
        in_front[:, c] = torch.where(near & (cosine > IN_FRONT), distance, torch.nan)
    seeing = in_front.isfinite().sum(dim=1)
    inwards = torch.where(seeing >= AT_LEAST_SEEING, in_front.nanmedian(dim=1).values, 0.0)
    return vertices - normals * inwards[:, None].double().numpy()


def _without_specks(values: Tensor, nodes: Tensor, voxel_m: float) -> tuple[np.ndarray, Tensor]:
    """Return the values as a volume surrounded by emptiness, and its first node [3]; hollows filled, specks removed."""
    first = nodes.amin(dim=0) - 1
    volume = torch.full((nodes.amax(dim=0) - first + 2).tolist(), voxel_m)
    volume[tuple((nodes - first).T)] = values
    volume = volume.numpy()
    empty = _pieces(volume >= 0)
    volume[(empty != empty[0, 0, 0]) & (volume >= 0)] = -voxel_m
    pieces = _pieces(volume < 0)
    sizes = np.bincount(pieces.ravel())
    # -3 voxels or less where all of a piece is taken for solid because no views say that it is not
    greatest = np.full(len(sizes), -np.inf)
    np.maximum.at(greatest, pieces.ravel(), volume.ravel())
    volume[(pieces > 0) & ((sizes < FEWEST_NODES) | (greatest < -2 * voxel_m))[pieces]] = voxel_m
    return volume, first


def _pieces(mask: np.ndarray) -> np.ndarray:
    """Return the number of the connected piece that each element belongs to, 0 outside of all."""
    pieces = np.zeros(mask.shape, dtype=np.int32)
    ndimage.label(mask, output=pieces)
    return pieces


def _outwards(vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    _, normals, areas = geometry_of(vertices, triangles)
    return vertex_normals(len(vertices), triangles, normals, areas)


def _simplified(
    vertices: np.ndarray, triangles: np.ndarray, max_triangles: int, voxel_m: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return a closed mesh of about so many triangles, with flat faces flat.

    Edges are collapsed by least quadric error (Garland and Heckbert 1997) before vertices go onto their planes: where
    all is flat to the last digit, that error is zero for any order, and it leaves holes and needles.
    """
    faces, face = flat_faces(vertices, triangles, voxel_m)
    simple, among = _collapsed(vertices, triangles, max_triangles, voxel_m)
    if len(among) == 0:
        raise ExportError(
            f"nothing is left of the surface with at most {max_triangles} triangles; allow more"
        )
    of_simple = faces_of_simplified((vertices, triangles, face), (simple, among), faces, voxel_m)
    return _arrays(_closed(flattened(simple, among, of_simple, faces, voxel_m), among))


def _apart(vertices: np.ndarray, outwards: np.ndarray, voxel_m: float) -> np.ndarray:
    """Return the vertices [V, 3] m, those that share a place moved into the solid a little.

    Where two sheets touch along an edge, each has vertices of its own there; whoever merges vertices by their place
    would find four triangles at that edge and call the mesh open.
    """
    _, place, counts = np.unique(vertices, axis=0, return_inverse=True, return_counts=True)
    shared = counts[place.ravel()] > 1
    return np.where(shared[:, None], vertices - APART_VOXELS * voxel_m * outwards, vertices)


def _collapsed(
    vertices: np.ndarray, triangles: np.ndarray, count: int, voxel_m: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return a closed mesh of about so many triangles, or of more if fewer would not be closed."""
    middle = vertices.mean(axis=0)
    scaled = ((vertices - middle) / voxel_m).astype(np.float32)  # the threshold of the collapse has no unit
    while count < len(triangles):
        simple = fast_simplification.simplify(
            scaled, triangles.astype(np.int32), target_count=count, agg=COLLAPSE_RATE
        )
        try:
            return _arrays(_closed(simple[0].astype(np.float64) * voxel_m + middle, simple[1]))
        except ExportError:
            count = 2 * count
    return _arrays(_closed(vertices, triangles))


def _closed(vertices: np.ndarray, triangles: np.ndarray) -> manifold3d.Manifold:
    solid = manifold3d.Manifold(manifold3d.Mesh64(vertices.astype(np.float64), triangles.astype(np.uint64)))
    if solid.status() != manifold3d.Error.NoError:
        raise ExportError(f"the surface is not closed ({solid.status()}), which should not happen")
    return solid


def _arrays(solid: manifold3d.Manifold) -> tuple[np.ndarray, np.ndarray]:
    mesh = solid.to_mesh64()
    return np.array(mesh.vert_properties[:, :3]), np.array(mesh.tri_verts, dtype=np.int64)


class _Looks:
    """What the views see of a model: its radiance, or under Lambert's law its albedo, for any places on its surface."""

    def __init__(
        self,
        gaussians: Gaussians,
        depths: list[Tensor],
        cameras: Cameras,
        sun_dir: Tensor | None,
        voxel_m: float,
    ):
        shown = gaussians
        if gaussians.shading == "lambert":  # the albedos alone
            turn = gaussians.sh.shape[1] > 1
            shown = dataclasses.replace(gaussians.matt(), shading="sun" if turn else "view")
        shown = lit_from(shown, sun_dir)
        self._depths, self._cameras, self._voxel_m = depths, cameras, voxel_m
        self._pictures = []
        for c in range(len(cameras)):
            picture = render(shown, cameras.one(c))
            alpha = picture.alpha.flatten()
            light = picture.radiance[0].flatten(0, 1) - cameras.background * (1 - alpha)[:, None]
            self._pictures.append((light, alpha))

    def at(
        self, places: np.ndarray, outwards: np.ndarray, behind_m: np.ndarray, seen_at: float = SEEN_AT
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return colours [P, C] and the number of views that see each place [P]; unseen ones are like their nearest.

        Args:
            places: [P, 3] m; outwards: [P, 3] unit normals; behind_m: [P] by how much what the views see there may lie
                in front of them.
        """
        points, facing = torch.from_numpy(places).float(), torch.from_numpy(outwards).float()
        behind = torch.from_numpy(behind_m).float()
        tolerance_m = SAME_DEPTH_VOXELS * self._voxel_m
        total = torch.zeros(len(points), self._pictures[0][0].shape[1])
        seen_by, covered = (
            torch.zeros(len(points)),
            torch.zeros(len(points)),
        )  # sum of the alphas they are seen in
        for c, (light, alpha) in enumerate(self._pictures):
            z, index, within, _ = _on_image(points, self._cameras.one(c))
            deeper = z - self._depths[c].flatten()[index]
            towards = F.normalize(self._cameras.centres[c] - points, dim=1)
            seen = within & ((towards * facing).sum(dim=1) > seen_at)
            seen &= (deeper > -tolerance_m) & (deeper < tolerance_m + behind)
            total += torch.where(seen[:, None], light[index], 0)
            covered += torch.where(seen, alpha[index], 0)
            seen_by += seen
        known = covered > 0
        colours = total / torch.where(known, covered, 1.0)[:, None]
        if known.any() and not known.all():
            _, nearest = KDTree(points[known].numpy()).query(points[~known].numpy())
            colours[~known] = colours[known][torch.from_numpy(nearest)]
        return colours.numpy(), seen_by.long().numpy()


def _back_projected(depth: Tensor, camera: Cameras) -> Tensor:
    """Return body-frame points [P, 3] of a depth map's solid pixels, every fourth along each side."""
    v, u = torch.meshgrid(torch.arange(camera.height) + 0.5, torch.arange(camera.width) + 0.5, indexing="ij")
    u, v, z = (values[::4, ::4] for values in (u, v, depth))
    u, v, z = u[z.isfinite()], v[z.isfinite()], z[z.isfinite()]
    K, R, t = camera.K[0], camera.world_to_camera[0, :3, :3], camera.world_to_camera[0, :3, 3]
    ray = torch.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], torch.ones_like(u)], dim=1)
    return (z[:, None] * ray - t) @ R


def _on_image(points: Tensor, camera: Cameras) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return the depth of points [P] m, the index of their pixel [P], which lie on the image [P], and their place in
    the pixel from its centre [P, 2] px."""
    K, R, t = camera.K[0], camera.world_to_camera[0, :3, :3], camera.world_to_camera[0, :3, 3]
    p = points @ (K @ R).T + K @ t
    z = p[:, 2]
    place = p[:, :2] / z.clamp(min=camera.near_m)[:, None]
    u, v = place.unbind(dim=1)
    within = (z > camera.near_m) & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    column, row = u.clamp(0, camera.width - 1).long(), v.clamp(0, camera.height - 1).long()
    from_centre = place - torch.stack([column, row], dim=1) - 0.5
    return z, row * camera.width + column, within, from_centre
