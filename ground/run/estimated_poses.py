"""The estimated poses of a run: their file, and what evaluation needs of them to be fair to a model that moved."""

import dataclasses
import json
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from flightsw.icd.quaternion import matrix_to_quat
from ground.run.runs import Run
from ground.session.earth import attitude_behind
from ground.session.folder import FrameRecord, Session, SessionError
from ground.session.training_frames import frames_of, tag_covariance, training_frame
from ground.session.truth import Truth
from obbgs_base.errors import reason
from obbgs_base.files import write_whole
from obbgs_base.physics.navigation_errors import SharedParameters, jacobian
from obbgs_core.frames import TrainingFrame
from obbgs_core.model.gaussians import Gaussians
from obbgs_core.poses.corrections import motion_of, with_estimate
from obbgs_core.poses.estimate import PoseEstimate
from obbgs_core.poses.gauge import best_motion, size_of
from obbgs_core.render.backdrops import without_earth
from obbgs_core.score.poses import PoseErrors, pose_errors, settled_poses
from obbgs_core.sensor import Sensor

FILE = "poses_estimated.json"


def write_estimate(folder: Path, estimate: PoseEstimate | None) -> None:
    """Write what a training found of its poses into a run folder; where they are as tagged there is no file."""
    if estimate is None:
        (folder / FILE).unlink(missing_ok=True)
    else:
        write_whole(folder / FILE, (json.dumps(estimate.tree()) + "\n").encode())


def read_estimate(folder: Path) -> PoseEstimate | None:
    """Return what the training of a run found of its poses; None where they are as tagged.

    Raises:
        SessionError: the file is damaged.
    """
    path = folder / FILE
    if not path.exists():
        return None
    try:
        return PoseEstimate.of(json.loads(path.read_bytes()))
    except (OSError, ValueError, LookupError, TypeError) as error:
        raise SessionError(f"{path} cannot be read: {reason(error)}; make the run again") from error


def estimated_records(records: list[FrameRecord], estimate: PoseEstimate | None) -> list[FrameRecord]:
    """Return training frames with the poses that the training found, without those that it left out.

    They are as they were where it left the poses as tagged.
    """
    if estimate is None:
        return records
    poses = estimate.by_frame()
    return [_placed(record, poses[record.id]) for record in records if record.id in poses]


def posed_frames(frames: list[TrainingFrame], estimate: PoseEstimate | None) -> list[TrainingFrame]:
    """Return training frames with the poses that a training of theirs found, as `estimated_records` does."""
    if estimate is None:
        return frames
    poses = estimate.by_frame()
    return [
        dataclasses.replace(
            frame, world_to_camera=torch.from_numpy(poses[frame.id]).to(frame.world_to_camera)
        )
        for frame in frames
        if frame.id in poses
    ]


def as_estimated(session: Session, estimate: PoseEstimate | None) -> Session:
    """Return a session with the poses that a training found, and what its shared errors make of the others' tags."""
    if estimate is None:
        return session
    poses = estimate.by_frame()
    others = [record for record in session.frames if record.id not in poses and record.pose_valid]
    if others:
        frames = with_estimate([training_frame(session, record) for record in others], estimate)
        poses |= {
            record.id: frame.world_to_camera.double().numpy()
            for record, frame in zip(others, frames, strict=True)
        }
    records = [_placed(r, poses[r.id]) if r.id in poses else r for r in session.frames]
    return dataclasses.replace(session, frames=tuple(records))


def scored_records(
    run: Run, truth: Truth | None = None, records: list[FrameRecord] | None = None
) -> list[FrameRecord]:
    """Return scored frames of a run with the poses from which pictures of its model are compared with them.

    With a truth these are the true poses, moved along where the model moved with the poses that its training refined.
    Without one they are those that settle on the frames' own pictures, or the tags where nothing was refined.

    Args:
        records: whole brackets of them; None: all.

    Raises:
        SessionError: the run's estimate is damaged, the truth lacks a frame, or a picture cannot be read.
    """
    estimate, records = read_estimate(run.folder), run.scored if records is None else records
    if truth is None:
        frames = map(run.without_sky_level, records)
        return settled_records(run.gaussians, records, frames, run.sensor, estimate)
    motion = None if estimate is None else Alignment.of(estimate, run.session, truth).motion.numpy()
    return [truth.posed(record, motion) for record in records]


def refined_session(run: Run) -> Session:
    """Return a run's session with the frames that it was trained and scored on, from the poses that go with its model.

    They state their splits. Poses that were refined are those of the training, and of held-out frames those that
    settled on their pictures; their covariances are what the estimate leaves in doubt, frame by frame. Frames that the
    training left out are not there.
    """
    estimate = read_estimate(run.folder)
    of_split = {"train": estimated_records(run.training, estimate)}
    if run.metrics["scored_frames"] == "held_out":
        of_split["test"] = scored_records(run)
    records = [dataclasses.replace(r, split=split) for split, of in of_split.items() for r in of]
    if estimate is not None:
        left = doubts_left(run.session, records, estimate)
        records = [
            dataclasses.replace(r, covariance=tag_covariance(c, r.world_to_camera[:3, :3]))
            for r, c in zip(records, left, strict=True)
        ]
    frames = tuple(sorted(records, key=lambda record: record.id))
    navigation = run.session.navigation
    if estimate is not None:
        navigation = dataclasses.replace(navigation, sigmas=SharedParameters())
    return dataclasses.replace(run.session, frames=frames, navigation=navigation)


