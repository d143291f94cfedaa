"""The command line `ground`: all commands; most are in `ground/commands/`, `compare` is in the part of that name."""

import contextlib
import dataclasses
import importlib
import json
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from flightsw.icd.mission import load_mission
from ground.commands.formats import export_command, import_command
from ground.commands.inspect import inspect_command, measure_command
from ground.commands.list import compare_runs_command, list_command
from ground.commands.live import live_command
from ground.commands.options import ListenKey, SessionDir, listening_key
from ground.commands.runs import evaluate_command, mesh_command, reconstruct_command, report_command
from ground.commands.systems import dictionary_command, yamcs_command
from ground.commands.uplink import UplinkWords, uplink_command
from ground.commands.view import view_command
from obbgs_base.command_line import LINK_HELP, MISSION_HELP, AsJson, new_app, run
from obbgs_base.errors import counted
from obbgs_base.output import output_may_fail
from obbgs_base.stopping import stop_on_signals

app = new_app("The ground station: frames in, a 3D model out.")
stderr = Console(stderr=True)
# found by its name: the part `compare` imports the ground station, never the reverse
RESEARCH = "compare.command"


@app.command("listen")
@output_may_fail()
def listen_command(
    link: Annotated[str, typer.Option(help=f"{LINK_HELP}.")],
    session: SessionDir,
    mission: Annotated[Path, typer.Option(help=f"{MISSION_HELP}.")] = Path("mission.yaml"),
    exit_after: Annotated[
        int | None, typer.Option(min=1, help="Stop receiving when the session holds this many frames.")
    ] = None,
    idle_timeout: Annotated[
        float | None, typer.Option(min=0, help="Stop after this many seconds of silence. Default: never.")
    ] = None,
    forward: Annotated[
        str | None,
        typer.Option(
            help="Pass every packet of the spacecraft on by UDP, to udp://HOST:PORT; default: to nobody."
        ),
    ] = None,
    key_file: ListenKey = None,
    json_: AsJson = False,
) -> None:
    """Receive frames and telemetry into a session folder until stopped, send commands, show the state of the pass.

    On a terminal it shows a screen; elsewhere it prints a line every ten seconds and each event. --json prints a line a
    second and each event; its last line is the summary.

    Example: ground listen --link 'serial:///dev/ttyUSB0?baud=921600' --session pass-12
    """
    from ground.commands.console import statuses_shown
    from ground.link.forward import Forwarder
    from ground.link.ingest import listen

    stop = stop_on_signals()
    with (
        Forwarder(forward) if forward is not None else contextlib.nullcontext() as forwarder,
        statuses_shown(stderr, json_, link, session) as (on_status, on_event),
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
            key=listening_key(key_file),
        )
    if json_:
        print(json.dumps({"type": "summary"} | dataclasses.asdict(summary)))
    else:
        print(
            f"{counted(summary.frames_received, 'frame')} received, {summary.frames_in_session} in {session}"
        )
    if exit_after is not None and summary.frames_in_session < exit_after:
        raise typer.Exit(1)


@app.command()
def key(
    file: Annotated[Path, typer.Argument(help="Where to write the key; an existing one is never replaced.")],
    spi: Annotated[
        int, typer.Option(min=1, max=65534, help="The key's number (security parameter index).")
    ] = 1,
    counter: Annotated[
        int | None,
        typer.Option(
            min=0,
            max=(1 << 63),
            help="Make no key: move the ground's counter of this one forward, past this number, which the spacecraft "
            "has taken. A lost FILE.sent is made anew.",
        ),
    ] = None,
    json_: AsJson = False,
) -> None:
    """Make the key that authenticates a mission's commands, and a counter for each side.

    Copy FILE and FILE.received to the spacecraft; FILE and FILE.sent stay on the ground.

    Example: ground key mission.key
    """
    from ground.link.uplink import make_key, move_counter

    if counter is not None:
        moved = move_counter(file, counter)
        print(
            json.dumps({"file": str(file), "counter": moved})
            if json_
            else f"the next command of {file} is {moved + 1}"
        )
        return
    made = make_key(file, spi)
    if json_:
        print(json.dumps({"file": str(file), "spi": made.spi, "fingerprint": made.fingerprint}))
    else:
        print(f"key {made.spi} ({made.fingerprint}) in {file}; copy it and {file}.received to the spacecraft")


app.command("uplink", cls=UplinkWords)(uplink_command)
app.command("live")(live_command)
app.command("reconstruct")(reconstruct_command)
app.command("evaluate")(evaluate_command)
app.command("report")(report_command)
app.command("mesh")(mesh_command)
app.command("inspect")(inspect_command)
app.command("measure")(measure_command)
app.command("view")(view_command)
app.command("compare")(importlib.import_module(RESEARCH).compare_command)
app.command("list")(list_command)
app.command("compare-runs")(compare_runs_command)
app.command("dictionary")(dictionary_command)
app.command("yamcs")(yamcs_command)
app.command("import")(import_command)
app.command("export")(export_command)


def main() -> None:
    """Run the command line."""
    run(app, "ground")


if __name__ == "__main__":
    main()
