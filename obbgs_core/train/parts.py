"""What the parts of a training share: what a step saw, how the training stands, and the change that a part asks for.

A part (growth, pruning, harmonics, highlights, poses, fit) owns what it decides by. `due` says whether it has something
to decide after a step, and `decide` returns the change of the model, if there is one; growth and the fit `observe` each
step besides. They read the training as `Now` shows it and change nothing of it but themselves and, by its methods, the
order of the frames. The trainer applies a change to everything that follows the Gaussians.
"""

import dataclasses
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from obbgs_core.batches import Batch, Batches
from obbgs_core.methods.config import MethodConfig, Moment
from obbgs_core.model.gaussians import Gaussians
from obbgs_core.poses.corrections import PoseCorrections
from obbgs_core.published.smoothing import smoothed
from obbgs_core.render import Rendered
from obbgs_core.render.shadows import Shadows
from obbgs_core.train.order import FrameOrder
from obbgs_core.train.setup import TrainingSetup


@dataclass(frozen=True)
class Change:
    """A model with other Gaussians, or the same ones with other parameters.

    Args:
        model: after the change.
        kept: [K] indices of the Gaussians of the model before that its first ones are, the others are new; None: the
            same Gaussians.
        reason: for the log; nothing is decided by it.
        goes_on: whether the records of growth go on for those that are kept; else all begin anew.
        begun_anew: names of parameters whose moments in the optimizer begin anew.
    """

    model: Gaussians
    kept: Tensor | None
    reason: str = ""
    goes_on: bool = False
    begun_anew: tuple[str, ...] = ()

    @property
    def added(self) -> int:
        """The number of new Gaussians."""
        return 0 if self.kept is None else len(self.model) - len(self.kept)

    @staticmethod
    def only(gaussians: Gaussians, mask: Tensor, reason: str, goes_on: bool = False) -> "Change":
        """Return the removal of all Gaussians but those of a mask [N]."""
        kept = torch.nonzero(mask)[:, 0]
        return Change(gaussians.detach().select(kept), kept, reason, goes_on)

    def then_only(self, mask: Tensor) -> "Change":
        """Return this change and the removal of all Gaussians but those of a mask [N] of its model."""
        assert self.kept is not None
        kept = self.kept[mask[: len(self.kept)]]
        return dataclasses.replace(self, model=self.model.select(torch.nonzero(mask)[:, 0]), kept=kept)


@dataclass(frozen=True)
class Seen:
    """What a step rendered and compared."""

    batch: Batch
    rendered: Rendered
    residual: Tensor  # [B, H, W, C]


@dataclass(frozen=True)
class Now:
    """A training in the step that is under way, as its parts see it."""

    setup: TrainingSetup
    moment: Moment
    taken: int  # steps, also those that were taken before the schedule was set back
    gaussians: Gaussians
    deviation_m: Tensor | None  # [N] of the 3D filter; None: the method has none
    corrections: PoseCorrections | None  # of the poses; None: as tagged
    is_resettling: bool  # the poses are, because frames have joined
    waits_for_poses: bool  # they are, and the schedule will be set back for them
    keeps_unseen: bool  # brackets are kept back to tell the model's own error
    misfit: float | None  # the model's own error as a share of the light; None: not learnt, or not yet
    order: FrameOrder
    shadows: Shadows
    rng: torch.Generator
    seen: Seen

    @property
    def config(self) -> MethodConfig:
        """The settings."""
        return self.setup.config

    @property
    def model(self) -> Gaussians:
        """The Gaussians as they are rendered."""
        return self.gaussians if self.deviation_m is None else smoothed(self.gaussians, self.deviation_m)

    @property
    def batches(self) -> Batches:
        """The training's images with the poses as they are estimated so far."""
        setup, poses = self.setup, self.corrections
        return setup.batches if poses is None else setup.batches.posed(poses.frames(setup.frames))

    def is_step(self, share: float) -> bool:
        """Return whether this is the step after which a share of the training is done."""
        return self.moment.done + 1 == round(self.config.steps_until(share))


class Part(Protocol):
    """A part of a training that decides on the model."""

    def due(self, now: Now) -> bool:
        """Return whether there is something to decide after this step."""
        ...

    def decide(self, now: Now) -> Change | None:
        """Return the change of the model; None: it stays."""
        ...
