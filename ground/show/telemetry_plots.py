"""The spacecraft's housekeeping over time, as small figures with the limits of the telemetry dictionary in colour."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import plotly.graph_objects as go

from flightsw.icd.telemetry import DICTIONARY, Item
from ground.session.folder import read_log

LIMIT_COLOURS = {"green": "#1f6feb", "yellow": "#d99a00", "red": "#c0392b"}
SHOWN = (  # the items that say how a pass went; telemetry.jsonl holds all of them
    *("frames_stored", "outbox_frames", "delivered", "frames_failed", "frames_refused", "frames_dropped"),
    *("segments_resent", "crc_errors", "hang_ups", "disk_free_bytes", "cpu_percent", "rss_bytes"),
)
HEIGHT_PX = 175
BYTES_PER_MB = 1e6


@dataclass(frozen=True)
class Series:
    """One number of the housekeeping packets over time."""

    item: Item
    seconds: np.ndarray  # [N] since the first packet, by the spacecraft's clock
    values: np.ndarray  # [N]
    start_utc_ns: int = 0  # of the first packet

    @property
    def limits(self) -> list[str]:
        """The limit that each value keeps or breaks: green, yellow or red."""
        return [self.item.limit(value) for value in self.values.tolist()]


def housekeeping_series(session: Path) -> list[Series]:
    """Return the numbers of a session's housekeeping that are shown, in order of time; none without telemetry.

    Lines that are damaged or lack an item are left out: telemetry is shown as far as it can be read.
    """
    lines = [line for line in read_log(session / "telemetry.jsonl") if _is_housekeeping(line)]
    if not lines:
        return []
    utc_ns = np.array([line["utc_ns"] for line in lines])
    order = np.argsort(utc_ns, kind="stable")
    seconds = (utc_ns[order] - utc_ns.min()) / 1e9
    layout = DICTIONARY.telemetry["housekeeping"]
    values = {name: np.array([float(line[name]) for line in lines])[order] for name in SHOWN}
    start = int(utc_ns.min())
    return [Series(layout.item(name), seconds, values[name], start) for name in SHOWN]


def telemetry_figures(series: list[Series]) -> list[go.Figure]:
    """Return one small plot for each series; values beyond a limit are yellow or red, the limits are lines."""
    figures = []
    for each in series:
        figure = go.Figure()
        factor = BYTES_PER_MB if each.item.unit == "B" else 1.0
        figure.add_scatter(
            x=each.seconds,
            y=each.values / factor,
            mode="lines+markers",
            line={"color": "#b9c4d0", "width": 1, "shape": "hv"},
            marker={"size": 4, "color": [LIMIT_COLOURS[limit] for limit in each.limits]},
            hovertemplate="%{y:,} after %{x:.0f} s<extra></extra>",
            showlegend=False,
            cliponaxis=False,  # a value on the axis is seen whole
        )
        for bound, colour in near_limits(each):
            figure.add_hline(y=bound / factor, line={"color": colour, "width": 1, "dash": "dot"})
        if (reach := constant_reach(each)) is not None:
            figure.update_yaxes(range=[0.0, reach])
        figure.update_xaxes(ticksuffix=" s")
        figure.update_yaxes(tickformat=",")
        title = {"text": f"{named(each.item)}{unit_of(each.item)}", "font": {"size": 12}}
        figure.update_layout(height=HEIGHT_PX, title=title, margin={"l": 45, "r": 15, "t": 30, "b": 25})
        figures.append(figure)
    return figures


def constant_reach(series: Series) -> float | None:
    """Return how far up from 0 the axis of a series goes whose values are all alike, bytes in MB; None of others.

    A scale of thousandths around a constant says nothing, and nothing that is shown can be negative.
    """
    if len(series.values) == 0 or series.values.min() != series.values.max():
        return None
    factor = BYTES_PER_MB if series.item.unit == "B" else 1.0
    highest = max([2 * series.values[0], *(1.1 * bound for bound, _ in near_limits(series))])
    return float(highest) / factor or 1.0


def near_limits(series: Series) -> list[tuple[float, str]]:
    """Return the limits that can be drawn without hiding how the values change, each with its colour.

    A range from 0 to more has one limit: nothing that is shown can be negative.
    """
    return [
        (bound, LIMIT_COLOURS[limit])
        for limit, bounds in (("yellow", series.item.yellow), ("red", series.item.red))
        for bound in bounds
        if (bound > 0 or max(bounds) == 0) and _is_near(bound, series.values)
    ]


def broken_limits(series: list[Series]) -> list[tuple[str, str]]:
    """Return the name of each item that broke a limit, and the worst limit it broke."""
    worst = {each.item.name: max(each.limits, key=("green", "yellow", "red").index) for each in series}
    return [(name, limit) for name, limit in worst.items() if limit != "green"]


def _is_housekeeping(line: dict[str, Any]) -> bool:
    is_packet = line.get("packet") == "housekeeping"
    return is_packet and all(type(line.get(name)) in (int, float) for name in ("utc_ns", *SHOWN))


def named(item: Item) -> str:
    """Return an item's name in words, without the unit that stands beside it."""
    return item.name.removesuffix("_bytes").removesuffix("_percent").replace("_", " ")


def unit_of(item: Item) -> str:
    """Return an item's unit after a comma, bytes as MB; nothing where it has none."""
    return f", {'MB' if item.unit == 'B' else item.unit}" if item.unit else ""


def _is_near(bound: float, values: np.ndarray) -> bool:
    """Return whether a limit is near enough to the values to be drawn without hiding how they change."""
    low, high = float(values.min()), float(values.max())
    reach = max(high - low, 0.5 * abs(high), 1.0)
    return low - reach <= bound <= high + reach
