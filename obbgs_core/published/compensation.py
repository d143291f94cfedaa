"""Exposure compensation: an affine map of the colours of each training frame, learnt with the model.

Source: the authors' later code of 3DGS (Kerbl et al., October 2024), after the learnt appearance of Martin-Brualla et
al., NeRF in the Wild, 2021.
"""

import math

import torch
from torch import Tensor

RATE, RATE_END = 0.01, 0.001  # a step, at the first and at the last; exponential between them
BETAS, EPS = (0.9, 0.999), 1e-8  # of Adam


class Compensation:
    """Maps `value` [F, C, C + 1] from rendered colours to those of each frame: a matrix and an offset in full scales.

    Colours of black are 0 and of full scale 1. The maps start as identities. Nothing ties their common gain to the
    model's radiance, as in the publication.
    """

    def __init__(self, frames: int, channels: int):
        self.value = torch.eye(channels, channels + 1).repeat(frames, 1, 1).requires_grad_()
        self.first, self.second = torch.zeros_like(self.value), torch.zeros_like(self.value)
        self.steps = 0

    def applied(self, radiance: Tensor, indices: list[int], full_scale: Tensor) -> Tensor:
        """Return the radiance [B, H, W, C] that gives the mapped colours of some frames.

        Args:
            indices: of the frames, B.
            full_scale: [B, 1, 1, 1] the radiance of full scale in each.
        """
        return mapped(radiance, self.value[indices].to(radiance.device), full_scale)

    @torch.no_grad()
    def step(self, share: float) -> None:
        """Move the maps down their gradients by Adam, after a share of the steps, and drop the gradients."""
        if self.value.grad is None:
            return
        self.steps += 1
        self.first.lerp_(self.value.grad, 1 - BETAS[0])
        self.second.lerp_(self.value.grad.square(), 1 - BETAS[1])
        corrected = (self.second / (1 - BETAS[1] ** self.steps)).sqrt() + EPS
        rate = RATE ** (1 - share) * RATE_END**share / (1 - BETAS[0] ** self.steps)
        self.value -= rate * self.first / corrected
        self.value.grad = None

    @torch.no_grad()
    def by_exposure(self, exposures_s: list[float]) -> dict[float, Tensor]:
        """Return the mean map [C, C + 1] of the frames of each exposure time."""
        rows: dict[float, list[int]] = {}
        for index, exposure_s in enumerate(exposures_s):
            rows.setdefault(exposure_s, []).append(index)
        return {exposure_s: self.value[indices].mean(dim=0) for exposure_s, indices in rows.items()}


def mapped(radiance: Tensor, maps: Tensor, full_scale: Tensor) -> Tensor:
    """Return colours [B, H, W, C] after affine maps [B, C, C + 1] whose offset is in units of full_scale."""
    linear = torch.einsum("bij,bhwj->bhwi", maps[..., :-1], radiance)
    return linear + maps[:, None, None, :, -1] * full_scale


def nearest(maps: dict[float, Tensor], exposure_s: float) -> Tensor:
    """Return the map of the exposure time with the smallest ratio to this one."""
    return maps[min(maps, key=lambda known_s: abs(math.log(known_s / exposure_s)))]
