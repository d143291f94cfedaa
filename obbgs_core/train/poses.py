"""When poses are refined together with the Gaussians."""

from dataclasses import dataclass
from typing import Literal

from obbgs_core.settings import check, fraction

# share of the steps after which poses that were aligned before the start are refined; the first pictures, a quarter as
# large, would move exact poses by half a pixel
ALIGNED_FROM = 0.15
# Where poses are refined, the schedule is set back from the first to the second share of the steps, so many times:
# poses and surface settle together only while the rates are large.
HELD_AT, HELD_FROM, HOLDS = 0.4, 0.16, 2
SURFACE_UNTIL = 0.5  # share of the steps until which the Gaussians go along with the surface's cells then


@dataclass(frozen=True)
class PoseSettings:
    """Whether the tagged poses are refined together with the Gaussians."""

    # auto: if the validation brackets say that they err
    refine: Literal["never", "always", "auto"] = "never"
    # share of the steps before which the model is too coarse to correct poses
    refine_from: float = fraction(0.25)

    def __post_init__(self):
        check(self, "poses")
