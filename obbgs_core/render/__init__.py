"""One door to rendering: `render`. All of it in our C++, or in plain PyTorch as the truth, or composited by gsplat."""

import dataclasses
import functools
import logging
import math
from dataclasses import dataclass, field

import torch
from torch import Tensor

from obbgs_core import compiled
from obbgs_core.model.cameras import Cameras
from obbgs_core.model.gaussians import Gaussians
from obbgs_core.render.lighting import (
    ShadowMap,
    bare,
    lit_shares,
    normals_towards,
    radiance_along,
    shadow_map_of,
    sun_camera,
    without_sun,
)

log = logging.getLogger(__name__)

DILATION_PX2 = 0.3  # added to the 2D covariance: no Gaussian is thinner than a pixel (Kerbl et al. 2023)
MIN_ALPHA = 1 / 255
MAX_ALPHA = 0.99
MIN_TRANSMITTANCE = 1e-4
FOV_MARGIN = 1.3  # the affine approximation is clamped this far outside the image (Kerbl et al. 2023)


@dataclass
class Projected:
    """Gaussians on each image plane: means2d [C, N, 2] px, conics [C, N, 3] px⁻² (xx, xy, yy), depths [C, N] m."""

    means2d: Tensor
    conics: Tensor
    depths: Tensor  # 0 where the Gaussian is nearer than near_m: such a Gaussian is not drawn
    radii: Tensor  # [C, N] px, three sigma of the longer axis; 0 where not drawn


@dataclass
class Rendered:
    """What `render` returns; images are [C, H, W] or [C, H, W, channels]."""

    radiance: Tensor
    alpha: Tensor
    depth: Tensor  # expected planar depth, m; 0 where nothing is
    median_depth: Tensor  # where half the light is stopped, m; 0 where it never is; no gradient
    means2d: Tensor  # [C, N, 2] px
    radii: Tensor  # [C, N] px
    normals: Tensor | None = None  # [C, H, W, 3] composited, body frame, on request
    screen: "ScreenGradients" = field(default_factory=lambda: ScreenGradients())


@dataclass
class ScreenGradients:
    """Filled by backward: what densification needs; one entry a camera."""

    means2d: dict[int, Tensor] = field(default_factory=dict)  # [N, 2] loss per px
    pixels: dict[int, Tensor] = field(default_factory=dict)  # [N] pixels touched

    def watch(self, camera_index: int, means2d: Tensor, pixels: Tensor) -> None:
        """Record what autograd sends to `means2d` of one camera."""

        def keep(gradient: Tensor | None) -> None:
            if gradient is not None:
                self.means2d[camera_index] = gradient.detach()

        if means2d.requires_grad:
            means2d.register_hook(keep)
            self.pixels[camera_index] = pixels


