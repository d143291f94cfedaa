"""flightsw: capture, downlink, serve, triage, plan."""

import dataclasses
import json
import logging
import signal
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from flightsw.cameras import open_camera
from flightsw.downlink import DownlinkProgress, run_downlink
from flightsw.errors import FlightError
from flightsw.icd.mission import BracketSection, ConfigError, Mission, load_mission
from flightsw.link import SerialLink
from flightsw.pose import pose_tag
from flightsw.sequencer import CaptureCounts, capture, plan
from flightsw.store import FrameStore

app = typer.Typer(add_completion=False, no_args_is_help=True, help="The flight side: what flies.")
stderr = Console(stderr=True)
LINGER_S = 0.5  # after the last delivery

MissionFile = Annotated[Path, typer.Option("--mission", help="The mission file.")]
StoreDir = Annotated[Path, typer.Option("--store", help="The frame store.")]
BracketMs = Annotated[str | None, typer.Option("--bracket", help="Exposure times, ms, comma separated.")]
Count = Annotated[int | None, typer.Option(help="Number of brackets.")]
Interval = Annotated[float | None, typer.Option(help="Seconds from one trigger to the next.")]
CameraUrl = Annotated[str, typer.Option("--camera", help="hil:///path/to/socket or hil://host:port.")]
LinkUrl = Annotated[str, typer.Option("--link", help="serial:///dev/ttyUSB0?baud=921600")]
AsJson = Annotated[bool, typer.Option("--json", help="Print the result as JSON.")]


@app.command("capture")
def capture_command(
    camera: CameraUrl,
    bracket: BracketMs = None,
    count: Count = None,
    interval: Interval = None,
    mission: MissionFile = Path("mission.yaml"),
    store: StoreDir = Path("store"),
    link: Annotated[str | None, typer.Option(help="Send the frames too, until the outbox is empty.")] = None,
    json_: AsJson = False,
) -> None:
    """Take exposure brackets, tag and store them.

    Example: flightsw capture --bracket 0.05,0.1,0.2 --count 40 --camera hil:///tmp/camera.sock --store store
    """
    plan_of = with_bracket(load_mission(mission), bracket, count, interval)
    _run(plan_of, store, camera, link, exit_when_empty=True, as_json=json_)


@app.command()
def serve(
    camera: CameraUrl,
    link: LinkUrl,
    mission: MissionFile = Path("mission.yaml"),
    store: StoreDir = Path("store"),
    json_: AsJson = False,
) -> None:
    """Capture the planned pass and send frames until stopped (SIGTERM or Ctrl-C end it cleanly).

    Example: flightsw serve --camera hil:///tmp/camera.sock --link serial:///dev/ttyUSB0?baud=921600
    """
    _run(load_mission(mission), store, camera, link, exit_when_empty=False, as_json=json_)


@app.command()
def downlink(
    link: LinkUrl,
    mission: MissionFile = Path("mission.yaml"),
    store: StoreDir = Path("store"),
    exit_when_empty: Annotated[bool, typer.Option(help="Stop when every frame is confirmed.")] = False,
    json_: AsJson = False,
) -> None:
    """Send the outbox, oldest frame first, each until the ground confirms it.

    Example: flightsw downlink --link serial:///dev/ttyUSB0?baud=921600 --store store --exit-when-empty
    """
    _run(load_mission(mission), store, None, link, exit_when_empty=exit_when_empty, as_json=json_)


