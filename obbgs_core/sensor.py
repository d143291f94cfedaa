"""The sensor model: from scene-linear radiance and exposure time to digital numbers (DN), and their noise."""

import dataclasses
import math
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from obbgs_core.jpeg import FULL_SCALE, JpegCoding

HALF_DN = 0.5  # a reading of 0 means a signal below this, since signals are rounded
STRAIGHT = 1e-3  # share of full scale below which a response is a straight line
# edge of the blocks by which noise is measured, and the share of them that is surely sky
BLOCK_PX, SKY_BLOCKS = 8, 0.25
# full scale at the mean exposure may be a radiance between this and its inverse without harm
USUAL_FULL_SCALE = 10.0
SKY_SCATTERS = 1.0  # a block whose mean is farther above an empty one, in deviations of a reading, is no sky


@dataclass(frozen=True)
class Prediction:
    """What a sensor is expected to read, before its readings are clipped, and the noise on it; all of one shape."""

    expected_dn: Tensor  # differentiable
    variance_dn2: Tensor  # of the noise, without gradient
    sigma_dn: Tensor  # its root

    def clipped_moments(self, white_dn: float) -> tuple[Tensor, Tensor]:
        """Return mean (DN) and variance (DN²) of the readings clipped at 0 and `white_dn`."""
        return clipped_moments(self.expected_dn, self.sigma_dn, white_dn)

    def chi2_terms(self, dn: Tensor, white_dn: float) -> tuple[Tensor, Tensor]:
        """Return squared errors of clipped readings and the variance of those readings, both over that of the noise.

        chi² is the sum of the first over the sum of the second: readings near a clip vary less, and weigh less.

        Args:
            dn: what was read, of the prediction's shape.
        """
        mean, variance = self.clipped_moments(white_dn)
        return (mean - dn).square() / self.variance_dn2, variance / self.variance_dn2


