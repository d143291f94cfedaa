"""A session on disk: the frames of one pass, their poses, and the count of everything lost.

Written frame by frame, each step whole or not at all, so that a session cut off anywhere opens again.
"""

import dataclasses
import hashlib
import json
import math
import os
import re
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import imagecodecs
import numpy as np

from flightsw.icd.config import ConfigError, build, keys_below, parse_json
from flightsw.icd.frame import Frame
from flightsw.icd.mission import CameraSection, Mission
from ground.telemetry import FlightCounts
from obbgs_base.errors import ObbgsError
from obbgs_base.files import write_whole

SCHEMA_VERSION = 1
FRAME_FILE = re.compile(
    r"frames/\d{6,10}\.png", re.ASCII
)  # nothing else is opened: a session may come from afar


class SessionError(ObbgsError):
    """A session cannot be used; the message says why."""


class MissingFrames(SessionError):
    """Frames are not there; `ids` lists those named in the session without a file, if any."""

    def __init__(self, message: str, ids: tuple[int, ...] = ()):
        super().__init__(message)
        self.ids = ids


class SessionCorrupt(SessionError):
    """A file of the session is damaged or not what it should be."""


@dataclass(frozen=True, eq=False)
class FrameRecord:
    """One line of frames.jsonl."""

    id: int
    bracket: int
    bracket_index: int
    exposure_time_s: float
    mid_exposure_utc_ns: int
    world_to_camera: np.ndarray  # [4, 4], metres, OpenCV axes
    quat_body_to_camera: np.ndarray  # [4] w, x, y, z
    position_body_m: np.ndarray  # [3]
    covariance: np.ndarray  # [6, 6] position (m, body) then rotation vector (rad, camera)
    sun_dir_body: np.ndarray  # [3]
    in_eclipse: bool
    pose_valid: bool
    saturated: int  # pixels at full scale
    file: str
    sha256: str  # of the container as received
    bit_depth: int
    black_dn: float


ARRAY_SHAPES = {
    "world_to_camera": (4, 4),
    "quat_body_to_camera": (4,),
    "position_body_m": (3,),
    "covariance": (6, 6),
    "sun_dir_body": (3,),
}


@dataclass(frozen=True)
class Session:
    """A session as read; frames in the order of their numbers."""

    path: Path
    camera: CameraSection
    frames: tuple[FrameRecord, ...]
    losses: Mapping[str, int]
    mission_sha256: str
    tles: Mapping[str, tuple[str, ...]]
    bytes_received: int
    created_utc: str
    flight: FlightCounts | None  # what flight's telemetry told of its frames; None: none was heard
    frames_imported: int | None  # pictures that were imported; None: the frames came over a link

    @property
    def frames_captured(self) -> int | None:
        """How many frames were taken, as flight's telemetry told when it was last heard; None where it told nothing.

        Of an import these are the pictures that were imported.
        """
        if self.flight is None:
            return self.frames_imported
        return self.flight.captured(self.frames[-1].id)

    def dn(self, record: FrameRecord) -> np.ndarray:
        """Return a frame's digital numbers, uint16 [H, W] or [H, W, 3].

        Raises:
            MissingFrames: its file is not there.
            SessionCorrupt: its file is not a 16-bit picture of the camera's size.
        """
        path = self.path / record.file
        try:
            dn = imagecodecs.png_decode(path.read_bytes())
        except FileNotFoundError as error:
            raise MissingFrames(f"frame {record.id}: {path} is not there", (record.id,)) from error
        except (OSError, ValueError, RuntimeError) as error:
            raise SessionCorrupt(f"frame {record.id}: {path} cannot be read: {error}") from error
        expected = (self.camera.height, self.camera.width) + ((3,) if self.camera.channels == 3 else ())
        if dn.shape != expected or dn.dtype != np.uint16:
            raise SessionCorrupt(
                f"frame {record.id}: expected uint16 {expected}, {path} has {dn.dtype} {dn.shape}"
            )
        return dn


