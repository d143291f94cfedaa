"""The settings of a method in one tree; each group is defined beside the code that uses it."""

from dataclasses import dataclass, field
from typing import Literal

from obbgs_core.model.gaussians import Footprint
from obbgs_core.settings import at_least_one, check
from obbgs_core.start.initialisation import StartSettings
from obbgs_core.train.adam import RateSettings
from obbgs_core.train.appearance import LightSettings
from obbgs_core.train.growth import GrowthSettings
from obbgs_core.train.objective import LossSettings
from obbgs_core.train.parsimony import ParsimonySettings
from obbgs_core.train.poses import PoseSettings


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
    frames_per_step: int = at_least_one(1)
    bracket_steps: bool = False  # the frames of a step are one of each exposure time
    steps: int = at_least_one(30_000)
    pyramid: tuple[tuple[float, float], ...] = ((0.0, 1.0),)  # (from this share of the steps on, image scale)
    footprint: Footprint = "kerbl"  # what a pixel averages over, see `Gaussians`
    outlier_filter: bool = False  # remove Gaussians far from the centre from the finished model
    chi2_end: float = 0.0  # above 0: stop after growth when the running chi² falls to this; 1 is pure noise
    start: StartSettings = field(default_factory=StartSettings)
    loss: LossSettings = field(default_factory=LossSettings)
    growth: GrowthSettings = field(default_factory=GrowthSettings)
    rates: RateSettings = field(default_factory=RateSettings)
    parsimony: ParsimonySettings = field(default_factory=ParsimonySettings)
    light: LightSettings = field(default_factory=LightSettings)
    poses: PoseSettings = field(default_factory=PoseSettings)

    def __post_init__(self):
        check(self)
        starts = [level[0] for level in self.pyramid]
        if not (
            all(len(level) == 2 and 0 < level[1] <= 1 for level in self.pyramid)
            and starts == sorted(set(starts))
            and starts[:1] == [0]
        ):
            raise ValueError(
                "pyramid must be pairs of a share of the steps, from 0 upwards, and an image scale of 0 to 1, got "
                f"{self.pyramid}"
            )

    def image_scale(self, share: float) -> float:
        """Return the scale of the images after a share of the steps."""
        return next(scale for start, scale in reversed(self.pyramid) if share >= start)
