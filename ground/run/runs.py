"""Run folders: their names, the lock and kept work of an unfinished run, and a finished run read again."""

import contextlib
import dataclasses
import fcntl
import functools
import hashlib
import json
import logging
import os
import platform
import shlex
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from torch import Tensor

from flightsw.icd.config import MAX_YAML_BYTES, ConfigError, parse_yaml
from ground.run import attitude
from ground.run.attitude import FoundAttitude, in_body_axes
from ground.run.live.status import LIVE_CHECKPOINT, LIVE_STATUS
from ground.session.cameras import sensor_of
from ground.session.folder import (
    FrameRecord,
    Session,
    SessionError,
    open_session,
    read_frame_lines,
    read_records,
    session_inside,
)
from ground.session.training_frames import split, told_before, training_frame
from obbgs_base.errors import reason
from obbgs_base.files import UNUSED, read_bounded
from obbgs_core.errors import ReconstructionError
from obbgs_core.frames import TrainingFrame
from obbgs_core.io.ply import load_ply
from obbgs_core.model.gaussians import Gaussians
from obbgs_core.render.backdrops import without_earth
from obbgs_core.sensor import Sensor
from obbgs_core.start.sky_level import levelled, without_plane

LOG = "log"
LOCK = "lock"  # in the folder of an unfinished run; holds the name of the process that works on it
# What metrics.json of every run holds, whatever its age; other keys may be missing.
NEEDED_METRICS: dict[str, type] = {
    "method": str,
    "gaussians": int,
    "sh_degree": int,
    "train_seconds": float,
    "stop_reason": str,
    "start": str,
    "frames_received": int,
    "frames_trained": int,
    "frames_held_out": int,
    "exposures_s": list,
}
NAMES_OF_FACTS = {  # of `session_facts`
    "mission_sha256": "mission",
    "frames_jsonl_sha256": "frames.jsonl",
    "pictures_sha256": "pictures",
    "created_utc": "time of creation",
    "background": "background",
    "encoding": "encoding",
}
KINDS = {str: "a text", int: "a whole number", float: "a number", list: "a list"}


@dataclass(frozen=True)
class Run:
    """A finished run with its session and models, as evaluation and report need it."""

    folder: Path
    session: Session
    training: list[FrameRecord]  # the frames that it was trained on
    scored: list[FrameRecord]  # the held-out frames; the training frames where none was held out
    sensor: Sensor
    gaussians: Gaussians
    blind: Gaussians | None  # of the training that ignored exposure times
    metrics: dict

    def without_sky_level(self, record: FrameRecord) -> TrainingFrame:
        """Return a frame as if empty sky read the stated black level, where the training found that it does not."""
        frame = training_frame(self.session, record, self._tagged.get(record.id))
        if (planes_dn := self._sky_planes_dn.get(record.id)) is None:
            return frame
        return without_plane(frame, planes_dn, self.sensor)

    def on_black_sky(self, record: FrameRecord, seen_from: Tensor | None = None) -> TrainingFrame:
        """Return a frame as if the sky was as black as stated, and the Earth not in view, as the model shows it.

        Args:
            seen_from: [4, 4] world_to_camera from which the model shows where the target is; None: the frame's own.
        """
        frame = self.without_sky_level(record)
        placed = frame if seen_from is None else dataclasses.replace(frame, world_to_camera=seen_from)
        black = without_earth(self.gaussians, placed, self.sensor)
        return dataclasses.replace(black, world_to_camera=frame.world_to_camera)

    @functools.cached_property
    def _tagged(self) -> dict[int, FrameRecord]:
        return {record.id: record for record in self.session.frames}

    @functools.cached_property
    def _sky_planes_dn(self) -> dict[int, Tensor]:
        """What empty sky reads above the stated black: planes [C, 3] as in `SkyLevel`, by frame; none where it fits."""
        planes_dn = {}
        if self.metrics.get("sky_level"):
            for records in (self.training, self.scored):
                frames = [training_frame(self.session, record) for record in records]
                level = levelled(frames, self.sensor)[2]
                planes_dn |= dict(zip(level.frame_ids, level.planes_dn, strict=True))
        return planes_dn


def without_own_sky(frame: TrainingFrame, sensor: Sensor) -> TrainingFrame:
    """Return a frame without what its own empty sky reads above the stated black level, as far as it shows that."""
    return without_plane(frame, levelled([frame], sensor)[2].planes_dn[0], sensor)


