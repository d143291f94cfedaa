"""Where in a frame the target is: the pixels that are sent, and those that the exposure is measured on."""

import numpy as np

from flightsw.icd.mission import CameraSection, Mission

ROUNDING_DN = 0.29  # 1 sigma of rounding to whole numbers, 1/sqrt(12)


def region_of_interest(dn: np.ndarray, mission: Mission) -> np.ndarray:
    """Return the mask [H, W] of pixels that are sent: those near anything `roi_sigma` above black in a 3x3 mean.

    Outside it the frame carries the black level, which compresses to nothing.
    """
    bright = _bright(_signal(dn, mission.camera), mission.camera, mission.link.roi_sigma)
    return _box_sum(bright.astype(np.float32), mission.link.roi_margin_px) > 0.5


def target_pixels(dn: np.ndarray, camera: CameraSection) -> np.ndarray:
    """Return the mask [H, W] of pixels that show the target, as far as it stands out of the noise.

    A pixel counts when its 3x3 mean is 4 sigma above black and most of its neighbourhood is 2 sigma above: that leaves
    out hot pixels, stars, and the rim where target and sky mix.
    """
    signal = _signal(dn, camera)
    alone = signal > 2 * np.hypot(camera.read_noise_dn, ROUNDING_DN)
    return _bright(signal, camera, 4.0) & (_box_sum(alone.astype(np.float32), 1) > 4.5)


def _signal(dn: np.ndarray, camera: CameraSection) -> np.ndarray:
    return dn.astype(np.float32).reshape(*dn.shape[:2], -1).mean(axis=2) - camera.black_dn


def _bright(signal_dn: np.ndarray, camera: CameraSection, sigmas: float) -> np.ndarray:
    noise_dn = np.hypot(camera.read_noise_dn, ROUNDING_DN) / 3  # of a 3x3 mean
    return _box_sum(signal_dn, 1) / 9 > sigmas * noise_dn


def _box_sum(image: np.ndarray, radius_px: int) -> np.ndarray:
    """Return the sum over a square window around each pixel, zero outside the image."""
    size = 2 * radius_px + 1
    for axis in (0, 1):
        pad = [(0, 0), (0, 0)]
        pad[axis] = (radius_px + 1, radius_px)
        total = np.cumsum(np.pad(image, pad), axis=axis, dtype=np.float64)
        upper, lower = [slice(None)] * 2, [slice(None)] * 2
        upper[axis], lower[axis] = slice(size, None), slice(None, -size)
        image = total[tuple(upper)] - total[tuple(lower)]
    return image
