"""ground: listen, uplink, key, reconstruct, evaluate, report, import, export."""

import contextlib
import dataclasses
import json
import math
import os
import signal
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.live import Live
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from flightsw.icd.mission import ReconstructSection, load_mission
from ground.progress import Stop, say, steps_shown
from ground.summary import frames_row, model_rows, table
from obbgs_base.command_line import new_app, run

app = new_app("The ground station: frames in, a 3D model out.")
stderr = Console(stderr=True)

SessionDir = Annotated[Path, typer.Option("--session", help="The session folder.")]
RunName = Annotated[str, typer.Option("--name", help="The run's name.")]
RunsDir = Annotated[
    Path | None, typer.Option("--out", help="The folder of runs; default: runs/ in the session.")
]
AsJson = Annotated[bool, typer.Option("--json", help="Print the result as JSON.")]
PLAIN_S = 10.0  # between lines about the link where there is no terminal


@app.command("listen")
def listen_command(
    link: Annotated[str, typer.Option(help="serial:///dev/ttyUSB0?baud=921600")],
    session: SessionDir,
    mission: Annotated[Path, typer.Option(help="The mission file.")] = Path("mission.yaml"),
    exit_after: Annotated[
        int | None, typer.Option(help="Stop when the session holds so many frames.")
    ] = None,
    idle_timeout: Annotated[float | None, typer.Option(help="Stop after so many seconds of silence.")] = None,
    json_: AsJson = False,
) -> None:
    """Receive frames and telemetry into a session folder until stopped, send commands, show the link.

    On a terminal a console; elsewhere a line every ten seconds and each event. --json prints a line a second and each
    event; the last line is the summary.

    Example: ground listen --link serial:///dev/ttyUSB0?baud=921600 --session pass-12
    """
    from ground.ingest import listen

    stop = threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: stop.set())
    with _shown(json_) as (on_status, on_event):
        summary = listen(
            link,
            session,
            load_mission(mission),
            exit_after,
            idle_timeout,
            should_stop=stop.is_set,
            on_status=on_status,
            on_event=on_event,
        )
    if json_:
        print(json.dumps({"type": "summary"} | dataclasses.asdict(summary)))
    else:
        print(f"{summary.frames_received} frames received, {summary.frames_in_session} in {session}")
    if exit_after is not None and summary.frames_in_session < exit_after:
        raise typer.Exit(1)


@contextlib.contextmanager
def _shown(as_json: bool) -> Iterator[tuple[Any, Any]]:
    """Give what shows statuses and events: a screen, lines where there is no terminal, or JSON lines on stdout."""
    from ground.console import ConsoleView
    from ground.ingest import Status
    from ground.telemetry import plain

    view, next_line_s = ConsoleView(), float("-inf")
    live = stderr.is_terminal and not as_json

    def on_status(status: Status) -> None:
        nonlocal next_line_s
        if live:
            screen.update(view.draw(status), refresh=True)
        elif status.now_s >= next_line_s:
            next_line_s = status.now_s + (1.0 if as_json else PLAIN_S)
            if as_json:
                facts = dataclasses.asdict(status)
                facts["housekeeping"] = plain(facts["housekeeping"])
                del facts["events"]  # printed when they came
                print(json.dumps({"type": "status"} | facts), flush=True)
            else:
                stderr.print(view.line(status), markup=False, highlight=False, soft_wrap=True)

    def on_event(event: dict[str, Any]) -> None:
        if as_json:
            print(json.dumps({"type": "event"} | event), flush=True)
        elif not live:
            text = f"{event['severity']}: {event['text']}"
            stderr.print(text, markup=False, highlight=False, soft_wrap=True)

    screen = Live(console=stderr, auto_refresh=False, transient=True)  # drawn here: no thread that could die
    with screen if live else contextlib.nullcontext():
        yield on_status, on_event


@app.command()
def key(
    file: Annotated[Path, typer.Argument(help="Where to write the key.")],
    spi: Annotated[int, typer.Option(min=1, max=65534, help="The key's number.")] = 1,
    json_: AsJson = False,
) -> None:
    """Make the key of a mission's commands. FILE and FILE.received go to the spacecraft, FILE and FILE.sent stay.

    Example: ground key mission.key
    """
    from ground.uplink import make_key

    made = make_key(file, spi)
    if json_:
        print(json.dumps({"file": str(file), "spi": made.spi, "fingerprint": made.fingerprint}))
    else:
        print(f"key {made.spi} ({made.fingerprint}) in {file}; copy it and {file}.received to the spacecraft")


