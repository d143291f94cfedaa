"""The operator's console: the state of link, spacecraft, files and commands, on one screen or in lines of text."""

import contextlib
import dataclasses
import functools
import json
import logging
import math
import os
import select
import sys
import termios
import tty
from collections import deque
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.panel import Panel
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from flightsw.icd.telemetry import DICTIONARY, printable
from ground.commands.terminal_pictures import COLUMNS, LatestPicture
from ground.link.ingest import Status
from ground.run.live.status import line as model_line
from ground.session.telemetry import plain
from obbgs_base.errors import counted

log = logging.getLogger(__name__)
PLAIN_S, JSON_S = 10.0, 1.0  # between lines where there is no screen
RATE_WINDOW_S = 5.0
SILENT_S = 3.0  # without a packet the link counts as silent; housekeeping comes every second
EVENTS_SHOWN = 10
ALARMS_SHOWN = 8
WIDE, HIGH = 120, 45  # columns and lines from which all panels have room at once; else keys switch them
PANELS = ("alarms and events", "link", "spacecraft", "files", "picture", "model")
TENDED = ("store_failures", "frames_rejected")  # counts of the ground that somebody has to look at
FILES_SHOWN = 8
EVENTS_REMEMBERED = 100  # refusals, without a terminal
HOUSEKEEPING = DICTIONARY.telemetry["housekeeping"]
COLOURS = {"green": "green", "yellow": "yellow", "red": "bold red"}
SEVERITIES = {"info": "", "warning": "yellow", "error": "bold red"}
# Items of the spacecraft panel; telemetry.jsonl holds all of them.
SHOWN = """
mode camera exposure_times_ms near priority model frames_stored frames_failed outbox_frames frames_ranked
transfers_failed segments_resent crc_errors hang_ups disk_free_bytes cpu_percent rss_bytes commands_accepted
commands_refused
"""
COUNTS = """
crc_errors packets_missing skipped_bytes segments_resent duplicates frames_rejected telemetry_refused store_failures
hang_ups packets_not_forwarded
"""


@contextlib.contextmanager
def statuses_shown(console: Console, as_json: bool, link: str, session: Path) -> Iterator[tuple[Any, Any]]:
    """Give two functions for `listen`, which show a status and an event of a link (its URL) and a session's folder.

    On a terminal they draw a screen; elsewhere they print a line every ten seconds and each event; with `as_json` a
    line of JSON on stdout every second and for each event.
    """
    view, next_line_s = ConsoleView(link, session), float("-inf")
    refused: deque[str | None] = deque(maxlen=EVENTS_REMEMBERED)
    live = console.is_terminal and not as_json

    def on_status(status: Status) -> None:
        nonlocal next_line_s
        if live:
            view.press(keys())
            screen.update(view.draw(status, *console.size), refresh=True)
        elif status.now_s >= next_line_s:
            next_line_s = status.now_s + (JSON_S if as_json else PLAIN_S)
            if as_json:
                facts = dataclasses.asdict(status)
                facts["housekeeping"] = plain(facts["housekeeping"])
                del facts["events"]  # each was printed when it came
                print(json.dumps({"type": "status"} | facts), flush=True)
            else:
                console.print(view.line(status), markup=False, highlight=False, soft_wrap=True)

    def on_event(event: dict[str, Any]) -> None:
        # a refusal is told where its command ends, and a command that is resent is refused again: housekeeping counts
        is_again = event.get("event") == "command_refused" and event.get("problem") in refused
        if event.get("event") in ("command", "command_refused"):
            refused.append(event.get("problem"))
        if as_json:
            print(json.dumps({"type": "event"} | event), flush=True)
        elif not live and not is_again:
            text = f"{event['severity']}: {event['text']}"
            console.print(text, markup=False, highlight=False, soft_wrap=True)

    # Refreshed by on_status, so that no thread of rich's can fail unseen.
    screen = Live(console=console, auto_refresh=False, transient=True)
    with keys_pressed() as keys, screen if live else contextlib.nullcontext():
        yield failures_told(on_status), failures_told(on_event)


def failures_told(show: Callable[[Any], None]) -> Callable[[Any], None]:
    """Return the function with its failures logged, each once: no fault of what is shown may end a reception."""
    told: set[str] = set()

    @functools.wraps(show)
    def shown_or_told(what: Any) -> None:
        try:
            show(what)
        except Exception as error:  # whatever it is, what arrives matters more
            if repr(error) not in told:
                told.add(repr(error))
                log.error("receiving goes on, but it cannot be shown: %r", error, exc_info=error)

    return shown_or_told


