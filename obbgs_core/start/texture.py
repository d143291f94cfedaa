"""How many pixels show texture: a body with texture all over asks for more first Gaussians than edges do."""

from collections.abc import Mapping

import torch.nn.functional as F
from torch import Tensor

from obbgs_core.compact import Compact, whole
from obbgs_core.compiled import each
from obbgs_core.frames import TrainingFrame
from obbgs_core.sensor import Sensor
from obbgs_core.start.hull import light

PICTURES = 12  # that are looked at, at most, spread evenly
TEXTURE = 0.05  # of a reading: by how much it departs from the mean of its four neighbours
NOISE = 4.0  # deviations of that difference which it also has to exceed
# Of the pixels within the target. 0.04 to 0.2 of renders of spacecraft at 400x400, where edges are what they show.
ALL_OVER = 1 / 3


def textured_pixels(
    frames: list[TrainingFrame], certain: Mapping[int, Tensor | Compact], sensor: Sensor
) -> int:
    """Return how many pixels of a picture show texture, on average; 0 where the target has none on most of it.

    Args:
        certain: [H, W], where silhouettes of some of the frames show light for certain, by the index of the frame.
    """
    indices = list(certain)[:: -(-len(certain) // PICTURES)]

    def counted(i: int) -> tuple[int, int]:
        frame, mask = frames[i], whole(certain[i])
        inside = -F.max_pool2d(-mask.float()[None], 3, 1, 1)[0] > 0
        dn = light(frame.dn, sensor, frame.background, frame.exposure_time_s)
        inside &= (frame.dn < sensor.white_dn).all(dim=2)
        variance_dn2 = sensor.variance_dn2(dn).mean(dim=2) / dn.shape[2]
        dn = dn.mean(dim=2) - sensor.black_dn
        beside = F.pad(dn[None, None], (1, 1, 1, 1), mode="replicate")[0, 0]
        mean = (beside[:-2, 1:-1] + beside[2:, 1:-1] + beside[1:-1, :-2] + beside[1:-1, 2:]) / 4
        least = ((TEXTURE * dn) ** 2 + NOISE**2 * 1.25 * variance_dn2).sqrt()
        return int((((dn - mean).abs() > least) & inside).sum()), int(inside.sum())

    textured, within = map(sum, zip(*each(counted, indices), strict=True))
    return textured // len(indices) if textured > ALL_OVER * within else 0
