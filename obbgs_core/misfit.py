"""The model's own error beside the noise: how large it is, and how it spreads over a picture."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from scipy.optimize import root_scalar
from torch import Tensor

from obbgs_core.sensor import Prediction, Sensor

ROWS = 50  # of an image that the model's own error is measured on, about
OWN = 0.8  # share of the error's variance that goes with a pixel's own light; the rest goes with that of its picture
# the smallest and the largest own error that is looked for in pictures, as a share of the light
STATED = (1e-3, 10.0)


@dataclass(frozen=True)
class ModelError:
    """What the model's own error adds to the variance of a reading, over the sensor pixels that are averaged in it."""

    by_light: float  # times the squared light of the pixel
    floor_dn2: Tensor  # [B] everywhere in each picture
    weight: float  # of the loss, by which the mean pull on the lit pixels stays that of the noise alone

    def variance_dn2(self, prediction: Prediction, sensor: Sensor) -> Tensor:
        """Return that variance for each pixel [B, H, W, C]."""
        return self.by_light * _light_dn(prediction, sensor).square() + self.floor_dn2[:, None, None, None]


@torch.no_grad()
def model_error(
    radiance: Tensor, exposure_time_s: Tensor, sensor: Sensor, averaged_pixels: int, misfit: float
) -> ModelError:
    """Return how the model's own error spreads over some pictures, where it is a share `misfit` of the light.

    Most of its variance goes with the squared light of each pixel, since albedo, normals and glints err by a share of
    it, and the rest (1 - `OWN`) with the mean square over the lit pixels of the picture, since misplaced edges and
    shadows err by the light of other pixels. Over the lit pixels that adds up to the squared share of the light. The
    other arguments are as for `likelihood_loss`, whose compiled sweep does the same (kernels/likelihood.cpp). Of large
    images, every so many pixels are taken.
    """
    (radiance,) = sampled(sensor, radiance)
    return error_of(
        sensor.predicted(radiance, exposure_time_s, averaged_pixels), sensor, averaged_pixels, misfit
    )


def error_of(prediction: Prediction, sensor: Sensor, averaged_pixels: int, misfit: float) -> ModelError:
    """Return `model_error` of what is expected of some pictures, all of whose pixels are taken."""
    squares = _light_dn(prediction, sensor).square()
    variance = prediction.variance_dn2 / averaged_pixels
    seen = squares > 4 * variance
    per_picture = (squares * seen).sum(dim=(1, 2, 3)) / seen.sum(dim=(1, 2, 3)).clamp(min=1)
    share = averaged_pixels * misfit**2
    floor_dn2 = share * (1 - OWN) * per_picture
    error = ModelError(share * OWN, floor_dn2, 1.0)
    if not seen.any():
        return error
    both = 1 + error.variance_dn2(prediction, sensor) / prediction.variance_dn2
    return ModelError(share * OWN, floor_dn2, both.sqrt()[seen].mean().item())


@torch.no_grad()
def relative_misfit(
    radiance: Tensor, exposure_time_s: Tensor, dn: Tensor, sensor: Sensor, averaged_pixels: int = 1
) -> float:
    """Return the model's own error as a share of the light, by the method of moments; NaN where nothing is lit.

    Its square is the mean square by which readings differ from their expectation, less the noise, over the mean square
    of the light; 0 where noise explains the difference. Values that are lit above twice the noise count, saturated ones
    do not. The arguments are as for `likelihood_loss`.
    """
    return misfit_of(
        sensor.predicted(radiance, exposure_time_s, averaged_pixels), dn, sensor, averaged_pixels
    )


def misfit_of(prediction: Prediction, dn: Tensor, sensor: Sensor, averaged_pixels: int = 1) -> float:
    """Return `relative_misfit` of what is expected of some pictures."""
    light_dn, variance = prediction.expected_dn - sensor.black_dn, prediction.variance_dn2 / averaged_pixels
    seen = (light_dn > 2 * variance.sqrt()) & (dn < sensor.white_dn)
    excess = torch.where(seen, (prediction.expected_dn - dn).square() - variance, 0.0).sum()
    return (excess / torch.where(seen, light_dn.square(), 0.0).sum()).clamp(min=0).sqrt().item()


@dataclass(frozen=True)
class Compared:
    """Some rendered pictures beside what was read there."""

    radiance: Tensor  # [B, H, W, C], rendered
    on_target: Tensor  # [B, H, W], which pixels count
    exposure_time_s: Tensor  # [B, 1, 1, 1]
    dn: Tensor  # [B, H, W, C]

    @torch.no_grad()
    def chi2_sums(self, sensor: Sensor, misfit: float | None) -> tuple[float, float]:
        """Return the squared errors of the readings that count, and the variance that is stated for them, each summed.

        Both are over the variance of noise and own error before clipping, as in `Prediction.chi2_terms`; their ratio is
        1 where errors are as large as stated.

        Args:
            misfit: the model's own error as a share of the light; None: noise alone.
        """
        prediction = sensor.predicted(self.radiance, self.exposure_time_s)
        if misfit is not None:
            error = model_error(self.radiance, self.exposure_time_s, sensor, 1, misfit)
            variance = prediction.variance_dn2 + error.variance_dn2(prediction, sensor)
            prediction = Prediction(prediction.expected_dn, variance, variance.sqrt())
        squares, expected = prediction.chi2_terms(self.dn, sensor.white_dn)
        return squares[self.on_target].sum().item(), expected[self.on_target].sum().item()


def stated_misfit(compared: Sequence[Compared], sensor: Sensor) -> float:
    """Return the own error, as a share of the light, with which the errors of pictures are as large as stated.

    It is the root of chi² = 1 over noise and own error: 0 where noise explains the errors, NaN where no pixel of the
    target can be read or no error of up to ten times the light is large enough.
    """

    def excess(log_share: float) -> float:
        sums = [images.chi2_sums(sensor, math.exp(log_share)) for images in compared]
        return sum(squares for squares, _ in sums) / sum(expected for _, expected in sums) - 1

    least, most = map(math.log, STATED)
    if not sum(images.chi2_sums(sensor, None)[1] for images in compared):
        return math.nan
    if excess(least) <= 0:
        return 0.0
    if excess(most) >= 0:
        return math.nan
    return math.exp(root_scalar(excess, bracket=(least, most), xtol=0.005).root)


@torch.no_grad()
def mean_light2(prediction: Prediction, sensor: Sensor, averaged_pixels: int) -> Tensor:
    """Return the mean square of what is expected above black over the lit pixels of each picture [B, 1, 1, 1], DN²."""
    squares = _light_dn(prediction, sensor).square()
    lit = squares > 4 * prediction.variance_dn2 / averaged_pixels
    count = lit.sum(dim=(1, 2, 3), keepdim=True).clamp(min=1)
    return (squares * lit).sum(dim=(1, 2, 3), keepdim=True) / count


def sampled(sensor: Sensor, *images: Tensor) -> tuple[Tensor, ...]:
    """Return about 50 rows of each image [B, H, W, ...], and columns as far apart; all where blocks were coded."""
    if sensor.jpeg is not None:
        return images
    step = sampling_stride(images[0])
    return tuple(image[:, ::step, ::step] for image in images)


def sampling_stride(images: Tensor) -> int:
    """Return how many pixels apart the samples of images [B, H, ...] lie."""
    return max(1, images.shape[1] // ROWS)


def _light_dn(prediction: Prediction, sensor: Sensor) -> Tensor:
    """Return what is expected above black, as far as it can be read."""
    return (prediction.expected_dn.detach() - sensor.black_dn).clamp(0, sensor.white_dn - sensor.black_dn)
