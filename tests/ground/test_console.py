"""Telemetry files, and the operator's screen: limits show in colour, and no text from the link moves the cursor."""

import io
import json
import os
import select
import termios
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import imagecodecs
import numpy as np
import pytest
from rich.console import Console
from rich.text import Text

from flightsw.icd.command import Report
from flightsw.icd.frame import HEADER, encode_frame
from flightsw.icd.packet import APID_EVENTS, APID_FRAME_HEADERS, APID_HOUSEKEEPING, APID_REPORTS
from flightsw.icd.telemetry import DICTIONARY
from flightsw.icd.transfer import Incoming
from ground.commands.console import (
    PLAIN_S,
    ConsoleView,
    events_once,
    failures_told,
    keys_pressed,
    link_state,
    shown,
    size,
    statuses_shown,
)
from ground.commands.terminal_pictures import COLUMNS, LatestPicture, stretched
from ground.link.ingest import ListenSummary, Status, _Ingest
from ground.session.telemetry import TelemetryLog
from obbgs_base.checked import parse_checked_line

LINK, HERE = "serial:///dev/ttyUSB0?baud=921600", Path("nowhere/pass-12")
SAMPLES = {"text": "x", "bytes": b"\xab\xcd\xef\x01" * 8, "float64": 1.5}


def housekeeping(**changes) -> dict:
    values = {}
    for item in DICTIONARY.telemetry["housekeeping"].items:
        value = item.states[0][1] if item.states else SAMPLES.get(item.kind, 0)
        if item.kind == "bytes":
            value = SAMPLES["bytes"][: item.count]
        values[item.name] = (0.05, 0.1) if item.type == "float64[16]" else value
    return values | {"disk_free_bytes": 5 * 10**9} | changes


def status(**changes) -> Status:
    values = {
        "now_s": 10.0,
        "summary": ListenSummary(packets_received=5, bytes_received=1000),
        "connected": True,
        "quiet_s": 0.1,
        "incoming": [],
        "housekeeping": housekeeping(),
        "housekeeping_age_s": 0.5,
        "frame_header": {},
        "events": [],
        "commands": [],
    }
    return Status(**values | changes)


def screen(view: ConsoleView, now: Status, width: int = 160, height: int = 60) -> str:
    """Return the screen with its colours as a terminal gets it."""
    console = Console(
        file=io.StringIO(), force_terminal=True, width=width, height=height, color_system="standard"
    )
    console.print(view.draw(now, width, height))
    assert isinstance(console.file, io.StringIO)
    return console.file.getvalue()


def test_the_screen_shows_link_spacecraft_files_and_events():
    view = ConsoleView(LINK, HERE)
    view.rates(status(now_s=6.0, summary=ListenSummary(packets_received=1)))
    drawn = screen(
        view,
        status(
            summary=ListenSummary(
                packets_received=9, bytes_received=40_000, crc_errors=3, link_losses={"wire": 2}
            ),
            incoming=[Incoming("00000012.obf", 5000, 25_000), Incoming("", 10, None)],
            events=[{"received_utc_ns": 0, "text": "bracket 7 lost", "severity": "warning"}],
            commands=[(4, "bracket", "accepted")],
        ),
    )
    for text in ("10.0 kB/s / 0 B/s", "00000012.obf", "5.0 kB of 25.0 kB", "2 s left", "(not named yet)"):
        assert text in drawn
    for text in ("bracket 7 lost", "command bracket 4: accepted", "0.05, 0.1 ms", "abcdef01", "5.0 GB"):
        assert text in drawn


@pytest.mark.parametrize(
    ("changes", "text", "colour"),
    [
        ({}, "5.0 GB", "32"),
        ({"disk_free_bytes": 5 * 10**8}, "500.0 MB", "33"),
        ({"disk_free_bytes": 10**7}, "10.0 MB", "1;31"),
        ({"mode": "safe"}, "safe", "1;31"),
        ({"cpu_percent": 95.0}, "95.0 %", "33"),
    ],
)
def test_limits_are_shown_in_colour(changes, text, colour):
    assert f"\x1b[{colour}m{text}" in screen(
        ConsoleView(LINK, HERE), status(housekeeping=housekeeping(**changes))
    )


def test_the_links_state_is_told_by_port_and_silence():
    assert link_state(status()) == ("up", "green")
    assert link_state(status(quiet_s=8.0)) == ("silent for 8 s", "yellow")
    assert link_state(status(summary=ListenSummary())) == ("silent for 0 s", "yellow")
    assert link_state(status(connected=False))[0] == "port closed"


def test_names_and_texts_from_the_link_cannot_move_the_cursor_or_style_the_screen():
    hostile = "\x1b[2J[bold red]\r\n"
    drawn = screen(
        ConsoleView(LINK, HERE),
        status(
            incoming=[Incoming(hostile, 0, 10)],
            events=[{"received_utc_ns": 1 << 80, "text": hostile, "severity": "info"}],
        ),
    )
    assert "\x1b[2J" not in drawn and "?[2J[bold red]??" in drawn


