"""Trials of the link: flight and ground as separate processes over a virtual link with faults, every frame compared.

Cuts, kills and full disks happen at seeded moments of the pass, counted in frames that the ground has received.
"""

import contextlib
import errno
import hashlib
import json
import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from flightsw.icd.frame import Frame, PoseTag, decode_frame, encode_frame
from flightsw.storage.store import FrameStore
from ground.session.folder import open_session
from hil.links.faults import Faults
from hil.links.virtual_can import VirtualCan
from hil.links.virtual_link import VirtualLink
from hil.links.virtual_serial import VirtualSerial
from hil.processes import tied

POLL_S = 0.01
FULL_S = 3.0  # how long a disk stays full
CAPTURE = """
import sys, time
from pathlib import Path
from flightsw.errors import StoreError
from flightsw.icd.frame import decode_frame
from flightsw.storage.store import FrameStore
for path in sorted(Path(sys.argv[2]).iterdir()):
    frame = decode_frame(path.read_bytes())
    while True:
        try:
            store = FrameStore(Path(sys.argv[1]))
            if frame.frame_id == store.next_frame_id:
                store.put(frame)
            break
        except StoreError:
            time.sleep(0.1)
"""


def noise_containers(count: int, size_px: int) -> list[bytes]:
    """Return frame containers of 12-bit noise, numbered from 0: 1.6 bytes a pixel, nothing to compress."""
    pose = PoseTag(
        quat_body_to_camera=np.array([1.0, 0, 0, 0]),
        position_body_m=np.array([0.0, 0, -400]),
        covariance=np.eye(6),
        sun_dir_body=np.array([0.6, 0, 0.8]),
        in_eclipse=False,
        valid=True,
    )
    containers = []
    for number in range(count):
        dn = np.random.default_rng(number).integers(0, 4096, (size_px, size_px), dtype=np.uint16)
        frame = Frame(
            frame_id=number,
            bracket_id=number // 3,
            bracket_index=number % 3,
            bracket_count=3,
            exposure_time_s=1e-4,
            mid_exposure_utc_ns=1_784_631_150_000_000_000 + number,
            pose=pose,
            dn=dn,
            bit_depth=12,
            black_dn=64.0,
            saturated_count=int((dn == 4095).sum()),
        )
        containers.append(encode_frame(frame))
    return containers


class TrialError(Exception):
    """A process of the trial failed, or the frames did not arrive as they were."""


@dataclass(frozen=True)
class Trial:
    """The link of a pass and the faults that happen in it."""

    link: str = "serial"  # serial (3 Mbaud), can (slcan at 1 Mbit/s) or canfd
    faults: Faults = field(default_factory=Faults)
    cut_s: float = 0.0  # length of one cut in the middle
    kills: int = 0  # SIGKILLs of each side
    stalls: int = 0  # how often each side is stopped (SIGSTOP) for `stall_s`
    stall_s: float = 0.0
    full_disks: bool = False  # each side's disk, one after the other, while frames are still being stored
    one_shot: bool = False  # CAN controllers do not repeat what the bus lost
    seed: int = 0

    def open(self) -> VirtualLink:
        """Return the link, not yet running."""
        if self.link == "serial":
            return VirtualSerial(3_000_000, self.faults, self.seed)
        if self.link not in ("can", "canfd"):
            raise ValueError(f"link must be serial, can or canfd, got {self.link!r}")
        return VirtualCan(1_000_000, self.link == "canfd", self.faults, self.seed, one_shot=self.one_shot)


@dataclass(frozen=True)
class TrialResult:
    """What a pass measured. It exists only if every frame arrived once and bit-identical."""

    frames: int
    payload_bytes: int  # of the containers
    seconds: float  # from the first byte on the wire to the last frame in the session
    flight: dict[str, Any]  # the last run's counts, as printed
    ground: dict[str, Any]
    lanes: dict[str, Any]
    flight_rss_mb: float  # peak
    flight_cpu_share: float  # of one core, during `seconds`


def run_trial(
    trial: Trial, folder: Path, mission: Path, containers: list[bytes], limit_s: float
) -> TrialResult:
    """Send frame containers, numbered from 0, over a link and return what it took.

    Raises:
        TrialError: a process ended by itself, `limit_s` passed, or a frame is missing, double, altered, or
            still in the outbox.
        PermissionError: a full disk was asked for and neither a small file system nor a limit can be set.
    """
    folder.mkdir(parents=True)
    captured = folder / "captured"
    captured.mkdir()
    for number, container in enumerate(containers):
        (captured / f"{number:08d}").write_bytes(container)
    size_bytes = 8 * sum(map(len, containers)) + (8 << 20)
    with contextlib.ExitStack() as stack:
        disks = [
            stack.enter_context(_Disk(folder / side, size_bytes if trial.full_disks else 0))
            for side in ("flight", "ground")
        ]
        line = stack.enter_context(trial.open())
        return stack.enter_context(_Pass(trial, line, folder, mission, disks, len(containers))).run(limit_s)


