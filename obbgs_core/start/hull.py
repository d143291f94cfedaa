"""The visual hull: the voxels in which most long exposures see light. Space is black, so light is target.

In front of another background, how far a reading departs from the background's takes the place of light (`light`).

A "sigma" here is the deviation of an unlit reading, or of the mean of a window of such readings.
"""

import dataclasses
import logging
import math
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import torch
import torch.nn.functional as F
from scipy.ndimage import uniform_filter
from torch import Tensor

from obbgs_core.background import grown
from obbgs_core.compact import hold_compact
from obbgs_core.compiled import each
from obbgs_core.frames import TrainingFrame
from obbgs_core.sensor import Sensor, dark_reading

log = logging.getLogger(__name__)
# a window's mean above this is light with few false alarms; the target's radius is taken from it
CERTAIN_SIGMA = 5.5
# A window is empty sky where its mean is this many natural logarithms of odds likelier of nothing than of the faintest
# face that should not be taken for nothing, of so many sigmas in each pixel.
SKY_ODDS, FAINTEST_SIGMA = 1.6, 0.2
BRIGHT_SIGMA = 4.0  # of a single pixel
EDGE_SIGMA = 1.5  # of a single pixel beside brighter ones
# a window's mean above this is likely light: some of it is noise, but one view in twenty may disagree on a voxel
LIKELY_SIGMA = 2.0
WINDOWS_PX = (3, 5, 9, 15)  # wide windows find shadowed faces that no single pixel shows
SKY_WINDOWS_PX = (5, 9, 15, 25)
# Certain light reaches about so far beyond edges; inside of it, many pixels of thin parts are still covered in part.
RIM_PX = 1
FEWEST_BRIGHT_PX = 4  # a frame with fewer counts as black
FEWEST_CHOSEN = 3  # pixels of a window that a mean is taken of
SPECK = 0.4  # a certain pixel is noise where no more than this share of its 3x3 window is certain
INSIDE = 0.9995  # share of all certain pixels that the target's radius encloses
AGREEMENT = 0.95  # share of views that must see light where a voxel projects
COARSE_VOXELS = 64  # along each axis of the first grid
SUBDIVISIONS = 2  # of the first grid, at most; each halves the voxels
VIEWS_AT_ONCE = 4  # between two looks for points that are out of the hull already
# A coarse grid is not carved where noise would keep more than WORTH of it, as every SAMPLED-th of its voxels tells.
SAMPLED, WORTH = 64, 0.5
FINEST_PX = 0.7  # smallest width of a voxel in the image
VOXELS_AT_ONCE = 1_000_000  # bounds the memory
POINTS_AT_ONCE = 1 << 17  # of one thread; with fewer, threads of Python wait for each other


@dataclass(frozen=True)
class Silhouette:
    """Where one frame sees light, by confidence; [H, W] bool each.

    certain: light with few false alarms; likely: light with few misses; sky: empty, with few false alarms. Nearly all
    empty pixels that are far from light pass as sky, a fifth of those right beside a faint face, and one in forty of a
    face of FAINTEST_SIGMA.
    grown_px: by how much likely light was grown, and sky shrunk, or by how much motion spread the light.
    """

    certain: Tensor
    likely: Tensor
    sky: Tensor
    world_to_camera: Tensor
    K: Tensor
    grown_px: int = 0

    @property
    def solid(self) -> Tensor:
        """The pixels [H, W] inside certain light, away from its rim by RIM_PX and by as much as likely light was grown:
        something opaque is there, however dark, since a spacecraft is not translucent."""
        return ~grown(~self.certain, RIM_PX + self.grown_px)

    def dilated(self, reach_px: int) -> "Silhouette":
        """Return the silhouette with its likely light grown, and its sky shrunk, by `reach_px` for pose errors."""
        if reach_px == 0:
            return self
        likely, lit = (grown(mask, reach_px) for mask in (self.likely, ~self.sky))
        return dataclasses.replace(self, likely=likely, sky=~lit, grown_px=self.grown_px + reach_px)


hold_compact(Silhouette, ["certain", "likely", "sky"])


