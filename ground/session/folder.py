"""A session: a folder with the frames of one pass, their pose tags, and a count of everything that was lost.

    session.json        schema version, digest of the mission file, camera calibration, TLEs, losses, bytes received,
                        what the spacecraft's telemetry said of its frames, time of creation; of imported pictures
                        also the background's radiance and whether values are linear in light or sRGB-coded; how the
                        pose tags can err (`Navigation`)
    frames.jsonl        one line per frame, a `FrameRecord`, in the order of arrival
    frames/000123.png   the frame's digital numbers, 16-bit linear, mono or RGB
    truth/              only from a simulator: true poses, radiance and surface; never read in training
    runs/NAME/          the models made of the session
    thumbnails/, telemetry.jsonl, events.jsonl, reports.jsonl    what else came down
    commands.jsonl, uplink/    what went up

`SessionWriter` in session_writer.py adds frames; each step is whole or not done, so that a session opens again after
a power cut at any moment. `open_session` reads one.

What came over a link carries checksums: session.json and each line of the .jsonl files a CRC-32, pictures those of PNG.
session.json and frames.jsonl stand twice, the second time with `.copy` behind their names, and what is damaged in one
is taken from the other. A line that is damaged in both costs that frame alone, and is counted. Files without checksums
are taken as they are: those of earlier versions, of imported pictures, and whatever is written by hand. Who edits
session.json or a line of frames.jsonl by hand removes its entry `crc32`.
"""

import dataclasses
import functools
import itertools
import logging
import math
import re
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import imagecodecs
import numpy as np

from flightsw.icd.config import MAX_JSON_BYTES, ConfigError, build, keys_below, parse_json, require
from flightsw.icd.frame import Attitude
from flightsw.icd.mission import CameraSection
from flightsw.icd.quaternion import quat_to_matrix
from ground.session.telemetry import FlightCounts
from obbgs_base.checked import Lines, copy_of, names_checksum, read_lines, read_lines_twice, read_twice
from obbgs_base.errors import ObbgsError, counted, reason
from obbgs_base.files import read_bounded
from obbgs_base.physics.navigation_errors import SharedParameters

log = logging.getLogger(__name__)

SCHEMA_VERSION = 1
SPLITS = ("train", "val", "test")
ENCODINGS = ("linear", "srgb")
# No other file name is opened: a session may come from someone else.
FRAME_FILE = re.compile(r"frames/\d{6,10}\.png", re.ASCII)
PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
LOGS = ("telemetry.jsonl", "events.jsonl", "reports.jsonl", "commands.jsonl")
LINES_DAMAGED = "lines_damaged"  # the name of their count among the losses


class SessionError(ObbgsError):
    """A session cannot be used; the message says why."""


class MissingFrames(SessionError):
    """Frames are missing; `ids` lists those that frames.jsonl names but that have no file, if any."""

    def __init__(self, message: str, ids: tuple[int, ...] = ()):
        super().__init__(message)
        self.ids = ids


class SessionCorrupt(SessionError):
    """A file of the session is damaged or has another form than it should."""


@dataclass(frozen=True, eq=False)
class FrameRecord:
    """One line of frames.jsonl: a frame with its pose tag, without its picture."""

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
    # train, val or test, where an imported data set states it: for all frames or for none
    split: str | None = None
    K: np.ndarray | None = None  # [3, 3] px, where it is not the session's camera's
    quat_inertial_to_body: np.ndarray | None = None  # [4] attitude of the target that the pose assumes, GCRS
    # [3] of the target from the Earth's centre, GCRS, m; None: its two-line elements say it, if there are any
    target_position_m: np.ndarray | None = None

    def __repr__(self) -> str:
        pose = "" if self.pose_valid else ", no valid pose"
        return (
            f"<frame {self.id}: exposure {self.bracket_index} of bracket {self.bracket}, "
            f"{1e3 * self.exposure_time_s:g} ms{pose}>"
        )


FREE_WITHIN_RAD = 2e-3  # root mean square that attitudes may be from those of a rotation without torque
ERRS_ALIKE_S = 5.0  # from one exposure to the next; further apart where tags state a longer correlation
ARRAY_SHAPES = {
    "world_to_camera": (4, 4),
    "quat_body_to_camera": (4,),
    "position_body_m": (3,),
    "covariance": (6, 6),
    "sun_dir_body": (3,),
    "K": (3, 3),
    "quat_inertial_to_body": (4,),
    "target_position_m": (3,),
}


