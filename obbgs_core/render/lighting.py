"""How Gaussians shine: harmonics of the view or of the Sun, or Lambert's law with a normal and cast shadows."""

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from obbgs_core.model.cameras import Cameras
from obbgs_core.model.gaussians import Gaussians
from obbgs_core.model.rotations import quats_to_matrices
from obbgs_core.model.sh import C0, fit, from_radiance, radiance, sh_basis, softplus

HALF_LIT = 2.0  # albedo of a Gaussian, over its mean radiance as the Sun goes round
FIRST_AMBIENT = 0.02
SHADOW_MAP_PX = 256  # along a side of the picture that the Sun takes
SUN_DISTANCE = 300.0  # in radii of the model: its rays are parallel to 0.2 degrees, as wide as the Sun is
SOLID_SHARE = 0.99  # of the centres: what strays farther out neither casts nor catches a shadow
# pixels of that picture plus own deviations that a Gaussian may lie behind what the Sun sees: nothing shades itself
LIT_UNTIL, DARK_FROM = 2.0, 4.0


def radiance_along(
    gaussians: Gaussians, directions: Tensor, sun_dir: Tensor | None = None, sunlit: Tensor | None = None
) -> Tensor:
    """Return each Gaussian's radiance [N, C] along `directions` [N, 3] (unit, camera to Gaussian).

    Args:
        sun_dir: [3] unit, body frame; needed unless the shading is of the view.
        sunlit: [N] share of the Sun that arrives at each; needed for Lambert's law.
    """
    if gaussians.shading == "view":
        return radiance(gaussians.sh, directions)
    assert sun_dir is not None  # who calls has looked
    sun_dir = sun_dir.detach().to(directions)
    if gaussians.shading == "sun":
        return radiance(gaussians.sh, sun_dir.expand(len(gaussians), 3))
    assert sunlit is not None
    light = softplus((normals_towards(gaussians, directions) * sun_dir).sum(dim=1)) * sunlit.to(directions)
    return radiance(gaussians.sh, directions) * (light + gaussians.ambient)[:, None]


def lambertian(gaussians: Gaussians) -> Gaussians:
    """Return Gaussians of constant radiance as matt ones of the albedo that, half lit, looks alike."""
    seen = radiance(gaussians.sh.detach()[:, :1], torch.zeros_like(gaussians.means))
    albedo, ambient = from_radiance(HALF_LIT * seen), torch.tensor(FIRST_AMBIENT)
    return dataclasses.replace(gaussians, sh=albedo[:, None], shading="lambert", ambient=ambient)


def normals_towards(gaussians: Gaussians, directions: Tensor) -> Tensor:
    """Return each Gaussian's shortest axis [N, 3], turned against `directions` [N, 3]: to the camera's side."""
    normal = shortest_axes(gaussians)
    return -normal * torch.sign((normal * directions).sum(-1, keepdim=True))


def shortest_axes(gaussians: Gaussians) -> Tensor:
    """Return the unit axis of each Gaussian's smallest deviation [N, 3], of either sign."""
    axes = quats_to_matrices(gaussians.quats)
    shortest = gaussians.log_scales.argmin(dim=1)
    return axes.gather(2, shortest[:, None, None].expand(-1, 3, 1))[..., 0]


def mean_radiance(gaussians: Gaussians, cameras: Cameras) -> Tensor:
    """Return each Gaussian's mean radiance [N, C] in some cameras, without shadows; of harmonics of the view the mean.

    Raises:
        ValueError: the radiance turns with the Sun, and the cameras do not say where it is.
    """
    if gaussians.shading == "view":
        return radiance(gaussians.sh[:, :1], torch.zeros_like(gaussians.means))
    suns, total = cameras.known_suns(), torch.zeros(len(gaussians), gaussians.sh.shape[2])
    for centre, sun_dir in zip(cameras.centres, suns, strict=True):
        directions = F.normalize(gaussians.means - centre, dim=1)
        total += radiance_along(gaussians, directions, sun_dir, torch.ones(len(gaussians)))
    return total / len(cameras)


def without_sun(gaussians: Gaussians, sun_dir: Tensor | None, sunlit: Tensor | None) -> Gaussians:
    """Return the model as it looks with the Sun towards `sun_dir` [3]: harmonics of the view.

    Exact for harmonics of the Sun. By Lambert's law a Gaussian's two sides differ: harmonics of degree 1 are fitted.

    Args:
        sunlit: [N], as for `radiance_along`.

    Raises:
        ValueError: the radiance turns with the Sun, and no direction is given.
    """
    if gaussians.shading == "view":
        return gaussians
    if sun_dir is None:
        raise ValueError("the model's radiance turns with the Sun: give sun_dir, the Sun's direction")
    if gaussians.shading == "sun":
        basis = sh_basis(sun_dir.reshape(1, 3).to(gaussians.sh), gaussians.sh.shape[1])
        constant = (basis[0, :, None] * gaussians.sh).sum(dim=1, keepdim=True) / C0
        return dataclasses.replace(gaussians, sh=constant, shading="view")
    directions, to_coefficients = fit(4)
    seen = [radiance_along(gaussians, d.expand(len(gaussians), 3), sun_dir, sunlit) for d in directions]
    before_softplus = C0 * from_radiance(torch.stack(seen, dim=1))
    fitted = torch.einsum("kd,ndc->nkc", to_coefficients, before_softplus)
    return dataclasses.replace(gaussians, sh=fitted, shading="view")


