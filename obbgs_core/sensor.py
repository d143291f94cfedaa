"""The sensor in the image model: scene-linear radiance and exposure to digital numbers, and how sure they are."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class Sensor:
    """A linear sensor: dn = clip(black_dn + dn_per_radiance_s·exposure_time_s·radiance + noise, 0, white_dn)."""

    black_dn: float
    white_dn: float
    dn_per_radiance_s: float
    electrons_per_dn: float
    read_noise_dn: float

    def __post_init__(self):
        if not (
            self.white_dn > self.black_dn >= 0 and self.dn_per_radiance_s > 0 and self.electrons_per_dn > 0
        ):
            raise ValueError(f"black, white, gain and electrons must be ordered and positive: {self}")

    def expected_dn(self, radiance: Tensor, exposure_time_s: float | Tensor) -> Tensor:
        """Return the noiseless reading, not clipped at full scale, so that a saturated prediction keeps a gradient."""
        return self.black_dn + self.dn_per_radiance_s * exposure_time_s * radiance

    def variance_dn2(self, expected_dn: Tensor) -> Tensor:
        """Return shot + read + quantisation variance, DN², of an expected reading; no gradient flows through it."""
        signal_dn = (expected_dn.detach() - self.black_dn).clamp(min=0)
        return signal_dn / self.electrons_per_dn + self.read_noise_dn**2 + 1 / 12

    def normalised_residual(self, radiance: Tensor, exposure_time_s: float | Tensor, dn: Tensor) -> Tensor:
        """Return (predicted - read) / sigma with the sensor's limits respected.

        Where the reading is saturated it says only "at least this much": a brighter prediction has no residual. Near
        zero the prediction is the mean of a reading clipped at zero (0.4 sigma for no light on a sensor without black
        level).
        """
        expected = self.expected_dn(radiance, exposure_time_s)
        sigma = self.variance_dn2(expected).sqrt()
        residual = clipped_mean(expected, sigma) - dn
        return torch.where(dn >= self.white_dn, residual.clamp(max=0), residual) / sigma

    def stabilised(self, dn: Tensor) -> Tensor:
        """Return readings on a scale where noise has unit variance everywhere, 0 where no light is.

        The generalised Anscombe transform minus its value at the black level, in the form that loses no digits where
        read noise is far larger than shot noise.
        """
        signal_e = (dn - self.black_dn) * self.electrons_per_dn
        floor = 3 / 8 + (self.read_noise_dn * self.electrons_per_dn) ** 2
        signal_e = signal_e.clamp(min=1e-3 - floor)
        return 2 * signal_e / ((signal_e + floor).clamp(min=1e-3).sqrt() + math.sqrt(floor))


def clipped_mean(mean: Tensor, sigma: Tensor) -> Tensor:
    """Return the mean of max(x, 0) for x normal: mean·Phi(mean/sigma) + sigma·phi(mean/sigma)."""
    z = mean / sigma
    density = torch.exp(-0.5 * z.clamp(-9, 9) ** 2) / math.sqrt(2 * math.pi)
    return mean * torch.special.ndtr(z) + sigma * density
