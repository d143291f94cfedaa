"""flightsw: capture, downlink, serve, triage, plan, fsck."""

import contextlib
import dataclasses
import json
import logging
import math
import signal
import threading
import time
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from flightsw.cameras import open_camera
from flightsw.cameras.reconnecting import RETRY_S, ReconnectingCamera
from flightsw.commands import ReplayCounter
from flightsw.downlink import DownlinkProgress, run_downlink
from flightsw.errors import CaptureError
from flightsw.fsck import fsck
from flightsw.icd.can import FLIGHT_SIDE
from flightsw.icd.config import ConfigError
from flightsw.icd.mission import BracketSection, Mission, load_mission
from flightsw.ports import Link, open_link
from flightsw.sequencer import CaptureCounts, capture, plan
from flightsw.settings import load_settings
from flightsw.store import FrameStore, open_store
from obbgs_base.command_line import new_app, run

log = logging.getLogger(__name__)
app = new_app("The flight side: what flies.")
stderr = Console(stderr=True)
LINGER_S = 0.5  # after the last delivery
START_NOW_S = 2.0  # from the command to the first trigger of --start now: a camera takes a second to open

MissionFile = Annotated[Path, typer.Option("--mission", help="The mission file.")]
StoreDir = Annotated[Path, typer.Option("--store", help="The frame store.")]
BracketMs = Annotated[
    str | None, typer.Option("--bracket", help="Exposure times, ms, comma separated, or auto.")
]
Count = Annotated[int | None, typer.Option(help="Number of brackets.")]
Duration = Annotated[
    float | None, typer.Option("--for", help="Seconds of brackets, instead of --count.", min=0.0)
]
Start = Annotated[str | None, typer.Option(help="First trigger: now, or UTC as 2026-07-21T10:52:30Z.")]
Interval = Annotated[float | None, typer.Option(help="Seconds from one trigger to the next.")]
CameraUrl = Annotated[
    str, typer.Option("--camera", help="hil:///path/to/socket, hil://host:port or gige://ID.")
]
LinkUrl = Annotated[str, typer.Option("--link", help="serial:///dev/ttyUSB0?baud=921600")]
KeyFile = Annotated[
    Path | None, typer.Option("--key", help="The mission's key; without it no command is taken.")
]
AsJson = Annotated[bool, typer.Option("--json", help="Print the result as JSON.")]


@app.command("capture")
def capture_command(
    camera: CameraUrl,
    bracket: BracketMs = None,
    count: Count = None,
    interval: Interval = None,
    duration: Duration = None,
    start: Start = None,
    mission: MissionFile = Path("mission.yaml"),
    store: StoreDir = Path("store"),
    link: Annotated[str | None, typer.Option(help="Send the frames too, until the outbox is empty.")] = None,
    json_: AsJson = False,
) -> None:
    """Take exposure brackets, tag and store them; started again, it takes what the store does not hold.

    A simulated camera lives in the mission's time. A real one waits for each exposure's time: --start now on a bench.

    Example: flightsw capture --bracket 0.05,0.1,0.2 --count 40 --camera hil:///tmp/camera.sock --store store
    """
    plan_of = with_bracket(load_mission(mission), bracket, count, interval, duration, start)
    _run(plan_of, store, camera, link, exit_when_empty=True, as_json=json_)


@app.command()
def serve(
    camera: CameraUrl,
    link: LinkUrl,
    mission: MissionFile = Path("mission.yaml"),
    store: StoreDir = Path("store"),
    key: KeyFile = None,
    json_: AsJson = False,
) -> None:
    """Capture the planned pass, send frames and take commands until stopped (SIGTERM or Ctrl-C end it cleanly).

    Example: flightsw serve --camera hil:///tmp/camera.sock --link serial:///dev/ttyUSB0?baud=921600 --key mission.key
    """
    _run(load_mission(mission), store, camera, link, exit_when_empty=False, as_json=json_, key_file=key)