class _Disk:
    """A folder; on a small file system of its own if it is to become full.

    Where mounting is not permitted, `fill` limits the file size of the processes that use it to zero: the kernel then
    refuses writing with EFBIG instead of the ENOSPC of a full disk.
    """

    def __init__(self, folder: Path, size_bytes: int):
        self.folder = folder
        self._size_bytes = size_bytes
        self._mounted = False
        self._refused: list[subprocess.Popen] = []

    def __enter__(self) -> "_Disk":
        self.folder.mkdir()
        if self._size_bytes:
            command = ["mount", "-t", "tmpfs", "-o", f"size={self._size_bytes}", "none", str(self.folder)]
            self._mounted = subprocess.run(command, capture_output=True).returncode == 0
        return self

    def __exit__(self, *_: object) -> None:
        if self._mounted:
            subprocess.run(["umount", "-l", str(self.folder)], check=True)

    def fill(self, users: list[subprocess.Popen]) -> None:
        if not self._mounted:
            for process in users:
                resource.prlimit(process.pid, resource.RLIMIT_FSIZE, (0, resource.RLIM_INFINITY))
            self._refused = users
            return
        with contextlib.suppress(OSError), open(self.folder / "ballast", "wb", buffering=0) as ballast:
            while True:
                ballast.write(bytes(4096))

    def free(self) -> None:
        (self.folder / "ballast").unlink(missing_ok=True)
        for process in self._refused:
            with contextlib.suppress(ProcessLookupError):
                resource.prlimit(
                    process.pid, resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY)
                )