@contextlib.contextmanager
def keys_pressed() -> Iterator[Callable[[], str]]:
    """Give a function that returns what was typed since the last call, without waiting; "" where nobody can type."""
    try:
        descriptor = sys.stdin.fileno()
        before = termios.tcgetattr(descriptor)
    except (AttributeError, ValueError, OSError, termios.error):  # no terminal
        yield lambda: ""
        return

    def typed() -> str:
        ready, _, _ = select.select([descriptor], [], [], 0)
        return os.read(descriptor, 100).decode(errors="ignore") if ready else ""

    # single keys; Ctrl-C still ends the command. At once: a terminal that nobody reads never sends what it holds
    tty.setcbreak(descriptor, termios.TCSANOW)
    try:
        yield typed
    finally:
        termios.tcsetattr(descriptor, termios.TCSANOW, before)


class ConsoleView:
    """Draws statuses, and keeps those of the last seconds to compute data rates."""

    def __init__(self, link: str, session: Path) -> None:
        self._link, self._session = link, session
        self._picture = LatestPicture(session)
        self._history: deque[tuple[float, int, int]] = deque()
        self.panel = PANELS[0]  # the one that a small terminal shows

    def press(self, keys: str) -> None:
        """Switch the panel: 1, 2 ... name one, any other letter, space or tab goes to the next."""
        for key in keys:
            if key.isdigit():
                self.panel = PANELS[min(max(int(key), 1), len(PANELS)) - 1]
            elif key.isalpha() or key in " \t":
                self.panel = PANELS[(PANELS.index(self.panel) + 1) % len(PANELS)]

    def rates(self, status: Status) -> tuple[float, float] | None:
        """Return bytes per second down and up since the latest status at least five seconds old; None at first.

        Where statuses come less often than that, as without a terminal, this is the status before.
        """
        now = (status.now_s, status.summary.bytes_received, status.summary.bytes_sent)
        self._history.append(now)
        while len(self._history) > 1 and self._history[1][0] <= status.now_s - RATE_WINDOW_S:
            self._history.popleft()
        then = self._history[0]
        elapsed_s = now[0] - then[0]
        return ((now[1] - then[1]) / elapsed_s, (now[2] - then[2]) / elapsed_s) if elapsed_s > 0 else None

    def draw(self, status: Status, width: int = 160, height: int = 60) -> RenderableType:
        """Return the screen for a terminal of so many columns and lines."""
        down, up = self.rates(status) or (0.0, 0.0)
        if width < WIDE or height < HIGH:
            return self._draw_small(status, down, up, height)
        top = Table.grid(expand=True, padding=(0, 1))
        top.add_column(ratio=1)
        top.add_column(ratio=1)
        title = Text.assemble("link ", (printable(self._link), "bold"))
        top.add_row(Panel(_link(status, down, up), title=title), Panel(_flight(status), title="spacecraft"))
        picture = self._picture.after(status.summary.thumbnails_received, status.summary.frames_in_session)
        name = Text.assemble("session ", (printable(str(self._session)), "bold"))
        model = [] if status.model is None else [Panel(Text(_model(status)), title="model")]
        left = Group(
            Panel(_alarms_and_events(status, ALARMS_SHOWN + EVENTS_SHOWN), title="alarms and events"),
            Panel(_files(status, down), title=name),
            *model,
        )
        bottom = Table.grid(expand=True, padding=(0, 1))
        bottom.add_column(ratio=1)
        bottom.add_column(width=COLUMNS + 4)
        bottom.add_row(left, Panel(picture, title=self._picture.name or "latest picture"))
        return Group(top, bottom)

    def _draw_small(self, status: Status, down: float, up: float, height: int) -> RenderableType:
        """Return a line of the link's state, one panel, and a line of the keys that switch panels."""
        state, colour = link_state(status)
        summary = status.summary
        head = Text.assemble(
            (f"link {state}", colour),
            f"  {size(down)}/s down, {size(up)}/s up  frames {summary.frames_in_session} / {captured(status)}",
            no_wrap=True,
            overflow="ellipsis",
        )
        body: dict[str, Callable[[], RenderableType]] = {
            "alarms and events": lambda: _alarms_and_events(status, height - 4),
            "link": lambda: _link(status, down, up),
            "spacecraft": lambda: _flight(status),
            "files": lambda: _files(status, down),
            "picture": lambda: self._picture.after(summary.thumbnails_received, summary.frames_in_session),
            "model": lambda: Text(_model(status)),
        }
        panel = Panel(body[self.panel](), title=self.panel, height=height - 2)
        names = "  ".join(f"{number} {name}" for number, name in enumerate(PANELS, start=1))
        return Group(head, panel, Text(names, "dim", no_wrap=True, overflow="ellipsis"))

    def line(self, status: Status) -> str:
        """Return the status in one line of text."""
        rates = self.rates(status)
        speed = f"{rates[0] / 1e3:.1f} kB/s down, {rates[1] / 1e3:.1f} up, " if rates else ""
        s = status.summary
        return (
            f"{link_state(status)[0]}, frames {s.frames_in_session} received / {captured(status)} captured, {speed}"
            f"{s.crc_errors} CRC errors, {s.packets_missing} missing, {s.segments_resent} resent, "
            f"outbox {status.housekeeping.get('outbox_frames', '?')}"
            + ("" if status.model is None else f"; model: {_model(status, in_short=True)}")
        )


