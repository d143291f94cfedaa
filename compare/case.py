"""One session as a comparison sees it: what every method is given, and what its result is compared with."""

import dataclasses
import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from compare.errors import CompareError
from compare.opponents.reconstruction import Reconstruction
from ground.run.estimated_poses import Alignment
from ground.run.scores import (
    ScoredView,
    clean_scores,
    cloud_scores,
    display_scores,
    mu_law_psnr_db,
    noisy_psnr_db,
)
from ground.session.cameras import exposed, sensor_of
from ground.session.folder import FrameRecord, Session, open_session, pass_name, read_header
from ground.session.training_frames import split, training_frame
from ground.session.truth import Truth
from obbgs_core.frames import TrainingFrame, cameras_of
from obbgs_core.model.cameras import Cameras
from obbgs_core.poses.gauge import seen_after, size_of
from obbgs_core.score.shown import shown_points
from obbgs_core.sensor import Sensor

# what session.json holds besides what decides a comparison: how the frames came, and when
INCIDENTAL = ("created_utc", "losses", "flight", "frames_received", "bytes_received", "log_bytes", "tles")


@dataclass(frozen=True)
class Case:
    """A session's frames, and where a simulator left its truth, what they look like without noise.

    held_out: in their true poses where the truth is known, so that errors of their tags do not count.
    radiance: [H, W, C], scene-linear, and coverage: [H, W] in 0..1, of each held-out frame; empty without truth.
    cloud_m: [N, 3], points of the true surface, body frame; None without truth.
    shown: [N], which of those the training frames show; None where it is not known.
    units_per_m: 2 over the target's largest dimension.
    session: where the frames came from; None for frames that are in no session.
    calibration: frames that are neither trained on nor scored, by which stated uncertainties are calibrated.
    """

    name: str
    sensor: Sensor
    training: list[TrainingFrame]
    held_out: list[TrainingFrame]
    radiance: list[Tensor]
    coverage: list[Tensor]
    cloud_m: np.ndarray | None
    units_per_m: float = 1.0
    session: Session | None = None
    calibration: Sequence[TrainingFrame] = ()
    shown: np.ndarray | None = None

    @property
    def clean(self) -> list[Tensor]:
        """The noiseless exposures [H, W, C] of the held-out frames in 0..1; empty without truth."""
        pairs = zip(self.radiance, self.held_out[: len(self.radiance)], strict=True)
        return [exposed(light, self.sensor, frame.exposure_time_s) for light, frame in pairs]

    @property
    def noisy(self) -> list[Tensor]:
        """The held-out frames as received [H, W, C] in 0..1."""
        return [frame.dn / self.sensor.white_dn for frame in self.held_out]

    def of_views(self, views: Sequence[int]) -> "Case":
        """Return the case with only some of its held-out frames, by their index, and nothing to calibrate by."""
        held_out, radiance, coverage = (
            [of[i] for i in views if of] for of in (self.held_out, self.radiance, self.coverage)
        )
        return dataclasses.replace(
            self, held_out=held_out, radiance=radiance, coverage=coverage, calibration=()
        )

    def seen_by(
        self, reconstruction: Reconstruction, with_size: bool = False
    ) -> tuple["Case", dict[str, float]]:
        """Return the case in the frame of a reconstruction, and how far off its poses are where the truth is known.

        It is the case itself where the method takes the poses as they are given. Where it estimated them, the model may
        have moved as a whole: the truth moves rigidly, so that the true poses of the training come nearest to the
        estimated ones. Without truth each held-out frame is settled on its picture, the model fixed.

        Args:
            with_size: the truth changes its size as well to come nearest.
        """
        poses = reconstruction.poses
        if poses is None or self.session is None:
            return self, {}
        calibration = poses.settled(list(self.calibration)) if self.calibration else ()
        if self.cloud_m is None:
            return dataclasses.replace(
                self, held_out=poses.settled(self.held_out), calibration=calibration
            ), {}
        alignment = Alignment.of(poses.estimate, self.session, Truth(self.session))
        motion = alignment.similarity if with_size else alignment.motion
        true = seen_after(torch.stack([frame.world_to_camera.double() for frame in self.held_out]), motion)
        held_out = [
            dataclasses.replace(frame, world_to_camera=pose.float())
            for frame, pose in zip(self.held_out, true, strict=True)
        ]
        back, shift_m = torch.linalg.inv(motion[:3, :3]).numpy(), motion[:3, 3].numpy()
        moved = dataclasses.replace(
            self,
            held_out=held_out,
            cloud_m=(self.cloud_m - shift_m) @ back.T,
            units_per_m=self.units_per_m * size_of(motion),
            calibration=calibration,
        )
        return moved, alignment.figures()

    def image_scores(self, images: Sequence[Tensor]) -> dict[str, float]:
        """Return the scores of a method's images [H, W, C] of the held-out frames: noisy, and clean where known."""
        pairs = list(zip(images, self.noisy, strict=True))
        figures = {"psnr_noisy_db": noisy_psnr_db(pairs)}
        if not self.radiance:
            if self.session is not None and images[0].shape[2] == 3:  # pictures of another data set
                figures |= display_scores(pairs, self.sensor, self.session.encoding)
            return figures
        exposures_s = [frame.exposure_time_s for frame in self.held_out]
        true = zip(images, self.clean, self.coverage, exposures_s, strict=True)
        return figures | clean_scores([ScoredView(*view) for view in true])

    def radiance_scores(self, image: Callable[[Cameras, float], Tensor]) -> dict[str, float]:
        """Return psnr_mu_db of the radiance that a method's images tell; {} where none is known.

        Images are asked for at the exposure time at which the brightest true pixel of all views reaches full scale, so
        that none is clipped.
        """
        brightest = max((light.max().item() for light in self.radiance), default=0.0)
        if not brightest:
            return {}
        black = self.sensor.black_dn / self.sensor.white_dn
        exposure_s = self.sensor.full_scale_radiance(1.0) / brightest
        with torch.no_grad():
            images = [image(cameras_of([frame]), exposure_s) for frame in self.held_out]
        shown = [(picture - black) / (1 - black) for picture in images]
        return {"psnr_mu_db": mu_law_psnr_db(shown, [light / brightest for light in self.radiance])}

    def cloud_scores(self, points_m: Tensor, surface_m: Tensor) -> dict[str, float]:
        """Return the scores of a method's points [N, 3] and surface points [M, 3]; {} where no surface is known."""
        if self.cloud_m is None:
            return {}
        clouds = {"": points_m.double().numpy(), "_surface": surface_m.double().numpy()}
        return cloud_scores(clouds, self.cloud_m, self.units_per_m, self.shown)

    def true_views(self) -> Callable[[TrainingFrame], tuple[np.ndarray, np.ndarray, np.ndarray | None]]:
        """Return a function from a training frame to its true radiance [H, W, C] and coverage [H, W] in 0..1.

        The third that it returns is the radiance [nH, nW, C] of pixels n times as small, None where it is not known.

        Raises:
            CompareError: the session has no truth.
        """
        session = self.session
        if session is None or not Truth.exists(session):
            raise CompareError(
                f"{self.name} has no truth, so its frames cannot be exposed anew: leave out the conditions that change "
                "exposures, noise or response, or take a simulated session"
            )
        truth, records = Truth(session), {record.id: record for record in session.frames}
        return lambda frame: (*truth.radiance(records[frame.id]), truth.finer(records[frame.id]))


