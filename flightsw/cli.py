"""The command line `flightsw`: mission new, plan, selftest, capture, downlink, serve, service, triage, fsck."""

import dataclasses
import json
import logging
import threading
from collections.abc import Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from flightsw.capture.sequencer import plan
from flightsw.downlink.loop import DownlinkProgress
from flightsw.icd.config import ConfigError, keys_below, require
from flightsw.icd.mission import BracketSection, Mission, load_mission
from flightsw.run import RunResult, run_pass
from flightsw.storage.fsck import fsck
from obbgs_base.command_line import (
    BRACKET_HELP,
    CAMERA_HELP,
    KEY_HELP,
    LINK_HELP,
    MISSION_HELP,
    OUT_HELP,
    START_HELP,
    AsJson,
    new_app,
    run,
)
from obbgs_base.errors import counted
from obbgs_base.output import output_may_fail
from obbgs_base.stopping import stop_on_signals

log = logging.getLogger(__name__)
app = new_app("The flight software: takes frames, stores them, sends them down and obeys commands.")
mission_app = new_app("Mission files.")
app.add_typer(mission_app, name="mission", help="Make a mission file.")
stderr = Console(stderr=True)
START_NOW_S = 2.0  # from the command to the first trigger of --start now: a camera takes a second to open

MissionFile = Annotated[Path, typer.Option("--mission", help=f"{MISSION_HELP}.")]
StoreDir = Annotated[Path, typer.Option("--store", help="The folder of the frame store.")]
BracketMs = Annotated[
    str | None,
    typer.Option("--bracket", help=f"{BRACKET_HELP}; auto: chosen by what was seen. Default: the mission's."),
]
Count = Annotated[int | None, typer.Option(help="Number of brackets; default: the mission's.")]
Start = Annotated[
    str | None,
    typer.Option(help=f"{START_HELP}; or now. Default: the mission's."),
]
CameraUrl = Annotated[
    str,
    typer.Option("--camera", help=f"{CAMERA_HELP}."),
]
LinkUrl = Annotated[str, typer.Option("--link", help=f"{LINK_HELP}.")]
KeyFiles = Annotated[
    list[Path] | None,
    typer.Option(
        "--key",
        help=f"{KEY_HELP}; can be repeated, for the key that takes the other's place. Without a usable one every "
        "command is refused.",
    ),
]


@app.command("capture")
def capture_command(
    camera: CameraUrl,
    bracket: BracketMs = None,
    count: Count = None,
    start: Start = None,
    mission: MissionFile = Path("mission.yaml"),
    store: StoreDir = Path("store"),
    link: Annotated[
        str | None, typer.Option(help=f"{LINK_HELP}: send the frames over it too, until all are confirmed.")
    ] = None,
    json_: AsJson = False,
) -> None:
    """Take exposure brackets, tag and store them; started again, it takes what the store does not hold.

    With a real camera flightsw waits for the planned time of each exposure: give --start now on a bench. A simulated
    camera lives in the mission's time and takes each exposure at once.

    Example: flightsw capture --bracket 0.05,0.1,0.2 --count 40 --camera hil:///tmp/camera.sock --store store
    """
    plan_of = with_bracket(load_mission(mission), bracket, count, start)
    _run(plan_of, store, camera, link, exit_when_empty=True, as_json=json_)


@app.command()
def serve(
    camera: CameraUrl,
    link: LinkUrl,
    mission: MissionFile = Path("mission.yaml"),
    store: StoreDir = Path("store"),
    key: KeyFiles = None,
    start: Start = None,
    json_: AsJson = False,
) -> None:
    """Take the planned brackets, send frames and obey commands until stopped (SIGTERM or Ctrl-C end it cleanly).

    Example: flightsw serve --camera gige://192.168.0.10 --link 'serial:///dev/ttyS1?baud=921600' --key mission.key
    """
    plan_of = with_bracket(load_mission(mission), start=start)
    _run(plan_of, store, camera, link, exit_when_empty=False, as_json=json_, key_files=key or ())


