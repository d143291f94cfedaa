"""The radiance of Gaussians: harmonics of the viewing direction or of the Sun's, or Lambert's law."""

import dataclasses

import torch
import torch.nn.functional as F
from torch import Tensor

from obbgs_core.model.cameras import Cameras
from obbgs_core.model.gaussians import Gaussians
from obbgs_core.model.sh import C0, fit, from_radiance, radiance, sh_basis, softplus
from obbgs_core.render.highlights import highlights_along, shortest_axes

INITIAL_ALBEDO = 2.0  # over a Gaussian's mean radiance: half of the Suns, about, shine on its other side
INITIAL_AMBIENT = 0.02  # in units of the Sun's light


def radiance_along(
    gaussians: Gaussians, directions: Tensor, sun_dir: Tensor | None = None, sunlit: Tensor | None = None
) -> Tensor:
    """Return each Gaussian's radiance [N, C] along `directions` [N, 3] (unit, camera to Gaussian), highlights included.

    Args:
        sun_dir: [3] unit, body frame; needed unless the shading is `view`.
        sunlit: [N] visibility of the Sun from each Gaussian, 0..1; needed if the shading is `lambert`.
    """
    if gaussians.has_highlights:
        matt = radiance_along(gaussians.matt(), directions, sun_dir, sunlit)
        return matt + highlights_along(gaussians, directions, sun_dir, sunlit)
    if gaussians.shading == "view":
        return radiance(gaussians.sh, directions)
    assert sun_dir is not None  # the callers check it
    sun_dir = sun_dir.detach().to(directions)
    if gaussians.shading == "sun":
        return radiance(gaussians.sh, sun_dir.expand(len(gaussians), 3))
    assert sunlit is not None
    light = softplus((normals_towards(gaussians, directions) * sun_dir).sum(dim=1)) * sunlit.to(directions)
    albedo = radiance(gaussians.sh, sun_dir.expand(len(gaussians), 3))
    return albedo * (light + gaussians.ambient)[:, None]


def lambertian(gaussians: Gaussians) -> Gaussians:
    """Return the Gaussians with shading `lambert`: albedos under which they look like their constant radiance."""
    constant = radiance(gaussians.sh.detach()[:, :1], torch.zeros_like(gaussians.means))
    albedo, ambient = from_radiance(INITIAL_ALBEDO * constant), torch.tensor(INITIAL_AMBIENT)
    return dataclasses.replace(gaussians, sh=albedo[:, None], shading="lambert", ambient=ambient)


def normals_towards(gaussians: Gaussians, directions: Tensor) -> Tensor:
    """Return each Gaussian's shortest axis [N, 3], its sign such that it points against `directions` [N, 3]."""
    normal = shortest_axes(gaussians)
    return -normal * torch.sign((normal * directions).sum(-1, keepdim=True))


def mean_radiance(gaussians: Gaussians, cameras: Cameras) -> Tensor:
    """Return each Gaussian's radiance [N, C] averaged over some cameras, without shadows.

    With shading `view` it is the mean over all directions instead, the harmonic of degree 0.

    Raises:
        ValueError: the radiance depends on the Sun's direction, and the cameras do not hold it.
    """
    if gaussians.shading == "view":
        return radiance(gaussians.sh[:, :1], torch.zeros_like(gaussians.means))
    suns, total = cameras.known_suns(), torch.zeros(len(gaussians), gaussians.sh.shape[2])
    for centre, sun_dir in zip(cameras.centres, suns, strict=True):
        directions = F.normalize(gaussians.means - centre, dim=1)
        total += radiance_along(gaussians, directions, sun_dir, torch.ones(len(gaussians)))
    return total / len(cameras)


def without_sun(gaussians: Gaussians, sun_dir: Tensor | None, sunlit: Tensor | None) -> Gaussians:
    """Return the model as it looks with the Sun towards `sun_dir` [3], in harmonics of the view alone.

    Exact for shading `sun`. Under Lambert's law the two sides of a Gaussian differ: harmonics of degree 1 are fitted.
    Highlights become harmonics of degree 3, far wider and fainter than they are.

    Args:
        sunlit: [N], as for `radiance_along`.

    Raises:
        ValueError: the radiance depends on the Sun's direction, and none is given.
    """
    if gaussians.shading == "view" and not gaussians.has_highlights:
        return gaussians
    if gaussians.shading != "view" and sun_dir is None:
        raise ValueError("the model's radiance turns with the Sun: give sun_dir, the Sun's direction")
    if sun_dir is not None and gaussians.shading == "sun" and not gaussians.has_highlights:
        return dataclasses.replace(gaussians, sh=constant_towards(gaussians, sun_dir), shading="view")
    directions, to_coefficients = fit(16 if gaussians.has_highlights else 4)
    seen = [radiance_along(gaussians, d.expand(len(gaussians), 3), sun_dir, sunlit) for d in directions]
    before_softplus = C0 * from_radiance(torch.stack(seen, dim=1))
    fitted = torch.einsum("kd,ndc->nkc", to_coefficients, before_softplus)
    return dataclasses.replace(gaussians.matt(), sh=fitted, shading="view")


def constant_towards(gaussians: Gaussians, sun_dir: Tensor) -> Tensor:
    """Return the coefficients [N, 1, C] of the constant that harmonics of the Sun's direction are at `sun_dir` [3]."""
    basis = sh_basis(sun_dir.reshape(1, 3).to(gaussians.sh), gaussians.sh.shape[1])
    return (basis[0, :, None] * gaussians.sh).sum(dim=1, keepdim=True) / C0


def constant_radiance(gaussians: Gaussians) -> Gaussians:
    """Return the same shapes, without gradient, with a constant radiance: enough to render depths, and cheaper."""
    return dataclasses.replace(gaussians.detach().matt(), sh=gaussians.sh.detach()[:, :1], shading="view")