@dataclass(frozen=True)
class Navigation:
    """What flight says of its pose tags beside their covariances, which are of what differs from bracket to bracket.

    attitude: of the target: known, rate_only (the body axes at the start were chosen freely) or unknown (`body` stands
        for inertial axes centred on the target); the least that any tag says.
    correlation_time_s: of the errors in the covariances; 0: independent from bracket to bracket.
    epoch_utc_ns: the time at which the shared parameters are those of the start.
    mean_motion_rad_s: of the target's orbit; 0: not known.
    quat_inertial_to_rtn: [4] to radial, transverse and normal axes at the epoch.
    rate_rad_s, inertia: [3] the target's angular velocity at the epoch and its moments of inertia (ratios matter), body
        axes; a rate of 0: not stated, then the frames' attitudes say how it turns (`Session.rotation`).
    sigmas: standard deviations of the parameters that all frames share.
    """

    attitude: Attitude = "known"
    correlation_time_s: float = 0.0
    epoch_utc_ns: int = 0
    mean_motion_rad_s: float = 0.0
    quat_inertial_to_rtn: tuple[float, ...] = (1.0, 0.0, 0.0, 0.0)
    rate_rad_s: tuple[float, ...] = (0.0, 0.0, 0.0)
    inertia: tuple[float, ...] = (1.0, 1.0, 1.0)
    sigmas: SharedParameters = field(default_factory=SharedParameters)

    def __post_init__(self):
        for name in ("correlation_time_s", "mean_motion_rad_s"):
            value = getattr(self, name)
            require(value >= 0, f"session.navigation.{name}", f"must not be negative, got {value}")
        quat = self.quat_inertial_to_rtn
        unit = len(quat) == 4 and abs(math.hypot(*quat) - 1) < 1e-6
        require(unit, "session.navigation.quat_inertial_to_rtn", f"expected a unit quaternion, got {quat}")
        rate, inertia = self.rate_rad_s, self.inertia
        require(len(rate) == 3, "session.navigation.rate_rad_s", f"expected 3 numbers, got {rate}")
        positive = len(inertia) == 3 and min(inertia) > 0
        require(positive, "session.navigation.inertia", f"expected 3 positive moments, got {inertia}")


