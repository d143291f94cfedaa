"""Flipped bits, zeroed and cut files of flight's store and the ground's session: python -m tests.benchmarks.flips

Each trial damages one file. Of a session, what must hold stands in ground_flips.py. A store is flown: the downlink
against a receiver in the same process on a clock of ours, or for some trials `flightsw downlink` as a process on a
pseudo-terminal. What must hold: telemetry comes within 10 s and the downlink never starts again; every waiting frame
whose container is intact arrives bit for bit, deleted and delivered ones do not; settings are as commanded, or safe; no
number and no exposure is used again, and frames can be stored; and damage to what is read is told in an event.
"""

import argparse
import hashlib
import json
import logging
import os
import random
import select
import shutil
import subprocess
import sys
import tempfile
import time
import tty
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from flightsw.downlink.housekeeping import EventLog
from flightsw.downlink.loop import run_downlink
from flightsw.errors import FlightError
from flightsw.icd.frame import Frame, PoseTag
from flightsw.icd.link.framing import PacketStream
from flightsw.icd.mission import Mission, load_mission
from flightsw.icd.packet import APID_EVENTS, APID_FILES, TELECOMMAND
from flightsw.icd.telemetry import DICTIONARY
from flightsw.icd.transfer import Receiver, timer_s
from flightsw.storage.boot_counter import count_boot
from flightsw.storage.settings import Settings, load_settings, save_settings
from flightsw.storage.store import FrameStore
from tests.benchmarks import ground_flips
from tests.benchmarks.rows import shown

COMMANDED = Settings("oldest", exposure_times_ms=(100.0, 200.0, 400.0), max_error_dn=1, safe_mode=True)
FRAMES, DELETED, DELIVERED, SIZE_PX = 5, 1, 2, 24
PASS_UTC_NS = 1_784_631_150_000_000_000
NO_CONTENT = ("lock", "reserve")  # files whose content means nothing
UP_WITHIN_S = 10.0
LIMIT_S = 30.0  # of one flight
BAUD_RATE = 3_000_000
CHUNK = 250  # trials between two notes of progress
KINDS = ("flipped bit", "zeroed file", "cut file")


