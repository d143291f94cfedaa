"""The model that a live reconstruction shows: the best so far by the held-out frames that have come."""

import dataclasses
import logging
import math
import shutil
from pathlib import Path

import torch

from ground.run.estimated_poses import settled_records, write_estimate
from ground.run.live.arrivals import Arrivals
from ground.run.model_files import exposure_times_s
from ground.run.runs import is_live
from ground.session.cameras import cameras_of, median_sun_direction, predicted_image, sensor_of
from ground.session.folder import FrameRecord
from ground.session.training_frames import training_frame
from obbgs_base.errors import reason
from obbgs_core.frames import TrainingFrame
from obbgs_core.io.ply import save_ply
from obbgs_core.model.gaussians import Gaussians
from obbgs_core.poses.estimate import PoseEstimate
from obbgs_core.render.backdrops import without_earth
from obbgs_core.score.metrics import psnr_db

log = logging.getLogger(__name__)
SCORED = 16  # held-out frames at most, spread evenly over those that have come
SETTLED = 3  # the same where poses have to settle, which takes as long as some 50 pictures


class ShownModel:
    """Renews model.ply in a run's folder when a model is better than the one that is there.

    held_out_db: mean PSNR of that one against held-out frames; NaN before the first of them.
    estimate: of the poses that it was trained with; None: they are as tagged.
    """

    def __init__(self, folder: Path, arrivals: Arrivals):
        self.gaussians: Gaussians | None = None
        self.step: int | None = None  # of the training, that the shown model is of
        self.offered_step: int | None = None  # of the last model that was offered
        self.held_out_db = math.nan
        self.estimate: PoseEstimate | None = None
        self._folder, self._arrivals = folder, arrivals
        self._scored_frames = 0  # held-out frames that had come when held_out_db was found
        self._frames: dict[int, TrainingFrame] = {}  # held-out frames as tagged

    def offer(self, gaussians: Gaussians, step: int, estimate: PoseEstimate | None = None) -> bool:
        """Show a model, unless the shown one is better by the same held-out frames; return whether it was shown.

        estimate: of the poses that the model was trained with; None: they are as tagged.
        """
        self.offered_step, held_out = step, self._arrivals.held_out  # the frames that have come by now
        offered_db = self._score_db(gaussians, estimate, held_out)
        if self.gaussians is not None:
            if len(held_out) != self._scored_frames:
                self.held_out_db = self._score_db(self.gaussians, self.estimate, held_out)
            self._scored_frames = len(held_out)
            if self.held_out_db > offered_db:
                return False
        try:
            self._write(gaussians, estimate)
        except OSError as error:  # a full disk must not end the training
            log.warning("step %d: %s cannot be renewed: %s", step, self._folder / "model.ply", reason(error))
            return False
        self.gaussians, self.step, self.held_out_db = gaussians, step, offered_db
        self.estimate = estimate
        self._scored_frames = len(held_out)
        return True

    def score_db(self, gaussians: Gaussians, estimate: PoseEstimate | None) -> float:
        """Return the mean PSNR of a model against held-out frames, noisy as they came; NaN without such frames.

        Where poses are estimated with the model, a few of them are seen from where their own pictures settle.
        """
        return self._score_db(gaussians, estimate, self._arrivals.held_out)

    def _score_db(
        self, gaussians: Gaussians, estimate: PoseEstimate | None, held_out: list[FrameRecord]
    ) -> float:
        """Return the mean PSNR against held-out frames, those without the Earth in view where there are such."""
        session = self._arrivals.session
        if session is None or not held_out:
            return math.nan
        sensor, values = sensor_of(session.camera), []
        new = [record for record in held_out if record.id not in self._frames]
        for record in self._arrivals.whole(new):
            self._frames[record.id] = training_frame(session, record)
        held_out = [record for record in held_out if record.id in self._frames]
        if not held_out:
            return math.nan
        held_out = [r for r in held_out if self._frames[r.id].earth_m is None] or held_out
        scored = held_out[:: math.ceil(len(held_out) / (SCORED if estimate is None else SETTLED))]
        frames = (self._frames[record.id] for record in scored)
        scored = settled_records(gaussians, scored, frames, sensor, estimate)
        for record in scored:
            pose = torch.from_numpy(record.world_to_camera).float()
            frame = dataclasses.replace(self._frames[record.id], world_to_camera=pose)
            predicted = predicted_image(gaussians, session, record, sensor, record.exposure_time_s)
            values.append(psnr_db(predicted, without_earth(gaussians, frame, sensor).dn / sensor.white_dn))
        return math.fsum(values) / len(values)

    def _write(self, gaussians: Gaussians, estimate: PoseEstimate | None) -> None:
        session, training = self._arrivals.session, self._arrivals.training
        assert session is not None
        if self._folder.exists() and not is_live(self._folder):
            shutil.rmtree(self._folder)  # a finished run that may be replaced
        self._folder.mkdir(parents=True, exist_ok=True)
        sensor = sensor_of(session.camera)
        write_estimate(self._folder, estimate)
        white_radiance = sensor.full_scale_radiance(exposure_times_s(training)[0])
        sun_dir, cameras = median_sun_direction(training), cameras_of(session, training)
        save_ply(gaussians, self._folder / "model.ply", white_radiance, sun_dir, cameras)