@app.command()
def downlink(
    link: LinkUrl,
    mission: MissionFile = Path("mission.yaml"),
    store: StoreDir = Path("store"),
    exit_when_empty: Annotated[
        bool, typer.Option("--exit-when-empty", help="Stop when every frame is confirmed.")
    ] = False,
    key: KeyFiles = None,
    json_: AsJson = False,
) -> None:
    """Send the frames that the ground has not confirmed, in the mission's or the commanded order; no camera is needed.

    Example: flightsw downlink --link 'serial:///dev/ttyUSB0?baud=921600' --store store --exit-when-empty
    """
    _run(load_mission(mission), store, None, link, exit_when_empty, as_json=json_, key_files=key or ())


@app.command()
def triage(
    model: Annotated[Path, typer.Option(help="The model, a run's model.onnx.")],
    store: StoreDir = Path("store"),
    mission: MissionFile = Path("mission.yaml"),
    json_: AsJson = False,
) -> None:
    """Rank stored frames by how badly the model predicts them and how new their view is, as the downlink would.

    Example: flightsw triage --model model.onnx --store store
    """
    from flightsw.triage.scores import rank_frames  # only this command needs onnxruntime

    K = np.array(load_mission(mission).camera.K)
    ranked, unreadable = rank_frames(model, store, K)
    if json_:
        rows = [{**vars(r), "path": str(r.path)} for r in ranked]
        print(json.dumps({"ranked": rows, "unreadable": unreadable}))
        return
    print("rank  frame  worst tile chi²  mean chi²  tile (row, column)")
    for place, r in enumerate(ranked, start=1):
        print(
            f"{place:4d}  {r.frame_id:5d}  {r.worst_chi2:15.2f}  {r.mean_chi2:9.3f}  "
            f"({r.tile_row_px}, {r.tile_column_px})"
        )
    if unreadable:
        stderr.print(f"{counted(unreadable, 'container')} could not be read")


@app.command("plan")
def plan_command(mission: MissionFile = Path("mission.yaml"), json_: AsJson = False) -> None:
    """Print field of view and planned brackets: time, range, light, readings to expect; then passes and eclipses.

    Fills is the target's largest dimension as a share of the picture's smaller side. Phase is the angle between Sun
    and camera as the target sees it, Sun the angle between line of sight and Sun, DN the brightest reading to expect of
    a white target: that of a surface turned to the Sun up to a phase of 90 degrees, less beyond it and where the target
    is smaller than a pixel, and the black level in eclipse.

    Example: flightsw plan --mission mission.yaml
    """
    from flightsw.capture.planning import pass_plan

    loaded = load_mission(mission)
    planned = pass_plan(loaded)
    if json_:
        print(json.dumps(dataclasses.asdict(planned)))
        return
    print(f"camera: {planned.view}")
    bracket = loaded.bracket
    print(f"exposures: {bracket.spacing_s():g} s apart, a bracket every {bracket.interval_s:g} s")
    if loaded.navigation.source != "sgp4":
        print(
            f"orbits: by the two-line elements; during the pass states come from {loaded.navigation.source}"
        )
    for problem in planned.problems:
        print(f"warning: {problem}")
    print(
        "bracket  UTC                       range m  phase deg  Sun deg  px/m  fills  light    pose   "
        "exposures ms -> DN"
    )
    for b in planned.brackets:
        exposures = ", ".join(
            f"{t:g} -> {dn}" for t, dn in zip(b.exposure_times_ms, b.expected_dn, strict=True)
        )
        print(
            f"{b.bracket:7d}  {b.utc}  {b.range_m:7.1f}  {b.phase_deg:9.1f}  {b.sun_deg:7.1f}  {b.px_per_m:4.1f}  "
            f"{b.filled:5.0%}  "
            f"{'eclipse' if b.eclipse else 'sunlit '}  {'valid' if b.pose_valid else 'stale'}  {exposures}"
        )
    for p in planned.passes:
        print(
            f"pass: brackets {p.first_bracket} to {p.last_bracket}, {p.start_utc} to {p.end_utc}, "
            f"{counted(p.frames, 'frame')}, range {p.range_m[0]:.0f} to {p.range_m[1]:.0f} m, "
            f"phase {p.phase_deg[0]:.0f} to {p.phase_deg[1]:.0f} deg"
        )
    for utc, change in planned.shadow:
        print(f"shadow: the target {change} it at {utc}")


