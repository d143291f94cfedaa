"""A session of the ground as a pass leaves it, and what must hold once one of its files is damaged (see flips.py).

It opens; records, session.json, pictures, telemetry, events, results and waiting commands are as they were, or are left
out and that is told; no counter of commands is used again; and once all frames were received again it is whole.
"""

import contextlib
import dataclasses
import json
import logging
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import imagecodecs
import numpy as np

from flightsw.icd.command import Command, Report
from flightsw.icd.frame import Frame, PoseTag, encode_frame
from flightsw.icd.link.auth import AuthError, Key, digest, unseal
from flightsw.icd.mission import ConfigError, Mission
from flightsw.icd.packet import APID_EVENTS, APID_HOUSEKEEPING, APID_REPORTS
from flightsw.icd.telemetry import DICTIONARY, Item
from ground.link.uplink import Uplinker, make_key, outcome, submit
from ground.session.check import damage
from ground.session.folder import LOGS, SessionError, open_session, read_header, read_log
from ground.session.telemetry import TelemetryLog
from ground.session.writer import SessionWriter
from ground.show.telemetry_plots import housekeeping_series
from obbgs_base.files import write_whole

FRAMES, SIZE_PX = 4, 24
NO_CONTENT = (".lock",)
PASS_UTC_NS = 1_784_631_150_000_000_000
EXPIRES_S = 1e6


