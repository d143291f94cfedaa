"""The simulated sensor: from radiance to digital numbers (DN). Written independently of `obbgs_core.sensor` on purpose.

Terms and units follow EMVA Standard 1288 and Janesick, Photon Transfer, 2007.
"""

import functools
import math
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.ndimage import convolve, gaussian_filter

from flightsw.icd.mission import CameraSection

HOT_RATE_E_S = 2e5  # mean dark current of a hot pixel, electrons per second
# The renderer's pixel filter blurs the radiance before any lens does; the mission's default is the same.
RENDERED_PSF_SIGMA_PX = 0.26
LARGEST_POISSON_E = 1e15  # far above any pixel; NumPy's Poisson refuses about 9e18


@dataclass(frozen=True)
class SensorModel:
    """A camera's sensor and optics, in the terms of a datasheet; the defaults are free of faults.

    Light: electrons = radiance * photons_per_radiance_s * exposure_time_s * quantum_efficiency.
    """

    photons_per_radiance_s: float = 1.0e8  # at a pixel: aperture, transmission and pixel area
    quantum_efficiency: float = 1.0  # electrons per photon
    electrons_per_dn: float = 4.0  # at a given DN the shot noise is the smaller, the larger this is
    bit_depth: int = 12
    black_dn: float = 64.0
    read_noise_e: float = 0.0  # standard deviation of a pixel
    dark_e_s: float = 0.0  # dark current of a pixel
    prnu: float = 0.0  # photo response non-uniformity: relative standard deviation of the pixels
    dsnu_e: float = 0.0  # dark signal non-uniformity: standard deviation of the pixels
    hot_pixels: float = 0.0  # fraction of the pixels
    full_well_e: float = math.inf
    blooming: bool = False  # charge above the full well runs along its column instead of being lost
    vignetting: float = 0.0  # fraction of the light lost in the corners; grows with the distance squared
    psf_sigma_px: float = 0.0  # of the Gaussian point spread function
    exposure_error: float = 0.0  # relative standard deviation of the true exposure time
    line_time_s: float = 0.0  # of a rolling shutter, from one row to the next; 0: a global shutter
    stars: bool = False
    colour: Literal["mono", "rgb", "bayer"] = "mono"  # bayer: an RGGB mosaic, interpolated
    seed: int = 0  # of the fixed pattern and the hot pixels: the individual sensor

    def __post_init__(self):
        for name in ("photons_per_radiance_s", "quantum_efficiency", "electrons_per_dn", "full_well_e"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} must be positive, got {getattr(self, name)}")
        if not (0 <= self.vignetting <= 1 and 0 <= self.hot_pixels <= 1):
            raise ValueError(f"expected fractions of 0 to 1, got {self.vignetting} and {self.hot_pixels}")

    @property
    def channels(self) -> int:
        return 1 if self.colour == "mono" else 3

    @property
    def dn_per_radiance_s(self) -> float:
        return self.photons_per_radiance_s * self.quantum_efficiency / self.electrons_per_dn

    @property
    def white_dn(self) -> int:
        return (1 << self.bit_depth) - 1

    def with_gain(self, dn_per_radiance_s: float) -> "SensorModel":
        """Return the sensor with as much light as gives this signal."""
        photons = dn_per_radiance_s * self.electrons_per_dn / self.quantum_efficiency
        return replace(self, photons_per_radiance_s=photons)

    def camera_section(self, width: int, height: int, focal_px: float) -> CameraSection:
        """Return what a calibration of this camera tells flight and ground: linear response, noise and blur."""
        return CameraSection(
            width=width,
            height=height,
            fx_px=focal_px,
            fy_px=focal_px,
            cx_px=width / 2,
            cy_px=height / 2,
            channels=self.channels,
            bit_depth=self.bit_depth,
            black_dn=self.black_dn,
            dn_per_radiance_s=self.dn_per_radiance_s,
            electrons_per_dn=self.electrons_per_dn,
            read_noise_dn=self.read_noise_e / self.electrons_per_dn,
            psf_sigma_px=math.hypot(self.psf_sigma_px, RENDERED_PSF_SIGMA_PX),
        )