def open_session(folder: str | Path) -> Session:
    """Return the session in a folder. A last line that was cut off in writing is left out.

    Raises:
        SessionError: no session there, or one of another schema version.
        MissingFrames: it holds no frames, or some files are missing.
        SessionCorrupt: a line or a value is damaged; the message names it.
    """
    folder = Path(folder)
    header = _read_header(folder)
    try:
        with keys_below("session.camera", "mission.camera"):
            camera = build(CameraSection, header["camera"], "session.camera")
        tles = {str(name): tuple(map(str, lines)) for name, lines in header["tles"].items()}
        losses = {str(name): int(count) for name, count in header["losses"].items()}
        facts = (
            str(header["mission_sha256"]),
            tles,
            int(header["bytes_received"]),
            str(header["created_utc"]),
            _flight_counts(header),
            int(header["frames_received"]) if "imported_from" in header else None,
        )
    except (ConfigError, KeyError, TypeError, ValueError, AttributeError) as error:
        raise SessionCorrupt(f"{folder / 'session.json'}: {error}") from error
    frames = tuple(sorted(_read_records(folder), key=lambda record: record.id))
    if not frames:
        raise MissingFrames(f"{folder} holds no frames")
    missing = tuple(record.id for record in frames if not (folder / record.file).is_file())
    if missing:
        named = ", ".join(map(str, missing[:5])) + (", ..." if len(missing) > 5 else "")
        raise MissingFrames(
            f"{folder}: {len(missing)} of {len(frames)} pictures are missing: {named}", missing
        )
    return Session(folder, camera, frames, losses, *facts)


class SessionWriter:
    """Adds frames to a session; made anew, or opened again after a cut and continued.

    Raises:
        SessionError: the folder holds a session of another mission or schema, or cannot be written.
        SessionCorrupt: its files are damaged other than by a cut.
    """

    def __init__(self, folder: str | Path, mission: Mission):
        self.folder = Path(folder)
        self._mission = mission
        self._frames_file = self.folder / "frames.jsonl"
        self._losses_before: dict[str, int] = {}
        self._bytes_before = 0
        self.flight: FlightCounts | None = None  # as session.json has it
        self._created_utc = datetime.now(UTC).isoformat(timespec="seconds")
        try:
            (self.folder / "frames").mkdir(parents=True, exist_ok=True)
            if (self.folder / "session.json").exists():
                self._continue()
            self._sha256_of = {record.id: record.sha256 for record in _read_records(self.folder)}
            self._cut_unfinished_line()
            self.save({}, 0)
        except OSError as error:
            raise SessionError(f"cannot write the session {self.folder}: {error}") from error

    @property
    def frame_count(self) -> int:
        return len(self._sha256_of)

    @property
    def last_frame_id(self) -> int:
        """The highest number of a frame; -1 for none."""
        return max(self._sha256_of, default=-1)

    def add(self, frame: Frame, container: bytes) -> bool:
        """Write a frame's picture and line; False if the session holds exactly this frame already.

        Raises:
            SessionError: another frame of this number is there, or the picture is not the camera's size.
            OSError: the disk refuses; the frame is not in the session.
        """
        sha256 = hashlib.sha256(container).hexdigest()
        known = self._sha256_of.get(frame.frame_id)
        if known is not None:
            if known != sha256:
                raise SessionError(f"another frame {frame.frame_id} is in the session already")
            return False
        camera = self._mission.camera
        shape = (camera.height, camera.width) + ((3,) if camera.channels == 3 else ())
        if frame.dn.shape != shape:
            raise SessionError(
                f"frame {frame.frame_id} has shape {frame.dn.shape}, the mission's camera {shape}"
            )
        name = f"frames/{frame.frame_id:06d}.png"
        write_whole(self.folder / name, bytes(imagecodecs.png_encode(frame.dn, level=1)))
        line = json.dumps(frame_line(frame, name, sha256), allow_nan=False).encode() + b"\n"
        before_bytes = self._frames_file.stat().st_size if self._frames_file.exists() else 0
        try:
            with open(self._frames_file, "ab") as file:
                file.write(line)
                file.flush()
                os.fsync(file.fileno())
        except OSError:
            if self._frames_file.exists():  # a full disk: half a line would damage the session for good
                os.truncate(self._frames_file, before_bytes)
            raise
        self._sha256_of[frame.frame_id] = sha256
        return True

    def save(
        self, losses: Mapping[str, int], bytes_received: int, flight: FlightCounts | None = None
    ) -> None:
        """Write session.json.

        `losses` and `bytes_received` are of this run and added to those before; `flight` replaces what was told before,
        None leaves it.
        """
        self.flight = flight or self.flight
        total = dict(self._losses_before)
        for name, count in losses.items():
            total[name] = total.get(name, 0) + count
        header = {
            "schema_version": SCHEMA_VERSION,
            "mission_sha256": self._mission.sha256,
            "camera": dataclasses.asdict(self._mission.camera),
            "tles": {
                "target": list(self._mission.orbit.target_tle),
                "chaser": list(self._mission.orbit.chaser_tle),
            },
            "losses": total,
            "flight": dataclasses.asdict(self.flight) if self.flight else None,
            "frames_received": self.frame_count,
            "bytes_received": self._bytes_before + bytes_received,
            "created_utc": self._created_utc,
        }
        write_whole(self.folder / "session.json", json.dumps(header, indent=2).encode() + b"\n")

    def _continue(self) -> None:
        header = _read_header(self.folder)
        if header.get("mission_sha256") != self._mission.sha256:
            raise SessionError(
                f"{self.folder} belongs to another mission file; choose another session folder"
            )
        try:
            self._losses_before = {str(name): int(count) for name, count in header["losses"].items()}
            self._bytes_before = int(header["bytes_received"])
            self._created_utc = str(header["created_utc"])
            self.flight = _flight_counts(header)
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise SessionCorrupt(f"{self.folder / 'session.json'}: {error}") from error

    def _cut_unfinished_line(self) -> None:
        if self._frames_file.exists():
            content = self._frames_file.read_bytes()
            whole_bytes = content.rfind(b"\n") + 1
            if whole_bytes < len(content):
                os.truncate(self._frames_file, whole_bytes)