@app.command()
def uplink(
    command: Annotated[
        str, typer.Argument(help="ping, bracket, near, priority, model, arm, delete, safe or resume.")
    ],
    arguments: Annotated[list[str] | None, typer.Argument(help="What the command needs.")] = None,
    session: Annotated[Path, typer.Option("--session", help="The session folder.")] = Path("session"),
    key_file: Annotated[Path, typer.Option("--key", help="The mission's key.")] = Path("mission.key"),
    link: Annotated[str | None, typer.Option(help="The link, if no `ground listen` has it.")] = None,
    mission: Annotated[Path, typer.Option(help="The mission file, with --link.")] = Path("mission.yaml"),
    timeout: Annotated[float, typer.Option(min=0.1, help="Seconds to wait for the end.")] = 120.0,
    json_: AsJson = False,
) -> None:
    """Send a command through the `ground listen` of the session, or through --link, and wait for its end.

    bracket 0.05,0.1,0.2 (ms) · near 2 (DN) · priority oldest|triage|thumbnail-first · model FILE · safe · ping;
    delete FIRST LAST and resume want `arm delete` or `arm resume` just before.

    Example: ground uplink bracket 0.02,0.05,0.1 --session pass-12 --key mission.key
    """
    from ground import uplink as uplinking
    from ground.session import SessionError

    made, model = uplinking.parse_command(command, arguments or [])
    if link is None and not uplinking.is_listening(session):
        raise SessionError(f"no `ground listen` has the link of {session}: start one, or give --link URL")
    counter = uplinking.submit(session, key_file, made, model, timeout)
    end_s = time.monotonic() + timeout + 1.0  # the listener writes the end when the command expires

    def ended() -> bool:
        return uplinking.outcome(session, counter) is not None or time.monotonic() > end_s

    try:
        if link is None:
            while not ended():
                time.sleep(0.05)
        else:
            from ground.ingest import listen

            listen(link, session, load_mission(mission), should_stop=ended)
    finally:
        uplinking.withdraw(session, counter)
    result = uplinking.outcome(session, counter)
    if result is None:
        result = {
            "counter": counter,
            "command": made.name,
            "stage": "failed",
            "text": "nobody sent it",
            "reports": [],
        }
    if json_:
        print(json.dumps(result))
    else:
        for report in result["reports"]:
            print(f"{report['stage']}: {report['text']}")
        if not result["reports"]:
            print(f"{result['stage']}: {result['text']}")
    if result["stage"] != "completed":
        raise typer.Exit(1)


@app.command("reconstruct")
def reconstruct_command(
    session: SessionDir,
    name: RunName = "run",
    out: RunsDir = None,
    method: Annotated[
        str | None, typer.Option(help="obbgs (default), jiang2025, 3dgs, pixel-gs or mvgs.")
    ] = None,
    quality: Annotated[str | None, typer.Option(help="draft, standard (default) or best.")] = None,
    budget: Annotated[
        str, typer.Option(help="Most Gaussians, a number; auto: as many as the frames pay for.")
    ] = "auto",
    steps: Annotated[int | None, typer.Option(min=1, help="Training steps.")] = None,
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", help="A setting of the method, key=value (YAML); may be given again."),
    ] = None,
    mission: Annotated[
        Path | None,
        typer.Option(help="A mission file: its reconstruct section, where no option says otherwise."),
    ] = None,
    time_limit: Annotated[float, typer.Option(help="Seconds for each training.")] = math.inf,
    seed: Annotated[int | None, typer.Option(min=0, help="Same seed, same model; default 7.")] = None,
    blind_reference: Annotated[
        bool, typer.Option(help="Train once more blind to exposure, to compare.")
    ] = False,
    overwrite: Annotated[bool, typer.Option(help="Replace a finished run of the same name.")] = False,
    threads: Annotated[int | None, typer.Option(min=1, help="Cores; default all.")] = None,
    json_: AsJson = False,
) -> None:
    """Train a model on a session, export it, score it and write its report.

    Ctrl-C and SIGTERM save the training and end with exit code 1; the same command goes on from there, and so it does
    after a kill.

    Example: ground reconstruct --session pass-12 --name first --time-limit 120 --set light.sun_shading=linear
    """
    os.environ.setdefault(
        "OMP_WAIT_POLICY", "passive"
    )  # spinning threads cost more than they give; before torch
    from obbgs_base.errors import Interrupted

    stop, folder = Stop(), None
    try:
        with stop.on_signals(), steps_shown(stderr) as show:
            import torch

            from ground.evaluate import evaluate
            from ground.reconstruct import Progress, reconstruct
            from ground.report import write_report
            from ground.settings import all_changes

            section = load_mission(mission).reconstruct if mission else ReconstructSection()
            wanted = method or section.method
            changes = all_changes(section, wanted, quality, budget, steps, settings or [])
            torch.set_num_threads(threads or os.cpu_count() or 1)
            stop.obey()

            def on_progress(progress: Progress) -> None:
                stop.ask()
                show(progress.label, progress.info)

            say(stderr, f"reading the frames of {session}")
            folder = reconstruct(
                session,
                name,
                wanted,
                changes,
                section.seed if seed is None else seed,
                time_limit,
                blind_reference,
                on_progress,
                out,
                overwrite,
                lambda: stop.asked,
            )
            stop.obey()
            say(stderr, "scoring the model and writing its report")
            metrics = evaluate(session, name, out)
            report = write_report(session, name, out)
    except KeyboardInterrupt as error:
        done = f"the run is finished in {folder}: `ground evaluate` and `ground report` score it"
        kept = done if folder else "the same command goes on from the last checkpoint, if there is one"
        raise Interrupted(f"interrupted; {kept}") from error
    _print_metrics(metrics, json_)
    if not json_:
        print(f"{folder}: {', '.join(sorted(path.name for path in folder.iterdir()))}\nreport: {report}")


