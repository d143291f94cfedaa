"""The report's section on the level of empty sky, where it departs from the stated black level."""

import html

import plotly.graph_objects as go

from ground.run.card import frames, is_imported
from ground.run.runs import Run
from ground.show.page import legend, plot, section
from ground.show.plots import EXPOSURE_COLOURS


def sky_section(run: Run) -> str:
    """Return the section; nothing for a run whose frames have the stated black level."""
    levels = run.metrics.get("sky_level_dn")
    if not levels:
        return ""
    shown = [record for record in run.session.frames if str(record.id) in levels]
    shown.sort(key=lambda record: record.mid_exposure_utc_ns)
    begin_ns = shown[0].mid_exposure_utc_ns if shown else 0
    figure, named = go.Figure(), []
    for index, exposure_s in enumerate(sorted({record.exposure_time_s for record in shown})):
        colour = EXPOSURE_COLOURS[index % len(EXPOSURE_COLOURS)]
        if not run.session.nominal_exposures:
            named.append((f"{exposure_s * 1e3:g} ms", colour))
        of_time = [record for record in shown if record.exposure_time_s == exposure_s]
        pairs = [levels[str(record.id)] for record in of_time]
        figure.add_scatter(
            x=[(record.mid_exposure_utc_ns - begin_ns) / 60e9 for record in of_time],
            y=[None if sigma_dn is None else level_dn for level_dn, sigma_dn in pairs],  # a gap: not measured
            error_y={"array": [2 * (sigma_dn or 0.0) for _, sigma_dn in pairs], "thickness": 1, "width": 0},
            mode="lines+markers",
            line={"color": colour},
            marker={"size": 4},
            hovertemplate="%{y:.2f} DN<extra></extra>",
        )
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
        f"{html.escape(run.metrics['sky_level'])}.{_gaps(run)}"
    )
    return section("Level of empty sky", note, legend(named) + plot(figure))


def _gaps(run: Run) -> str:
    """Return in words why frames are missing in the plot; nothing where none is."""
    levels = run.metrics["sky_level_dn"]
    assumed = [level_dn for level_dn, sigma_dn in levels.values() if sigma_dn is None]
    if not assumed:
        return ""
    return (
        f" {len(assumed)} of {len(levels)} {frames(is_imported(run.metrics))} have the Earth in view or too little sky "
        f"of their own: the mean of the others, {assumed[0]:.2f} DN, is taken off them, and the plot has a gap there."
    )