@app.command()
def triage(
    model: Annotated[Path, typer.Option(help="The uplinked model.onnx.")],
    frames: Annotated[Path, typer.Option(help="A frame store, or a folder of .obf containers.")],
    mission: MissionFile = Path("mission.yaml"),
    top: Annotated[int, typer.Option(help="How many to print.")] = 20,
    json_: AsJson = False,
) -> None:
    """Rank stored frames by how badly the model predicts them.

    Example: flightsw triage --model model.onnx --frames store
    """
    from flightsw.triage import rank_frames  # only this command needs onnxruntime

    K = np.array(load_mission(mission).camera.K)
    ranked, unreadable = rank_frames(model, frames, K)
    if json_:
        rows = [{**vars(r), "path": str(r.path)} for r in ranked]
        print(json.dumps({"ranked": rows, "unreadable": unreadable}))
        return
    print("rank  frame  worst tile chi²  mean chi²  tile (row, column)")
    for place, r in enumerate(ranked[:top], start=1):
        print(
            f"{place:4d}  {r.frame_id:5d}  {r.worst_chi2:15.2f}  {r.mean_chi2:9.3f}  "
            f"({r.tile_row_px}, {r.tile_column_px})"
        )
    if unreadable:
        stderr.print(f"{unreadable} containers could not be read")


@app.command("plan")
def plan_command(mission: MissionFile = Path("mission.yaml"), json_: AsJson = False) -> None:
    """Print each planned bracket: time, range, phase angle, eclipse.

    Example: flightsw plan --mission mission.yaml
    """
    loaded = load_mission(mission)
    rows: list[dict[str, Any]] = []
    for shot in plan(loaded):
        if shot.bracket_index:
            continue
        tag = pose_tag(loaded, shot.mid_exposure_utc_ns)
        range_m = float(np.linalg.norm(tag.position_body_m))
        cos_phase = tag.position_body_m @ tag.sun_dir_body / range_m
        rows.append(
            {
                "bracket": shot.bracket_id,
                "utc": str(np.datetime64(shot.start_utc_ns, "ns"))[:23] + "Z",
                "range_m": round(range_m, 2),
                "phase_deg": round(float(np.degrees(np.arccos(np.clip(cos_phase, -1, 1)))), 2),
                "px_per_m": round(loaded.camera.fx_px / range_m, 2),
                "eclipse": tag.in_eclipse,
                "pose_valid": tag.valid,
            }
        )
    if json_:
        print(json.dumps(rows))
        return
    print("bracket  UTC                       range m  phase deg  px/m  light    pose")
    for row in rows:
        light = "eclipse" if row["eclipse"] else "sunlit "
        pose = "valid" if row["pose_valid"] else "stale elements"
        print(
            f"{row['bracket']:7d}  {row['utc']}  {row['range_m']:7.1f}  {row['phase_deg']:9.1f}  "
            f"{row['px_per_m']:4.1f}  {light}  {pose}"
        )


def with_bracket(mission: Mission, bracket: str | None, count: int | None, interval: float | None) -> Mission:
    """Return the mission with the bracket section changed by the command line.

    Raises:
        ConfigError: a value is not a number or out of range.
    """
    changes: dict[str, Any] = {}
    if bracket is not None:
        try:
            changes["exposure_times_ms"] = tuple(float(part) for part in bracket.split(","))
        except ValueError as error:
            raise ConfigError(
                "--bracket", f"expected times in ms such as 0.05,0.1,0.2, got {bracket!r}"
            ) from error
    if count is not None:
        changes["count"] = count
    if interval is not None:
        changes["interval_s"] = interval
    section: BracketSection = dataclasses.replace(mission.bracket, **changes)
    return dataclasses.replace(mission, bracket=section)


