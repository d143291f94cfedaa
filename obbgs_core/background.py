"""The Earth behind the target: which pixels can show it, and what it looks like where the target hides it.

Navigation says where the Earth's disc is. There, a pixel that no Gaussian is near shows the Earth and nothing else: it
is taken out of the frame, as if space were black. Near the target and in it the Earth is filled in from such pixels,
from coarse to fine, and stands behind the model: a field of each frame's own, not Gaussians. What is filled in is a
mean, and how much the Earth scatters about it is known from the same pixels.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from obbgs_base.physics.earth import THICK_CLOUD, camera_rays, sees_earth
from obbgs_core.frames import TrainingFrame
from obbgs_core.sensor import Sensor

# Of a model's alpha between neighbouring pixels, if all frames but one show black sky: its outlines err by so much
OUTLINE = 0.6


@dataclass(frozen=True)
class Backdrop:
    """A frame and what stands behind the target in it.

    dn: [H, W, C] the readings, with the black level where only the Earth is seen.
    radiance: [H, W, C] behind the target, 0 where `dn` holds no Earth.
    sigma: [H, W, C] how far it may err.
    """

    dn: Tensor
    radiance: Tensor
    sigma: Tensor


def earth_pixels(frame: TrainingFrame) -> Tensor:
    """Return which pixels [H, W] of a frame can show the Earth or its air."""
    height, width = frame.shape[:2]
    if frame.earth_m is None:
        return torch.zeros(height, width, dtype=torch.bool)
    rays = camera_rays(frame.K.double().numpy(), width, height)
    return torch.from_numpy(sees_earth(rays, -frame.earth_m.double().numpy()))


def black_share(frames: Sequence[TrainingFrame]) -> float:
    """Return the share of frames that have black sky behind the target."""
    return sum(frame.earth_m is None for frame in frames) / len(frames)


def backdrop(frame: TrainingFrame, sensor: Sensor, near_target: Tensor) -> Backdrop:
    """Return a frame without the Earth beside the target, and the Earth behind it.

    Args:
        near_target: [H, W] bool, pixels that may show the target.
    """
    earth = earth_pixels(frame)
    full = sensor.full_scale_radiance(frame.exposure_time_s)
    light = (frame.dn - sensor.black_dn) / (sensor.dn_per_radiance_s * frame.exposure_time_s)
    # a saturated cloud is between full scale and the brightest cloud there is
    saturated, span = frame.dn >= sensor.white_dn, max(0.0, THICK_CLOUD - full)
    light = torch.where(saturated, full + span / 2, light) * earth[..., None]
    seen, sigma = filled(light, saturated * span**2 / 12, ~near_target)
    held = (earth & near_target)[..., None]
    only_earth = (earth & ~near_target)[..., None]
    dn = torch.where(only_earth, sensor.black_dn, frame.dn)
    return Backdrop(dn, seen.clamp(min=0) * held, sigma * held)


def doubt(alpha: Tensor, radiance: Tensor, sigma: Tensor, black: float) -> Tensor:
    """Return by how much the light that comes from behind a model may err, in its pictures [B, H, W, C].

    What stands there errs by `sigma`; and where the model's outline errs, as much more or less is seen of it. In front
    of black sky, dark Gaussians around a bright face make its outline sharp. In front of the Earth they show, so that
    outlines come out true and their light wrong. They are therefore left to the frames with black sky, as far as there
    are any.

    Args:
        alpha: [B, H, W] of the model; radiance, sigma: [B, H, W, C] of what stands behind.
        black: the share of frames whose sky is black, from which outlines are learnt.
    """
    change = F.max_pool2d(alpha[:, None], 3, 1, 1) + F.max_pool2d(-alpha[:, None], 3, 1, 1)
    through = (1 - alpha)[..., None] * sigma
    outline = OUTLINE * black * change.movedim(1, -1) * radiance
    return (through.square() + outline.square()).sqrt()


def weighed(dn: Tensor, predicted_dn: Tensor, sigma_dn: Tensor, behind_dn: Tensor, white_dn: float) -> Tensor:
    """Return readings [B, H, W, C] moved towards their prediction by as much as what stands behind them is uncertain.

    Pixel by pixel, the pull on the model is then what it would be if the uncertainty was part of the noise.

    Args:
        sigma_dn: the deviation of the noise; behind_dn: that of what is seen behind the model; both [B, H, W, C].
    """
    doubt = behind_dn.square() / (behind_dn.square() + sigma_dn.square())
    return torch.where(doubt > 0, dn + doubt * (predicted_dn.clamp(max=white_dn) - dn), dn)


def filled(image: Tensor, variance: Tensor, known: Tensor) -> tuple[Tensor, Tensor]:
    """Return an image [H, W, C] with what is not known of it filled in, and by how much that may err.

    Means over 2x2 pixels, those over 2x2 of these, and so on, fill each level where the one below has too little;
    pixels that are known stay. The deviation is that of what was averaged.

    Source: Gortler et al., The Lumigraph, 1996 (push and pull).

    Args:
        variance: [H, W, C] of the image's values.
        known: [H, W] bool.
    """
    weight = known.float()[None, None]
    values = torch.cat([image, image.square() + variance], dim=-1).movedim(-1, 0)[None]
    levels = []
    while True:
        levels.append((values, weight))
        if min(weight.shape[2:]) <= 1 or bool((weight >= 1).all()):
            break
        total = F.avg_pool2d(weight, 2, ceil_mode=True)
        values = F.avg_pool2d(values * weight, 2, ceil_mode=True) / total.clamp(min=1e-9)
        weight = (4 * total).clamp(max=1)
    values, weight = levels.pop()
    for finer, finer_weight in reversed(levels):
        coarse = F.interpolate(values, size=finer.shape[2:], mode="bilinear", align_corners=False)
        values = finer_weight * finer + (1 - finer_weight) * coarse
    mean, square = values[0].movedim(0, -1).chunk(2, dim=-1)
    return mean, (square - mean.square()).clamp(min=0).sqrt()


def grown(mask: Tensor, reach_px: int) -> Tensor:
    """Return where a mask [H, W] bool is set within `reach_px` rows and columns."""
    for axis in (0, 1):
        done, most = 0, min(reach_px, mask.shape[axis] - 1)
        while done < most:  # what is within `done` of a pixel that is `step` away is within their sum
            step = min(done + 1, most - done)  # that pixel lies on the way, within the picture
            near, mask, length = mask, mask.clone(), mask.shape[axis] - step
            mask.narrow(axis, step, length).logical_or_(near.narrow(axis, 0, length))
            mask.narrow(axis, 0, length).logical_or_(near.narrow(axis, step, length))
            done += step
    return mask
