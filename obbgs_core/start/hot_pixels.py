"""Hot pixels: those that read more than their neighbours in frame after frame, whatever is behind them.

A target moves across the picture, and its light reaches a pixel together with those beside it. Frames in which the
pixels around one show empty sky therefore tell whether it is hot, and the brightness of a single frame does not: a
star or a particle is in one frame only.
"""

import math

import torch
import torch.nn.functional as F
from torch import Tensor

from obbgs_core.compiled import each
from obbgs_core.frames import TrainingFrame
from obbgs_core.sensor import Sensor, dark_reading

LOOKED_AT = 48  # frames, at most, spread evenly
FEWEST = 8  # of them that show sky around a pixel
SKY_SIGMA = 3.0  # the mean of eight neighbours may be so many of its deviations above an empty one
MOST_SIGMA = 5.0  # by which one frame counts, in deviations of the difference
LEAST_SIGMA, CERTAIN = 1.0, 6.0  # of the mean over frames: in deviations of one difference, and in its own


def without_hot_pixels(frames: list[TrainingFrame], sensor: Sensor) -> tuple[list[TrainingFrame], str]:
    """Return frames of one size whose hot pixels read the mean of their neighbours, and in words how many those are.

    Coded as JPEG a hot pixel is no single pixel any more, and in front of another background than black there is no
    empty sky: nothing is changed there.
    """
    if frames[0].background or sensor.jpeg is not None:
        return frames, ""
    hot = hot_pixels(frames, sensor)
    count = int(hot.sum())
    if not count:
        return frames, ""
    kept = (~hot).float()
    around = _around(kept)
    filled = hot & (around > 0)
    frames = [
        f.with_readings(filled, _around_all(f.dn * kept[..., None])[filled] / around[filled][:, None])
        for f in frames
    ]
    return frames, f"{count} hot pixels, {count / hot.numel():.2%}, read the mean of their neighbours"


def hot_pixels(frames: list[TrainingFrame], sensor: Sensor) -> Tensor:
    """Return which pixels [H, W] read more than their neighbours wherever those show empty sky."""
    dark_dn, sigma_dn = dark_reading(sensor)
    sigma_dn /= math.sqrt(frames[0].shape[2])
    apart_dn = sigma_dn * math.sqrt(1 + 1 / 8)
    total, count = torch.zeros(2, *frames[0].shape[:2])

    def beside(frame: TrainingFrame) -> tuple[Tensor, Tensor]:
        grey = frame.dn.mean(dim=2)
        around = _around(grey) / _around(torch.ones_like(grey))
        sky = around < dark_dn + SKY_SIGMA * sigma_dn / math.sqrt(8)
        return sky, sky * (grey - around).clamp(-MOST_SIGMA * apart_dn, MOST_SIGMA * apart_dn)

    for sky, brighter in each(beside, frames[:: math.ceil(len(frames) / LOOKED_AT)]):
        total += brighter
        count += sky
    mean = total / count.clamp(min=1)
    certain = mean > CERTAIN * apart_dn / count.clamp(min=1).sqrt()
    return (count >= FEWEST) & certain & (mean > LEAST_SIGMA * apart_dn)


def _around(image: Tensor) -> Tensor:
    """Return the sum over the eight neighbours of each pixel of an image [H, W], none beyond the border."""
    return 9 * F.avg_pool2d(image[None], 3, 1, 1)[0] - image


def _around_all(dn: Tensor) -> Tensor:
    """Return the sums over the neighbours in each channel of dn [H, W, C]."""
    return torch.stack([_around(channel) for channel in dn.unbind(dim=2)], dim=2)