def render(
    gaussians: Gaussians,
    cameras: Cameras,
    backend: str = "auto",
    normals: bool = False,
    sunlit: Tensor | None = None,
) -> Rendered:
    """Render radiance, alpha, depth and (on request) normals of all cameras.

    Front-to-back compositing of Kerbl et al. 2023 on a black sky: alpha = min(0.99, opacity·exp(-d²/2)), contributions
    under 1/255 skipped, a pixel ends before its transmittance falls below 1e-4.

    Args:
        backend: `native` (C++, float32), `reference` (plain PyTorch, any dtype), `gsplat` (CUDA), or `auto`.
        sunlit: [C, N] share of each camera's Sun that reaches each Gaussian, for a model that obeys Lambert's law and
            a caller that knows it; by default its shadows are cast first (`sunlit_shares`).

    Raises:
        ValueError: an unknown backend, or one that is not available here; the radiance turns with the Sun and the
            cameras do not say where it is.
    """
    suns = None if gaussians.shading == "view" else cameras.known_suns()
    if gaussians.shading != "lambert":
        sunlit = None
    elif suns is not None and sunlit is None:
        sunlit = sunlit_shares(gaussians, suns, backend)
    composite = _backend(backend, gaussians.means)
    if isinstance(composite, str):
        return _render_native(composite, gaussians, cameras, suns, sunlit, normals)
    projected = project(gaussians, cameras)
    gaussians, _ = _repaired(gaussians)
    directions = gaussians.means[None] - cameras.centres[:, None]  # [C, N, 3]
    directions = directions / directions.norm(dim=-1, keepdim=True).clamp(min=1e-12)
    channels = gaussians.sh.shape[2]
    screen = ScreenGradients()
    images, alphas, medians = [], [], []
    for c in range(len(cameras)):
        sun, share = (None if each is None else each[c] for each in (suns, sunlit))
        features = [radiance_along(gaussians, directions[c], sun, share), projected.depths[c][:, None]]
        if normals:
            features.append(normals_towards(gaussians, directions[c]))
        image, transmittance, median = composite(
            projected.means2d[c],
            projected.conics[c],
            gaussians.opacities,
            projected.depths[c],
            torch.cat(features, dim=1),
            cameras,
            screen,
            c,
        )
        images.append(image)
        alphas.append(1 - transmittance)
        medians.append(median)
    image, alpha = torch.stack(images), torch.stack(alphas)
    depth = image[..., channels] / alpha.clamp(min=1e-6)
    return Rendered(
        radiance=image[..., :channels],
        alpha=alpha,
        depth=torch.where(alpha > 1e-6, depth, torch.zeros_like(depth)),
        median_depth=torch.stack(medians),
        means2d=projected.means2d,
        radii=projected.radii,
        normals=image[..., channels + 1 :] if normals else None,
        screen=screen,
    )


@torch.no_grad()
def shadow_map(gaussians: Gaussians, sun_dir: Tensor, backend: str = "auto") -> ShadowMap:
    """Return what the Sun sees from `sun_dir` [3].

    Source: Williams, Casting Curved Shadows on Curved Surfaces, 1978; edges softened as by Reeves et al. 1987.
    """
    shape, device = bare(gaussians), gaussians.means.device
    if device.type != "cpu":  # gsplat gives no median depth: the picture is taken on the CPU
        shape = dataclasses.replace(
            shape, **{name: value.cpu() for name, value in shape.parameters().items()}
        )
        backend = "auto"
    sun = sun_camera(shape, sun_dir.to(shape.means.device))
    surface_m = render(shape, sun, backend).median_depth[0]
    there = dataclasses.replace(sun, world_to_camera=sun.world_to_camera.to(device), K=sun.K.to(device))
    return shadow_map_of(there, surface_m.to(device))


def sunlit_shares(gaussians: Gaussians, sun_dir: Tensor, backend: str = "auto") -> Tensor:
    """Return the share of the Sun that reaches each Gaussian [S, N] from directions [S, 3]."""
    directions, which = sun_dir.unique(dim=0, return_inverse=True)
    return lit_shares(gaussians, [shadow_map(gaussians, each, backend) for each in directions])[which]


def lit_from(gaussians: Gaussians, sun_dir: Tensor | None) -> Gaussians:
    """Return the model as it looks with the Sun towards `sun_dir` [3] (unit, body frame), as `shading.without_sun`.

    Raises:
        ValueError: the radiance turns with the Sun, and no direction is given.
    """
    sunlit = None
    if gaussians.shading == "lambert" and sun_dir is not None:
        sunlit = sunlit_shares(gaussians, sun_dir[None])[0]
    return without_sun(gaussians, sun_dir, sunlit)


