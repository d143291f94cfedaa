"""Which run a viewer shows: found by its folder or by its session's, and read again whenever model.ply is renewed."""

import os
from dataclasses import dataclass
from pathlib import Path

from ground.cameras import sensor_of
from ground.session import Session, SessionError, open_session
from obbgs_core.io.ply import load_ply
from obbgs_core.model.gaussians import Gaussians
from obbgs_core.sensor import Sensor

MODEL, MESH = "model.ply", "model.glb"


@dataclass(frozen=True)
class Shown:
    """A model with its session, as it was when it was read; mesh: the bytes of model.glb where there is one."""

    name: str
    session: Session
    sensor: Sensor
    gaussians: Gaussians
    mesh: bytes | None


class Source:
    """A run's folder that is watched: its model.ply may be renewed, whole, by a reconstruction under way.

    Args:
        path: of a run (a folder in runs/ of a session), or of a session, whose newest run is shown.

    Raises:
        SessionError: neither of them, or a session without a run.
    """

    def __init__(self, path: Path):
        self.folder = run_of(path)
        self.session_path = session_of(self.folder)
        self._read: tuple[int, int, int] | None = None

    @property
    def name(self) -> str:
        return f"{self.session_path.resolve().name}/{self.folder.name}"

    def renewed(self) -> bool:
        """Return whether model.ply is another than was read last."""
        return self._stamp() not in (None, self._read)

    def load(self) -> Shown:
        """Return the model and the frames as they are now.

        Raises:
            SessionError, ReconstructionError: a file is missing or damaged.
        """
        stamp = self._stamp()
        if stamp is None:
            raise SessionError(
                f"{self.folder} has no {MODEL} yet; `ground reconstruct` or `ground live` makes one"
            )
        session = open_session(self.session_path)
        mesh = self.folder / MESH
        shown = Shown(
            self.name,
            session,
            sensor_of(session.camera),
            load_ply(self.folder / MODEL),
            mesh.read_bytes() if mesh.is_file() else None,
        )
        if len(shown.gaussians) == 0:
            raise SessionError(f"{self.folder / MODEL} holds no Gaussian")
        self._read = stamp
        return shown

    def _stamp(self) -> tuple[int, int, int] | None:
        """Return what changes when a file is replaced whole; None where there is none."""
        try:
            status = os.stat(self.folder / MODEL)
        except OSError:
            return None
        return status.st_ino, status.st_mtime_ns, status.st_size


def run_of(path: Path) -> Path:
    """Return a run's folder, for itself or for its session.

    Raises:
        SessionError: neither a run with a model nor a session that has one.
    """
    if (path / MODEL).is_file():
        return path
    if (path / "session.json").is_file():
        runs = [
            model.parent for model in path.glob(f"runs/*/{MODEL}") if not model.parent.name.startswith(".")
        ]
        if runs:
            return max(runs, key=lambda run: (run / MODEL).stat().st_mtime_ns)
        raise SessionError(
            f"{path} has no run with a {MODEL} yet: make one with `ground reconstruct --session {path}`"
        )
    raise SessionError(
        f"{path} is neither a session (session.json) nor a run ({MODEL}, in runs/ of a session)"
    )


def session_of(run: Path) -> Path:
    """Return the session that holds a run.

    Raises:
        SessionError: the run does not lie in runs/ of a session.
    """
    session = run.resolve().parent.parent
    if (session / "session.json").is_file():
        return session
    raise SessionError(f"{run} does not lie in runs/ of a session, whose frames and camera the viewer needs")
