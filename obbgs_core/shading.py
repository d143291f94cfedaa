"""How Gaussians shine: harmonics of the view or of the Sun, or Lambert's law with a normal and cast shadows."""

import dataclasses

import torch
import torch.nn.functional as F
from torch import Tensor

from obbgs_core.cameras import Cameras
from obbgs_core.gaussians import Gaussians
from obbgs_core.rotations import quats_to_matrices
from obbgs_core.sh import C0, fit, from_radiance, radiance, sh_basis, softplus

HALF_LIT = 2.0  # albedo of a Gaussian, over its mean radiance as the Sun goes round
FIRST_AMBIENT = 0.02
SHADOW_MAP_PX = 256  # along a side of the picture that the Sun takes
SUN_DISTANCE = 1000.0  # in radii of the model: its rays are parallel to 0.06 degrees
SOLID_SHARE = 0.99  # of the centres: what strays farther out casts no shadow
SHADOW_BIAS = (
    3.0  # pixels of that picture, and deviations of the Gaussian towards the Sun: it does not shade itself
)


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
    albedo = from_radiance(
        HALF_LIT * radiance(gaussians.sh.detach()[:, :1], torch.zeros_like(gaussians.means))
    )
    ambient = torch.tensor(FIRST_AMBIENT)
    return dataclasses.replace(gaussians, sh=albedo[:, None], shading="lambert", ambient=ambient)


def normals_towards(gaussians: Gaussians, directions: Tensor) -> Tensor:
    """Return each Gaussian's shortest axis [N, 3], turned against `directions` [N, 3]: to the camera's side."""
    axes = quats_to_matrices(gaussians.quats)
    shortest = gaussians.log_scales.argmin(dim=1)
    normal = axes.gather(2, shortest[:, None, None].expand(-1, 3, 1))[..., 0]
    return -normal * torch.sign((normal * directions).sum(-1, keepdim=True))


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
        return dataclasses.replace(
            gaussians, sh=(basis[0, :, None] * gaussians.sh).sum(dim=1, keepdim=True) / C0, shading="view"
        )
    directions, to_coefficients = fit(4)
    seen = [radiance_along(gaussians, d.expand(len(gaussians), 3), sun_dir, sunlit) for d in directions]
    before_softplus = C0 * from_radiance(torch.stack(seen, dim=1))
    return dataclasses.replace(
        gaussians, sh=torch.einsum("kd,ndc->nkc", to_coefficients, before_softplus), shading="view"
    )


def bare(gaussians: Gaussians) -> Gaussians:
    """Return the same shapes with a constant radiance, for those who ask for depths only; without gradient."""
    return dataclasses.replace(gaussians.detach(), sh=gaussians.sh.detach()[:, :1], shading="view")


def solid_ball(gaussians: Gaussians) -> tuple[Tensor, float]:
    """Return the centre [3] and the radius, m, of what casts shadows: nearly all of the centres, and some room."""
    means = gaussians.means.detach()
    means = means[means.isfinite().all(dim=1)]
    if len(means) == 0:
        return means.new_zeros(3), 1.0
    centre = (means.quantile(1 - SOLID_SHARE, dim=0) + means.quantile(SOLID_SHARE, dim=0)) / 2
    return centre, max(1e-6, 1.1 * float((means - centre).norm(dim=1).quantile(SOLID_SHARE)))


def sun_cameras(gaussians: Gaussians, sun_dir: Tensor) -> Cameras:
    """Return cameras that see the whole model from where the Sun is, one for each of its directions [S, 3]."""
    centre, radius = solid_ball(gaussians)
    distance_m, half_px = SUN_DISTANCE * radius, SHADOW_MAP_PX / 2
    forward = -F.normalize(sun_dir.detach().to(centre), dim=1)
    aside = torch.where(
        forward[:, :1].abs() < 0.9, centre.new_tensor([1.0, 0, 0]), centre.new_tensor([0, 1.0, 0])
    )
    right = F.normalize(torch.linalg.cross(aside, forward), dim=1)
    R = torch.stack([right, torch.linalg.cross(forward, right), forward], dim=1)
    pose = torch.eye(4).to(centre).repeat(len(R), 1, 1)
    pose[:, :3, :3] = R
    pose[:, :3, 3] = -(R @ (centre - distance_m * forward)[..., None])[..., 0]
    focal_px = half_px * SUN_DISTANCE
    K = centre.new_tensor([[focal_px, 0, half_px], [0, focal_px, half_px], [0, 0, 1]])
    return Cameras(pose, K.expand(len(R), 3, 3), SHADOW_MAP_PX, SHADOW_MAP_PX)


def lit_shares(gaussians: Gaussians, suns: Cameras, means2d: Tensor, surface_m: Tensor) -> Tensor:
    """Return the share of the Sun that reaches each Gaussian [S, N]: of nine pixels around it, where it lies first.

    Args:
        suns: of `sun_cameras`; means2d [S, N, 2] px and the surface's depths [S, H, W] m (0: none) in their pictures.
    """
    R, t = suns.world_to_camera[:, :3, :3], suns.world_to_camera[:, :3, 3]
    depth_m = (gaussians.means.detach() @ R[:, 2, :, None])[..., 0] + t[:, 2:]  # [S, N]
    axes = torch.einsum("si,nij->snj", R[:, 2], quats_to_matrices(gaussians.quats.detach()))
    deviation_m = (axes * gaussians.scales.detach()).norm(dim=2)
    pixel_m = t[:, 2:] / suns.K[:, 0, :1]
    before_m = depth_m - SHADOW_BIAS * (deviation_m + pixel_m)
    first_m = F.pad(torch.where(surface_m > 0, surface_m, torch.inf), (2, 2, 2, 2), value=torch.inf)
    columns, rows = first_m.shape[2], first_m.shape[1]
    u, v = (means2d.nan_to_num(-1e6).floor() + 2).unbind(dim=2)
    u, v = u.clamp(1, columns - 2).long(), v.clamp(1, rows - 2).long()  # outside the picture all is lit
    around = [
        first_m.flatten(1).gather(1, (v + dv) * columns + u + du) >= before_m
        for dv in (-1, 0, 1)
        for du in (-1, 0, 1)
    ]
    return torch.stack(around).float().mean(dim=0)
