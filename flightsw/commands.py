"""Commands from the ground: decrypted, checked, counted, executed at most once, and reported stage by stage.

Nothing has an effect before its tag, its counter, its arguments and, where it destroys, its arming are good, and the
counter is on the disk before the effect. A command that comes again is answered with its reports, never executed. One
whose counter cannot be kept is neither executed nor answered, as if it had been lost on the link.
"""

import contextlib
import dataclasses
import fcntl
import hashlib
import logging
import os
import time
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from flightsw.errors import FlightError, StoreError
from flightsw.icd.auth import TAG_BYTES, AuthError, Key, unseal, unseal_file
from flightsw.icd.command import ENDED, Command, Report, model_file_name
from flightsw.icd.config import ConfigError
from flightsw.icd.mission import Mission
from flightsw.icd.packet import PacketError
from flightsw.icd.telemetry import DICTIONARY
from flightsw.settings import Settings, load_settings, save_settings
from flightsw.store import FrameStore, keep_reserve, write_with_reserve
from obbgs_base.files import write_whole

log = logging.getLogger(__name__)
REMEMBERED = 64  # commands whose reports are sent again when the ground asks again
RESERVE_BYTES = 8 * 1024  # given up for the counter on a full disk: commands are what empties it
ANSWER_S = 0.2  # between answers to repeated commands: a flood of replays must not fill the downlink


class ReplayCounter:
    """The counter of the last authentic command, on the disk beside the key; one process at a time has it.

    A file beside the counter holds some space in reserve for when the disk is full.

    Raises:
        ConfigError: the key or the counter file is missing, damaged or another key's.
    """

    def __init__(self, key_file: Path):
        self.path = key_file.with_name(key_file.name + ".received")
        try:
            self.key = Key.parse(key_file.read_text(), str(key_file))
            self.last = self.key.parse_counter(self.path.read_text(), str(self.path))
            self._lock = os.open(
                key_file.with_name(self.path.name + ".lock"), os.O_WRONLY | os.O_CREAT, 0o600
            )
        except (OSError, UnicodeDecodeError) as error:
            raise ConfigError(str(key_file), f"cannot read the key and its counter: {error}") from error
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            self.close()
            raise ConfigError(str(self.path), "another process takes commands with this key") from error
        self._reserve = self.path.with_name(self.path.name + ".reserve")
        self._keep_reserve()

    def advance(self, counter: int) -> None:
        """Keep the counter of a command that is about to have an effect.

        Raises:
            StoreError: the disk refuses. The command must be neither executed nor reported as refused: after a restart
                it could be taken, and then the report would not have been true.
        """
        try:
            write_with_reserve(self.path, self.key.counter_text(counter).encode(), self._reserve)
        except OSError as error:
            raise StoreError(f"cannot keep the command counter: {error}") from error
        self.last = counter
        self._keep_reserve()

    def close(self) -> None:
        os.close(self._lock)

    def _keep_reserve(self) -> None:
        """Make the reserve if there is none; without space it is tried again at the next command."""
        with contextlib.suppress(OSError):
            keep_reserve(self._reserve, RESERVE_BYTES)


@dataclass(frozen=True)
class Upload:
    """A model file that an authentic command has announced."""

    counter: int
    size_bytes: int
    sha256: bytes
    file_key: bytes

    @property
    def file_name(self) -> str:
        return model_file_name(self.counter)

    @property
    def sealed_bytes(self) -> int:
        return self.size_bytes + TAG_BYTES


