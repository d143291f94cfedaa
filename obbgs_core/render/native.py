"""The compiled rasterizer (kernels/) as an autograd function of the model's tensors and the camera poses."""

import functools
import logging
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from obbgs_core import compiled
from obbgs_core.model.cameras import Cameras
from obbgs_core.model.footprint import footprint_px2, lowers_peak
from obbgs_core.model.gaussians import TENSORS, Gaussians
from obbgs_core.render.rendered import Rendered, ScreenGradients

log = logging.getLogger(__name__)


@functools.lru_cache(maxsize=1)
def native_kernels() -> tuple[str, ...]:
    """Return `compiled.kernels()`, the one in use first; empty, with one warning, without the compiled module."""
    if not compiled.kernels():
        log.warning("the compiled rasterizer is missing; rendering in plain PyTorch, tens of times slower")
    return compiled.kernels()


def render_native(
    kernel: str,
    gaussians: Gaussians,
    cameras: Cameras,
    suns: Tensor | None,
    sunlit: Tensor | None,
    added: Tensor | None = None,
) -> Rendered:
    """Render with one of `native_kernels()`, in float32 on the CPU; other arguments as of `backends.rasterize`."""
    peak_lowered = lowers_peak(gaussians)
    request = _Request(kernel, cameras, suns, sunlit, peak_lowered, ScreenGradients())
    footprint = footprint_px2(gaussians, cameras)
    stored = [getattr(gaussians, name) for name in TENSORS]
    tensors = (*stored, cameras.world_to_camera, gaussians.ambient, footprint, added)
    images: Any = _Rasterize.apply(request, *tensors)
    return Rendered(*images, screen=request.screen)


@dataclass(frozen=True)
class _Request:
    """What a rendering depends on besides the tensors that have gradients."""

    kernel: str
    cameras: Cameras
    suns: Tensor | None
    sunlit: Tensor | None
    peak_lowered: bool
    screen: ScreenGradients  # filled by the backward pass


class _Rasterize(torch.autograd.Function):
    """Differentiable once; the C++ object keeps what the backward pass needs of the forward pass."""

    @staticmethod
    def forward(
        ctx,
        request: _Request,
        means,
        quats,
        log_scales,
        opacity_logits,
        sh,
        world_to_camera,
        ambient,
        footprint,
        added,
    ):
        cameras = request.cameras
        module = compiled.module_for()
        assert module is not None  # `native_kernels()` would be empty
        rasterization = module.Rasterization(
            kernel=request.kernel,
            width=cameras.width,
            height=cameras.height,
            near_m=cameras.near_m,
            means=_float32(means),
            quats=_float32(quats),
            log_scales=_float32(log_scales),
            opacity_logits=_float32(opacity_logits),
            sh=_float32(sh),
            world_to_camera=_float32(world_to_camera),
            K=_float32(cameras.K),
            sun_dir=None if request.suns is None else _float32(request.suns),
            sunlit=None if request.sunlit is None else _float32(request.sunlit),
            ambient=ambient.item(),
            added=None if added is None else _float32(added),
            footprint_px2=_float32(footprint),
            peak_lowered=request.peak_lowered,
        )
        shape, splats = (len(cameras), cameras.height, cameras.width), (len(cameras), means.shape[0])
        radiance = torch.empty(*shape, sh.shape[2])
        alpha, depth, median_depth = (torch.empty(shape) for _ in range(3))
        means2d, radii = torch.empty(*splats, 2), torch.empty(splats)
        rasterization.forward(
            compiled.threads(),
            radiance,
            alpha,
            depth,
            median_depth,
            means2d,
            radii,
        )
        ctx.set_materialize_grads(False)
        shapes = (means, quats, log_scales, opacity_logits)
        inputs = (*shapes, sh, world_to_camera, ambient, footprint, added)
        ctx.save_for_backward(*inputs, radiance, depth)
        ctx.rasterization, ctx.screen = rasterization, request.screen
        ctx.mark_non_differentiable(median_depth, radii)
        return radiance, alpha, depth, median_depth, means2d, radii

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *grad_outputs: Tensor | None):  # pyright: ignore[reportIncompatibleMethodOverride]
        radiance, alpha, depth, _, means2d, _ = grad_outputs
        *inputs, radiance_image, depth_image = ctx.saved_tensors
        gradients = [None if t is None else torch.empty(t.shape) for t in inputs]
        count, n = inputs[5].shape[0], inputs[0].shape[0]
        screen_means2d, pixels = torch.empty(count, n, 2), torch.empty(count, n)
        ctx.rasterization.backward(
            compiled.threads(),
            radiance_image,
            depth_image,
            *(None if g is None else g.float() for g in (radiance, alpha, depth)),
            None if means2d is None else means2d.float().contiguous(),
            *gradients,
            screen_means2d,
            pixels,
        )
        ctx.screen.means2d.update(enumerate(screen_means2d))
        ctx.screen.pixels.update(enumerate(pixels))
        return None, *(None if g is None else g.to(t.dtype) for g, t in zip(gradients, inputs, strict=True))


def _float32(tensor: Tensor) -> Tensor:
    return tensor.detach().float().contiguous()
