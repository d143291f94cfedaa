"""The report's section on the level of empty sky, where it departs from the stated black level."""

import html

import numpy as np
import plotly.graph_objects as go

from ground.run.runs import Run
from ground.show.page import plot, section

COLOUR, BAND = "#1f6feb", "rgba(31,111,235,0.18)"


def sky_section(run: Run) -> str:
    """Return the section; nothing for a run whose frames have the stated black level."""
    levels = run.metrics.get("sky_level_dn")
    if not levels:
        return ""
    times_ns = {str(record.id): record.mid_exposure_utc_ns for record in run.session.frames}
    shown = sorted((times_ns[number], *pair) for number, pair in levels.items() if number in times_ns)
    begin_ns = shown[0][0] if shown else 0
    minutes = [(utc_ns - begin_ns) / 60e9 for utc_ns, _, _ in shown]
    level_dn, sigma_dn = np.array([pair for _, *pair in shown]).reshape(-1, 2).T
    upper, lower = level_dn + 2 * sigma_dn, level_dn - 2 * sigma_dn
    band = go.Scatter(
        x=[*minutes, *minutes[::-1]],
        y=[*upper, *lower[::-1]],
        fill="toself",
        fillcolor=BAND,
        line={"width": 0},
    )
    line = go.Scatter(x=minutes, y=level_dn, mode="lines+markers", line={"color": COLOUR}, marker={"size": 4})
    figure = go.Figure([band.update(hoverinfo="skip"), line])
    figure.update_layout(
        height=260,
        margin={"l": 60, "r": 20, "t": 20, "b": 45},
        showlegend=False,
        xaxis_title="minutes since the first frame",
        yaxis_title="DN above black",
    )
    note = (
        "What a pixel without light reads above the black level of the mission file, in the middle of each frame, with "
        "two standard deviations of its measurement: a pedestal of the sensor, or stray light. In this training "
        f"{html.escape(run.metrics['sky_level'])}."
    )
    return section("Level of empty sky", note, plot(figure))
