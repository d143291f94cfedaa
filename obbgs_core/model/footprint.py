"""The footprint of a pixel: over how much of the image its reading averages, as a variance added to each Gaussian."""

from typing import Literal, get_args

import torch
from torch import Tensor

from obbgs_core.model.cameras import Cameras

# What a model is rendered with:
# kerbl: 0.3 px² are added, and the peak is kept: thin Gaussians gain light (Kerbl et al. 2023);
# mip-splatting: 0.1 px² are added, and the peak is lowered so that the light stays the same (Yu et al. 2024);
# camera: the variance of the camera's own pixel and optics is added, and the peak is lowered as well.
Footprint = Literal["kerbl", "mip-splatting", "camera"]
FOOTPRINTS: tuple[Footprint, ...] = get_args(Footprint)

KERBL_PX2, MIP_SPLATTING_PX2 = 0.3, 0.1
PIXEL_PX2 = 1 / 12  # variance of a square pixel along each side


def variance_px2(footprint: Footprint, psf_sigma_px: float | Tensor) -> float | Tensor:
    """Return the variance, px², that is added to both axes of a projected Gaussian.

    Args:
        psf_sigma_px: of the camera's optics; a tensor keeps its gradient where the footprint is the camera's.
    """
    fixed = {"kerbl": KERBL_PX2, "mip-splatting": MIP_SPLATTING_PX2}.get(footprint)
    return PIXEL_PX2 + psf_sigma_px**2 if fixed is None else fixed


def footprint_px2(footprint: Footprint, cameras: Cameras) -> Tensor:
    """Return the variance that is added in each camera [C] px²."""
    variance = variance_px2(footprint, cameras.psf_sigma_px)
    return torch.as_tensor(variance, dtype=cameras.K.dtype, device=cameras.K.device).expand(len(cameras))


def lowers_peak(footprint: Footprint) -> bool:
    """Return whether a widened Gaussian is made fainter, so that its integral over the image stays the same."""
    return footprint != "kerbl"
