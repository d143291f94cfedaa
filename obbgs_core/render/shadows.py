"""Cast shadows: a depth map from the Sun's direction, and how much of the Sun each Gaussian sees.

Source: Williams, Casting Curved Shadows on Curved Surfaces, 1978; soft edges as in Reeves et al., Rendering Antialiased
Shadows with Depth Maps, 1987.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
import torch.nn.functional as F
from torch import Tensor

from obbgs_core.model.cameras import Cameras
from obbgs_core.model.gaussians import Gaussians
from obbgs_core.render.backends import rasterize
from obbgs_core.render.lighting import constant_radiance, without_sun

SHADOW_MAP_PX = 256  # width and height
SHADOW_MARGIN_PX = 2  # added around the map, lit everywhere
SHADOW_PSF_SIGMA_PX = 0.0  # no optics look from the Sun
# in radii of the model: its rays are parallel to 0.2 degrees, less than the Sun's diameter
SUN_DISTANCE = 300.0
INLIER_QUANTILE = 0.99  # of the centres' distances: Gaussians farther out neither cast nor receive shadows
BALL_MARGIN = 1.1
# How far behind the first surface a Gaussian is still fully lit, and from where on it is in full shadow, in units of a
# pixel's width plus the Gaussian's own sigma along the ray. The tolerance keeps surfaces from shading themselves.
LIT_UNTIL, DARK_FROM = 2.0, 4.0
SHADOW_INTERVAL = 120  # steps of a training between two computations of its shadow maps


@dataclass(frozen=True)
class ShadowMap:
    """What the Sun sees: a camera in its place, and the depth of the first surface there, with a margin around it."""

    sun: Cameras  # one camera
    first_m: Tensor  # [H + 4, W + 4] m, infinite where there is no surface


@torch.no_grad()
def shadow_map(gaussians: Gaussians, sun_dir: Tensor, backend: str = "auto") -> ShadowMap:
    """Return the shadow map of the Sun in direction `sun_dir` [3] (unit, body frame)."""
    shapes = constant_radiance(gaussians)
    sun = sun_camera(shapes, sun_dir.to(shapes.means.device))
    surface_m = rasterize(shapes, sun, backend).median_depth[0]
    first_m = torch.where(surface_m > 0, surface_m, torch.inf)
    return ShadowMap(sun, F.pad(first_m[None], (SHADOW_MARGIN_PX,) * 4, value=torch.inf)[0])


def sunlit_shares(gaussians: Gaussians, sun_dir: Tensor, backend: str = "auto") -> Tensor:
    """Return the visibility 0..1 of the Sun from each Gaussian [S, N], for Suns in directions [S, 3]."""
    directions, which = sun_dir.unique(dim=0, return_inverse=True)
    return lit_shares(gaussians, [shadow_map(gaussians, each, backend) for each in directions])[which]


def lit_from(gaussians: Gaussians, sun_dir: Tensor | None) -> Gaussians:
    """Return the model as it looks with the Sun towards `sun_dir` [3] (unit, body frame), in harmonics of the view.

    Raises:
        ValueError: the radiance depends on the Sun's direction, and none is given.
    """
    sunlit = None
    if gaussians.shading == "lambert" and sun_dir is not None:
        sunlit = sunlit_shares(gaussians, sun_dir[None])[0]
    return without_sun(gaussians, sun_dir, sunlit)


def lit_shares(gaussians: Gaussians, maps: Sequence[ShadowMap]) -> Tensor:
    """Return the visibility 0..1 of each map's Sun from each Gaussian [S, N].

    The nine pixels around a Gaussian are compared with its depth and averaged with the weights of a spline, and the
    visibility falls over a range of depths: it is continuous, so that rounding errors cannot switch light on or off.
    """
    gaussians = gaussians.detach()
    axes, shares = gaussians.axes, []
    for each in maps:
        R, t = each.sun.world_to_camera[0, :3, :3], each.sun.world_to_camera[0, :3, 3]
        focal_px, middle_px = each.sun.K[0, 0, 0], each.sun.K[0, 0, 2]
        x, y, depth_m = (gaussians.means @ R.T + t).unbind(dim=1)
        sigma_m = (R[2] @ axes).norm(dim=1)
        tolerance_m = sigma_m + t[2] / focal_px
        side = len(each.first_m)
        u, v = (
            (focal_px * offset / depth_m + middle_px + SHADOW_MARGIN_PX)
            .nan_to_num(1.5)
            .clamp(1.5, side - 1.5)
            for offset in (x, y)
        )
        neighbours = torch.tensor([dv * side + du for dv in (-1, 0, 1) for du in (-1, 0, 1)], device=u.device)
        surface_m = each.first_m.flatten()[(v.long() * side + u.long())[:, None] + neighbours]
        behind = (depth_m[:, None] - surface_m) / tolerance_m[:, None]
        lit = ((DARK_FROM - behind) / (DARK_FROM - LIT_UNTIL)).clamp(0, 1)
        weight = _spline_weights(v)[:, :, None] * _spline_weights(u)[:, None]
        shares.append((lit * weight.flatten(1)).sum(dim=1))
    return torch.stack(shares)


def sun_camera(gaussians: Gaussians, sun_dir: Tensor) -> Cameras:
    """Return a camera that sees the whole model from the Sun's direction `sun_dir` [3]."""
    centre, radius_m = bounding_ball(gaussians)
    distance_m, half_px = SUN_DISTANCE * radius_m, SHADOW_MAP_PX / 2
    forward = -F.normalize(sun_dir.detach().to(centre), dim=0)
    aside = centre.new_tensor([1.0, 0.0, 0.0] if abs(float(forward[0])) < 0.9 else [0.0, 1.0, 0.0])
    right = F.normalize(torch.linalg.cross(aside, forward), dim=0)
    pose = torch.eye(4).to(centre)
    pose[:3, :3] = torch.stack([right, torch.linalg.cross(forward, right), forward])
    pose[:3, 3] = -pose[:3, :3] @ (centre - distance_m * forward)
    focal_px = half_px * SUN_DISTANCE
    K = centre.new_tensor([[focal_px, 0, half_px], [0, focal_px, half_px], [0, 0, 1]])
    return Cameras(pose[None], K[None], SHADOW_MAP_PX, SHADOW_MAP_PX, psf_sigma_px=SHADOW_PSF_SIGMA_PX)


