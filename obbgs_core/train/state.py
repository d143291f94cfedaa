"""The state of a training: everything that the next step depends on, and the checkpoint that it is saved in."""

import dataclasses
import io
import json
import logging
import math
import pickle
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from obbgs_base.errors import reason
from obbgs_base.files import set_aside, write_whole
from obbgs_core.errors import Diverged
from obbgs_core.evidence.poses import validation_brackets
from obbgs_core.evidence.response import Response
from obbgs_core.methods.config import MethodConfig, Moment
from obbgs_core.model.cameras import Cameras
from obbgs_core.model.gaussians import Gaussians
from obbgs_core.model.obb import Obb
from obbgs_core.model.pose_covariance import Whitening
from obbgs_core.poses.answers import SAVED as ROUND_SAVED
from obbgs_core.poses.corrections import PoseCorrections
from obbgs_core.published.compensation import Compensation
from obbgs_core.published.smoothing import sampling_deviation_m, smoothed
from obbgs_core.render.shadows import ShadowMap, Shadows
from obbgs_core.settings import flat
from obbgs_core.train.adam import FIRST_MEMORY, SECOND_MEMORY, Adam, Average
from obbgs_core.train.fit import Fit
from obbgs_core.train.growth import Extension, Growth, OpacityResets, finite
from obbgs_core.train.objective import Neighbours
from obbgs_core.train.order import FrameOrder
from obbgs_core.train.parts import Change, Now, Part, Seen
from obbgs_core.train.poses import PoseDecision, Poses
from obbgs_core.train.result import StepInfo
from obbgs_core.train.selection import Harmonics, Highlights, Pruning
from obbgs_core.train.setup import Start, TrainingSetup

log = logging.getLogger(__name__)
FORMAT = 20  # of checkpoints; raise it when the fields of a class below change


@dataclass(frozen=True)
class Identity:
    """What decides the result of a training, to tell whether a checkpoint belongs to it.

    inputs: a digest of the seed, the sensor and the frames.
    settings: of the method, by name.
    defaults: the value of each setting at which a training is as it was before there was this setting.
    """

    inputs: str
    settings: dict[str, Any]
    defaults: dict[str, Any]

    @staticmethod
    def of(setup: TrainingSetup) -> "Identity":
        """Return that of the training of a setup."""
        return Identity(setup.digest, flat(setup.asked), flat(MethodConfig(setup.asked.name)))

    def text(self) -> str:
        """Return inputs and settings as JSON."""
        return json.dumps({"inputs": self.inputs, "settings": self.settings})

    def difference(self, text: str) -> str:
        """Return in what the training whose `text` this is differs from this one; nothing if it is the same.

        All of its settings are compared, whatever their defaults are by now. One that it does not have is newer than
        it; it stands for its default.

        Raises:
            ValueError, LookupError, TypeError: not such a text.
        """
        other = json.loads(text)
        mine = json.loads(self.text())["settings"]
        theirs = json.loads(json.dumps(self.defaults)) | other["settings"]
        if different := sorted(name for name in mine | theirs if mine.get(name) != theirs.get(name)):
            return f"in {', '.join(different)}"
        return "" if other["inputs"] == self.inputs else "in its frames, its sensor or its seed"


