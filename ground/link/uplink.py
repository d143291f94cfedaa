"""Commands to the spacecraft: encrypted and authenticated by `ground uplink`, sent by `ground listen`.

`ground uplink` seals a command (AES-GCM), so that only it needs the key, and leaves it in the session's folder uplink/
as NUMBER.json, where NUMBER is the command's counter; the sealed file of a model lies beside it as NUMBER.bin. The
listener has the port: it sends commands in the order of their counters, repeats each until the spacecraft reports its
result, and writes that to NUMBER.done.json. The session's commands.jsonl has a line for each command that ended: one
history, whoever sent them. For how long a command may be sent is elapsed time, whatever this computer's clock says.
"""

import contextlib
import fcntl
import hashlib
import logging
import os
import re
import secrets
import shlex
import stat
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from flightsw.icd.command import ENDED, Command, Report, model_file_name
from flightsw.icd.link.auth import MAX_COUNTER, Key, digest, seal, seal_file
from flightsw.icd.mission import Checksum, ConfigError
from flightsw.icd.model_file import MAX_MODEL_BYTES, ModelUnfit, check_for_triage
from flightsw.icd.transfer import UPLINK, Sender
from ground.session.folder import SessionError
from ground.session.telemetry import plain
from obbgs_base.checked import checked_line, copy_of, each_copy, parse_line, read_twice, write_twice
from obbgs_base.errors import reason
from obbgs_base.files import append_line, write_whole

log = logging.getLogger(__name__)
JOB_NAME = re.compile(r"(\d{20})\.json", re.ASCII)
MAX_JOB_BYTES = 64 * 1024  # of a command file
COUNTER_MARGIN = 1 << 20  # that `move_counter` leaves for commands that were sent and never arrived
BOOT_ID = Path("/proc/sys/kernel/random/boot_id")  # elapsed time counts from this start of the computer
LAST_FRAME = (1 << 32) - 1
HISTORY = "commands.jsonl"
EXAMPLES = {  # of the commands that take arguments
    "bracket": "bracket 0.02,0.05,0.1",
    "near": "near 2",
    "priority": "priority oldest",
    "model": "model pass-12/runs/first/model.onnx",
    "arm": "arm delete` or `arm resume` or `arm retire",
    "delete": "delete 0 39",
    "resend": "resend 0 39` or `resend all",
    "retire": "retire 1",
}
POLL_S = 0.2  # between looks at the folder
LOCK_TRIES = 5  # to become the session's listener
RESEND_INTERVALS = 2  # timer intervals before an unanswered command is sent again
DAMAGED = (ValueError, KeyError, TypeError, OverflowError, RecursionError)  # a command file
RESULT_INTERVALS = 4  # the same for a command without a result; the spacecraft repeats its reports
NS = 1_000_000_000