def load_case(folder: Path, sector_deg: float = 0.0) -> Case:
    """Return the case of a session folder, named after the folder, or after the one above where it is `session`.

    Args:
        sector_deg: the width of a sector of viewing directions, about the orbit's normal and around the middle frame.
            If it is above 0, all frames of the sector are held out and scored, and no others.

    Raises:
        SessionError: the session or its truth cannot be used.
        CompareError: no frame is held out, or none is left.
    """
    session = open_session(folder)
    session.check_body_axes()
    training, held_out = split(session)
    calibrating: list[FrameRecord] = []
    if sector_deg:
        inside = _sector(training, sector_deg)
        calibrating = [record for record in held_out if not inside(record)]
        held_out = [record for record in training + held_out if inside(record)]
        training = [record for record in training if not inside(record)]
        if not training:
            raise CompareError(f"a sector of {sector_deg:g} degrees leaves no frame of {folder} for training")
    if not held_out:
        raise CompareError(
            f"{folder} holds out no frames, so nothing can be scored: it needs two brackets or more"
        )
    sensor, truth = sensor_of(session.camera), Truth(session) if Truth.exists(session) else None
    given, calibration = (
        [training_frame(session, r) for r in records] for records in (training, calibrating)
    )
    if truth is None:
        scored = [training_frame(session, record) for record in held_out]
        return Case(
            pass_name(folder), sensor, given, scored, [], [], None, session=session, calibration=calibration
        )
    records = list(map(truth.posed, held_out))
    scored = [
        # the truth is that of a target that stands still
        dataclasses.replace(training_frame(session, record), pose_covariance=None, rates=None)
        for record in records
    ]
    true = [tuple(map(torch.from_numpy, truth.radiance(record))) for record in records]
    return Case(
        pass_name(folder),
        sensor,
        given,
        scored,
        [radiance for radiance, _ in true],
        [coverage for _, coverage in true],
        truth.cloud_m,
        2 / truth.largest_dimension_m,
        session,
        calibration,
        None if session.background else _shown(truth, training, given, sensor),
    )


