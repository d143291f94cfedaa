"""Rendering: the function `render`, in compiled C++ or plain PyTorch, with cast shadows where the model has them."""

from torch import Tensor

from obbgs_core.model.cameras import Cameras
from obbgs_core.model.gaussians import Gaussians
from obbgs_core.render.backends import rasterize
from obbgs_core.render.device import DEVICES, backend_for, pictures_at
from obbgs_core.render.moving import at_moments, averaged, repeated
from obbgs_core.render.native import native_kernels
from obbgs_core.render.projection import Projected, project
from obbgs_core.render.rendered import Rendered, ScreenGradients, weighted_gradient
from obbgs_core.render.shadows import lit_from, shadow_map, sunlit_shares

__all__ = [
    "Projected",
    "Rendered",
    "ScreenGradients",
    "backend_for",
    "lit_from",
    "native_kernels",
    "pictures_at",
    "project",
    "render",
    "shadow_map",
    "sunlit_shares",
    "weighted_gradient",
]


def render(
    gaussians: Gaussians,
    cameras: Cameras,
    backend: str = "auto",
    sunlit: Tensor | None = None,
    added: Tensor | None = None,
) -> Rendered:
    """Render radiance, alpha and depth of all cameras, with the highlights of a model that has some.

    Front-to-back compositing on the cameras' background (Kerbl et al. 2023): alpha = min(0.99, opacity·exp(-d²/2)),
    where d is the Mahalanobis distance from the projected mean; contributions under 1/255 are skipped, and a pixel is
    finished before its transmittance would fall below 1e-4. What a pixel averages over is the model's `footprint`;
    where that lowers a Gaussian's peak, it lowers the 1/255 as much. Where the target moves while the shutter is open,
    the images are the mean of three moments, and depths those of the middle one.

    Args:
        backend: `native` (C++, float32), `native-KERNEL` (the same with one of `native_kernels()`), `reference` (plain
            PyTorch, any dtype and device), `cuda` (float32; images stay on the GPU), `warp` (the kernels of `cuda` on
            this processor), or `auto`: native where it can run.
        sunlit: [C, N] visibility of each camera's Sun from each Gaussian, 0..1, only used under Lambert's law; computed
            from shadow maps (`sunlit_shares`) where it is not given.
        added: [C, N, channels] radiance of each Gaussian towards each camera, on top of the model's own.

    Raises:
        ValueError: an unknown backend, or one that is not available here; the model's radiance depends on the Sun's
            direction, and the cameras do not hold it.
    """
    suns = None if gaussians.shading == "view" else cameras.known_suns()
    if gaussians.shading != "lambert":
        sunlit = None
    elif suns is not None and sunlit is None:
        sunlit = sunlit_shares(gaussians, suns, "auto" if backend in DEVICES else backend)
    if cameras.motion is None:
        rendered = rasterize(gaussians, cameras, backend, suns, sunlit, added)
    else:
        of_moments = (repeated(suns), repeated(sunlit), repeated(added))
        rendered = averaged(rasterize(gaussians, at_moments(cameras), backend, *of_moments))
    if cameras.background or cameras.backdrop is not None:
        rendered.radiance = rendered.radiance + (1 - rendered.alpha)[..., None] * cameras.behind
    return rendered