PRESETS = {
    # Jiang et al. 2025: Gaussian noise on 8-bit pictures; 0.025 of full scale is consistent with their PSNR
    "paper": SensorModel(
        electrons_per_dn=1e6, bit_depth=8, black_dn=0.0, read_noise_e=0.025 * 255 * 1e6, colour="rgb"
    ),
    # a typical scientific CMOS sensor for space: 16,000 electrons at 12 bits
    "spacecam": SensorModel(
        quantum_efficiency=0.6,
        electrons_per_dn=4.0,
        bit_depth=12,
        black_dn=64.0,
        read_noise_e=12.0,
        dark_e_s=50.0,
        prnu=0.01,
        dsnu_e=2.0,
        hot_pixels=2e-5,
        full_well_e=15_800.0,
        vignetting=0.08,
        psf_sigma_px=0.6,
        exposure_error=0.002,
        line_time_s=8e-6,
        stars=True,
    ),
}


def ideal(camera: CameraSection) -> SensorModel:
    """Return the sensor that a camera's calibration describes, free of the faults that a calibration leaves out."""
    psf_px = RENDERED_PSF_SIGMA_PX if camera.psf_sigma_px is None else camera.psf_sigma_px
    return SensorModel(
        photons_per_radiance_s=camera.dn_per_radiance_s * camera.electrons_per_dn,
        electrons_per_dn=camera.electrons_per_dn,
        bit_depth=camera.bit_depth,
        black_dn=camera.black_dn,
        read_noise_e=camera.read_noise_dn * camera.electrons_per_dn,
        psf_sigma_px=math.sqrt(max(0.0, psf_px**2 - RENDERED_PSF_SIGMA_PX**2)),
        colour="mono" if camera.channels == 1 else "rgb",
    )


def through_lens(radiance: np.ndarray, camera: CameraSection) -> np.ndarray:
    """Return a rendered radiance [H, W, C] as the camera's calibrated point spread leaves it, float32.

    It is what a noiseless sensor behind that lens would measure, and what a model that knows the lens should predict.
    """
    sigma_px = ideal(camera).psf_sigma_px
    return gaussian_filter(radiance.astype(np.float32), sigma_px, axes=(0, 1), mode="constant")


def clean_dn(radiance: np.ndarray, exposure_time_s: float, camera: CameraSection) -> np.ndarray:
    """Return the reading of a noiseless sensor, DN as float64, clipped at full scale but not rounded."""
    signal_dn = camera.dn_per_radiance_s * exposure_time_s * radiance.astype(np.float64)
    return np.minimum(camera.black_dn + signal_dn, camera.white_dn)


def expose(
    radiance: np.ndarray, exposure_time_s: float, camera: CameraSection, rng: np.random.Generator
) -> np.ndarray:
    """Return one exposure of the camera's ideal sensor, uint16: Poisson electrons, Gaussian read noise, clipped.

    Args:
        radiance: [H, W, C], scene-linear.
    """
    return read_out(ideal(camera), radiance, exposure_time_s, rng)


def read_out(
    sensor: SensorModel, radiance: np.ndarray, exposure_time_s: float, rng: np.random.Generator
) -> np.ndarray:
    """Return one noisy exposure, uint16, of the radiance's shape.

    In the order of the signal chain: lens (vignetting, blur), shutter, colour filter, pixels (fixed pattern, dark
    current, shot noise, full well), converter (read noise, black level, clipping); for a Bayer sensor interpolation.

    Args:
        radiance: [H, W, C], scene-linear; C is 1 for a mono sensor and 3 for the others.

    Raises:
        ValueError: the radiance has another shape.
    """
    if radiance.ndim != 3 or radiance.shape[2] != sensor.channels:
        raise ValueError(
            f"a {sensor.colour} sensor takes radiance [H, W, {sensor.channels}], got {list(radiance.shape)}"
        )
    light = radiance.astype(np.float64)
    if sensor.vignetting:
        light *= 1 - sensor.vignetting * _squared_distance(*light.shape[:2])[..., None]
    if sensor.psf_sigma_px:
        light = gaussian_filter(light, sensor.psf_sigma_px, axes=(0, 1), mode="nearest")
    if sensor.exposure_error:
        exposure_time_s *= max(0.0, 1 + sensor.exposure_error * rng.standard_normal())
    if sensor.colour == "bayer":
        light = (light * _bayer_mask(*light.shape[:2])).sum(axis=2, keepdims=True)
    mean_e = sensor.dn_per_radiance_s * exposure_time_s * sensor.electrons_per_dn * light
    dark_e_s = sensor.dark_e_s
    if sensor.prnu or sensor.dsnu_e or sensor.hot_pixels:
        sensitivity, offset_e, hot_e_s = _fixed_pattern(sensor, light.shape)
        mean_e = mean_e * sensitivity
        dark_e_s = dark_e_s + hot_e_s
    else:
        offset_e = 0.0
    electrons = rng.poisson(np.minimum(mean_e + dark_e_s * exposure_time_s, LARGEST_POISSON_E)) + offset_e
    if sensor.blooming:
        electrons = bloom(electrons, sensor.full_well_e)
    electrons = np.minimum(electrons, sensor.full_well_e)
    dn = sensor.black_dn + electrons / sensor.electrons_per_dn
    dn = converted(dn, sensor.read_noise_e / sensor.electrons_per_dn, sensor.white_dn, rng)
    return demosaic(dn[..., 0]) if sensor.colour == "bayer" else dn


