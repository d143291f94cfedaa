"""The settings of a method in one tree; each group is defined beside the code that uses it."""

import dataclasses
from dataclasses import dataclass, field
from typing import Literal

from obbgs_core.model.gaussians import Footprint
from obbgs_core.settings import at_least_one, check, fraction, number
from obbgs_core.start.initialisation import StartSettings
from obbgs_core.train.adam import RateSettings
from obbgs_core.train.appearance import LightSettings
from obbgs_core.train.growth import GrowthSettings
from obbgs_core.train.objective import LossSettings
from obbgs_core.train.parsimony import ParsimonySettings
from obbgs_core.train.poses import PoseSettings
from obbgs_core.train.sparsity import FEW_SH_DEGREE, SparseSettings, few_share


@dataclass(frozen=True)
class Moment:
    """Where a training stands in the schedule of its stage, in the step that is under way."""

    step: int  # of the stage, from 1
    share: float  # of the steps of the training that were done in the stage, 0 in the first
    image_scale: float
    frames: int  # of the step


@dataclass(frozen=True)
class MethodConfig:
    """Everything that shapes a training besides its frames, its sensor and its seed.

    A time within the training is a share of its steps, from 0 to 1. Lengths are multiples of `length_unit`.

    Raises:
        ValueError: a value is out of its range; the message names the setting, such as `growth.interval`.
    """

    name: str
    # false: every exposure time is replaced by the geometric mean of all, as the methods were published
    exposure_aware: bool = False
    # target: its radius as the silhouettes show it; cameras: the extent of the cameras, as in 3DGS
    length_unit: Literal["target", "cameras"] = "target"
    # of the rate of the radiance coefficients. full_scale: what saturates a pixel at the frames' mean exposure time, as
    # where pictures of 0 to 1 are fitted; one: radiance as it is
    radiance_unit: Literal["one", "full_scale"] = "one"
    frames_per_step: int = at_least_one(1)
    bracket_steps: bool = False  # the frames of a step are one of each exposure time
    windows: bool = False  # only the part of each frame that the target lies in is rendered and compared
    steps: int = at_least_one(30_000)
    footprint: Footprint = "kerbl"  # what a pixel averages over, see `Gaussians`
    # (image scale, frames of a step, share of the steps) of trainings that come first and hand over their model; each
    # counts its steps from 0, so that the rate of the means and growth begin again (MVGS)
    coarse: tuple[tuple[float, int, float], ...] = ()
    # above 0: variance, px², of the 3D filter that keeps Gaussians as wide as the pictures sample (Mip-Splatting)
    smoothing_px2: float = 0.0
    # an affine map of the colours of each training frame is learnt with the model (later 3DGS)
    compensation: bool = False
    dropout: float = number(0.0, most=0.9)  # share of the Gaussians that each step leaves out (DropGaussian)
    # share of the steps from which on the models after each step are averaged; 1: the model is that of the last step
    averaged_from: float = fraction(1.0)
    outlier_filter: bool = False  # remove Gaussians far from the centre from the finished model
    chi2_end: float = 0.0  # above 0: stop after growth when the running chi² falls to this; 1 is pure noise
    start: StartSettings = field(default_factory=StartSettings)
    loss: LossSettings = field(default_factory=LossSettings)
    growth: GrowthSettings = field(default_factory=GrowthSettings)
    rates: RateSettings = field(default_factory=RateSettings)
    parsimony: ParsimonySettings = field(default_factory=ParsimonySettings)
    light: LightSettings = field(default_factory=LightSettings)
    poses: PoseSettings = field(default_factory=PoseSettings)
    sparse: SparseSettings = field(default_factory=SparseSettings)

    def __post_init__(self):
        check(self)
        if not all(len(stage) == 3 and 0 < stage[0] <= 1 and stage[1] >= 1 for stage in self.coarse) or not (
            sum(stage[2] for stage in self.coarse) < 1
        ):
            raise ValueError(
                "coarse must be triples of an image scale of 0 to 1, a number of frames and a share of the steps, of "
                f"less than 1 in all, got {self.coarse}"
            )

    def for_frames(self, count: int) -> "MethodConfig":
        """Return the settings as they are for so many frames."""
        few = few_share(count)
        sky_weight = max(self.loss.sky_weight, few * self.sparse.sky_weight)
        sh_degree = min(self.light.max_sh_degree, FEW_SH_DEGREE) if few else self.light.max_sh_degree
        return dataclasses.replace(
            self,
            light=dataclasses.replace(self.light, max_sh_degree=sh_degree),
            dropout=max(self.dropout, few * self.sparse.dropout),
            loss=dataclasses.replace(self.loss, sky_weight=sky_weight),
        )

    def stages(self) -> list[tuple[int, float, int]]:
        """Return the stages of the training: the first step, counted from 0, the image scale and the frames of a step.

        The last one is the training itself, on whole pictures.
        """
        stages, first = [], 0
        for scale, frames, share in self.coarse:
            stages.append((first, scale, frames))
            first += round(share * self.steps)
        return [*stages, (first, 1.0, self.frames_per_step)]

    def moment(self, steps_done: int) -> Moment:
        """Return where in its schedule a training stands after some steps."""
        stages = self.stages()
        main, _, _ = stages[-1]
        first, scale, frames = next(stage for stage in reversed(stages) if steps_done >= stage[0])
        return Moment(steps_done - first + 1, (steps_done - first) / max(1, self.steps - main), scale, frames)

    def steps_until(self, share: float) -> float:
        """Return how many steps are done when a share of the training, coarse stages left out, is."""
        main = self.stages()[-1][0]
        return main + share * (self.steps - main)