def run_folder(session_dir: Path, name: str, out: Path | None = None) -> Path:
    """Return where a run is or will be: in `out` if given, otherwise in runs/ of the session.

    Raises:
        ValueError: the name is not a plain folder name.
    """
    if not name or Path(name).name != name or name.startswith("."):
        raise ValueError(f"a run's name must be a plain folder name, got {name!r}")
    return (session_dir / "runs" if out is None else out) / name


def is_session(path: Path) -> bool:
    """Return whether a folder is a session."""
    return (path / "session.json").is_file()


def session_of(path: Path) -> Path:
    """Return the session that a path names, or in which the run lies, or will lie, that it names.

    Raises:
        SessionError: it names neither.
    """
    if is_session(path):
        return path
    run = path.resolve()
    session = run.parent.parent
    if is_session(session) and (run.parent.name == "runs" or (run / "model.ply").is_file()):
        return session
    if (run / "model.ply").is_file():
        raise SessionError(f"{path} does not lie in runs/ of a session, whose frames and camera are needed")
    raise SessionError(
        f"{path} is neither a session (session.json) nor a run in runs/ of one"
        + (
            session_inside(path)
            or "; a session begins with `ground listen`, `ground live` or `ground import`"
        )
    )


def newest_run(session: Path) -> Path | None:
    """Return the folder of a session's run whose model was renewed last; None where no run has a model."""
    models = {
        path: _renewed_ns(path) for path in session.glob("runs/*/model.ply") if path.parent.name[0] != "."
    }
    return max(models, key=lambda path: models[path]).parent if models else None


def _renewed_ns(path: Path) -> int:
    """Return when a file was renewed; 0 where it has been removed meanwhile."""
    try:
        return path.stat().st_mtime_ns
    except OSError:
        return 0


def run_at(path: Path) -> tuple[Path, str, Path]:
    """Return session, name and folder of runs of the run that a path names: its folder, or a session's newest run.

    Raises:
        SessionError: the path names neither, or the session has no run with a model.
    """
    session = session_of(path)
    folder = newest_run(path) if is_session(path) else path.resolve()
    if folder is None:
        raise SessionError(f"{path} has no run yet; `ground reconstruct --session {path}` makes one")
    return session, folder.name, folder.parent


def open_run(session_dir: Path, name: str, out: Path | None = None) -> Run:
    """Return a finished run; `out` is the folder of runs if it is not the session's own.

    Its session has the frames that it was made of, without those that came afterwards.

    Raises:
        SessionError: there is no such session or run, it is a run of another session or of one that has changed since,
            its metrics.json is damaged, or its model is missing.
    """
    session = open_session(session_dir)
    folder = run_folder(session.path, name, out)
    if not (folder / "metrics.json").is_file():
        raise SessionError(
            f"{folder} is not a finished run; make one with `ground reconstruct --session {session_dir} --name {name}`"
        )
    if not (folder / "model.ply").is_file():
        raise SessionError(f"{folder} has lost its model.ply: make the run again with `ground reconstruct`")
    metrics = read_metrics(folder / "metrics.json")
    if metrics.get("session_created_utc", session.created_utc) != session.created_utc:
        raise SessionError(
            f"{folder} is a run of the session of {metrics['session_created_utc']}, but {session.path} is that of "
            f"{session.created_utc}"
        )
    session = _as_it_was(session, folder, metrics["frames_received"])
    if (found := FoundAttitude.read(folder / attitude.FILE)) is not None:
        session = in_body_axes(session, found)
    training, held_out = split(session, on_warning=told_before)
    if not metrics[
        "frames_held_out"
    ]:  # of a few brackets that came one by one, none was kept from the training
        training, held_out = [*training, *held_out], []
    metrics["scored_frames"] = "held_out" if held_out else "training"
    metrics["frames_imported"] = session.frames_imported  # runs of earlier versions do not say it
    with_blind = (folder / "blind.ply").exists() and "blind_reference_exposure_s" in metrics
    return Run(
        folder,
        session,
        training,
        held_out or training,
        sensor_of(session.camera),
        load_ply(folder / "model.ply"),
        load_ply(folder / "blind.ply") if with_blind else None,
        metrics,
    )