def test_before_any_telemetry_there_is_a_screen_and_a_line_all_the_same():
    empty = status(housekeeping={}, summary=ListenSummary())
    assert "no housekeeping yet" in screen(ConsoleView(LINK, HERE), empty)
    assert "outbox ?" in ConsoleView(LINK, HERE).line(empty)
    assert "outbox 0" in ConsoleView(LINK, HERE).line(status())


@pytest.mark.parametrize("every_s", [0.25, 1.0, 5.0, PLAIN_S])
def test_the_rate_is_told_however_rarely_a_line_is_printed(every_s):
    """`ground listen` without a terminal prints a line every ten seconds, longer than the rate's own window."""
    view, texts = ConsoleView(LINK, HERE), []
    for number in range(round(30.0 / every_s)):
        now_s = number * every_s
        summary = ListenSummary(bytes_received=round(40_000 * now_s), bytes_sent=round(300 * now_s))
        texts.append(view.line(status(now_s=now_s, summary=summary)))
    assert "kB/s" not in texts[0]  # not known yet
    assert all("40.0 kB/s down, 0.3 up" in text for text in texts[1:])


def test_the_rate_is_of_the_last_seconds_only():
    view = ConsoleView(LINK, HERE)
    for now_s, received in ((0.0, 0), (10.0, 10**6), (12.0, 10**6), (16.0, 10**6 + 60_000)):
        rates = view.rates(status(now_s=now_s, summary=ListenSummary(bytes_received=received)))
    assert rates == (10_000.0, 0.0)  # since 10 s: the newest status that is at least 5 s old


def test_frames_that_flight_took_are_counted_or_said_to_be_unknown():
    for taken, text in ((None, "24 received / unknown captured"), (48, "24 received / 48 captured")):
        now = status(summary=ListenSummary(frames_in_session=24, frames_captured=taken))
        assert text in screen(ConsoleView(LINK, HERE), now) and text in ConsoleView(LINK, HERE).line(now)


def test_a_model_and_the_lack_of_one_are_shown():
    assert (shown("model", b"\1\2\3\4"), shown("model", bytes(4))) == ("01020304", "none")


def read(folder, name) -> list[dict]:
    return [parse_checked_line(line) for line in (folder / name).read_bytes().splitlines()]


def test_telemetry_is_kept_with_the_session_as_it_came(tmp_path, make_frame):
    events, reports = [], []
    log = TelemetryLog(tmp_path, events.append, reports.append, lambda: 77)
    log.add(APID_HOUSEKEEPING, DICTIONARY.telemetry["housekeeping"].pack(**housekeeping(outbox_frames=9)))
    container = encode_frame(make_frame(12))
    log.add(APID_FRAME_HEADERS, container[: HEADER.size])
    log.add(APID_EVENTS, DICTIONARY.events["warning"].pack(utc_ns=5, problem="cold"))
    log.add(APID_EVENTS, DICTIONARY.events["model_in_use"].pack(utc_ns=6, sha256=bytes(range(32))))
    log.add(APID_REPORTS, Report(8, 3, bytes(8), "completed", "alive").pack())
    packet, header = read(tmp_path, "telemetry.jsonl")
    assert (packet["packet"], packet["outbox_frames"], packet["received_utc_ns"]) == ("housekeeping", 9, 77)
    assert (header["packet"], header["frame_id"]) == ("frame", 12)
    assert header["position_body_m"] == make_frame(12).pose.position_body_m.tolist()
    warning, model = read(tmp_path, "events.jsonl")
    assert (warning["event"], warning["severity"], warning["text"]) == ("warning", "warning", "cold")
    assert model["text"] == "frames are ranked by the model 00010203"
    assert events == [warning, model]
    assert read(tmp_path, "reports.jsonl")[0]["stage"] == "completed" and len(reports) == 1
    assert log.refused == 0


def test_an_event_that_comes_again_is_taken_once(tmp_path):
    heard: list[dict] = []
    log, again = (
        TelemetryLog(tmp_path, heard.append),
        DICTIONARY.events["warning"].pack(utc_ns=5, problem="cold"),
    )
    later = DICTIONARY.events["warning"].pack(utc_ns=6, problem="cold")
    for data in (again, again, later, again):
        log.add(APID_EVENTS, data)
    assert (
        [event["utc_ns"] for event in heard]
        == [5, 6]
        == [e["utc_ns"] for e in read(tmp_path, "events.jsonl")]
    )


