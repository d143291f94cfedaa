"""The state of a training: everything that the next step depends on, and the checkpoint that it is saved in."""

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

from obbgs_base.files import set_aside, write_whole
from obbgs_core.model.cameras import Cameras
from obbgs_core.model.gaussians import Gaussians
from obbgs_core.model.pose_covariance import Whitening
from obbgs_core.obb import Obb
from obbgs_core.poses.answers import SAVED as ROUND_SAVED
from obbgs_core.poses.answers import PoseRound
from obbgs_core.poses.corrections import PoseCorrections
from obbgs_core.render.shadows import ShadowMap
from obbgs_core.train.adam import Adam
from obbgs_core.train.appearance import Shadows
from obbgs_core.train.averaging import Average
from obbgs_core.train.compensation import Compensation
from obbgs_core.train.growth import Growth
from obbgs_core.train.neighbours import Neighbours
from obbgs_core.train.order import FrameOrder
from obbgs_core.train.poses import PoseDecision
from obbgs_core.train.result import StepInfo
from obbgs_core.train.smoothing import log_lowering, smoothed

log = logging.getLogger(__name__)
FORMAT = 16  # of checkpoints; raise it when the fields of a class below change


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
    """Everything that the next step depends on besides what the training is given, and what its result reports."""

    rng: torch.Generator
    gaussians: Gaussians
    adam: Adam
    growth: Growth
    order: FrameOrder
    poses: PoseCorrections | None  # None: as tagged
    poses_aligned: bool  # before the first step, or by rounds before the schedule was set back
    pose_decision: PoseDecision
    pose_evidence: (
        str  # what the decision rests on, in words for the report; nothing where the decision says it all
    )
    holds: int  # how often the schedule will still be set back for the poses
    appearance_reason: str  # why the radiance depends on what it does
    highlights_reason: str = ""  # why it has highlights or not; empty: not tested
    highlights_frames: int = 0  # how many there were when they were tested
    has_joined: bool = False  # frames have, since the first Gaussians were placed
    # refined poses that the setup was made with, as they were then; None: it was made with the tags
    placed_by: PoseCorrections | None = None
    round: PoseRound | None = None  # of the poses, under way
    pose_rounds: float = 0.0  # in which the pose of a frame has moved, mean of the frames
    average: Average | None = None  # of the models of the last steps; None: not averaged yet
    smoothing_m: Tensor | None = None  # [N] deviations of the 3D filter; None: the method has none
    compensation: Compensation | None = None  # None: the colours of all frames are the model's
    misfits: list[int] = field(
        default_factory=list
    )  # frames that are left out: they fit no pose that their tags allow
    boxes: list[Obb] = field(default_factory=list)  # behind the worst tiles since the last growth inside them
    shadows: Shadows = field(default_factory=Shadows)
    neighbours: Neighbours = field(default_factory=Neighbours)
    chi2: float = math.nan  # running mean
    misfit: float | None = None  # running mean of the model's own error; None: not learnt, or not yet
    # how many times as large it is on frames that are not trained on; None: not measured
    unseen_factor: float | None = None
    psnr_db: float = math.nan  # of the last step's frames
    steps_done: int = 0
    seconds: float = 0.0
    removed_not_finite: int = 0
    history: list[StepInfo] = field(default_factory=list)

    @property
    def model(self) -> Gaussians:
        """The Gaussians as they are rendered; gradients reach those that are trained."""
        return self._filtered(self.gaussians)

    @property
    def averaged_model(self) -> Gaussians:
        """The mean of the models of the last steps where they are averaged, else the model, without gradients."""
        return self._filtered(self.gaussians if self.average is None else self.average.gaussians).detach()

    def _filtered(self, gaussians: Gaussians) -> Gaussians:
        return gaussians if self.smoothing_m is None else smoothed(gaussians, self.smoothing_m)

    @property
    def pose_report(self) -> str:
        """Whether the poses are refined, and why, in words."""
        decision = self.pose_decision.report
        return f"{decision} ({self.pose_evidence})" if self.pose_evidence else decision

    @property
    def log_lowering(self) -> Tensor | None:
        """The logarithm [N] of the factor by which the 3D filter lowers opacities."""
        return None if self.smoothing_m is None else log_lowering(self.gaussians, self.smoothing_m)

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
            difference = identity.difference(saved["identity"])
            if not difference:
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
            why = f"is damaged or of another version ({error})"
        kept = set_aside(path).name
        log.warning("%s %s: it is not used; it is kept as %s, and this training begins anew", path, why, kept)
        return None


# the classes that a checkpoint may hold: nothing else in a file is ever built
SAVED = [
    TrainingState,
    Gaussians,
    Adam,
    Average,
    Growth,
    Compensation,
    FrameOrder,
    PoseCorrections,
    PoseDecision,
    Whitening,
    Obb,
    Shadows,
    ShadowMap,
    Neighbours,
    Cameras,
    StepInfo,
    *ROUND_SAVED,
]