class _Pass:
    """The processes of a trial; leaving the `with` block ends them."""

    def __init__(
        self,
        trial: Trial,
        line: VirtualLink,
        folder: Path,
        mission: Path,
        disks: list[_Disk],
        count: int,
    ):
        self._trial, self._line, self._folder, self._disks, self._count = trial, line, folder, disks, count
        self._store, self._session = folder / "flight" / "store", folder / "ground" / "session"
        python = sys.executable
        capture = [python, "-c", CAPTURE, str(self._store), str(folder / "captured")]
        downlink = [
            python,
            "-m",
            "flightsw.cli",
            "downlink",
            "--link",
            line.flight_url,
            "--store",
            str(self._store),
        ]
        listen = [
            python,
            "-m",
            "ground.cli",
            "listen",
            "--link",
            line.ground_url,
            "--session",
            str(self._session),
        ]
        self._commands = {
            "capture": capture,
            "flight": [*downlink, "--mission", str(mission), "--json"],
            "ground": [*listen, "--mission", str(mission), "--json"],
        }
        self._running: dict[str, subprocess.Popen] = {}
        self._is_full = dict.fromkeys(self._commands, False)

    def __enter__(self) -> "_Pass":
        return self

    def __exit__(self, *_: object) -> None:
        for process in self._running.values():
            process.kill()
            process.wait()

    def run(self, limit_s: float) -> TrialResult:
        end_s = time.monotonic() + limit_s
        if not self._trial.full_disks:  # else a separate process stores them, also while the disks are full
            store = FrameStore(self._store)
            for path in sorted((self._folder / "captured").iterdir()):
                store.put(decode_frame(path.read_bytes()))
        self._start("ground")
        self._wait(lambda: (self._session / "session.json").exists(), end_s)
        self._start("flight")
        if self._trial.full_disks:
            self._start("capture")
        self._wait(lambda: self._lane_bytes("down") > 0, end_s)
        began_s, cpu_before_s = time.monotonic(), self._flight_usage()[1]
        moments = self._plan()
        acting: list[tuple[float, Iterator[float]]] = []
        while (received := self._received()) < self._count or moments or acting:
            self._check(end_s, received)
            while moments and moments[0][0] <= received:
                acting.append((time.monotonic(), moments.pop(0)[1]))
            for at_s, action in [each for each in acting if each[0] <= time.monotonic()]:
                acting.remove((at_s, action))
                if (pause_s := next(action, None)) is not None:
                    acting.append((time.monotonic() + pause_s, action))
            time.sleep(POLL_S)
        seconds = time.monotonic() - began_s
        rss_mb, cpu_s = self._flight_usage()
        self._wait(lambda: not FrameStore(self._store).outbox(), end_s)
        flight, ground = self._stop("flight"), self._stop("ground")
        payload_bytes = self._verify()
        return TrialResult(
            self._count,
            payload_bytes,
            seconds,
            flight,
            ground,
            {name: vars(lane) for name, lane in self._line.statistics().items()},
            rss_mb,
            (cpu_s - cpu_before_s) / seconds,
        )

    def _plan(self) -> list[tuple[float, Iterator[float]]]:
        """Return the actions and the numbers of received frames at which they start, in order."""
        source = random.Random(self._trial.seed)
        moments: list[tuple[float, Iterator[float]]] = []
        if self._trial.cut_s:
            moments.append((self._count // 2, self._cut()))
        if self._trial.full_disks:
            for number, disk in enumerate(self._disks):
                users = ("flight", "capture") if number == 0 else ("ground",)
                moments.append(((number + 1) * self._count // 4, self._fill(disk, users)))
        for side in ("flight", "ground"):
            for _ in range(self._trial.kills):
                moments.append((source.uniform(0, self._count - 1), self._kill(side, source.uniform(0, 0.3))))
            for _ in range(self._trial.stalls):
                moments.append((source.uniform(0, self._count - 1), self._stall(side)))
        return sorted(moments, key=lambda moment: moment[0])

    # Each action is a generator that yields the seconds until its next step.

    def _cut(self) -> Iterator[float]:
        self._line.cut()
        yield self._trial.cut_s
        self._line.mend()

    def _fill(self, disk: _Disk, users: tuple[str, ...]) -> Iterator[float]:
        disk.fill([self._running[name] for name in users])
        self._is_full |= dict.fromkeys(users, True)
        yield FULL_S
        disk.free()
        self._is_full |= dict.fromkeys(users, False)

    def _kill(self, side: str, delay_s: float) -> Iterator[float]:
        yield delay_s
        self._running[side].kill()
        self._running[side].wait()
        self._start(side)

    def _stall(self, side: str) -> Iterator[float]:
        self._running[side].send_signal(signal.SIGSTOP)
        yield self._trial.stall_s
        self._running[side].send_signal(signal.SIGCONT)

    def _start(self, name: str) -> None:
        with (
            open(self._folder / f"{name}.log", "ab") as log,
            open(self._folder / f"{name}.json", "wb") as out,
        ):
            self._running[name] = subprocess.Popen(tied(self._commands[name]), stdout=out, stderr=log)

    def _stop(self, name: str) -> dict[str, Any]:
        process = self._running[name]
        process.send_signal(signal.SIGTERM)
        process.wait(30)
        if process.returncode == -signal.SIGTERM:
            return {}  # it was restarted a moment ago and has not counted anything yet
        try:
            return json.loads((self._folder / f"{name}.json").read_text().splitlines()[-1])
        except (IndexError, ValueError) as error:
            raise TrialError(f"{name} printed no result: {self._end_of_log(name)}") from error

    def _check(self, end_s: float, received: int) -> None:
        for name, process in list(self._running.items()):
            if process.poll() is None or (name == "capture" and not process.returncode):
                continue
            if self._trial.kills and self._is_full[name] and process.returncode == 1:
                self._start(name)  # killed and restarted while its disk was full: it reported that and ended
            else:
                raise TrialError(f"{name} ended with {process.returncode}: {self._end_of_log(name)}")
        if time.monotonic() > end_s:
            raise TrialError(f"{received} of {self._count} frames had arrived when the time was up")

    def _end_of_log(self, name: str) -> str:
        return (self._folder / f"{name}.log").read_text()[-2000:]

    def _wait(self, condition: Callable[[], bool], end_s: float) -> None:
        while not condition():
            self._check(end_s, self._received())
            time.sleep(POLL_S)

    def _received(self) -> int:
        try:
            return (self._session / "frames.jsonl").read_bytes().count(b"\n")
        except OSError as error:
            if error.errno != errno.ENOENT:
                raise
            return 0

    def _lane_bytes(self, direction: str) -> int:
        lane = self._line.statistics()[direction]
        return getattr(lane, "frames_in", 0) + getattr(lane, "bytes_in", 0)

    def _flight_usage(self) -> tuple[float, float]:
        """Return the flight process' peak resident memory in MB and its CPU seconds so far."""
        process = Path("/proc") / str(self._running["flight"].pid)
        peak_kb = next(
            int(line.split()[1])
            for line in (process / "status").read_text().splitlines()
            if line.startswith("VmHWM")
        )
        user, system = (process / "stat").read_text().rpartition(")")[2].split()[11:13]
        return peak_kb / 1024, (int(user) + int(system)) / os.sysconf("SC_CLK_TCK")

    def _verify(self) -> int:
        """Compare what the ground holds with what was captured; return the containers' bytes."""
        sent = [path.read_bytes() for path in sorted((self._folder / "captured").iterdir())]
        expected = {number: hashlib.sha256(container).hexdigest() for number, container in enumerate(sent)}
        session = open_session(self._session)
        numbers = [record.id for record in session.frames]
        if len(numbers) != len(set(numbers)):
            raise TrialError(f"frames came twice into the session: {sorted(numbers)}")
        received = {record.id: record.sha256 for record in session.frames}
        if wrong := {n for n in expected | received if expected.get(n) != received.get(n)}:
            raise TrialError(f"frames missing, altered or never sent: {sorted(wrong)}")
        for record in session.frames:
            if (session.dn(record) != decode_frame(sent[record.id]).dn).any():
                raise TrialError(f"the picture of frame {record.id} is not the one that was sent")
        shutil.rmtree(self._folder / "captured")
        return sum(map(len, sent))
