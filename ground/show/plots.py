"""The report's interactive figures: training over time, the exposure histogram."""

import math
from collections.abc import Iterable, Sequence

import numpy as np
import plotly.graph_objects as go

from ground.session.folder import Session
from obbgs_core.sensor import Sensor

POINTS_SHOWN = 15_000  # more make the page larger and the view no clearer
LEAST_OPACITY = 0.2  # fainter Gaussians would hide the others like fog
SMOOTHED = 10  # logged steps
EVEN_TICKS = 6  # at most, over a range that is less than a factor of a few
BINS = 128
INK, SPACE, SUN = "#1c2733", "#10161e", "#f0b429"
KNOWN_COLOUR, BLIND_COLOUR = "#1f6feb", "#d1652a"
EXPOSURE_COLOURS = ("#1f6feb", "#2a9d8f", "#d1652a", "#8e44ad", "#c0392b")


def training_figures(history: Sequence[dict]) -> tuple[list[go.Figure], list[tuple[str, str]]]:
    """Return loss and PSNR over time, as running means, of each training in the lines of metrics.jsonl.

    The second value is the legend: the trainings with their colours.
    """
    named, figures = [], [go.Figure(), go.Figure()]
    losses: list[float] = []
    for label, colour in (("known exposure", KNOWN_COLOUR), ("blind to exposure", BLIND_COLOUR)):
        rows = [line for line in history if line["training"] == label]
        if not rows:
            continue
        named.append((label, colour))
        seconds = [line["seconds"] for line in rows]
        for figure, key in zip(figures, ("loss", "psnr_db"), strict=True):
            values = running_mean([line[key] for line in rows])
            if key == "loss":
                losses += values
            figure.add_scatter(
                x=seconds,
                y=values,
                name=label,
                mode="lines" if len(rows) > 1 else "markers",
                line={"color": colour, "width": 2},
            )
    ticks = ticks_1_2_5(losses)
    figures[0].update_yaxes(type="log", tickvals=ticks, ticktext=[f"{t:g}" for t in ticks], title_text="loss")
    figures[1].update_yaxes(title_text="PSNR of each step, dB")
    for figure in figures:
        figure.update_xaxes(title_text="training time, s", rangemode="tozero")
        figure.update_layout(height=330, margin={"l": 60, "r": 20, "t": 15, "b": 45}, showlegend=False)
    return figures, named


def histogram_figure(
    session: Session, sensor: Sensor, nominal: bool
) -> tuple[go.Figure, list[tuple[str, str]]]:
    """Return the histogram of the readings in all frames, one line for each exposure time, and its legend.

    Args:
        nominal: exposure times are made up and not named.
    """
    named, figure = [], go.Figure()
    edges = np.linspace(0, sensor.white_dn + 1, BINS + 1)
    for index, exposure_s in enumerate(sorted({r.exposure_time_s for r in session.frames})):
        counts, colour = np.zeros(BINS), EXPOSURE_COLOURS[index % len(EXPOSURE_COLOURS)]
        if not nominal:
            named.append((f"{exposure_s * 1e3:g} ms", colour))
        for record in session.frames:
            if record.exposure_time_s == exposure_s:
                counts += np.histogram(session.dn(record), edges)[0]
        figure.add_scatter(
            x=(edges[:-1] + edges[1:]) / 2,
            y=np.where(counts > 0, counts, np.nan),
            name="" if nominal else f"{exposure_s * 1e3:g} ms",
            mode="lines",
            line={"shape": "hvh", "width": 2, "color": colour},
            hovertemplate="%{y:,} pixels near %{x:.0f} DN",
        )
    for level, label, side in (
        (sensor.black_dn, "black level", "right"),
        (sensor.white_dn, "full scale", "left"),
    ):
        figure.add_vline(
            x=level,
            line={"dash": "dot", "color": "#5b6b7b"},
            annotation_text=f"{label}, {level:g}",
            annotation_position=f"top {side}",
        )
    figure.update_yaxes(type="log", title_text="pixels", dtick=1)
    figure.update_xaxes(title_text="digital number (DN)", range=[0, 1.02 * sensor.white_dn])
    figure.update_layout(height=350, margin={"l": 60, "r": 20, "t": 30, "b": 45}, showlegend=False)
    return figure, named


def running_mean(values: Sequence[float], window: int = SMOOTHED) -> list[float]:
    """Return for each value the mean of it and those before it, at most `window` of them."""
    total = np.cumsum([0.0, *values])
    ends = np.arange(1, len(values) + 1)
    starts = np.maximum(0, ends - window)
    return ((total[ends] - total[starts]) / (ends - starts)).tolist()


def ticks_1_2_5(values: Iterable[float]) -> list[float]:
    """Return ticks at 1, 2 and 5 times powers of ten that cover the positive values; Plotly's own omit the power.

    Where fewer than two of them lie between values that differ, ticks are evenly apart, by 1, 2 or 5 times a power of
    ten.
    """
    positive = [value for value in values if value > 0]
    if not positive:
        return [1.0]
    low, high = min(positive), max(positive)
    first, last = math.floor(math.log10(low)), math.floor(math.log10(high))
    ticks = [m * 10.0**power for power in range(first, last + 2) for m in (1, 2, 5)]
    if high <= 1.0001 * low or sum(low <= tick <= high for tick in ticks) > 1:
        return ticks
    power = 10.0 ** math.floor(math.log10(high - low))
    step = next(m * power for m in (0.2, 0.5, 1, 2, 5) if (high - low) / (m * power) <= EVEN_TICKS)
    return [
        float(f"{n * step:.6g}") for n in range(math.floor(low / step), math.ceil(high / step) + 1) if n > 0
    ]