@dataclass(frozen=True)
class Sensor:
    """A linear sensor: dn = clip(black_dn + dn_per_radiance_s·exposure_time_s·radiance + noise, 0, white_dn).

    jpeg: how the readings were stored, full scale as 255; None: as they are.
    response: what is above black is the share of full scale that light would read to this power; 1: a linear sensor.
    """

    black_dn: float
    white_dn: float
    dn_per_radiance_s: float
    electrons_per_dn: float
    read_noise_dn: float
    jpeg: JpegCoding | None = None
    response: float = 1.0

    def __post_init__(self):
        if not (
            self.white_dn > self.black_dn >= 0 and self.dn_per_radiance_s > 0 and self.electrons_per_dn > 0
        ):
            raise ValueError(f"black, white, gain and electrons must be ordered and positive: {self}")

    def expected_dn(self, radiance: Tensor, exposure_time_s: float | Tensor) -> Tensor:
        """Return the noiseless reading, not clipped at full scale, so that a saturated prediction keeps a gradient."""
        linear, sensor = self.linear(radiance, exposure_time_s)
        return sensor.black_dn + sensor.dn_per_radiance_s * exposure_time_s * linear

    def linear(self, radiance: Tensor, exposure_time_s: float | Tensor) -> tuple[Tensor, "Sensor"]:
        """Return the radiance that a linear sensor would read like this one reads a given one, and that sensor.

        Near black, where powers have no slope or an infinite one, the response is a straight line.
        """
        if self.response == 1:
            return radiance, self
        white = (self.white_dn - self.black_dn) / (self.dn_per_radiance_s * exposure_time_s)
        share = radiance / white
        bent = share.clamp(min=STRAIGHT) ** (self.response - 1) * share
        return bent * white, dataclasses.replace(self, response=1.0)

    def full_scale_radiance(self, exposure_time_s: float) -> float:
        """Return the radiance whose noiseless reading is full scale."""
        return (self.white_dn - self.black_dn) / (self.dn_per_radiance_s * exposure_time_s)

    def variance_dn2(self, expected_dn: Tensor) -> Tensor:
        """Return shot + read + quantisation variance, DN², of an expected reading; no gradient flows through it."""
        signal_dn = (expected_dn.detach() - self.black_dn).clamp(min=0)
        return signal_dn / self.electrons_per_dn + self.read_noise_dn**2 + 1 / 12

    def predicted(
        self, radiance: Tensor, exposure_time_s: float | Tensor, averaged_pixels: int = 1
    ) -> Prediction:
        """Return the expected readings of a radiance and their noise.

        Of pictures [B, H, W, C] or [H, W, C] that were stored as JPEG they are what comes back of clipped readings; the
        upper left pixel must then be that of one of the sensor's blocks. Of means of several pixels coding is left out.
        """
        expected = self.expected_dn(radiance, exposure_time_s)
        variance = self.variance_dn2(expected)
        if self.jpeg is not None and averaged_pixels == 1:
            scale_dn = self.white_dn / FULL_SCALE
            read, spread = clipped_moments(expected, variance.sqrt(), self.white_dn)
            shape = read.shape if read.ndim == 4 else (1, *read.shape)
            stored = self.jpeg.moments((read / scale_dn).view(shape), (spread / scale_dn**2).view(shape))
            expected = (stored[0] * scale_dn).view(read.shape)
            variance = ((stored[1] + 1 / 12) * scale_dn**2).view(read.shape)
        return Prediction(expected, variance, variance.sqrt())

    def normalised_residual(self, radiance: Tensor, exposure_time_s: float | Tensor, dn: Tensor) -> Tensor:
        """Return (expected reading - reading) / deviation of the reading: mean 0 and variance 1 for a true radiance.

        Mean and deviation are those of the clipped reading. Far beyond a clip the reading does not vary; its deviation
        is then taken as a thousandth of the noise, so that the residual stays finite.
        """
        prediction = self.predicted(radiance, exposure_time_s)
        sigma = prediction.sigma_dn
        mean, variance = prediction.clipped_moments(self.white_dn)
        return (mean - dn) / (variance.sqrt() + 1e-3 * sigma * (variance < 1e-6 * sigma**2))

    def deviance_residual(
        self, radiance: Tensor, exposure_time_s: float | Tensor, dn: Tensor, averaged_pixels: int = 1
    ) -> Tensor:
        """Return the signed root of twice the negative log-likelihood of each reading; positive: predicted too bright.

        A reading is a normal variable clipped at zero and at full scale (Tobin 1958). Between the clips the residual is
        (predicted - read) / sigma. A reading at a clip says only "at most this much" or "at least this much": its
        likelihood is the probability of lying beyond the clip, and a prediction far beyond has no residual.

        A mean of `averaged_pixels` readings is no clipped normal variable: its expectation is that of readings clipped
        at zero, its noise is smaller by the root of their number. One that holds a saturated reading is given as full
        scale (`frames.averaged`), and a prediction above it has no residual.

        Source: Tobin, Estimation of relationships for limited dependent variables, 1958.
        """
        return self.residual_of(
            self.predicted(radiance, exposure_time_s, averaged_pixels), dn, averaged_pixels
        )

    def residual_of(self, prediction: Prediction, dn: Tensor, averaged_pixels: int = 1) -> Tensor:
        """Return the `deviance_residual` of what is expected."""
        expected, sigma = prediction.expected_dn, prediction.sigma_dn
        saturated = dn >= self.white_dn
        if averaged_pixels > 1:
            residual = (clipped_mean(expected, sigma) - dn) / sigma * math.sqrt(averaged_pixels)
            return torch.where(saturated, residual.clamp(max=0), residual)
        beyond = torch.where(saturated, expected - (self.white_dn - HALF_DN), HALF_DN - expected) / sigma
        # the root has no derivative at 0, where the likelihood is 1; 1e-15 keeps the argument above 0
        deviance = (-2 * torch.special.log_ndtr(beyond) + 1e-15).sqrt()
        at_a_clip = torch.where(saturated, -deviance, deviance)
        return torch.where(saturated | (dn <= 0), at_a_clip, (expected - dn) / sigma)

    def stabilised(self, dn: Tensor) -> Tensor:
        """Return readings on a scale where shot and read noise have nearly unit variance everywhere and black is 0.

        The generalised Anscombe transform minus its value at the black level, written so that it loses no digits where
        read noise is far larger than shot noise: 2 (sqrt(e + f) - sqrt(f)) = 2 e / (sqrt(e + f) + sqrt(f)) for e
        electrons and the floor f. Quantisation is left out of it.
        """
        signal_e = (dn - self.black_dn) * self.electrons_per_dn
        floor = 3 / 8 + (self.read_noise_dn * self.electrons_per_dn) ** 2
        signal_e = signal_e.clamp(min=1e-3 - floor)
        return 2 * signal_e / ((signal_e + floor).clamp(min=1e-3).sqrt() + math.sqrt(floor))


