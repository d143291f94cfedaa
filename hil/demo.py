"""The whole loop on one desk: sky, camera and wire here; flight and ground as processes of their own."""

import contextlib
import json
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO, Literal

import numpy as np
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.table import Table

from flightsw.icd.frame import PoseTag
from flightsw.icd.mission import Mission, load_mission
from ground.summary import model_rows, table
from hil.cameras.gige import GigeCameraServer
from hil.cameras.virtual import CameraServer
from hil.links.faults import STANDARD_CUT_S, STANDARD_FAULTS, Faults
from hil.links.virtual_can import VirtualCan
from hil.links.virtual_link import VirtualLink
from hil.links.virtual_serial import VirtualSerial
from hil.processes import end, tied
from hil.sky.blender import RenderFarm, check_mesh
from hil.truth import write_truth
from hil.world.clock import SimulatedClock
from hil.world.scenario import true_exposures
from hil.world.states import World, load_world, write_flight_inputs
from obbgs_base.errors import ObbgsError

MARKER = "demo.json"  # says that what a folder has of these is a demo's own
MADE_ANEW = ("flight", "session", "scenario")
LOGS = ("ground.log", "flight.log", "flight.json")
PATIENCE_S = 60.0  # the pass has stalled when nothing was captured or received for this long
FAULT_SEED = 1
FAULT_WORDS = {"lost", "destroyed", "flipped", "duplicated", "reordered", "cut", "overrun"}


class DemoError(ObbgsError, RuntimeError):
    """A step of the loop failed; the message says which, and where its log is."""


@dataclass(frozen=True)
class DemoConfig:
    """What the loop is made of."""

    camera: Literal["hil", "gige"] = "hil"
    link: Literal["serial", "slcan", "slcan-fd"] = "serial"  # the mission's baud rate, or CAN at 1 Mbit/s
    faults: Literal["none", "standard"] = "none"  # standard: 2 % of each, and a cut in the middle
    scenario: str = ""  # a ready-made one or a YAML file; empty: the mission's own orbits and attitude
    navigation_noise: int | None = None  # seed of errors with the mission's sigmas; none: tags without error
    real_time: float = 0.0  # how many times as fast as ours the simulated clock runs; 0: lock step

    def open_link(self, mission: Mission) -> VirtualLink:
        """Return the link, not yet running."""
        faults = STANDARD_FAULTS if self.faults == "standard" else Faults()
        if self.link == "serial":
            return VirtualSerial(mission.link.baud_rate, faults, FAULT_SEED)
        return VirtualCan(fd=self.link == "slcan-fd", faults=faults, seed=FAULT_SEED)

    @property
    def cut_s(self) -> float:
        return STANDARD_CUT_S if self.faults == "standard" else 0.0


def run_demo(out: Path, mission_path: Path, mesh: Path, config: DemoConfig, console: Console) -> dict:
    """Run the loop below `out` and return its figures; frames that are rendered already are used again.

    Raises:
        DemoError: a process failed or stalled, or a frame was lost or altered on its way.
        And what `simulate_pass` raises.
    """
    began_s = time.monotonic()
    simulation = simulate_pass(out, mission_path, mesh, config, console)
    console.print("[bold]4/4 Model[/] trained with known exposure, and once more blind to it")
    session = out / "session"
    command = [_tool("ground"), "reconstruct", "--session", str(session), "--name", "demo"]
    command += ["--blind-reference", "--mission", str(mission_path)]
    finished = subprocess.run(tied([*command, "--json"]), stdout=subprocess.PIPE, text=True)
    if finished.returncode:
        raise DemoError("the reconstruction failed; its message is above")
    seconds = round(time.monotonic() - began_s, 1)
    figures = {**json.loads(finished.stdout), **simulation, "seconds": seconds}
    (out / MARKER).write_text(json.dumps(figures, indent=2) + "\n")
    console.print(_summary(figures))
    console.print(f"Report: {session / 'runs/demo/report.html'}", soft_wrap=True)
    return figures