def _shown(
    truth: Truth, records: list[FrameRecord], frames: list[TrainingFrame], sensor: Sensor
) -> np.ndarray:
    """Return which points [N] of the true surface frames show, in their true poses."""
    poses = [torch.from_numpy(truth.posed(record).world_to_camera).float() for record in records]
    posed = [dataclasses.replace(f, world_to_camera=pose) for f, pose in zip(frames, poses, strict=True)]
    return shown_points(truth.cloud_m, posed, sensor)


def _sector(training: list[FrameRecord], width_deg: float) -> Callable[[FrameRecord], bool]:
    """Return whether a frame was taken from the sector around the middle one of the training frames.

    Its azimuth is measured about the direction in which the cameras' directions from the target vary least.
    """

    def direction(record: FrameRecord) -> np.ndarray:
        return record.position_body_m / np.linalg.norm(record.position_body_m)

    directions = np.array([direction(record) for record in training])
    _, _, axes = np.linalg.svd(directions)

    def azimuth_deg(record: FrameRecord) -> float:
        along, across = axes[:2] @ direction(record)
        return float(np.degrees(np.arctan2(across, along)))

    middle_deg = azimuth_deg(training[len(training) // 2])
    return lambda record: abs((azimuth_deg(record) - middle_deg + 180) % 360 - 180) <= width_deg / 2


def content_digest(folder: Path) -> str:
    """Return the SHA-256 of everything in a session that a comparison depends on: frames, tags, calibration, truth.

    It is the same for a copy of the session, wherever it lies.

    Raises:
        SessionError: the session or its truth cannot be used.
    """
    session = open_session(folder)
    header = {key: value for key, value in read_header(folder).items() if key not in INCIDENTAL}
    digest = hashlib.sha256(json.dumps(header, sort_keys=True).encode())
    digest.update((folder / "frames.jsonl").read_bytes())
    truth = Truth(session) if Truth.exists(session) else None
    for record in session.frames:
        digest.update(session.dn(record).tobytes())
        if truth is not None:
            digest.update(repr(truth.posed(record).world_to_camera.tolist()).encode())
            for array in (*truth.radiance(record), truth.finer(record)):
                digest.update(b"" if array is None else array.tobytes())
    if truth is not None:
        digest.update(repr(truth.largest_dimension_m).encode() + truth.cloud_m.tobytes())
    return digest.hexdigest()