def unusual_unit(white: float) -> str:
    """Return a warning if radiance is measured in a unit in which full scale, `white`, is far from 1; "" otherwise."""
    if 1 / USUAL_FULL_SCALE <= white <= USUAL_FULL_SCALE:
        return ""
    return (
        f"full scale is a radiance of {white:.2g}, and trainings are tuned to about 1: choose the unit of radiance so, "
        f"for instance with {white:.2g} times the gain dn_per_radiance_s"
    )


def clipped_mean(mean: Tensor, sigma: Tensor) -> Tensor:
    """Return the mean of max(x, 0) for x normal: mean·Phi(mean/sigma) + sigma·phi(mean/sigma)."""
    z = mean / sigma
    return mean * torch.special.ndtr(z) + sigma * _density(z)


def clipped_moments(mean: Tensor, sigma: Tensor, most: float) -> tuple[Tensor, Tensor]:
    """Return mean and variance of min(max(x, 0), most) for x normal with `mean` and deviation `sigma`.

    Only the first has a gradient, by `mean`.
    """
    with torch.no_grad():
        low, high = -mean / sigma, (most - mean) / sigma  # the clips, in deviations from the mean
        below, above = torch.special.ndtr(low), torch.special.ndtr(-high)
        at_low, at_high = _density(low), _density(high)
        # the means of what each clip cuts off, and the second moment between the clips
        lifted, lowered = low * below + at_low, at_high - high * above
        between = 1 - below - above
        inside = between + low * at_low - high * at_high
        shift = lifted - lowered
        variance = (inside + low**2 * below + high**2 * above - shift**2).clamp(min=0)
        clipped, variance = (mean + sigma * shift).clamp(0, most), sigma**2 * variance
    if mean.requires_grad:
        clipped = clipped + between * (mean - mean.detach())
    return clipped, variance


def _density(z: Tensor) -> Tensor:
    """Return the density of the standard normal distribution."""
    return torch.exp(-0.5 * z.clamp(-12, 12) ** 2) / math.sqrt(2 * math.pi)


def dark_reading(sensor: Sensor) -> tuple[float, float]:
    """Return mean and deviation, DN, of a pixel without light: normal noise on the black level, clipped at zero."""
    mean, sigma = sensor.black_dn, math.hypot(sensor.read_noise_dn, math.sqrt(1 / 12))
    share = 0.5 * (1 + math.erf(mean / sigma / math.sqrt(2)))
    density = math.exp(-0.5 * (mean / sigma) ** 2) / math.sqrt(2 * math.pi)
    first = mean * share + sigma * density
    second = (mean**2 + sigma**2) * share + mean * sigma * density
    return first, math.sqrt(second - first**2)


def noise_excess(dn: Tensor, sensor: Sensor, empty_dn: float) -> tuple[float, float]:
    """Return the scatter of empty sky over the stated one, and that of readings two apart over that of neighbours.

    Differences of neighbouring readings dn [H, W, C] have twice the variance of a reading. Of blocks of 8x8 pixels
    those that read what is empty within SKY_SCATTERS of their own scatter, and of these the ones with the smaller
    differences, are empty sky, also where the target fills most of the picture or stars are in it. If there is none,
    nothing is learnt: 1 is returned. The second figure is the deviation of differences two pixels apart over that of
    neighbours in these blocks: 1.03 for noise, more where the picture was smoothed or compressed, infinite where it
    has no noise.

    Args:
        empty_dn: what an empty pixel reads in the mean.
    """
    squares = [
        (dn[:, lag:] - dn[:, :-lag])[:, : dn.shape[1] - 2].square().mean(dim=2)[None] for lag in (1, 2)
    ]
    block_px = min(BLOCK_PX, *squares[0].shape[1:])
    near, far = (F.avg_pool2d(s, block_px).flatten() for s in squares)
    level = F.avg_pool2d((dn[:, :-2].mean(dim=2) - empty_dn)[None], block_px).flatten()
    empty = level <= SKY_SCATTERS * (0.5 * near).sqrt()
    share = empty.float().mean().item()
    if share == 0:
        return 1.0, math.inf
    # as many blocks as a quarter of all, but where so many are not empty for sure a quarter of those that are
    quietest = near[empty].quantile(SKY_BLOCKS / share if share >= 2 * SKY_BLOCKS else SKY_BLOCKS)
    sky = empty & (near <= quietest)
    farther = (far[sky].mean() / near[sky].mean()).sqrt().nan_to_num(nan=torch.inf).item()
    return math.sqrt(0.5 * quietest.item()) / dark_reading(sensor)[1], farther