def noise_frame(number: int) -> Frame:
    zero = np.zeros(3)
    pose = PoseTag(np.array([1.0, 0, 0, 0]), zero, np.zeros((6, 6)), zero, False, False, "none")
    dn = np.random.default_rng(number).integers(0, 4095, (SIZE_PX, SIZE_PX)).astype(np.uint16)
    return Frame(number, number // 3, number % 3, 3, 1e-4, PASS_UTC_NS + number, pose, dn, 12, 64.0, 0)


class Ground:
    """Receives files and events."""

    def __init__(self, mission: Mission):
        self.arrived: dict[str, str] = {}  # SHA-256 of each file
        self.told = False  # of damage
        self.first_packet_s: float | None = None
        self.problems: list[str] = []
        self._stream = PacketStream(TELECOMMAND, mission.link.max_packet_bytes)
        self._receiver = Receiver(
            self._stream.max_data_bytes, timer_s(BAUD_RATE), self._accept, checksum=mission.link.checksum
        )

    def take(self, data: bytes, now_s: float) -> bytes:
        """Take bytes from the wire and return the answers to them."""
        for apid, content in self._stream.decode(data):
            if self.first_packet_s is None:
                self.first_packet_s = now_s
            if apid == APID_FILES:
                self._receiver.receive(content, now_s)
            elif apid == APID_EVENTS:
                self.told |= DICTIONARY.unpack("events", content)[0].severity in ("warning", "error")
        answers = []
        while (pdu := self._receiver.next_pdu(now_s)) is not None:
            answers.append(self._stream.encode(APID_FILES, pdu))
        return b"".join(answers)

    def has(self, digests: dict[str, str]) -> bool:
        return digests.items() <= self.arrived.items()

    def _accept(self, name: str, content: bytes) -> bool:
        digest = hashlib.sha256(content).hexdigest()
        if self.arrived.setdefault(name, digest) != digest:
            self.problems.append(f"{name} came as two files")
        return True


class GroundLink:
    """Flight's end of a wire to the ground, both on one clock."""

    baud_rate = BAUD_RATE
    bytes_read = bytes_written = hang_ups = 0
    connected = ready = True

    def __init__(self, ground: Ground):
        self.now_s = 0.0
        self.losses: dict[str, int] = {}
        self._ground, self._answers = ground, b""

    def write(self, data: bytes) -> None:
        self._answers += self._ground.take(data, self.now_s)

    def exchange(self, timeout_s: float) -> bytes:
        self.now_s += timeout_s + 0.001
        answers, self._answers = self._answers, b""
        return answers + self._ground.take(b"", self.now_s)

    def close(self) -> None: ...

    def __enter__(self):
        return self

    def __exit__(self, *_: object) -> None: ...


def make_store(folder: Path) -> dict[int, str]:
    """Make a store as a pass leaves it; return the digests of the frames that wait."""
    store = FrameStore(folder)
    store.hold_pass(PASS_UTC_NS)
    for number in range(FRAMES):
        store.put(noise_frame(number))
    store.drop(DELETED)
    store.mark_delivered(DELIVERED)
    save_settings(folder, COMMANDED)
    count_boot(folder)
    assert store.identity and store.next_transaction() >= 0
    return {frame.frame_id: frame.sha256 for frame in store.frames if frame.frame_id != DELIVERED}


def files_of(folder: Path) -> list[Path]:
    """Return the files with content, relative to the folder."""
    files = [path for path in folder.rglob("*") if path.is_file() and path.name not in NO_CONTENT]
    return sorted(path.relative_to(folder) for path in files if path.stat().st_size)


def damaged(content: bytes, kind: str, source: random.Random) -> bytes:
    if kind == "zeroed file":
        return bytes(len(content))
    if kind == "cut file":  # by more than the last line feed, without which nothing is missing
        return content[: source.randrange(len(content) - 1)]
    bit = source.randrange(8 * len(content))
    flipped = bytearray(content)
    flipped[bit // 8] ^= 1 << bit % 8
    return bytes(flipped)


def fly_here(folder: Path, mission: Mission, wanted: dict[str, str]) -> tuple[Ground, list[str]]:
    """Run the downlink in this process; return what the ground received and what went wrong."""
    ground, events, logger = Ground(mission), EventLog(), logging.getLogger("flightsw")
    link, store = GroundLink(ground), FrameStore(folder, open_now=False)
    logger.addHandler(events)  # from before the store is opened
    done = run_downlink(
        store,
        link,
        mission,
        clock_s=lambda: link.now_s,
        boot=count_boot(folder),
        events=events,
        should_stop=lambda: link.now_s > LIMIT_S or (link.now_s > 1.0 and ground.has(wanted)),
    )
    return ground, [f"{done.restarts} restarts"] if done.restarts else []


def fly_process(folder: Path, mission_file: Path, wanted: dict[str, str]) -> tuple[Ground, list[str]]:
    """Run `flightsw downlink` as a process; return what the ground received and what went wrong."""
    ground, (master, slave) = Ground(load_mission(mission_file)), os.openpty()
    tty.setraw(slave)
    link = f"serial://{os.ttyname(slave)}?baud={BAUD_RATE}"
    command = [sys.executable, "-m", "flightsw.cli", "downlink", "--link", link, "--store", str(folder)]
    started_s = time.monotonic()
    flight = subprocess.Popen([*command, "--mission", str(mission_file)], stderr=subprocess.DEVNULL)
    problems = []
    try:
        while (now_s := time.monotonic() - started_s) < LIMIT_S and not ground.has(wanted):
            data = os.read(master, 65_536) if select.select([master], [], [], 0.02)[0] else b""
            if answers := ground.take(data, now_s):
                os.write(master, answers)
            if flight.poll() is not None:
                problems.append(f"flight ended with exit code {flight.returncode}")
                break
    finally:
        flight.terminate()
        flight.wait(30)
        for descriptor in (master, slave):
            os.close(descriptor)
    return ground, problems


def what_fails(
    folder: Path, file: Path, mission_file: Path, digests: dict[int, str], as_process: bool
) -> list[str]:
    """Fly a store of which one file was damaged, and return what does not hold."""
    mission = load_mission(mission_file)
    hurt = int(file.stem) if file.suffix == ".obf" else None
    wanted = {f"{number:08d}.obf": digest for number, digest in digests.items() if number != hurt}
    fly = fly_process if as_process else fly_here
    ground, wrong = fly(folder, mission_file if as_process else mission, wanted)  # type: ignore[arg-type]
    wrong += ground.problems
    if ground.first_packet_s is None or ground.first_packet_s > UP_WITHIN_S:
        wrong.append("the link is not up in time")
    frames = {name: digest for name, digest in ground.arrived.items() if name.endswith(".obf")}
    wrong += [f"{name} did not arrive as it was" for name in wanted if frames.get(name) != wanted[name]]
    wrong += [f"{name} came again" for name in frames.keys() - {f"{n:08d}.obf" for n in digests}]
    later, logger = EventLog(), logging.getLogger("flightsw")
    logger.addHandler(later)
    try:
        store = FrameStore(folder)
        if (store.next_frame_id, store.holds(DELETED // 3, DELETED % 3)) != (FRAMES, True):
            wrong.append("a number or an exposure is used again")
        store.hold_pass(PASS_UTC_NS)
        store.put(noise_frame(FRAMES))
    except FlightError as error:
        wrong.append(f"no more frames can be stored: {error}")
    settings = load_settings(folder, mission)
    logger.removeHandler(later)
    # nobody reads a frame again that was delivered
    told = ground.told or later.take() is not None or hurt == DELIVERED
    if settings != COMMANDED and not settings.safe_mode:
        wrong.append(f"settings became {settings}")
    return wrong if told else [*wrong, "nothing was told"]


@dataclass(frozen=True)
class Case:
    """One way of damage to the files of one side; trials in one process, or each as a process of its own."""

    side: str  # flight or ground
    kind: str
    trials: int
    as_process: bool = False

    @property
    def condition(self) -> str:
        return f"{self.kind}, {self.side}, {'as processes' if self.as_process else 'in one process'}"


def measure(case: Case, first: int, trials: int, mission_file: Path) -> dict[str, Any]:
    """Return the row of some trials of a case, seeded by their numbers, over all files in turn.

    Its `failures` say what did not hold, and how often.
    """
    failures: Counter[str] = Counter()
    mission = load_mission(mission_file)
    with tempfile.TemporaryDirectory(dir="/dev/shm" if os.path.isdir("/dev/shm") else None) as scratch:
        made = Path(scratch) / "made"
        made.mkdir()
        if case.side == "flight":
            digests = make_store(made)
            files = files_of(made)
        else:
            kept = ground_flips.make_pass(made, mission)
            files = ground_flips.files_of(made)
        started_s, failed = time.monotonic(), 0
        for number in range(first, first + trials):
            file, copy = files[number % len(files)], Path(scratch) / str(number)
            shutil.copytree(made, copy)
            source = random.Random(f"{case.condition} {number}")
            (copy / file).write_bytes(damaged((made / file).read_bytes(), case.kind, source))
            if case.side == "flight":
                wrong = what_fails(copy, file, mission_file, digests, case.as_process)
            else:
                wrong = ground_flips.what_fails(copy, file, mission, kept)
            failed += bool(wrong)
            failures.update(f"{case.condition}, {file}, trial {number}: {problem}" for problem in wrong)
            shutil.rmtree(copy)
    return {
        "condition": case.condition,
        "first": first,
        "trials": trials,
        "trials_failed": failed,
        "files": len(files),
        "seconds": round(time.monotonic() - started_s, 1),
        "failures": failures,
    }


def main() -> int:
    parser = argparse.ArgumentParser(description="Flipped bits, zeroed and cut files of flight and ground.")
    parser.add_argument("--json", action="store_true", help="one JSON object a row")
    parser.add_argument(
        "--flips", type=int, default=10_000, help="trials with a flipped bit, half on each side"
    )
    parser.add_argument(
        "--files", type=int, default=1_000, help="trials with a zeroed or a cut file, a quarter each of both"
    )
    parser.add_argument(
        "--processes", type=int, default=30, help="trials of flight's process with a flipped bit"
    )
    parser.add_argument(
        "--progress", type=Path, help="file to note what is done, so that another start goes on"
    )
    parser.add_argument(
        "--minutes", type=float, default=float("inf"), help="begin no more trials after so many"
    )
    arguments = parser.parse_args()
    for name in ("flightsw", "ground"):
        logging.getLogger(name).propagate = False
        logging.getLogger(name).addHandler(logging.NullHandler())
    sides = ("ground", "flight")
    cases = [Case("flight", KINDS[0], arguments.processes, True)]
    cases += [Case(side, kind, arguments.files // 4) for kind in KINDS[1:] for side in sides]
    cases += [Case(side, KINDS[0], arguments.flips // 2) for side in sides]
    done = _noted(arguments.progress)
    end_s = time.monotonic() + 60 * arguments.minutes
    with tempfile.TemporaryDirectory() as folder:
        mission_file = Path(folder) / "mission.yaml"
        text = Path("mission.yaml").read_text()
        mission_file.write_text(text.replace("link:\n", "link:\n  priority: oldest\n"))
        for first in range(0, max(case.trials for case in cases), CHUNK):  # all cases go on alike
            for case in cases:
                trials = min(CHUNK, case.trials - first)
                if trials <= 0 or (case.condition, first) in done or time.monotonic() > end_s:
                    continue
                row = measure(case, first, trials, mission_file)
                done[case.condition, first] = row
                for problem, count in row["failures"].items():
                    print(f"{count} times: {problem}", file=sys.stderr, flush=True)
                if arguments.progress:
                    with open(arguments.progress, "a") as file:
                        file.write(json.dumps(row) + "\n")
    rows = [_total([row for (name, _), row in done.items() if name == case.condition]) for case in cases]
    for row in filter(None, rows):
        print(shown(row, "flips", arguments.json), flush=True)
    return 1 if any(row["trials_failed"] for row in filter(None, rows)) else 0


def _noted(progress: Path | None) -> dict[tuple[str, int], dict[str, Any]]:
    if progress is None or not progress.exists():
        return {}
    rows = [json.loads(line) for line in progress.read_text().splitlines()]
    return {(row["condition"], row["first"]): row for row in rows}


def _total(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Return one row for all trials of a case; {} without any."""
    if not rows:
        return {}
    summed = {name: sum(row[name] for row in rows) for name in ("trials", "trials_failed")}
    summed["seconds"] = round(sum(row["seconds"] for row in rows), 1)
    return {"condition": rows[0]["condition"], "files": rows[0]["files"]} | summed


if __name__ == "__main__":
    sys.exit(main())