@app.command("evaluate")
def evaluate_command(
    session: SessionDir, name: RunName = "run", out: RunsDir = None, json_: AsJson = False
) -> None:
    """Score a finished run against held-out frames, and against the truth if a simulator left it.

    Example: ground evaluate --session demo/session --name demo --json
    """
    from ground.evaluate import evaluate

    _print_metrics(evaluate(session, name, out), json_)


@app.command("report")
def report_command(
    session: SessionDir, name: RunName = "run", out: RunsDir = None, json_: AsJson = False
) -> None:
    """Write a run's report.html again.

    Example: ground report --session demo/session --name demo
    """
    from ground.report import write_report

    path = write_report(session, name, out)
    print(json.dumps({"report": str(path)}) if json_ else path)


@app.command("import")
def import_command(
    folder: Annotated[Path, typer.Option("--from", help="The data set's folder.")],
    session: Annotated[Path, typer.Option(help="The session folder to make.")],
    format_: Annotated[str, typer.Option("--format", help="nerf, nerfstudio, colmap or shirt.")],
    srgb: Annotated[bool, typer.Option(help="Undo the sRGB curve of the pictures.")] = False,
    frames: Annotated[int | None, typer.Option(min=1, help="Only so many, the first ones.")] = None,
    json_: AsJson = False,
) -> None:
    """Make a session of pictures with known cameras: NeRF-synthetic, nerfstudio, COLMAP or SHIRT.

    Example: ground import --format shirt --from shirtv1/roe1/lightbox --frames 363 --session roe1
    """
    from ground.formats.colmap import read_colmap
    from ground.formats.nerf import read_nerf
    from ground.formats.nerfstudio import read_nerfstudio
    from ground.formats.shirt import read_shirt
    from ground.formats.views import write_session

    camera = None
    if format_ == "nerf":
        views, camera = read_nerf(folder)
    elif format_ == "nerfstudio":
        views, camera = read_nerfstudio(folder)
    elif format_ == "colmap":
        views = read_colmap(folder)
    elif format_ == "shirt":
        views = read_shirt(folder)
    else:
        raise ValueError(f"--format must be nerf, nerfstudio, colmap or shirt, got {format_!r}")
    views = views[:frames]
    with Progress(TextColumn("importing"), BarColumn(), TimeRemainingColumn(), console=stderr) as progress:
        task = progress.add_task("import", total=len(views))
        source = f"{format_}: {folder}"
        count = write_session(views, session, source, srgb, camera, lambda: progress.advance(task))
    print(json.dumps({"frames": count, "session": str(session)}) if json_ else f"{count} frames in {session}")


@app.command("export")
def export_command(
    session: SessionDir,
    out: Annotated[Path, typer.Option(help="The folder to write.")],
    format_: Annotated[str, typer.Option("--format", help="nerf or nerfstudio.")] = "nerf",
    json_: AsJson = False,
) -> None:
    """Write a session's frames for other tools, split by brackets into train, val and test (6:2:3).

    Example: ground export --session pass-12 --format nerfstudio --out pass-12-nerfstudio
    """
    from ground.formats.nerf import export_nerf
    from ground.formats.nerfstudio import export_nerfstudio
    from ground.session import open_session

    exporters = {"nerf": export_nerf, "nerfstudio": export_nerfstudio}
    if format_ not in exporters:
        raise ValueError(f"--format must be nerf or nerfstudio, got {format_!r}")
    counts = exporters[format_](open_session(session), out)
    text = ", ".join(f"{count} {split}" for split, count in counts.items())
    print(json.dumps(counts) if json_ else f"{text} in {out}")


def _print_metrics(metrics: dict, as_json: bool) -> None:
    if as_json:
        print(json.dumps(metrics))
        return
    Console().print(table("The model", [frames_row(metrics), *model_rows(metrics)]))


def main() -> None:
    """Run the command line."""
    run(app, "ground")


if __name__ == "__main__":
    main()