def bounding_ball(gaussians: Gaussians) -> tuple[Tensor, float]:
    """Return the centre [3] m and radius, m, of a ball around all centres but a few outliers, with a margin."""
    means = gaussians.means.detach()
    means = means[means.isfinite().all(dim=1)]
    if len(means) == 0:
        return means.new_zeros(3), 1.0
    centre = means.mean(dim=0)
    distances = (means - centre).norm(dim=1)
    farthest_m = float(distances.kthvalue(math.ceil(INLIER_QUANTILE * len(means))).values)
    return centre, max(1e-6, BALL_MARGIN * farthest_m)


def _spline_weights(place: Tensor) -> Tensor:
    """Return quadratic B-spline weights [N, 3] of the pixels before, at and after places [N] px."""
    off = place - place.floor() - 0.5
    return torch.stack([0.5 * (0.5 - off) ** 2, 0.75 - off**2, 0.5 * (0.5 + off) ** 2], dim=1)


@dataclass
class Shadows:
    """The shadow maps of a model, by the Sun's direction; the model changes slowly, so they are kept for some steps."""

    maps: dict[tuple[float, ...], ShadowMap] = field(default_factory=dict)

    def sunlit(self, gaussians: Gaussians, cameras: Cameras, step: int) -> Tensor | None:
        """Return the share of each camera's Sun that reaches each Gaussian [C, N]; None unless shading is Lambert's."""
        if gaussians.shading != "lambert":
            return None
        if step % SHADOW_INTERVAL == 0:
            self.maps = {}
        used = []
        for sun_dir in cameras.known_suns():
            sun = tuple(sun_dir.tolist())
            if sun not in self.maps:
                self.maps[sun] = shadow_map(gaussians, sun_dir)
            used.append(self.maps[sun])
        return lit_shares(gaussians, used)