@app.command("service")
def service_command(
    camera: CameraUrl,
    link: LinkUrl,
    json_: AsJson = False,
) -> None:
    """Print the systemd unit that runs `flightsw serve` of this installation as a user of its own, obbgs.

    Its mission file is /etc/obbgs/mission.yaml; frames are kept in /var/lib/obbgs/store, the key in mission.key beside
    it. The unit's first lines say how to make the user and where to put the unit.

    Example: flightsw service --camera gige://192.168.0.10 --link 'can://can0?fd=1' > obbgs-flight.service
    """
    from flightsw.service import unit

    text = unit(camera, link)
    print(json.dumps({"unit": text}) if json_ else text, end="\n" if json_ else "")


@mission_app.command("new")
def mission_new(
    out: Annotated[Path, typer.Option(help=f"{OUT_HELP}; a file that is there is not replaced.")],
    target_tle: Annotated[
        Path, typer.Option(help="A file with the target's two-line elements, or an OMM of CCSDS.")
    ],
    chaser_tle: Annotated[Path, typer.Option(help="The same of the spacecraft with the camera.")],
    target_size: Annotated[float, typer.Option(help="The target's largest dimension, m.")],
    picture: Annotated[
        str, typer.Option(help="Width and height of the picture, px; 1024x768x3: in colour.")
    ] = "1024x1024",
    focal_length: Annotated[float, typer.Option(help="Of the lens, mm.")] = 100.0,
    pixel_pitch: Annotated[float, typer.Option(help="From one pixel to the next, micrometres.")] = 5.5,
    start: Annotated[
        str | None, typer.Option(help=f"{START_HELP}; or now. Default: an hour from now.")
    ] = None,
    json_: AsJson = False,
) -> None:
    """Write a mission file, commented as the example is; then look at it with plan, and calibrate the camera.

    Example: flightsw mission new --out mission.yaml --target-tle target.tle --chaser-tle chaser.tle --target-size 6
    """
    from flightsw.new_mission import write_mission

    write_mission(
        out,
        target_tle,
        chaser_tle,
        target_size,
        picture,
        focal_length,
        pixel_pitch,
        start,
    )
    if json_:
        print(json.dumps({"mission": str(out)}))
        return
    print(f"wrote {out}; next: flightsw plan --mission {out}, and the calibrated figures of the camera")


@app.command()
def selftest(
    camera: Annotated[str | None, typer.Option("--camera", help=f"{CAMERA_HELP}: takes one bracket.")] = None,
    link: Annotated[
        str | None, typer.Option("--link", help=f"{LINK_HELP}: is opened, and packets are sent.")
    ] = None,
    loopback: Annotated[
        bool,
        typer.Option(
            "--loopback",
            help="Test that packets come back: by a plug on a serial line, by a second socket on a CAN interface.",
        ),
    ] = False,
    mission: MissionFile = Path("mission.yaml"),
    store: StoreDir = Path("store"),
    key: Annotated[
        list[Path] | None,
        typer.Option("--key", help=f"{KEY_HELP}: is checked with its counter; can be repeated."),
    ] = None,
    json_: AsJson = False,
) -> None:
    """Check clock, disk, computer and orbital elements, and key, link and camera if they are named; stop flight first.

    Says for each what was found and, where something is wrong, what to do. Exits with 1 when a check failed; a warning
    leaves 0.

    Example: flightsw selftest --camera gige://192.168.0.10 --link 'serial:///dev/ttyS1?baud=921600' --key mission.key
    """
    from flightsw.selftest import Finding, self_test

    def show(finding: Finding) -> None:
        if not json_:
            print(f"{finding.state:8} {finding.check:11} {finding.found}")
            if finding.advice:
                print(f"{'':20} -> {finding.advice}")

    require(link is not None or not loopback, "--loopback", "tests a link: name it with --link")
    findings = self_test(load_mission(mission), store, camera, link, loopback, key or (), on_finding=show)
    failed = sum(finding.state == "failed" for finding in findings)
    if json_:
        print(json.dumps({"ok": not failed, "findings": [dataclasses.asdict(f) for f in findings]}))
    if failed:
        raise typer.Exit(1)