def converted(
    signal_dn: np.ndarray, sigma_dn: float | np.ndarray, white_dn: float, rng: np.random.Generator
) -> np.ndarray:
    """Return the analogue-to-digital converter's output, uint16, for an unclipped signal in DN of the same shape.

    As in a real converter Gaussian noise of standard deviation `sigma_dn` is added, the sum is rounded, then clipped to
    0..white_dn. A signal above full scale can therefore still read below it.
    """
    noisy = signal_dn + sigma_dn * rng.standard_normal(signal_dn.shape)
    return np.clip(np.rint(noisy), 0, white_dn).astype(np.uint16)


def bloom(electrons: np.ndarray, full_well_e: float) -> np.ndarray:
    """Return the charge [H, W, C] after the excess over the full well has run along its columns, half each way.

    Charge is lost only over the upper and the lower edge.
    """
    well = np.minimum(electrons, full_well_e)
    half_excess = (electrons - well) / 2
    for step in (1, -1):  # down, then up
        flowing = np.zeros(electrons.shape[1:])
        for row in range(len(electrons))[::step]:
            held = np.minimum(well[row] + flowing, full_well_e)
            flowing = flowing - (held - well[row]) + half_excess[row]
            well[row] = held
    return well


def demosaic(dn: np.ndarray) -> np.ndarray:
    """Return an RGGB mosaic [H, W] as colours [H, W, 3] by bilinear interpolation."""
    mask = _bayer_mask(*dn.shape)
    kernel = np.array([[0.25, 0.5, 0.25], [0.5, 1.0, 0.5], [0.25, 0.5, 0.25]])
    colours = []
    for channel in range(3):
        weight = convolve(mask[..., channel], kernel, mode="constant")
        colours.append(convolve(dn * mask[..., channel], kernel, mode="constant") / weight)
    blended = np.stack(colours, axis=2)
    return np.rint(np.where(mask > 0, dn[..., None], blended)).astype(np.uint16)


def _bayer_mask(height: int, width: int) -> np.ndarray:
    """Return [H, W, 3], 1 where a pixel of an RGGB sensor is sensitive to the colour, else 0."""
    mask = np.zeros((height, width, 3))
    mask[0::2, 0::2, 0] = 1
    mask[0::2, 1::2, 1] = mask[1::2, 0::2, 1] = 1
    mask[1::2, 1::2, 2] = 1
    return mask


def _squared_distance(height: int, width: int) -> np.ndarray:
    """Return the squared distance [H, W] from the image's middle, 1 in its corners."""
    y = np.arange(height) + 0.5 - height / 2
    x = np.arange(width) + 0.5 - width / 2
    return (y[:, None] ** 2 + x**2) / ((height / 2) ** 2 + (width / 2) ** 2)


@functools.lru_cache(maxsize=4)
def _fixed_pattern(sensor: SensorModel, shape: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the pixels' relative sensitivity, offset (electrons) and additional dark current (electrons/s)."""
    rng = np.random.default_rng((sensor.seed, *shape))
    sensitivity = np.maximum(0.0, 1 + sensor.prnu * rng.standard_normal(shape))
    offset_e = sensor.dsnu_e * rng.standard_normal(shape)
    hot = rng.random(shape) < sensor.hot_pixels
    return sensitivity, offset_e, np.where(hot, rng.exponential(HOT_RATE_E_S, shape), 0.0)
