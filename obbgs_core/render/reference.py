"""The rasterizer in readable PyTorch, for any dtype and device; each compiled kernel is compared with it."""

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from obbgs_core.model.cameras import Cameras
from obbgs_core.model.gaussians import Gaussians
from obbgs_core.render.lighting import radiance_along
from obbgs_core.render.projection import project, with_zeros_for_invalid
from obbgs_core.render.rendered import Rendered, ScreenGradients

# The kernels have the same numbers in kernels/rasterizer.h; a test compares them.
# Fainter contributions are skipped (Kerbl et al. 2023); where a peak is lowered, this is lowered as much, so that the
# same share of the light is cut off at every distance.
MIN_ALPHA = 1 / 255
MAX_ALPHA = 0.99
MIN_TRANSMITTANCE = 1e-4  # a pixel is finished before its transmittance would fall below
MIN_DEPTH_ALPHA = 1e-6  # the depth is 0 where alpha is not above this
BAND_ELEMENTS = 4_000_000  # pixels times Gaussians that are composited at once: bounds the memory


class Splats(NamedTuple):
    """One camera's Gaussians, what compositing takes of them."""

    means2d: Tensor  # [N, 2] px
    factors: Tensor  # [N, 3] px⁻¹, see `Projected`
    opacities: Tensor  # [N]
    cutoffs: Tensor  # [N] alphas below which a contribution is skipped
    depths: Tensor  # [N] m, 0 for those not drawn
    features: Tensor  # [N, F], blended like a colour


# of splats and a picture's width and height, px: image [H, W, F], transmittance [H, W], median depth [H, W] m, and the
# pixels [N] that each splat touches, which may be filled by the backward pass only
Composite = Callable[[Splats, int, int], tuple[Tensor, Tensor, Tensor, Tensor]]


def render_reference(
    gaussians: Gaussians,
    cameras: Cameras,
    suns: Tensor | None,
    sunlit: Tensor | None,
    added: Tensor | None = None,
    composite: Composite | None = None,
) -> Rendered:
    """Render with plain PyTorch; arguments as of `backends.rasterize`.

    Args:
        composite: takes the place of `composite_reference`.
    """
    composite = composite or composite_reference
    projected = project(gaussians, cameras)
    gaussians, _ = with_zeros_for_invalid(gaussians)
    directions = gaussians.means[None] - cameras.centres[:, None]  # [C, N, 3]
    directions = directions / directions.norm(dim=-1, keepdim=True).clamp(min=1e-12)
    channels = gaussians.sh.shape[2]
    screen = ScreenGradients()
    images, alphas, medians = [], [], []
    for c in range(len(cameras)):
        means2d, depths, shares = projected.means2d[c], projected.depths[c], projected.peak_shares[c]
        sun, share = (None if each is None else each[c] for each in (suns, sunlit))
        light = radiance_along(gaussians, directions[c], sun, share)
        if added is not None:
            light = light + added[c]
        splats = Splats(
            means2d,
            projected.factors[c],
            gaussians.opacities * shares,
            MIN_ALPHA * shares.detach(),
            depths,
            torch.cat([light, depths[:, None]], dim=1),
        )
        image, transmittance, median, pixels = composite(splats, cameras.width, cameras.height)
        screen.watch(c, means2d, pixels)
        images.append(image)
        alphas.append(1 - transmittance)
        medians.append(median)
    image, alpha = torch.stack(images), torch.stack(alphas)
    depth = image[..., channels] / alpha.clamp(min=MIN_DEPTH_ALPHA)
    return Rendered(
        radiance=image[..., :channels],
        alpha=alpha,
        depth=torch.where(alpha > MIN_DEPTH_ALPHA, depth, torch.zeros_like(depth)),
        median_depth=torch.stack(medians),
        means2d=projected.means2d,
        radii=projected.radii,
        screen=screen,
    )


def composite_reference(splats: Splats, width: int, height: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Composite one camera's Gaussians front to back, see `Composite`."""
    depths, means2d = splats.depths, splats.means2d
    order = torch.argsort(depths, stable=True)
    order = order[depths[order] > 0]
    rows = max(1, BAND_ELEMENTS // max(1, width * len(order)))
    ys = torch.arange(height, dtype=means2d.dtype, device=means2d.device) + 0.5
    xs = torch.arange(width, dtype=means2d.dtype, device=means2d.device) + 0.5
    k1, k2, k3 = splats.factors[order].unbind(-1)
    bands = []
    for band in ys.split(rows):
        dx = xs[None, :, None] - means2d[order, 0]  # [h, W, N]
        dy = band[:, None, None] - means2d[order, 1]
        power = -0.5 * ((k1 * dx + k2 * dy).square() + (k3 * dy).square())
        alpha = (splats.opacities[order] * power.exp()).clamp(max=MAX_ALPHA)
        alpha = torch.where(alpha >= splats.cutoffs[order], alpha, torch.zeros_like(alpha))
        after = torch.cumprod(1 - alpha, dim=-1)
        alpha = torch.where(after >= MIN_TRANSMITTANCE, alpha, torch.zeros_like(alpha))
        after = torch.cumprod(1 - alpha, dim=-1)
        before = torch.cat([torch.ones_like(after[..., :1]), after[..., :-1]], dim=-1)
        crossing = (before > 0.5) & (after <= 0.5)
        final = after[..., -1].clone() if len(order) else means2d.new_ones(len(band), width)
        median = (crossing * depths[order]).sum(-1).detach()
        bands.append(((alpha * before) @ splats.features[order], final, median))
    image, transmittance, median = (torch.cat(parts) for parts in zip(*bands, strict=True))
    return image, transmittance, median, _pixels_touched(splats)


@torch.no_grad()
def _pixels_touched(splats: Splats) -> Tensor:
    """Return the area [N] px of each ellipse that is not cut off; the kernels count the pixels instead."""
    squared_radius = 2 * torch.log((splats.opacities / splats.cutoffs).clamp(min=1))  # in sigmas
    area = math.pi * squared_radius / (splats.factors[:, 0] * splats.factors[:, 2]).clamp(min=1e-6)
    return torch.where(splats.depths > 0, area, torch.zeros_like(area))
