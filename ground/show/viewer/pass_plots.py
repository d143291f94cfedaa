"""The pass beside the model: housekeeping as plots with limits, events and commands; live, or replayed at any speed."""

import html
import math
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import viser
from viser import uplot

from ground.link.uplink import HISTORY
from ground.session.folder import read_log
from ground.session.telemetry import refusal
from ground.show.telemetry_plots import (
    BYTES_PER_MB,
    LIMIT_COLOURS,
    Series,
    constant_reach,
    housekeeping_series,
    named,
    near_limits,
    unit_of,
)

TELEMETRY, EVENTS = "telemetry.jsonl", "events.jsonl"
EVENTS_SHOWN = 30
PLOT_PX, PANEL_PX = 120, 330
TOP_PX = 12  # beside which the topmost number of an axis, and the last one, are whole
STEPS_A_SECOND = 10  # of the slider; the replay itself goes on between them
DRAWN_EVERY_S = 1.0  # of a replay's viewers' time: a page that is sent plots more often lags behind
SPEEDS = {"1x": 1.0, "10x": 10.0, "100x": 100.0, "1000x": 1000.0}
SEVERITY_COLOURS = {"info": "inherit", "warning": LIMIT_COLOURS["yellow"], "error": LIMIT_COLOURS["red"]}


@dataclass(frozen=True)
class Event:
    """What was told in the pass: seconds since its first housekeeping, by the spacecraft's clock where it has one."""

    seconds: float
    severity: str
    text: str


def pass_events(session: Path, start_utc_ns: int) -> list[Event]:
    """Return events and ends of commands in the order of time; lines that are damaged are left out."""
    found, commands = [], read_log(session / HISTORY)
    ended = {
        refusal(line["counter"], line["text"]) for line in commands if {"counter", "text"} <= line.keys()
    }
    for line in read_log(session / EVENTS):
        if line.get("event") == "command_refused" and line.get("problem") in ended:
            continue  # told where the command ends
        utc_ns, text = line.get("utc_ns", line.get("received_utc_ns")), line.get("text")
        if type(utc_ns) is int and isinstance(text, str):
            found.append(Event((utc_ns - start_utc_ns) / 1e9, str(line.get("severity", "info")), text))
    for line in commands:
        utc_ns, stage = line.get("ended_utc_ns"), line.get("stage")
        if type(utc_ns) is int:
            severity = "info" if stage == "completed" else "warning"
            text = f"command {line.get('given')} {stage}: {line.get('text')}"
            found.append(Event((utc_ns - start_utc_ns) / 1e9, severity, text))
    return sorted(found, key=lambda event: event.seconds)


def up_to(series: Series, seconds: float) -> Series:
    """Return what was known of a series at a time."""
    kept = series.seconds <= seconds
    return Series(series.item, series.seconds[kept], series.values[kept], series.start_utc_ns)


def announced_frames(session: Path) -> list[tuple[int, int]]:
    """Return when each frame's header came and when the frame was taken, Unix ns by two clocks, in the order of coming.

    The first is by the clock of the housekeeping, which tells when its own packets were sent and came.
    """
    lines = read_log(session / TELEMETRY)
    timed = [line for line in lines if type(line.get("received_utc_ns")) is int]
    sent = sorted(
        (line["received_utc_ns"], line["utc_ns"]) for line in timed if type(line.get("utc_ns")) is int
    )
    headers = sorted(
        (line["received_utc_ns"], line["mid_exposure_utc_ns"])
        for line in timed
        if type(line.get("mid_exposure_utc_ns")) is int
    )
    if not sent or not headers:
        return []
    first_ns = sent[0][0]  # large numbers would lose digits
    came_s = np.array([came - first_ns for came, _ in headers]) / 1e9
    ahead_s = np.interp(
        came_s, [(came - first_ns) / 1e9 for came, _ in sent], [(own - came) / 1e9 for came, own in sent]
    )
    return [(came + round(1e9 * ahead), taken) for (came, taken), ahead in zip(headers, ahead_s, strict=True)]


@dataclass(frozen=True)
class Controls:
    """The panel's controls, and a plot for each item of the housekeeping that is shown."""

    replay: viser.GuiCheckboxHandle
    speed: viser.GuiDropdownHandle
    place: viser.GuiSliderHandle
    told: viser.GuiHtmlHandle
    plots: dict[str, viser.GuiUplotHandle]


