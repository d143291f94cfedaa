"""Writes a session frame by frame, so that a power cut at any moment leaves a session that opens again."""

import dataclasses
import hashlib
import logging
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import imagecodecs

from flightsw.icd.frame import ATTITUDES, Attitude, Frame
from flightsw.icd.mission import Mission
from flightsw.icd.quaternion import matrix_to_quat
from flightsw.icd.tle import orbit_axes
from ground.session.folder import (
    LINES_DAMAGED,
    SCHEMA_VERSION,
    SessionCorrupt,
    SessionError,
    flight_counts,
    is_whole_png,
    log_sizes,
    read_frame_lines,
    read_header,
    records_of,
    shortened_logs,
)
from ground.session.telemetry import FlightCounts
from obbgs_base.checked import append_twice, checked_text, copy_of, write_twice
from obbgs_base.errors import in_words
from obbgs_base.files import set_aside, write_whole

log = logging.getLogger(__name__)


class SessionWriter:
    """Adds frames to a session folder: a new one, or one that an earlier run began.

    Raises:
        SessionError: the folder holds a session of another mission or schema version, or cannot be written.
        SessionCorrupt: its files are damaged in another way than an unfinished last line.
    """

    def __init__(self, folder: str | Path, mission: Mission):
        self.folder = Path(folder)
        self._mission = mission
        self._navigation = navigation_of(mission)
        self._frames_file, self._header_file = self.folder / "frames.jsonl", self.folder / "session.json"
        self._losses_before: dict[str, int] = {}
        self._bytes_before = 0
        self.flight: FlightCounts | None = None  # as in session.json
        self._created_utc = datetime.now(UTC).isoformat(timespec="seconds")
        try:
            (self.folder / "frames").mkdir(parents=True, exist_ok=True)
            if any(each.exists() for each in (self._header_file, copy_of(self._header_file))):
                self._continue()
            self._sha256_of = self._mended_lines()
            self.save({}, 0)
        except OSError as error:
            raise SessionError(f"cannot write the session {self.folder}: {in_words(error)}") from error

    @property
    def frame_count(self) -> int:
        return len(self._sha256_of)

    @property
    def last_frame_id(self) -> int:
        """The highest frame number; -1 without frames."""
        return max(self._sha256_of, default=-1)

    def add(self, frame: Frame, container: bytes) -> bool:
        """Write a frame's picture and line, and return True; return False if the session already holds this very frame.

        A picture of it that is damaged or gone is written again.

        Args:
            container: the frame as received; its SHA-256 tells whether two frames are the same.

        Raises:
            SessionError: the session holds another frame of this number, or the picture is not of the camera's size.
            OSError: writing failed; the frame is not in the session.
        """
        sha256 = hashlib.sha256(container).hexdigest()
        known = self._sha256_of.get(frame.frame_id)
        if known is not None:
            if known != sha256:
                raise SessionError(
                    f"another frame {frame.frame_id} is in the session already; if the spacecraft has a new store, "
                    "start `ground listen` with another --session"
                )
            if self._has_picture(frame.frame_id):
                return False
            log.warning("the picture of frame %d was damaged and is written again", frame.frame_id)
        camera = self._mission.camera
        shape = (camera.height, camera.width) + ((3,) if camera.channels == 3 else ())
        if frame.dn.shape != shape:
            raise SessionError(
                f"frame {frame.frame_id} has shape {frame.dn.shape}, the mission's camera {shape}"
            )
        name = _picture_of(frame.frame_id)
        write_whole(self.folder / name, bytes(imagecodecs.png_encode(frame.dn, level=1)))
        if known is not None:
            return True
        append_twice(self._frames_file, frame_line(frame, name, sha256))
        self._note_attitude(frame.pose.attitude)
        self._sha256_of[frame.frame_id] = sha256
        return True

    def save(
        self, losses: Mapping[str, int], bytes_received: int, flight: FlightCounts | None = None
    ) -> None:
        """Write session.json and its copy.

        `losses` and `bytes_received` are counts of this run and added to those of earlier runs; `flight` replaces the
        earlier value, unless it is None.
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
            "navigation": self._navigation,
            "losses": total,
            "flight": dataclasses.asdict(self.flight) if self.flight else None,
            "frames_received": self.frame_count,
            "bytes_received": self._bytes_before + bytes_received,
            "log_bytes": log_sizes(self.folder),
            "created_utc": self._created_utc,
        }
        write_twice(self._header_file, header, form=checked_text)

    def _continue(self) -> None:
        header = read_header(self.folder)
        if header.get("mission_sha256") != self._mission.sha256:
            raise SessionError(
                f"{self.folder} belongs to another mission file; choose another session folder"
            )
        for problem in shortened_logs(self.folder, header):
            log.warning("%s: %s", self.folder, problem)
        try:
            self._losses_before = {str(name): int(count) for name, count in header["losses"].items()}
            self._bytes_before = int(header["bytes_received"])
            self._created_utc = str(header["created_utc"])
            self.flight = flight_counts(header)
            self._note_attitude(header.get("navigation", {}).get("attitude", "known"))
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise SessionCorrupt(f"{self.folder / 'session.json'}: {error}") from error

    def _note_attitude(self, attitude: Attitude) -> None:
        """Keep the least that the mission file or any tag knows of the target's attitude."""
        self._navigation["attitude"] = max(self._navigation["attitude"], attitude, key=ATTITUDES.index)

    def _has_picture(self, frame_id: int) -> bool:
        try:
            return is_whole_png((self.folder / _picture_of(frame_id)).read_bytes())
        except OSError:
            return False

    def _mended_lines(self) -> dict[int, str]:
        """Return the digests of the frames, and make both copies of frames.jsonl whole; what is damaged is set aside.

        A last line that was left unfinished goes.
        """
        lines = read_frame_lines(self.folder)
        digests = {record.id: record.sha256 for record in records_of(self.folder, lines)}
        if lines.lost:
            self._losses_before[LINES_DAMAGED] = self._losses_before.get(LINES_DAMAGED, 0) + lines.lost
        content = b"".join(line + b"\n" for line in lines.raw)
        for each in (self._frames_file, copy_of(self._frames_file)):
            before = each.read_bytes() if each.exists() else b""
            if before == content:
                continue
            if not content.startswith(before) and not before.startswith(content):
                log.warning("the damaged %s is kept as %s", each.name, set_aside(each).name)
            write_whole(each, content)
        return digests


def _picture_of(frame_id: int) -> str:
    return f"frames/{frame_id:06d}.png"


def navigation_of(mission: Mission) -> dict[str, Any]:
    """Return the section `navigation` of session.json (`ground.session.folder.Navigation`).

    Raises:
        ConfigError: the target's orbit cannot be propagated to the mission's start.
    """
    epoch_utc_ns = mission.orbit.start_utc_ns
    mean_motion_rad_s, inertial_to_rtn = orbit_axes(mission.orbit.target_tle, epoch_utc_ns)
    return {
        "attitude": mission.target_attitude.knowledge,
        "correlation_time_s": mission.pose.correlation_time_s,
        "epoch_utc_ns": epoch_utc_ns,
        "mean_motion_rad_s": mean_motion_rad_s,
        "quat_inertial_to_rtn": matrix_to_quat(inertial_to_rtn).tolist(),
        "sigmas": mission.navigation_errors.sigmas.lists(),
    }


def frame_line(frame: Frame, file: str, sha256: str) -> dict[str, Any]:
    """Return a frame's line of frames.jsonl."""
    pose = frame.pose
    assumed = pose.quat_inertial_to_body
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
        **({} if assumed is None else {"quat_inertial_to_body": assumed.tolist()}),
    }
