"""The level of empty sky: what a pixel reads where the target is not, measured on the frames themselves.

A sensor's stated black level leaves out what a pass adds: a pedestal that drifts with temperature, and stray light that
changes from one side of the picture to the other. Both are added to every reading, target or sky, so that a plane in
each frame and channel describes them. The plane is fitted to blocks of pixels that scatter as empty sky does; readings
are normal variables clipped at zero (Tobin 1958), and the expectation of what is clipped is fitted.

Frames learn from each other: each plane is the mean of what its own frame shows and of what all show, weighted by how
precisely the one is measured and by how much frames differ (empirical Bayes; Efron and Morris, Data analysis using
Stein's estimator, 1975).
"""

import dataclasses
import math
import statistics
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import torch
import torch.nn.functional as F
from torch import Tensor

from obbgs_core.background import grown
from obbgs_core.compact import Compact, held, whole
from obbgs_core.compiled import each
from obbgs_core.frames import TrainingFrame
from obbgs_core.jpeg import BLOCK_PX, FULL_SCALE
from obbgs_core.process import give_back
from obbgs_core.sensor import Sensor, clipped_mean, clipped_moments, dark_reading, noise_excess

NOISE_FRAMES = 12  # about so many, spread evenly, by which the noise is measured
# of the scatter of empty sky over that of the sensor model, or the reverse; frames that fit it have 0.93 to 0.97
CLEAR_EXCESS = 1.3
UNSMOOTHED = 1.1  # ratio of the scatter of pixels two apart to that of neighbours; noise has 1.02 to 1.05
BLOCKS = 28  # along the shorter side of the picture, about
FEWEST_BLOCKS = 12  # of sky, that a plane can be fitted to
MOST_BLOCKS = 40_000  # of a frame: of more, every so many rows and columns are looked at
# The first plane has about this share of all blocks below it. Most pictures are mostly sky, and light of the target is
# never below it.
LOW_SHARE = 0.2
# The first noise is that of about this share of the blocks, and half of it may be clipped, which leaves so much of a
# deviation.
QUIET_SHARE, CLIPPED_SIGMA = 0.25, math.sqrt(0.5 - 0.5 / math.pi)
FAR = 3.0  # a block whose mean is more deviations away from the plane is no empty sky
TOO_VARIED = 4.0  # nor is one whose variance is above that of noise by so many of its deviations
# Nothing is darker than the sky: where more blocks than this share are far below the plane, it lies in the target.
MOST_BELOW = 0.02
FAR_BELOW = 4.0
# Flight sends what is far from the target as the black level, in areas wider than this, px. Empty sky of noise that is
# clear of rounding reads one number all over such a square as good as never.
CUT_PX, CLEAR_NOISE_DN = 5, 1.0
CUT_BELOW = 2.0  # deviations of a reading: where flight has cut, the sky is lower than that above black
CUT_BLOCK_PX = 4  # blocks are as small in passes that were cut, since what is left of the sky is a rim
FIRST_SWEEPS, SWEEPS = 30, 6  # of the first plane, and of the plane through sky
# So many blocks, about, are computed with at once, which bounds the memory. Their frames are a multiple of 16, which
# libraries of matrices take together: results do not depend on how many there are.
BLOCKS_AT_ONCE, FRAMES_TOGETHER = 1 << 19, 16
# Of a reading's deviation: a level that departs by less from the stated black, in the mean of squares over frames and
# pixels, is no reason to doubt it. Windows of 25 pixels tell sky from a face of 0.2 (`start.hull.FAINTEST_SIGMA`).
NEGLIGIBLE = 0.03
NEGLIGIBLE_CODED = 0.1  # the same of the noise before coding as JPEG, which rounds the mean of each block
CERTAIN = 3.0  # and it has to be above the error of measurement by so many deviations


