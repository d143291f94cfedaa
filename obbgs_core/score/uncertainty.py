"""How far a model's images may be off: a deviation for each pixel, and intervals that held-out readings calibrate.

The deviation comes from the posterior of the Gaussians' parameters in Laplace's approximation with a diagonal Fisher
information (MacKay 1992; for splatting, Jiang et al. 2024, FisherRF): parameters are drawn from it, and the images of
the draws differ where the training frames say little. It knows the noise of the sensor but not what the model cannot
show, so its scale is too small; a Student distribution whose scale and degrees of freedom are fitted to the residuals
of held-out readings carries the rest.
"""

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy import optimize, special  # not scipy.stats: importing it takes half a second
from torch import Tensor

from obbgs_core.frames import TrainingFrame, cameras_of
from obbgs_core.model.cameras import Cameras
from obbgs_core.model.gaussians import Gaussians
from obbgs_core.render import render
from obbgs_core.sensor import Sensor

# standard deviation of log scales, opacity logits and quaternions of which the frames say nothing
PRIOR = 0.5
DRAWS = 16  # models drawn for a deviation
MIXTURE = 24  # normal distributions that stand for a Student distribution
FEWEST_DEGREES, MOST_DEGREES = 2.0, 100.0
BISECTIONS = 30
CLEAR_OF_CLIPS = 2.0  # standard deviations of the noise
MOST_READINGS = 20_000  # that a calibration looks at


@dataclass(frozen=True)
class Readings:
    """Readings against a model: one-dimensional tensors of one length, DN.

    dn: read; expected_dn: by the model, not clipped; deviation_dn: of that, by `rendered_deviation`; noise_dn: of the
    sensor.
    """

    dn: Tensor
    expected_dn: Tensor
    deviation_dn: Tensor
    noise_dn: Tensor

    @staticmethod
    def of(
        sensor: Sensor, radiance: Tensor, deviation: Tensor, dn: Tensor, exposure_time_s: float
    ) -> "Readings":
        """Return the readings `dn` that are expected clear of both clips; all arguments are of one shape.

        They are chosen by the prediction, not by the reading, which would choose among the errors.

        Args:
            radiance, deviation: predicted, and the standard deviation of that.
        """
        prediction = sensor.predicted(radiance, exposure_time_s)
        margin = CLEAR_OF_CLIPS * prediction.sigma_dn
        clear = prediction.expected_dn > sensor.black_dn + margin
        clear &= prediction.expected_dn < sensor.white_dn - margin
        deviation_dn = deviation * sensor.dn_per_radiance_s * exposure_time_s
        values = (dn, prediction.expected_dn, deviation_dn, prediction.sigma_dn)
        return Readings(*(value[clear] for value in values))

    @staticmethod
    def together(parts: "Sequence[Readings]") -> "Readings":
        names = (field.name for field in dataclasses.fields(Readings))
        return Readings(**{name: torch.cat([getattr(part, name) for part in parts]) for name in names})


@dataclass(frozen=True)
class Calibration:
    """The error of a pixel: a Student variable of so many degrees of freedom, times `scale`, times its deviation."""

    scale: float
    degrees: float

    def half_width(self, deviation: Tensor, share: float = 0.9) -> Tensor:
        """Return half the width of the interval about a prediction that holds the true value with this probability."""
        return float(special.stdtrit(self.degrees, (1 + share) / 2)) * self.scale * deviation

    def half_width_read(self, deviation: Tensor, noise: Tensor, share: float = 0.9) -> Tensor:
        """Return the same of an interval that holds a reading: the model's error and the sensor's noise together."""
        variance = (self.scale * deviation[..., None]) ** 2 * self.variances().to(deviation) + noise[
            ..., None
        ] ** 2
        shortest, longest = torch.zeros_like(deviation), 10 * variance.amax(dim=-1).sqrt()
        for _ in range(BISECTIONS):
            middle = 0.5 * (shortest + longest)
            held = torch.erf(middle[..., None] / (2 * variance).sqrt()).mean(dim=-1)
            shortest = torch.where(held < share, middle, shortest)
            longest = torch.where(held < share, longest, middle)
        return longest

    def variances(self) -> Tensor:
        """Return the variances of normal distributions whose mean is the Student distribution of scale 1, float64.

        They are quantiles of the inverse gamma distribution.
        """
        quantiles, half = (np.arange(MIXTURE) + 0.5) / MIXTURE, self.degrees / 2
        return torch.from_numpy(half * (1 / special.gammainccinv(half, quantiles)))


