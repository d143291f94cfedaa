"""How sure a model is of its images: calibrated intervals and stated errors, and how they hold in unseen views."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from obbgs_core.frames import TrainingFrame, cameras_of
from obbgs_core.losses import ON_TARGET_ALPHA
from obbgs_core.misfit import Compared
from obbgs_core.model.gaussians import Gaussians
from obbgs_core.render import render
from obbgs_core.score.uncertainty import (
    Calibration,
    Readings,
    calibrated,
    parameter_deviations,
    rendered_deviation,
)
from obbgs_core.sensor import Sensor


@dataclass(frozen=True)
class View:
    """A frame with what the model expects of it, all [H, W, C]: radiance, its standard deviation; on_target [H, W]."""

    frame: TrainingFrame
    radiance: Tensor
    deviation: Tensor
    on_target: Tensor

    def of_target(self, sensor: Sensor) -> Readings:
        """Return the readings on the target that are expected clear of both clips."""
        radiance, deviation, dn = (
            value[self.on_target] for value in (self.radiance, self.deviation, self.frame.dn)
        )
        return Readings.of(sensor, radiance, deviation, dn, self.frame.exposure_time_s)


def interval_views(
    gaussians: Gaussians, deviations: dict[str, Tensor], frames: Sequence[TrainingFrame]
) -> list[View]:
    """Return what a model with the deviations of its parameters expects of some frames."""
    cameras = [cameras_of([frame]) for frame in frames]
    views = []
    for frame, camera, deviation in zip(
        frames, cameras, rendered_deviation(gaussians, deviations, cameras), strict=True
    ):
        with torch.no_grad():
            rendered = render(gaussians, camera)
        views.append(
            View(frame, rendered.radiance[0], deviation, rendered.alpha[0].squeeze(-1) > ON_TARGET_ALPHA)
        )
    return views


def calibration_of(views: Sequence[View], sensor: Sensor) -> Calibration:
    """Return the calibration by the readings of held-out views.

    Raises:
        ValueError: none of them lies on the target between the clips.
    """
    return calibrated(Readings.together([view.of_target(sensor) for view in views]))


def interval_scores(
    gaussians: Gaussians,
    training: Sequence[TrainingFrame],
    sensor: Sensor,
    scored: Sequence[TrainingFrame],
    radiance: Sequence[Tensor],
    calibration: Sequence[TrainingFrame] = (),
) -> dict[str, float]:
    """Return how often the intervals that should hold 90 % hold in the scored frames, on the target's pixels.

    - interval_90_noisy: the share of readings in their interval; of those expected clear of both clips.
    - interval_90_clean: the share of true noiseless exposures in theirs; missing without the true radiance.
    - interval_90_half_width: half the mean width of those, as a fraction of full scale.

    All are missing where no reading can calibrate an interval.

    Args:
        radiance: [H, W, C], true, of each scored frame; empty where no truth is known.
        calibration: held-out frames by which the intervals are calibrated. Where there are none, the scored frames
            with odd places calibrate those with even places, and the other way round.
    """
    deviations = parameter_deviations(gaussians, training, sensor)
    views = interval_views(gaussians, deviations, scored)
    others = interval_views(gaussians, deviations, calibration)
    held: dict[str, list[Tensor]] = {"noisy": [], "clean": [], "half_width": []}
    for part in range(2):
        try:
            fitted = calibration_of(others or views[1 - part :: 2], sensor)
        except ValueError:
            return {}
        for i in range(part, len(views), 2):
            read = views[i].of_target(sensor)
            half_width = fitted.half_width_read(read.deviation_dn, read.noise_dn)
            held["noisy"].append((read.dn - read.expected_dn).abs() <= half_width)
            if radiance:
                for name, values in _against_truth(views[i], radiance[i], sensor, fitted).items():
                    held[name].append(values)
    return {
        f"interval_90_{name}": torch.cat(values).double().mean().item()
        for name, values in held.items()
        if sum(part.numel() for part in values)
    }


def _against_truth(view: View, radiance: Tensor, sensor: Sensor, fitted: Calibration) -> dict[str, Tensor]:
    """Return of each pixel on the target whether the clipped true exposure lies in its interval, and the half width."""
    gain = sensor.dn_per_radiance_s * view.frame.exposure_time_s / sensor.white_dn
    half_width = fitted.half_width(view.deviation[view.on_target] * gain)
    expected, true = (
        (sensor.expected_dn(light[view.on_target], view.frame.exposure_time_s) / sensor.white_dn).clamp(0, 1)
        for light in (view.radiance, radiance)
    )
    return {"clean": (expected - true).abs() <= half_width, "half_width": half_width}


@torch.no_grad()
def stated_error_scores(
    gaussians: Gaussians, sensor: Sensor, scored: Iterable[TrainingFrame], misfit: float | None
) -> dict[str, float]:
    """Return how large the errors of the scored frames are beside those that are stated, on the target's pixels.

    - chi2_held_out: Σ (y - e)² / σ² over Σ v / σ², where y is read, σ² the variance of the noise, and e and v mean and
      variance of the clipped reading, as `losses.fit_figures` has it in training.
    - chi2_held_out_both: the same with the variance of the model's own error (`model_error`) added to σ²: 1 where the
      two errors together are as large as stated, and spread so. Missing where that error was not learnt.

    Nothing is returned where no scored frame shows the target, or all of it is saturated.

    Args:
        misfit: the model's own error as a share of the light; None: not learnt.
    """
    stated = {"chi2_held_out": None} | ({} if misfit is None else {"chi2_held_out_both": misfit})
    squares, expected = dict.fromkeys(stated, 0.0), dict.fromkeys(stated, 0.0)
    for frame in scored:
        rendered = render(gaussians, cameras_of([frame]))
        on_target = rendered.alpha > ON_TARGET_ALPHA
        compared = Compared(rendered.radiance, on_target, torch.tensor(frame.exposure_time_s), frame.dn[None])
        for key, share in stated.items():
            sums = compared.chi2_sums(sensor, share)
            squares[key] += sums[0]
            expected[key] += sums[1]
    if not all(expected.values()):
        return {}
    return {key: squares[key] / expected[key] for key in stated}