def session_facts(session: Session) -> dict[str, str | float]:
    """Return what says of a session that it is the same one: for config.yaml, and to compare with it."""
    # frames that came later stand behind those that were read
    lines = read_frame_lines(session.path).raw[: len(session.frames)]
    pictures = hashlib.sha256()
    for record in session.frames:
        pictures.update((session.path / record.file).read_bytes())
    return {
        "mission_sha256": session.mission_sha256,
        "frames_jsonl_sha256": hashlib.sha256(b"".join(line + b"\n" for line in lines)).hexdigest(),
        "pictures_sha256": pictures.hexdigest(),
        "created_utc": session.created_utc,
        "background": session.background,
        "encoding": session.encoding,
    }


def _as_it_was(session: Session, folder: Path, count: int) -> Session:
    """Return a session with its first `count` frames, of which a run was made.

    Raises:
        SessionError: they, or what else the run's config.yaml says of its session, are others now.
    """
    first = {record.id for record in read_records(session.path)[:count]}
    then = dataclasses.replace(session, frames=tuple(r for r in session.frames if r.id in first))
    if not (folder / "config.yaml").is_file():
        return then
    noted, now = read_config(folder).get("session"), session_facts(then)
    if not isinstance(noted, dict):
        return then
    differing = [NAMES_OF_FACTS[key] for key, value in now.items() if noted.get(key, value) != value]
    if differing:
        given = shlex.join(["--session", str(session.path), "--name", folder.name])
        raise SessionError(
            f"{session.path} has changed since {folder.name} was made of it ({', '.join(differing)}), so the run is "
            f"neither scored nor shown with it; `ground reconstruct {given} --overwrite` makes it again"
        )
    return then


def read_config(folder: Path) -> dict:
    """Return the settings in the config.yaml of a run's folder.

    Raises:
        SessionError: it is missing, no YAML, or not the settings of a run; the message names the file.
    """
    path = folder / "config.yaml"
    if not path.is_file():
        example = "give the folder of one, such as SESSION/runs/run"
        raise SessionError(f"{folder} is not a finished run: it has no {path.name}; {example}")
    try:
        settings = parse_yaml(read_bounded(path, MAX_YAML_BYTES), "config")
    except (OSError, ConfigError) as error:
        raise SessionError(f"{path} cannot be read: {reason(error)}; make the run again") from error
    if not (isinstance(settings, dict) and isinstance(settings.get("method"), dict)):
        raise SessionError(
            f"{path} should hold the settings of a run, with those of a method; make the run again"
        )
    return settings


def read_metrics(path: Path) -> dict:
    """Return a run's metrics.json.

    Raises:
        SessionError: it is missing, not JSON, or lacks a key that every run has; the message names the file.
    """
    try:
        metrics = json.loads(path.read_bytes())
    except (OSError, ValueError) as error:  # a UnicodeDecodeError is a ValueError too
        raise SessionError(f"{path} cannot be read: {reason(error)}; make the run again") from error
    if not isinstance(metrics, dict):
        raise SessionError(f"{path} should hold an object; make the run again")
    for key, kind in NEEDED_METRICS.items():
        value = metrics.get(key)
        if type(value) is not kind and not (kind is float and type(value) is int):
            raise SessionError(
                f"{path} is damaged: expected {key} as {KINDS[kind]}, got {value!r}; make the run again"
            )
    return metrics


@contextlib.contextmanager
def written_to(folder: Path) -> Iterator[None]:
    """Turn any OSError of the block into one line that names the folder of runs and a way out.

    Raises:
        SessionError: in place of the OSError.
    """
    try:
        yield
    except OSError as error:
        raise SessionError(
            f"cannot write to {folder}: {reason(error)}; make it writable, or copy the session to where you can write"
        ) from error


def check_replaceable(folder: Path, overwrite: bool) -> None:
    """Check that a new run may have this folder.

    Raises:
        SessionError: there is a finished run and `overwrite` is False, or something that is not a finished run.
    """
    if not folder.exists() or is_live(folder):
        return
    if not (folder / "metrics.json").is_file():
        raise SessionError(
            f"{folder} exists and is not a finished run, so it is not replaced; give another --name"
        )
    if not overwrite:
        raise SessionError(f"{folder} is a finished run: --overwrite replaces it, --name makes another")


def is_live(folder: Path) -> bool:
    """Return whether a folder holds only what `ground live` shows of a run that is not finished."""
    return (folder / LIVE_STATUS).is_file() and not (folder / "metrics.json").is_file()