def test_what_the_dictionary_does_not_know_is_counted_and_written_nowhere(tmp_path):
    log = TelemetryLog(tmp_path)
    for apid in (APID_HOUSEKEEPING, APID_FRAME_HEADERS, APID_EVENTS, APID_REPORTS, 0x0C5):
        for data in (b"", b"\1", b"\1\1", bytes(310), b"\xff" * 400):
            log.add(apid, data)
    assert log.refused == 25
    assert list(tmp_path.iterdir()) == []


def test_a_line_cut_off_by_a_power_cut_does_not_swallow_the_next(tmp_path):
    log = TelemetryLog(tmp_path)
    log.add(APID_EVENTS, DICTIONARY.events["warning"].pack(utc_ns=5, problem="first"))
    with open(tmp_path / "events.jsonl", "ab") as file:
        file.write(b'{"event": "war')
    log.add(APID_EVENTS, DICTIONARY.events["warning"].pack(utc_ns=6, problem="second"))
    lines = (tmp_path / "events.jsonl").read_text().splitlines()
    assert json.loads(lines[2])["text"] == "second" and len(lines) == 3


def test_a_disk_that_refuses_telemetry_is_counted_and_the_pass_goes_on(tmp_path):
    (tmp_path / "events.jsonl").mkdir()
    log = TelemetryLog(tmp_path)
    log.add(APID_EVENTS, DICTIONARY.events["warning"].pack(utc_ns=5, problem="first"))
    assert log.write_failures == 1 and log.events[-1]["text"] == "first"


def test_link_and_session_are_named_and_nothing_in_a_name_moves_the_cursor():
    drawn = screen(ConsoleView("can://can0\x1b[2J", Path("there/pass-7")), status())
    assert "there/pass-7" in drawn and "can://can0?" in drawn and "\x1b[2J" not in drawn


@pytest.mark.parametrize(
    ("count", "told"),
    [(0, "0 B"), (999, "999 B"), (1500, "1.5 kB"), (2.5e6, "2.5 MB"), (8e9, "8.0 GB")],
)
def test_bytes_are_told_in_units_that_a_person_reads(count, told):
    assert size(count) == told


def written(folder: Path, number: int, dn: np.ndarray) -> None:
    folder.mkdir(exist_ok=True)
    (folder / f"{number:06d}.png").write_bytes(bytes(imagecodecs.png_encode(dn)))


def test_the_latest_picture_is_drawn_in_half_blocks(tmp_path):
    """A white square right of the middle of a black picture is white there, and black elsewhere."""
    dn = np.full((72, 72), 64, np.uint16)
    dn[24:48, 36:60] = 4000
    picture = LatestPicture(tmp_path)
    assert str(picture.after(0, 0)) == "none yet"
    written(tmp_path / "frames", 3, dn)
    lines = picture.after(0, 1).split("\n")
    assert picture.name == "frame 3" and len(lines) == 18 and {len(line) for line in lines} == {COLUMNS}
    inside, outside = (str(lines[8].get_style_at_offset(Console(), at)) for at in (24, 5))
    assert inside == "rgb(255,255,255) on rgb(255,255,255)" and outside == "rgb(0,0,0) on rgb(0,0,0)"
    drawn = screen(ConsoleView(LINK, tmp_path), status(summary=ListenSummary(frames_in_session=1)))
    assert "frame 3" in drawn and "▀" in drawn


def test_a_picture_that_cannot_be_read_leaves_the_one_before_it(tmp_path):
    written(tmp_path / "thumbnails", 1, np.arange(48 * 48, dtype=np.uint16).reshape(48, 48))
    picture = LatestPicture(tmp_path)
    before = picture.after(1, 0)
    assert picture.name == "thumbnail 1"
    (tmp_path / "thumbnails" / "000002.png").write_bytes(b"damaged")
    assert picture.after(2, 0) is before and picture.name == "thumbnail 1"


@pytest.mark.parametrize("shape", [(1, 1), (5, 300), (300, 5), (48, 64, 3), (37, 37)])
def test_pictures_of_any_shape_fit_the_panel(shape):
    rng = np.random.default_rng(0)
    image = stretched(rng.integers(0, 4096, shape, dtype=np.uint16))
    assert image.shape[0] % 2 == 0 and image.shape[1] <= COLUMNS and image.shape[2] == 3
    assert (stretched(np.full(shape, 7, np.uint16)) == 0).all()


@pytest.mark.parametrize(
    ("model", "told"),
    [
        (None, "none is made meanwhile"),
        ({}, "the training starts"),  # its process loads PyTorch still
        ({"state": "failed", "message": "no memory"}, "failed; no memory"),  # before it said anything
    ],
)
def test_the_panel_of_the_model_tells_a_training_that_starts_from_none(model, told):
    view = ConsoleView(LINK, HERE)
    view.press("6")
    now = status(model=model)
    assert told in screen(view, now, 80, 24)
    assert (told in screen(view, now)) == (model is not None)
    assert (f"; model: {told.partition(';')[0]}" in view.line(now)) == (model is not None)
    assert "no memory" not in view.line(now)  # a line every ten seconds does not repeat a reason


