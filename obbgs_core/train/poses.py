"""When poses are refined together with the Gaussians."""

from dataclasses import dataclass
from enum import Enum
from typing import Literal

from obbgs_core.settings import check, fraction

ALIGNED_FROM = 0.05  # share of the steps after which poses that were aligned before the start are refined
# Where poses are refined, the schedule is set back from the first to the second share of the steps, so many times:
# poses and surface settle together only while the rates are large (experiment 079).
HELD_AT, HELD_FROM, HOLDS = 0.4, 0.16, 1
# In so many rounds the poses would move during a whole training if they moved as often as before `HELD_AT`, or as
# after it.
EARLY_ROUNDS, LATE_ROUNDS = 60, 25
SURFACE_UNTIL = 0.5  # share of the steps until which the Gaussians go along with the surface's cells then


class PoseDecision(Enum):
    """Whether the tagged poses are refined."""

    OPEN = "open"  # the validation brackets will decide
    NEVER = "never"  # by the settings
    EXACT_TAGS = "exact tags"
    TOO_FEW_BRACKETS = "too few brackets"
    TAGS_HOLD = "tags hold"  # the validation brackets say so
    REFINED = "refined"

    @property
    def is_tested(self) -> bool:
        """Whether validation brackets have decided, or the settings."""
        return self in (PoseDecision.NEVER, PoseDecision.TAGS_HOLD, PoseDecision.REFINED)

    @property
    def report(self) -> str:
        """The decision in words, for people alone."""
        return {
            PoseDecision.OPEN: "as tagged (training ended before this was decided)",
            PoseDecision.EXACT_TAGS: "as tagged (the tags are exact)",
            PoseDecision.TOO_FEW_BRACKETS: "as tagged (too few brackets for validation)",
            PoseDecision.REFINED: "refined",
        }.get(self, "as tagged")


@dataclass(frozen=True)
class PoseSettings:
    """Whether the tagged poses are refined together with the Gaussians."""

    # auto: if the validation brackets say that they err
    refine: Literal["never", "always", "auto"] = "never"
    # share of the steps before which the model is too coarse to correct poses
    refine_from: float = fraction(0.25)

    def __post_init__(self):
        check(self, "poses")