class PassPlots:
    """A panel with the telemetry of a session. Only `tick` draws, so that its last state is the one that is seen.

    Args:
        on_time: told the time of a replay by the clock of the frames, Unix ns, as it goes on.
        taken_utc_ns: gives the times of the frames that there are.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        session: Path,
        on_time: Callable[[int], None] = lambda utc_ns: None,
        taken_utc_ns: Callable[[], list[int]] = list,
    ):
        self._server, self._session = server, session
        self._on_time, self._taken_utc_ns = on_time, taken_utc_ns
        self._announced: list[tuple[int, int]] = []
        self._read: tuple[int, ...] = ()  # sizes of the files as they were read
        self._series: list[Series] = []
        self._events: list[Event] = []
        self._is_replaying = False
        self._replayed_s = self._shown_s = 0.0  # how far the replay is, and what the slider says of it
        self._drawn_to_s = np.inf  # of the pass
        self._since_drawn_s = 0.0  # of the viewers' time
        self.controls: Controls | None = None  # None before the first housekeeping

    def tick(self, elapsed_s: float) -> None:
        """Read what has come, and let a replay go on by so many seconds of its viewers' time."""
        files = [self._session / name for name in (TELEMETRY, EVENTS, HISTORY)]
        sizes = tuple(path.stat().st_size if path.is_file() else 0 for path in files)
        changed = sizes != self._read
        if changed:
            self._series, self._read = housekeeping_series(self._session), sizes
            if self._series:
                self._events = pass_events(self._session, self._series[0].start_utc_ns)
                self._announced = announced_frames(self._session)
        if not self._series:
            return
        if self.controls is None:
            self.controls = self._built()
        controls = self.controls
        end_s = max(float(self._series[0].seconds[-1]), *(event.seconds for event in self._events), 0.0)
        controls.place.max = max(math.ceil(end_s * STEPS_A_SECOND) / STEPS_A_SECOND, 1.0)
        was_replaying, self._is_replaying = self._is_replaying, controls.replay.value
        is_due = changed or was_replaying != self._is_replaying
        if self._is_replaying:
            if not was_replaying and controls.place.value >= controls.place.max:
                # once more, from the beginning
                controls.place.value = self._shown_s = self._replayed_s = 0.0
            moved = self._go_on(controls, elapsed_s, end_s)
            self._since_drawn_s += elapsed_s
            late = self._since_drawn_s >= DRAWN_EVERY_S or self._replayed_s == end_s
            if is_due or moved or (late and self._drawn_to_s != self._replayed_s):
                self._draw(controls, self._replayed_s)
        elif is_due:
            self._draw(controls, np.inf)

    def _go_on(self, controls: Controls, elapsed_s: float, end_s: float) -> bool:
        """Let a replay go on by so many seconds of its viewers' time; return whether someone has moved the slider."""
        if moved := controls.place.value != self._shown_s:
            self._replayed_s = float(controls.place.value)
        self._replayed_s += elapsed_s * SPEEDS.get(controls.speed.value, 1.0)
        self._replayed_s = min(self._replayed_s, end_s)
        self._shown_s = math.ceil(self._replayed_s * STEPS_A_SECOND) / STEPS_A_SECOND
        controls.place.value = self._shown_s
        if (utc_ns := self._time_of_frames()) is not None:
            self._on_time(utc_ns)
        return moved

    @property
    def _is_one_clock(self) -> bool:
        """Whether any frame was taken while housekeeping came; those of a simulated pass have its simulated times."""
        taken, start_ns = self._taken_utc_ns(), self._series[0].start_utc_ns
        end_ns = start_ns + 1e9 * float(self._series[0].seconds[-1])
        return not taken or any(start_ns <= utc_ns <= end_ns for utc_ns in taken)

    def _time_of_frames(self) -> int | None:
        """Return how far a replay is by the clock of the frames; None where nothing tells, or nothing has come yet.

        Where that is another clock than the housekeeping's, the frame that was announced last tells the time.
        """
        now_ns = self._series[0].start_utc_ns + round(1e9 * self._replayed_s)
        if self._is_one_clock:
            return now_ns
        return max((taken for came, taken in self._announced if came <= now_ns), default=None)

    @property
    def _note(self) -> str:
        """What a replay shows of the frames where their times are not those of the telemetry; else nothing."""
        if self._is_one_clock:
            return ""
        if self._announced:
            return "Frames have another clock than the telemetry: the timeline shows the one that was announced last."
        return "Frames have another clock than the telemetry, and nothing links the two: the timeline stays."

    def _built(self) -> Controls:
        gui = self._server.gui
        panel = gui.add_panel()
        with panel.add_tab("Telemetry"):
            replay = gui.add_checkbox("Replay the pass", initial_value=False)
            speed = gui.add_dropdown("Speed", tuple(SPEEDS), initial_value="10x")
            place = gui.add_slider("Seconds", min=0.0, max=1.0, step=1 / STEPS_A_SECOND, initial_value=0.0)
            controls = Controls(
                replay, speed, place, gui.add_html(""), {s.item.name: self._plot(s) for s in self._series}
            )
        panel.dock_left()
        panel.set_width(PANEL_PX)
        return controls

    def _plot(self, series: Series) -> viser.GuiUplotHandle:
        return self._server.gui.add_uplot(
            data=plotted(series, series),
            series=drawn_lines(series),
            scales=scales_of(series),
            axes=(
                uplot.Axis(stroke="#9aa5b1", label="s", labelSize=16, labelGap=-4, size=28),
                uplot.Axis(stroke="#9aa5b1", size=64),
            ),
            title=f"{named(series.item)}{unit_of(series.item)}",
            legend=uplot.Legend(show=False),
            height=PLOT_PX,
            padding=(TOP_PX, TOP_PX, 0, 0),
        )

    def _draw(self, controls: Controls, seconds: float) -> None:
        """Draw plots and events as they were known at a time; what is drawn so already is not sent again."""
        self._drawn_to_s, self._since_drawn_s = seconds, 0.0
        known = [up_to(series, seconds) for series in self._series]
        for whole, series in zip(self._series, known, strict=True):
            plot, data = controls.plots[series.item.name], plotted(series, whole)
            if len(data) != len(plot.series):  # a limit has come near, or is far away now
                plot.series = drawn_lines(whole)
            if (scales := scales_of(series)) != plot.scales:
                plot.scales = scales
            if not _are_equal(data, plot.data):
                plot.data = data
        told = [event for event in self._events if event.seconds <= seconds]
        controls.told.content = _told(known, told, self._note if self._is_replaying else "")


