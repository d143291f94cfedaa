"""The command `ground live`: a model while the frames of a pass arrive."""

import dataclasses
import json
import os
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from flightsw.icd.link.auth import Key
from flightsw.icd.mission import ConfigError, ReconstructSection, load_mission
from ground.commands.options import (
    Overwrite,
    RunName,
    SessionDir,
    listening_key,
)
from ground.commands.progress import Lines, Stop, say
from ground.run.live.process import LiveProcess
from ground.run.live.status import LiveStatus, line
from ground.show.summary import frames_row, model_rows, table
from obbgs_base.command_line import KEY_HELP, LINK_HELP, MISSION_HELP, AsJson
from obbgs_base.errors import counted
from obbgs_base.imports import quick_imports
from obbgs_base.output import output_may_fail
from obbgs_base.stopping import stop_on_signals

stderr = Console(stderr=True)


@output_may_fail()
def live_command(
    session: SessionDir,
    link: Annotated[
        str | None,
        typer.Option(
            help=f"{LINK_HELP}; it receives over it. Default: follow a session that another process receives."
        ),
    ] = None,
    mission: Annotated[
        Path | None,
        typer.Option(help=f"{MISSION_HELP}; default: mission.yaml with --link, otherwise none is read."),
    ] = None,
    name: RunName = "live",
    triage: Annotated[
        bool,
        typer.Option(
            "--triage",
            help="Send the model up whenever it has improved by 1 dB, and ask for the order by triage.",
        ),
    ] = False,
    key_file: Annotated[
        Path,
        typer.Option(
            "--key",
            help=f"{KEY_HELP}: it authenticates answers to the spacecraft, and --triage needs it.",
        ),
    ] = Path("mission.key"),
    exit_after: Annotated[
        int | None,
        typer.Option(min=1, help="Stop receiving when the session holds this many frames; with --link."),
    ] = None,
    idle_timeout: Annotated[
        float | None,
        typer.Option(
            min=0,
            help="Stop after this many seconds of silence. With --link: without a packet, default: never. Without: "
            "without a frame while no process receives, default: 30.",
        ),
    ] = None,
    overwrite: Overwrite = False,
    listener: Annotated[int | None, typer.Option(hidden=True)] = None,
    json_: AsJson = False,
) -> None:
    """Make a model while frames arrive: renewed every few seconds during the pass, and a finished run at its end.

    With --link it receives as `ground listen` does, and the training is a process of its own at lower priority: Ctrl-C
    ends the pass and finishes the model, a second one saves the training. A killed command goes on where it was.

    Example: ground live --link 'serial:///dev/ttyUSB0?baud=921600' --session pass-12
    """
    if link is None:
        key = key_file if triage else None
        _follow(session, mission, name, key, idle_timeout, overwrite, listener, json_)
        return
    mission = mission or Path("mission.yaml")
    given = {
        "--session": session,
        "--mission": mission,
        "--name": name,
        "--key": key_file if triage else None,
    }
    options = [str(part) for option, value in given.items() if value is not None for part in (option, value)]
    options += ["--triage"] * triage + ["--overwrite"] * overwrite
    _receive(
        link,
        session,
        mission,
        session / "runs" / name,
        options,
        exit_after,
        idle_timeout,
        json_,
        listening_key(key_file if key_file.exists() else None),
    )


def _receive(
    link: str,
    session: Path,
    mission: Path,
    run: Path,
    options: list[str],
    exit_after: int | None,
    idle_timeout: float | None,
    as_json: bool,
    key: Key | None,
) -> None:
    """Receive a pass here, with the training in a process of its own, and wait for its model."""
    from ground.commands.console import failures_told, statuses_shown
    from ground.link.ingest import Status, listen

    stop = stop_on_signals()
    show = Lines(stderr)
    with LiveProcess(session, run, options, lambda text: say(stderr, text)) as training:
        with statuses_shown(stderr, as_json, link, session) as (on_status, on_event):

            def with_model(status: Status) -> None:
                training.tend()
                on_status(dataclasses.replace(status, model=training.status()))

            summary = listen(
                link,
                session,
                load_mission(mission),
                exit_after,
                idle_timeout,
                should_stop=stop.is_set,
                on_status=failures_told(with_model),
                on_event=on_event,
                key=key,
            )
        stop.clear()  # the next signal ends the training
        if not as_json:
            say(
                stderr,
                f"{counted(summary.frames_received, 'frame')} received, "
                f"{summary.frames_in_session} in {session}",
            )
        training.finish(stop.is_set, lambda facts: None if as_json else show("model", line(facts)))
    metrics = json.loads((run / "metrics.json").read_bytes())
    if as_json:
        print(json.dumps({"type": "summary"} | dataclasses.asdict(summary) | {"model": metrics}))
    else:
        _print_model(run, metrics)
    if exit_after is not None and summary.frames_in_session < exit_after:
        raise typer.Exit(1)


def _follow(
    session: Path,
    mission: Path | None,
    name: str,
    key: Path | None,
    idle_timeout: float | None,
    overwrite: bool,
    listener: int | None,
    as_json: bool,
) -> None:
    """Train here on a session that another process receives, or that has been received."""
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # before torch: spinning threads slow each other down
    stop, show = Stop(), Lines(stderr)
    with stop.on_signals():
        with quick_imports():
            from ground.run.evaluate import evaluate
            from ground.run.live.reconstruct import reconstruct_live
            from ground.run.settings import mission_changes
            from ground.show.report.document import write_report
            from obbgs_core.process import prepare_process

        prepare_process()
        section = load_mission(mission).reconstruct if mission else ReconstructSection()
        if section.method != "obbgs":
            raise ConfigError("mission.reconstruct.method", f"live it must be obbgs, got {section.method!r}")

        def on_status(status: LiveStatus) -> None:
            if as_json:
                print(json.dumps({"type": "model"} | dataclasses.asdict(status)), flush=True)
            else:
                show("model", line(dataclasses.asdict(status)))

        folder = reconstruct_live(
            session,
            name,
            mission_changes(section),
            section.seed,
            None,
            overwrite,
            30.0 if idle_timeout is None else idle_timeout,
            listener is not None,
            key,
            on_status,
            # the process that receives was killed: it starts a training again when it is started again
            lambda: stop.requested or listener not in (None, os.getppid()),
        )
        metrics = evaluate(session, name)
        write_report(session, name)
    if as_json:
        print(json.dumps({"type": "summary"} | metrics))
    else:
        _print_model(folder, metrics)


def _print_model(folder: Path, metrics: dict) -> None:
    Console().print(table("The model", [frames_row(metrics), *model_rows(metrics)]))
    print(f"report: {folder / 'report.html'}")
