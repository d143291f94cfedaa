"""What every compared method returns, and how the comparison follows and interrupts its work."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from obbgs_core.frames import TrainingFrame
from obbgs_core.model.cameras import Cameras
from obbgs_core.poses.estimate import PoseEstimate


@dataclass(frozen=True)
class EstimatedPoses:
    """The poses that a method made of those it was given, so that its model lies in a frame of its own.

    settled: from held-out frames to the same in poses that are settled on their pictures, the model fixed.
    """

    estimate: PoseEstimate
    settled: Callable[[list[TrainingFrame]], list[TrainingFrame]]


@dataclass(frozen=True)
class Reconstruction:
    """What a method made of some frames.

    points: [N, 3] its own points, m, body frame: the centres of Gaussians, or a point cloud.
    surface: [M, 3] points on the surface that the training views see, m, body frame; empty where it has none.
    image: from one camera and an exposure time (s) to a noiseless image [H, W, C] as a fraction of full scale, 0 to 1;
        None where the method makes no images.
    size_bytes: of the file or the parameters that one would keep.
    seconds: of the method's own work, without scoring, over all interrupted parts.
    figures: further columns of its row, such as the number of registered frames.
    stated_errors: from held-out frames, their true radiance (or none) and the frames that calibrate to how well the
        intervals and errors hold that method and sensor state (`obbgs_core.score.intervals`); None where pictures are
        not made by exposing a radiance.
    poses: None where the method takes the poses as they are given.
    """

    points: Tensor
    surface: Tensor
    image: Callable[[Cameras, float], Tensor] | None
    size_bytes: int
    seconds: float
    figures: dict[str, Any] = field(default_factory=dict)
    stated_errors: (
        Callable[[list[TrainingFrame], list[Tensor], Sequence[TrainingFrame]], dict[str, float]] | None
    ) = None
    poses: EstimatedPoses | None = None

    @staticmethod
    def nothing(seconds: float, reason: str) -> "Reconstruction":
        """Return the reconstruction of a method that failed, with the reason in its row."""
        empty = torch.zeros(0, 3)
        return Reconstruction(empty, empty, None, 0, seconds, {"failed": reason})


@dataclass(frozen=True)
class Work:
    """How one reconstruction is followed, kept and interrupted.

    folder: where checkpoints and other intermediate files go; a killed reconstruction goes on from them when it is
        called again. None: nothing is kept.
    on_step: called with the share of the work that is done, the seconds spent so far, and a function that returns the
        reconstruction as it stands, with points on its surface where it is called with true: those take long. Its own
        time does not count as the method's.
    should_stop: asked after each step; when it returns true, the work is saved and ends in `Interrupted`.
    """

    folder: Path | None = None
    on_step: Callable[[float, float, Callable[[bool], Reconstruction]], None] = (
        lambda share, seconds, snapshot: None
    )
    should_stop: Callable[[], bool] = lambda: False