def parameter_deviations(
    gaussians: Gaussians, frames: Sequence[TrainingFrame], sensor: Sensor, seed: int = 0
) -> dict[str, Tensor]:
    """Return the posterior standard deviation of each parameter that is stored of each Gaussian, by name.

    The information is that of the readings between the clips. Its diagonal is estimated without bias by one
    backward pass a frame, with signs drawn at random for the pixels (Hutchinson 1989). A weak prior bounds what the
    frames leave open: a Gaussian's place by its largest deviation, its colour by the mean of all.
    """
    draws = torch.Generator().manual_seed(seed)
    stored = gaussians.tensors()
    information = {name: torch.zeros_like(value) for name, value in stored.items()}
    for frame in frames:
        leaves = gaussians.trainable()
        radiance = render(leaves, cameras_of([frame])).radiance
        prediction = sensor.predicted(radiance.detach(), frame.exposure_time_s)
        read = (prediction.expected_dn < sensor.white_dn) & (prediction.expected_dn >= 0)
        weight = sensor.dn_per_radiance_s * frame.exposure_time_s / prediction.sigma_dn * read
        signs = torch.randint(0, 2, radiance.shape, generator=draws) * 2.0 - 1.0
        (radiance * signs * weight).sum().backward()
        for name, value in leaves.tensors().items():
            if value.grad is not None:
                information[name] += value.grad**2
    prior = {name: torch.full_like(value, PRIOR) for name, value in stored.items()}
    prior["means"] = gaussians.scales.max(dim=1, keepdim=True).values.expand_as(stored["means"])
    prior["sh"] = torch.full_like(stored["sh"], stored["sh"].abs().mean().item() + 1e-9)
    return {name: (information[name] + prior[name] ** -2).rsqrt() for name in stored}


@torch.no_grad()
def rendered_deviation(
    gaussians: Gaussians, deviations: dict[str, Tensor], cameras: Sequence[Cameras], seed: int = 0
) -> list[Tensor]:
    """Return the standard deviation [H, W, C] of the radiance that each camera sees, over models drawn at random.

    Args:
        deviations: of the parameters, as `parameter_deviations` returns them.
        cameras: of one view each.
    """
    draws = torch.Generator().manual_seed(seed)
    sums: list[list[Tensor]] = [[] for _ in cameras]
    for _ in range(DRAWS):
        drawn = {
            name: value + deviations[name] * torch.randn(value.shape, generator=draws)
            for name, value in gaussians.tensors().items()
        }
        model = dataclasses.replace(gaussians, **drawn)
        for images, camera in zip(sums, cameras, strict=True):
            images.append(render(model, camera).radiance[0])
    return [torch.stack(images).std(dim=0) for images in sums]


def calibrated(held_out: Readings) -> Calibration:
    """Return the scale and the degrees of freedom that make held-out readings the most likely.

    The error of a reading is the model's, a Student variable, plus the sensor's normal noise. A Student variable is a
    normal one whose variance is drawn, so that the likelihood of the sum is a mean over normal distributions.

    Raises:
        ValueError: no reading.
    """
    if not len(held_out.dn):
        raise ValueError(
            "no held-out reading lies on the target between the clips: an interval cannot be calibrated"
        )
    every = -(-len(held_out.dn) // MOST_READINGS)
    squared = (held_out.dn - held_out.expected_dn)[::every].double().square()[:, None]
    deviation2 = held_out.deviation_dn[::every].double().square()[:, None]
    noise2 = held_out.noise_dn[::every].double().square()[:, None]

    def given(parameters: np.ndarray) -> Calibration:
        degrees = FEWEST_DEGREES + math.exp(min(parameters[1], math.log(MOST_DEGREES)))
        return Calibration(math.exp(parameters[0]), degrees)

    def loss(parameters: np.ndarray) -> float:
        tried = given(parameters)
        variance = tried.scale**2 * deviation2 * tried.variances() + noise2
        return -torch.logsumexp(-0.5 * (squared / variance + variance.log()), dim=1).mean().item()

    best = optimize.minimize(loss, [0.0, 0.0], method="Nelder-Mead", options={"xatol": 0.01, "fatol": 1e-7})
    return given(best.x)
