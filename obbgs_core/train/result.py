"""What a training returns: figures of each step, and the finished model with how it was made."""

from dataclasses import dataclass

from obbgs_core.model.gaussians import Gaussians
from obbgs_core.train.config import MethodConfig


@dataclass(frozen=True)
class StepInfo:
    """How a training stands after a step."""

    step: int  # steps done, from 1
    steps: int  # of the whole training
    loss: float
    psnr_db: float  # of this step's frames, full scale = 1
    chi2: float  # running mean squared normalised residual where the model is; 1 is pure noise
    gaussians: int
    seconds: float  # spent so far, before a kill too
    seconds_left: float  # if the pace per pixel stays as it is


@dataclass(frozen=True, kw_only=True)
class TrainResult:
    """A finished model, and how its training went."""

    gaussians: Gaussians
    config: MethodConfig  # as used: with no more Gaussians than the budget allows
    history: list[StepInfo]
    stop_reason: str
    start: str  # where the first Gaussians came from
    budget: str  # the largest number of Gaussians, and what limits it
    appearance: str  # what the radiance depends on, and why
    growth: str  # the step until which Gaussians were added
    poses: str  # whether the poses were refined, and why
    reference_exposure_s: float | None  # what every exposure was taken for when exposure is ignored
    sun_span_deg: float  # largest angle between two frames' Suns, body frame
    dark_frames: int  # left out: nothing in them rises above the noise
    removed_outliers: int
    removed_not_finite: int  # Gaussians removed because a parameter became NaN or infinite
    seconds: float
