"""The footprint of a pixel: over how much of the image its reading averages, as a variance added to each Gaussian."""

import torch
from torch import Tensor

from obbgs_core.model.cameras import Cameras
from obbgs_core.model.gaussians import Gaussians

KERBL_PX2, MIP_SPLATTING_PX2 = 0.3, 0.1
PIXEL_PX2 = 1 / 12  # variance of a square pixel along each side


def variance_px2(gaussians: Gaussians, psf_sigma_px: float | None, scale: float = 1.0) -> float | Tensor:
    """Return the variance, px², that is added to both axes of a projected Gaussian.

    Args:
        psf_sigma_px: of the camera's optics, px of the sensor; None: the model's estimate, which keeps its gradient.
        scale: pixels of the image for one of the sensor, along a side.
    """
    if gaussians.footprint == "camera":
        psf = gaussians.psf_sigma_px if psf_sigma_px is None else psf_sigma_px
        return PIXEL_PX2 + (scale * psf) ** 2
    return KERBL_PX2 if gaussians.footprint == "kerbl" else MIP_SPLATTING_PX2


def footprint_px2(gaussians: Gaussians, cameras: Cameras) -> Tensor:
    """Return the variance that is added in each camera [C] px²."""
    variance = variance_px2(gaussians, cameras.psf_sigma_px, cameras.scale)
    return torch.as_tensor(variance, dtype=cameras.K.dtype, device=cameras.K.device).expand(len(cameras))


def lowers_peak(gaussians: Gaussians) -> bool:
    """Return whether a widened Gaussian is made fainter, so that its integral over the image stays the same."""
    return gaussians.footprint != "kerbl"