def make_key(path: Path, spi: int = 1) -> Key:
    """Write a new key and the counters of both sides beside it: PATH, PATH.sent and PATH.received.

    Raises:
        ConfigError: one of the files exists already, or the folder cannot be written; nothing is left behind.
    """
    key, made = Key(spi, secrets.token_bytes(32)), list[Path]()
    try:
        for suffix, text in (
            (".sent", key.counter_text(0)),
            (".received", key.counter_text(0)),
            ("", key.text),
        ):
            part = path.with_name(path.name + suffix)
            with open(os.open(part, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w") as file:
                made.append(part)
                file.write(text)
    except OSError as error:
        for part in made:
            part.unlink(missing_ok=True)
        if not isinstance(error, FileExistsError):
            raise ConfigError(str(path), f"cannot write the key: {reason(error)}") from error
        raise ConfigError(str(error.filename), "exists already; a key is never overwritten") from error
    return key


def move_counter(path: Path, last_used: int) -> int:
    """Move the ground's counter of a key forward, past one that was used already; return the new one.

    It never goes back, and may be lost or damaged. `COUNTER_MARGIN` beyond what is known are left unused, so that none
    is used again that was given to a command which never arrived: a counter that is used twice gives the key away.

    Args:
        last_used: such as the spacecraft says in a report, or as `command_counter` in its housekeeping.

    Raises:
        ConfigError: the key cannot be read, the counter cannot be written, or there are none beyond it.
    """
    try:
        with _locked_counter(path) as sent:
            key = Key.parse(path.read_text(), str(path))
            counters, _ = each_copy(sent, lambda text: key.parse_counter(text, str(sent)))
            counter = max([last_used, *counters]) + COUNTER_MARGIN
            if counter >= MAX_COUNTER:
                raise ConfigError(
                    "--counter", f"expected less than {MAX_COUNTER - COUNTER_MARGIN}, got {last_used}"
                )
            _keep_counter(sent, key, counter, path)
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(str(path), f"cannot use the key and its counter: {reason(error)}") from error
    return counter


def parse_command(name: str, arguments: list[str]) -> tuple[Command, Path | None]:
    """Return the command that a command line asks for, and the model file of `model`.

    Raises:
        ValueError: no such command, or not its arguments, or one out of range; the message repeats what was given.
    """
    given = " ".join([name, *arguments])
    try:
        command, model = _parsed(name, arguments)
        if model is None:
            command.pack()
    except ValueError as error:
        raise ValueError(f"`{given}`: {error}") from error
    return command, model


def _parsed(name: str, arguments: list[str]) -> tuple[Command, Path | None]:
    match name, arguments:
        case "ping" | "safe" | "resume" | "fsck", []:
            return Command(name, {}), None
        case "bracket", [times]:
            return Command(
                name, {"exposure_times_ms": tuple(_number(t, float) for t in times.split(","))}
            ), None
        case "near", [near]:
            return Command(name, {"near": _number(near, int)}), None
        case "priority", [order]:
            return Command(name, {"order": order}), None
        case "model", [file]:
            return Command(name, {}), Path(file)
        case "arm", [command]:
            return Command(name, {"command": command}), None
        case "resend", ["all"]:
            return Command(name, {"first_frame": 0, "last_frame": LAST_FRAME}), None
        case "delete" | "resend", [first, last]:
            frames = {"first_frame": _number(first, int), "last_frame": _number(last, int)}
            if frames["first_frame"] > frames["last_frame"]:
                raise ValueError("expected the number of the first frame before that of the last")
            return Command(name, frames), None
        case "retire", [key]:
            return Command(name, {"key": _number(key, int)}), None
    Command(name, {})  # refused where there is none of this name
    example = EXAMPLES.get(name)
    raise ValueError(f"expected `{example}`" if example else "expected no arguments")


def parse_script(text: str) -> list[tuple[Command, Path | None]]:
    """Return the commands of a script: one a line as on the command line; empty lines and those after # count nothing.

    Raises:
        ValueError: a line is no command, or its arguments are out of range; the message has its number.
    """
    commands = []
    for number, line in enumerate(text.splitlines(), start=1):
        try:
            if words := shlex.split(line, comments=True):
                commands.append(parse_command(words[0], words[1:]))
                _, model = commands[-1]
                if model is not None and not model.is_file():
                    raise ValueError(f"{model} is no file")
        except ValueError as error:
            raise ValueError(f"line {number} of the script: {error}") from error
    if not commands:
        raise ValueError("the script holds no command; expected one a line, such as `bracket 0.05,0.1`")
    return commands


def in_words(command: Command, model: Path | None) -> str:
    """Return a command as a person gives it, such as `bracket 0.05,0.1`."""
    values = command.arguments.values() if model is None else (model,)
    texts = [",".join(f"{x:g}" for x in v) if isinstance(v, tuple) else str(v) for v in values]
    return " ".join([command.name, *texts])


def _number(text: str, kind: type) -> Any:
    try:
        return kind(text)
    except ValueError as error:
        expected = "a whole number" if kind is int else "a number"
        raise ValueError(f"expected {expected}, got {text!r}") from error


def submit(session: Path, key_file: Path, command: Command, model: Path | None, expires_s: float) -> int:
    """Seal a command and leave it for the listener; return its counter.

    The counter is on disk before the sealed command, so that no counter is ever used for two commands.

    Args:
        command: the arguments of `model` are made here from its file.
        expires_s: how long from now it may be sent; a model's file that is under way by then is sent to its end.

    Raises:
        ConfigError: the key, its counter or the model file cannot be used.
        ValueError: an argument is out of range.
        SessionError: the session folder cannot be written.
    """
    content, given = b"", in_words(command, model)
    if model is not None:
        content, command = _model_command(model)
    packed = command.pack()  # it may be invalid, and should not use up a counter then
    expires_ns = time.monotonic_ns() + int(expires_s * NS)
    folder = session / "uplink"
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        with _next_counter(key_file, folder) as (key, counter):
            if content:
                file_key = command.arguments["file_key"]
                write_whole(folder / f"{counter:020d}.bin", seal_file(file_key, content))
            job = {
                "command": command.name,
                "given": given,
                "packet": seal(key, counter, packed).hex(),
                "boot": _boot_id(),
                "expires_ns": expires_ns,
            }
            write_whole(folder / f"{counter:020d}.json", checked_line(job))
    except OSError as error:
        raise SessionError(f"cannot leave the command in {folder}: {reason(error)}") from error
    return counter


def check_model(model: Path) -> None:
    """Look whether the spacecraft could use a model file, before it goes up.

    Raises:
        ConfigError: it cannot be read, or is no model of a run.
    """
    try:
        check_for_triage(model.read_bytes())
    except OSError as error:
        raise ConfigError(str(model), f"cannot read the model: {reason(error)}") from error
    except ModelUnfit as error:
        raise ConfigError(str(model), f"{error}; expected a run's model.onnx") from error


def _model_command(model: Path) -> tuple[bytes, Command]:
    try:
        content = model.read_bytes()
    except OSError as error:
        raise ConfigError(str(model), f"cannot read the model: {reason(error)}") from error
    if not 0 < len(content) <= MAX_MODEL_BYTES:
        raise ConfigError(
            str(model),
            f"has {len(content):,} bytes and the spacecraft accepts 1 to {MAX_MODEL_BYTES:,}; `ground reconstruct` "
            "makes a smaller model with a smaller --budget",
        )
    arguments = {
        "size_bytes": len(content),
        "sha256": hashlib.sha256(content).digest(),
        "file_key": secrets.token_bytes(32),
    }
    return content, Command("model", arguments)


@contextlib.contextmanager
def _next_counter(key_file: Path, folder: Path) -> Iterator[tuple[Key, int]]:
    """Give the key and a counter that was never used before; a lock keeps other processes out meanwhile.

    One that names files of another key's command in the folder is passed over.
    """
    try:
        with _locked_counter(key_file) as sent:
            key = Key.parse(key_file.read_text(), str(key_file))
            counters, problems = each_copy(sent, lambda text: key.parse_counter(text, str(sent)))
            if not counters:
                raise ConfigError(
                    str(sent),
                    f"the counter cannot be used ({problems[0]}); `ground key {key_file} --counter N` makes it anew, "
                    "with N from `command_counter` in the newest housekeeping",
                )
            counter = max(counters) + 1
            while any((folder / f"{counter:020d}{suffix}").exists() for suffix in (".json", ".done.json")):
                counter += 1
            if counter >= MAX_COUNTER:
                raise ConfigError(str(sent), "is at its end: make another key with `ground key`")
            _keep_counter(sent, key, counter, key_file)
            yield key, counter
    except (FileNotFoundError, PermissionError, UnicodeDecodeError) as error:
        raise ConfigError(str(key_file), f"cannot use the key and its counter: {reason(error)}") from error


@contextlib.contextmanager
def _locked_counter(key_file: Path) -> Iterator[Path]:
    """Give the file of the ground's counter while no other process has it."""
    key_file.stat()  # without a key nothing is left beside it
    sent = key_file.with_name(key_file.name + ".sent")
    with open(sent.with_name(sent.name + ".lock"), "wb") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield sent


def _keep_counter(sent: Path, key: Key, counter: int, key_file: Path) -> None:
    """Write the ground's counter and its copy; a new file can be read by those who can read the key."""
    for each in (sent, copy_of(sent)):
        write_whole(each, key.counter_text(counter).encode(), like=key_file)


def _boot_id() -> str:
    return BOOT_ID.read_text().strip()


def outcome(session: Path, counter: int) -> dict[str, Any] | None:
    """Return a command's result (stage, text, reports); None while it has none.

    Raises:
        SessionError: it and its copy are damaged, or cannot be read.
    """
    path = session / "uplink" / f"{counter:020d}.done.json"
    try:
        return read_twice(path, lambda problem: log.warning("%s", problem), mend=False)
    except (OSError, ValueError) as error:
        raise SessionError(f"the result of command {counter} cannot be read: {reason(error)}") from error


def note_end(session: Path, done: dict[str, Any], utc_ns: int) -> None:
    """Add the end of a command, as `outcome` has it, to the session's history; a disk that refuses it is logged."""
    line = {"ended_utc_ns": utc_ns} | {name: done[name] for name in ("counter", "given", "stage", "text")}
    try:
        append_line(session / HISTORY, checked_line(line))
    except OSError as error:
        log.error(
            "the end of command %d is missing in %s: %s", done["counter"], session / HISTORY, reason(error)
        )


def is_waiting(session: Path, counter: int) -> bool:
    """Return whether a command has no result yet, and was not withdrawn."""
    return (session / "uplink" / f"{counter:020d}.json").exists()


def was_sent(session: Path, counter: int) -> bool:
    """Return whether a listener has sent a command that has no result and was not withdrawn."""
    return (session / "uplink" / f"{counter:020d}.sent").exists()


def withdraw(session: Path, counter: int) -> None:
    """Take back a command; one that has been sent already may still be executed."""
    for suffix in (".json", ".bin", ".sent"):
        (session / "uplink" / f"{counter:020d}{suffix}").unlink(missing_ok=True)


@contextlib.contextmanager
def listening(session: Path) -> Iterator[None]:
    """Hold the lock by which only one process listens into a session.

    Raises:
        SessionError: another process listens, or the folder cannot be made.
    """
    with contextlib.ExitStack() as opened:
        try:
            session.mkdir(parents=True, exist_ok=True)
            lock = opened.enter_context(open(session / "listener.lock", "wb"))
        except OSError as error:
            raise SessionError(f"cannot write the session {session}: {reason(error)}") from error
        for tried in range(LOCK_TRIES):
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError as error:
                if tried == LOCK_TRIES - 1:
                    raise SessionError(f"another process listens into {session}") from error
                time.sleep(0.02)  # `is_listening` of another process holds the lock for a moment
        yield


def is_listening(session: Path) -> bool:
    """Tell whether a process listens into a session."""
    try:
        with open(session / "listener.lock", "rb") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except FileNotFoundError:
        return False
    except BlockingIOError:
        return True
    except OSError as error:
        raise SessionError(
            f"cannot tell whether a process listens into {session}: {reason(error)}"
        ) from error
    return False


@dataclass
class Job:
    """A command without a result yet."""

    counter: int
    command: str
    given: str  # the command with its arguments
    packet: bytes
    expires_ns: int  # of the elapsed time
    file: bytes | None
    file_put: bool = False
    next_send_s: float = float("-inf")
    reports: list[Report] = field(default_factory=list)

    @property
    def stage(self) -> str:
        return self.reports[-1].stage if self.reports else "waiting"


class Uplinker:
    """The listener's side: gives packets to send, takes reports, writes results. It has no port and no clock.

    What lies in the folder for commands, or that it cannot be read, is logged once and never raised.
    """

    def __init__(
        self,
        session: Path,
        max_pdu_bytes: int,
        interval_s: float,
        on_end: Callable[[int, str, str, str], None] = lambda counter, command, stage, text: None,
        utc_ns: Callable[[], int] = time.time_ns,
        checksum: Checksum = "crc-32",
        elapsed_ns: Callable[[], int] = time.monotonic_ns,
    ):
        self.jobs: dict[int, Job] = {}
        self.files = Sender(max_pdu_bytes, interval_s, route=UPLINK, checksum=checksum)
        self._folder, self._on_end, self._utc_ns = session / "uplink", on_end, utc_ns
        self._interval_s, self._max_packet_bytes = interval_s, max_pdu_bytes
        self._elapsed_ns, self._boot = elapsed_ns, _boot_id()
        self._left_alone: set[int] = set()  # counters of files that could not be read, or not be removed
        self._is_unreadable = False
        self._next_poll_s = float("-inf")

    @property
    def is_sending_file(self) -> bool:
        return bool(self.files.in_flight)

    def next_command(self, now_s: float) -> bytes | None:
        """Return a sealed command that is due, None if none is: the first unanswered one, or one without a result."""
        if now_s >= self._next_poll_s:
            self._next_poll_s = now_s + POLL_S
            self._poll()
        for counter in sorted(self.jobs):
            job = self.jobs[counter]
            if now_s >= job.next_send_s and not (job.file_put and self.is_sending_file):
                intervals = RESULT_INTERVALS if job.reports else RESEND_INTERVALS
                job.next_send_s = now_s + intervals * self._interval_s
                with contextlib.suppress(OSError):  # a full disk keeps no command from being sent
                    (self._folder / f"{counter:020d}.sent").touch()
                return job.packet
            if not job.reports:
                return None  # counters must arrive in order
        return None

    def next_pdu(self, now_s: float) -> bytes | None:
        """Return the next PDU of a model file whose command the spacecraft has accepted; None if none is due."""
        for job in self.jobs.values():
            if job.file is not None and job.reports and not job.file_put:
                job.file_put = True
                self.files.put(model_file_name(job.counter), job.file, job.counter % (1 << 32), now_s)
        pdu = self.files.next_pdu(now_s)
        for ended in self.files.outcomes():
            if not ended.delivered:
                log.warning("%s: transfer failed (%s)", ended.name, ended.reason)
                for job in list(self.jobs.values()):
                    if model_file_name(job.counter) == ended.name:
                        self._end(job, "failed", f"the file did not arrive: {ended.reason}")
        return pdu

    def take_report(self, report: Report, report_s: float) -> None:
        """Take a report of the spacecraft; one on a packet that is not ours is ignored."""
        job = self.jobs.get(report.counter)
        if job is None or report.digest != digest(job.packet):
            return
        if any(report.stage == known.stage for known in job.reports):
            return
        job.reports.append(report)
        job.next_send_s = report_s + RESULT_INTERVALS * self._interval_s
        if report.stage in ENDED:
            self._end(job, report.stage, report.text)

    def _poll(self) -> None:
        try:
            names = os.listdir(self._folder) if self._folder.is_dir() else []
        except OSError as error:
            if not self._is_unreadable:
                log.error(
                    "no command is taken from %s, where this user may not look: %s",
                    self._folder,
                    reason(error),
                )
            self._is_unreadable = True
            names = [f"{counter:020d}.json" for counter in self.jobs]  # as far as is known
        else:
            self._is_unreadable = False
        counters = {int(match[1]) for match in map(JOB_NAME.fullmatch, names) if match}
        self._left_alone &= counters
        for counter in counters - set(self.jobs) - self._left_alone:
            try:
                self.jobs[counter] = self._read(counter)
            except OSError as error:  # perhaps another user's
                log.error("command %d cannot be read and is not sent: %s", counter, reason(error))
                self._left_alone.add(counter)
            except DAMAGED as error:
                log.error("command %d is damaged: %s", counter, error)
                self._remove(counter)
        for counter, job in list(self.jobs.items()):
            if counter not in counters:
                del self.jobs[counter]  # withdrawn
            elif self._elapsed_ns() > job.expires_ns and model_file_name(counter) not in self.files.in_flight:
                still = f"still {job.stage} when its time was up; give more by --timeout"
                self._end(job, "failed", still if job.reports else "no answer in time")

    def _read(self, counter: int) -> Job:
        tree = parse_line(_content(self._folder / f"{counter:020d}.json", MAX_JOB_BYTES))
        file = self._folder / f"{counter:020d}.bin"
        content = _content(file, 2 * MAX_MODEL_BYTES) if file.exists() else None
        packet = bytes.fromhex(tree["packet"])
        if not 0 < len(packet) <= self._max_packet_bytes:
            raise ValueError(f"its packet has {len(packet)} bytes")
        name = str(tree["command"])
        expires_ns = int(tree["expires_ns"])
        if tree["boot"] != self._boot:
            log.warning("command %d was left before this computer started, or by another one", counter)
            expires_ns = 0
        return Job(counter, name, str(tree.get("given", name)), packet, expires_ns, content)

    def _remove(self, counter: int) -> None:
        """Remove a command's files; one that stays, since the folder does not let go of it, is not looked at again."""
        for suffix in (".json", ".bin", ".sent"):
            try:
                (self._folder / f"{counter:020d}{suffix}").unlink(missing_ok=True)
            except OSError as error:
                log.error("the files of command %d cannot be removed: %s", counter, reason(error))
                self._left_alone.add(counter)

    def _end(self, job: Job, stage: str, text: str) -> None:
        done = {
            "counter": job.counter,
            "command": job.command,
            "given": job.given,
            "stage": stage,
            "text": text,
            "reports": [plain(vars(report)) for report in job.reports],
        }
        name = f"{job.counter:020d}"
        note_end(self._folder.parent, done, self._utc_ns())
        try:
            write_twice(self._folder / f"{name}.done.json", done)
        except OSError as error:
            log.error("the end of command %d cannot be written: %s", job.counter, reason(error))
        self._remove(job.counter)
        self.jobs.pop(job.counter, None)
        self._on_end(job.counter, job.command, stage, text)


def _content(path: Path, max_bytes: int) -> bytes:
    """Return a file's content; nothing that lies under its name makes this wait.

    Raises:
        OSError: it cannot be read, or is no ordinary file.
        ValueError: it is larger.
    """
    with open(path, "rb", opener=lambda name, flags: os.open(name, flags | os.O_NONBLOCK)) as file:
        facts = os.fstat(file.fileno())
        if not stat.S_ISREG(facts.st_mode):
            raise OSError(f"{path.name} is no ordinary file")
        if facts.st_size > max_bytes:
            raise ValueError(f"expected at most {max_bytes:,} bytes, got {facts.st_size:,}")
        return file.read(max_bytes)
