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
from torch.autograd.function import once_differentiable

BLOCK_PX = 8
# red, green and blue to luma and chromas, T.871
TO_YCC = ((0.299, 0.587, 0.114), (-0.168736, -0.331264, 0.5), (0.5, -0.418688, -0.081312))
TO_RGB = ((1.0, 0.0, 1.402), (1.0, -0.344136, -0.714136), (1.0, 1.772, 0.0))
FULL_SCALE, MIDDLE = 255.0, 128.0  # the largest value; what is taken off luma before it is transformed
# of a coefficient, in its steps: less would leave rounding without a slope; more, and its mean is what was rounded
LEAST_SIGMA, WIDE = 0.05, 0.6
PROJECTIONS = 4  # between what pictures can show and what files can hold, where values were clipped
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
        height, width = mean.shape[1:3]
        means, variances = self._planes(mean), self._variances(variance)
        rounded = [_rounded(*of) for of in zip(means, variances, self._tables, strict=False)]
        back, error = ([planes[k] for planes in rounded] for k in range(2))
        return (
            self._in_colours(back, torch.tensor(TO_RGB), height, width, MIDDLE),
            self._in_colours(error, torch.tensor(TO_RGB).square(), height, width),
        )

    def coefficients(self, picture: Tensor) -> list[Tensor]:
        """Return the coefficients that a picture [H, W, C] came from, in quantisation steps, whole numbers as int16.

        They are those of luma [1, rows, columns, 64] and of chromas [2, ...], by blocks. Where values were clipped they
        follow from what lies beyond the clips, which is found by turns with them: an estimate.

        Args:
            picture: what came back, of which FULL_SCALE is the largest value.
        """
        read, whole = picture[None], self._whole_steps(picture[None])
        height, width = read.shape[1:3]
        for _ in range(PROJECTIONS - 1):
            planes = [_from_steps(of, table) for of, table in zip(whole, self._tables, strict=False)]
            back = self._in_colours(planes, torch.tensor(TO_RGB), height, width, MIDDLE)
            beyond = torch.where(read <= 0, back.clamp(max=0), read)
            beyond = torch.where(read >= FULL_SCALE, back.clamp(min=FULL_SCALE), beyond)
            whole = self._whole_steps(beyond)
        return [of[0].to(torch.int16) for of in whole]

    def _whole_steps(self, shown: Tensor) -> list[Tensor]:
        """Return the coefficients, in whole steps, that come nearest to an image [B, H, W, C] that came back."""
        planes = zip(self._before_interpolation(shown), self._tables, strict=False)
        return [_in_steps(of, table).round() for of, table in planes]

    def part(self, planes: list[Tensor], rows: slice, columns: slice) -> list[Tensor]:
        """Return the coefficients [K, rows, columns, 64] of some pixels, whose first is the first of a block."""
        parts = []
        for plane, averaged in zip(planes, ((1, 1), self.averaged), strict=False):
            at = [slice(None)]
            for pixels, shared, few in zip((rows, columns), self.averaged, averaged, strict=True):
                unit, blocks = BLOCK_PX * shared, shared // few  # of pixels that end with blocks of both
                end = None if pixels.stop is None else -(-pixels.stop // unit) * blocks
                at.append(slice((pixels.start or 0) // unit * blocks, end))
            parts.append(plane[tuple(at)])
        return parts

    def stacked(self, pictures: Tensor) -> list[Tensor]:
        """Return the `coefficients` of pictures [B, H, W, C], each of a shape [B, ...]."""
        of_pictures = [self.coefficients(picture) for picture in pictures]
        return [torch.stack(planes) for planes in zip(*of_pictures, strict=True)]

    def deviance_residuals(self, mean: Tensor, variance: Tensor, stored: list[Tensor]) -> list[Tensor]:
        """Return the root of twice the negative log-likelihood of each stored coefficient, less the least it can be.

        A coefficient says that the value lay within half a step of it. Returned are those of luma [B, 1, rows, columns,
        64] and of chromas [B, 2, rows, columns, 64], by blocks; they have a gradient by the mean if that has one.

        Args:
            mean, variance: as for `moments`.
            stored: as from `coefficients`, of each picture.
        """
        means, variances = self._planes(mean), self._variances(variance)
        return [
            _DevianceResidual.apply(_in_steps(value, steps), _deviation(spread, steps), of.to(value))
            for value, spread, of, steps in zip(means, variances, stored, self._tables, strict=False)
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

    @property
    def blocks_px(self) -> tuple[int, int]:
        """Rows and columns of pixels after which a block of each plane ends."""
        return BLOCK_PX * self.averaged[0], BLOCK_PX * self.averaged[1]

    @property
    def _tables(self) -> tuple[tuple[int, ...], ...]:
        """The quantisation steps of luma and of chromas."""
        return self.luma, self.chroma or self.luma

    def _in_colours(
        self, planes: list[Tensor], turn: Tensor, height: int, width: int, middle: float = 0.0
    ) -> Tensor:
        """Return the image [B, H, W, C] of luma [B, 1, H, W] and averaged chromas [B, 2, h, w], with `turn` [C, 3]."""
        image = planes[0] + middle
        if len(planes) > 1:
            # linear between the middles of what was averaged, as libjpeg does
            whole = F.interpolate(planes[1], image.shape[2:], mode="bilinear", align_corners=False)
            image = torch.einsum("ck,bkhw->bchw", turn.to(image), torch.cat([image, whole], dim=1))
        return image[:, :, :height, :width].movedim(1, -1)

    def _before_interpolation(self, read: Tensor) -> list[Tensor]:
        """Return the planes, as `_planes` does, from which an image that came back was interpolated."""
        planes = self._planes(read)
        if len(planes) > 1:
            height, width = (
                _before_interpolation(n, few).to(read)
                for n, few in zip(planes[1].shape[2:], self.averaged, strict=True)
            )
            planes[1] = height @ planes[1] @ width.T
        return planes

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
    error = (spread * _tensor(steps, image).square()) @ _transform().to(image).square()
    return _from_steps(mean, steps), _in_place(error)


def _from_steps(coefficients: Tensor, steps: tuple[int, ...]) -> Tensor:
    """Return the images [B, K, H, W] of coefficients [B, K, rows, columns, 64], in quantisation steps."""
    return _in_place((coefficients * _tensor(steps, coefficients)) @ _transform().to(coefficients))


def _in_place(blocks: Tensor) -> Tensor:
    """Return the images [B, K, H, W] of the values of blocks [B, K, rows, columns, 64]."""
    parts = blocks.unflatten(4, (BLOCK_PX, BLOCK_PX)).transpose(3, 4)
    return parts.flatten(4, 5).flatten(2, 3)


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


class _DevianceResidual(torch.autograd.Function):
    """The root of -2 ln of the likelihood, over its maximum, that x lies within half of what was stored.

    x is normal with mean `value` and deviation `sigma`; the slope by the mean is known with it.
    """

    @staticmethod
    def forward(ctx, value: Tensor, sigma: Tensor, stored: Tensor) -> Tensor:
        away = value - stored
        distance = away.abs()
        near, far = ((edge - distance) / sigma for edge in (0.5, -0.5))
        log_near = torch.special.log_ndtr(near)
        log_inside = log_near + torch.log1p(-(torch.special.log_ndtr(far) - log_near).exp())
        most = torch.erf(0.5 / math.sqrt(2) / sigma).log()
        residual = (2 * (most - log_inside).clamp(min=0) + 1e-15).sqrt()  # the root has no slope at 0
        if ctx.needs_input_grad[0]:
            densities = torch.exp(-0.5 * near.square() - log_inside) - torch.exp(
                -0.5 * far.square() - log_inside
            )
            ctx.save_for_backward(away.sign() * densities / (math.sqrt(2 * math.pi) * sigma * residual))
        return residual

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grad_outputs: Tensor):  # pyright: ignore[reportIncompatibleMethodOverride]
        (slope,) = ctx.saved_tensors
        return grad_outputs[0] * slope, None, None


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
