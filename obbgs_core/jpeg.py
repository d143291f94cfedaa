"""What JPEG leaves of a picture: mean and variance of the values that come back, for values that are uncertain.

An encoder turns red, green and blue into luma and two chromas, averages the chromas over blocks of pixels, transforms
blocks of 8x8 by the discrete cosine transform, and rounds each coefficient to a multiple of its quantisation step. All
but the rounding is linear. The coefficient of a reading with noise is normal, and mean and variance of its rounded
value are known: a coefficient far below half its step comes back as zero whatever it was, which is what the likelihood
has to know of it.

Source: ITU-T T.81, 1992; T.871, 2011 (colours).
"""

import functools
import math
from dataclasses import dataclass
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

BLOCK_PX = 8
# red, green and blue to luma and chromas, T.871
TO_YCC = ((0.299, 0.587, 0.114), (-0.168736, -0.331264, 0.5), (0.5, -0.418688, -0.081312))
TO_RGB = ((1.0, 0.0, 1.402), (1.0, -0.344136, -0.714136), (1.0, 1.772, 0.0))
FULL_SCALE, MIDDLE = 255.0, 128.0  # the largest value; what is taken off luma before it is transformed
# of a coefficient, in its steps: less would leave rounding without a slope; more, and its mean is what was rounded
LEAST_SIGMA, WIDE = 0.05, 0.6
THRESHOLDS = 2  # of rounding on each side of a coefficient that are looked at