@app.command("fsck")
def fsck_command(
    store: StoreDir = Path("store"),
    check: Annotated[bool, typer.Option("--check", help="Report only, change nothing.")] = False,
    json_: AsJson = False,
) -> None:
    """Check a frame store and repair it; damaged frames go to its quarantine/. Stop flight first.

    Exits with 1 when the store is damaged and --check leaves it so, or when frames were lost.

    Example: flightsw fsck --store store
    """
    report = fsck(store, repair=not check)
    if json_:
        print(json.dumps(dataclasses.asdict(report)))
    else:
        for problem in report.problems:
            print(problem)
        print(report.sentence("found" if check else "repaired"))
    if report.quarantined or report.missing or (check and report.problems):
        raise typer.Exit(1)


def with_bracket(
    mission: Mission,
    bracket: str | None = None,
    count: int | None = None,
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
    with (
        keys_below("--count", "mission.bracket.count"),
        keys_below("--bracket", "mission.bracket.exposure_times_ms"),
    ):
        section: BracketSection = dataclasses.replace(mission.bracket, **changes)
    orbit = mission.orbit
    if start is not None:
        now = datetime.now(UTC) + timedelta(seconds=START_NOW_S)
        with keys_below("--start", "mission.orbit.start_utc"):
            orbit = dataclasses.replace(orbit, start_utc=now.isoformat() if start == "now" else start)
    return dataclasses.replace(mission, bracket=section, orbit=orbit)


@output_may_fail(log)
def _run(
    mission: Mission,
    store_dir: Path,
    camera_url: str | None,
    link_url: str | None,
    exit_when_empty: bool,
    as_json: bool,
    key_files: Sequence[Path] = (),
) -> None:
    """Capture and send, whichever are asked for, with a bar for each; print what became of every frame."""
    stop = stop_on_signals()
    shots = len(list(plan(mission))) if camera_url is not None else None
    with _progress() as progress:
        sent_bar = progress.add_task("sent", total=None, visible=link_url is not None)
        captured_bar = progress.add_task("captured", total=shots, visible=False)

        def show_sent(now: DownlinkProgress) -> None:
            progress.update(sent_bar, completed=now.delivered, total=now.delivered + now.waiting)

        result = run_pass(
            mission,
            store_dir,
            stop,
            camera_url=camera_url,
            link_url=link_url,
            key_files=key_files,
            exit_when_empty=exit_when_empty,
            on_captured=lambda now: progress.update(captured_bar, completed=now.planned, visible=True),
            on_sent=show_sent,
        )
    if as_json:
        print(json.dumps(result.tree()))
    else:
        _print_result(result, store_dir)
    captured = result.captured
    not_all_stored = captured is not None and (captured.failed or captured.refused or captured.dropped)
    if not_all_stored or (exit_when_empty and link_url is not None and result.outbox):
        raise typer.Exit(1)


def _print_result(result: RunResult, store_dir: Path) -> None:
    if (captured := result.captured) is not None:
        print(
            f"captured {counted(captured.stored, 'frame')}, {captured.already_stored} were taken before, "
            f"{captured.failed} failed, {captured.refused} refused, {captured.pose_invalid} without a valid pose"
        )
        if captured.dropped:
            print(f"deleted {counted(captured.dropped, 'frame')} undelivered to make room (store.when_full)")
        if captured.skipped:
            print(f"{counted(captured.skipped, 'exposure')} not taken: safe mode")
        if result.camera_losses:
            times = "once" if result.camera_losses == 1 else f"{result.camera_losses} times"
            lost = (
                f"{counted(captured.lost_with_camera, 'exposure')} of "
                f"{counted(captured.brackets_short, 'bracket')} not taken"
                if captured.lost_with_camera
                else "no exposure was lost with it"
            )
            print(
                f"the camera was lost {times}{' and never came back' if result.camera_is_lost else ''}: {lost}"
            )
    if result.sent is not None:
        resent = counted(result.sent.segments_resent, "segment")
        print(f"delivered {counted(result.sent.delivered, 'frame')}, {resent} resent")
    print(f"{counted(result.frames_stored, 'frame')} in {store_dir}, {result.outbox} still to be delivered")


def _progress() -> Progress:
    return Progress(
        TextColumn("{task.description:>9}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        console=stderr,
        transient=True,
        disable=not stderr.is_terminal,  # elsewhere nothing is left of it but an empty line
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