def doubts_left(session: Session, records: list[FrameRecord], estimate: PoseEstimate) -> np.ndarray:
    """Return the covariances [F, 6, 6] of the correcting motions of frames' poses that an estimate leaves in doubt.

    They are those of the shared parameters and of the frames' brackets; of frames that the training did not see those
    that their tags state.

    Args:
        session: with the poses as tagged.
    """
    tagged = {record.id: record for record in session.frames}
    frames = frames_of(session, [tagged[record.id] for record in records])
    row_of = dict(zip(estimate.frame_ids, estimate.brackets, strict=True))
    own = np.zeros((len(frames), 6, 6))
    for place, frame in enumerate(frames):
        if frame.id in row_of:
            own[place] = np.diag(estimate.own_posterior[row_of[frame.id]] ** 2)
        elif frame.pose_covariance is not None:
            own[place] = frame.pose_covariance.numpy()
    if frames[0].navigation is None:
        return own
    columns = jacobian(motion_of(frames), estimate.shared)
    return own + columns @ estimate.shared_covariance @ columns.transpose(0, 2, 1)


def settled_records(
    gaussians: Gaussians,
    records: list[FrameRecord],
    frames: Iterable[TrainingFrame],
    sensor: Sensor,
    estimate: PoseEstimate | None,
) -> list[FrameRecord]:
    """Return held-out frames with the poses that settle on their pictures, the model fixed.

    They are as they were where the training left its poses as tagged.

    Args:
        frames: the same with their pictures, and the poses as tagged; looked at only where poses were refined.
    """
    if estimate is None or not records:
        return records
    placed = [without_earth(gaussians, frame, sensor) for frame in with_estimate(list(frames), estimate)]
    poses = settled_poses(gaussians, placed, sensor)
    return [_placed(record, pose.double().numpy()) for record, pose in zip(records, poses, strict=True)]


def _placed(record: FrameRecord, world_to_camera: np.ndarray) -> FrameRecord:
    position_m = -world_to_camera[:3, :3].T @ world_to_camera[:3, 3]
    attitude = record.quat_inertial_to_body
    if attitude is not None:
        attitude = attitude_behind(attitude, record.world_to_camera, world_to_camera)
    return dataclasses.replace(
        record,
        quat_inertial_to_body=attitude,
        world_to_camera=world_to_camera,
        quat_body_to_camera=matrix_to_quat(world_to_camera[:3, :3]),
        position_body_m=position_m,
    )


@dataclass(frozen=True)
class Alignment:
    """How a model whose poses were estimated lies in the true body frame.

    motion: [4, 4] rigid, from the model's frame to the true one; similarity: the same with the model's size free.
    before, after: errors of the training's poses as tagged and as estimated, each after the rigid motion that suits it
    best; after_similarity: as estimated, after the similarity.
    """

    motion: Tensor
    similarity: Tensor
    before: PoseErrors
    after: PoseErrors
    after_similarity: PoseErrors

    @staticmethod
    def of(estimate: PoseEstimate, session: Session, truth: Truth) -> "Alignment":
        """Return the alignment of an estimate with a simulator's truth.

        Raises:
            SessionError: the truth lacks a frame of the training.
        """
        records = {record.id: record for record in session.frames}
        true = torch.from_numpy(
            np.stack([truth.posed(records[number]).world_to_camera for number in estimate.frame_ids])
        )
        radius_m, focal_px = truth.largest_dimension_m / 2, session.camera.fx_px
        tagged, estimated = torch.from_numpy(estimate.tagged), torch.from_numpy(estimate.estimated)
        motion = best_motion(estimated, true, radius_m)
        similarity = best_motion(estimated, true, radius_m, with_size=True)
        as_tagged = best_motion(tagged, true, radius_m)
        return Alignment(
            motion,
            similarity,
            pose_errors(tagged, true, as_tagged, radius_m, focal_px),
            pose_errors(estimated, true, motion, radius_m, focal_px),
            pose_errors(estimated, true, similarity, radius_m, focal_px),
        )

    def figures(self) -> dict[str, float]:
        """Return the errors for metrics.json; size_error_percent: by how much the model is too large."""
        return {
            "pose_error_tagged_deg": self.before.rotation_deg,
            "pose_error_tagged_range": self.before.range_share,
            "pose_error_tagged_px": self.before.pixels,
            "pose_error_deg": self.after.rotation_deg,
            "pose_error_range": self.after.range_share,
            "pose_error_px": self.after.pixels,
            "similarity_pose_error_deg": self.after_similarity.rotation_deg,
            "similarity_pose_error_range": self.after_similarity.range_share,
            "similarity_pose_error_px": self.after_similarity.pixels,
            "size_error_percent": 100 * (1 / size_of(self.similarity) - 1),
        }
