"""A simulated pass: camera and link run here, flight and ground as processes of their own, until every frame is across.

Only the link carries frames from one process to the other.
"""

import contextlib
import json
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO

import numpy as np
from rich.console import Console
from scipy.spatial.transform import Rotation

from flightsw.icd.frame import Attitude, PoseTag
from flightsw.icd.mission import Mission
from flightsw.icd.quaternion import quat_to_matrix
from hil.cameras.gige import GigeCameraServer
from hil.cameras.virtual import CameraServer
from hil.choices import NAVIGATION, SKY, LinkKind, NavigationKind, SkyKind
from hil.link_by_name import virtual_link
from hil.links.faults import LinkFaults
from hil.links.virtual_link import VirtualLink
from hil.processes import end, installed, tied
from hil.progress import progress_bar
from hil.world.surroundings import Surroundings
from hil.world.world import World
from obbgs_base.errors import ObbgsError

# the pass has failed when nothing was captured or received for this long, and for as long as frames without any
# compression would take that the link carries side by side
STALL_S = 60.0
FAULT_WORDS = {
    "lost",
    "destroyed",
    "flipped",
    "duplicated",
    "reordered",
    "cut",
    "overrun",
}  # in names of counts
FLIGHT_COUNTS = ("segments_sent", "segments_resent", "transfers_failed")  # of the downlink, for the report


class PassError(ObbgsError):
    """A process failed or stalled, or a frame was lost or altered; the message says which, and where its log is."""


@dataclass(frozen=True)
class PassConfig:
    """What a pass is simulated with."""

    gige: bool = False  # GigE Vision on 127.0.0.1 instead of our own protocol on a socket
    link: LinkKind = "serial"  # serial: at the mission's baud rate; CAN at 1 Mbit/s
    faults: str = "none"  # as `LinkFaults.parse` takes them
    scenario: str = ""  # a ready-made one or a YAML file; empty: the mission's own orbits and attitude
    navigation: NavigationKind = NAVIGATION
    real_time: float = 0.0  # how many times as fast as real time the simulated clock runs; 0: lock step
    seed: int = 1  # of the navigation errors
    attitude: Attitude | None = None  # what flight knows of the target's; None: what the mission says
    sky: SkyKind = SKY  # real: with Earth, stars, stray light and a dark level that drifts

    def open_link(self, mission: Mission) -> VirtualLink:
        """Return the link, not yet running."""
        return virtual_link(self.link, LinkFaults.parse(self.faults), mission.link.baud_rate)

    @property
    def cut_s(self) -> float:
        """How long the link is cut in the middle of the pass, 0 for no cut."""
        return LinkFaults.parse(self.faults).cut_s


def fly(
    out: Path,
    world: World,
    mission_path: Path,
    radiance: Callable[[PoseTag], np.ndarray],
    config: PassConfig,
    console: Console,
    surroundings: Surroundings | None = None,
) -> dict[str, dict]:
    """Run flight and ground until every frame is across; return what was simulated, by part.

    Flight's store is `out`/flight, the session `out`/session; the logs are beside them.

    Args:
        mission_path: the file of the world's mission.
        radiance: gives the scene-linear radiance [H, W, C] for a true pose.
        surroundings: what else the camera sees; None: a black sky.

    Raises:
        PassError: a process failed or stalled, or a frame was lost or altered on its way.
        CaptureError, OSError: the GigE camera cannot be served: Aravis is missing, or its port is taken.
    """
    mission = world.mission
    with config.open_link(mission) as line, _open_camera(world, radiance, surroundings, config) as camera:
        cut = _Cut(line, config.cut_s, _planned_frames(mission))
        _run_flight_and_ground(out, mission, mission_path, line, camera.url, cut, config, console)
        link_figures = _link_figures(line, config, cut)
        camera_figures = {
            "kind": "gige" if config.gige else "hil",
            "pace": f"{config.real_time:g} times real time" if config.real_time else "lock step",
            "exposures": camera.exposures,
            "late_frames": camera.late_frames,
            "failures": camera.failures,
        }
    received = _verified_records(out, _planned_frames(mission))
    counts = json.loads((out / "flight.json").read_text())
    return {
        "scenario": {
            "name": config.scenario or "the mission's own orbits and attitude",
            "sky": config.sky,
            "brackets": mission.bracket.count,
            "interval_s": round(mission.bracket.interval_s, 1),
        },
        "frames": {
            "captured": len(received),
            "received": len(received),
            "without_valid_pose": counts["capture"]["pose_invalid"],
        },
        "camera": camera_figures | {"packets_lost": counts["capture"]["packets_lost"]},
        "link": link_figures | {name: counts["downlink"][name] for name in FLIGHT_COUNTS},
        "navigation": _navigation_figures(world, config, received),
    }