def project(gaussians: Gaussians, cameras: Cameras) -> Projected:
    """Project Gaussians onto each image plane by the local affine (EWA) approximation.

    Gaussians nearer than `cameras.near_m`, or not finite, get depth and radius 0 and no gradient, never NaN.

    Source: Zwicker et al., EWA Volume Splatting, 2001.
    """
    gaussians, sound = _repaired(gaussians)
    R, t = cameras.world_to_camera[:, :3, :3], cameras.world_to_camera[:, :3, 3]
    p = torch.einsum("cij,nj->cni", R, gaussians.means) + t[:, None]  # [C, N, 3]
    drawn = sound & (p[..., 2] > cameras.near_m) & torch.isfinite(p).all(dim=-1)
    z = torch.where(drawn, p[..., 2], torch.ones_like(p[..., 2]))
    fx, fy = cameras.K[:, 0, 0, None], cameras.K[:, 1, 1, None]
    cx, cy = cameras.K[:, 0, 2, None], cameras.K[:, 1, 2, None]
    x, y = torch.where(drawn, p[..., 0], 0) / z, torch.where(drawn, p[..., 1], 0) / z
    means2d = torch.stack([fx * x + cx, fy * y + cy], dim=-1)

    limit_x = FOV_MARGIN * torch.maximum(cx, cameras.width - cx) / fx
    limit_y = FOV_MARGIN * torch.maximum(cy, cameras.height - cy) / fy
    x, y = (
        torch.maximum(torch.minimum(x, limit_x), -limit_x),
        torch.maximum(torch.minimum(y, limit_y), -limit_y),
    )
    zero = torch.zeros_like(z)
    J = torch.stack([fx / z, zero, -fx * x / z, zero, fy / z, -fy * y / z], dim=-1).unflatten(-1, (2, 3))
    M = J @ (R[:, None] @ gaussians.axes[None])  # [C, N, 2, 3]; Sigma' = M M^T
    xx = (M[..., 0, :] ** 2).sum(-1) + DILATION_PX2
    xy = (M[..., 0, :] * M[..., 1, :]).sum(-1)
    yy = (M[..., 1, :] ** 2).sum(-1) + DILATION_PX2
    determinant = xx * yy - xy * xy
    drawn = drawn & torch.isfinite(determinant) & (determinant > 0)
    determinant = torch.where(drawn, determinant, torch.ones_like(determinant))
    conics = torch.stack([yy, -xy, xx], dim=-1) / determinant[..., None]
    conics = torch.where(drawn[..., None], conics, torch.zeros_like(conics))
    with torch.no_grad():
        middle = (xx + yy) / 2
        longest = middle + (middle**2 - determinant).clamp(min=0.1).sqrt()
        radii = torch.where(drawn, 3 * longest.sqrt(), 0.0).ceil()
    return Projected(means2d, conics, torch.where(drawn, z, torch.zeros_like(z)), radii)


def _repaired(gaussians: Gaussians) -> tuple[Gaussians, Tensor]:
    """Return the Gaussians with any that hold NaN or infinity set to zeros, and which [N] were sound."""
    numbers = (gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, gaussians.sh)
    sound = torch.stack([torch.isfinite(t).reshape(len(t), -1).all(dim=1) for t in numbers]).all(dim=0)
    tensors = gaussians.tensors().items()
    repaired = {
        n: torch.where(sound.reshape(-1, *[1] * (t.ndim - 1)), t, torch.zeros_like(t)) for n, t in tensors
    }
    return dataclasses.replace(gaussians, **repaired), sound


def _backend(name: str, like: Tensor):
    """Return the compositor of a backend, or the name of a compiled kernel, which renders by itself."""
    if name == "auto":
        if like.is_cuda:
            name = "gsplat"
        else:
            name = "native" if native_kernels() and like.dtype == torch.float32 else "reference"
    if name == "reference":
        return composite_reference
    if name == "gsplat":
        return _composite_gsplat
    kernel = name.removeprefix("native").lstrip("-")
    if name.startswith("native") and (not kernel or kernel in native_kernels()):
        if not native_kernels():
            raise ValueError(
                "the compiled rasterizer is missing: install g++ and python3-dev, then reinstall"
            )
        return kernel or native_kernels()[0]
    raise ValueError(f"backend must be auto, native, reference or gsplat, got {name!r}")


@functools.lru_cache(maxsize=1)
def native_kernels() -> tuple[str, ...]:
    """Return `compiled.kernels()`, the one in use first; empty, and one warning, without the compiled module."""
    if not compiled.kernels():
        log.warning("the compiled rasterizer is missing; rendering in plain PyTorch, tens of times slower")
    return compiled.kernels()


