"""Losses and image metrics against OpenCV, scikit-image and finite differences."""

import cv2
import numpy as np
import pytest
import torch
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from obbgs_core.losses import charbonnier, sobel, sobel_edge_loss, ssim_map
from obbgs_core.metrics import psnr_db, ssim


def images(seed: int, channels: int = 3, dtype=torch.float64) -> tuple[torch.Tensor, torch.Tensor]:
    rng = np.random.default_rng(seed)
    a = cv2.GaussianBlur(rng.random((48, 64, channels)), (7, 7), 2).reshape(48, 64, channels)
    b = np.clip(a + 0.05 * rng.normal(size=a.shape), 0, 1)
    return torch.tensor(a, dtype=dtype), torch.tensor(b, dtype=dtype)


def test_sobel_matches_opencv():
    image = np.random.default_rng(7).random((48, 64))
    dx, dy = sobel(torch.from_numpy(image)[None, ..., None])
    for ours, order in ((dx, (1, 0)), (dy, (0, 1))):
        expected = cv2.Sobel(image, cv2.CV_64F, *order, ksize=3)[1:-1, 1:-1]
        np.testing.assert_allclose(
            ours[0, ..., 0].numpy(), expected, atol=1e-12
        )  # the same sums in another order


def test_ssim_matches_scikit_image():
    a, b = images(1)
    expected = structural_similarity(
        a.numpy(),
        b.numpy(),
        data_range=1.0,
        channel_axis=-1,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        win_size=11,
    )
    assert ssim(a, b) == pytest.approx(expected, abs=1e-6)


def test_psnr_matches_scikit_image():
    a, b = images(2)
    assert psnr_db(a, b) == pytest.approx(
        peak_signal_noise_ratio(a.numpy(), b.numpy(), data_range=1.0), abs=1e-9
    )
    assert psnr_db(a, a) == 120


def test_gradients_match_finite_differences():
    a, b = (i[None, :13, :14, :1].contiguous() for i in images(3))
    a.requires_grad_()
    assert torch.autograd.gradcheck(lambda x: ssim_map(x, b).mean(), a)
    assert torch.autograd.gradcheck(lambda x: sobel_edge_loss(x, b), a)
    assert torch.autograd.gradcheck(lambda x: charbonnier(30 * (x - b)), a)


def test_charbonnier_is_half_the_square_for_noise_and_linear_for_outliers():
    small = torch.tensor([0.01], dtype=torch.float64)
    assert charbonnier(small).item() == pytest.approx(0.5e-4, rel=1e-4)
    assert (
        charbonnier(torch.tensor([2000.0])) / charbonnier(torch.tensor([1000.0]))
    ).item() == pytest.approx(2, rel=1e-2)
