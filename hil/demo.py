"""The whole loop on one desk: sky, camera and wire here; flight and ground as processes of their own."""

import json
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import TextIO

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

from flightsw.icd.mission import Mission, load_mission
from hil.blender import RenderFarm
from hil.scenario import true_exposures
from hil.truth import write_truth
from hil.virtual_camera import CameraServer
from hil.virtual_link import VirtualSerial

MARKER = "demo.json"  # says that a folder's flight/ and session/ are a demo's own and may be made anew
PATIENCE_S = 60.0  # the pass has stalled when nothing was captured or received for this long


class DemoError(RuntimeError):
    """A step of the loop failed; the message says which, and where its log is."""


def run_demo(out: Path, mission_path: Path, mesh: Path, console: Console) -> dict:
    """Run the loop below `out` and return its figures; frames that are rendered already are used again.

    Raises:
        DemoError: a process failed or stalled, or a frame was lost or altered on its way.
        ConfigError, MeshError, BlenderError: the mission, the mesh or Blender is not usable.
    """
    began_s = time.monotonic()
    mission = load_mission(mission_path)
    _clear(out)
    exposures = true_exposures(mission)
    size = f"{mission.camera.width}x{mission.camera.height}"
    console.print(
        f"[bold]1/4 Sky[/]   {len(exposures)} exposures of {mesh.name} at {size}, rendered by Blender"
    )
    with RenderFarm(mission, mesh, out / "renders") as farm:
        with _bar(console) as progress:
            task = progress.add_task("render", total=len(exposures))
            farm.prerender([e.pose for e in exposures], lambda: progress.advance(task))
        console.print(
            f"[bold]2/4 Pass[/]  flight and ground, a serial line at {mission.link.baud_rate} baud between"
        )
        link = _fly(out, mission, mission_path, farm, len(exposures), console)
        console.print("[bold]3/4 Truth[/] the simulator's own record, for the evaluation only")
        write_truth(out / "session", mission, farm)
    console.print("[bold]4/4 Model[/] trained with known exposure, and once more blind to it")
    session = out / "session"
    command = [
        _tool("ground"),
        "reconstruct",
        "--session",
        str(session),
        "--name",
        "demo",
        "--blind-reference",
    ]
    command += ["--method", mission.reconstruct.method, "--seed", str(mission.reconstruct.seed)]
    if mission.reconstruct.steps:
        command += ["--steps", str(mission.reconstruct.steps)]
    finished = subprocess.run([*command, "--json"], stdout=subprocess.PIPE, text=True)
    if finished.returncode:
        raise DemoError("the reconstruction failed; its message is above")
    figures = {**json.loads(finished.stdout), **link, "seconds": round(time.monotonic() - began_s, 1)}
    (out / MARKER).write_text(json.dumps(figures, indent=2) + "\n")
    console.print(_summary(figures))
    console.print(f"Report: {session / 'runs/demo/report.html'}", soft_wrap=True)
    return figures


def _clear(out: Path) -> None:
    """Make room for a new pass; only what an earlier demo made is removed, rendered frames stay.

    Raises:
        DemoError: the folder holds a session that no demo made.
    """
    ours = (out / MARKER).exists()
    for name in ("flight", "session"):
        if (out / name).exists():
            if not ours:
                raise DemoError(f"{out / name} was not made by a demo; choose another folder with OUT=DIR")
            shutil.rmtree(out / name)
    out.mkdir(parents=True, exist_ok=True)
    (out / MARKER).write_text("{}\n")


