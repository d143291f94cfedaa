"""The commands of `ground` that make, score and show a model: reconstruct, evaluate, report, mesh."""

import json
import math
import os
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console

from flightsw.icd.config import require
from flightsw.icd.mission import ReconstructSection, load_mission
from ground.commands.options import (
    AttitudeChoice,
    AttitudeGiven,
    Budget,
    MeshFormatName,
    MethodName,
    Overwrite,
    QualityName,
    ReconstructMission,
    RunAt,
    RunName,
    Seed,
    SessionDirs,
    SettingsGiven,
    TimeLimit,
    WorkersGiven,
    workers_at,
)
from ground.commands.progress import Stop, say, shares_shown, steps_shown
from ground.show.summary import frames_row, model_rows, runs_table, table
from obbgs_base.command_line import AsJson
from obbgs_base.errors import Interrupted
from obbgs_base.imports import quick_imports
from obbgs_base.output import output_may_fail

if TYPE_CHECKING:  # it imports PyTorch
    from ground.commands import many

stderr = Console(stderr=True)


@output_may_fail()
def reconstruct_command(
    session: SessionDirs,
    name: RunName = "run",
    method: MethodName = None,
    quality: QualityName = None,
    budget: Budget = "auto",
    settings: SettingsGiven = None,
    mission: ReconstructMission = None,
    time_limit: TimeLimit = math.inf,
    seed: Seed = None,
    attitude: AttitudeGiven = AttitudeChoice.AUTO,
    workers: WorkersGiven = None,
    overwrite: Overwrite = False,
    json_: AsJson = False,
) -> None:
    """Train a model on a session, export it, score it and write its report.

    Ctrl-C and SIGTERM save the training and end with exit code 1; the same command resumes it, also after a kill. Only
    one process at a time makes a run. Of several sessions one that fails does not end the others, finished runs are
    left as they are, and a table shows them all; that needs obbgs[compare].

    Example: ground reconstruct --session pass-12 --name first --time-limit 120 --set light.sun_shading=linear
    """
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # before torch: spinning threads slow each other down
    section = load_mission(mission).reconstruct if mission else ReconstructSection()
    require(time_limit > 0, "--time-limit", f"the time limit must be longer than 0 s, got {time_limit:g}")
    chosen, seed = method or section.method, section.seed if seed is None else seed
    asked = _Asked(
        name, chosen, section, quality, budget, settings or [], seed, time_limit, attitude, overwrite
    )
    if len(session) > 1 or workers is not None:
        _many(session, asked, workers, json_)
    else:
        _one(session[0], asked, json_)


@dataclass(frozen=True)
class _Asked:
    """What the options of `reconstruct` ask for, whatever the session."""

    name: str
    method: str
    section: ReconstructSection
    quality: str | None
    budget: str
    settings: list[str]
    seed: int
    time_limit_s: float
    attitude: AttitudeChoice
    overwrite: bool

    def changes(self) -> dict:
        """Return the changes to the method's preset; imports PyTorch.

        Raises:
            ValueError: as in `all_changes`.
        """
        from ground.run.settings import all_changes

        return all_changes(self.section, self.method, self.quality, self.budget, self.settings)


def _one(session: Path, asked: _Asked, as_json: bool) -> None:
    """Reconstruct a session in this process."""
    stop, folder = Stop(), None
    try:
        with stop.on_signals(), steps_shown(stderr) as show:
            with quick_imports():
                from ground.run.evaluate import evaluate
                from ground.run.reconstruct import Progress, reconstruct
                from ground.run.runs import check_replaceable, run_folder
                from ground.session.folder import read_header
                from ground.show.report.document import write_report
                from obbgs_core.process import prepare_process

            changes = asked.changes()
            prepare_process()
            stop.raise_at_once()

            def on_progress(progress: Progress) -> None:
                stop.defer()
                show(progress.label, progress.info)

            read_header(session)  # what is no session is told before anything else
            check_replaceable(run_folder(session, asked.name), asked.overwrite)  # and so is a wrong name
            say(stderr, f"reading the frames of {session}")
            folder = reconstruct(
                session,
                asked.name,
                asked.method,
                changes,
                asked.seed,
                asked.time_limit_s,
                on_progress,
                overwrite=asked.overwrite,
                should_stop=lambda: stop.requested,
                attitude=asked.attitude.value,
                on_search=shares_shown(stderr),
            )
            stop.raise_at_once()
            say(stderr, "scoring the model and writing its report")
            metrics = evaluate(session, asked.name)
            report = write_report(session, asked.name)
    except KeyboardInterrupt as error:
        raise Interrupted(_interrupted(folder)) from error
    _print_metrics(metrics, as_json)
    if not as_json:
        print(f"{folder}: {', '.join(sorted(path.name for path in folder.iterdir()))}\nreport: {report}")


