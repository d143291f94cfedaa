"""Rendering on a GPU: PyTorch's projection and radiance there, and Warp's kernels for what is done pixel by pixel.

The package `warp-lang` comes with the extra `gpu`. The model stays in main memory, where it is trained; its tensors are
copied at each rendering, and gradients flow back. Pictures stay on the device.
"""

import contextlib
import dataclasses
import functools
import importlib.util
from types import ModuleType
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.autograd.function import once_differentiable

from obbgs_core.model.cameras import Cameras
from obbgs_core.model.gaussians import Gaussians
from obbgs_core.render.reference import Splats, render_reference
from obbgs_core.render.rendered import Rendered

# where each of these backends of `render` leaves its pictures; `warp` runs the kernels of `cuda` on this processor
DEVICES = {"cuda": "cuda", "warp": "cpu"}
FEATURES = 4  # that a pixel composites: radiance in up to three channels, and the depth


def backend_for(device: str) -> str:
    """Return the backend of `render` for a device: auto (a GPU where one can be used), cpu, cuda or warp.

    Raises:
        ValueError: it cannot be used here; the message says what is missing.
    """
    missing = _missing(device)
    if device == "cpu" or (device == "auto" and missing):
        return "auto"
    if missing:
        raise ValueError(f"device={device} cannot be used: {missing}; device=cpu always can")
    return "cuda" if device == "auto" else device


def _missing(device: str) -> str:
    """Return what a device lacks, in words; nothing where it can be used."""
    if device != "warp" and not torch.cuda.is_available():
        return "PyTorch finds no CUDA device"
    if importlib.util.find_spec("warp") is None:
        return "the package warp-lang is not installed (pip install 'obbgs[gpu]')"
    return ""


def pictures_at(backend: str) -> torch.device:
    """Return where the pictures are that a backend renders."""
    return torch.device(DEVICES.get(backend, "cpu"))


def render_on_device(
    backend: str,
    gaussians: Gaussians,
    cameras: Cameras,
    suns: Tensor | None,
    sunlit: Tensor | None,
    added: Tensor | None = None,
) -> Rendered:
    """Render by one of `DEVICES`, in float32; other arguments as of `backends.rasterize`.

    The images are on the device, means, radii and screen-space gradients in main memory.
    """
    device = pictures_at(backend)

    def there(tensor: Tensor | None) -> Any:
        return None if tensor is None else tensor.to(device, torch.float32)

    tensors = gaussians.parameters() | {"static_sun": gaussians.static_sun}
    moved = dataclasses.replace(gaussians, **{name: there(tensor) for name, tensor in tensors.items()})
    seen = dataclasses.replace(
        cameras, world_to_camera=there(cameras.world_to_camera), K=there(cameras.K), backdrop=None
    )
    rendered = render_reference(moved, seen, there(suns), there(sunlit), there(added), composite)
    rendered.means2d, rendered.radii = rendered.means2d.to("cpu"), rendered.radii.to("cpu")
    rendered.screen.home = torch.device("cpu")
    return rendered


