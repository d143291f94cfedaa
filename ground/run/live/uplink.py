"""Sends the model of a live reconstruction up when it has improved enough, so that the downlink follows it."""

import logging
import math
import time
from pathlib import Path

from flightsw.icd.command import Command
from flightsw.icd.link.auth import Key
from flightsw.icd.mission import ConfigError
from ground.link.uplink import outcome, submit
from ground.run.live.model import ShownModel
from ground.run.model_files import exposure_times_s
from ground.session.cameras import sensor_of
from ground.session.folder import FrameRecord, Session
from obbgs_base.errors import reason
from obbgs_core.io.onnx import export_onnx
from obbgs_core.model.gaussians import Gaussians
from obbgs_core.poses.estimate import PoseEstimate

log = logging.getLogger(__name__)
GAIN_DB = 1.0  # over the model on board, on held-out frames: less is not worth the time of the uplink
EXPIRES_S = 300.0  # for which the listener tries to send a command
RETRY_S = 60.0  # after a model that did not arrive
TRIAGE = Command("priority", {"order": "triage"})


class LiveUplink:
    """Leaves models for the session's listener to send, one at a time, and asks for the order by triage after one.

    state: what became of the last command, in words; empty before the first.

    Raises:
        ConfigError: the key cannot be used.
    """

    def __init__(self, session_dir: Path, key_file: Path):
        try:
            Key.parse(key_file.read_text(), str(key_file))
        except (OSError, UnicodeDecodeError) as error:
            raise ConfigError(str(key_file), f"cannot read the key: {reason(error)}") from error
        self.state = ""
        self._session_dir, self._key_file = session_dir, key_file
        # the model on board or on its way there, with the poses that it was trained with
        self._sent: tuple[Gaussians, PoseEstimate | None] | None = None
        self._sent_text = ""
        # counter and name of the command that has no result yet
        self._under_way: tuple[int, str] | None = None
        self._is_ordered = False  # the spacecraft has taken the order by triage
        self._not_before_s = -math.inf

    def tend(self) -> bool:
        """Note what became of what was sent, ask for the order by triage after a model; tell whether one may be sent.

        Raises:
            ConfigError: the key cannot be used any more.
            SessionError: the session folder cannot be written.
        """
        if self._under_way is not None:
            self._note_result(*self._under_way)
        if self._under_way is not None or time.monotonic() < self._not_before_s:
            return False
        if self._sent is not None and not self._is_ordered:
            self._under_way = submit(self._session_dir, self._key_file, TRIAGE, None, EXPIRES_S), "priority"
            return False
        return True

    def follow(self, shown: ShownModel, session: Session, training: list[FrameRecord], folder: Path) -> None:
        """Send the shown model if it has improved enough and nothing else is under way.

        Args:
            folder: where the model's file is made.

        Raises:
            ConfigError: the key cannot be used any more, or the spacecraft accepts no model of this size.
            SessionError: the session folder cannot be written.
        """
        if not self.tend() or shown.gaussians is None or math.isnan(shown.held_out_db):
            return
        gain_db = math.inf if self._sent is None else shown.held_out_db - shown.score_db(*self._sent)
        if gain_db >= GAIN_DB:
            self._send(shown.gaussians, session, training, folder / "uplink.onnx")
            self._sent = shown.gaussians, shown.estimate
            self._sent_text = f"step {shown.step}, held out {shown.held_out_db:.1f} dB"
            self.state = f"{self._sent_text}: waiting"
            log.info("a model goes up: %s", self._sent_text)

    def _send(self, gaussians: Gaussians, session: Session, training: list[FrameRecord], path: Path) -> None:
        camera = session.camera
        export_onnx(
            gaussians,
            sensor_of(camera),
            path,
            camera.width,
            camera.height,
            exposure_times_s(training),
            camera.psf_sigma_px,
            session.background,
        )
        try:
            counter = submit(self._session_dir, self._key_file, Command("model", {}), path, EXPIRES_S)
        finally:
            path.unlink(missing_ok=True)
        self._under_way = counter, "model"

    def _note_result(self, counter: int, name: str) -> None:
        result = outcome(self._session_dir, counter)
        if result is None:
            return
        self._under_way, stage = None, result["stage"]
        log.info("%s %d %s: %s", name, counter, stage, result["text"])
        self.state = f"{self._sent_text}: {name} {stage}"
        if stage != "completed":
            self._not_before_s = time.monotonic() + RETRY_S
            if name == "model":
                self._sent = None
        elif name == "priority":
            self._is_ordered = True