@dataclass(frozen=True)
class SkyLevel:
    """What empty sky reads in some frames.

    frame_ids: of the frames.
    planes_dn: [F, C, 3] the level above the stated black at the picture's centre, and how much it rises from there to
        the right edge and to the lower edge, DN; zeros where the stated level fits.
    sigma_dn: [F, C, 3] the deviations of `planes_dn`; infinite for a frame that shows too little sky of its own.
    """

    frame_ids: list[int]
    planes_dn: Tensor
    sigma_dn: Tensor

    @property
    def fits(self) -> bool:
        """Whether the stated black level is that of empty sky."""
        return not self.planes_dn.any()

    def by_frame(self) -> dict[int, list[float | None]]:
        """Return the level above black in the middle of each frame and its deviation, DN, means of the channels.

        The deviation is None for a frame that shows too little sky of its own: its level is the mean of the others.
        """
        values = torch.stack([self.planes_dn, self.sigma_dn])[..., 0].mean(dim=2).T.tolist()
        return {
            number: [round(v, 3) if math.isfinite(v) else None for v in pair]
            for number, pair in zip(self.frame_ids, values, strict=True)
        }

    def __str__(self) -> str:
        if self.fits:
            return "empty sky reads the stated black level"
        level, rise = self.planes_dn[..., 0], self.planes_dn[..., 1:].norm(dim=2)
        return (
            f"empty sky reads {level.min():.2f} to {level.max():.2f} DN more than the stated black level in the middle "
            f"of the frames, and up to {rise.max():.2f} DN more at an edge: this is taken off every reading"
        )


def levelled(frames: list[TrainingFrame], sensor: Sensor) -> tuple[list[TrainingFrame], Sensor, SkyLevel]:
    """Measure the level of empty sky in frames of one size, and take its departure from the stated black off them.

    Frames that have the Earth in view take the mean of the others. In front of another background than black, and where
    fewer than half of those others show sky, nothing is measured and the stated level holds.

    Returns:
        The frames and the sensor with which their readings say of the light what those given say of light and
        departure; those given where the stated level fits. And the level.
    """
    channels = frames[0].shape[2]
    nothing = torch.zeros(len(frames), channels, 3)
    ids = [f.id for f in frames]
    told = SkyLevel(ids, nothing, torch.full_like(nothing, math.inf))
    if frames[0].background:
        return frames, sensor, told
    black = [i for i, f in enumerate(frames) if f.earth_m is None]
    if not black:
        return frames, sensor, told
    planes, covariance = nothing.double(), torch.full_like(nothing, math.inf).double()
    planes[black], covariance[black], sigma_dn = _measured([frames[i] for i in black], sensor)
    measured = covariance.isfinite().all(dim=2).all(dim=1)
    if 2 * int(measured.sum()) < len(black):
        return frames, sensor, told
    planes = planes - torch.tensor([sensor.black_dn, 0, 0])
    negligible_dn = NEGLIGIBLE * sigma_dn if sensor.jpeg is None else NEGLIGIBLE_CODED * _noise_dn(sensor)
    departs = _departs(planes[measured], covariance[measured], negligible_dn)
    planes, covariance = _shared(planes, covariance, measured)
    sigma_dn = torch.where(measured[:, None, None], covariance.sqrt(), math.inf).float()
    if not departs:
        return frames, sensor, dataclasses.replace(told, sigma_dn=sigma_dn)
    level = SkyLevel(ids, planes.float(), sigma_dn)
    return *_without(frames, sensor, level.planes_dn), level


def field(plane_dn: Tensor, height: int, width: int) -> Tensor:
    """Return the departure [H, W, C] of one frame's planes [C, 3], DN."""
    return torch.einsum("hwk,ck->hwc", _basis(height, width).to(plane_dn), plane_dn)


