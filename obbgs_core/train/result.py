"""What a training returns: figures of each step, and the finished model with how it was made."""

from dataclasses import dataclass, field

from torch import Tensor

from obbgs_core.evidence.response import Response
from obbgs_core.methods.config import MethodConfig
from obbgs_core.model.gaussians import Gaussians
from obbgs_core.poses.estimate import PoseEstimate
from obbgs_core.published.compensation import mapped, nearest
from obbgs_core.sensor import Sensor
from obbgs_core.start.sky_level import SkyLevel


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
    seconds_left: float | None  # if the pace per pixel stays as it is; None: before there is a pace


@dataclass(frozen=True)
class Exposing:
    """How a trained model is turned into the picture of an exposure time.

    reference_exposure_s: what a method that ignores exposure takes every exposure for; None: it knows them.
    maps: of a method that learnt the colours of each training frame, the mean map [C, C + 1] of the frames of each
        exposure time, s. A held-out picture takes that of the nearest exposure time: unlike the publications, which
        fit a map to the held-out picture itself, it needs no look at the picture.
    """

    reference_exposure_s: float | None = None
    maps: dict[float, Tensor] = field(default_factory=dict)

    def image(self, radiance: Tensor, sensor: Sensor, exposure_time_s: float) -> Tensor:
        """Return the noiseless picture of radiance [H, W, C], a fraction of full scale, clipped as the sensor clips."""
        exposure_s = self.reference_exposure_s or exposure_time_s
        if self.maps:
            full_scale = sensor.full_scale_radiance(exposure_s)
            maps = nearest(self.maps, exposure_time_s)[None]
            radiance = mapped(radiance[None], maps, radiance.new_tensor(full_scale))[0]
        return (sensor.expected_dn(radiance, exposure_s) / sensor.white_dn).clamp(0, 1)


@dataclass(frozen=True, kw_only=True, repr=False)
class TrainResult:
    """A finished model, and how its training went; printed it is one line."""

    gaussians: Gaussians
    config: MethodConfig  # as used: with no more Gaussians than the budget allows
    history: list[StepInfo]
    stop_reason: str
    start: str  # where the first Gaussians came from
    budget: str  # the largest number of Gaussians, and what limits it
    appearance: str  # what the radiance depends on, and why
    growth: str  # the step until which Gaussians were added
    poses: str  # whether the poses were refined, and why
    pose_estimate: PoseEstimate | None  # the refined poses; None: as tagged
    exposing: Exposing  # what its pictures are made with
    # the model's own error as a share of the light, on frames that it was not trained on where that was measured; None:
    # not learnt
    misfit: float | None
    # how many times as large that is as on the frames that it was trained on; None: not measured
    unseen_factor: float | None
    response: Response  # of the camera, as far as it is learnt
    sky_level: SkyLevel  # of the frames that were given
    sun_span_deg: float  # largest angle between two frames' Suns, body frame
    dark_frames: int  # left out: nothing in them rises above the noise
    misfit_frames: list[int]  # left out, by their ids: they fitted no pose that their tags allow
    removed_outliers: int
    removed_not_finite: int  # Gaussians removed because a parameter became NaN or infinite
    seconds: float

    def __repr__(self) -> str:
        last = f"PSNR {self.history[-1].psnr_db:.1f} dB of its last frames, " if self.history else ""
        return (
            f"<{self.config.name}: {len(self.gaussians):,} Gaussians, {last}{len(self.history):,} steps in "
            f"{self.seconds:.1f} s: {self.stop_reason}>"
        )

    @property
    def reference_exposure_s(self) -> float | None:
        """What every exposure was taken for when exposure is ignored."""
        return self.exposing.reference_exposure_s