def _model(status: Status, in_short: bool = False) -> str:
    """Return how the training beside the listener stands; in short without why it failed, which was told then."""
    if status.model is None:
        return "none is made meanwhile"
    if in_short and status.model.get("state") == "failed":
        return "failed"
    return model_line(status.model) if status.model else "the training starts"


def link_state(status: Status) -> tuple[str, str]:
    """Return the link's state in words, and its colour."""
    if not status.connected:
        return "port closed", "bold red"
    if status.quiet_s > SILENT_S or not status.summary.packets_received:
        return f"silent for {status.quiet_s:.0f} s", "yellow"
    return "up", "green"


def captured(status: Status) -> str:
    """Return how many frames the spacecraft reported to have taken; "unknown" before its first telemetry."""
    count = status.summary.frames_captured
    return "unknown" if count is None else f"{count:,}"


def _link(status: Status, down: float, up: float) -> Table:
    state, colour = link_state(status)
    s = status.summary
    rows: list[tuple[str, Text]] = [
        ("state", Text(state, colour)),
        ("rate down / up", Text(f"{size(down)}/s / {size(up)}/s")),
        ("received", Text(f"{size(s.bytes_received)}, {counted(s.packets_received, 'packet')}")),
        (
            "frames",
            Text(
                f"{s.frames_in_session} received / {captured(status)} captured, {s.frames_received} in this run"
            ),
        ),
        ("headers / thumbnails", Text(f"{s.headers_received} / {s.thumbnails_received}")),
    ]
    for name in COUNTS.split():
        count = getattr(s, name)
        rows.append((name.replace("_", " "), Text(f"{count:,}", "yellow" if count else "")))
    rows += [
        (name.replace("_", " "), Text(f"{count:,}", "yellow" if count else ""))
        for name, count in s.link_losses.items()
    ]
    return _rows(rows)


def _flight(status: Status) -> RenderableType:
    values = status.housekeeping
    if not values:
        return Text("no housekeeping yet", "yellow")
    age_colour = "yellow" if status.housekeeping_age_s > SILENT_S else "green"
    rows = [("telemetry age", Text(f"{status.housekeeping_age_s:.1f} s", age_colour))]
    for name in SHOWN.split():
        item = HOUSEKEEPING.item(name)
        rows.append(
            (name.replace("_", " "), Text(shown(name, values[name]), COLOURS[item.limit(values[name])]))
        )
    header = status.frame_header
    if header:
        seconds = header["mid_exposure_utc_ns"] // 10**9
        range_m = math.hypot(*header["position_body_m"])
        text = (
            f"{header['frame_id']}: {utc(seconds)}, {header['exposure_time_s'] * 1e3:g} ms, {range_m:.1f} m"
        )
        rows.append(("last exposure", Text(text)))
    return _rows(rows)