def _planned_frames(mission: Mission) -> int:
    return mission.bracket.count * len(mission.bracket.exposure_times_ms)


@contextlib.contextmanager
def _open_camera(
    world: World,
    radiance: Callable[[PoseTag], np.ndarray],
    surroundings: Surroundings | None,
    config: PassConfig,
) -> Iterator[CameraServer | GigeCameraServer]:
    """Serve the camera; the socket is in a folder of its own, since its path must be short."""
    more = {"pose_at": world.pose_at, "real_time": config.real_time, "surroundings": surroundings}
    if config.gige:
        with GigeCameraServer(world.mission, radiance, **more) as camera:
            yield camera
        return
    with (
        tempfile.TemporaryDirectory(prefix="hil-") as folder,
        CameraServer(world.mission, radiance, Path(folder) / "camera.sock", **more) as camera,
    ):
        yield camera


class _Cut:
    """One cut of the link, `seconds` long, when the ground has received half of the frames; none for 0 s."""

    def __init__(self, line: VirtualLink, seconds: float, frames: int):
        self.count = 0
        self._line, self._seconds, self._frames = line, seconds, frames
        self._since_s = 0.0

    def update(self, received: int) -> None:
        now_s = time.monotonic()
        if self._line.is_cut and now_s - self._since_s > self._seconds:
            self._line.mend()
        elif self._seconds and not self.count and self._frames // 2 <= received < self._frames:
            self._line.cut()
            self._since_s, self.count = now_s, 1


def _run_flight_and_ground(
    out: Path,
    mission: Mission,
    mission_path: Path,
    line: VirtualLink,
    camera_url: str,
    cut: _Cut,
    config: PassConfig,
    console: Console,
) -> None:
    """Start flight and ground and wait until both have ended well; flight's counts are in `out`/flight.json.

    Raises:
        PassError: one of them failed, or the pass stalled.
    """
    frames = _planned_frames(mission)
    listen = ["listen", "--link", line.ground_url, "--session", str(out / "session")]
    listen += ["--exit-after", str(frames), "--mission", str(mission_path)]
    capture = ["capture", "--camera", camera_url, "--store", str(out / "flight"), "--link", line.flight_url]
    capture += ["--mission", str(mission_path), "--json"]
    camera = mission.camera
    at_once_bits = 16 * camera.width * camera.height * camera.channels * mission.link.files_in_flight
    stall_s = STALL_S + at_once_bits / mission.link.baud_rate
    stall_s += mission.bracket.interval_s / config.real_time if config.real_time else 0.0
    with (
        open(out / "ground.log", "w") as ground_log,
        open(out / "flight.log", "w") as flight_log,
        open(out / "flight.json", "w") as flight_result,
        _process("ground", listen, ground_log, ground_log) as ground,
        _process("flightsw", capture, flight_result, flight_log) as flight,
    ):
        _watch(out, flight, ground, frames, cut, stall_s, console)
    for process, log in ((flight, out / "flight.log"), (ground, out / "ground.log")):
        if process.returncode:
            raise PassError(f"a process of the pass failed: {_last_line(log)} (log: {log})")


@contextlib.contextmanager
def _process(tool: str, arguments: list[str], out: IO, log: IO) -> Iterator[subprocess.Popen]:
    """Run one of our commands; if it still runs at the end of the `with` block, it is ended."""
    process = subprocess.Popen(tied([installed(tool), *arguments]), stdout=out, stderr=log)
    try:
        yield process
    finally:
        end(process)


