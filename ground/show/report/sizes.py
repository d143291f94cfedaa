"""The report's section on the body's sizes: lengths and areas as `ground measure` tells them, with their errors."""

import html

from ground.run.runs import Run
from ground.session.folder import SessionError
from ground.show.inspection import read_model
from ground.show.measure import measured
from ground.show.page import section, two_tables, unbroken
from ground.show.sizes import with_deviation


def sizes_section(run: Run) -> str:
    """Return the section; nothing for a run without a mesh, or with one of which no frames show anything."""
    try:
        values = measured(read_model(run.folder))
    except SessionError:
        return ""
    unit = html.escape(values["unit"])
    squared = "m²" if unit == "m" else "the squares of these"
    rows = [("largest dimension", _told(values["largest_dimension"]))]
    for face in values["faces"]:
        rows.append(
            (
                f"{face['name']}, length x width",
                f"{_told(face['length'])} {unbroken('x ')}{_told(face['width'])}",
            )
        )
        rows.append(("… its area", _told(face["area"])))
    note = (
        f"Lengths are in {unit}, areas in {squared}. Intervals hold the true value with a probability of 90 %: they "
        f"count the error of the scale, {values['size_sigma_percent']:.2g} % (one standard deviation), and that of "
        f"edges in the model, whose pixels are {values['pixel']:.2g} {unit} wide."
    )
    note += (
        " Faces are what the frames show of flat ones, without what stands on them or hides them, largest first, "
        "if their width is known to a quarter."
        if values["faces"]
        else " The frames show no flat face that is large enough to be measured."
    )
    return section("Sizes", note, two_tables(rows))


def _told(value: dict) -> str:
    """Return a value and half of the width of its interval, as `measured` gives them, in one line."""
    return unbroken(with_deviation(value["value"], value["half_width_90"]))