def _fly(
    out: Path, mission: Mission, mission_path: Path, farm: RenderFarm, frames: int, console: Console
) -> dict[str, int]:
    """Run flight and ground until every frame is across; return what crossed the line.

    Raises:
        DemoError: see `run_demo`.
    """
    store, session = out / "flight", out / "session"
    bracket = ",".join(f"{time_ms:g}" for time_ms in mission.bracket.exposure_times_ms)
    with (
        VirtualSerial(mission.link.baud_rate) as line,
        CameraServer(mission, farm, out / "camera.sock") as camera,
        open(out / "ground.log", "w") as ground_log,
        open(out / "flight.log", "w") as flight_log,
    ):
        listen = ["listen", "--link", line.ground_url, "--session", str(session), "--exit-after", str(frames)]
        capture = [
            "capture",
            "--bracket",
            bracket,
            "--count",
            str(mission.bracket.count),
            "--camera",
            camera.url,
        ]
        capture += ["--store", str(store), "--link", line.flight_url]
        ground = _start("ground", [*listen, "--mission", str(mission_path)], ground_log)
        flight = _start("flightsw", [*capture, "--mission", str(mission_path)], flight_log)
        try:
            _watch(store, session, flight, ground, frames, console)
        finally:
            for process in (flight, ground):
                if process.poll() is None:
                    process.terminate()
                    process.wait(timeout=10)
        for process, log in ((flight, flight_log), (ground, ground_log)):
            if process.returncode:
                raise DemoError(
                    f"a process of the pass failed: {_last_line(Path(log.name))} (log: {log.name})"
                )
        down = line.statistics()["down"]
    captured, received = _digests(store / "index.jsonl", "frame_id"), _digests(session / "frames.jsonl", "id")
    if captured != received:
        different = {i for i in captured if captured[i] != received.get(i)}
        raise DemoError(
            f"{len(different)} of {len(captured)} frames were lost or altered: {sorted(different)[:5]}"
        )
    return {
        "frames_captured": len(captured),
        "frames_received": len(received),
        "line_bytes_down": down.bytes_out,
        "line_bytes_lost": down.lost_bytes + down.cut_bytes,
    }


def _start(tool: str, arguments: list[str], log: TextIO) -> subprocess.Popen:
    return subprocess.Popen([_tool(tool), *arguments], stdout=log, stderr=subprocess.STDOUT)


def _watch(
    store: Path,
    session: Path,
    flight: subprocess.Popen,
    ground: subprocess.Popen,
    frames: int,
    console: Console,
) -> None:
    """Show what is captured and received until both processes have ended, one has failed, or nothing moves."""
    seen, moved_s = (0, 0), time.monotonic()
    with _bar(console) as progress:
        tasks = [progress.add_task(name, total=frames) for name in ("captured", "received")]
        while flight.poll() is None or ground.poll() is None:
            if flight.poll() or ground.poll():  # a failure; the other side would wait for ever
                return
            counts = (_lines(store / "index.jsonl"), _lines(session / "frames.jsonl"))
            for task, count in zip(tasks, counts, strict=True):
                progress.update(task, completed=count)
            if counts != seen:
                seen, moved_s = counts, time.monotonic()
            if time.monotonic() - moved_s > PATIENCE_S:
                raise DemoError(f"the pass stalled at {counts[0]} captured, {counts[1]} received of {frames}")
            time.sleep(0.2)
        for task in tasks:
            progress.update(task, completed=frames)


def _lines(path: Path) -> int:
    return path.read_bytes().count(b"\n") if path.exists() else 0


def _digests(path: Path, key: str) -> dict[int, str]:
    lines = path.read_text().splitlines() if path.exists() else []
    records = [json.loads(line) for line in lines]
    return {record[key]: record["sha256"] for record in records}


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
    table = Table(title="The pass and its model", show_header=False)
    for label, value in (
        ("frames captured / received", f"{f['frames_captured']} / {f['frames_received']}, sha256 equal"),
        ("bytes down the line / lost", f"{f['line_bytes_down']:,} / {f['line_bytes_lost']:,}"),
        (
            "clean held-out PSNR",
            f"{f['psnr_clean_db']:.2f} dB ({f['psnr_clean_blind_db']:.2f} dB blind to exposure)",
        ),
        ("Chamfer distance", f"{f['chamfer']:.4f} (largest dimension = 2)"),
        ("Gaussians", f"{f['gaussians']:,}"),
        ("ONNX renderer agrees to", f"{f['onnx_parity_db']:.1f} dB"),
        ("training / everything", f"{f['train_seconds']:.0f} s / {f['seconds']:.0f} s"),
    ):
        table.add_row(label, value)
    return table