class Commander:
    """Takes sealed commands, gives reports.

    `upload` is the file that the ground may send now, None most of the time. A model that has come has a file of its
    own, by which the end of its verification is told. Without a counter (no key) every command is refused.
    """

    def __init__(
        self,
        counter: ReplayCounter | None,
        store: FrameStore,
        mission: Mission,
        on_refusal: Callable[[str], None] = lambda problem: None,
        clock_s: Callable[[], float] = time.monotonic,
        utc_ns: Callable[[], int] = time.time_ns,
    ):
        self.settings = load_settings(store.folder, mission)
        self.upload: Upload | None = None
        self.accepted = 0
        self.refused = 0
        self.repeated = 0
        self.reports: list[Report] = []  # to be sent; the owner takes them out
        self._counter, self._store, self._mission = counter, store, mission
        self._on_refusal, self._clock_s, self._utc_ns = on_refusal, clock_s, utc_ns
        self._remembered: OrderedDict[int, list[Report]] = OrderedDict()
        self._armed: tuple[str, float] | None = None  # command, until when
        self._verifying: dict[Path, int] = {}  # the command of each model that has come
        self._next_answer_s = float("-inf")

    @property
    def last_counter(self) -> int:
        return self._counter.last if self._counter else 0

    def receive(self, data: bytes) -> None:
        """Take a packet from the link; it may be anything."""
        if self._counter is None:
            self._refuse("there is no key on board")
            return
        try:
            counter, content = unseal(self._counter.key, data)
        except AuthError as error:
            self._refuse(str(error))
            return
        if counter <= self._counter.last:
            self.repeated += 1
            self._answer_again(counter)
            return
        try:
            self._counter.advance(counter)
        except StoreError as error:
            self._refuse(f"command {counter} is not taken yet: {error}")
            return  # without a report: the ground sends the command again
        try:
            command = Command.unpack(content)
            self._check_arming(command)
            self._check(command)
        except (PacketError, ValueError) as error:
            self._refuse(f"counter {counter}: {error}")
            self._note(counter, "refused", str(error))
            return
        self.accepted += 1
        self._note(counter, "accepted", command.name)
        self._note(counter, "started", command.name)
        try:
            result = self._execute(counter, command)
        except FlightError as error:
            self._note(counter, "failed", str(error))
        else:
            if result is not None:
                self._note(counter, "completed", result)

    def receive_model(self, name: str, data: bytes) -> Path | None:
        """Return where the announced model now lies, to be verified; None, and the command failed, if it is another.

        The name is the link's: it is compared with the expected one and never opened.
        """
        upload = self.upload
        if upload is None or name != upload.file_name:
            return None
        self.upload = None
        path = self._store.folder / f"{name}.received"
        try:
            content = unseal_file(upload.file_key, data)
            if len(content) != upload.size_bytes or hashlib.sha256(content).digest() != upload.sha256:
                raise AuthError("the file is not the one that was announced")
            write_whole(path, content)
        except (AuthError, OSError) as error:
            self._note(upload.counter, "failed", str(error))
            return None
        self._verifying[path] = upload.counter
        return path

    def end_model(self, path: Path, problem: str | None, result: str = "") -> None:
        """Report how the verification of a model file ended, to the command that announced it."""
        self._note(self._verifying.pop(path), "failed" if problem else "completed", problem or result)

    def end_models(self, problem: str) -> None:
        """Report that no model is verified any more."""
        for path in list(self._verifying):
            self.end_model(path, problem)

    def _answer_again(self, counter: int) -> None:
        if self._clock_s() < self._next_answer_s:
            return
        self._next_answer_s = self._clock_s() + ANSWER_S
        unknown = self._report(
            counter, "refused", "was taken before; what became of it is not known here any more"
        )
        self.reports += self._remembered.get(counter, [unknown])

    def _check_arming(self, command: Command) -> None:
        armed, self._armed = self._armed, None  # whatever comes next disarms
        if not command.layout.armed:
            return
        if armed is None or armed[0] != command.name or self._clock_s() > armed[1]:
            raise ValueError(f"not armed: send `arm {command.name}` at most {DICTIONARY.arm_s} s before")

    def _check(self, command: Command) -> None:
        """Refuse what is in range but makes no sense here.

        Raises:
            ValueError: says what.
        """
        values = command.arguments
        if command.name == "bracket":
            dataclasses.replace(self.settings, **values).bracket(self._mission)
        elif command.name == "delete" and values["first_frame"] > values["last_frame"]:
            raise ValueError(f"frames {values['first_frame']} to {values['last_frame']} are none")

    def _execute(self, counter: int, command: Command) -> str | None:
        """Do it and return the result in words; None when it goes on.

        Raises:
            FlightError: it could not be done.
        """
        values = command.arguments
        match command.name:
            case "ping":
                return "alive"
            case "bracket":
                self._change(exposure_times_ms=values["exposure_times_ms"])
                return ", ".join(f"{time_ms:g}" for time_ms in values["exposure_times_ms"]) + " ms"
            case "near":
                self._change(max_error_dn=values["near"])
                return f"NEAR {values['near']}"
            case "priority":
                self._change(priority=values["order"])
                return values["order"]
            case "model":
                if self.upload is not None:
                    self._note(self.upload.counter, "failed", f"replaced by command {counter}")
                self.upload = Upload(counter, **values)
                return None
            case "arm":
                self._armed = (values["command"], self._clock_s() + DICTIONARY.arm_s)
                return f"{values['command']} is armed for {DICTIONARY.arm_s} s"
            case "delete":
                return self._delete(values["first_frame"], values["last_frame"])
            case "safe" | "resume":
                self._change(safe_mode=command.name == "safe")
                return "no exposures until resumed" if self.settings.safe_mode else "exposures go on"
        raise AssertionError(command.name)  # the dictionary has no other

    def _change(self, **changes: object) -> None:
        settings: Settings = dataclasses.replace(self.settings, **changes)  # type: ignore[arg-type]
        save_settings(self._store.folder, settings)
        self.settings = settings

    def _delete(self, first_frame: int, last_frame: int) -> str:
        deleted = [f.frame_id for f in self._store.frames if first_frame <= f.frame_id <= last_frame]
        for frame_id in deleted:
            self._store.drop(frame_id)
        return f"{len(deleted)} frames deleted"

    def _note(self, counter: int, stage: str, text: str) -> None:
        report = self._report(counter, stage, text)
        self._remembered.setdefault(counter, []).append(report)
        if len(self._remembered) > REMEMBERED:
            self._remembered.popitem(last=False)
        self.reports.append(report)
        if stage in ENDED:
            log.info("command %d %s: %s", counter, stage, text)

    def _report(self, counter: int, stage: str, text: str) -> Report:
        return Report(self._utc_ns(), counter, stage, text)

    def _refuse(self, problem: str) -> None:
        self.refused += 1
        self._on_refusal(problem)
