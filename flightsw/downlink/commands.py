"""Commands from the ground: decrypted, checked, counted, executed at most once, and reported stage by stage.

Nothing has an effect before its tag, its counter, its arguments and, where it destroys, its arming are good, and the
counter is on the disk before the effect. A command that comes again is answered with its reports, never executed. One
whose counter cannot be kept is neither executed nor answered, as if it had been lost on the link. Every report says by
a digest on which packet it is; a packet that no key on board has sealed, or whose counter another one used, is told so.
"""

import contextlib
import dataclasses
import fcntl
import hashlib
import logging
import os
import time
from collections import OrderedDict, deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from flightsw.clock import utc_ns
from flightsw.errors import FlightError, StoreError
from flightsw.icd.command import ENDED, Command, Report, model_file_name
from flightsw.icd.config import ConfigError
from flightsw.icd.link.auth import (
    MAX_COUNTER,
    TAG_BYTES,
    AuthError,
    Key,
    claimed,
    digest,
    unseal,
    unseal_file,
)
from flightsw.icd.mission import Mission
from flightsw.icd.packet import PacketError
from flightsw.icd.telemetry import DICTIONARY
from flightsw.storage.fsck import RunningCheck
from flightsw.storage.settings import Settings, load_settings, save_settings
from flightsw.storage.store import RESERVE, FrameStore, keep_reserve, write_with_reserve
from obbgs_base.checked import copy_of, each_copy, read_twice, write_twice
from obbgs_base.errors import counted, in_words, reason
from obbgs_base.files import set_aside, write_whole

log = logging.getLogger(__name__)
REMEMBERED = 64  # commands whose reports are sent again when the ground asks again
RESERVE_BYTES = 8 * 1024  # given up for the counter on a full disk: commands are what empties it
ANSWER_S = 0.2  # between answers to packets without effect: a flood of them must not fill the downlink
DELETE_S = 0.05  # for deleting frames in one turn of the downlink's loop
DELETIONS = (
    "deletions.json"  # in the store's folder: what is being deleted, so that a restart goes on with it
)


class ReplayCounter:
    """The counter of the last authentic command, on the disk beside the key; one process at a time has it.

    It stands in two files, each with a checksum. The larger of the two counts, and a damaged one is written again; they
    differ by one command where the power went between them. A third file holds some space in reserve for when the disk
    is full.

    Raises:
        ConfigError: the key is missing or damaged, or both counter files are missing, damaged or another key's.
    """

    def __init__(self, key_file: Path):
        self.path, self._key_file = key_file.with_name(key_file.name + ".received"), key_file
        self._reserve = self.path.with_name(self.path.name + ".reserve")
        try:
            self.key = Key.parse(key_file.read_text(), str(key_file))
            self._lock = os.open(
                key_file.with_name(self.path.name + ".lock"), os.O_WRONLY | os.O_CREAT, 0o600
            )
        except (OSError, UnicodeDecodeError) as error:
            raise ConfigError(
                str(key_file), f"cannot read the key and its counter: {reason(error)}"
            ) from error
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            self.last = self._read()
        except BlockingIOError as error:
            self.close()
            raise ConfigError(str(self.path), "another process takes commands with this key") from error
        except ConfigError:
            self.close()
            raise
        self._keep_reserve()

    @property
    def is_retired(self) -> bool:
        """Whether the counter has come to its end, by which a key is retired."""
        return self.last == MAX_COUNTER

    def _read(self) -> int:
        counters, problems = each_copy(self.path, lambda text: self.key.parse_counter(text, str(self.path)))
        if not counters:
            raise ConfigError(str(self.path), f"neither the counter nor its copy can be used: {problems[0]}")
        if problems:
            log.warning("one of the two files of the command counter is mended: %s", problems[0])
        last, content = max(counters), self.key.counter_text(max(counters)).encode()
        for each in (self.path, copy_of(self.path)):
            with contextlib.suppress(OSError):  # one of the two is good
                if not each.exists() or each.read_bytes() != content:
                    self._write(each, content)
        return last

    def advance(self, counter: int) -> None:
        """Keep the counter of a command that is about to have an effect.

        Raises:
            StoreError: the disk refuses. The command must be neither executed nor reported as refused: after a restart
                it could be taken, and then the report would not have been true.
        """
        content = self.key.counter_text(counter).encode()
        try:
            self._write(self.path, content)
        except OSError as error:
            raise StoreError(f"cannot keep the command counter: {in_words(error)}") from error
        self.last = counter
        try:
            self._write(copy_of(self.path), content)
        except OSError as error:
            log.warning("the copy of the command counter cannot be written: %s", in_words(error))
        self._keep_reserve()

    def close(self) -> None:
        os.close(self._lock)

    def _write(self, path: Path, content: bytes) -> None:
        """Write one of the two files; a new one can be read by those who can read the key."""
        write_with_reserve(path, content, self._reserve, like=self._key_file)

    def _keep_reserve(self) -> None:
        """Make the reserve if there is none; without space it is tried again at the next command."""
        with contextlib.suppress(OSError):
            keep_reserve(self._reserve, RESERVE_BYTES)