def simulate_pass(
    out: Path, mission_path: Path, mesh: Path, config: DemoConfig, console: Console
) -> dict[str, dict]:
    """Render the sky, fly the pass and write its truth, all below `out`; return what was simulated, by part.

    A pass that cannot start leaves nothing but rendered frames.

    Raises:
        DemoError: a process failed or stalled, or a frame was lost or altered on its way.
        ConfigError, MeshError, BlenderError: the mission, the scenario, the mesh or Blender is not usable.
        ValueError: flight cannot follow the real-time factor.
        CaptureError, OSError: the GigE camera cannot be served: no Aravis, or its port is taken.
    """
    world = load_world(load_mission(mission_path), config.scenario)
    SimulatedClock(
        world.mission, config.real_time
    )  # a factor that cannot be is known before anything is removed
    check_mesh(mesh)
    _require_own(out)
    mission = world.mission
    exposures = true_exposures(mission, world.pose_at)
    size = f"{mission.camera.width}x{mission.camera.height}"
    console.print(
        f"[bold]1/4 Sky[/]   {len(exposures)} exposures of {mesh.name} at {size}, rendered by Blender"
        + (f", scenario {config.scenario}" if config.scenario else "")
    )
    with _nothing_left_behind(out), RenderFarm(mission, mesh, out / "renders") as farm:
        with _bar(console) as progress:
            task = progress.add_task("render", total=len(exposures))
            farm.prerender([e.pose for e in exposures], lambda: progress.advance(task))
        _clear(out)  # only now: a mesh that cannot be rendered costs no earlier pass
        if config.scenario or config.navigation_noise is not None:
            mission_path = write_flight_inputs(world, out / "scenario", config.navigation_noise)
            world = replace(world, mission=load_mission(mission_path))
        console.print(
            f"[bold]2/4 Pass[/]  flight and ground, {config.camera} camera, {config.link} link between, "
            f"faults: {config.faults}"
        )
        simulation = fly(out, world, mission_path, farm.radiance, config, console)
        console.print("[bold]3/4 Truth[/] the simulator's own record, for the evaluation only")
        write_truth(out / "session", world.mission, farm, pose_at=world.pose_at, simulation=simulation)
    return simulation


def _require_own(out: Path) -> None:
    """Refuse a folder whose flight/ or session/ no demo made.

    Raises:
        DemoError: there is such a one.
    """
    if not (out / MARKER).exists():
        for name in MADE_ANEW:
            if (out / name).exists():
                raise DemoError(f"{out / name} was not made by a demo; choose another folder with OUT=DIR")


def _clear(out: Path) -> None:
    """Make room for a new pass: what an earlier demo flew is removed, rendered frames stay."""
    for name in MADE_ANEW:
        if (out / name).exists():
            shutil.rmtree(out / name)
    out.mkdir(parents=True, exist_ok=True)
    (out / MARKER).write_text("{}\n")


@contextlib.contextmanager
def _nothing_left_behind(out: Path) -> Iterator[None]:
    """Take back the files of a demo that ends before flight or ground made any; rendered frames stay."""
    try:
        yield
    except BaseException:
        if not (out / "flight").exists() and not (out / "session").exists():
            shutil.rmtree(out / "scenario", ignore_errors=True)
            for name in (MARKER, *LOGS):
                (out / name).unlink(missing_ok=True)
            for folder in (out / "renders", out):
                with contextlib.suppress(OSError):  # missing, or not empty
                    folder.rmdir()
        raise


