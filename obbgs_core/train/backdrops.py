"""Renews what stands behind the target in the frames that have the Earth, as the model learns where the target is."""

import dataclasses

import torch

from obbgs_core.background import backdrop, black_share, doubt, grown, weighed
from obbgs_core.batches import Batch
from obbgs_core.frames import TrainingFrame, cameras_of
from obbgs_core.model.gaussians import Gaussians
from obbgs_core.render import Rendered, render
from obbgs_core.sensor import Sensor
from obbgs_core.train.setup import TrainingSetup
from obbgs_core.train.state import TrainingState

EVERY_STEPS = 100
NEAR_ALPHA = 0.3  # a pixel with more of the model's alpha shows the target; less is mostly dust
REACH_PX = 2  # and so may its neighbours


def renew(setup: TrainingSetup, state: TrainingState) -> None:
    """Find where the model is in the frames that have the Earth, when due, and what stands behind it there."""
    indices = [i for i, f in enumerate(setup.frames) if f.earth_m is not None]
    if not indices or setup.config.published.loss != "likelihood":
        return
    # a round of poses asks about one and the same
    due = state.steps_done % EVERY_STEPS == 0 and state.poses.round is None
    if due or set(state.near_target) != set(indices):
        poses = state.poses.corrections
        batches = setup.batches if poses is None else setup.batches.posed(poses.frames(setup.frames))
        with torch.no_grad():
            state.near_target = {
                i: grown(render(state.model, batches.cameras([i])).alpha[0] > NEAR_ALPHA, REACH_PX)
                for i in indices
            }
    elif setup.batches.has_backdrops:
        return
    near = state.near_target
    seen = {i: backdrop(setup.frames[i], setup.sensor, near[i]) for i in indices}
    setup.batches.stand(seen, {i: ~near[i] for i in indices if setup.config.loss.sky_weight})


@torch.no_grad()
def doubted(setup: TrainingSetup, batch: Batch, rendered: Rendered) -> Batch:
    """Return a step's frames with less pull where it is uncertain what is seen behind the model."""
    sensor, behind = setup.sensor, batch.cameras.backdrop
    if batch.doubt is None or behind is None:
        return batch
    prediction = sensor.predicted(rendered.radiance, batch.exposure_time_s)
    gain = sensor.dn_per_radiance_s * batch.exposure_time_s
    behind_dn = gain * doubt(rendered.alpha, behind, batch.doubt, black_share(setup.frames))
    dn = weighed(batch.dn, prediction.expected_dn, prediction.sigma_dn, behind_dn, sensor.white_dn)
    return dataclasses.replace(batch, dn=dn)


@torch.no_grad()
def without_earth(model: Gaussians, frame: TrainingFrame, sensor: Sensor) -> TrainingFrame:
    """Return a frame as if the sky was black where it has the Earth in view, beside the target and behind it."""
    if frame.earth_m is None:
        return frame
    alpha = render(model, cameras_of([frame])).alpha[0]
    found = backdrop(frame, sensor, grown(alpha > NEAR_ALPHA, REACH_PX))
    behind_dn = sensor.dn_per_radiance_s * frame.exposure_time_s * (1 - alpha)[..., None] * found.radiance
    dn = torch.where(found.dn < sensor.white_dn, (found.dn - behind_dn).clamp(min=0), found.dn)
    return dataclasses.replace(frame, dn=dn, earth_m=None)