def _watch(
    out: Path,
    flight: subprocess.Popen,
    ground: subprocess.Popen,
    frames: int,
    cut: _Cut,
    stall_s: float,
    console: Console,
) -> None:
    """Show how many frames are captured and received until both processes have ended or one has failed.

    Cuts and repairs the link meanwhile.

    Raises:
        PassError: nothing was captured or received for `stall_s`.
    """
    session, seen, last_progress_s = out / "session", (0, 0, 0), time.monotonic()
    with progress_bar(console) as progress:
        tasks = [progress.add_task(name, total=frames) for name in ("captured", "received")]
        while flight.poll() is None or ground.poll() is None:
            if flight.poll() or ground.poll():  # one has failed; the other would run for ever
                return
            captured, received = _lines(out / "flight" / "index.jsonl"), _lines(session / "frames.jsonl")
            for task, count in zip(tasks, (captured, received), strict=True):
                progress.update(task, completed=count)
            counts = (captured, received, len(list(session.glob("thumbnails/*.png"))))
            if counts != seen:
                seen, last_progress_s = counts, time.monotonic()
            if time.monotonic() - last_progress_s > stall_s:
                raise PassError(f"the pass stalled at {captured} captured, {received} received of {frames}")
            cut.update(received)
            time.sleep(0.2)
        for task in tasks:
            progress.update(task, completed=frames)


def _lines(path: Path) -> int:
    return path.read_bytes().count(b"\n") if path.exists() else 0


def _last_line(log: Path) -> str:
    return next((line for line in reversed(log.read_text().splitlines()) if line.strip()), "no message")


def _verified_records(out: Path, frames: int) -> list[dict]:
    """Return the session's records after a comparison of every frame with flight's store.

    Raises:
        PassError: not every planned frame was captured and received with the same SHA-256.
    """
    captured = _records(out / "flight" / "index.jsonl", "frame_id")
    received = _records(out / "session" / "frames.jsonl", "id")
    different = {i for i in captured if i not in received or captured[i]["sha256"] != received[i]["sha256"]}
    if different or len(captured) != frames or len(received) != frames:
        raise PassError(
            f"{len(different)} of {len(captured)} captured frames (planned: {frames}) were lost or altered, "
            f"{len(received)} received: {sorted(different)[:5]}"
        )
    return list(received.values())


def _records(path: Path, key: str) -> dict[int, dict]:
    """Return the JSON lines of a file by their number."""
    lines = path.read_text().splitlines() if path.exists() else []
    records = [json.loads(line) for line in lines]
    return {record[key]: record for record in records}


def _link_figures(line: VirtualLink, config: PassConfig, cut: _Cut) -> dict:
    """Return what crossed the link and what the faults did, in packets or CAN frames of both directions."""
    lanes = line.statistics()
    figures = {
        "kind": config.link,
        "faults": config.faults,
        "cuts": cut.count,
        "cut_s": config.cut_s,
        "bytes_down": lanes["down"].bytes_out,
    }
    for name in vars(lanes["down"]):
        if is_fault_count(name):
            key = name.replace("frames_", "can_frames_")  # not to be confused with the camera's frames
            figures[key] = getattr(lanes["down"], name) + getattr(lanes["up"], name)
    return figures


def is_fault_count(name: str) -> bool:
    """Return whether a count of a link's statistics, by its name, counts faults."""
    return bool(FAULT_WORDS & set(name.split("_")))


def _navigation_figures(world: World, config: PassConfig, records: list[dict]) -> dict:
    """Return the root mean square errors of the received tags, in position and in rotation.

    Tags of another attitude than the known one are compared in the axes that they were free to choose.
    """
    position_m, turn_rad = [], []
    knowledge, start_ns = world.mission.target_attitude.knowledge, world.mission.orbit.start_utc_ns
    for record in records:
        utc_ns = record["mid_exposure_utc_ns"]
        true = world.pose_at(utc_ns)
        tag_to_body = np.eye(3)
        if knowledge != "known":
            tag_to_body = world.gcrs_to_body(start_ns if knowledge == "rate_only" else utc_ns)
        tagged = quat_to_matrix(np.array(record["quat_body_to_camera"])) @ tag_to_body.T
        position_m.append(np.linalg.norm(true.position_body_m - tag_to_body @ record["position_body_m"]))
        turn_rad.append(Rotation.from_matrix(tagged @ quat_to_matrix(true.quat_body_to_camera).T).magnitude())
    return {
        "source": world.mission.navigation.source.partition(":")[0],
        "errors": f"realistic, seed {config.seed}" if config.navigation == "realistic" else "none",
        "attitude": knowledge,
        "position_error_m": round(float(np.sqrt(np.mean(np.square(position_m)))), 4),
        "rotation_error_deg": round(float(np.degrees(np.sqrt(np.mean(np.square(turn_rad))))), 5),
    }
