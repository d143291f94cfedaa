"""Which run a viewer shows: found by its folder or by its session's, and read again whenever its model is renewed."""

import os
from dataclasses import dataclass, field
from pathlib import Path

from ground.run import attitude
from ground.run.attitude import FoundAttitude
from ground.run.estimated_poses import as_estimated, read_estimate, settled_records
from ground.run.runs import is_session, newest_run, session_of
from ground.session.cameras import sensor_of
from ground.session.folder import FrameRecord, Session, SessionError, open_session, pass_name
from ground.session.training_frames import training_frame
from obbgs_core.io.ply import load_ply
from obbgs_core.model.gaussians import Gaussians
from obbgs_core.poses.estimate import PoseEstimate
from obbgs_core.sensor import Sensor

MODEL, MESH = "model.ply", "model.glb"
FileStamp = tuple[int, int, int]  # number, time and size of a file
Stamp = tuple[FileStamp, FileStamp | None]  # of a model, and of its mesh where there is one


@dataclass(frozen=True)
class Shown:
    """A model with its session, whose poses are those of the model, as it was when it was read.

    mesh: the bytes of model.glb where there is one. tagged: the session with its tags; estimate: what the training
    found of them, None where they are as tagged.
    """

    name: str
    session: Session
    sensor: Sensor
    gaussians: Gaussians
    mesh: bytes | None
    tagged: Session
    estimate: PoseEstimate | None
    _compared: dict[int, FrameRecord] = field(default_factory=dict, repr=False)

    def compared(self, record: FrameRecord) -> FrameRecord:
        """Return a frame with the pose from which the model's picture is compared with it.

        Where poses were refined, one that the training did not see is settled on its picture, as in the scores.
        """
        if self.estimate is None or record.id in self.estimate.frame_ids or not record.pose_valid:
            return record
        if record.id not in self._compared:
            seen = set(self.estimate.frame_ids)
            bracket = [r for r in self.tagged.frames if r.bracket == record.bracket and r.id not in seen]
            frames = (training_frame(self.tagged, record) for record in bracket)
            settled = settled_records(self.gaussians, bracket, frames, self.sensor, self.estimate)
            self._compared.update({r.id: r for r in settled})
        return self._compared[record.id]


class Source:
    """A run's folder that is watched: a reconstruction under way may renew its model.ply, whole, or has yet to make it.

    folder: of the run; None: of a session that has no run with a model yet.

    Args:
        path: of a run (a folder in runs/ of a session), or of a session, whose newest run is shown.

    Raises:
        SessionError: neither of them.
    """

    def __init__(self, path: Path):
        self.session_path = session_of(path)
        self.folder = newest_run(path) if is_session(path) else path
        self._read: Stamp | None = None

    @property
    def name(self) -> str:
        session = pass_name(self.session_path)
        return session if self.folder is None else f"{session}/{self.folder.resolve().name}"

    def is_ready(self) -> bool:
        """Return whether there is a model to show."""
        if self.folder is None:
            self.folder = newest_run(self.session_path)
        return self._stamp() is not None

    def renewed(self) -> bool:
        """Return whether there is a model.ply, and it or the mesh is another than was read last."""
        return self._stamp() not in (None, self._read)

    def load(self) -> Shown:
        """Return the model and the frames as they are now.

        Raises:
            SessionError, ReconstructionError: a file is missing or damaged.
        """
        stamp = self._stamp()
        if stamp is None:
            raise SessionError(
                f"{self.name} has no {MODEL} yet; `ground reconstruct` or `ground live` makes one"
            )
        assert self.folder is not None
        session = open_session(self.session_path)
        if (found := FoundAttitude.read(self.folder / attitude.FILE)) is not None:
            session = attitude.in_body_axes(session, found)
        estimate = read_estimate(self.folder)
        mesh = self.folder / MESH
        shown = Shown(
            self.name,
            as_estimated(session, estimate),
            sensor_of(session.camera),
            load_ply(self.folder / MODEL),
            mesh.read_bytes() if mesh.is_file() else None,
            session,
            estimate,
        )
        if len(shown.gaussians) == 0:
            raise SessionError(f"{self.folder / MODEL} holds no Gaussian")
        self._read = stamp
        return shown

    def _stamp(self) -> Stamp | None:
        """Return what changes when the model or its mesh is replaced whole; None where there is no model."""
        if self.folder is None:
            return None
        model, mesh = (_file_stamp(self.folder / name) for name in (MODEL, MESH))
        return None if model is None else (model, mesh)


def _file_stamp(path: Path) -> FileStamp | None:
    """Return what changes when a file is replaced whole; None where there is none."""
    try:
        status = os.stat(path)
    except OSError:
        return None
    return status.st_ino, status.st_mtime_ns, status.st_size
