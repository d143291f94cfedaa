"""The simulated sensor: radiance and exposure to digital numbers. Independent of `obbgs_core.sensor` on purpose."""

import numpy as np

from flightsw.icd.mission import CameraSection


def clean_dn(radiance: np.ndarray, exposure_time_s: float, camera: CameraSection) -> np.ndarray:
    """Return what a noiseless sensor would read, float64, clipped at full scale but not rounded."""
    signal_dn = camera.dn_per_radiance_s * exposure_time_s * radiance.astype(np.float64)
    return np.minimum(camera.black_dn + signal_dn, camera.white_dn)


def expose(
    radiance: np.ndarray, exposure_time_s: float, camera: CameraSection, rng: np.random.Generator
) -> np.ndarray:
    """Return one noisy exposure as uint16 of the same shape: Poisson electrons, Gaussian read noise, clipped.

    Args:
        radiance: [H, W, C], scene-linear.
    """
    electrons = rng.poisson(
        camera.dn_per_radiance_s * exposure_time_s * camera.electrons_per_dn * radiance.astype(np.float64)
    )
    dn = camera.black_dn + electrons / camera.electrons_per_dn
    dn += rng.normal(0.0, camera.read_noise_dn, radiance.shape)
    return np.clip(np.rint(dn), 0, camera.white_dn).astype(np.uint16)