def fly(
    out: Path,
    world: World,
    mission_path: Path,
    radiance: Callable[[PoseTag], np.ndarray],
    config: DemoConfig,
    console: Console,
) -> dict[str, dict]:
    """Run flight and ground until every frame is across; return what was simulated, by part.

    Args:
        mission_path: the file of the world's mission.
        radiance: gives the sky [H, W, C] for a true pose.

    Raises:
        DemoError: see `simulate_pass`.
    """
    store, session, mission = out / "flight", out / "session", world.mission
    frames = mission.bracket.count * len(mission.bracket.exposure_times_ms)
    bracket = ",".join(f"{time_ms:g}" for time_ms in mission.bracket.exposure_times_ms)
    with (
        config.open_link(mission) as line,
        _open_camera(out, world, radiance, config) as camera,
        open(out / "ground.log", "w") as ground_log,
        open(out / "flight.log", "w") as flight_log,
        open(out / "flight.json", "w") as flight_result,
    ):
        listen = ["listen", "--link", line.ground_url, "--session", str(session), "--exit-after", str(frames)]
        capture = ["capture", "--bracket", bracket, "--count", str(mission.bracket.count)]
        capture += ["--camera", camera.url, "--store", str(store), "--link", line.flight_url]
        capture += ["--mission", str(mission_path), "--json"]
        cut = _Cut(line, config.cut_s, frames)
        patience_s = PATIENCE_S
        if config.real_time:
            patience_s += mission.bracket.interval_s / config.real_time
        with (
            _process("ground", [*listen, "--mission", str(mission_path)], ground_log, ground_log) as ground,
            _process("flightsw", capture, flight_result, flight_log) as flight,
        ):
            _watch(store, session, flight, ground, frames, cut, patience_s, console)
        for process, log in ((flight, flight_log), (ground, ground_log)):
            if process.returncode:
                raise DemoError(
                    f"a process of the pass failed: {_last_line(Path(log.name))} (log: {log.name})"
                )
        link_figures = _link_figures(line, config, cut)
        camera_figures = {
            "kind": config.camera,
            "pace": f"{config.real_time:g} times real time" if config.real_time else "lock step",
            "exposures": camera.exposures,
            "late_frames": camera.late_frames,
            "failures": camera.failures,
        }
    captured, received = _records(store / "index.jsonl", "frame_id"), _records(session / "frames.jsonl", "id")
    different = {i for i in captured if i not in received or captured[i]["sha256"] != received[i]["sha256"]}
    if different or len(captured) != frames or len(received) != frames:
        raise DemoError(
            f"{len(different)} of {len(captured)} captured frames (planned: {frames}) were lost or altered, "
            f"{len(received)} received: {sorted(different)[:5]}"
        )
    done = json.loads((out / "flight.json").read_text())
    names = ("segments_sent", "segments_resent", "transfers_failed")
    return {
        "scenario": {
            "name": config.scenario or "the mission's own orbits and attitude",
            "brackets": mission.bracket.count,
            "interval_s": round(mission.bracket.interval_s, 1),
        },
        "frames": {
            "captured": len(captured),
            "received": len(received),
            "without_valid_pose": done["capture"]["pose_invalid"],
        },
        "camera": camera_figures | {"packets_lost": done["capture"]["packets_lost"]},
        "link": link_figures | {name: done["downlink"][name] for name in names},
        "navigation": _navigation_figures(world, config, list(received.values())),
    }


def _open_camera(
    out: Path, world: World, radiance: Callable[[PoseTag], np.ndarray], config: DemoConfig
) -> CameraServer | GigeCameraServer:
    more = {"pose_at": world.pose_at, "real_time": config.real_time}
    if config.camera == "gige":
        return GigeCameraServer(world.mission, radiance, **more)
    return CameraServer(world.mission, radiance, out / "camera.sock", **more)


class _Cut:
    """One cut of the link, of `seconds`, as soon as the ground holds half of the frames; none for 0 s."""

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


def _link_figures(line: VirtualLink, config: DemoConfig, cut: _Cut) -> dict:
    """Return what crossed the link, and what it did to packets (CAN: frames) in both directions."""
    lanes = line.statistics()
    figures = {
        "kind": config.link,
        "faults": config.faults,
        "cuts": cut.count,
        "cut_s": config.cut_s,
        "bytes_down": lanes["down"].bytes_out,
    }
    for name in vars(lanes["down"]):
        if FAULT_WORDS & set(name.split("_")):
            key = name.replace("frames_", "can_frames_")  # not the camera's
            figures[key] = getattr(lanes["down"], name) + getattr(lanes["up"], name)
    return figures


