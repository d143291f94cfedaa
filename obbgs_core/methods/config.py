"""The settings of a method, all in one place, and where a training stands in its schedule.

The defaults are those of `obbgs`. The number at a setting is that of the note in docs/experiments that measured it.
What never differs is a constant beside the code that uses it.
"""

import dataclasses
from dataclasses import dataclass, field
from typing import Literal

from obbgs_core.published.settings import PublishedSettings
from obbgs_core.settings import at_least_one, check, fraction, number
from obbgs_core.start.initialisation import StartSettings

# Where poses are refined, the schedule is set back from the first to the second share of the steps, so many times:
# poses and surface settle together only while the rates are large (experiment 079).
SET_BACK_AT, SET_BACK_TO, SET_BACKS = 0.4, 0.16, 1
# Frames: up to the first what `SparseSettings` says holds in full, from the second on nothing of it (experiment 038).
FEW, MANY = 12, 48
# of the harmonics, at most, where frames are fewer than `MANY`: few views leave higher ones open
FEW_SH_DEGREE = 1
FIXED_COST = 0.25  # time of a step that does not shrink with the image, over the time that does, at full size


@dataclass(frozen=True)
class Moment:
    """Where a training stands in the schedule of its stage, in the step that is under way."""

    done: int  # steps of the whole training before this one
    step: int  # of the stage, from 1
    share: float  # of the steps of the training that were done in the stage, 0 in the first
    image_scale: float
    frames: int  # of the step


@dataclass(frozen=True)
class LossSettings:
    """The weights of what is added to the loss of the images."""

    # the model's own error is learnt beside the noise, and what it cannot explain loses its pull (037)
    misfit: bool = True
    edge_weight: float = 0.05  # of the difference of Sobel derivatives (001; within the scatter: 076)
    # of the mean peak radiance of highlights along normals: a prior for matt surface (057)
    gloss_weight: float = 0.02
    # of how far the normals of neighbours are apart, under Lambert's law: faces are smooth (067)
    normal_weight: float = 0.02
    # of the mean shortest scale over the target's radius: flat Gaussians are surface (070)
    flat_weight: float = 15.0
    sky_weight: float = 4.0  # of the mean alpha of pixels that show no light: space is empty (005, 055, 101)
    # of the mean transmittance of pixels that certainly show light, where the Sun stands still and the sky is black:
    # what is dark is opaque too (092)
    solid_weight: float = 1.0

    def __post_init__(self):
        check(self, "loss")


@dataclass(frozen=True)
class GrowthSettings:
    """When and where Gaussians are added, and which are removed."""

    max_gaussians: int = at_least_one(10_000)
    # above 0: no more Gaussians than so many times the square root of the number of pixels that are lit in the long
    # exposures, since detail lies along edges; fewer than 35 exposures count as 35 (084)
    gaussians_per_root_pixel: float = 12.0
    begin: float = fraction(0.08)  # share of the steps (043)
    end: float = fraction(0.6)  # share of the steps (046)
    interval: int = at_least_one(24)  # steps between two densifications (043)
    # above 0: this share of the Gaussians grows, largest gradients first; 0: those above the threshold of 3DGS (043)
    grown_share: float = 0.08
    # above 0: steps between extra growth inside the boxes of the worst tiles (Jiang et al. 2025; 070, 076)
    obb_interval: int = 12
    prune_opacity: float = fraction(0.02)  # fainter Gaussians are removed at each densification (002)

    def __post_init__(self):
        check(self, "growth")


@dataclass(frozen=True)
class RateSettings:
    """Learning rates a step, of the means in the method's unit of length and of `sh` in its unit of radiance (002)."""

    means: float = 4e-3  # at the first step
    means_end: float = 2e-5  # at the last step, with exponential decay between them
    quats: float = 0.01
    log_scales: float = 0.02
    sh: float = 0.04
    sh_rest: float = 0.1  # factor on the rate of the coefficients above degree 0 (073)
    # all rates but that of the means decay exponentially to this share of themselves (070, 071)
    final_share: float = 0.4
    # Share of the second moments that a step keeps: the smaller it is, the sooner steps follow gradients that shrink.
    # Where the Sun or the poses may move, 0.999 is taken instead: a step that has forgotten the gradients of another
    # Sun is too large for it, and refined poses lose accuracy (071).
    second_memory: float = number(0.99, most=0.9999)

    def __post_init__(self):
        check(self, "rates")


@dataclass(frozen=True)
class ParsimonySettings:
    """When Gaussians whose likelihood gain is below their BIC penalty are pruned."""

    prune_at: tuple[float, ...] = fraction((0.3, 0.45, 0.6, 0.72, 0.85))  # shares of the steps (002, 043)
    # Gaussians above it are kept where a picture shows them: dark surface explains no light and is surface (046)
    keep_above_opacity: float = fraction(0.65)

    def __post_init__(self):
        check(self, "parsimony")


