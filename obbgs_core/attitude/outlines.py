"""Outlines of the target as tight as the noise allows; the search for the attitude lives on where they end."""

import math

import torch
import torch.nn.functional as F

from obbgs_core.frames import TrainingFrame, bracket_numbers
from obbgs_core.sensor import Sensor, dark_reading
from obbgs_core.start import alignment, hull
from obbgs_core.start.hull import Silhouette

OPEN_SIGMA = 4.0  # a mean of 3x3 pixels above this may be light
LIT_SIGMA = 5.5  # and above this it is, where the pixel itself is above the next
PIXEL_SIGMA = 3.0
FEWEST_LIT_PX = 9  # a view with fewer shows nothing
PIXELS_PER_CELL = 2  # of the finest pictures that outlines are compared in; smaller pixels are averaged first


def longest_exposures(frames: list[TrainingFrame]) -> list[int]:
    """Return the index of the longest exposure of each bracket, in the order of the frames."""
    best: dict[int, int] = {}
    for index, bracket in enumerate(bracket_numbers(frames)):
        known = best.get(bracket)
        if known is None or frames[index].exposure_time_s > frames[known].exposure_time_s:
            best[bracket] = index
    return sorted(best.values())


def outline(frame: TrainingFrame, sensor: Sensor, binned: int) -> Silhouette:
    """Return where a frame shows light, after squares of `binned` pixels were averaged."""
    dn = hull.light(frame.dn, sensor, frame.background, frame.exposure_time_s).mean(dim=-1)
    dn = F.avg_pool2d(dn[None], binned)[0]
    sky_dn, sigma_dn = dark_reading(sensor)
    signal = (dn - sky_dn) / (sigma_dn / binned / math.sqrt(frame.dn.shape[2]))
    mean = F.avg_pool2d(signal[None], 3, 1, 1)[0] * 3
    likely = mean > OPEN_SIGMA
    K = frame.K / torch.tensor([[binned], [binned], [1.0]])
    return Silhouette((mean > LIT_SIGMA) & (signal > PIXEL_SIGMA), likely, ~likely, frame.world_to_camera, K)


def whole_outlines(frames: list[TrainingFrame], sensor: Sensor) -> dict[int, Silhouette]:
    """Return the outline in all pixels of each bracket's longest exposure that shows light, by the frame's index.

    Frames that have the Earth in view have none.
    """
    black = [i for i in longest_exposures(frames) if frames[i].earth_m is None]
    whole = {i: outline(frames[i], sensor, 1) for i in black}
    return {i: s for i, s in whole.items() if int(s.certain.sum()) >= FEWEST_LIT_PX}


def centred(frames: list[TrainingFrame], sensor: Sensor) -> list[TrainingFrame]:
    """Return frames, in inertial axes, moved to where their outlines are around the target's centre: `alignment`."""
    return alignment.centred(frames, whole_outlines(frames, sensor))


def outlines(frames: list[TrainingFrame], sensor: Sensor, cells: int) -> tuple[dict[int, Silhouette], float]:
    """Return the outlines of each bracket's longest exposure by the frame's index, and the target's radius, m.

    Args:
        cells: width of the pictures in which outlines are compared; smaller pixels are averaged.
    """
    whole = whole_outlines(frames, sensor)
    radius_m = hull.radius_m(list(whole.values()))
    if radius_m == 0:
        return {}, 0.0
    binned = {}
    for i in whole:
        frame = frames[i]
        cell_px = 2 * radius_m / cells * float(frame.K[0, 0] / frame.world_to_camera[2, 3])
        binned[i] = outline(frame, sensor, max(1, int(cell_px / PIXELS_PER_CELL)))
    return binned, radius_m