@dataclass(frozen=True)
class Session:
    """A session as read, frames in the order of their numbers."""

    path: Path
    camera: CameraSection
    frames: tuple[FrameRecord, ...]
    losses: Mapping[str, int]
    mission_sha256: str
    tles: Mapping[str, tuple[str, ...]]
    bytes_received: int
    created_utc: str
    flight: FlightCounts | None  # what the spacecraft's telemetry said of its frames; None: none was received
    frames_imported: int | None  # pictures that were imported; None: the frames came over a link
    background: float  # radiance of what is seen where the target is not
    encoding: str  # of the digital numbers: linear in light, or srgb (display values)
    navigation: Navigation
    registration: Mapping[str, Any] | None  # of photographs: what structure from motion made of them
    attitude_estimated: bool = False  # poses are in axes of the target that were found

    def __repr__(self) -> str:
        size = f"{self.camera.width}x{self.camera.height} pixels"
        brackets = len({record.bracket for record in self.frames})
        grouped = f" in {counted(brackets, 'bracket')}" if self.is_bracketed else ""
        return f"<{self.path}: {counted(len(self.frames), 'frame')} of {size}{grouped}>"

    def check_body_axes(self) -> None:
        """Check that poses are in axes of the target.

        Raises:
            SessionError: they are in inertial axes, since the target's attitude is unknown.
        """
        if self.navigation.attitude == "unknown":
            raise SessionError(
                f"{self.path}: the target's attitude is unknown, so its poses are in inertial axes, in which a target "
                "that turns has no shape; `ground reconstruct` finds the attitude and makes a model"
            )

    @property
    def frames_captured(self) -> int | None:
        """How many frames the spacecraft's last telemetry said were taken; None without telemetry.

        For an imported session, the number of imported pictures.
        """
        if self.flight is None:
            return self.frames_imported
        return self.flight.captured(self.frames[-1].id)

    @property
    def is_bracketed(self) -> bool:
        """Whether frames were taken in exposure brackets: always but for imported pictures that each stand alone."""
        return self.frames_imported is None or len({r.bracket for r in self.frames}) < len(self.frames)

    @property
    def nominal_exposures(self) -> bool:
        """Whether the exposure times are made up: pictures were imported that state none."""
        return self.frames_imported is not None and {r.exposure_time_s for r in self.frames} == {1.0}

    @property
    def frames_err_alone(self) -> bool:
        """Whether the frames of a bracket are so far apart that the errors of their tags are not one and the same."""
        return self.frame_spacing_s > max(ERRS_ALIKE_S, self.navigation.correlation_time_s)

    @functools.cached_property
    def frame_spacing_s(self) -> float:
        """The time from one exposure of a bracket to the next, s, the median of the session; 0 without such two."""
        apart_s = [
            (after.mid_exposure_utc_ns - before.mid_exposure_utc_ns)
            / (after.bracket_index - before.bracket_index)
            for before, after in itertools.pairwise(self.frames)
            if before.bracket == after.bracket and before.bracket_index < after.bracket_index
        ]
        return float(np.median(apart_s)) / 1e9 if apart_s else 0.0

    @functools.cached_property
    def rotation(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The target's rate at the epoch [3], rad/s, its moments of inertia [3] (ratios matter), and steps of the rate.

        All are in body axes, the steps [K, 4] those of `NominalMotion`. Where navigation states no rate, they are those
        of the free rotation that fits the frames' attitudes, in pieces where torques act: an error of the rate then
        grows as it does in a body that turns like this one. A rate of 0: none fits.
        """
        navigation = self.navigation
        stated = np.array(navigation.rate_rad_s), np.array(navigation.inertia), np.zeros((0, 4))
        known = {r.mid_exposure_utc_ns: r.quat_inertial_to_body for r in self.frames if r.pose_valid}
        attitudes = [quat for quat in known.values() if quat is not None]
        if stated[0].any() or self.navigation.attitude != "known" or len(attitudes) < len(known):
            return stated
        # it needs SciPy, which opening a session does not
        from obbgs_base.physics.rotation_fit import fitted_rotation

        times_s = (np.array(list(known)) - self.navigation.epoch_utc_ns) / 1e9
        to_body = np.array([quat_to_matrix(quat) for quat in attitudes])
        return fitted_rotation(times_s, to_body, FREE_WITHIN_RAD) or stated

    def K(self, record: FrameRecord) -> np.ndarray:
        """Return the pinhole matrix [3, 3] of a frame, float32, px."""
        return np.array(self.camera.K if record.K is None else record.K, dtype=np.float32)

    def is_whole(self, record: FrameRecord) -> bool:
        """Return whether every checksum in a frame's picture fits.

        Raises:
            MissingFrames, SessionCorrupt: its file is not there, or cannot be read.
        """
        return is_whole_png(self._content(record))

    def dn(self, record: FrameRecord) -> np.ndarray:
        """Return a frame's digital numbers, uint16 [H, W] or [H, W, 3].

        Raises:
            MissingFrames: its file is not there.
            SessionCorrupt: its file is not a 16-bit picture of the camera's size.
        """
        path, content = self.path / record.file, self._content(record)
        try:
            if not is_whole_png(content):
                raise ValueError(
                    "it is damaged; while the frame is still on board, "
                    f"`ground uplink resend {record.id} {record.id}` brings it again"
                )
            dn = imagecodecs.png_decode(content)
        except (ValueError, RuntimeError) as error:
            raise SessionCorrupt(f"frame {record.id}: {path} cannot be read: {error}") from error
        expected = (self.camera.height, self.camera.width) + ((3,) if self.camera.channels == 3 else ())
        if dn.shape != expected or dn.dtype != np.uint16:
            raise SessionCorrupt(
                f"frame {record.id}: expected uint16 {expected}, {path} has {dn.dtype} {dn.shape}"
            )
        return dn

    def _content(self, record: FrameRecord) -> bytes:
        path = self.path / record.file
        try:
            return path.read_bytes()
        except FileNotFoundError as error:
            raise MissingFrames(f"frame {record.id}: {path} is not there", (record.id,)) from error
        except OSError as error:
            raise SessionCorrupt(f"frame {record.id}: {path} cannot be read: {reason(error)}") from error


def pass_name(session: Path) -> str:
    """Return the name of a session's folder; that of the folder around it where it is just `session`."""
    folder = session.resolve()
    return folder.parent.name if folder.name == "session" else folder.name


def open_session(folder: str | Path) -> Session:
    """Return the session in a folder, without an unfinished last line of frames.jsonl.

    Damage is told in a warning; lines of frames.jsonl that are damaged in both copies count among the losses.

    Raises:
        SessionError: there is no session, or one of another schema version.
        MissingFrames: it holds no frames, or some files are missing.
        SessionCorrupt: a line or a value is damaged; the message names it.
    """
    folder = Path(folder)
    header = read_header(folder)
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
            flight_counts(header),
            int(header["frames_received"]) if "imported_from" in header else None,
            _background(header),
            _encoding(header),
            _navigation(header),
            _registration(header),
        )
    except (ConfigError, KeyError, TypeError, ValueError, AttributeError) as error:
        raise SessionCorrupt(f"{folder / 'session.json'}: {error}") from error
    lines = read_frame_lines(folder)
    frames = tuple(sorted(records_of(folder, lines), key=lambda record: record.id))
    if not frames:
        raise MissingFrames(f"{folder} holds no frames{damage_of(lines)}")
    if lines.lost:
        losses[LINES_DAMAGED] = losses.get(LINES_DAMAGED, 0) + lines.lost
    missing = tuple(record.id for record in frames if not (folder / record.file).is_file())
    if missing:
        named = ", ".join(map(str, missing[:5])) + (", ..." if len(missing) > 5 else "")
        raise MissingFrames(
            f"{folder}: {len(missing)} of {counted(len(frames), 'picture')} missing: {named}", missing
        )
    unstated = [record.id for record in frames if record.split is None]
    if 0 < len(unstated) < len(frames):
        raise SessionCorrupt(
            f"{folder / 'frames.jsonl'}: expected a split for all frames or for none, {len(unstated)} of "
            f"{len(frames)} have none, the first of them frame {unstated[0]}; complete or remove them"
        )
    return Session(folder, camera, frames, losses, *facts)