def silhouette(dn: Tensor, sensor: Sensor, world_to_camera: Tensor, K: Tensor) -> Silhouette:
    """Return the pixels of dn [H, W, C] that are brighter than noise."""
    sky_dn, sigma_dn = dark_reading(sensor)
    sigma_dn /= math.sqrt(dn.shape[2])
    signal = ((dn.mean(dim=-1) - sky_dn) / sigma_dn)[None, None]  # in sigmas
    bright = signal > BRIGHT_SIGMA
    certain, likely = torch.zeros_like(bright), bright.clone()
    means = {w: _mean(signal, w) * w for w in WINDOWS_PX}
    # bright pixels are left out, so that they do not make their neighbours look lit
    faint = {w: _mean_of(signal, ~bright, w) for w in sorted({*WINDOWS_PX, *SKY_WINDOWS_PX})}
    for w in WINDOWS_PX:  # the 3x3 test keeps out pixels that are only near to light
        certain |= (means[w] > CERTAIN_SIGMA) & (means[3] > LIKELY_SIGMA)
        likely |= (faint[w] > LIKELY_SIGMA) & (faint[5] > 0)
    likely |= (means[3] > CERTAIN_SIGMA) & (signal > EDGE_SIGMA)
    certain &= _mean(certain.float(), 3) > SPECK
    sky = torch.zeros_like(bright)
    for w in SKY_WINDOWS_PX:
        expected = FAINTEST_SIGMA * w  # of a window on the faintest face, in sigmas of its mean
        sky |= faint[w] < expected / 2 - SKY_ODDS / expected
    return Silhouette(certain[0, 0], likely[0, 0], (sky & ~likely)[0, 0], world_to_camera, K)