def _run(
    mission: Mission,
    store_dir: Path,
    camera_url: str | None,
    link_url: str | None,
    exit_when_empty: bool,
    as_json: bool,
) -> None:
    """Capture and downlink side by side, whichever are asked for; print what became of every frame."""
    stop = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: stop.set())
    signal.signal(signal.SIGINT, lambda *_: stop.set())
    store = FrameStore(store_dir)
    captured = CaptureCounts()
    sent = DownlinkProgress()
    with _progress() as progress:
        capturing = threading.Event()
        thread = None
        if link_url is not None:
            task = progress.add_task("sent", total=None)

            def report_sent(now: DownlinkProgress) -> None:
                progress.update(task, completed=now.delivered, total=now.delivered + now.waiting)

            link = SerialLink(link_url)  # a port that is not there is known before the first exposure
            if camera_url is not None:
                capturing.set()
            thread = _Downlink(
                FrameStore(store_dir), link, mission, exit_when_empty, capturing, stop, report_sent
            )
            thread.start()
        try:
            if camera_url is not None:
                shots = len(list(plan(mission)))
                captured = _capture(mission, camera_url, store, progress, shots, stop)
        finally:
            capturing.clear()
            if thread is not None:
                thread.join()
                link.close()
        if thread is not None:
            if thread.error:
                raise thread.error
            sent = thread.result
    result: dict[str, Any] = {
        "frames_stored": len(store.frames),
        "outbox": len(FrameStore(store_dir).outbox()),
    }
    if camera_url is not None:
        result["capture"] = vars(captured)
    if link_url is not None:
        result["downlink"] = dataclasses.asdict(sent)
    if as_json:
        print(json.dumps(result))
    else:
        if camera_url is not None:
            print(
                f"captured {captured.stored} frames, {captured.already_stored} were there, {captured.failed} failed"
            )
        if link_url is not None:
            print(f"delivered {sent.delivered} frames, {sent.segments_resent} segments resent")
        print(f"{result['frames_stored']} frames in {store_dir}, {result['outbox']} still to be delivered")
    if captured.failed or (exit_when_empty and link_url is not None and result["outbox"]):
        raise typer.Exit(1)


def _capture(
    mission: Mission,
    camera_url: str,
    store: FrameStore,
    progress: Progress,
    shots: int,
    stop: threading.Event,
) -> CaptureCounts:
    task = progress.add_task("captured", total=shots)
    camera = open_camera(camera_url)
    try:
        return capture(
            mission,
            camera,
            store,
            on_frame=lambda counts: progress.update(task, completed=counts.planned),
            should_stop=stop.is_set,
        )
    finally:
        camera.close()


class _Downlink(threading.Thread):
    """Sends while frames are being taken; an error is kept for the main thread."""

    def __init__(
        self,
        store: FrameStore,
        link: SerialLink,
        mission: Mission,
        exit_when_empty: bool,
        capturing: threading.Event,
        stop: threading.Event,
        on_progress: Callable[[DownlinkProgress], None],
    ):
        super().__init__(name="downlink", daemon=True)
        self.store, self.link, self.mission = store, link, mission
        self.exit_when_empty, self.capturing, self.stop, self.on_progress = (
            exit_when_empty,
            capturing,
            stop,
            on_progress,
        )
        self.empty_since_s: float | None = None
        self.result = DownlinkProgress()
        self.error: FlightError | None = None

    def run(self) -> None:
        try:
            self.result = run_downlink(
                self.store, self.link, self.mission, False, self._keep, should_stop=self._should_stop
            )
        except FlightError as error:
            self.error = error

    def _keep(self, now: DownlinkProgress) -> None:
        self.result = now
        self.on_progress(now)

    def _should_stop(self) -> bool:
        """Tell whether all is delivered; lingers a little, as the ground may ask for its last answer once more."""
        waiting = self.capturing.is_set() or self.result.waiting or not self.exit_when_empty
        if waiting or self.store.outbox():
            self.empty_since_s = None
        elif self.empty_since_s is None:
            self.empty_since_s = time.monotonic()
        done = self.empty_since_s is not None and time.monotonic() - self.empty_since_s > LINGER_S
        return self.stop.is_set() or done


def _progress() -> Progress:
    return Progress(
        TextColumn("{task.description:>9}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        console=stderr,
        transient=True,
    )


def main() -> None:
    """Run the command line; one clear line for what went wrong, exit code 2 for usage and configuration, 1 for work."""
    logging.basicConfig(level=logging.WARNING, format="%(name)s: %(message)s", stream=sys.stderr)
    try:
        app()
    except ConfigError as error:
        sys.exit(_fail(error, 2))
    except FlightError as error:
        sys.exit(_fail(error, 1))
    except ValueError as error:
        sys.exit(_fail(error, 2))


def _fail(error: Exception, code: int) -> int:
    print(f"flightsw: {error}", file=sys.stderr)
    return code


if __name__ == "__main__":
    main()