@app.command()
def downlink(
    link: LinkUrl,
    mission: MissionFile = Path("mission.yaml"),
    store: StoreDir = Path("store"),
    exit_when_empty: Annotated[bool, typer.Option(help="Stop when every frame is confirmed.")] = False,
    key: KeyFile = None,
    json_: AsJson = False,
) -> None:
    """Send the outbox, each frame until the ground confirms it, in the mission's or the commanded order.

    Example: flightsw downlink --link serial:///dev/ttyUSB0?baud=921600 --store store --exit-when-empty
    """
    _run(load_mission(mission), store, None, link, exit_when_empty, as_json=json_, key_file=key)


@app.command()
def triage(
    model: Annotated[Path, typer.Option(help="The uplinked model.onnx.")],
    frames: Annotated[Path, typer.Option(help="A frame store, or a folder of .obf containers.")],
    mission: MissionFile = Path("mission.yaml"),
    top: Annotated[int, typer.Option(help="How many to print.")] = 20,
    json_: AsJson = False,
) -> None:
    """Rank stored frames by how badly the model predicts them and how new their view is, as the downlink would.

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
    """Print the planned pass: each bracket's time, range, light, exposures and expected counts; passes and eclipses.

    Example: flightsw plan --mission mission.yaml
    """
    from flightsw.planning import pass_plan

    planned = pass_plan(load_mission(mission))
    if json_:
        print(json.dumps(dataclasses.asdict(planned)))
        return
    print(
        "bracket  UTC                       range m  phase deg  Sun deg  px/m  light    pose   exposures ms -> DN"
    )
    for b in planned.brackets:
        exposures = ", ".join(
            f"{t:g} -> {dn}" for t, dn in zip(b.exposure_times_ms, b.expected_dn, strict=True)
        )
        print(
            f"{b.bracket:7d}  {b.utc}  {b.range_m:7.1f}  {b.phase_deg:9.1f}  {b.sun_deg:7.1f}  {b.px_per_m:4.1f}  "
            f"{'eclipse' if b.eclipse else 'sunlit '}  {'valid' if b.pose_valid else 'stale'}  {exposures}"
        )
    for p in planned.passes:
        print(
            f"pass: brackets {p.first_bracket} to {p.last_bracket}, {p.start_utc} to {p.end_utc}, {p.frames} frames, "
            f"range {p.range_m[0]:.0f} to {p.range_m[1]:.0f} m, phase {p.phase_deg[0]:.0f} to {p.phase_deg[1]:.0f} deg"
        )
    for utc, change in planned.shadow:
        print(f"shadow: the target {change} it at {utc}")


@app.command("fsck")
def fsck_command(
    store: StoreDir = Path("store"),
    check: Annotated[bool, typer.Option("--check", help="Report only, change nothing.")] = False,
    json_: AsJson = False,
) -> None:
    """Check a frame store and repair it; damaged containers go to quarantine/. Stop `flightsw` first.

    Exits with 1 when the store is damaged and --check leaves it so, or when frames were lost.

    Example: flightsw fsck --store store
    """
    report = fsck(store, repair=not check)
    if json_:
        print(json.dumps(dataclasses.asdict(report)))
    else:
        for problem in report.problems:
            print(problem)
        print(
            f"{report.frames} good frames, {report.waiting} to be delivered, {report.quarantined} quarantined, "
            f"{report.missing} missing, {len(report.problems)} problems {'found' if check else 'mended'}"
        )
    if report.quarantined or report.missing or (check and report.problems):
        raise typer.Exit(1)


def with_bracket(
    mission: Mission,
    bracket: str | None,
    count: int | None,
    interval: float | None,
    duration: float | None = None,
    start: str | None = None,
) -> Mission:
    """Return the mission with the bracket section and the first trigger changed by the command line.

    Raises:
        ConfigError: a value is not a number or out of range.
    """
    changes: dict[str, Any] = {}
    if bracket == "auto":
        changes["auto"] = True
    elif bracket is not None:
        changes["auto"] = False
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
    if duration is not None:
        if count is not None:
            raise ConfigError("--for", "says how many brackets, as --count does; give one of them")
        spacing_s = mission.bracket.interval_s if interval is None else interval
        changes["count"] = max(1, math.ceil(duration / spacing_s))
    section: BracketSection = dataclasses.replace(mission.bracket, **changes)
    orbit = mission.orbit
    if start is not None:
        now = datetime.now(UTC) + timedelta(seconds=START_NOW_S)
        orbit = dataclasses.replace(orbit, start_utc=now.isoformat() if start == "now" else start)
    return dataclasses.replace(mission, bracket=section, orbit=orbit)


def _run(
    mission: Mission,
    store_dir: Path,
    camera_url: str | None,
    link_url: str | None,
    exit_when_empty: bool,
    as_json: bool,
    key_file: Path | None = None,
) -> None:
    """Capture and downlink side by side, whichever are asked for; print what became of every frame.

    Key, link and camera come before the store: wrong ones leave none behind.
    """
    stop = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: stop.set())
    signal.signal(signal.SIGINT, lambda *_: stop.set())
    captured = CaptureCounts()
    sent = DownlinkProgress()
    with contextlib.ExitStack() as opened, _progress() as progress:
        counter = link = camera = no_camera = None
        if link_url is not None:
            counter = ReplayCounter(key_file) if key_file is not None else None
            if counter is not None:
                opened.callback(counter.close)
            link = opened.enter_context(open_link(link_url, FLIGHT_SIDE))
        if camera_url is not None:
            try:
                camera = ReconnectingCamera(open_camera(camera_url, mission.camera), stop.wait)
                opened.callback(camera.close)
            except CaptureError as error:
                if link is None:
                    raise
                no_camera = error  # what is stored goes down all the same
        store = open_store(store_dir, mission)
        capturing = threading.Event()
        thread = None
        if link is not None:
            task = progress.add_task("sent", total=None)

            def report_sent(now: DownlinkProgress) -> None:
                progress.update(task, completed=now.delivered, total=now.delivered + now.waiting)

            if camera_url is not None:
                capturing.set()
            thread = _Downlink(
                FrameStore(store_dir),
                link,
                mission,
                counter,
                exit_when_empty,
                capturing,
                stop,
                report_sent,
                camera,
            )
            thread.start()
        try:
            if no_camera is not None:
                raise no_camera
            if camera is not None:
                shots = len(list(plan(mission)))
                note = thread.note_capture if thread is not None else lambda counts: None
                captured = _capture(mission, camera, store, progress, shots, stop, note)
        except Exception as error:
            if thread is not None:  # it goes on until the outbox is empty or for ever: say now what is wrong
                thread.camera_failed = True
                log.error("no more exposures: %s", str(error) or repr(error))
            raise
        finally:
            capturing.clear()
            if thread is not None:
                thread.join()
        if thread is not None:
            if thread.error:
                raise thread.error
            sent = thread.result
    left = FrameStore(store_dir)  # opened again: the downlink has its own
    result: dict[str, Any] = {"frames_stored": len(left.frames), "outbox": len(left.outbox())}
    if camera_url is not None:
        result["capture"] = vars(captured) | {"camera_losses": camera.losses if camera else 0}
    if link_url is not None:
        result["downlink"] = dataclasses.asdict(sent)
    if as_json:
        print(json.dumps(result))
    else:
        if camera_url is not None:
            print(
                f"captured {captured.stored} frames, {captured.already_stored} were there, {captured.failed} failed, "
                f"{captured.refused} refused, {captured.pose_invalid} without a valid pose"
            )
            if camera is not None and camera.losses:
                times = "once" if camera.losses == 1 else f"{camera.losses} times"
                print(
                    f"the camera was lost {times}"
                    f"{' and never came back' if camera.lost else ''}: {captured.lost_with_camera} exposures "
                    f"of {captured.brackets_short} brackets were not taken"
                )
        if link_url is not None:
            print(f"delivered {sent.delivered} frames, {sent.segments_resent} segments resent")
        print(f"{result['frames_stored']} frames in {store_dir}, {result['outbox']} still to be delivered")
    if captured.failed or captured.refused or (exit_when_empty and link_url is not None and result["outbox"]):
        raise typer.Exit(1)


def _capture(
    mission: Mission,
    camera: ReconnectingCamera,
    store: FrameStore,
    progress: Progress,
    shots: int,
    stop: threading.Event,
    on_counts: Callable[[CaptureCounts], None],
) -> CaptureCounts:
    task = progress.add_task("captured", total=shots)

    def wait_until(utc_ns: int) -> None:
        while camera.waits and not stop.is_set() and (left_s := (utc_ns - time.time_ns()) / 1e9) > 0:
            camera.reconnect()
            stop.wait(min(left_s, RETRY_S) if camera.lost else left_s)

    def on_frame(counts: CaptureCounts) -> None:
        counts.packets_lost = camera.packets_lost
        progress.update(task, completed=counts.planned)
        on_counts(counts)

    counts = capture(
        mission,
        camera,
        store,
        on_frame=on_frame,
        should_stop=stop.is_set,
        wait_until=wait_until,
        settings=lambda: load_settings(store.folder, mission),
    )
    if camera.lost:
        log.error("the camera did not come back: %d exposures were not taken", counts.lost_with_camera)
    return counts


class _Downlink(threading.Thread):
    """Sends while frames are being taken; an error is kept for the main thread."""

    def __init__(
        self,
        store: FrameStore,
        link: Link,
        mission: Mission,
        counter: ReplayCounter | None,
        exit_when_empty: bool,
        capturing: threading.Event,
        stop: threading.Event,
        on_progress: Callable[[DownlinkProgress], None],
        camera: ReconnectingCamera | None,
    ):
        super().__init__(name="downlink", daemon=True)
        self.store, self.link, self.mission, self.counter = store, link, mission, counter
        self.captured = CaptureCounts()
        self.camera, self.camera_failed = camera, False
        self.exit_when_empty, self.capturing, self.stop, self.on_progress = (
            exit_when_empty,
            capturing,
            stop,
            on_progress,
        )
        self.empty_since_s: float | None = None
        self.result = DownlinkProgress()
        self.error: Exception | None = None

    def run(self) -> None:
        try:
            self.result = run_downlink(
                self.store,
                self.link,
                self.mission,
                on_progress=self._keep,
                should_stop=self._should_stop,
                counter=self.counter,
                capture_values=self._capture_values,
            )
        except Exception as error:  # of this thread nothing else would remain; the main thread raises it
            self.error = error
            if self.capturing.is_set():  # perhaps for hours
                log.error("the downlink has ended, frames are only stored: %s", str(error) or repr(error))

    def note_capture(self, counts: CaptureCounts) -> None:
        self.captured = counts

    def _capture_values(self) -> dict[str, Any]:
        """Return what capture knows of the housekeeping packet."""
        state = "capturing" if self.capturing.is_set() else "pass done" if self.captured.planned else "none"
        is_lost = self.camera is not None and self.camera.lost
        state = "failed" if self.camera_failed or is_lost else state
        counts = {"frames_failed": self.captured.failed, "frames_refused": self.captured.refused}
        return {"camera": state} | counts

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
    """Run the command line."""
    threading.excepthook = log_dead_thread
    run(app, "flightsw")


def log_dead_thread(end: threading.ExceptHookArgs) -> None:
    """Log what ended a thread as an error; while there is a link, the ground gets it as an event."""
    name = end.thread.name if end.thread else "unknown"
    log.error("the thread %s has ended: %r", name, end.exc_value, exc_info=end.exc_value)


if __name__ == "__main__":
    main()