def composite(splats: Splats, width: int, height: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Composite one camera's splats by Warp's kernels, see `reference.Composite`; pixels are counted exactly."""
    features = F.pad(splats.features, (0, FEATURES - splats.features.shape[1]))
    pixels = torch.zeros_like(splats.depths)
    image, transmittance, median = _Composite.apply(*splats[:5], features, width, height, pixels)  # pyright: ignore
    return image[..., : splats.features.shape[1]], transmittance, median, pixels


class _Composite(torch.autograd.Function):
    """Differentiable once."""

    @staticmethod
    def forward(ctx, means2d, factors, opacities, cutoffs, depths, features, width, height, pixels):
        order = torch.argsort(depths, stable=True)
        order = order[depths[order] > 0]
        of_drawn = [t[order].contiguous() for t in (means2d, factors, opacities, cutoffs, depths, features)]
        launch = _Launch(width, height, of_drawn)
        ends = launch.counts().cumsum(0, dtype=torch.int32)
        tiles, splats = launch.listed(ends)
        sorted_tiles, pairs = torch.sort(tiles, stable=True)  # pairs were listed by depth
        first = torch.arange(launch.tiles + 1, device=tiles.device, dtype=tiles.dtype)
        pairs = pairs.int()
        begins = torch.searchsorted(sorted_tiles, first, out_int32=True)
        image, transmittance, median, lasts = launch.composited(begins, pairs, splats)
        ctx.set_materialize_grads(False)
        ctx.save_for_backward(*of_drawn, order, ends, splats, pairs, begins, image, transmittance, lasts)
        ctx.size, ctx.pixels = (width, height), pixels
        ctx.mark_non_differentiable(median)
        return image, transmittance, median

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grad_outputs: Tensor | None):  # pyright: ignore[reportIncompatibleMethodOverride]
        by_image, by_transmittance, _ = grad_outputs
        width, height = ctx.size
        *of_drawn, order, ends, splats, pairs, begins, image, transmittance, lasts = ctx.saved_tensors
        by_image = torch.zeros_like(image) if by_image is None else by_image.float().contiguous()
        behind = (by_image * image).sum(dim=-1)
        if by_transmittance is not None:
            behind = behind + by_transmittance * transmittance
        launch = _Launch(width, height, of_drawn)
        gradients = launch.gradients(
            begins, pairs, splats, lasts, by_image, behind.float().contiguous(), ends
        )
        by_splat = gradients.new_zeros(len(ctx.pixels), gradients.shape[1])
        by_splat[order] = gradients
        ctx.pixels.copy_(by_splat[:, 10])
        by_means, by_factors, by_opacities, by_features = by_splat[:, :10].split([2, 3, 1, FEATURES], dim=1)
        return by_means, by_factors, by_opacities[:, 0], None, None, by_features, None, None, None


@functools.cache
def _kernels() -> ModuleType:
    """Return the module of the kernels; Warp compiles them when they are first launched, for some seconds."""
    import warp as wp  # pyright: ignore[reportMissingImports]

    wp.config.log_level = wp.LOG_WARNING  # it would print what it finds and compiles
    wp.init()
    from obbgs_core.render import device_kernels

    return device_kernels


class _Launch:
    """The kernels on one camera's splats [S], those that are drawn, by depth; tensors in and out, on their device."""

    def __init__(self, width: int, height: int, splats: list[Tensor]):
        import warp as wp  # pyright: ignore[reportMissingImports]

        self._wp, self._kernels, self._device = wp, _kernels(), splats[0].device
        self._size, self._count = (height, width), len(splats[0])
        side = self._kernels.TILE_PX
        self._splats = s = self._kernels.Splats()
        s.across, s.down = -(-width // side), -(-height // side)
        self.tiles = s.across * s.down
        types = (wp.vec2, wp.vec3, wp.float32, wp.float32, wp.float32, wp.vec4)
        s.means2d, s.factors, s.opacities, s.cutoffs, s.depths, s.features = (
            wp.from_torch(t, dtype=of) for t, of in zip(splats, types, strict=True)
        )

    def counts(self) -> Tensor:
        """Return how many tiles [S] each splat touches."""
        counts = torch.zeros(self._count, dtype=torch.int32, device=self._device)
        self._run(self._kernels.count_tiles, self._count, counts)
        return counts

    def listed(self, ends: Tensor) -> tuple[Tensor, Tensor]:
        """Return the tile and the splat of each pair, splat by splat; `ends` [S] is the running sum of the counts."""
        count = int(ends[-1]) if self._count else 0
        tiles, splats = (torch.empty(count, dtype=torch.int32, device=self._device) for _ in range(2))
        self._run(self._kernels.list_tiles, self._count, ends, tiles, splats)
        return tiles, splats

    def composited(
        self, begins: Tensor, pairs: Tensor, splats: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return image [H, W, 4], transmittance, median depth, and where in `pairs` each pixel ended [H, W]."""
        image = torch.empty(*self._size, FEATURES, device=self._device)
        transmittance, median = (torch.empty(self._size, device=self._device) for _ in range(2))
        lasts = torch.empty(self._size, dtype=torch.int32, device=self._device)
        places = (begins, pairs, splats, (image, self._wp.vec4), transmittance, median, lasts)
        self._run(self._kernels.composite, self.tiles * self._kernels.LANES, *places)
        return image, transmittance, median, lasts

    def gradients(
        self,
        begins: Tensor,
        pairs: Tensor,
        splats: Tensor,
        lasts: Tensor,
        by_image: Tensor,
        behind: Tensor,
        ends: Tensor,
    ) -> Tensor:
        """Return the gradient [S, 11] by each splat, its numbers in the order of `device_kernels.GRADIENT`."""
        kernels, numbers = self._kernels, self._kernels.Gradient
        of_pairs = torch.zeros(len(pairs), kernels.GRADIENT, device=self._device)
        of_splats = torch.empty(self._count, kernels.GRADIENT, device=self._device)
        places = (begins, pairs, splats, lasts, (by_image, self._wp.vec4), behind, (of_pairs, numbers))
        self._run(kernels.composite_backward, self.tiles * kernels.LANES, *places)
        sums = (ends, (of_pairs, numbers), (of_splats, numbers))
        self._run(kernels.add_up, self._count, *sums, with_splats=False)
        return of_splats

    def _run(self, kernel, threads: int, *arrays: Any, with_splats: bool = True) -> None:
        """Launch a kernel with the splats and some tensors, those of vectors with their type, on PyTorch's stream."""
        given = [
            self._wp.from_torch(a[0], dtype=a[1]) if isinstance(a, tuple) else self._wp.from_torch(a)
            for a in arrays
        ]
        on_stream = contextlib.nullcontext()
        if self._device.type == "cuda":
            on_stream = self._wp.ScopedStream(
                self._wp.stream_from_torch(torch.cuda.current_stream(self._device))
            )
        with on_stream:
            self._wp.launch(
                kernel,
                dim=threads,
                inputs=[self._splats, *given] if with_splats else given,
                device=self._wp.device_from_torch(self._device),
                block_dim=self._kernels.LANES,
            )
