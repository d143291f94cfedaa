"""Highlights: what a Gaussian mirrors of the Sun, one lobe of the microfacet distribution GGX for each."""

import torch
import torch.nn.functional as F
from torch import Tensor

from obbgs_core.model.cameras import Cameras
from obbgs_core.model.gaussians import Gaussians
from obbgs_core.model.rotations import quats_to_matrices


def highlights(
    gaussians: Gaussians, cameras: Cameras, suns: Tensor | None, sunlit: Tensor | None
) -> Tensor | None:
    """Return the radiance [C, N, channels] that each Gaussian's lobe adds towards each camera; None without lobes.

    Args:
        suns, sunlit: as for `backends.rasterize`.
    """
    if not gaussians.has_highlights:
        return None
    directions = F.normalize(gaussians.means - cameras.centres[:, None], dim=-1)
    return highlights_along(gaussians, directions, None if suns is None else suns[:, None], sunlit)


def highlights_along(
    gaussians: Gaussians, directions: Tensor, sun_dir: Tensor | None, sunlit: Tensor | None
) -> Tensor:
    """Return the radiance [..., N, C] that the lobes add along `directions` [..., N, 3].

    Arguments as of `lighting.radiance_along`, for one camera or, with one more axis at the front, for several.
    """
    if gaussians.shading == "view":
        sun_dir = gaussians.static_sun if len(gaussians.static_sun) else None
    cosine = (brightest_axes(directions, sun_dir) * lobe_axes(gaussians)).sum(dim=-1)
    share = lobe(cosine, gaussians.gloss[0].exp(), sun_dir is not None)
    share = share * gaussians.lobes[:, -1].exp()
    if sunlit is not None:
        share = share * sunlit.to(share)
    share = torch.where(share.isfinite(), share, torch.zeros_like(share))  # what is not finite is not drawn
    return share[..., None] * gaussians.gloss[1:].exp()


def lobe_axes(gaussians: Gaussians) -> Tensor:
    """Return the unit axes [N, 3] of the lobes: each Gaussian's shortest, or the lobe's own."""
    own = gaussians.lobes[:, :-1]
    return F.normalize(own, dim=1) if own.shape[1] else shortest_axes(gaussians)


def shortest_axes(gaussians: Gaussians) -> Tensor:
    """Return the unit axis of each Gaussian's smallest scale [N, 3]; its sign is arbitrary."""
    axes = quats_to_matrices(gaussians.quats)
    shortest = gaussians.log_scales.argmin(dim=1)
    return axes.gather(2, shortest[:, None, None].expand(-1, 3, 1))[..., 0]


def brightest_axes(directions: Tensor, sun_dir: Tensor | None) -> Tensor:
    """Return the axes [..., 3] of lobes seen at their brightest along `directions` [..., 3], camera to Gaussian.

    Without a Sun that is the direction to the camera, otherwise the half vector of camera and Sun, the normal of a
    mirror that shows the Sun.
    """
    if sun_dir is None:
        return -directions
    return F.normalize(sun_dir.detach().to(directions) - directions, dim=-1)


def lobe(cosine: Tensor, alpha: Tensor, half_vector: bool) -> Tensor:
    """Return the GGX distribution over its peak, by the cosine of the angle between a lobe's axis and the brightest.

    With the angle t between half vector and normal, D(t) / D(0) = (a² / (1 + (a² - 1) cos² t))² (Walter et al. 2007).
    A view at the angle u from the direction in which the mirror shows the Sun has t = u/2, exactly in the plane of Sun
    and normal: cos² t = (1 + cos u) / 2. A mirror has two sides.
    """
    cos2 = cosine.square() if half_vector else (1 + cosine) / 2
    alpha2 = alpha.square()
    return (alpha2 / (1 - (1 - alpha2) * cos2).clamp(min=1e-12)).square()