@dataclass(frozen=True)
class JpegCoding:
    """How a file's values were rounded.

    luma, chroma: the 64 quantisation steps, row by row, from slow to fast; chroma may be empty where there is none.
    averaged: rows and columns of pixels that share a chroma.
    """

    luma: tuple[int, ...]
    chroma: tuple[int, ...] = ()
    averaged: tuple[int, int] = (1, 1)

    def __post_init__(self):
        for name, steps in (("luma", self.luma), ("chroma", self.chroma)):
            if len(steps) not in ((64,) if name == "luma" else (0, 64)) or min(steps, default=1) < 1:
                raise ValueError(f"{name} must be 64 quantisation steps of 1 or more, got {steps}")

    @staticmethod
    def of(image: Any) -> "JpegCoding | None":
        """Return how the values of a JPEG that Pillow has opened were rounded; None if it is neither grey nor YCbCr."""
        layers, tables = image.layer, {k: tuple(table) for k, table in image.quantization.items()}
        if len(layers) == 1:
            return JpegCoding(tables[layers[0][3]])
        if len(layers) != 3 or layers[1][1:3] != layers[2][1:3]:
            return None
        (_, wide, high, luma), (_, chroma_wide, chroma_high, chroma) = layers[:2]
        if wide % chroma_wide or high % chroma_high:
            return None
        return JpegCoding(tables[luma], tables[chroma], (high // chroma_high, wide // chroma_wide))

    def moments(self, mean: Tensor, variance: Tensor) -> tuple[Tensor, Tensor]:
        """Return mean and variance [B, H, W, C] of the values that come back, before they are clipped.

        The upper left pixel of an image has to be that of a block, of 16 pixels where chromas are averaged.

        Args:
            mean, variance: [B, H, W, C] of the values that are coded, of which FULL_SCALE is the largest; C is 1 or 3.
                The first may have a gradient.
        """
        height, width, channels = mean.shape[1:]
        means, variances = self._planes(mean), self._variances(variance)
        luma = _rounded(means[0], variances[0], self.luma)
        back, error = luma[0] + MIDDLE, luma[1]
        if channels == 3:
            chroma = _rounded(means[1], variances[1], self.chroma or self.luma)
            # linear between the middles of what was averaged, as libjpeg does
            whole = [F.interpolate(i, back.shape[2:], mode="bilinear", align_corners=False) for i in chroma]
            back, error = torch.cat([back, whole[0]], dim=1), torch.cat([error, whole[1]], dim=1)
            turn = torch.tensor(TO_RGB).to(mean)
            back = torch.einsum("ck,bkhw->bchw", turn, back)
            error = torch.einsum("ck,bkhw->bchw", turn.square(), error)
        back, error = (image[:, :, :height, :width].movedim(1, -1) for image in (back, error))
        return back, error

    def deviance_residuals(self, mean: Tensor, variance: Tensor, stored: Tensor) -> list[Tensor]:
        """Return the root of twice the negative log-likelihood of each stored coefficient, less the least it can be.

        A coefficient says that the value lay within half a step of it. Returned are those of luma [B, 1, rows, columns,
        64] and of chromas [B, 2, rows, columns, 64], by blocks; they have a gradient by the mean if that has one.

        What came back does not tell the coefficients exactly where it was clipped.

        Args:
            mean, variance: as for `moments`.
            stored: [B, H, W, C], what came back.
        """
        means, variances, read = self._planes(mean), self._variances(variance), self._planes(stored)
        if len(read) > 1:
            height, width = (
                _before_interpolation(n, few) for n, few in zip(read[1].shape[2:], self.averaged, strict=True)
            )
            read[1] = height.to(stored) @ read[1] @ width.to(stored).T
        tables = (self.luma, self.chroma or self.luma)
        return [
            _deviance_residual(_in_steps(value, steps), _deviation(spread, steps), _in_steps(values, steps))
            for value, spread, values, steps in zip(means, variances, read, tables, strict=False)
        ]

    def in_pixels(self, residuals: list[Tensor], height: int, width: int) -> Tensor:
        """Return the root mean square [B, H, W, 1] of the residuals of the blocks that each pixel lies in."""
        sums = [
            F.interpolate(
                of.square().sum(dim=(1, 4))[:, None], scale_factor=[float(BLOCK_PX * n) for n in averaged]
            )
            for of, averaged in zip(residuals, ((1, 1), self.averaged), strict=False)
        ]
        total = sums[0] + sums[1] / math.prod(self.averaged) if len(sums) > 1 else sums[0]
        return (total / BLOCK_PX**2).sqrt()[:, 0, :height, :width, None]

    def _planes(self, image: Tensor) -> list[Tensor]:
        """Return luma [B, 1, H, W], less the middle, and the averaged chromas [B, 2, h, w], in whole blocks."""
        luma, *few = self._averaged(image, torch.tensor(TO_YCC))
        return [luma - MIDDLE, *few]

    def _variances(self, variance: Tensor) -> list[Tensor]:
        """Return the variances of `_planes`, where those of pixels are independent."""
        luma, *few = self._averaged(variance, torch.tensor(TO_YCC).square())
        return [luma, *(of / math.prod(self.averaged) for of in few)]

    def _averaged(self, image: Tensor, turn: Tensor) -> list[Tensor]:
        """Return an image [B, H, W, C] of whole blocks in other colours; all but the first are averaged."""
        height, width, channels = image.shape[1:]
        image = image.movedim(-1, 1)
        if channels == 3:
            image = torch.einsum("kc,bchw->bkhw", turn.to(image), image)
        size = [BLOCK_PX * n for n in (self.averaged if channels == 3 else (1, 1))]
        image = F.pad(image, (0, -width % size[1], 0, -height % size[0]), mode="replicate")
        return [image[:, :1], *([F.avg_pool2d(image[:, 1:], self.averaged)] if channels == 3 else [])]


def _in_steps(image: Tensor, steps: tuple[int, ...]) -> Tensor:
    """Return the coefficients [B, K, rows, columns, 64] of images [B, K, H, W], in quantisation steps."""
    rows, columns = (n // BLOCK_PX for n in image.shape[2:])
    shape = (*image.shape[:2], rows, BLOCK_PX, columns, BLOCK_PX)
    return image.reshape(shape).transpose(3, 4).flatten(4) @ (
        _transform().to(image).T / _tensor(steps, image)
    )


def _deviation(variance: Tensor, steps: tuple[int, ...]) -> Tensor:
    """Return the deviation [B, K, rows, columns, 64] of coefficients, in steps, by that of pixels [B, K, H, W]."""
    # the noise of pixels is independent, and nearly the same all over a block
    sigma = F.avg_pool2d(variance, BLOCK_PX).sqrt()[..., None] / _tensor(steps, variance)
    return sigma.clamp(min=LEAST_SIGMA)


def _rounded(image: Tensor, variance: Tensor, steps: tuple[int, ...]) -> tuple[Tensor, Tensor]:
    """Return mean and variance of images [B, K, H, W] whose coefficients were rounded to multiples of steps."""
    mean, spread = _rounding(_in_steps(image, steps), _deviation(variance, steps))
    transform, step = _transform().to(image), _tensor(steps, image)
    back, error = (mean * step) @ transform, (spread * step.square()) @ transform.square()
    parts = (*mean.shape[:4], BLOCK_PX, BLOCK_PX)
    back, error = (blocks.view(parts).transpose(3, 4).reshape(image.shape) for blocks in (back, error))
    return back, error


def _tensor(steps: tuple[int, ...], like: Tensor) -> Tensor:
    return torch.tensor(steps, dtype=like.dtype, device=like.device)


def _rounding(value: Tensor, sigma: Tensor) -> tuple[Tensor, Tensor]:
    """Return mean and variance of round(x) for x normal with mean `value` and deviation `sigma`.

    Far above WIDE rounding is a small error of variance 1/12.
    """
    nearest = value.detach().round()
    offset = value - nearest
    mean, square = torch.zeros_like(value), torch.zeros_like(value)
    for k in range(THRESHOLDS):
        above = torch.special.ndtr((offset - (k + 0.5)) / sigma)
        below = torch.special.ndtr(-(offset + (k + 0.5)) / sigma)
        mean = mean + above - below
        square = square + (2 * k + 1) * (above + below).detach()
    wide = sigma > WIDE
    variance = torch.where(wide, sigma.square() + 1 / 12, square - mean.detach().square())
    return torch.where(wide, value, nearest + mean), variance


def _deviance_residual(value: Tensor, sigma: Tensor, stored: Tensor) -> Tensor:
    """Return the root of -2 ln of the likelihood, over its maximum, that x lies within half of what was stored.

    x is normal with mean `value` and deviation `sigma`.
    """
    away = (value - stored).abs()
    near, far = (torch.special.log_ndtr((edge - away) / sigma) for edge in (0.5, -0.5))
    most = torch.erf(0.5 / math.sqrt(2) / sigma).log()
    deviance = 2 * (most - near - torch.log1p(-(far - near).exp())).clamp(min=0)
    return (deviance + 1e-15).sqrt()  # the root has no derivative at 0


@functools.cache
def _before_interpolation(n: int, averaged: int) -> Tensor:
    """Return the matrix [n, n] that turns means over so many pixels of interpolated values into the values."""
    if averaged == 1:
        return torch.eye(n)
    whole = F.interpolate(torch.eye(n)[None], averaged * n, mode="linear", align_corners=False)
    return torch.linalg.inv(F.avg_pool1d(whole, averaged)[0].T)


@functools.cache
def _transform() -> Tensor:
    """Return the orthonormal discrete cosine transform of a block [64, 64]: frequencies by places."""
    n = torch.arange(BLOCK_PX, dtype=torch.float64)
    along = torch.cos((2 * n + 1) * n[:, None] * math.pi / (2 * BLOCK_PX)) * math.sqrt(2 / BLOCK_PX)
    along[0] /= math.sqrt(2)
    return torch.kron(along, along)
