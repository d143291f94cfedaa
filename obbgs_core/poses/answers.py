"""What pictures of a model say of the poses that they were taken from, asked while the training goes on."""

import dataclasses
from collections.abc import Mapping
from concurrent.futures import Future
from dataclasses import dataclass

import torch
from torch import Tensor

from obbgs_core.batches import Batches
from obbgs_core.compiled import Background
from obbgs_core.misfit import relative_misfit, sampled
from obbgs_core.model.gaussians import Gaussians
from obbgs_core.poses.registration import CellInformation, PoseInformation, pose_information
from obbgs_core.render.slopes import render_with_slopes
from obbgs_core.sensor import Sensor

RENDERED = 6  # frames at a time
_asking = Background("poses")  # of all trainings of this process


@dataclass(frozen=True)
class Question:
    """Frames that are asked, and the model and poses that they are asked about.

    indices: of the frames; poses: [B, 4, 4] theirs, world to camera; cell_m: edge of the cells of the surface.
    coarse: the frames whose pictures are averaged to a share of their size, by index: where a pose may err by more than
        a pattern repeats, such as solar cells, the pattern must not be seen.
    """

    model: Gaussians
    batches: Batches
    indices: list[int]
    poses: Tensor
    sensor: Sensor
    cell_m: float
    coarse: Mapping[int, float]

    @torch.no_grad()
    def answer(self) -> "Answer":
        """Render the model and compare it with the frames' readings."""
        told, misfits, parts = [], [], self._parts()
        for scale, places in parts:
            batch = self.batches.batch([self.indices[k] for k in places], scale)
            cameras = dataclasses.replace(batch.cameras, world_to_camera=self.poses[places])
            rendered, slopes = render_with_slopes(self.model, cameras)
            images = (rendered.radiance, slopes, rendered.alpha, rendered.depth)
            readings = (batch.exposure_time_s, batch.dn, self.sensor, batch.averaged_pixels)
            told.append(pose_information(*images, cameras, *readings, cell_m=self.cell_m))
            radiance, dn = sampled(self.sensor, rendered.radiance, batch.dn)
            for one in range(len(cameras)):
                at = slice(one, one + 1)
                seen = (radiance[at], batch.exposure_time_s[at], dn[at])
                misfits.append(relative_misfit(*seen, self.sensor, batch.averaged_pixels))
        asked = [k for _, places in parts for k in places]
        order = sorted(range(len(asked)), key=asked.__getitem__)
        cells = [cell for t in told for cell in t.cells or []]
        information = PoseInformation(
            torch.cat([t.gradient for t in told])[order],
            torch.cat([t.curvature for t in told])[order],
            [cells[k] for k in order] if cells else [],
            self.cell_m,
        )
        dispersion = torch.cat([t.dispersion for t in told if t.dispersion is not None])[order]
        return Answer(self.indices, information, dispersion, torch.tensor(misfits)[order])

    def _parts(self) -> list[tuple[float, list[int]]]:
        """Return which frames are rendered at a time, by their places among the indices, and at which scale."""
        scales = [self.coarse.get(index, 1.0) for index in self.indices]
        parts = []
        for scale in sorted(set(scales), reverse=True):
            places = [k for k, of_frame in enumerate(scales) if of_frame == scale]
            parts += [(scale, places[first : first + RENDERED]) for first in range(0, len(places), RENDERED)]
        return parts


@dataclass(frozen=True)
class Answer:
    """What frames say of their poses and of the surface.

    dispersion: [B] their residuals as mean squares in deviations of the noise; misfit: [B] as shares of their light.
    """

    indices: list[int]
    information: PoseInformation
    dispersion: Tensor
    misfit: Tensor

    def standing_out(self, by: float) -> list[int]:
        """Return the places of the frames that are so far off that something else than the model's error is in them.

        Both residuals have to say so: the smallest error of a pose shows in deviations of the noise where thin
        structures are seen edge-on, but it moves little of the picture's light there. A frame without the target has
        residuals of NaN, and does not.

        Args:
            by: of the logarithm of the dispersion, so many median absolute deviations above the median, scaled to those
                of a normal distribution; of the misfit, so many times the median.
        """
        above, times = self._residuals()
        return torch.nonzero((above > by) & (times > by))[:, 0].tolist()

    def doubtful(self, by: float) -> list[int]:
        """Return the places of the frames that stand out, or would if exposures had told as much: dim ones hide errors.

        Args:
            by: as for `standing_out`, but in the mean of both; a frame whose misfit is that high need have a third of
                it as its dispersion.
        """
        above, times = self._residuals()
        return torch.nonzero((above > by / 3) & (times > by) & (above + times > 2 * by))[:, 0].tolist()

    def _residuals(self) -> tuple[Tensor, Tensor]:
        """Return the deviations of the dispersions above their median [B], and misfits over theirs [B]."""
        logs = self.dispersion.log()
        above = logs - logs.nanmedian()
        return above / (1.4826 * above.abs().nanmedian()), self.misfit / self.misfit.nanmedian()


class PoseRound:
    """A round of the poses under way: frames are asked in a thread of its own, and the training goes on meanwhile.

    Where a core is free, a round takes little time. Its answer is of the model at which it began, whenever it comes.

    Args:
        brackets: indices of the frames, by bracket; one frame of each is asked.
        answered_at: steps of the training after which the answer is used.
        judges: whether brackets whose residuals stand out are left out then.
    """

    def __init__(self, question: Question, brackets: list[list[int]], answered_at: int, judges: bool):
        self.brackets, self.answered_at, self.judges = brackets, answered_at, judges
        self._coming: Future[Answer] | Answer = _asking.submit(question.answer)

    def answer(self) -> Answer:
        """Return what the frames have said, as soon as they have."""
        return self._coming.result() if isinstance(self._coming, Future) else self._coming

    def __getstate__(self) -> dict:
        return vars(self) | {"_coming": self.answer()}


# the classes that a checkpoint of a round may hold
SAVED = [PoseRound, Answer, PoseInformation, CellInformation]