def drawn_lines(whole: Series) -> tuple[uplot.Series, ...]:
    """Return how the columns of `plotted` are drawn."""
    lines = [
        uplot.Series(label="limit", stroke=colour, dash=(4, 4), width=1) for _, colour in near_limits(whole)
    ]
    return (uplot.Series(label="s"), uplot.Series(label="value", stroke="#6ea8fe", width=2), *lines)


def scales_of(known: Series) -> dict[str, uplot.Scale]:
    """Return the scales of a plot: those of values that are all alike begin just below 0, so that 0 itself is seen.

    The page's own axis of values that are all 0 would go up to 100.
    """
    scales = {"x": uplot.Scale(time=False)}
    if (reach := constant_reach(known)) is not None:
        scales["y"] = uplot.Scale(
            range=(-0.05 * reach, 1.15 * reach)
        )  # the page cuts what is written at the edge
    return scales


def plotted(known: Series, whole: Series) -> tuple[np.ndarray, ...]:
    """Return a plot's columns: seconds, values (bytes in MB), then the limits that are near.

    A value stands until the next one comes, as in the report: each has a point where it came and one where it ended.
    """
    factor = BYTES_PER_MB if known.item.unit == "B" else 1.0
    seconds, values = np.repeat(known.seconds, 2)[1:], np.repeat(known.values / factor, 2)[:-1]
    limits = [np.full(len(seconds), bound / factor) for bound, _ in near_limits(whole)]
    return (seconds, values, *limits)


def _are_equal(some: tuple[np.ndarray, ...], others: tuple[np.ndarray, ...]) -> bool:
    return len(some) == len(others) and all(map(np.array_equal, some, others))


def _told(known: list[Series], events: list[Event], note: str) -> str:
    """Return as HTML a note, the limits that are broken now, red before yellow, and the newest events, newest first."""
    broken = [(s, s.limits[-1]) for s in known if len(s.values) and s.limits[-1] != "green"]
    start_s = known[0].start_utc_ns / 1e9
    lines = [f"<i>{note}</i>"] if note else []
    lines += [
        f'<b style="color: {LIMIT_COLOURS[limit]}">{named(s.item)} {_in_words(s)}</b>'
        for s, limit in sorted(broken, key=lambda pair: pair[1] != "red")
    ]
    for event in events[: -EVENTS_SHOWN - 1 : -1]:
        at = f"{datetime.fromtimestamp(start_s + event.seconds, UTC):%H:%M:%S} UTC"
        colour = SEVERITY_COLOURS.get(event.severity, "inherit")
        lines.append(f'<span style="color: {colour}">{at} {html.escape(event.text)}</span>')
    return f'<div style="padding: 4px 12px; font-size: 12px; line-height: 1.5">{"<br>".join(lines)}</div>'


def _in_words(series: Series) -> str:
    value = series.values[-1] / (BYTES_PER_MB if series.item.unit == "B" else 1.0)
    return f"{value:,.6g}{unit_of(series.item).replace(',', '')}"