def composite_reference(
    means2d: Tensor,
    conics: Tensor,
    opacities: Tensor,
    depths: Tensor,
    features: Tensor,
    cameras: Cameras,
    screen: ScreenGradients | None = None,
    camera_index: int = 0,
) -> tuple[Tensor, Tensor, Tensor]:
    """Composite one camera's Gaussians in readable PyTorch: the truth that every kernel is compared with.

    Returns:
        image [H, W, F], transmittance [H, W], median depth [H, W].
    """
    order = torch.argsort(depths, stable=True)
    order = order[depths[order] > 0]
    rows = max(1, 4_000_000 // max(1, cameras.width * len(order)))  # bounds the memory
    ys = torch.arange(cameras.height, dtype=means2d.dtype, device=means2d.device) + 0.5
    xs = torch.arange(cameras.width, dtype=means2d.dtype, device=means2d.device) + 0.5
    parts = []
    for band in ys.split(rows):
        dx = xs[None, :, None] - means2d[order, 0]  # [h, W, N]
        dy = band[:, None, None] - means2d[order, 1]
        a, b, c = conics[order].unbind(-1)
        power = -0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy
        alpha = (opacities[order] * power.clamp(max=0).exp()).clamp(max=MAX_ALPHA)
        alpha = torch.where(alpha >= MIN_ALPHA, alpha, torch.zeros_like(alpha))
        after = torch.cumprod(1 - alpha, dim=-1)
        alpha = torch.where(after >= MIN_TRANSMITTANCE, alpha, torch.zeros_like(alpha))
        after = torch.cumprod(1 - alpha, dim=-1)
        before = torch.cat([torch.ones_like(after[..., :1]), after[..., :-1]], dim=-1)
        crossing = (before > 0.5) & (after <= 0.5)
        final = after[..., -1].clone() if len(order) else torch.ones(dx.shape[:2], dtype=means2d.dtype)
        median = (crossing * depths[order]).sum(-1).detach()
        parts.append(((alpha * before) @ features[order], final, median))
    image, transmittance, median = (torch.cat(p) for p in zip(*parts, strict=True))
    if screen is not None:
        screen.watch(camera_index, means2d, _pixels_touched(means2d, conics, opacities, depths))
    return image, transmittance, median


@torch.no_grad()
def _pixels_touched(means2d: Tensor, conics: Tensor, opacities: Tensor, depths: Tensor) -> Tensor:
    """Return the area [N] px of each ellipse alpha >= 1/255: the reference's stand-in for the kernel's exact count."""
    q = 2 * torch.log((opacities / MIN_ALPHA).clamp(min=1))
    determinant = (conics[:, 0] * conics[:, 2] - conics[:, 1] ** 2).clamp(min=1e-12)
    return torch.where(depths > 0, math.pi * q / determinant.sqrt(), torch.zeros_like(q))


def _render_native(
    kernel: str,
    gaussians: Gaussians,
    cameras: Cameras,
    suns: Tensor | None,
    sunlit: Tensor | None,
    normals: bool,
) -> Rendered:
    screen = ScreenGradients()
    tensors = (*gaussians.tensors().values(), cameras.world_to_camera, gaussians.ambient)
    images = _Native.apply(*tensors, cameras, suns, sunlit, kernel, normals, screen)
    radiance, alpha, depth, median_depth, means2d, radii, *more = images
    return Rendered(radiance, alpha, depth, median_depth, means2d, radii, more[0] if more else None, screen)


class _Native(torch.autograd.Function):
    """The C++ rasterizer as an autograd function of the model's tensors and the camera poses."""

    @staticmethod
    def forward(
        ctx,
        means,
        quats,
        log_scales,
        opacity_logits,
        sh,
        world_to_camera,
        ambient,
        cameras,
        sun_dir,
        sunlit,
        kernel,
        normals,
        screen,
    ):
        inputs = (means, quats, log_scales, opacity_logits, sh, world_to_camera, ambient)
        arrays = [t.detach().float().contiguous() for t in (*inputs[:6], cameras.K)]
        arrays += [None if each is None else each.detach().float().contiguous() for each in (sun_dir, sunlit)]
        count, n, height, width = len(cameras), means.shape[0], cameras.height, cameras.width
        radiance = torch.empty(count, height, width, sh.shape[2])
        alpha, depth, median_depth = (torch.empty(count, height, width) for _ in range(3))
        means2d, radii = torch.empty(count, n, 2), torch.empty(count, n)
        normal_images = [torch.empty(count, height, width, 3)] if normals else []
        module = compiled.module_for()
        assert module is not None  # a kernel's name comes from it
        rasterization = module.Rasterization(kernel, width, height, cameras.near_m, *arrays, ambient.item())
        rasterization.forward(
            torch.get_num_threads(),
            radiance,
            alpha,
            depth,
            median_depth,
            normal_images[0] if normals else None,
            means2d,
            radii,
        )
        ctx.set_materialize_grads(False)
        ctx.save_for_backward(*inputs, radiance, depth, *normal_images)
        ctx.rasterization, ctx.screen = rasterization, screen
        ctx.mark_non_differentiable(median_depth, radii)
        return radiance, alpha, depth, median_depth, means2d, radii, *normal_images

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, radiance, alpha, depth, median_depth, means2d, radii, normals=None):
        inputs, images = ctx.saved_tensors[:7], ctx.saved_tensors[7:]
        gradients = [torch.empty(t.shape) for t in inputs]
        count, n = inputs[5].shape[0], inputs[0].shape[0]
        screen_means2d, pixels = torch.empty(count, n, 2), torch.empty(count, n)
        ctx.rasterization.backward(
            torch.get_num_threads(),
            images[0],
            images[1],
            images[2] if len(images) > 2 else None,
            *(None if g is None else g.float() for g in (radiance, alpha, depth, normals)),
            None if means2d is None else means2d.float().contiguous(),
            *gradients,
            screen_means2d,
            pixels,
        )
        ctx.screen.means2d.update(enumerate(screen_means2d))
        ctx.screen.pixels.update(enumerate(pixels))
        return *(g.to(t.dtype) for g, t in zip(gradients, inputs, strict=True)), *[None] * 6


