"""The command line `ground`: all commands; those of runs, lists, comparisons and other systems are in `cli_*`."""

import contextlib
import dataclasses
import json
import signal
import threading
import time
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from flightsw.icd.mission import load_mission
from ground.cli_compare import compare_command
from ground.cli_list import compare_runs_command, list_command
from ground.cli_live import live_command
from ground.cli_options import (
    AsJson,
    Background,
    BackgroundGiven,
    ExportFormat,
    ImportFormat,
    SessionDir,
    UplinkCommand,
    ValuesGiven,
)
from ground.cli_runs import evaluate_command, mesh_command, reconstruct_command, report_command
from ground.cli_systems import dictionary_command, yamcs_command
from obbgs_base.command_line import new_app, run

app = new_app("The ground station: frames in, a 3D model out.")
stderr = Console(stderr=True)


@app.command("listen")
def listen_command(
    link: Annotated[str, typer.Option(help="The link's URL, such as serial:///dev/ttyUSB0?baud=921600.")],
    session: SessionDir,
    mission: Annotated[Path, typer.Option(help="The mission file, the same as in flight.")] = Path(
        "mission.yaml"
    ),
    exit_after: Annotated[
        int | None, typer.Option(help="Stop when the session holds this many frames.")
    ] = None,
    idle_timeout: Annotated[
        float | None, typer.Option(help="Stop after this many seconds without a packet.")
    ] = None,
    forward: Annotated[
        str | None,
        typer.Option(
            help="Pass every packet of the spacecraft on by UDP, to udp://HOST:PORT; default: to nobody."
        ),
    ] = None,
    json_: AsJson = False,
) -> None:
    """Receive frames and telemetry into a session folder until stopped, send commands, show the state of the pass.

    On a terminal it shows a screen; elsewhere it prints a line every ten seconds and each event. --json prints a line a
    second and each event; its last line is the summary.

    Example: ground listen --link 'serial:///dev/ttyUSB0?baud=921600' --session pass-12
    """
    from ground.console import statuses_shown
    from ground.forward import Forwarder
    from ground.ingest import listen

    stop = threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: stop.set())
    with (
        Forwarder(forward) if forward is not None else contextlib.nullcontext() as forwarder,
        statuses_shown(stderr, json_) as (on_status, on_event),
    ):
        summary = listen(
            link,
            session,
            load_mission(mission),
            exit_after,
            idle_timeout,
            should_stop=stop.is_set,
            on_status=on_status,
            on_event=on_event,
            forward=forwarder,
        )
    if json_:
        print(json.dumps({"type": "summary"} | dataclasses.asdict(summary)))
    else:
        print(f"{summary.frames_received} frames received, {summary.frames_in_session} in {session}")
    if exit_after is not None and summary.frames_in_session < exit_after:
        raise typer.Exit(1)