def noise_frame(number: int) -> Frame:
    """Return a frame of noise with a pose, of the size of `small`."""
    source = np.random.default_rng(number)
    position = source.normal(size=3)
    pose = PoseTag(np.array([1.0, 0, 0, 0]), position, np.eye(6), np.array([0, 0, 1.0]), False, True, "sgp4")
    dn = source.integers(0, 4095, (SIZE_PX, SIZE_PX)).astype(np.uint16)
    return Frame(number, number // 3, number % 3, 3, 1e-4, PASS_UTC_NS + number, pose, dn, 12, 64.0, 0)


def small(mission: Mission) -> Mission:
    """Return the mission with a camera of a few pixels."""
    return dataclasses.replace(
        mission, camera=dataclasses.replace(mission.camera, width=SIZE_PX, height=SIZE_PX, channels=1)
    )


@dataclass(frozen=True)
class Kept:
    """What a session said before the damage."""

    header: dict[str, Any]
    frames: dict[int, str]  # the records as text
    logs: dict[str, list[dict[str, Any]]]
    series: dict[str, list[float]]
    ended: dict[str, Any]  # the result of the first command
    packet: bytes  # of the second one, which waits
    key: Key


def make_pass(root: Path, mission: Mission) -> Kept:
    """Write a session and a key as a pass leaves them in a folder; return what they say."""
    session, mission = root / "session", small(mission)
    key = make_key(root / "key")
    writer = SessionWriter(session, mission)
    log = TelemetryLog(session, utc_ns=lambda: PASS_UTC_NS)
    values = {item.name: _some_value(item, 0) for item in DICTIONARY.telemetry["housekeeping"].items}
    for number in range(FRAMES):
        writer.add(noise_frame(number), encode_frame(noise_frame(number)))
        filled = values | {"utc_ns": PASS_UTC_NS + number * 10**9, "frames_stored": number + 1}
        log.add(APID_HOUSEKEEPING, DICTIONARY.telemetry["housekeeping"].pack(**filled))
        log.add(APID_EVENTS, _event(number))
    (session / "thumbnails").mkdir()
    thumbnail = np.arange(64, dtype=np.uint16).reshape(8, 8)
    write_whole(session / "thumbnails" / "000000.png", bytes(imagecodecs.png_encode(thumbnail, level=1)))
    counters = [
        submit(session, root / "key", Command(name, {}), None, EXPIRES_S) for name in ("ping", "safe")
    ]
    uplinker = Uplinker(session, 1024, 0.1)
    packet = uplinker.next_command(0.0)
    assert packet is not None
    report = Report(PASS_UTC_NS, counters[0], digest(packet), "completed", "pong")
    log.add(APID_REPORTS, report.pack())
    uplinker.take_report(report, 0.0)
    waiting = uplinker.next_command(1.0)
    ended = outcome(session, counters[0])
    assert waiting is not None and ended is not None
    writer.save({"crc_errors": 3}, 4000, log.flight)
    return Kept(read_header(session), _frames(session), _logs(session), _series(session), ended, waiting, key)


def files_of(root: Path) -> list[Path]:
    """Return the files with content, relative to the folder."""
    files = [path for path in root.rglob("*") if path.is_file() and path.suffix not in NO_CONTENT]
    return sorted(path.relative_to(root) for path in files if path.stat().st_size)


@dataclass
class Told(logging.Handler):
    """Whether a warning or an error was logged."""

    lines: list[str] = field(default_factory=list)

    def __post_init__(self):
        super().__init__(logging.WARNING)

    def __hash__(self):
        return id(self)

    def emit(self, record: logging.LogRecord) -> None:
        self.lines.append(record.getMessage())


@contextlib.contextmanager
def listened() -> Iterator[list[str]]:
    """Give the warnings and errors that the ground logs meanwhile."""
    told, logger = Told(), logging.getLogger("ground")
    logger.addHandler(told)
    try:
        yield told.lines
    finally:
        logger.removeHandler(told)


def what_fails(root: Path, file: Path, mission: Mission, before: Kept) -> list[str]:
    """Read a session of which one file was damaged, go on with it, and return what does not hold."""
    wrong: list[str] = []
    with listened() as told:
        told += damage(root / "session", with_pictures=True)
        lacking = _read(root, file, before, wrong)
        lacking += _command(root, before, wrong)
        lacking += _go_on(root, file, small(mission), before, wrong)
    if lacking and not told:
        wrong.append(f"nothing was told of {', '.join(lacking)}")
    return wrong


def _read(root: Path, file: Path, before: Kept, wrong: list[str]) -> list[str]:
    """Compare what the session says with what it said; return what is lacking."""
    lacking, session = [], root / "session"
    try:
        opened, frames, header = open_session(session), _frames(session), read_header(session)
    except SessionError as error:
        wrong.append(f"the session does not open: {error}")
        return []
    if frames != before.frames:
        wrong.append("the frames' records are others")
    if header != before.header:
        wrong.append("session.json says something else")
    for record in opened.frames:
        try:
            if (opened.dn(record) != noise_frame(record.id).dn).any():
                wrong.append("a picture was altered")
        except SessionError:
            if file.name != f"{record.id:06d}.png" or file.parent.name != "frames":
                wrong.append("a whole picture cannot be read")
            lacking.append("a picture")
    for name, lines in _logs(session).items():
        if any(line not in before.logs[name] for line in lines):
            wrong.append(f"a line of {name} was altered")
        if len(lines) < len(before.logs[name]):
            lacking.append(f"lines of {name}")
    for name, values in _series(session).items():
        if any(value not in before.series[name] for value in values):
            wrong.append(f"{name} was altered")
    return lacking


def _command(root: Path, before: Kept, wrong: list[str]) -> list[str]:
    """Give a command and let the listener look for those that wait; return what is lacking."""
    lacking, session = [], root / "session"
    first = before.ended["counter"]
    try:
        if outcome(session, first) != before.ended:
            wrong.append("a command's result was altered")
    except SessionError:
        lacking.append("a command's result")
    jobs = _waiting(session)
    if jobs.get(first + 1, ("safe", before.packet)) != ("safe", before.packet):
        wrong.append("a waiting command was altered")
    if first + 1 not in jobs:
        lacking.append("a waiting command")
    try:
        counter = submit(session, root / "key", Command("resume", {}), None, EXPIRES_S)
    except ConfigError:  # which says what to do
        return lacking
    if counter <= first + 1:
        wrong.append("a counter is used again")
    with contextlib.suppress(AuthError):  # the spacecraft refuses a command with another key, and says so
        unseal(before.key, _waiting(session)[counter][1])
    return lacking


def _waiting(session: Path) -> dict[int, tuple[str, bytes]]:
    uplinker = Uplinker(session, 1024, 0.1)
    uplinker.next_command(0.0)
    return {job.counter: (job.given, job.packet) for job in uplinker.jobs.values()}


def _go_on(root: Path, file: Path, mission: Mission, before: Kept, wrong: list[str]) -> list[str]:
    """Receive all frames again and one more, then look whether the session is whole."""
    session = root / "session"
    try:
        writer = SessionWriter(session, mission)
        for number in range(FRAMES + 1):
            is_new = writer.add(noise_frame(number), encode_frame(noise_frame(number)))
            was_hurt = file.name == f"{number:06d}.png" and file.parent.name == "frames"
            if is_new != (number == FRAMES or was_hurt):
                wrong.append("a frame that is there is taken for new, or one that is not for there")
        writer.save({}, 0)
        opened = open_session(session)
        for record in opened.frames:
            if (opened.dn(record) != noise_frame(record.id).dn).any():
                wrong.append("a picture was altered")
    except SessionError as error:
        wrong.append(f"the session cannot be gone on with: {error}")
        return []
    if {number: text for number, text in _frames(session).items() if number < FRAMES} != before.frames:
        wrong.append("the frames' records are others after going on")
    left = [
        line
        for line in damage(session, with_pictures=True)
        if "thumbnails" not in line and "jsonl" not in line
    ]
    wrong += [f"still damaged after going on: {line}" for line in left]
    return []


def _frames(session: Path) -> dict[int, str]:
    return {r.id: json.dumps(vars(r), default=np.ndarray.tolist) for r in open_session(session).frames}


def _logs(session: Path) -> dict[str, list[dict[str, Any]]]:
    return {name: list(read_log(session / name)) for name in LOGS}


def _series(session: Path) -> dict[str, list[float]]:
    return {each.item.name: each.values.tolist() for each in housekeeping_series(session)}


def _event(number: int) -> bytes:
    layout = DICTIONARY.events["started"]
    return layout.pack(**{item.name: _some_value(item, number) for item in layout.items})


def _some_value(item: Item, number: int) -> Any:
    if item.states:
        return item.states[0][1]
    several = {"float64": (0.1, 0.2), "text": "", "bytes": bytes(item.count)}
    return several[item.kind] if "[" in item.type else number
