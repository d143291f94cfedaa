"""The commands of `ground` that show what is there: list, compare-runs."""

import dataclasses
import json
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.table import Table
from rich.text import Text

from ground.run.card import readings
from obbgs_base.command_line import AsJson
from obbgs_base.errors import counted

if TYPE_CHECKING:  # torch takes seconds to import, and --help must not wait for it
    from ground.show.listing import RunEntry, SessionEntry


def list_command(
    folders: Annotated[
        list[Path] | None, typer.Argument(help="Where to look, three levels deep; default: here.")
    ] = None,
    pictures: Annotated[
        bool, typer.Option("--pictures", help="Look for damage in every picture, too.")
    ] = False,
    json_: AsJson = False,
) -> None:
    """Show the sessions in some folders, and their runs: frames, what is lost or damaged, method, quality, PSNR, poses.

    Example: ground list passes demo --json
    """
    from ground.show.listing import find_sessions

    sessions = find_sessions(folders or [Path()], pictures)
    if json_:
        print(json.dumps([dataclasses.asdict(session) for session in sessions]))
        return
    if not sessions:
        print("no session here; `ground listen` and `ground import` make one")
        return
    Console().print(_sessions_table(sessions))


def compare_runs_command(
    runs: Annotated[
        tuple[Path, Path], typer.Argument(metavar="RUN RUN", help="Two runs' folders, of any sessions.")
    ],
    json_: AsJson = False,
) -> None:
    """Show which settings differ between two runs, and the figures of both.

    Example: ground compare-runs pass-12/runs/first pass-12/runs/second
    """
    from ground.show.listing import compare_runs

    first, second = runs
    found = compare_runs(first, second)
    if json_:
        print(json.dumps(found))
        return
    for title, values in found.items():
        table = Table(title=title.capitalize())
        for heading in ("", str(first), str(second)):
            table.add_column(heading, overflow="fold")
        for name, pair in values.items():
            table.add_row(*(Text(cell) for cell in (name, *map(_cell, pair))))
        Console().print(table if values else f"{title}: no difference")


def _sessions_table(sessions: "list[SessionEntry]") -> Table:
    table = Table()
    for heading in (
        "session / run",
        "made",
        "frames / method",
        "lost / clean PSNR",
        "size / Gaussians",
        "link / poses",
    ):
        table.add_column(heading, overflow="fold")
    for s in sessions:
        captured = "" if s.frames_captured is None else f" of {s.frames_captured}"
        lost = _counts(s.frames_lost) or ("" if s.imported_from or s.damage else "nothing")
        # pictures came over no link, and of what is damaged each line says what is lost
        if s.frames_missing:
            least = "at least " if s.frames_captured is None else ""
            lost += f"; {least}{s.frames_missing:,} not received yet"
        counts = (f"{kind.replace('_', ' ').replace('crc', 'CRC')}: {n:,}" for kind, n in s.link.items())
        link = "; ".join(("repaired", *counts)) if s.link else s.imported_from or ""
        count = f"{s.frames}{captured} in {counted(s.brackets, 'bracket')}"
        if s.imported_from:
            grouped = f" in {counted(s.brackets, 'bracket')}" if s.brackets < s.frames else ""
            count = counted(s.frames, "picture") + grouped
        cells = [s.folder, _age(s.created_utc), count, lost, s.size, link]
        if s.problem:
            cells = [s.folder, "", "", "", "", s.problem]
        table.add_row(*map(Text, cells), style="bold")
        for line in s.damage:
            table.add_row(*map(Text, ("  damaged", "", "", "", "", line)))
        for run in s.runs:
            table.add_row(*map(Text, _run_cells(run, s.imported_from is not None)))
        table.add_section()
    return table


def _run_cells(run: "RunEntry", imported: bool) -> list[str]:
    psnr_db = run.psnr_clean_db if run.psnr_clean_db is not None else run.psnr_noisy_db
    psnr = "" if psnr_db is None else f"{psnr_db:.2f} dB"
    if psnr and run.psnr_clean_db is None:
        psnr += f" (against {readings(imported)})"
    gaussians = "" if run.gaussians is None else f"{run.gaussians:,}"
    method = ", ".join(part for part in (run.method, run.quality) if part)
    if run.seconds is not None:
        method += f", {run.seconds:.0f} s"
    poses = (run.poses or "").partition(" (")[0]  # the reason stands in `compare-runs` and in the report
    if run.pose_error_px is not None:
        poses += f", off by {run.pose_error_px:.2g} px, {run.pose_error_deg or 0:.2g}°"
    # the whole of a status stands in `--json`
    problem = f"unfinished: {run.state}" if run.state else run.problem
    return [f"  {run.name}", _age(run.made_utc), method, psnr, gaussians, problem or poses]


def _counts(counts: dict[str, int]) -> str:
    return ", ".join(f"{count:,} {kind.replace('_', ' ')}" for kind, count in counts.items())


def _age(utc: str) -> str:
    """Return how long ago a time was, in its largest whole unit; the text itself where it is no time."""
    try:
        then = datetime.fromisoformat(utc)
    except ValueError:
        return utc
    seconds = (datetime.now(UTC) - then.replace(tzinfo=then.tzinfo or UTC)).total_seconds()
    for unit, length_s in (("day", 86_400), ("hour", 3600), ("minute", 60)):
        if (count := int(seconds // length_s)) >= 1:
            return f"{count} {unit}{'s' if count > 1 else ''} ago"
    return "just now"


def _cell(value: Any) -> str:
    if value is None:
        return "-"
    return (
        f"{value:.5g}" if isinstance(value, float) else f"{value:,}" if isinstance(value, int) else str(value)
    )
