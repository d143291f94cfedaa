"""The command `ground compare`."""

import contextlib
import json
import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn

from compare.errors import for_people
from ground.commands.options import WorkersGiven, workers_at
from ground.commands.progress import Stop, say
from obbgs_base.command_line import OUT_HELP, AsJson
from obbgs_base.imports import quick_imports

if TYPE_CHECKING:  # both take seconds to import
    from compare.grid.run import State

stderr = Console(stderr=True)
PLAIN_S = 60.0  # between lines where there is no terminal


def compare_command(
    sessions: Annotated[list[Path], typer.Argument(metavar="SESSION...", help="Session folders.")],
    out: Annotated[Path, typer.Option(help=f"{OUT_HELP}; an earlier comparison there goes on.")],
    methods: Annotated[
        str, typer.Option(help="Methods, separated by commas; a wrong name lists them all.")
    ] = "black,mean,untrained,noise,obbgs",
    seeds: Annotated[int, typer.Option(min=1, help="Trainings of each, with seeds 0, 1, ...")] = 1,
    budgets: Annotated[
        str,
        typer.Option(
            help="What a training may use: a share of its method's steps, @ and the most Gaussians; commas between."
        ),
    ] = "1",
    conditions: Annotated[
        Path | None,
        typer.Option(help="A YAML file of stability conditions; default: frames as they were taken."),
    ] = None,
    weights: Annotated[Path | None, typer.Option(help="The file of weights that mvsnet needs.")] = None,
    workers: WorkersGiven = None,
    json_: AsJson = False,
) -> None:
    """Compare methods: one row for each session, method, seed, budget and condition, then a page of all rows.

    Rows that are in the folder already are not made again. Ctrl-C and SIGTERM save what is running and end with exit
    code 1; the same command goes on, also after a kill.

    Example: ground compare tdrs dscovr --methods black,3dgs,3dgs+exposure,obbgs --seeds 3 --out comparison
    """
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # before torch: spinning threads slow each other down
    stop = Stop()
    with stop.on_signals():
        with quick_imports():
            from compare.charts.figures import write_figures
            from compare.charts.page import write_page
            from compare.conditions import AS_TAKEN, Condition, load_conditions
            from compare.errors import CompareError
            from compare.grid.cells import cells_of, parse_budgets, session_facts
            from compare.grid.origin import this_command
            from compare.grid.run import run_grid
            from compare.methods import method

        chosen = load_conditions(conditions) if conditions else {AS_TAKEN: Condition()}
        names = [name.strip() for name in methods.split(",") if name.strip()]
        shares = parse_budgets(budgets)
        # what is no method and no number of workers is told before anything is read
        if not names:
            raise CompareError(
                "no method is named: give --methods names with commas between, such as obbgs,3dgs"
            )
        for name in names:
            method(name, weights)
        scheduler_and_count = workers_at(workers)
        say(stderr, "reading the sessions")
        facts = [session_facts(folder) for folder in sessions]
        cells = cells_of(facts, names, seeds, shares, chosen, weights)
        with _shown(stderr) as on_state:
            command = this_command("ground")
            summary = run_grid(cells, out, command, *scheduler_and_count, on_state, lambda: stop.requested)
        asked = {cell.digest: (cell.session.name, cell.condition_name) for cell in cells}
        page, figures = write_page(out, asked), write_figures(out, asked)
    for label, reason in summary.failed.items():
        say(stderr, f"not made: {label}: {reason}")
    if json_:
        counts = {"made": summary.made, "were_done": summary.were_done, "failed": summary.failed}
        print(json.dumps({"rows": str(out / "rows.jsonl"), "page": str(page)} | counts))
    else:
        print(f"{summary.made} rows made, {summary.were_done} were there, in {out / 'rows.jsonl'}")
        print(f"page: {page}, and {len(figures)} figures beside it")
    if summary.failed:
        raise typer.Exit(1)


@contextlib.contextmanager
def _shown(console: Console) -> Iterator[Callable[["State"], None]]:
    """Give a function that shows the state of a comparison: a bar on a terminal, elsewhere lines."""
    if not console.is_terminal:
        yield _Lines(console)
        return
    columns = TextColumn("{task.description}"), BarColumn(bar_width=24), TextColumn("{task.fields[state]}")
    with Progress(*columns, console=console) as progress:
        task = progress.add_task("rows", total=None, state="")

        def show(state: "State") -> None:
            if state.news is not None:
                say(console, _line(state.news))
            part = sum(share for _, share in state.running)
            progress.update(task, completed=state.done + part, total=state.total, state=_state(state))

        yield show


class _Lines:
    """Prints each row that is made, and how far the comparison is once a minute."""

    def __init__(self, console: Console):
        self._console, self._next_s = console, 0.0

    def __call__(self, state: "State") -> None:
        if state.news is not None:
            say(self._console, _line(state.news))
        elif time.monotonic() >= self._next_s:
            self._next_s = time.monotonic() + PLAIN_S
            say(self._console, _state(state))


def _line(row: dict) -> str:
    """Return a row in a line of text."""
    what = f"{row['method']}, {row['target']}, {row['condition']}, seed {row['seed']}"
    if "error" in row:
        return f"{what}: {for_people(row['error'])}"
    psnr = ("psnr_clean_db", "{:.2f} dB")
    if row.get("psnr_clean_db") is None:  # no simulator left a truth
        psnr = ("psnr_noisy_db", "{:.2f} dB against the noisy frames")
    shown = (psnr, ("chamfer", "Chamfer {:.4f}"), ("seconds", "{:.0f} s"))
    return f"{what}: " + ", ".join(form.format(row[key]) for key, form in shown if row.get(key) is not None)


def _state(state: "State") -> str:
    left = "" if state.seconds_left is None else f", about {_duration(state.seconds_left)} left"
    running = "; ".join(f"{cell.method} on {cell.session.name} {share:.0%}" for cell, share in state.running)
    return f"{state.done} of {state.total} rows{left}" + (f"; {running}" if running else "")


def _duration(seconds: float) -> str:
    minutes = round(seconds / 60)
    return (
        f"{seconds:.0f} s"
        if seconds < 90
        else f"{minutes} min"
        if minutes < 120
        else f"{seconds / 3600:.1f} h"
    )