def frame_line(frame: Frame, file: str, sha256: str) -> dict[str, Any]:
    """Return a frame's line of frames.jsonl."""
    pose = frame.pose
    return {
        "id": frame.frame_id,
        "bracket": frame.bracket_id,
        "bracket_index": frame.bracket_index,
        "exposure_time_s": frame.exposure_time_s,
        "mid_exposure_utc_ns": frame.mid_exposure_utc_ns,
        "world_to_camera": pose.world_to_camera.tolist(),
        "quat_body_to_camera": pose.quat_body_to_camera.tolist(),
        "position_body_m": pose.position_body_m.tolist(),
        "covariance": pose.covariance.tolist(),
        "sun_dir_body": pose.sun_dir_body.tolist(),
        "in_eclipse": pose.in_eclipse,
        "pose_valid": pose.valid,
        "saturated": frame.saturated_count,
        "file": file,
        "sha256": sha256,
        "bit_depth": frame.bit_depth,
        "black_dn": frame.black_dn,
    }


def _read_header(folder: Path) -> dict[str, Any]:
    path = folder / "session.json"
    try:
        header = parse_json(path.read_bytes(), "session")
    except (FileNotFoundError, NotADirectoryError) as error:
        raise SessionError(f"{folder} is not a session: it has no session.json") from error
    except OSError as error:
        raise SessionError(f"{path} cannot be read: {error}") from error
    except ConfigError as error:
        raise SessionCorrupt(f"{path}: {error}") from error
    if not isinstance(header, dict):
        raise SessionCorrupt(f"{path} should hold an object")
    if header.get("schema_version") != SCHEMA_VERSION:
        raise SessionError(
            f"{folder} was written with schema version {header.get('schema_version')}; "
            f"this software reads {SCHEMA_VERSION}"
        )
    return header


def _flight_counts(header: dict[str, Any]) -> FlightCounts | None:
    """Return what flight told, from session.json; None for sessions that were written before it was kept."""
    told = header.get("flight")
    return None if told is None else FlightCounts(**told)


def _read_records(folder: Path) -> list[FrameRecord]:
    path = folder / "frames.jsonl"
    if not path.exists():
        return []
    *lines, _unfinished = path.read_bytes().split(b"\n")
    records: dict[int, FrameRecord] = {}
    for number, line in enumerate(lines, start=1):
        try:
            record = _record(json.loads(line))
            if record.id in records:
                raise ValueError(f"frame {record.id} is there twice")
        except (ValueError, TypeError, KeyError) as error:
            raise SessionCorrupt(f"{path} line {number}: {error}") from error
        records[record.id] = record
    return list(records.values())


def _record(tree: Any) -> FrameRecord:
    if not isinstance(tree, dict):
        raise ValueError("expected an object")
    values: dict[str, Any] = {}
    for field in dataclasses.fields(FrameRecord):
        if field.name not in tree:
            raise ValueError(f"{field.name} is missing")
        value = tree[field.name]
        if field.name in ARRAY_SHAPES:
            value = np.array(value, dtype=np.float64)
            if value.shape != ARRAY_SHAPES[field.name] or not np.isfinite(value).all():
                raise ValueError(f"{field.name} must be {ARRAY_SHAPES[field.name]} finite numbers")
        elif field.type is float and type(value) is int:
            value = float(value)
        elif type(value) is not field.type or (field.type is float and not math.isfinite(value)):
            raise ValueError(f"{field.name} is {value!r}")
        values[field.name] = value
    if not FRAME_FILE.fullmatch(values["file"]):
        raise ValueError(f"file is {values['file']!r}, expected frames/000123.png")
    return FrameRecord(**values)