def bare(gaussians: Gaussians) -> Gaussians:
    """Return the same shapes with a constant radiance, for those who ask for depths only; without gradient."""
    return dataclasses.replace(gaussians.detach(), sh=gaussians.sh.detach()[:, :1], shading="view")


def solid_ball(gaussians: Gaussians) -> tuple[Tensor, float]:
    """Return the centre [3] and the radius, m, of what casts shadows: nearly all of the centres, and some room."""
    means = gaussians.means.detach()
    means = means[means.isfinite().all(dim=1)]
    if len(means) == 0:
        return means.new_zeros(3), 1.0
    centre = means.mean(dim=0)
    distances = (means - centre).norm(dim=1)
    return centre, max(1e-6, 1.1 * float(distances.kthvalue(math.ceil(SOLID_SHARE * len(means))).values))


def sun_camera(gaussians: Gaussians, sun_dir: Tensor) -> Cameras:
    """Return a camera that sees the whole model from where the Sun is, `sun_dir` [3]."""
    centre, radius = solid_ball(gaussians)
    distance_m, half_px = SUN_DISTANCE * radius, SHADOW_MAP_PX / 2
    forward = -F.normalize(sun_dir.detach().to(centre), dim=0)
    aside = centre.new_tensor([1.0, 0.0, 0.0] if abs(float(forward[0])) < 0.9 else [0.0, 1.0, 0.0])
    right = F.normalize(torch.linalg.cross(aside, forward), dim=0)
    pose = torch.eye(4).to(centre)
    pose[:3, :3] = torch.stack([right, torch.linalg.cross(forward, right), forward])
    pose[:3, 3] = -pose[:3, :3] @ (centre - distance_m * forward)
    focal_px = half_px * SUN_DISTANCE
    K = centre.new_tensor([[focal_px, 0, half_px], [0, focal_px, half_px], [0, 0, 1]])
    return Cameras(pose[None], K[None], SHADOW_MAP_PX, SHADOW_MAP_PX)


@dataclass(frozen=True)
class ShadowMap:
    """What the Sun sees: a camera in its place, and how deep its light goes [H + 4, W + 4] m, two pixels around it."""

    sun: Cameras
    first_m: Tensor


def shadow_map_of(sun: Cameras, surface_m: Tensor) -> ShadowMap:
    """Return what a camera of `sun_camera` sees, given the surface's depths there [H, W] m, 0 where there is none."""
    first_m = torch.where(surface_m > 0, surface_m, torch.inf)
    around = (2, 2, 2, 2)  # outside the picture all is lit
    return ShadowMap(sun, F.pad(first_m[None], around, value=torch.inf)[0])


def lit_shares(gaussians: Gaussians, maps: Sequence[ShadowMap]) -> Tensor:
    """Return the share of each Sun that reaches each Gaussian [S, N]: of nine pixels around it, where it lies first.

    Pixels are weighted by a spline and the share falls over a range of depths: steps would turn a last bit into light.
    """
    gaussians = gaussians.detach()
    axes, shares = gaussians.axes, []
    for each in maps:
        R, t = each.sun.world_to_camera[0, :3, :3], each.sun.world_to_camera[0, :3, 3]
        focal_px, middle_px = each.sun.K[0, 0, 0], each.sun.K[0, 0, 2]
        x, y, depth_m = (gaussians.means @ R.T + t).unbind(dim=1)
        deviation_m = (R[2] @ axes).norm(dim=1)
        unit_m = deviation_m + t[2] / focal_px
        side = len(each.first_m)
        u, v = (
            (focal_px * along / depth_m + middle_px + 2).nan_to_num(1.5).clamp(1.5, side - 1.5)
            for along in (x, y)
        )
        around = torch.tensor([dv * side + du for dv in (-1, 0, 1) for du in (-1, 0, 1)], device=u.device)
        near_m = each.first_m.flatten()[(v.long() * side + u.long())[:, None] + around]
        behind = (depth_m[:, None] - near_m) / unit_m[:, None]
        lit = ((DARK_FROM - behind) / (DARK_FROM - LIT_UNTIL)).clamp(0, 1)
        weight = _spline_weights(v)[:, :, None] * _spline_weights(u)[:, None]
        shares.append((lit * weight.flatten(1)).sum(dim=1))
    return torch.stack(shares)


def _spline_weights(place: Tensor) -> Tensor:
    """Return the weights [N, 3] of the pixel that holds a place [N] px and its neighbours: a quadratic B-spline."""
    off = place - place.floor() - 0.5
    return torch.stack([0.5 * (0.5 - off) ** 2, 0.75 - off**2, 0.5 * (0.5 + off) ** 2], dim=1)