def session_inside(folder: Path) -> str:
    """Return for a message which folder directly in this one is a session; nothing where none is."""
    return next((f"; {path.parent} is one" for path in sorted(folder.glob("*/session.json"))), "")


def read_header(folder: Path) -> dict[str, Any]:
    """Return session.json, its schema version checked; where it is damaged, what its copy holds.

    Raises:
        SessionError: there is no session.json, it cannot be read, or it has another schema version.
        SessionCorrupt: it is not a JSON object, or does not fit its checksum and has no good copy.
    """
    path = folder / "session.json"
    try:
        header = _header(path)
    except (FileNotFoundError, NotADirectoryError) as error:
        raise SessionError(
            f"{folder} is not a session: it has no session.json{session_inside(folder)}"
        ) from error
    except OSError as error:
        raise SessionError(f"{path} cannot be read: {reason(error)}") from error
    except ConfigError as error:
        raise SessionCorrupt(f"{path}: {error}") from error
    except ValueError as error:
        raise SessionCorrupt(
            f"{path}: {error}, and there is no good copy; who edits it by hand removes its entry crc32"
        ) from error
    if not isinstance(header, dict):
        raise SessionCorrupt(f"{path} should hold an object")
    if header.get("schema_version") != SCHEMA_VERSION:
        raise SessionError(
            f"{folder} was written with schema version {header.get('schema_version')}; "
            f"this software reads {SCHEMA_VERSION}"
        )
    return header


def _header(path: Path) -> Any:
    """Return what session.json holds: the good one of the two; one that names no checksum as it is."""
    has_copy = copy_of(path).exists()
    content = b"" if has_copy and not path.exists() else read_bounded(path, MAX_JSON_BYTES)
    if not names_checksum(content):
        try:
            return parse_json(content, "session")
        except ConfigError:
            if not has_copy:
                raise
    return read_twice(path, lambda problem: _tell(f"{path.parent}: {problem}"), mend=False)


def header_damage(folder: Path) -> list[str]:
    """Return what is wrong with session.json and its copy.

    Raises:
        SessionError: as `read_header`, but not where a good one of the two is used.
    """
    read_header(folder)
    path, found = folder / "session.json", []
    if copy_of(path).exists() and names_checksum(copy_of(path).read_bytes()):
        read_twice(path, found.append, mend=False)
    return found