class KeyRing:
    """The keys that seal commands, each with a counter of its own: two while one takes the other's place.

    A key that cannot be used is left out, since without commands frames are still taken and sent.

    problems: why keys were left out.
    without_counter: those that were left out for their counter alone. They open no command, but the ground's answers
        about frames are authenticated with them all the same.
    """

    def __init__(self, key_files: Iterable[Path]):
        self.counters: list[ReplayCounter] = []
        self.problems: list[str] = []
        self.without_counter: list[Key] = []
        for key_file in key_files:
            try:
                counter = ReplayCounter(key_file)
            except ConfigError as error:
                self.problems.append(str(error))
                with contextlib.suppress(ConfigError, OSError, UnicodeDecodeError):
                    self.without_counter.append(Key.parse(key_file.read_text(), str(key_file)))
                continue
            if self.of(counter.key.spi) is not None:
                self.problems.append(f"{key_file}: another key has the number {counter.key.spi} already")
                counter.close()
                continue
            self.counters.append(counter)

    def of(self, spi: int) -> ReplayCounter | None:
        """Return the counter of the key with this number."""
        return next((counter for counter in self.counters if counter.key.spi == spi), None)

    def unseal(self, packet: bytes) -> tuple[ReplayCounter, int, bytes]:
        """Return whose key sealed a packet, its counter and its content.

        Raises:
            AuthError: no key on board did, or it was changed.
        """
        spi, _ = claimed(packet)
        if not self.counters:
            raise AuthError(self.problems[0] if self.problems else "there is no key on board")
        own = self.of(spi)
        on_board = ", ".join(str(counter.key) for counter in self.counters)
        if own is None:
            raise AuthError(f"sealed with key {spi}; on board: {on_board}")
        try:
            return own, *unseal(own.key, packet)
        except AuthError as error:
            raise AuthError(f"{error}, or another key {spi}; on board: {on_board}") from error

    def close(self) -> None:
        for counter in self.counters:
            counter.close()


@dataclass(frozen=True)
class Received:
    """Which authentic packet a command came in."""

    spi: int
    counter: int
    digest: bytes


@dataclass(frozen=True)
class Upload:
    """A model file that an authentic command has announced."""

    command: Received
    size_bytes: int
    sha256: bytes
    file_key: bytes

    @property
    def file_name(self) -> str:
        return model_file_name(self.command.counter)

    @property
    def sealed_bytes(self) -> int:
        return self.size_bytes + TAG_BYTES


