"""Image losses: robust likelihood, L1, SSIM and Sobel edges. Images are [B, H, W, C]."""

import torch
import torch.nn.functional as F
from torch import Tensor

SSIM_WINDOW, SSIM_SIGMA = 11, 1.5  # Wang et al. 2004
SSIM_C1, SSIM_C2 = 0.01**2, 0.03**2


def charbonnier(normalised_residual: Tensor, knee: float = 2.0) -> Tensor:
    """Return the mean robust penalty: half the square below `knee` sigma, linear beyond."""
    return (knee * knee * ((1 + (normalised_residual / knee) ** 2).sqrt() - 1)).mean()


def ssim(a: Tensor, b: Tensor) -> Tensor:
    """Return the mean structural similarity of images in 0..1, Gaussian window, zero padding as in 3DGS."""
    return ssim_map(a, b).mean()


def ssim_map(a: Tensor, b: Tensor) -> Tensor:
    """Return SSIM at each pixel [B, C, H, W]."""
    a, b = a.movedim(-1, 1), b.movedim(-1, 1)
    stack = torch.cat([a, b, a * a, b * b, a * b], dim=1)
    blurred = _gaussian_blur(stack)
    mean_a, mean_b, aa, bb, ab = blurred.chunk(5, dim=1)
    variance_a, variance_b, covariance = aa - mean_a**2, bb - mean_b**2, ab - mean_a * mean_b
    luminance = (2 * mean_a * mean_b + SSIM_C1) / (mean_a**2 + mean_b**2 + SSIM_C1)
    return luminance * (2 * covariance + SSIM_C2) / (variance_a + variance_b + SSIM_C2)


def _gaussian_blur(images: Tensor) -> Tensor:
    x = torch.arange(SSIM_WINDOW, dtype=images.dtype, device=images.device) - SSIM_WINDOW // 2
    window = torch.exp(-0.5 * (x / SSIM_SIGMA) ** 2)
    window = window / window.sum()
    flat = images.flatten(0, 1)[:, None]
    flat = F.conv2d(flat, window.view(1, 1, 1, -1), padding=(0, SSIM_WINDOW // 2))
    flat = F.conv2d(flat, window.view(1, 1, -1, 1), padding=(SSIM_WINDOW // 2, 0))
    return flat.view_as(images)


def sobel(image: Tensor) -> tuple[Tensor, Tensor]:
    """Return the 3x3 Sobel derivatives along x and y [B, H-2, W-2, C], without padding."""
    smooth_y = image[:, :-2] + 2 * image[:, 1:-1] + image[:, 2:]
    smooth_x = image[:, :, :-2] + 2 * image[:, :, 1:-1] + image[:, :, 2:]
    return smooth_y[:, :, 2:] - smooth_y[:, :, :-2], smooth_x[:, 2:] - smooth_x[:, :-2]


def sobel_edge_loss(predicted: Tensor, truth: Tensor) -> Tensor:
    """Return |Sx(predicted) - Sx(truth)| + |Sy(predicted) - Sy(truth)|, means over pixels (Jiang et al. 2025)."""
    dx, dy = sobel(predicted - truth)
    return dx.abs().mean() + dy.abs().mean()