def check_not_live(folder: Path) -> None:
    """Check that a folder is not that of a live run, whose checkpoints another run of its name would remove.

    Raises:
        SessionError: it is one that is not finished.
    """
    kept = unfinished_folder(folder).glob("*")
    if is_live(folder) or any(LIVE_CHECKPOINT.fullmatch(path.name) for path in kept):
        raise SessionError(
            f"{folder} is a run of `ground live` that is not finished: `ground live --name {folder.name}` goes on with "
            "it, --name makes another run, --overwrite replaces it"
        )


@contextlib.contextmanager
def unfinished_run(folder: Path, overwrite: bool, kept: Sequence[str]) -> Iterator[Path]:
    """Give the hidden folder in which a run is made, locked against other processes and with its log open.

    It holds the `kept` files (checkpoints, also those that were set aside) and the log of an interrupted run of the
    same name, nothing else of it. It stays when the block is interrupted, so that the next run resumes from it, and is
    removed when the frames allow no model.

    Raises:
        SessionError: another process makes this run, there is a finished one, or the folder cannot be written.
    """
    part = unfinished_folder(folder)
    with written_to(folder.parent):
        lock = _locked(part)
    try:
        check_replaceable(folder, overwrite)  # it may have appeared before the lock was ours
        with written_to(folder.parent):
            _clear(part, [LOCK, LOG, *kept])
            handler = logging.FileHandler(part / LOG)
        with _logged_to(handler):
            yield part
    except ReconstructionError:
        with contextlib.suppress(OSError):
            _clear(part, [LOCK])
        raise
    finally:
        _unlock(lock, part)


def unfinished_folder(folder: Path) -> Path:
    """Return the hidden folder in which a run is made."""
    return folder.with_name(f".{folder.name}.part")


def publish(part: Path, folder: Path) -> None:
    """Rename an unfinished run to its final folder, in place of a run that may be there, and drop all checkpoints."""
    replaced = folder.with_name(f".{folder.name}.replaced")
    shutil.rmtree(replaced, ignore_errors=True)
    if folder.exists():
        folder.rename(replaced)
    part.rename(folder)
    shutil.rmtree(replaced, ignore_errors=True)
    for path in (folder / LOCK, *folder.glob("*.checkpoint*")):
        path.unlink(missing_ok=True)


def _locked(part: Path) -> int:
    """Make the folder if need be and return the descriptor of its lock file, locked by this process."""
    while True:
        part.mkdir(parents=True, exist_ok=True)
        try:
            lock = os.open(part / LOCK, os.O_RDWR | os.O_CREAT, 0o666)
        except FileNotFoundError:  # another process has just removed or published the folder
            continue
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            holder = os.read(lock, 300).decode(errors="replace").strip() or "another process"
            os.close(lock)
            raise SessionError(
                f"{holder} is making this run in {part}: wait for its end, or give another --name"
            ) from error
        if _is_at(lock, part / LOCK):
            os.truncate(lock, 0)
            os.write(lock, f"process {os.getpid()} on {platform.node()}\n".encode())
            return lock
        os.close(lock)


def _unlock(lock: int, part: Path) -> None:
    """Release the lock, and remove its file, and the folder if nothing else is in it."""
    with contextlib.suppress(OSError):
        if _is_at(lock, part / LOCK):  # not after publication, when the name may be another process's
            (part / LOCK).unlink()
            part.rmdir()
    os.close(lock)


def _is_at(descriptor: int, path: Path) -> bool:
    """Tell whether an open file is the one at a path, and has not been renamed or removed."""
    try:
        return os.path.samestat(os.fstat(descriptor), path.stat())
    except FileNotFoundError:
        return False


def _clear(part: Path, kept: Sequence[str]) -> None:
    """Remove everything from a folder but the kept names, and files of these names that were set aside."""
    for path in part.iterdir():
        if path.name.partition(UNUSED)[0] not in kept:
            shutil.rmtree(path) if path.is_dir() else path.unlink()


@contextlib.contextmanager
def _logged_to(handler: logging.Handler) -> Iterator[None]:
    """Write all messages of our packages from INFO upwards to a run's log, whatever levels the program has set."""
    handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(name)s: %(message)s"))
    root = logging.getLogger()
    root.addHandler(handler)
    levels = {logging.getLogger(name): logging.getLogger(name).level for name in ("ground", "obbgs_core")}
    for ours in levels:
        ours.setLevel(min(logging.INFO, ours.getEffectiveLevel()))
    try:
        yield
    finally:
        for ours, level in levels.items():
            ours.setLevel(level)
        root.removeHandler(handler)
        handler.close()