@dataclass(frozen=True)
class Deletion:
    """The frames that a command deletes: those of its range that were stored when it came."""

    command: Received
    first: int
    last: int
    count: int = 0

    def of(self, frame_ids: Iterable[int]) -> list[int]:
        """Return the frames of these that it is about."""
        return [frame_id for frame_id in frame_ids if self.first <= frame_id <= self.last]

    def tree(self) -> dict[str, Any]:
        """Return it as `from_tree` takes it."""
        command = vars(self.command) | {"digest": self.command.digest.hex()}
        return vars(self) | {"command": command}

    @classmethod
    def from_tree(cls, tree: dict[str, Any]) -> "Deletion":
        """Return what `tree` gave.

        Raises:
            ValueError, TypeError, KeyError: it is not that.
        """
        command = tree["command"]
        received = Received(command["spi"], command["counter"], bytes.fromhex(command["digest"]))
        return cls(received, int(tree["first"]), int(tree["last"]), int(tree["count"]))


class Commander:
    """Takes sealed commands, gives reports.

    `upload` is the file that the ground may send now, None most of the time. A model that has come has a file of its
    own, by which the end of its verification is told. Without a key every command is refused. `poll` does what takes
    longer than one turn of the downlink's loop may.
    """

    def __init__(
        self,
        keys: KeyRing | None,
        store: FrameStore,
        mission: Mission,
        on_refusal: Callable[[str], None] = lambda problem: None,
        clock_s: Callable[[], float] = time.monotonic,
        utc_ns: Callable[[], int] = utc_ns,
    ):
        self.settings = load_settings(store.folder, mission)
        self.upload: Upload | None = None
        self.accepted = 0
        self.refused = 0
        self.repeated = 0
        self.reports: list[Report] = []  # to be sent; the owner takes them out
        self._keys, self._store, self._mission = keys or KeyRing([]), store, mission
        self._on_refusal, self._clock_s, self._utc_ns = on_refusal, clock_s, utc_ns
        self._remembered: OrderedDict[Received, list[Report]] = OrderedDict()
        self._armed: tuple[str, float] | None = None  # command, until when
        self._verifying: dict[Path, Received] = {}  # the command of each model that has come
        self._deletions: deque[Deletion] = deque()
        self._frames_to_delete: deque[int] | None = None  # of the first of them, once it is begun
        self._are_deletions_read = False  # those of the run before
        self._last_used = next(iter(self._keys.counters), None)
        self._check_of_store: tuple[Received, RunningCheck] | None = None  # the command that asked for it
        self._next_answer_s = float("-inf")

    @property
    def last_counter(self) -> int:
        """The counter of the last authentic command of the key that was used last."""
        return self._last_used.last if self._last_used else 0

    def receive(self, data: bytes) -> None:
        """Take a packet from the link; it may be anything."""
        try:
            own, number, content = self._keys.unseal(data)
        except AuthError as error:
            self._refuse(str(error))
            with contextlib.suppress(AuthError):  # too short to be anybody's command
                self._answer([self._report(Received(*claimed(data), digest(data)), "refused", str(error))])
            return
        received = Received(own.key.spi, number, digest(data))
        if number <= own.last:
            self.repeated += 1
            self._answer(self._remembered.get(received) or [self._used_before(received, own)])
            return
        try:
            own.advance(number)
        except StoreError as error:
            self._refuse(f"command {number} is not taken yet: {error}")
            return  # without a report: the ground sends the command again
        self._last_used = own
        try:
            command = Command.unpack(content)
            self._check_arming(command)
            self._check(received, command)
        except (PacketError, ValueError) as error:
            self._refuse(f"counter {number}: {error}")
            self._note(received, "refused", str(error))
            return
        self.accepted += 1
        self._note(received, "accepted", command.name)
        self._note(received, "started", command.name)
        try:
            result = self._execute(received, command)
        except FlightError as error:
            self._note(received, "failed", str(error))
        else:
            if result is not None:
                self._note(received, "completed", result)

    def poll(self) -> None:
        """Go on with what commands have begun, for `DELETE_S` at most."""
        self._poll_check()
        self._read_deletions()
        end_s = self._clock_s() + DELETE_S
        while self._deletions:
            deletion = self._deletions[0]
            if self._frames_to_delete is None:
                self._frames_to_delete = deque(deletion.of(f.frame_id for f in self._store.frames))
            frames, count = self._frames_to_delete, deletion.count
            try:
                while frames:
                    if self._store.path(frames[0]).exists():  # it may have been deleted for another's room
                        self._store.drop(frames[0])
                    frames.popleft()
                    if self._clock_s() > end_s:
                        return
            except FlightError as error:
                self._note(
                    deletion.command,
                    "failed",
                    f"{count - len(frames)} of {counted(count, 'frame')} deleted: {error}",
                )
            else:
                self._note(deletion.command, "completed", f"{counted(count, 'frame')} deleted")
            self._deletions.popleft()
            self._frames_to_delete = None
            with contextlib.suppress(StoreError):  # after a restart it is found to be done
                self._keep_deletions()

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
            self._note(upload.command, "failed", reason(error))
            return None
        self._verifying[path] = upload.command
        return path

    def end_model(self, path: Path, problem: str | None, result: str = "") -> None:
        """Report how the verification of a model file ended, to the command that announced it."""
        self._note(self._verifying.pop(path), "failed" if problem else "completed", problem or result)

    def end_models(self, problem: str) -> None:
        """Report that no model is verified any more."""
        for path in list(self._verifying):
            self.end_model(path, problem)

    def _answer(self, reports: list[Report]) -> None:
        """Answer a packet that had no effect, at a walking pace."""
        if self._clock_s() >= self._next_answer_s:
            self._next_answer_s = self._clock_s() + ANSWER_S
            self.reports += reports

    def _used_before(self, received: Received, own: ReplayCounter) -> Report:
        """Return the answer to an authentic packet whose counter is used up and whose own reports are not known."""
        number, last = received.counter, own.last
        if own.is_retired:
            text = f"key {received.spi} is retired"
        elif any((known.spi, known.counter) == (received.spi, number) for known in self._remembered):
            text = (
                f"not executed: counter {number} was used by another command, the last is {last}; "
                f"`ground key FILE --counter {last}`, then again"
            )
        else:
            text = (
                f"counter {number} was used before, by this command or another; the last is {last}, what became of it "
                f"is not known any more"
            )
        return self._report(received, "refused", text)

    def _poll_check(self) -> None:
        """Report how the check of the store ended, once it has."""
        if self._check_of_store is None:
            return
        received, check = self._check_of_store
        try:
            report = check.outcome()
        except FlightError as error:
            self._note(received, "failed", str(error))
        else:
            if report is None:
                return
            self._note(received, "completed", report.sentence())
        self._check_of_store = None

    def _check_arming(self, command: Command) -> None:
        armed, self._armed = self._armed, None  # whatever comes next disarms
        if not command.layout.armed:
            return
        if armed is None or armed[0] != command.name or self._clock_s() > armed[1]:
            raise ValueError(f"not armed: send `arm {command.name}` at most {DICTIONARY.arm_s} s before")

    def _check(self, received: Received, command: Command) -> None:
        """Refuse what is in range but makes no sense here.

        Raises:
            ValueError: says what.
        """
        values = command.arguments
        if command.name == "bracket":
            dataclasses.replace(self.settings, **values).bracket(self._mission)
        elif command.name in ("delete", "resend") and values["first_frame"] > values["last_frame"]:
            first, last = values["first_frame"], values["last_frame"]
            raise ValueError(f"expected the first number before the last, got {first} and {last}")
        elif command.name == "retire":
            if values["key"] == received.spi:
                raise ValueError(f"key {received.spi} would retire itself: seal this with the key that stays")
            if self._keys.of(values["key"]) is None:
                raise ValueError(f"there is no key {values['key']} on board")

    def _execute(self, received: Received, command: Command) -> str | None:
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
                    self._note(self.upload.command, "failed", f"replaced by command {received.counter}")
                self.upload = Upload(received, **values)
                return None
            case "arm":
                self._armed = (values["command"], self._clock_s() + DICTIONARY.arm_s)
                return f"{values['command']} is armed for {DICTIONARY.arm_s} s"
            case "delete":
                self._read_deletions()  # before they are written
                deletion = Deletion(received, values["first_frame"], values["last_frame"])
                frames = deletion.of(f.frame_id for f in self._store.frames)
                if not frames:
                    return "0 frames deleted"
                # none that is taken later: its number would be in the range too
                self._deletions.append(dataclasses.replace(deletion, last=max(frames), count=len(frames)))
                try:
                    self._keep_deletions()
                except StoreError:
                    self._deletions.pop()
                    raise
                return None
            case "retire":
                retired = self._keys.of(values["key"])
                assert retired is not None  # checked
                retired.advance(MAX_COUNTER)
                return f"key {retired.key} is retired"
            case "resend":
                count = self._store.put_back(values["first_frame"], values["last_frame"])
                return f"{counted(count, 'frame')} put into the outbox again"
            case "fsck":
                if self._check_of_store is not None:
                    raise StoreError(f"command {self._check_of_store[0].counter} checks the store already")
                self._check_of_store = (received, RunningCheck(self._store.folder))
                return None
            case "safe" | "resume":
                self._change(safe_mode=command.name == "safe")
                return "no exposures until resumed" if self.settings.safe_mode else "exposures go on"
        raise AssertionError(command.name)  # the dictionary has no other

    def _read_deletions(self) -> None:
        """Go on with what a run before has begun to delete, once the store is open."""
        if self._are_deletions_read or not self._store.is_open:
            return
        self._are_deletions_read = True
        path = self._store.folder / DELETIONS
        try:
            tree = read_twice(path, log.warning)
            begun = [Deletion.from_tree(each) for each in tree["deletions"]] if tree is not None else []
        except (OSError, ValueError, TypeError, KeyError) as error:
            log.error(
                "a deletion of the run before may be left half done, command it again: %s", in_words(error)
            )
            if not isinstance(error, OSError):
                for each in filter(Path.exists, (path, copy_of(path))):
                    with contextlib.suppress(OSError):  # it is said again after the next start
                        set_aside(each)
            return
        self._deletions.extendleft(reversed(begun))
        for deletion in begun:
            log.warning("the deletion of command %d goes on after a restart", deletion.command.counter)

    def _keep_deletions(self) -> None:
        """Note on the disk what is to be deleted.

        Raises:
            StoreError: the disk refuses.
        """
        path = self._store.folder / DELETIONS
        try:
            if self._deletions:
                tree = {"deletions": [deletion.tree() for deletion in self._deletions]}
                reserve = self._store.folder / RESERVE
                write_twice(path, tree, lambda file, data: write_with_reserve(file, data, reserve))
            else:
                for each in (path, copy_of(path)):
                    each.unlink(missing_ok=True)
        except OSError as error:
            raise StoreError(f"cannot note what is to be deleted: {in_words(error)}") from error

    def _change(self, **changes: object) -> None:
        settings: Settings = dataclasses.replace(self.settings, **changes)  # type: ignore[arg-type]
        save_settings(self._store.folder, settings)
        self.settings = settings

    def _note(self, received: Received, stage: str, text: str) -> None:
        report = self._report(received, stage, text)
        self._remembered.setdefault(received, []).append(report)
        if len(self._remembered) > REMEMBERED:
            self._remembered.popitem(last=False)
        self.reports.append(report)
        if stage in ENDED:
            log.info("command %d %s: %s", received.counter, stage, text)

    def _report(self, received: Received, stage: str, text: str) -> Report:
        return Report(self._utc_ns(), received.counter, received.digest, stage, text)

    def _refuse(self, problem: str) -> None:
        self.refused += 1
        self._on_refusal(problem)
