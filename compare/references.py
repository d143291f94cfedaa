"""What stands beside every comparison: images that nothing was trained for, the ceiling of blind methods, the noise."""

import torch
from torch import Tensor

from compare.case import Case
from compare.errors import CompareError
from ground.session.cameras import exposed
from obbgs_core.frames import TrainingFrame, mean_exposure_s


def black(case: Case, frames: list[TrainingFrame]) -> list[Tensor]:
    """Return images without light, the black level in every pixel, of the held-out frames."""
    level = case.sensor.black_dn / case.sensor.white_dn
    return [torch.full_like(frame.dn, level) for frame in case.held_out]


def mean_image(case: Case, frames: list[TrainingFrame]) -> list[Tensor]:
    """Return for each held-out frame the mean of the training frames of its exposure time, or where none is, of all."""
    means: dict[float, Tensor] = {}
    for exposure_s in {frame.exposure_time_s for frame in case.held_out}:
        same = [frame.dn for frame in frames if frame.exposure_time_s == exposure_s]
        means[exposure_s] = torch.stack(same or [frame.dn for frame in frames]).mean(0)
    return [means[frame.exposure_time_s] / case.sensor.white_dn for frame in case.held_out]


def ceiling(case: Case, frames: list[TrainingFrame]) -> list[Tensor]:
    """Return the images of a perfect method that ignores exposure: true radiance at the geometric mean exposure.

    Raises:
        CompareError: the session has no truth.
    """
    _require_truth(case, "ceiling")
    reference_s = mean_exposure_s(frames)
    return [exposed(radiance, case.sensor, reference_s) for radiance in case.radiance]


def noise(case: Case, frames: list[TrainingFrame]) -> list[Tensor]:
    """Return the noisy held-out frames themselves: what their noise alone costs against the noiseless exposures.

    Raises:
        CompareError: the session has no truth.
    """
    _require_truth(case, "noise")
    return case.noisy


def _require_truth(case: Case, name: str) -> None:
    if not case.radiance:
        raise CompareError(
            f"{name} needs a session with its truth, and {case.name} has none: leave it out there"
        )