def _composite_gsplat(means2d, conics, opacities, depths, features, cameras, screen, camera_index):
    """Composite on a CUDA device with gsplat's own tile kernel."""
    try:
        from gsplat import (  # pyright: ignore[reportMissingImports]
            isect_offset_encode,
            isect_tiles,
            rasterize_to_pixels,
        )
    except ImportError as error:
        raise ValueError("backend gsplat needs a CUDA device and the gsplat package") from error
    tile = 16
    tiles_x, tiles_y = -(-cameras.width // tile), -(-cameras.height // tile)
    determinant = (conics[:, 0] * conics[:, 2] - conics[:, 1] ** 2).clamp(min=1e-12)
    reach = (2 * torch.log((opacities / MIN_ALPHA).clamp(min=1))).sqrt()
    radii = torch.stack(
        [(conics[:, 2] / determinant).sqrt() * reach, (conics[:, 0] / determinant).sqrt() * reach], -1
    )
    radii = torch.where(depths[:, None] > 0, radii.ceil(), 0).int()
    _, ids, flat = isect_tiles(means2d[None], radii[None], depths[None], tile, tiles_x, tiles_y)
    offsets = isect_offset_encode(ids, 1, tiles_x, tiles_y)
    image, alpha = rasterize_to_pixels(
        means2d[None],
        conics[None],
        features[None],
        opacities[None],
        cameras.width,
        cameras.height,
        tile,
        offsets,
        flat,
    )
    screen.watch(camera_index, means2d, _pixels_touched(means2d, conics, opacities, depths))
    transmittance = 1 - alpha[0, ..., 0]
    return image[0], transmittance, torch.zeros_like(transmittance)