@dataclass(frozen=True)
class LightSettings:
    """What the radiance of a Gaussian may depend on."""

    # the degree is raised up to this where the gain exceeds the BIC penalty (073)
    max_sh_degree: int = number(2, most=3)
    sun_span_deg: float = 5.0  # above 0: the Sun is tested too where its direction spans more than this (015)
    # albedo, normal and cast shadows | harmonics towards the Sun (015)
    sun_shading: Literal["lambert", "linear"] = "lambert"
    # given to all Gaussians where withheld frames are explained better, and where the Sun moves (042, 057)
    highlights: bool = True

    def __post_init__(self):
        check(self, "light")

    def moves(self, span_deg: float) -> bool:
        """Return whether a Sun whose direction spans so much is one that moves."""
        return 0 < self.sun_span_deg < span_deg


@dataclass(frozen=True)
class PoseSettings:
    """Whether the tagged poses are refined together with the Gaussians."""

    # auto: if the validation brackets say that they err (044, 061)
    refine: Literal["never", "always", "auto"] = "auto"

    def __post_init__(self):
        check(self, "poses")


@dataclass(frozen=True)
class SparseSettings:
    """What few frames need; between `FEW` and `MANY` a share of it (038)."""

    dropout: float = number(0.3, most=0.9)  # share of the Gaussians that each step leaves out (DropGaussian)

    def __post_init__(self):
        check(self, "sparse")


@dataclass(frozen=True)
class MethodConfig:
    """Everything that shapes a training besides its frames, its sensor and its seed.

    A time within the training is a share of its steps, from 0 to 1.

    Raises:
        ValueError: a value is out of its range; the message names the setting, such as `growth.interval`.
    """

    name: str
    # false: every exposure time is replaced by the geometric mean of all (001, 076)
    exposure_aware: bool = True
    frames_per_step: int = at_least_one(3)  # (043)
    steps: int = at_least_one(1000)  # (043, 072)
    # share of the steps from which on the models after each step are averaged; 1: the model is that of the last step
    # (071)
    averaged_from: float = fraction(0.88)
    # where pictures are rendered and compared; auto: cuda where that can be used; warp: the kernels of cuda on this
    # processor, for tests (not measured on a GPU)
    device: Literal["cpu", "cuda", "auto", "warp"] = "cpu"
    # of a run: trained a second time without exposure times, for comparison
    blind_reference: bool = False
    # above 0: stop after growth when the running chi² falls to this; 1 is pure noise (002)
    chi2_end: float = 1.0
    start: StartSettings = field(default_factory=StartSettings)
    loss: LossSettings = field(default_factory=LossSettings)
    growth: GrowthSettings = field(default_factory=GrowthSettings)
    rates: RateSettings = field(default_factory=RateSettings)
    parsimony: ParsimonySettings = field(default_factory=ParsimonySettings)
    light: LightSettings = field(default_factory=LightSettings)
    poses: PoseSettings = field(default_factory=PoseSettings)
    sparse: SparseSettings = field(default_factory=SparseSettings)
    published: PublishedSettings = field(default_factory=PublishedSettings)

    def __post_init__(self):
        check(self)

    @property
    def learns_misfit(self) -> bool:
        """Whether the model's own error is learnt."""
        return self.loss.misfit and self.published.loss == "likelihood"

    def for_frames(self, count: int) -> "MethodConfig":
        """Return the settings as they are for so many frames."""
        few = few_share(count)
        sh_degree = min(self.light.max_sh_degree, FEW_SH_DEGREE) if few else self.light.max_sh_degree
        return dataclasses.replace(self, light=dataclasses.replace(self.light, max_sh_degree=sh_degree))

    def stages(self) -> list[tuple[int, float, int]]:
        """Return the stages of the training: the first step, counted from 0, the image scale and the frames of a step.

        The last one is the training itself, on whole pictures.
        """
        stages, first = [], 0
        for scale, frames, share in self.published.coarse:
            stages.append((first, scale, frames))
            first += round(share * self.steps)
        return [*stages, (first, 1.0, self.frames_per_step)]

    def moment(self, done: int) -> Moment:
        """Return where in its schedule a training stands after some steps."""
        stages = self.stages()
        main, _, _ = stages[-1]
        first, scale, frames = next(stage for stage in reversed(stages) if done >= stage[0])
        return Moment(done, done - first + 1, (done - first) / max(1, self.steps - main), scale, frames)

    def work(self, first: int, last: int) -> float:
        """Return the work of the steps from `first` to before `last`, in that of a frame of full size."""
        stages = self.stages()
        ends = [*(start for start, _, _ in stages[1:]), self.steps]
        return sum(
            max(0, min(last, until) - max(first, start)) * (FIXED_COST + scale**2) * frames
            for (start, scale, frames), until in zip(stages, ends, strict=True)
        )

    def steps_until(self, share: float) -> float:
        """Return how many steps are done when a share of the training, coarse stages left out, is."""
        main = self.stages()[-1][0]
        return main + share * (self.steps - main)


def few_share(frames: int) -> float:
    """Return how far so many frames are few: 1 up to `FEW`, falling to 0 at `MANY`."""
    return min(1.0, max(0.0, (MANY - frames) / (MANY - FEW)))
