"""ground: listen, reconstruct, evaluate, report."""

import dataclasses
import json
import logging
import math
import os
import signal
import sys
import threading
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from flightsw.icd.mission import ConfigError, load_mission

app = typer.Typer(
    add_completion=False, no_args_is_help=True, help="The ground station: frames in, a 3D model out."
)
stderr = Console(stderr=True)

SessionDir = Annotated[Path, typer.Option("--session", help="The session folder.")]
RunName = Annotated[str, typer.Option("--name", help="The run's name below runs/.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print the result as JSON.")]


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
    """Receive frames into a session folder until stopped.

    Example: ground listen --link serial:///dev/ttyUSB0?baud=921600 --session pass-12
    """
    from ground.ingest import ListenSummary, listen

    stop = threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: stop.set())
    with Progress(TextColumn("{task.description}"), console=stderr, transient=True) as progress:
        task = progress.add_task("listening", total=None)

        def show(now: ListenSummary) -> None:
            text = (
                f"{now.frames_in_session} frames, {now.bytes_received:,} bytes, {now.crc_errors} CRC errors"
            )
            progress.update(task, description=f"{text}, {now.segments_resent} segments resent")

        summary = listen(link, session, load_mission(mission), exit_after, idle_timeout, show, stop.is_set)
    if json_:
        print(json.dumps(dataclasses.asdict(summary)))
    else:
        print(f"{summary.frames_received} frames received, {summary.frames_in_session} in {session}")
    if exit_after is not None and summary.frames_in_session < exit_after:
        raise typer.Exit(1)


@app.command("reconstruct")
def reconstruct_command(
    session: SessionDir,
    name: RunName = "run",
    method: Annotated[str, typer.Option(help="obbgs, jiang2025, 3dgs, pixel-gs or mvgs.")] = "obbgs",
    steps: Annotated[int | None, typer.Option(min=1, help="Training steps.")] = None,
    max_gaussians: Annotated[int | None, typer.Option(min=1, help="Largest model.")] = None,
    time_limit: Annotated[float, typer.Option(help="Seconds for each training.")] = math.inf,
    seed: Annotated[int, typer.Option(help="Same seed, same model.")] = 7,
    blind_reference: Annotated[
        bool, typer.Option(help="Train once more blind to exposure, to compare.")
    ] = False,
    threads: Annotated[int | None, typer.Option(min=1, help="Cores; default all.")] = None,
    json_: AsJson = False,
) -> None:
    """Train a model on a session, export it, score it and write its report.

    Example: ground reconstruct --session pass-12 --name first --time-limit 120
    """
    os.environ.setdefault(
        "OMP_WAIT_POLICY", "passive"
    )  # spinning threads cost more than they give; before torch
    import torch

    from ground.evaluate import evaluate
    from ground.reconstruct import Progress as Step
    from ground.reconstruct import reconstruct
    from ground.report import write_report

    torch.set_num_threads(threads or os.cpu_count() or 1)
    changes = {"steps": steps, "max_gaussians": max_gaussians}
    with Progress(
        TextColumn("{task.description:>18}"),
        BarColumn(bar_width=24),
        TextColumn("{task.fields[state]}"),
        TimeRemainingColumn(),
        console=stderr,
    ) as progress:
        tasks: dict[str, Any] = {}

        def show(step: Step) -> None:
            if step.label not in tasks:
                tasks[step.label] = progress.add_task(step.label, total=step.info.steps, state="")
            if step.info.step % 5 == 0 or step.info.step == step.info.steps:
                info = step.info
                state = f"step {info.step} loss {info.loss:.3f} PSNR {info.psnr_db:.1f} dB {info.gaussians} Gaussians"
                progress.update(tasks[step.label], completed=info.step, state=state)

        given = {key: value for key, value in changes.items() if value is not None}
        folder = reconstruct(session, name, method, given, seed, time_limit, blind_reference, show)
    metrics = evaluate(session, name)
    report = write_report(session, name)
    _print_metrics(metrics, json_)
    if not json_:
        print(f"{folder}: model.ply, model.onnx; report: {report}")


@app.command("evaluate")
def evaluate_command(session: SessionDir, name: RunName = "run", json_: AsJson = False) -> None:
    """Score a finished run against held-out frames, and against the truth if a simulator left it.

    Example: ground evaluate --session demo/session --name demo --json
    """
    from ground.evaluate import evaluate

    _print_metrics(evaluate(session, name), json_)


@app.command("report")
def report_command(session: SessionDir, name: RunName = "run", json_: AsJson = False) -> None:
    """Write a run's report.html again.

    Example: ground report --session demo/session --name demo
    """
    from ground.report import write_report

    path = write_report(session, name)
    print(json.dumps({"report": str(path)}) if json_ else path)


def _print_metrics(metrics: dict, as_json: bool) -> None:
    if as_json:
        print(json.dumps(metrics))
        return
    for key, value in metrics.items():
        print(f"{key:28} {value}")


def main() -> None:
    """Run the command line; one clear line for what went wrong, exit code 2 for usage and configuration, 1 for work."""
    logging.basicConfig(level=logging.WARNING, format="%(name)s: %(message)s", stream=sys.stderr)
    logging.getLogger().setLevel(logging.INFO)
    logging.getLogger().handlers[0].setLevel(logging.WARNING)
    try:
        app()
    except KeyboardInterrupt:
        sys.exit(_fail("interrupted; nothing half-written was left", 1))
    except ConfigError as error:
        sys.exit(_fail(str(error), 2))
    except ValueError as error:
        sys.exit(_fail(str(error), 2))
    except Exception as error:
        if type(error).__module__.partition(".")[0] not in ("ground", "obbgs_core"):
            raise
        sys.exit(_fail(str(error), 1))


def _fail(message: str, code: int) -> int:
    print(f"ground: {message}", file=sys.stderr)
    return code


if __name__ == "__main__":
    main()