@dataclass
class TrainingState:
    """Everything that the next step depends on besides what the training is given, and what its result reports.

    The trainer keeps the model, its optimizer, the random numbers and the schedule; the other fields are the parts,
    each of which changes itself.
    """

    rng: torch.Generator
    gaussians: Gaussians
    adam: Adam
    order: FrameOrder
    growth: Growth
    poses: Poses
    harmonics: Harmonics
    highlights: Highlights = field(default_factory=Highlights)
    fit: Fit = field(default_factory=Fit)
    extension: Extension = field(default_factory=Extension)  # of growth
    response: Response = field(default_factory=Response)
    average: Average = field(default_factory=Average)  # of the models of the last steps
    deviation_m: Tensor | None = None  # [N] of the 3D filter; None: the method has none
    # [H, W] which pixels may show the target, of the frames that have the Earth in view, by index
    near_target: dict[int, Tensor] = field(default_factory=dict)
    compensation: Compensation | None = None  # None: the colours of all frames are the model's
    shadows: Shadows = field(default_factory=Shadows)
    neighbours: Neighbours = field(default_factory=Neighbours)
    has_joined: bool = False  # frames have, since the first Gaussians were placed
    steps_done: int = 0
    seconds: float = 0.0
    removed_not_finite: int = 0
    history: list[StepInfo] = field(default_factory=list)

    @staticmethod
    def first(setup: TrainingSetup, start: Start, refined: PoseCorrections | None = None) -> "TrainingState":
        """Return the state before the first step.

        Args:
            refined: poses that the start was made with.
        """
        config, brackets = setup.config, validation_brackets(setup.frames)
        poses = Poses.first(setup, start, bool(brackets), refined)
        is_open, as_tagged = poses.decision is PoseDecision.OPEN, poses.corrections is None
        kept_back = brackets if is_open or (setup.keeps_unseen and as_tagged) else []
        # the method's own memory only where neither the Sun nor the poses can move
        still = as_tagged and not is_open and not setup.sun_moves
        memory = config.rates.second_memory if still else SECOND_MEMORY
        channels = setup.frames[0].shape[2]
        state = TrainingState(
            rng=start.rng,
            gaussians=start.gaussians,
            adam=Adam(start.gaussians, (FIRST_MEMORY, memory)),
            order=FrameOrder(setup.exposures_s, config.published.bracket_steps, kept_back),
            growth=Growth.of(len(start.gaussians)),
            poses=poses,
            harmonics=Harmonics("as configured" if config.published.sh_degree else ""),
            compensation=Compensation(len(setup.frames), channels) if config.published.compensation else None,
        )
        if config.published.smoothing_px2:
            state.deviation_m = sampling_deviation_m(
                start.gaussians.means, setup.frames, config.published.smoothing_px2
            )
        return state

    @property
    def parts(self) -> list[Part]:
        """The parts that decide on the model, in the order in which they do."""
        number = [self.growth, OpacityResets()]
        return [self.poses, self.fit, *number, self.highlights, Pruning(), self.harmonics]

    def now(self, setup: TrainingSetup, moment: Moment, seen: Seen) -> Now:
        """Return what parts see of the training in a step."""
        poses = self.poses
        is_resettling = self.has_joined and poses.corrections is not None
        return Now(
            setup=setup,
            moment=moment,
            taken=len(self.history),
            gaussians=self.gaussians,
            deviation_m=self.deviation_m,
            corrections=poses.corrections,
            is_resettling=is_resettling,
            waits_for_poses=is_resettling and poses.set_backs > 0,
            keeps_unseen=self.keeps_unseen(setup),
            misfit=self.fit.misfit,
            order=self.order,
            shadows=self.shadows,
            rng=self.rng,
            seen=seen,
        )

    def keeps_unseen(self, setup: TrainingSetup) -> bool:
        """Return whether there are brackets that are kept back to tell the model's own error."""
        return setup.keeps_unseen and not self.poses.decision.is_open and bool(self.order.validation_brackets)

    def apply(self, setup: TrainingSetup, change: Change) -> None:
        """Change the model, and all that follows its Gaussians."""
        self.gaussians = change.model.trainable()
        self.adam.apply(change)
        self.growth.follow(change)
        self.average.follow(change)
        if change.reason:
            log.info("step %d: %s", self.steps_done + 1, change.reason)
        if change.goes_on and not change.added and self.deviation_m is not None:
            self.deviation_m = self.deviation_m[change.kept]
        elif change.kept is not None:
            self.find_filter(setup)

    def find_filter(self, setup: TrainingSetup) -> None:
        """Find the widths of the 3D filter, where the method has one, because Gaussians have moved or are others."""
        if setup.config.published.smoothing_px2:
            poses = self.poses.corrections
            frames = setup.frames if poses is None else poses.frames(setup.frames)
            variance_px2 = setup.config.published.smoothing_px2
            self.deviation_m = sampling_deviation_m(self.gaussians.means, frames, variance_px2)

    def drop_not_finite(self, setup: TrainingSetup) -> None:
        """Remove the Gaussians of which a parameter became NaN or infinite, and count them.

        Raises:
            Diverged: no Gaussian is finite.
        """
        kept = finite(self.gaussians)
        count = len(kept) - int(kept.sum())
        if count == len(kept):
            problem = f"none of {count} Gaussians has finite parameters any more,"
            raise Diverged(self.steps_done, math.nan, problem)
        if count:
            self.apply(setup, Change.only(self.gaussians, kept, "", goes_on=True))
            self.removed_not_finite += count
            log.warning("step %d: %d Gaussians were not finite and are removed", self.steps_done, count)

    @property
    def model(self) -> Gaussians:
        """The Gaussians as they are rendered; gradients reach those that are trained."""
        return self._filtered(self.gaussians)

    @property
    def averaged_model(self) -> Gaussians:
        """The mean of the models of the last steps where they are averaged, else the model, without gradients."""
        return self._filtered(self.average.gaussians or self.gaussians).detach()

    def _filtered(self, gaussians: Gaussians) -> Gaussians:
        return gaussians if self.deviation_m is None else smoothed(gaussians, self.deviation_m)

    def begun_again(self, fresh: "TrainingState") -> "TrainingState":
        """Return a state before the first step that goes on with what this one counted."""
        counted = {name: getattr(self, name) for name in ("history", "seconds", "removed_not_finite")}
        return dataclasses.replace(fresh, **counted)

    def __getstate__(self) -> dict:
        return vars(self) | {"rng": self.rng.get_state()}

    def __setstate__(self, saved: dict) -> None:
        vars(self).update(saved | {"rng": torch.Generator().set_state(saved["rng"])})

    def save(self, path: Path, identity: Identity) -> None:
        """Write the state with the identity of its training, whole or not at all.

        Raises:
            OSError: the disk does not take it.
        """
        content = io.BytesIO()
        torch.save({"format": FORMAT, "identity": identity.text(), "state": self}, content)
        write_whole(path, content.getvalue())

    @staticmethod
    def load(path: Path, identity: Identity) -> "TrainingState | None":
        """Return the state in a file; None if there is none that can be used.

        A file that is damaged or of another training or version is set aside, not lost: it may hold the work of days,
        which the version that saved it can complete.
        """
        if not path.exists():
            return None
        try:
            with torch.serialization.safe_globals(SAVED):
                saved = torch.load(path, weights_only=True)
            if saved["format"] != FORMAT:
                raise ValueError(f"expected format {FORMAT}, got {saved['format']}")
            if not (difference := identity.difference(saved["identity"])):
                return saved["state"]
            why = f"belongs to another training, which differs {difference}"
        except (
            pickle.UnpicklingError,
            RuntimeError,
            OSError,
            EOFError,
            LookupError,
            TypeError,
            ValueError,
        ) as error:
            # half a file, or one that another version of this program saved, with other classes
            why = f"is damaged or of another version ({reason(error)})"
        kept = set_aside(path).name
        log.warning("%s %s: it is not used; it is kept as %s, and this training begins anew", path, why, kept)
        return None


# the classes that a checkpoint may hold: nothing else in a file is ever built
SAVED = [
    *(TrainingState, Gaussians, Adam, Average, Growth, Compensation, FrameOrder, Harmonics, Highlights),
    *(
        Fit,
        Extension,
        Response,
        Poses,
        PoseDecision,
        PoseCorrections,
        Whitening,
        Obb,
        Shadows,
        ShadowMap,
        Neighbours,
        Cameras,
    ),
    *(StepInfo, *ROUND_SAVED),
]