def without_plane(frame: TrainingFrame, plane_dn: Tensor, sensor: Sensor) -> TrainingFrame:
    """Return one frame without the departure of its planes [C, 3]; full scale still says "at least this much"."""
    dn = (frame.dn - field(plane_dn, *frame.dn.shape[:2])).clamp(min=0)
    dn[frame.dn >= sensor.white_dn] = sensor.white_dn
    return dataclasses.replace(frame, dn=dn)


def cut_pixels(sensor: Sensor, dn: Tensor) -> Tensor:
    """Return which pixels [H, W] of readings dn [H, W, C] flight has not sent: they read the black level all over."""
    # with less noise, or a black level below it, many readings of the sky are exactly that
    if not CLEAR_NOISE_DN < _noise_dn(sensor) < sensor.black_dn:
        return torch.zeros(dn.shape[:2], dtype=torch.bool)
    other = ~(dn == int(sensor.black_dn)).all(dim=2)
    return grown(~grown(other, CUT_PX // 2), CUT_PX // 2)


def _basis(rows: int, columns: int) -> Tensor:
    """Return 1 and the place from -1 at the left and upper edges to 1 at the others, of cells [rows, columns, 3]."""
    y, x = ((torch.arange(n) + 0.5) * 2 / n - 1 for n in (rows, columns))
    y, x = torch.meshgrid(y, x, indexing="ij")
    return torch.stack([torch.ones_like(x), x, y], dim=-1)


def _measured(frames: list[TrainingFrame], sensor: Sensor) -> tuple[Tensor, Tensor, float]:
    """Return planes [F, C, 3] and their variances, infinite where a frame shows no sky, and a reading's deviation."""
    height, width, channels = frames[0].shape
    px = max(2, round(min(height, width) / BLOCKS))
    cut = list(each(partial(_cut, sensor), frames))
    if any(bool(whole(mask).any()) for mask in cut):
        px = min(px, CUT_BLOCK_PX)
    if sensor.jpeg is not None:  # within its blocks readings are not independent
        px = BLOCK_PX * max(1, round(px / BLOCK_PX))
    rows, columns = height // px, width // px
    if rows * columns < FEWEST_BLOCKS:
        nothing = torch.zeros(len(frames), channels, 3).double()
        return nothing, torch.full_like(nothing, math.inf), 1.0
    step = math.ceil(math.sqrt(rows * columns / MOST_BLOCKS))
    kept = -(-rows // step) * -(-columns // step)
    mean, variance = torch.empty(2, len(frames), channels, kept).double()  # [F, C, B]
    for i, moments in enumerate(each(lambda f: _block_moments(f.dn, px, step), frames)):
        mean[i], variance[i] = moments
    known = torch.stack(
        [F.max_pool2d(_taken(whole(m)[None], px, step).float(), px).flatten() == 0 for m in cut]
    )  # [F, B]
    shown = known.sum(dim=1) >= FEWEST_BLOCKS
    known |= ~shown[:, None]
    places = _taken(_basis(height, width).movedim(-1, 0), px, step)
    basis = F.avg_pool2d(places, px).flatten(1).T.double()  # [B, 3]
    parts = _parts(len(frames), kept)

    def of_parts(work: Callable[[slice], Tensor]) -> Tensor:
        return torch.cat(list(map(work, parts)))

    quiet = of_parts(lambda at: _quantile(variance[at].mean(dim=1), known[at], QUIET_SHARE)).median()
    sigma_dn = max(math.sqrt(float(quiet)) / CLIPPED_SIGMA, math.sqrt(1 / 12))
    low, even = torch.zeros(2, len(frames), 3).double()
    for at in parts:
        levels = _levels(mean[at].mean(dim=1), sigma_dn)
        even[at, 0] = _quantile(levels, known[at], LOW_SHARE)
        low[at] = _low_planes(basis, levels, known[at], sigma_dn)
    size, starts = (px * px, -(-rows // step)), (low, even)
    given = (basis, mean, variance, known, size, sigma_dn, sensor)
    found = list(each(lambda start: _through_sky(start, *given), starts))
    # of the two planes of a frame that with more sky; the noise as most frames show it
    first = found[0].count >= found[1].count
    plane = torch.where(first[:, None], found[0].plane, found[1].plane)
    sky = torch.where(first[:, None], found[0].sky, found[1].sky)
    usable = shown & (found[0].count.maximum(found[1].count) > 0)
    sigma_dn = max(found, key=lambda f: int(f.count.sum())).sigma_dn

    def of_channel(channel: int) -> tuple[Tensor, Tensor]:
        own, of_reading = plane.clone(), torch.empty_like(plane)
        for at in parts:
            for _ in range(SWEEPS):
                own[at], of_reading[at] = _fitted(
                    own[at], basis, mean[at, channel], sky[at], sigma_dn, sensor
                )
        of_mean = of_reading / (px * px)
        if sensor.jpeg is not None:
            of_mean = of_mean * (1 + _of_coding(sensor, px * px) * px * px / sigma_dn**2)
            own, of_mean = _before_coding(own, of_mean, sigma_dn, sensor)
        return own, of_mean

    planes, variances = zip(*each(of_channel, range(channels)), strict=True)
    errors = torch.where(usable[:, None, None], torch.stack(variances, dim=1), math.inf)
    return torch.stack(planes, dim=1), errors, sigma_dn


@dataclass(frozen=True)
class _Fit:
    """Planes [F, 3] through the sky of frames, which blocks [F, B] are sky, and a reading's deviation.

    count: [F] of blocks of sky; 0 where they are too few, or where something is darker than the plane.
    """

    plane: Tensor
    sky: Tensor
    count: Tensor
    sigma_dn: float


def _cut(sensor: Sensor, frame: TrainingFrame) -> Tensor | Compact:
    """Return where flight has cut the sky of a frame, [H, W] bool."""
    cut = held(frame.seen(partial(cut_pixels, sensor), 2 * CUT_PX))
    if isinstance(cut, Compact):  # what one large frame frees is in pieces that the next does not fit into
        give_back()
    return cut


def _through_sky(
    plane: Tensor,
    basis: Tensor,
    mean: Tensor,
    variance: Tensor,
    known: Tensor,
    size: tuple[int, int],
    sigma_dn: float,
    sensor: Sensor,
) -> _Fit:
    """Return planes after sweeps that tell sky from the target and fit plane and noise to the sky.

    Args:
        plane: [F, 3] the first planes.
        mean, variance: [F, C, B] of the readings of each block.
        known: [F, B] bool, the blocks that are as the camera read them.
        size: pixels of a block, and rows of blocks.
    """
    readings, parts = size[0] * mean.shape[1], _parts(len(mean), mean.shape[2])
    plane, sky, ratio, below = plane.clone(), torch.ones_like(known), *torch.zeros(2, len(mean)).double()
    for _ in range(SWEEPS):
        for at in parts:
            grey, scatter = mean[at].mean(dim=1), variance[at].mean(dim=1)
            expected, spread = _moments(plane[at], basis, sigma_dn, sensor)
            of_mean = spread / readings + _of_coding(sensor, readings)
            seen = (grey, scatter, known[at], expected, spread, of_mean)
            sky[at] = _sky_blocks(*seen, readings, size[1])
            plane[at], _ = _fitted(plane[at], basis, grey, sky[at], sigma_dn, sensor)
            _, spread = _moments(plane[at], basis, sigma_dn, sensor)
            ratio[at] = (scatter * sky[at]).sum(dim=1) / (spread * sky[at]).sum(dim=1)
        if ratio.isfinite().any():
            sigma_dn *= math.sqrt(float(ratio.nanmedian()))
    for at in parts:
        expected, spread = _moments(plane[at], basis, sigma_dn, sensor)
        of_mean = spread / readings + _of_coding(sensor, readings)
        far = torch.where(known[at], FAR_BELOW * of_mean.sqrt(), CUT_BELOW * spread.sqrt())
        below[at] = (mean[at].mean(dim=1) < expected - far).double().mean(dim=1)
    count = sky.sum(dim=1)
    return _Fit(plane, sky, count * ((count >= FEWEST_BLOCKS) & (below <= MOST_BELOW)), sigma_dn)


def _parts(frames: int, blocks: int) -> list[slice]:
    """Return frames in parts whose blocks are few enough to be computed with at once."""
    together = FRAMES_TOGETHER * max(1, BLOCKS_AT_ONCE // (FRAMES_TOGETHER * blocks))
    return [slice(first, min(first + together, frames)) for first in range(0, frames, together)]


def _noise_dn(sensor: Sensor) -> float:
    """Return the deviation of a reading without light as the sensor states it, before anything is clipped."""
    return math.hypot(sensor.read_noise_dn, math.sqrt(1 / 12))


def _of_coding(sensor: Sensor, readings: int) -> float:
    """Return the variance, DN², of means of so many readings that JPEG adds to what their scatter says, at most.

    It keeps slow noise while it smooths the fast, and rounds the mean of each block.
    """
    if sensor.jpeg is None:
        return 0.0
    step_dn = sensor.jpeg.luma[0] / BLOCK_PX * sensor.white_dn / FULL_SCALE
    return dark_reading(sensor)[1] ** 2 / readings + step_dn**2 / 12


def _before_coding(
    planes: Tensor, variance: Tensor, sigma_dn: float, sensor: Sensor
) -> tuple[Tensor, Tensor]:
    """Return planes [F, 3] and their variances, fitted to pictures that were stored as JPEG, of what was stored.

    Coding smooths readings that were clipped before: their mean stays, but they scatter by `sigma_dn`, less than the
    sensor's noise, and near zero most of their mean is that of the clip.
    """
    level, narrow = planes[:, 0], torch.full_like(planes[:, 0], sigma_dn)
    wide = torch.full_like(level, _noise_dn(sensor))
    before = _levels(clipped_mean(level, narrow), float(wide[0]))
    slope = torch.special.ndtr(level / narrow) / torch.special.ndtr(before / wide)
    planes = torch.cat([before[:, None], planes[:, 1:] * slope[:, None]], dim=1)
    return planes, variance * slope.square()[:, None]


def _block_moments(dn: Tensor, px: int, step: int = 1) -> tuple[Tensor, Tensor]:
    """Return mean and variance [C, B] of blocks of px x px readings dn [H, W, C], those of `_taken`."""
    image = _taken(dn.movedim(-1, 0), px, step).double()
    mean, square = (F.avg_pool2d(values, px).flatten(1) for values in (image, image.square()))
    return mean, ((square - mean.square()) * px**2 / (px**2 - 1)).clamp(min=0)


def _taken(image: Tensor, px: int, step: int) -> Tensor:
    """Return of an image [C, H, W] the blocks of px x px pixels of every so many rows and columns of blocks."""
    if step == 1:
        return image
    rows, columns = (side // px for side in image.shape[1:])
    blocks = image[:, : rows * px, : columns * px].unflatten(1, (rows, px)).unflatten(3, (columns, px))
    return blocks[:, ::step, :, ::step].flatten(3).flatten(1, 2)


def _levels(mean: Tensor, sigma_dn: float) -> Tensor:
    """Return the levels whose readings, clipped at zero, have given means; by Newton's method, from above."""
    level, sigma = mean.clone(), torch.full_like(mean, sigma_dn)
    for _ in range(SWEEPS):
        level -= (clipped_mean(level, sigma) - mean) / torch.special.ndtr(level / sigma)
        level.clamp_(min=-FAR * sigma_dn)
    return level


def _quantile(values: Tensor, known: Tensor, share: float) -> Tensor:
    """Return the value of each row [F] below which a share of its known values [F, B] lie."""
    return values.where(known, torch.nan).nanquantile(share, dim=1)


def _low_planes(basis: Tensor, mean: Tensor, known: Tensor, sigma_dn: float) -> Tensor:
    """Return planes [F, 3] below which LOW_SHARE of the known blocks' levels [F, B] lie.

    Source: Koenker and Bassett, Regression quantiles, 1978; by iteratively reweighted least squares.
    """
    weight, planes = known.to(mean), torch.zeros(len(mean), 3).double()
    for _ in range(FIRST_SWEEPS):
        planes = _solved(basis, mean, weight)
        above = mean - planes @ basis.T
        weight = known * torch.where(above > 0, LOW_SHARE, 1 - LOW_SHARE) / (above.abs() + 0.05 * sigma_dn)
    return planes


def _solved(basis: Tensor, values: Tensor, weight: Tensor) -> Tensor:
    """Return the planes [F, 3] that fit values [F, B] best by weighted squares."""
    normal = torch.einsum("bi,fb,bj->fij", basis, weight, basis)
    return torch.linalg.solve(normal, torch.einsum("bi,fb->fi", basis, weight * values))


def _moments(planes: Tensor, basis: Tensor, sigma_dn: float, sensor: Sensor) -> tuple[Tensor, Tensor]:
    """Return mean and variance [F, B] of readings of sky at the level of the planes, clipped as the sensor clips."""
    level = planes @ basis.T
    return clipped_moments(level, torch.full_like(level, sigma_dn), sensor.white_dn)


def _sky_blocks(
    mean: Tensor,
    variance: Tensor,
    known: Tensor,
    expected: Tensor,
    spread: Tensor,
    of_mean: Tensor,
    readings: int,
    rows: int,
) -> Tensor:
    """Return which known blocks [F, B] read and scatter as empty sky, and have no neighbours that do not.

    of_mean: [F, B] the variance of the mean of a block.
    """
    lit = (mean - expected).abs() > FAR * of_mean.sqrt()
    lit |= variance > spread * (1 + TOO_VARIED * math.sqrt(2 / readings))
    lit &= known
    grid = lit.double().view(len(lit), 1, rows, -1)
    near = F.max_pool2d(grid, 3, 1, 1).view(len(lit), -1) > 0
    enough = (~near & known).sum(dim=1, keepdim=True) >= FEWEST_BLOCKS
    return known & torch.where(enough, ~near, ~lit)


def _fitted(
    planes: Tensor, basis: Tensor, mean: Tensor, sky: Tensor, sigma_dn: float, sensor: Sensor
) -> tuple[Tensor, Tensor]:
    """Return planes [F, 3] after one Gauss-Newton step towards the block means, and their variances for one reading."""
    expected, spread = _moments(planes, basis, sigma_dn, sensor)
    slope = torch.special.ndtr(planes @ basis.T / sigma_dn)  # of the clipped mean by the level
    weight = sky / spread.clamp(min=1e-9)
    normal = torch.einsum("bi,fb,bj->fij", basis, weight * slope.square(), basis)
    normal = normal + 1e-9 * torch.eye(3).double()
    step = torch.linalg.solve(normal, torch.einsum("bi,fb->fi", basis, weight * slope * (mean - expected)))
    return planes + step, torch.linalg.inv(normal).diagonal(dim1=1, dim2=2)


def _departs(planes: Tensor, variance: Tensor, negligible_dn: float) -> bool:
    """Return whether planes [F, C, 3] depart from zero by more than what is negligible and than their errors.

    Mean squares over the picture are compared, those of all frames and those of the mean plane.
    """
    over_picture = torch.tensor([1, 1 / 3, 1 / 3]).double()  # the mean square of each term
    noise = float((variance @ over_picture).mean())
    for seen, error, count in ((planes, noise, len(planes)), (planes.mean(dim=0), noise / len(planes), 1)):
        excess = float((seen.square() @ over_picture).mean()) - error
        if excess > negligible_dn**2 + CERTAIN * error * math.sqrt(2 / count):
            return True
    return False


def _shared(planes: Tensor, variance: Tensor, measured: Tensor) -> tuple[Tensor, Tensor]:
    """Return planes and their variances [F, C, 3] after each frame has learnt from the others."""
    seen, noise = planes[measured], variance[measured]
    mean = seen.mean(dim=0)
    between = (seen.var(dim=0, unbiased=len(seen) > 1) - noise.mean(dim=0)).clamp(min=0)
    trust = torch.where(variance.isfinite(), between / (between + variance), 0.0)
    own = torch.where(variance.isfinite(), planes, mean)
    of_others = between + noise.mean(dim=0) / len(seen)
    posterior = trust * variance.nan_to_num(posinf=0) + (1 - trust) * of_others
    return mean + trust * (own - mean), posterior


def _without(
    frames: list[TrainingFrame], sensor: Sensor, planes_dn: Tensor
) -> tuple[list[TrainingFrame], Sensor]:
    """Return frames and sensor without the fields of given planes.

    A reading clipped at zero says "at most this much", one at full scale "at least this much". Both still do after the
    field was taken off, if all readings are clipped again at levels that no field moves the old ones beyond.
    """
    height, width = frames[0].shape[:2]
    corner = planes_dn[..., 1:].abs().sum(dim=2)
    lowest = min(0.0, float((planes_dn[..., 0] - corner).min()))
    highest = max(0.0, float((planes_dn[..., 0] + corner).max()))
    black_dn = max(0.0, sensor.black_dn + lowest)
    white_dn = sensor.white_dn - (highest - (black_dn - sensor.black_dn))

    def corrected(given: tuple[TrainingFrame, Tensor]) -> TrainingFrame:
        frame, plane = given
        off = field(plane, height, width) - (black_dn - sensor.black_dn)
        dn = (frame.dn - off).clamp(0, white_dn)
        dn[frame.dn <= 0], dn[frame.dn >= sensor.white_dn] = 0.0, white_dn
        dn[cut_pixels(sensor, frame.dn)] = black_dn
        return dataclasses.replace(frame, dn=dn)

    changed = dataclasses.replace(sensor, black_dn=black_dn, white_dn=white_dn)
    return list(each(corrected, zip(frames, planes_dn, strict=True))), changed


def with_noise_seen(frames: list[TrainingFrame], sensor: Sensor) -> tuple[Sensor, str]:
    """Return the sensor with the read noise that empty sky shows, and in words what was changed, if anything.

    With less than there is, noise would count as light: there would be no empty sky, and no hull. With more, faint
    parts of the target would count as noise. Smoothed pictures scatter less too, but their nearest neighbours most.
    """
    shown = [frame for frame in frames if frame.earth_m is None] or frames
    shown = shown[:: max(1, len(shown) // NOISE_FRAMES)]
    dark_dn, _ = dark_reading(sensor)
    empty_dn = [
        max(dark_dn, sensor.expected_dn(torch.tensor(frame.background), frame.exposure_time_s).item())
        for frame in shown
    ]
    found = each(lambda of: noise_excess(of[0].dn, sensor, of[1]), zip(shown, empty_dn, strict=True))
    ratios, farther = zip(*found, strict=True)
    excess = statistics.median(ratios)
    too_much = sensor.jpeg is None and excess < 1 / CLEAR_EXCESS and statistics.median(farther) < UNSMOOTHED
    if not (excess > CLEAR_EXCESS or too_much):
        return sensor, ""
    seen = dataclasses.replace(
        sensor, read_noise_dn=excess * sensor.variance_dn2(torch.tensor(sensor.black_dn)).sqrt().item()
    )
    return seen, (
        f"read noise taken as {seen.read_noise_dn:.2f} DN instead of the stated {sensor.read_noise_dn:.2f} DN: "
        f"empty sky scatters {excess:.2g} times as much as that"
    )