def read_log(path: Path) -> tuple[dict[str, Any], ...]:
    """Return the objects in one of the files `LOGS`; damaged lines are left out, which is told."""
    lines = read_lines(path)
    if problem := log_damage(lines):
        _tell(f"{path} {problem}")
    return lines.trees


def log_damage(lines: Lines) -> str:
    """Return what is wrong with one of the files `LOGS`, to be read after its name; nothing of a whole one."""
    words = (
        f"has {counted(len(lines.problems), 'damaged line')} ({lines.problems[0]})" if lines.problems else ""
    )
    if lines.unfinished:
        words += (" and " if words else "") + "ends in an unfinished line"
    return words


def log_sizes(folder: Path) -> dict[str, int]:
    """Return the sizes in bytes of the files `LOGS` that are there; they only grow."""
    return {name: (folder / name).stat().st_size for name in LOGS if (folder / name).exists()}


def shortened_logs(folder: Path, header: Mapping[str, Any]) -> list[str]:
    """Return which of the files `LOGS` have less in them than session.json knows of."""
    sizes, known = log_sizes(folder), header.get("log_bytes")
    known = known if isinstance(known, dict) else {}
    return [
        f"{name} was cut: {sizes.get(name, 0):,} of {known[name]:,} bytes are there"
        for name in LOGS
        if type(known.get(name)) is int and sizes.get(name, 0) < known[name]
    ]


def flight_counts(header: dict[str, Any]) -> FlightCounts | None:
    """Return what the spacecraft said of its frames; None without telemetry, and in sessions of older versions."""
    told = header.get("flight")
    return None if told is None else FlightCounts.from_tree(told)


def _background(header: dict[str, Any]) -> float:
    background = header.get("background", 0.0)
    if type(background) not in (int, float) or not 0 <= background < math.inf:
        raise ValueError(f"background must be a radiance of at least 0, got {background!r}")
    return float(background)


def _encoding(header: dict[str, Any]) -> str:
    encoding = header.get("encoding", "linear")
    if encoding not in ENCODINGS:
        raise ValueError(f"encoding must be one of {', '.join(ENCODINGS)}, got {encoding!r}")
    return encoding


def _registration(header: dict[str, Any]) -> dict[str, Any] | None:
    found = header.get("registration")
    if found is None:
        return None
    if not (isinstance(found, dict) and isinstance(found.get("left_out"), list)):
        raise ValueError(f"registration must be an object with a list left_out, got {found!r}")
    return found


def _navigation(header: dict[str, Any]) -> Navigation:
    """Return the section `navigation`; the default one, of exact shared parameters, in sessions without it."""
    tree = dict(header.get("navigation", {}))
    sigmas = SharedParameters(**tree.pop("sigmas", {}))
    if (sigmas.vector() < 0).any():
        raise ValueError(f"navigation.sigmas must not be negative, got {sigmas.lists()}")
    return build(Navigation, tree, "session.navigation", sigmas=sigmas)


def read_frame_lines(folder: Path) -> Lines:
    """Return the whole lines of frames.jsonl in their order, none where there is no such file; damage is told.

    Raises:
        SessionError: the disk refuses it.
    """
    try:
        lines = read_lines_twice(folder / "frames.jsonl", "id")
    except OSError as error:
        raise SessionError(f"{folder / 'frames.jsonl'} cannot be read: {reason(error)}") from error
    if damage := damage_of(lines):
        _tell(f"{folder / 'frames.jsonl'}{damage}")
    return lines


def damage_of(lines: Lines) -> str:
    """Return what is wrong with frames.jsonl, to be read after its name; nothing of a whole one."""
    words = []
    if lines.problems:
        words.append(f"has {counted(len(lines.problems), 'damaged line')} ({lines.problems[0]})")
    if lines.restored:
        words.append(f"{counted(lines.restored, 'frame')} found in its copy only and taken from there")
    if lines.lost:
        words.append(
            f"{counted(lines.lost, 'frame')} lost: `ground uplink resend` asks for what is still on board"
        )
    return ": " + "; ".join(words) if words else ""