@app.command()
def key(
    file: Annotated[Path, typer.Argument(help="Where to write the key; an existing one is never replaced.")],
    spi: Annotated[
        int, typer.Option(min=1, max=65534, help="The key's number (security parameter index).")
    ] = 1,
    json_: AsJson = False,
) -> None:
    """Make the key that authenticates a mission's commands, and a counter for each side.

    Copy FILE and FILE.received to the spacecraft; FILE and FILE.sent stay on the ground.

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
    command: Annotated[UplinkCommand, typer.Argument(help="The command.")],
    arguments: Annotated[list[str] | None, typer.Argument(help="Its arguments, as above.")] = None,
    session: Annotated[Path, typer.Option("--session", help="The session folder.")] = Path("session"),
    key_file: Annotated[Path, typer.Option("--key", help="The file of the mission's key.")] = Path(
        "mission.key"
    ),
    link: Annotated[
        str | None, typer.Option(help="The link's URL, if no `ground listen` has it open.")
    ] = None,
    mission: Annotated[Path, typer.Option(help="The mission file; read with --link only.")] = Path(
        "mission.yaml"
    ),
    timeout: Annotated[float, typer.Option(min=0.1, help="Seconds to wait for the result.")] = 120.0,
    json_: AsJson = False,
) -> None:
    """Send a command through the session's `ground listen`, or over --link, and wait for its result.

    ping · bracket 0.05,0.1,0.2 (exposure times, ms) · near 2 (largest coding error, DN) · priority oldest, triage or
    thumbnail-first · model FILE (a run's model.onnx) · safe (no more exposures). `arm delete` and then delete FIRST
    LAST (numbers of frames), `arm resume` and then resume, each at most 30 s later.

    Example: ground uplink bracket 0.02,0.05,0.1 --session pass-12 --key mission.key
    """
    from ground import uplink as uplinking
    from ground.session import SessionError

    made, model = uplinking.parse_command(command.value, arguments or [])
    if link is None and not uplinking.is_listening(session):
        raise SessionError(f"no `ground listen` receives into {session}: start one, or give --link URL")
    counter = uplinking.submit(session, key_file, made, model, timeout)
    end_s = time.monotonic() + timeout + 1.0  # the listener writes a result when the command expires

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
            "text": "no process sent it",
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


app.command("live")(live_command)
app.command("reconstruct")(reconstruct_command)
app.command("evaluate")(evaluate_command)
app.command("report")(report_command)
app.command("mesh")(mesh_command)
app.command("compare")(compare_command)
app.command("list")(list_command)
app.command("compare-runs")(compare_runs_command)
app.command("dictionary")(dictionary_command)
app.command("yamcs")(yamcs_command)


@app.command("import")
def import_command(
    folder: Annotated[Path, typer.Option("--from", help="The data set's folder.")],
    session: Annotated[Path, typer.Option(help="The session folder to make.")],
    format_: Annotated[ImportFormat, typer.Option("--format", help="The data set's format.")],
    values: ValuesGiven = None,
    background: BackgroundGiven = None,
    frames: Annotated[
        int | None,
        typer.Option(min=1, help="Import only the first so many pictures (of each split); default: all."),
    ] = None,
    json_: AsJson = False,
) -> None:
    """Make a session of pictures with known cameras: NeRF-synthetic, nerfstudio, COLMAP or SHIRT.

    Splits that the data set states are kept: `ground reconstruct` trains on train and holds out test, or val if there
    is no test.

    Example: ground import --format shirt --from shirtv1/roe1/lightbox --frames 363 --session roe1
    """
    from ground.formats.colmap import read_colmap
    from ground.formats.nerf import read_nerf
    from ground.formats.nerfstudio import read_nerfstudio
    from ground.formats.shirt import read_shirt
    from ground.formats.views import Values, first_of_each_split, is_transparent, write_session

    exported = None
    white = None if background is None else background is Background.WHITE
    match format_:
        case ImportFormat.NERF:
            views, exported = read_nerf(folder)
            if exported is None and white is None:
                white = is_transparent(views[0].image)
        case ImportFormat.NERFSTUDIO:
            views, exported = read_nerfstudio(folder)
        case ImportFormat.COLMAP:
            views = read_colmap(folder)
        case ImportFormat.SHIRT:
            views = read_shirt(folder)
    views = first_of_each_split(views, frames)
    given = None if values is None else Values(values.value)
    with Progress(TextColumn("importing"), BarColumn(), TimeRemainingColumn(), console=stderr) as progress:
        task = progress.add_task("import", total=len(views))
        source = f"{format_.value}: {folder}"
        count = write_session(views, session, source, given, white, exported, lambda: progress.advance(task))
    print(json.dumps({"frames": count, "session": str(session)}) if json_ else f"{count} frames in {session}")


@app.command("export")
def export_command(
    session: SessionDir,
    out: Annotated[Path, typer.Option(help="The folder to write.")],
    format_: Annotated[
        ExportFormat, typer.Option("--format", help="The format to write.")
    ] = ExportFormat.NERF,
    json_: AsJson = False,
) -> None:
    """Write a session's frames for other software, whole brackets split into train, val and test (6:2:3).

    Example: ground export --session pass-12 --format nerfstudio --out pass-12-nerfstudio
    """
    from ground.formats.nerf import export_nerf
    from ground.formats.nerfstudio import export_nerfstudio
    from ground.session import open_session

    exporters = {ExportFormat.NERF: export_nerf, ExportFormat.NERFSTUDIO: export_nerfstudio}
    counts = exporters[format_](open_session(session), out)
    text = ", ".join(f"{count} {split}" for split, count in counts.items())
    print(json.dumps(counts) if json_ else f"{text} in {out}")


def main() -> None:
    """Run the command line."""
    run(app, "ground")


if __name__ == "__main__":
    main()
