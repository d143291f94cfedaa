"""Chooses the rasterizer: the compiled one where it can run, else the reference in plain PyTorch."""

import torch
from torch import Tensor

from obbgs_core.model.cameras import Cameras
from obbgs_core.model.gaussians import Gaussians
from obbgs_core.render.device import DEVICES, render_on_device
from obbgs_core.render.highlights import highlights
from obbgs_core.render.native import native_kernels, render_native
from obbgs_core.render.reference import render_reference
from obbgs_core.render.rendered import Rendered


def rasterize(
    gaussians: Gaussians,
    cameras: Cameras,
    backend: str,
    suns: Tensor | None = None,
    sunlit: Tensor | None = None,
    added: Tensor | None = None,
) -> Rendered:
    """Render with a known illumination, by the backend of this name (see `render`).

    Args:
        suns: [C, 3] unit vectors towards the Sun, body frame; None for a model of shading `view`.
        sunlit: [C, N] visibility of each camera's Sun from each Gaussian, for a model of shading `lambert`, else None.
        added: [C, N, channels] radiance of each Gaussian towards each camera, on top of the model's own; or None.

    Raises:
        ValueError: an unknown backend, or one that is not available here.
    """
    if backend in DEVICES:
        return render_on_device(backend, gaussians, cameras, suns, sunlit, added)
    kernel = _kernel(backend, gaussians.means)
    if kernel is None:
        return render_reference(gaussians, cameras, suns, sunlit, added)
    shine = highlights(gaussians, cameras, suns, sunlit)  # the kernels know harmonics and Lambert's law
    if shine is not None:
        added = shine if added is None else shine + added
    return render_native(kernel, gaussians, cameras, suns, sunlit, added)


def _kernel(backend: str, like: Tensor) -> str | None:
    """Return the compiled kernel that a backend runs on tensors like this one; None for the reference."""
    if backend == "reference":
        return None
    if backend == "auto":
        runs_native = like.dtype == torch.float32 and like.device.type == "cpu" and native_kernels()
        return native_kernels()[0] if runs_native else None
    name, _, kernel = backend.partition("-")
    if name == "native" and not native_kernels():
        raise ValueError("the compiled rasterizer is missing: install g++ and python3-dev, then reinstall")
    if backend == "native":
        return native_kernels()[0]
    if name == "native" and kernel in native_kernels():
        return kernel
    known = ", ".join(
        ["auto", "native", *(f"native-{each}" for each in native_kernels()), "reference", *DEVICES]
    )
    raise ValueError(f"backend must be one of {known}, got {backend!r}")