def read_records(folder: Path) -> list[FrameRecord]:
    """Return the frames of frames.jsonl in the order of its lines; [] where there is no such file.

    Raises:
        SessionError, SessionCorrupt: as `read_frame_lines` and `records_of`.
    """
    return records_of(folder, read_frame_lines(folder))


def records_of(folder: Path, lines: Lines) -> list[FrameRecord]:
    """Return the frames of lines of a folder's frames.jsonl, in their order.

    Raises:
        SessionCorrupt: a line's values are wrong, a frame occurs twice, or a line without checksum is damaged.
    """
    path = folder / "frames.jsonl"
    if lines.problems and lines.unchecked == len(lines.raw) and not lines.restored:
        raise SessionCorrupt(f"{path} {lines.problems[0]}")
    records: dict[int, FrameRecord] = {}
    for number, tree in enumerate(lines.trees, start=1):
        try:
            record = _record(tree)
            if record.id in records:
                raise ValueError(f"frame {record.id} is there twice")
        except (ValueError, TypeError, KeyError) as error:
            raise SessionCorrupt(f"{path} line {number}: {error}") from error
        records[record.id] = record
    return list(records.values())


@functools.lru_cache(maxsize=1000)
def _tell(problem: str) -> None:
    """Log what is wrong, once: a session that is being written is read again and again."""
    log.warning("%s", problem)


def _record(tree: Any) -> FrameRecord:
    if not isinstance(tree, dict):
        raise ValueError("expected an object")
    values: dict[str, Any] = {}
    for column in dataclasses.fields(FrameRecord):
        if column.default is None and tree.get(column.name) is None:
            continue
        if column.name not in tree:
            raise ValueError(f"{column.name} is missing")
        value = tree[column.name]
        if column.name in ARRAY_SHAPES:
            value = np.array(value, dtype=np.float64)
            if value.shape != ARRAY_SHAPES[column.name] or not np.isfinite(value).all():
                raise ValueError(f"{column.name} must be {ARRAY_SHAPES[column.name]} finite numbers")
        elif column.name == "split":
            if value not in SPLITS:
                raise ValueError(f"split must be one of {', '.join(SPLITS)}, got {value!r}")
        elif column.type is float and type(value) is int:
            value = float(value)
        elif type(value) is not column.type or (column.type is float and not math.isfinite(value)):
            raise ValueError(f"{column.name} is {value!r}")
        values[column.name] = value
    if "K" in values and not is_pinhole(values["K"]):
        raise ValueError(
            f"K must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], fx and fy positive, got {tree['K']}"
        )
    if not FRAME_FILE.fullmatch(values["file"]):
        raise ValueError(f"file is {values['file']!r}, expected frames/000123.png")
    if values["id"] < 0 or values["exposure_time_s"] <= 0:
        raise ValueError(
            f"expected a frame of at least 0 and an exposure time above 0, got frame {values['id']} and "
            f"{values['exposure_time_s']} s"
        )
    if not is_pose(values["world_to_camera"]):
        raise ValueError(f"world_to_camera must turn and move, got {values['world_to_camera'].tolist()}")
    return FrameRecord(**values)


def is_whole_png(content: bytes) -> bool:
    """Return whether a PNG has all its parts and every checksum fits; what the parts say is not looked at."""
    at = len(PNG_SIGNATURE)
    if not content.startswith(PNG_SIGNATURE):
        return False
    while True:
        end = at + 12 + int.from_bytes(content[at : at + 4])
        part = content[at + 4 : end - 4]
        if end > len(content) or zlib.crc32(part) != int.from_bytes(content[end - 4 : end]):
            return False
        if part.startswith(b"IEND"):
            return True
        at = end


def is_pose(matrix: np.ndarray) -> bool:
    """Return whether [4, 4] finite numbers are a rotation and a translation."""
    R = matrix[:3, :3]
    turns = np.allclose(R @ R.T, np.eye(3), atol=1e-3) and np.linalg.det(R) > 0
    return bool(turns and (matrix[3] == (0, 0, 0, 1)).all())


def is_pinhole(K: np.ndarray) -> bool:
    """Return whether [3, 3] finite numbers are a pinhole matrix without skew."""
    expected = np.array([[K[0, 0], 0, K[0, 2]], [0, K[1, 1], K[1, 2]], [0, 0, 1]])
    return bool((expected == K).all() and K[0, 0] > 0 and K[1, 1] > 0)
