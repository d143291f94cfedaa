"""What stands behind a rendered model in frames that have the Earth: where the model is, and how sure that is."""

import dataclasses

import torch
from torch import Tensor

from obbgs_core.background import backdrop, black_share, doubt, grown, weighed
from obbgs_core.batches import Batch
from obbgs_core.frames import TrainingFrame, cameras_of
from obbgs_core.model.gaussians import Gaussians
from obbgs_core.render import Rendered, render
from obbgs_core.sensor import Sensor

NEAR_ALPHA = 0.3  # a pixel with more of the model's alpha shows the target; less is mostly dust
REACH_PX = 2  # and so may its neighbours


def covered(alpha: Tensor) -> Tensor:
    """Return which pixels [H, W] show a model of which they have this alpha [H, W], or lie next to it, as bool."""
    return grown(alpha > NEAR_ALPHA, REACH_PX)


@torch.no_grad()
def doubted(batch: Batch, rendered: Rendered, sensor: Sensor, frames: list[TrainingFrame]) -> Batch:
    """Return a batch of frames with less pull where it is uncertain what is seen behind the model."""
    behind = batch.cameras.backdrop
    if batch.doubt is None or behind is None:
        return batch
    prediction = sensor.predicted(rendered.radiance, batch.exposure_time_s)
    gain = sensor.dn_per_radiance_s * batch.exposure_time_s
    behind_dn = gain * doubt(rendered.alpha, behind, batch.doubt, black_share(frames))
    dn = weighed(batch.dn, prediction.expected_dn, prediction.sigma_dn, behind_dn, sensor.white_dn)
    return dataclasses.replace(batch, dn=dn, stored=None)


@torch.no_grad()
def without_earth(model: Gaussians, frame: TrainingFrame, sensor: Sensor) -> TrainingFrame:
    """Return a frame as if the sky was black where it has the Earth in view, beside the target and behind it."""
    if frame.earth_m is None:
        return frame
    alpha = render(model, cameras_of([frame])).alpha[0]
    found = backdrop(frame, sensor, covered(alpha))
    behind_dn = sensor.dn_per_radiance_s * frame.exposure_time_s * (1 - alpha)[..., None] * found.radiance
    dn = torch.where(found.dn < sensor.white_dn, (found.dn - behind_dn).clamp(min=0), found.dn)
    return dataclasses.replace(frame, dn=dn, earth_m=None)
