"""What rendering returns: images, projected means, and the screen-space gradients that densification needs."""

from dataclasses import dataclass, field

import torch
from torch import Tensor


@dataclass
class ScreenGradients:
    """Screen-space facts of each Gaussian, by camera index; empty until the backward pass has filled them."""

    means2d: dict[int, Tensor] = field(
        default_factory=dict
    )  # [N, 2] gradient by the projected mean, loss per px
    pixels: dict[int, Tensor] = field(default_factory=dict)  # [N] pixels to which the Gaussian contributes
    home: torch.device | None = None  # where gradients are kept that `watch` records; None: where they arise

    def watch(self, camera_index: int, means2d: Tensor, pixels: Tensor) -> None:
        """Record the gradient that autograd computes for the projected means [N, 2] of one camera."""

        def keep(gradient: Tensor | None) -> None:
            if gradient is not None:
                self.means2d[camera_index] = gradient.detach().to(self.home or gradient.device)
                self.pixels[camera_index] = pixels.to(self.home or pixels.device)

        if means2d.requires_grad:
            means2d.register_hook(keep)


@dataclass
class Rendered:
    """Images of C cameras and what the Gaussians look like on them."""

    radiance: Tensor  # [C, H, W, channels] scene-linear
    alpha: Tensor  # [C, H, W] 0..1
    depth: Tensor  # [C, H, W] m, expected planar depth; 0 where nothing is drawn
    median_depth: (
        Tensor  # [C, H, W] m, where the transmittance falls to one half; 0 where it never does; no gradient
    )
    means2d: Tensor  # [C, N, 2] px
    radii: Tensor  # [C, N] px
    screen: ScreenGradients = field(default_factory=ScreenGradients)


def weighted_gradient(image: Tensor, weights: Tensor, parameter: Tensor, keep_graph: bool = False) -> Tensor:
    """Return the gradient of the sum of an image times weights of its shape by a parameter, in the parameter's shape.

    PyTorch takes the weights as `grad_outputs` too, but then imports its symbolic shapes first, for a second.
    """
    (gradient,) = torch.autograd.grad((image * weights).sum(), parameter, retain_graph=keep_graph)
    return gradient
