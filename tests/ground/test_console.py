"""Telemetry files, and the operator's screen: limits show in colour, and no text from the link moves the cursor."""

import io
import json

import pytest
from rich.console import Console

from flightsw.icd.command import Report
from flightsw.icd.frame import HEADER, encode_frame
from flightsw.icd.packet import APID_EVENTS, APID_FRAME_HEADERS, APID_HOUSEKEEPING, APID_REPORTS
from flightsw.icd.telemetry import DICTIONARY
from flightsw.icd.transfer import Incoming
from ground.console import PLAIN_S, ConsoleView, link_state, shown
from ground.ingest import ListenSummary, Status
from ground.telemetry import TelemetryLog

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


def screen(view: ConsoleView, now: Status) -> str:
    """Return the screen with its colours as a terminal gets it."""
    console = Console(file=io.StringIO(), force_terminal=True, width=160, height=60, color_system="standard")
    console.print(view.draw(now))
    assert isinstance(console.file, io.StringIO)
    return console.file.getvalue()


def test_the_screen_shows_link_spacecraft_files_and_events():
    view = ConsoleView()
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
    for text in ("10.0 / 0.0 kB/s", "00000012.obf", "5,000 of 25,000 B", "2 s left", "(not named yet)"):
        assert text in drawn
    for text in ("bracket 7 lost", "command bracket 4: accepted", "0.05, 0.1 ms", "abcdef01", "5,000.0 MB"):
        assert text in drawn


@pytest.mark.parametrize(
    ("changes", "text", "colour"),
    [
        ({}, "5,000.0 MB", "32"),
        ({"disk_free_bytes": 5 * 10**8}, "500.0 MB", "33"),
        ({"disk_free_bytes": 10**7}, "10.0 MB", "1;31"),
        ({"mode": "safe"}, "safe", "1;31"),
        ({"cpu_percent": 95.0}, "95.0 %", "33"),
    ],
)
def test_limits_are_shown_in_colour(changes, text, colour):
    assert f"\x1b[{colour}m{text}" in screen(ConsoleView(), status(housekeeping=housekeeping(**changes)))


def test_the_links_state_is_told_by_port_and_silence():
    assert link_state(status()) == ("up", "green")
    assert link_state(status(quiet_s=8.0)) == ("silent for 8 s", "yellow")
    assert link_state(status(summary=ListenSummary())) == ("silent for 0 s", "yellow")
    assert link_state(status(connected=False))[0] == "port closed"


def test_names_and_texts_from_the_link_cannot_move_the_cursor_or_style_the_screen():
    hostile = "\x1b[2J[bold red]\r\n"
    drawn = screen(
        ConsoleView(),
        status(
            incoming=[Incoming(hostile, 0, 10)],
            events=[{"received_utc_ns": 1 << 80, "text": hostile, "severity": "info"}],
        ),
    )
    assert "\x1b[2J" not in drawn and "?[2J[bold red]??" in drawn


def test_before_any_telemetry_there_is_a_screen_and_a_line_all_the_same():
    empty = status(housekeeping={}, summary=ListenSummary())
    assert "no housekeeping yet" in screen(ConsoleView(), empty)
    assert "outbox ?" in ConsoleView().line(empty)
    assert "outbox 0" in ConsoleView().line(status())


@pytest.mark.parametrize("every_s", [0.25, 1.0, 5.0, PLAIN_S])
def test_the_rate_is_told_however_rarely_a_line_is_printed(every_s):
    """`ground listen` without a terminal prints a line every ten seconds, longer than the rate's own window."""
    view, texts = ConsoleView(), []
    for number in range(round(30.0 / every_s)):
        now_s = number * every_s
        summary = ListenSummary(bytes_received=round(40_000 * now_s), bytes_sent=round(300 * now_s))
        texts.append(view.line(status(now_s=now_s, summary=summary)))
    assert "kB/s" not in texts[0]  # not known yet
    assert all("40.0 kB/s down, 0.3 up" in text for text in texts[1:])


def test_the_rate_is_of_the_last_seconds_only():
    view = ConsoleView()
    for now_s, received in ((0.0, 0), (10.0, 10**6), (12.0, 10**6), (16.0, 10**6 + 60_000)):
        rates = view.rates(status(now_s=now_s, summary=ListenSummary(bytes_received=received)))
    assert rates == (10_000.0, 0.0)  # since 10 s: the newest status that is at least 5 s old


def test_frames_that_flight_took_are_counted_or_said_to_be_unknown():
    for taken, text in ((None, "24 received / unknown captured"), (48, "24 received / 48 captured")):
        now = status(summary=ListenSummary(frames_in_session=24, frames_captured=taken))
        assert text in screen(ConsoleView(), now) and text in ConsoleView().line(now)


def test_a_model_and_the_lack_of_one_are_shown():
    assert (shown("model", b"\1\2\3\4"), shown("model", bytes(4))) == ("01020304", "none")


def read(folder, name) -> list[dict]:
    return [json.loads(line) for line in (folder / name).read_text().splitlines()]


def test_telemetry_is_kept_with_the_session_as_it_came(tmp_path, make_frame):
    events, reports = [], []
    log = TelemetryLog(tmp_path, events.append, reports.append, lambda: 77)
    log.add(APID_HOUSEKEEPING, DICTIONARY.telemetry["housekeeping"].pack(**housekeeping(outbox_frames=9)))
    container = encode_frame(make_frame(12))
    log.add(APID_FRAME_HEADERS, container[: HEADER.size])
    log.add(APID_EVENTS, DICTIONARY.events["warning"].pack(utc_ns=5, problem="cold"))
    log.add(APID_EVENTS, DICTIONARY.events["model_in_use"].pack(utc_ns=6, sha256=bytes(range(32))))
    log.add(APID_REPORTS, Report(8, 3, "completed", "alive").pack())
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
