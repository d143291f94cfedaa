"""The commands of `ground` that judge and measure a run's body: inspect, measure."""

import json
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.table import Table
from rich.text import Text

from ground.commands.options import RunAt
from obbgs_base.command_line import AsJson
from obbgs_base.imports import quick_imports
from obbgs_base.output import output_may_fail


@output_may_fail()
def inspect_command(
    run: RunAt,
    against: Annotated[
        Path,
        typer.Option(
            help="The design, a mesh in any position, unit and axes: GLB, OBJ, STL or PLY; or another run's folder."
        ),
    ],
    json_: AsJson = False,
) -> None:
    """Tell whether a body is as it was built: missing and added parts, and panels that are turned, with 90 % intervals.

    It writes inspection.json, .html and .glb into the run's folder. The design is laid on its surface whatever its
    size. What the frames do not show is "not seen", never missing. A part as dark as the sky in all frames cannot be
    told from a missing one.

    Example: ground inspect pass-12/runs/first --against target.glb
    """
    with quick_imports():
        from ground.run.runs import run_at
        from ground.show.inspection import write_inspection

    _, name, runs = run_at(run)
    folder = runs / name
    values = write_inspection(folder, against, folder)
    if json_:
        print(json.dumps(values))
        return
    low, high = values["scale_interval_90"]
    print(
        f"one unit of {values['against']} is {values['scale']:.5g} {values['unit']} ({low:.5g} to {high:.5g})"
    )
    table = Table(title="Findings")
    for heading in ("what", "part", "how much (90 %)"):
        table.add_column(heading, overflow="fold")
    for panel in (panel for panel in values["panels"] if panel["turned"]):
        table.add_row("turned", Text(panel["part"]), _told(panel, "angle_deg", "°"))
    for region in values["regions"]:
        what = f"{region['kind']}, whole" if region["whole_part"] else region["kind"]
        table.add_row(what, Text(region["part"]), _told(region, "size", values["unit"]))
    Console().print("as designed, where it was seen" if values["as_designed"] else table)
    print(f"{100 * values['design_shown_share']:.0f} % of the design was seen: {folder / 'inspection.html'}")


@output_may_fail()
def measure_command(
    run: RunAt,
    between: Annotated[
        list[str] | None,
        typer.Option(
            metavar="X,Y,Z:X,Y,Z",
            help="Two places in the body's axes, m; the distance of the points of the surface nearest to them. Can be "
            "repeated.",
        ),
    ] = None,
    json_: AsJson = False,
) -> None:
    """Measure a run's body: its largest dimension, the sizes and areas of its flat faces, and distances, with errors.

    Intervals hold the true value with a probability of 90 %: they count the errors of the scale, that of the stated
    ranges, and of edges in the model. Faces are their seen, uncovered parts.

    Example: ground measure pass-12/runs/first --between 0,0,1:0,0,-1
    """
    with quick_imports():
        from ground.run.runs import run_at
        from ground.show.inspection import read_model
        from ground.show.measure import measured, places_of
        from ground.show.sizes import with_deviation

    _, name, runs = run_at(run)
    values = measured(read_model(runs / name), [places_of(text) for text in between or []])
    if json_:
        print(json.dumps(values))
        return

    def told(value: dict) -> str:
        return with_deviation(value["value"], value["half_width_90"])

    table = Table(title=f"Sizes, {values['unit']} (90 %: ±)")
    for heading in ("", "length", "width", "area"):
        table.add_column(heading, overflow="fold")
    largest = values["largest_dimension"]
    table.add_row("largest dimension", told(largest))
    for face in values["faces"]:
        table.add_row(face["name"], told(face["length"]), told(face["width"]), told(face["area"]))
    for distance in values["distances"]:
        table.add_row("between the points", told(distance))
    Console().print(table)


def _told(values: dict, key: str, unit: str) -> str:
    low, high = values[f"{key}_interval_90"]
    return f"{values[key]:.3g} {unit} ({low:.3g} to {high:.3g})"