def _many(sessions: list[Path], asked: _Asked, workers: str | None, as_json: bool) -> None:
    """Reconstruct sessions in processes of their own, and show what became of them in a table."""
    stop = Stop()
    with stop.on_signals():
        with quick_imports():
            from ground.commands import many

        wanted = many.Asked(
            asked.name,
            asked.method,
            asked.changes(),
            asked.seed,
            asked.time_limit_s,
            asked.attitude.value,
            asked.overwrite,
        )

        def on_end(session: Path, ended: "many.Ended") -> None:
            state = ended.problem or ("was finished" if ended.was_done else "finished")
            say(stderr, f"{session}: {state}")

        say(stderr, f"reconstructing {len(sessions)} session{'s' * (len(sessions) > 1)}")
        found = many.reconstruct_all(sessions, wanted, *workers_at(workers), on_end, lambda: stop.requested)
    if as_json:
        told = {str(s): e.metrics or {"error": e.problem} for s, e in found.items()}
        print(json.dumps({"sessions": told}))
    else:
        Console().print(runs_table({str(s): e.metrics or e.problem for s, e in found.items()}))
    if any(ended.problem for ended in found.values()):
        raise typer.Exit(1)


def evaluate_command(run: RunAt, json_: AsJson = False) -> None:
    """Score a finished run against its held-out frames, and against the truth if a simulator left one.

    Example: ground evaluate demo/session/runs/demo --json
    """
    with quick_imports():
        from ground.run.evaluate import evaluate
        from ground.run.runs import run_at

    _print_metrics(evaluate(*run_at(run)), json_)


def report_command(run: RunAt, json_: AsJson = False) -> None:
    """Write report.html into the folder of a finished run again.

    Example: ground report demo/session/runs/demo
    """
    with quick_imports():
        from ground.run.runs import run_at
        from ground.show.report.document import write_report

    path = write_report(*run_at(run))
    print(json.dumps({"report": str(path)}) if json_ else path)


def mesh_command(
    run_path: RunAt,
    format_: Annotated[MeshFormatName, typer.Option("--format", help="The format.")] = MeshFormatName.GLB,
    json_: AsJson = False,
) -> None:
    """Write a finished run's surface into its folder as a closed mesh: model.glb, or mesh.FORMAT.

    Example: ground mesh demo/session/runs/demo --format obj
    """
    from ground.run.estimated_poses import estimated_records, read_estimate
    from ground.run.evaluate import keep_metrics
    from ground.run.mesh_files import write_mesh
    from ground.run.model_files import model_sizes, white_radiance_of
    from ground.run.runs import open_run, run_at

    run = open_run(*run_at(run_path))
    training = estimated_records(run.training, read_estimate(run.folder))
    stem = "model" if format_ is MeshFormatName.GLB else "mesh"  # model.ply holds the Gaussians
    path = run.folder / f"{stem}.{format_.value}"
    facts = write_mesh(run.gaussians, run.session, training, path, white_radiance_of(run.session, training))
    if format_ is MeshFormatName.GLB:
        # figures whose names end in _mesh are those of the mesh before
        kept = {key: value for key, value in run.metrics.items() if not key.endswith("_mesh")}
        missing = {n: why for n, why in kept.get("missing_outputs", {}).items() if n != path.name}
        keep_metrics(run, kept | {"missing_outputs": missing} | facts | model_sizes(run.folder))
    if json_:
        print(json.dumps({"mesh": str(path)} | facts))
    else:
        unseen = f"{100 * facts['mesh_unseen_share']:.1f} % of the area in triangles with a corner that no view saw"
        print(f"{facts['mesh_triangles']:,} triangles, {unseen}: {path}")


def _interrupted(folder: Path | None) -> str:
    """Return what an interruption left; `folder` is that of the run if it was finished."""
    if folder is None:
        return "interrupted; the same command resumes from the last checkpoint, if there is one"
    return f"interrupted; the run is finished in {folder}: `ground evaluate` and `ground report` score it"


def _print_metrics(metrics: dict, as_json: bool) -> None:
    if as_json:
        print(json.dumps(metrics))
        return
    Console().print(table("The model", [frames_row(metrics), *model_rows(metrics)]))
