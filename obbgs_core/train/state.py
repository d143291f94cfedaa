"""The state of a training: everything that the next step depends on, and the checkpoint that it is saved in."""

import io
import logging
import math
import pickle
from dataclasses import dataclass, field
from pathlib import Path

import torch

from obbgs_base.files import write_whole
from obbgs_core.model.cameras import Cameras
from obbgs_core.model.gaussians import Gaussians
from obbgs_core.model.pose_covariance import Whitening
from obbgs_core.obb import Obb
from obbgs_core.render.shadows import ShadowMap
from obbgs_core.train.adam import Adam
from obbgs_core.train.appearance import Shadows
from obbgs_core.train.batches import FrameOrder
from obbgs_core.train.growth import Growth
from obbgs_core.train.poses import PoseCorrections
from obbgs_core.train.result import StepInfo

log = logging.getLogger(__name__)
FORMAT = 2  # of checkpoints; raise it when the fields of a class below change


@dataclass
class TrainingState:
    """Everything that the next step depends on besides what the training is given, and what its result reports."""

    rng: torch.Generator
    gaussians: Gaussians
    adam: Adam
    growth: Growth
    order: FrameOrder
    poses: PoseCorrections | None  # None: as tagged
    poses_decided: str  # whether the poses are refined, and why; empty: the validation brackets will decide
    appearance_reason: str  # why the radiance depends on what it does
    boxes: list[Obb] = field(default_factory=list)  # behind the worst tiles since the last growth inside them
    shadows: Shadows = field(default_factory=Shadows)
    chi2: float = math.nan  # running mean
    psnr_db: float = math.nan  # of the last step's frames
    steps_done: int = 0
    seconds: float = 0.0
    removed_not_finite: int = 0
    history: list[StepInfo] = field(default_factory=list)

    def __getstate__(self) -> dict:
        return vars(self) | {"rng": self.rng.get_state()}

    def __setstate__(self, saved: dict) -> None:
        vars(self).update(saved | {"rng": torch.Generator().set_state(saved["rng"])})

    def save(self, path: Path, fingerprint: str) -> None:
        """Write the state with the fingerprint of its training, whole or not at all.

        Raises:
            OSError: the disk does not take it.
        """
        content = io.BytesIO()
        torch.save({"fingerprint": f"{FORMAT} {fingerprint}", "state": self}, content)
        write_whole(path, content.getvalue())

    @staticmethod
    def load(path: Path, fingerprint: str) -> "TrainingState | None":
        """Return the state in a file; None if there is none, or if it is damaged or of another training or version."""
        if not path.exists():
            return None
        try:
            with torch.serialization.safe_globals(SAVED):
                saved = torch.load(path, weights_only=True)
            same = saved["fingerprint"] == f"{FORMAT} {fingerprint}"
        except (pickle.UnpicklingError, RuntimeError, OSError, EOFError, LookupError, TypeError) as error:
            # half a file, or one that another version of this program saved, with other classes
            log.warning("%s is damaged or of another version, it is not used: %s", path, error)
            return None
        if not same:
            log.warning("%s belongs to another training: it is not used", path)
            return None
        return saved["state"]


# the classes that a checkpoint may hold: nothing else in a file is ever built
SAVED = [
    TrainingState,
    Gaussians,
    Adam,
    Growth,
    FrameOrder,
    PoseCorrections,
    Whitening,
    Obb,
    Shadows,
    ShadowMap,
    Cameras,
    StepInfo,
]