def _navigation_figures(world: World, config: DemoConfig, records: list[dict]) -> dict:
    """Return how far the received tags are from the truth, root mean squares: of position [3] and of rotation."""
    noise = "none" if config.navigation_noise is None else f"seed {config.navigation_noise}"
    position_m, turn_rad = [], []
    for record in records:
        true = world.pose_at(record["mid_exposure_utc_ns"])
        position_m.append(np.linalg.norm(true.position_body_m - record["position_body_m"]))
        half_turn = min(1.0, abs(true.quat_body_to_camera @ record["quat_body_to_camera"]))
        turn_rad.append(2 * np.arccos(half_turn))
    return {
        "source": world.mission.navigation.source.partition(":")[0],
        "noise": noise,
        "position_error_m": round(float(np.sqrt(np.mean(np.square(position_m)))), 4),
        "rotation_error_deg": round(float(np.degrees(np.sqrt(np.mean(np.square(turn_rad))))), 5),
    }


@contextlib.contextmanager
def _process(tool: str, arguments: list[str], out: IO, log: IO) -> Iterator[subprocess.Popen]:
    """Run one of our commands; what still runs at the end of the `with` is told to end."""
    process = subprocess.Popen(tied([_tool(tool), *arguments]), stdout=out, stderr=log)
    try:
        yield process
    finally:
        end(process)


def _watch(
    store: Path,
    session: Path,
    flight: subprocess.Popen,
    ground: subprocess.Popen,
    frames: int,
    cut: _Cut,
    patience_s: float,
    console: Console,
) -> None:
    """Show what is captured and received until both processes have ended, one has failed, or nothing moves.

    Cuts and mends the link on the way.
    """
    seen, moved_s = (0, 0, 0), time.monotonic()
    with _bar(console) as progress:
        tasks = [progress.add_task(name, total=frames) for name in ("captured", "received")]
        while flight.poll() is None or ground.poll() is None:
            if flight.poll() or ground.poll():  # a failure; the other side would wait for ever
                return
            captured, received = _lines(store / "index.jsonl"), _lines(session / "frames.jsonl")
            for task, count in zip(tasks, (captured, received), strict=True):
                progress.update(task, completed=count)
            counts = (captured, received, len(list(session.glob("thumbnails/*.png"))))
            if counts != seen:
                seen, moved_s = counts, time.monotonic()
            if time.monotonic() - moved_s > patience_s:
                raise DemoError(f"the pass stalled at {captured} captured, {received} received of {frames}")
            cut.update(received)
            time.sleep(0.2)
        for task in tasks:
            progress.update(task, completed=frames)


def _lines(path: Path) -> int:
    return path.read_bytes().count(b"\n") if path.exists() else 0


def _records(path: Path, key: str) -> dict[int, dict]:
    """Return the JSON lines of a file by their number."""
    lines = path.read_text().splitlines() if path.exists() else []
    records = [json.loads(line) for line in lines]
    return {record[key]: record for record in records}


def _last_line(log: Path) -> str:
    return next((line for line in reversed(log.read_text().splitlines()) if line.strip()), "no message")


def _tool(name: str) -> str:
    """Return the path of one of our commands in this environment."""
    return str(Path(sys.executable).with_name(name))


def _bar(console: Console) -> Progress:
    return Progress(
        TextColumn("{task.description:>10}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        console=console,
    )


def _summary(f: dict) -> Table:
    frames, camera, link, navigation = f["frames"], f["camera"], f["link"], f["navigation"]
    done = ", ".join(
        f"{value:,} {name.replace('_', ' ')}"
        for name, value in link.items()
        if value and FAULT_WORDS & set(name.split("_"))
    )
    rows = [
        ("frames captured / received", f"{frames['captured']} / {frames['received']}, sha256 equal"),
        ("camera", f"{camera['kind']}: {camera['late_frames']} frames late, {camera['failures']} failures"),
        (
            "link",
            f"{link['kind']}, faults {link['faults']}, {link['cuts']} cuts: {link['bytes_down']:,} bytes down",
        ),
        ("done on the link", done or "nothing"),
        (
            "tags against truth",
            f"{navigation['position_error_m']:.3f} m, {navigation['rotation_error_deg']:.4f} deg "
            f"(injected noise: {navigation['noise']})",
        ),
        *model_rows(f),
        ("everything", f"{f['seconds']:.0f} s"),
    ]
    return table("The pass and its model", rows)