def silhouette_of(frame: TrainingFrame, sensor: Sensor) -> Silhouette:
    """Return the silhouette of a frame in front of black sky, or of another even background."""

    def look(dn: Tensor) -> Tensor:
        lit = light(dn, sensor, frame.background, frame.exposure_time_s)
        found = silhouette(lit, sensor, frame.world_to_camera, frame.K)
        return torch.stack([found.certain, found.likely, found.sky])

    certain, likely, sky = frame.seen(look, max(SKY_WINDOWS_PX) // 2 + 1)
    return Silhouette(certain, likely, sky, frame.world_to_camera, frame.K)


def light(dn: Tensor, sensor: Sensor, background: float, exposure_time_s: float) -> Tensor:
    """Return readings [H, W, C] as if on black sky: the black level plus how far each is from that of the background.

    Args:
        background: radiance of what is seen where the target is not.
    """
    if not background:
        return dn
    empty_dn = sensor.expected_dn(torch.tensor(background), exposure_time_s).clamp(max=sensor.white_dn)
    return sensor.black_dn + (dn - empty_dn).abs()


def _mean_of(signal: Tensor, chosen: Tensor, window: int) -> Tensor:
    """Return the mean of the chosen pixels around each [1, 1, H, W], in sigmas of that mean; nan where they are few."""
    share, total = _mean(chosen.float(), window), _mean(signal * chosen, window) * window
    return torch.where(
        share * window**2 > FEWEST_CHOSEN - 0.5, total / share.clamp(min=1e-6).sqrt(), torch.nan
    )


def _mean(image: Tensor, window: int) -> Tensor:
    """Return the mean of the window around each pixel [1, 1, H, W], 0 beyond the border, by running sums."""
    return torch.from_numpy(uniform_filter(image[0, 0].numpy(), window, mode="constant"))[None, None]


def shows_light(frame: TrainingFrame, sensor: Sensor) -> bool:
    """Return whether anything in a frame certainly rises above the noise; in eclipse nothing does."""
    sky_dn, sigma_dn = dark_reading(sensor)
    dn = light(frame.dn, sensor, frame.background, frame.exposure_time_s)
    signal = F.avg_pool2d((dn.mean(dim=-1) - sky_dn)[None], 3, 1)
    bright = signal > CERTAIN_SIGMA * sigma_dn / math.sqrt(dn.shape[2]) / 3
    return int(bright.sum()) >= FEWEST_BRIGHT_PX


def radius_m(silhouettes: list[Silhouette]) -> float:
    """Return the target's radius, m: how far from the origin, across the line of sight, light is; 0 if all is dark."""
    ahead = [s for s in silhouettes if s.world_to_camera[2, 3] > 0]
    count = sum(int(s.certain.sum()) for s in ahead)
    # pixels that are no nearer: of each view no more are kept
    outside = count - max(1, int(INSIDE * count)) + 1
    reaches = []
    for s in ahead:
        rows, columns = torch.nonzero(s.certain, as_tuple=True)
        origin = s.world_to_camera[:3, 3]
        x = (columns + 0.5 - s.K[0, 2]) / s.K[0, 0] - origin[0] / origin[2]
        y = (rows + 0.5 - s.K[1, 2]) / s.K[1, 1] - origin[1] / origin[2]
        reach = torch.hypot(x, y) * origin[2]
        reaches.append(reach.topk(min(len(reach), outside)).values)
    if not count:
        return 0.0
    return 1.05 * float(torch.cat(reaches).topk(outside).values[-1])


def origin_apart(silhouettes: list[Silhouette]) -> float:
    """Return how far the origin is from the middle of certain light, in deviations of that light: the median view's.

    Infinite where it lies behind the camera.
    """
    apart = []
    for s in silhouettes:
        lit = torch.nonzero(s.certain).flip(1) + 0.5  # columns, then rows
        origin = s.K @ s.world_to_camera[:3, 3]
        if len(lit) >= FEWEST_BRIGHT_PX:
            spread_px = lit.std(dim=0).norm().clamp(min=1.0)
            offset_px = (origin[:2] / origin[2] - lit.mean(dim=0)).norm()
            apart.append(float(offset_px / spread_px) if origin[2] > 0 else math.inf)
    return sorted(apart)[len(apart) // 2] if apart else 0.0


def hull_points(silhouettes: list[Silhouette], radius: float) -> tuple[Tensor, float]:
    """Return surface points [M, 3] m of the visual hull, and the voxel size, m.

    The grid starts coarse, and only voxels that survive are divided again, down to the size of a pixel. The result is
    empty when the views do not agree anywhere.
    """
    voxel_m = 2 * radius / COARSE_VOXELS
    pixels_m = [float(s.world_to_camera[:3, 3].norm() / s.K[0, 0]) for s in silhouettes]
    finer = math.log2(voxel_m / max(FINEST_PX * sorted(pixels_m)[len(pixels_m) // 2], 1e-9))
    subdivisions = min(SUBDIVISIONS, max(0, math.floor(finer)))
    inside = torch.ones((COARSE_VOXELS,) * 3, dtype=torch.bool)
    for level in range(subdivisions + 1):
        if level:
            inside, voxel_m = _doubled(inside), voxel_m / 2
        # a coarse voxel survives when light falls anywhere near its projection, a final one when at its centre
        reach_m = 0.87 * voxel_m * (level < subdivisions)
        points = _centres(inside, voxel_m, radius)
        if reach_m:
            staying = agreement(silhouettes, points[::SAMPLED], reach_m) >= AGREEMENT
            if staying.float().mean() > WORTH:
                continue
        pieces = points.split(VOXELS_AT_ONCE)
        shares = torch.cat([agreement(silhouettes, p, reach_m, AGREEMENT) for p in pieces])
        inside[inside.clone()] = shares >= AGREEMENT
        if not inside.any():
            break
    return _centres(inside & ~_eroded(inside), voxel_m, radius), voxel_m


def coherence(silhouettes: list[Silhouette], points: Tensor, voxel_m: float) -> float:
    """Return the share of all certain light that the projection of a hull covers; 1 where poses and silhouettes agree.

    A hull that was carved with wrong poses lacks parts that some views show, since other views carved them away.

    Source: Hernandez, Schmitt and Cipolla, Silhouette coherence for camera calibration under circular motion, 2007.

    Args:
        points: [M, 3] of the hull's surface, a voxel of `voxel_m` apart.
    """
    covered = total = 0
    for s in silhouettes:
        p = points @ s.world_to_camera[:3, :3].T + s.world_to_camera[:3, 3]
        p = p[p[:, 2] > 1e-6]
        u, v = (s.K[i, i] * p[:, i] / p[:, 2] + s.K[i, 2] for i in (0, 1))
        height, width = s.certain.shape
        inside = (u >= 0) & (v >= 0) & (u < width) & (v < height)
        image = torch.zeros(height, width, dtype=torch.bool)
        image[v[inside].long(), u[inside].long()] = True
        voxel_px = float(s.K[0, 0]) * voxel_m / max(float(s.world_to_camera[2, 3]), 1e-6)
        reach_px = math.ceil(min(max(voxel_px / 2, 1.0), min(height, width) / 4))  # as in `agreement`
        image = grown(image, reach_px)
        covered += int((s.certain & image).sum())
        total += int(s.certain.sum())
    return covered / max(total, 1)


def _doubled(grid: Tensor) -> Tensor:
    return grid.repeat_interleave(2, 0).repeat_interleave(2, 1).repeat_interleave(2, 2)


def _eroded(inside: Tensor) -> Tensor:
    """Return the voxels whose six neighbours are all inside."""
    padded = F.pad(inside, (1,) * 6)
    n = inside.shape[0]
    eroded = torch.ones_like(inside)
    for axis in range(3):
        for start in (0, 2):
            starts = [1, 1, 1]
            starts[axis] = start
            eroded &= padded[tuple(slice(s, s + n) for s in starts)]
    return eroded


def _centres(grid: Tensor, voxel_m: float, radius: float) -> Tensor:
    """Return the centres [M, 3] m of the voxels that are set."""
    return (torch.nonzero(grid) + 0.5) * voxel_m - radius


def agreement(silhouettes: list[Silhouette], points: Tensor, reach_m: float, least: float = 0.0) -> Tensor:
    """Return the share [M] of views that see light within `reach_m` of each point, of those with the point in view.

    Points in view of less than a third of the views have a share of 0.

    Args:
        least: points whose share is below this may have a share of 0 instead, which takes less time.
    """
    pieces = [
        _Voted(some, at, *torch.zeros(2, len(at)))
        for some, at in zip(
            *(of.split(POINTS_AT_ONCE) for of in (points, torch.arange(len(points)))), strict=True
        )
    ]
    shares, most_against = torch.zeros(len(points)), (1 - least) * len(silhouettes)
    for first in range(0, len(silhouettes), VIEWS_AT_ONCE):
        views = silhouettes[first : first + VIEWS_AT_ONCE]
        masks = list(each(partial(_reaching, reach_m), views))
        pieces = list(each(partial(_voted, views, masks, most_against), pieces))
    for _, at, votes, seen in pieces:
        enough = seen >= max(1, len(silhouettes) // 3)
        shares[at[enough]] = (votes / seen.clamp(min=1))[enough]
    return shares


class _Voted(NamedTuple):
    """Points [M, 3] that may be in the hull yet, which of all they are, and the views that see light there, and any."""

    points: Tensor
    at: Tensor
    votes: Tensor
    seen: Tensor


def _reaching(reach_m: float, s: Silhouette) -> Tensor:
    """Return where a view sees likely light within `reach_m` at the target's distance, [H, W]."""
    if reach_m <= 0:
        return s.likely
    pixels = math.ceil(float(s.K[0, 0]) * reach_m / max(float(s.world_to_camera[2, 3]), 1e-6))
    return grown(s.likely, min(pixels, min(s.likely.shape) // 4))


def _voted(views: list[Silhouette], masks: list[Tensor], most_against: float, before: _Voted) -> _Voted:
    """Return points after more views, by their masks, without those that too many speak against."""
    points, at, votes, seen = before
    for s, mask in zip(views, masks, strict=True):
        p = torch.addmm(s.world_to_camera[:3, 3], points, s.world_to_camera[:3, :3].T)
        z = p[:, 2].clamp(min=1e-6)
        u, v = s.K[0, 0] * p[:, 0] / z + s.K[0, 2], s.K[1, 1] * p[:, 1] / z + s.K[1, 2]
        height, width = mask.shape
        inside = (p[:, 2] > 1e-6) & (u >= 0) & (v >= 0) & (u < width) & (v < height)
        lit = mask[v.long().clamp(0, height - 1), u.long().clamp(0, width - 1)]
        votes, seen = votes + (lit & inside), seen + inside
    possible = seen - votes <= most_against
    return _Voted(points[possible], at[possible], votes[possible], seen[possible])