def shown(name: str, value: Any) -> str:
    """Return a housekeeping value as text with its unit."""
    item = HOUSEKEEPING.item(name)
    if isinstance(value, bytes):
        return value.hex() if any(value) else "none"
    if isinstance(value, tuple):
        return ", ".join(f"{number:zg}" for number in value) + f" {item.unit}"
    if item.unit == "B":
        return size(value)
    number = f"{value:z.1f}" if isinstance(value, float) else f"{value}"
    return f"{number} {item.unit}".rstrip()


def size(count: float) -> str:
    """Return a number of bytes with the unit that leaves at most four digits before the point."""
    for unit, factor in (("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if count >= factor:
            return f"{count / factor:.1f} {unit}"
    return f"{count:.0f} B"


def _files(status: Status, down: float) -> RenderableType:
    if not status.incoming:
        return Text("none in flight")
    table = Table.grid(padding=(0, 1))
    before_bytes = 0
    for file in status.incoming[:FILES_SHOWN]:
        size_bytes = file.size_bytes or 0
        before_bytes += max(size_bytes - file.received_bytes, 0)
        left = f"{before_bytes / down:.0f} s left" if down and size_bytes else ""
        bar = ProgressBar(total=max(size_bytes, 1), completed=file.received_bytes, width=30)
        name = printable(file.name)[:30] or "(not named yet)"
        table.add_row(Text(name), bar, Text(f"{size(file.received_bytes)} of {size(size_bytes)}"), Text(left))
    return table


def alarms(status: Status) -> list[tuple[str, str]]:
    """Return what is wrong now and the colour of each: red before yellow."""
    found = []
    state, colour = link_state(status)
    if colour != "green":
        found.append((f"link {state}", colour))
    for item in HOUSEKEEPING.items:
        if item.name in status.housekeeping:
            limit = item.limit(status.housekeeping[item.name])
            if limit != "green":
                value = shown(item.name, status.housekeeping[item.name])
                found.append((f"{item.name.replace('_', ' ')} {value}", COLOURS[limit]))
    for name in TENDED:
        if count := getattr(status.summary, name):
            found.append((f"{name.replace('_', ' ')} on the ground {count:,}", "yellow"))
    return sorted(found, key=lambda alarm: "red" not in alarm[1])


def events_once(events: list[dict[str, Any]]) -> list[tuple[dict[str, Any], int]]:
    """Return events, the newest first, each sentence once with how often it came: resending repeats a refusal.

    A refusal is told where its command ends, and not once more by the spacecraft's event about it.
    """
    ended = {event.get("problem") for event in events if event.get("event") == "command"}
    events = [e for e in events if e.get("event") != "command_refused" or e.get("problem") not in ended]
    counts: dict[str, int] = {}
    newest: dict[str, dict[str, Any]] = {}
    for event in reversed(events):
        newest.setdefault(event["text"], event)
        counts[event["text"]] = counts.get(event["text"], 0) + 1
    return [(event, counts[text]) for text, event in newest.items()]


def _alarms_and_events(status: Status, most: int) -> RenderableType:
    """Return alarms, then commands under way, then events, the newest first; at most so many lines."""
    lines = [Text(f"! {text}", colour) for text, colour in alarms(status)]
    if len(lines) > ALARMS_SHOWN:
        more = len(lines) - ALARMS_SHOWN + 1
        lines = [*lines[: ALARMS_SHOWN - 1], Text(f"! {more} more: see link and spacecraft", "yellow")]
    lines += [Text(f"command {name} {counter}: {stage}", "cyan") for counter, name, stage in status.commands]
    for event, count in events_once(status.events):
        times = f" ({count} times)" if count > 1 else ""
        text = f"{utc(event['received_utc_ns'] // 10**9)}  {printable(event['text'])}{times}"
        lines.append(Text(text, SEVERITIES[event["severity"]]))
    for line in lines:
        line.no_wrap, line.overflow = True, "ellipsis"
    return Group(*lines[: max(1, most)]) if lines else Text("no alarm, no event")


def _rows(rows: list[tuple[str, Text]]) -> Table:
    table = Table.grid(padding=(0, 2))
    for name, text in rows:
        table.add_row(Text(name, "dim"), text)
    return table


def utc(seconds: int) -> str:
    """Return a Unix time as a time of day; a number that is not a valid time in seconds."""
    try:
        return datetime.fromtimestamp(seconds, UTC).strftime("%H:%M:%SZ")
    except (ValueError, OverflowError, OSError):
        return f"{seconds} s"