def test_a_terminal_of_80_columns_and_24_lines_shows_alarms_then_events_and_keys_switch_panels():
    """Twenty newer events do not push a red alarm off the screen, and nothing is wider or higher than it."""
    events = [{"received_utc_ns": n, "text": f"event {n} {'x' * 90}", "severity": "info"} for n in range(30)]
    now = status(housekeeping=housekeeping(disk_free_bytes=10**7, cpu_percent=95.0), events=events)
    view = ConsoleView(LINK, HERE)

    def plain(now: Status) -> list[str]:
        return Text.from_ansi(screen(view, now, 80, 24)).plain.splitlines()

    lines = plain(now)
    assert len(lines) <= 24 and max(map(len, lines)) <= 80
    assert "disk free bytes 10.0 MB" in lines[2] and "cpu percent 95.0 %" in lines[3]
    assert "event 29" in lines[4] and "event 28" in lines[5]
    assert "2 link" in lines[-1]
    for key, told in (
        ("3", "outbox frames"),
        ("2", "packets missing"),
        ("4", "none in flight"),
        ("1", "event 29"),
    ):
        view.press(key)
        drawn = plain(now)
        assert told in "\n".join(drawn) and len(drawn) <= 24
    view.press("n")
    assert "packets missing" in "\n".join(plain(now))


def test_a_refusal_that_came_several_times_is_shown_once_and_counted():
    refusal = {"received_utc_ns": 0, "text": "command refused: forged", "severity": "warning"}
    other = refusal | {"text": "bracket 7 lost"}
    now = status(events=[refusal, other, refusal, refusal])
    drawn = screen(ConsoleView(LINK, HERE), now)
    assert drawn.count("command refused: forged") == 1 and "forged (3 times)" in drawn
    assert [count for _, count in events_once(now.events)] == [3, 1]


def test_a_refusal_is_told_where_its_command_ends_and_not_once_more():
    """The spacecraft sends a report and an event about it; another command's refusal stays."""
    told: list[dict] = []
    log: Any = SimpleNamespace(
        _commands_ended=0, _telemetry=SimpleNamespace(events=told), _on_event=lambda event: None
    )
    _Ingest._note_end(log, 9, "retire", "refused", "not armed")
    (ended,) = told
    refused = {
        "received_utc_ns": 0,
        "severity": "warning",
        "event": "command_refused",
        "text": "command refused: x",
    }
    same, other = refused | {"problem": "counter 9: not armed"}, refused | {"problem": "counter 8: forged"}
    assert [event for event, _ in events_once([same, ended, other])] == [other, ended]
    assert ended["text"] == "command 9, retire, refused: not armed"
    console = Console(file=io.StringIO(), width=100)
    with statuses_shown(console, False, LINK, HERE) as (_, on_event):
        for event in (ended, same, other, other):
            on_event(event | {"text": event["text"] if event is ended else event["problem"]})
    assert isinstance(console.file, io.StringIO)
    lines = ["warning: command 9, retire, refused: not armed", "warning: counter 8: forged"]
    assert console.file.getvalue().splitlines() == lines


def test_keys_are_read_from_a_terminal_one_by_one_and_it_is_left_as_it_was(monkeypatch):
    master, slave = os.openpty()
    try:
        with open(slave, closefd=False) as stdin:
            monkeypatch.setattr("sys.stdin", stdin)
            before = termios.tcgetattr(slave)
            with keys_pressed() as keys:
                assert keys() == ""
                os.write(master, b"3")  # no line feed
                assert select.select([slave], [], [], 10)[0] and keys() == "3"
            assert termios.tcgetattr(slave) == before
        monkeypatch.setattr("sys.stdin", io.StringIO())
        with keys_pressed() as keys:
            assert keys() == ""
    finally:
        os.close(master)
        os.close(slave)


def test_whatever_fails_in_the_display_is_told_once_and_the_reception_does_not_see_it(caplog):
    shown_before: list[Exception] = []

    def show(error: Exception) -> None:
        shown_before.append(error)
        raise error

    for error in (OSError(5, "Input/output error"), KeyError("mode"), OSError(5, "Input/output error")):
        failures_told(show)(error)
    told = failures_told(show)
    for _ in range(3):
        told(RecursionError("too deep"))
    assert len(shown_before) == 6
    assert [record.message for record in caplog.records].count(
        "receiving goes on, but it cannot be shown: RecursionError('too deep')"
    ) == 1


def test_a_rounded_number_is_never_a_negative_zero():
    assert shown("uptime_s", -0.04) == "0.0 s" and shown("uptime_s", -0.06) == "-0.1 s"
