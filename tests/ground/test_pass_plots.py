"""Telemetry beside the model: what is known at a time of the pass, and its replay, in the browser and without one."""

import json

import numpy as np
import pytest

from ground.show.page import page, section, two_tables
from ground.show.telemetry_plots import LIMIT_COLOURS, housekeeping_series, telemetry_figures
from ground.show.viewer.door import opened
from ground.show.viewer.pass_plots import PassPlots, drawn_lines, pass_events, plotted, up_to
from tests.browser import as_url, chromium
from tests.browser import opened as page_of
from tests.ground.test_telemetry_plots import packet, written


@pytest.fixture
def session(tmp_path):
    """A pass of 100 s in which the disk fills at 60 s and a command is refused at 70 s."""
    lines = [
        packet(t, outbox_frames=t, disk_free_bytes=10**7 if t >= 60 else 5 * 10**9) for t in range(0, 101, 10)
    ]
    written(tmp_path, *lines)
    events = [
        {"utc_ns": t * 10**9, "severity": s, "text": f"<{s}> at {t}"}
        for t, s in ((20, "info"), (65, "error"))
    ]
    (tmp_path / "events.jsonl").write_text("".join(f"{json.dumps(event)}\n" for event in events) + '{"half')
    command = {
        "ended_utc_ns": 70 * 10**9,
        "counter": 1,
        "given": "near 9",
        "stage": "refused",
        "text": "forged",
    }
    (tmp_path / "commands.jsonl").write_text(json.dumps(command) + "\n")
    return tmp_path


@pytest.fixture
def server():
    made = opened("127.0.0.1", 0)
    yield made
    made.stop()


def test_events_and_commands_are_one_list_in_the_order_of_time(session):
    found = pass_events(session, 10 * 10**9)
    assert [(event.seconds, event.severity) for event in found] == [
        (10, "info"),
        (55, "error"),
        (60, "warning"),
    ]
    assert found[-1].text == "command near 9 refused: forged"
    refused = {
        "utc_ns": 70 * 10**9,
        "severity": "warning",
        "event": "command_refused",
        "text": "command refused",
    }
    for problem in ("counter 1: forged", "counter 2: forged"):  # the first is told by the end of the command
        with open(session / "events.jsonl", "a") as file:
            file.write("\n" + json.dumps(refused | {"problem": problem}) + "\n")
    assert len(pass_events(session, 10 * 10**9)) == len(found) + 1


def test_a_plot_shows_what_was_known_and_the_limits_that_are_near(session):
    whole = next(s for s in housekeeping_series(session) if s.item.name == "disk_free_bytes")
    seconds, values, *limits = plotted(up_to(whole, 35), whole)
    np.testing.assert_array_equal(seconds, [0, 10, 10, 20, 20, 30, 30])
    assert (values == 5000).all()  # MB
    assert [set(limit) for limit in limits] == [{1000.0}, {100.0}]
    assert len(drawn_lines(whole)) == 4


def test_a_plot_is_drawn_in_steps_as_the_report_draws_it(session):
    """Seen as a line, what plotly's shape `hv` stands for: a value holds until the next one comes."""
    whole = next(s for s in housekeeping_series(session) if s.item.name == "outbox_frames")
    (figure,) = telemetry_figures([whole])
    assert figure.data[0].line.shape == "hv"
    x, y = figure.data[0].x, figure.data[0].y
    seconds, values, *_ = plotted(whole, whole)
    corners = list(zip(seconds, values, strict=True))
    steps = [corner for i in range(len(x) - 1) for corner in ((x[i], y[i]), (x[i + 1], y[i]))]
    assert corners == [*steps, (x[-1], y[-1])] and len(set(y)) > 1


def test_a_replay_goes_at_its_speed_shows_no_future_and_tells_the_time(session, server):
    times: list[int] = []
    plots = PassPlots(server, session, times.append)
    plots.tick(0.25)
    controls = plots.controls
    assert controls is not None and len(controls.plots["outbox_frames"].data[0]) == 21
    assert "disk free 10 MB" in controls.told.content and "&lt;error&gt; at 65" in controls.told.content
    controls.replay.value, controls.speed.value = True, "100x"
    plots.tick(0.25)
    assert times == [25 * 10**9] and len(controls.plots["outbox_frames"].data[0]) == 5
    assert "at 20" in controls.told.content and "at 65" not in controls.told.content
    assert "disk free" not in controls.told.content
    for _ in range(8):
        plots.tick(0.25)
    assert times[-1] == 100 * 10**9 and controls.place.value == 100
    assert LIMIT_COLOURS["red"] in controls.told.content and "near 9 refused" in controls.told.content
    with open(session / "telemetry.jsonl", "a") as file:
        file.write("\n" + json.dumps(packet(110)) + "\n")
    controls.replay.value = False
    plots.tick(0.25)  # live again: what has come is drawn
    assert len(controls.plots["outbox_frames"].data[0]) == 23
    with open(session / "telemetry.jsonl", "a") as file:
        file.write(json.dumps(packet(120, outbox_frames=900)) + "\n")
    lines = len(controls.plots["outbox_frames"].series)
    plots.tick(0.25)  # the limit of 1,000 is near now
    plot = controls.plots["outbox_frames"]
    assert len(plot.series) == len(plot.data) == lines + 1


def test_a_replay_that_is_ended_while_it_goes_on_leaves_the_whole_pass_and_begins_anew(session, server):
    """The box is unticked by another thread than the one that draws, here between the two parts of one step."""
    plots = PassPlots(server, session, lambda _: untick())

    def untick():
        if plots.controls is not None:
            plots.controls.replay.value = False

    plots.tick(0.25)
    controls = plots.controls
    assert controls is not None
    controls.replay.value = True
    plots.tick(0.25)
    plots.tick(0.25)
    assert len(controls.plots["outbox_frames"].data[0]) == 21 and "at 65" in controls.told.content
    controls.place.value, controls.replay.value = controls.place.max, True
    plots.tick(0.25)
    assert controls.place.value == 2.5


def test_a_replay_draws_once_in_a_second_and_only_the_plots_that_change(session, server):
    plots = PassPlots(server, session)
    plots.tick(0.25)
    controls = plots.controls
    assert controls is not None
    controls.replay.value, controls.speed.value = True, "10x"
    plot, points = controls.plots["outbox_frames"], []
    for _ in range(9):
        plots.tick(0.25)
        points.append(len(plot.data[0]))
    assert points == [1, 1, 1, 1, 3, 3, 3, 3, 5]  # of values that come every 10 s
    controls.speed.value = "1x"
    before = plot.data, plot.scales
    for _ in range(8):
        plots.tick(0.25)
    assert plot.data is before[0] and plot.scales is before[1]
    controls.place.value = 55.0  # who moves the slider sees at once what was known there
    plots.tick(0.25)
    assert len(plot.data[0]) == 11


def test_the_slider_of_a_replay_shows_tenths_of_seconds_and_loses_no_time(tmp_path, server):
    """Housekeeping of 17.12796 s; at 1x a quarter of a second passes between two looks, which is no whole tenth."""
    last = packet(0) | {"utc_ns": 17_127_960_000}
    written(tmp_path, packet(0), packet(9), last)
    event = {"utc_ns": 18 * 10**9, "severity": "info", "text": "flight software stopped"}
    (tmp_path / "events.jsonl").write_text(json.dumps(event) + "\n")
    times: list[int] = []
    plots = PassPlots(server, tmp_path, times.append)
    plots.tick(0.25)
    controls = plots.controls
    assert controls is not None and controls.place.max == 18
    controls.replay.value, controls.speed.value = True, "1x"
    for _ in range(6):
        plots.tick(0.25)
        assert controls.place.value == round(controls.place.value, 1)
    assert times[-1] == 1_500_000_000
    controls.place.value = 12.0  # moved by someone
    plots.tick(0.25)
    assert times[-1] == 12_250_000_000
    controls.speed.value = "100x"
    plots.tick(0.25)
    plots.tick(0.25)  # on to the last event, which came after the last housekeeping
    assert times[-1] == 18_000_000_000 and "stopped" in controls.told.content
    assert controls.place.value == controls.place.max


def test_a_replay_of_a_simulated_pass_moves_the_timeline_by_the_frames_that_were_announced(tmp_path, server):
    """Frames have the simulated time, the housekeeping has the wall clock; the ground's clock is 5 s ahead of it."""
    lines = [packet(t) | {"received_utc_ns": (t + 5) * 10**9} for t in range(0, 101, 10)]
    taken = [(9000 + 30 * i) * 10**9 for i in range(4)]
    headers = [
        {"packet": "frame", "received_utc_ns": (20 * i + 15) * 10**9, "mid_exposure_utc_ns": utc_ns}
        for i, utc_ns in enumerate(taken)
    ]  # at 10, 30, 50 and 70 s of the housekeeping's clock
    written(tmp_path, *lines, *headers)
    times: list[int] = []
    plots = PassPlots(server, tmp_path, times.append, lambda: taken)
    plots.tick(0.25)
    controls = plots.controls
    assert controls is not None and "another clock" not in controls.told.content
    controls.replay.value, controls.speed.value = True, "10x"
    for _ in range(16):
        plots.tick(0.5)
    assert list(dict.fromkeys(times)) == taken and times.count(taken[0]) == 4
    assert "the one that was announced last" in controls.told.content
    written(tmp_path, *lines)  # nothing links the clocks
    times.clear()
    plots.tick(0.5)
    assert times == [] and "nothing links the two" in controls.told.content


def test_the_page_draws_a_plot_for_each_item_and_a_session_without_telemetry_has_no_panel(
    session, tmp_path, server
):
    empty = PassPlots(server, tmp_path / "nothing")
    empty.tick(0.25)
    assert empty.controls is None
    plots = PassPlots(server, session)
    plots.tick(0.25)
    assert plots.controls is not None
    with (
        chromium() as browser,
        page_of(browser, f"http://127.0.0.1:{server.get_port()}", 900, 800) as page,
    ):
        page.get_by_text("Replay the pass").wait_for()
        page.wait_for_function(
            f"document.querySelectorAll('.uplot canvas').length == {len(plots.controls.plots)}"
        )
        page.get_by_text("command near 9 refused: forged").wait_for()
        texts = page.locator(".uplot").first.inner_text()  # its title; the axes are drawn on the canvas
        assert texts.startswith("frames stored")


def test_a_table_with_a_long_value_stays_within_its_half_of_the_page(tmp_path):
    elements = "da -0.04, dlambda -2.40, dex -0.34, dey -0.27, dix 0.14, diy 0.27"
    tables = two_tables([("brackets", "24"), ("navigation: orbit error, m", elements)])
    (tmp_path / "page.html").write_text(page("Wide", "", [section("World", "", tables)], plots=False))
    with chromium() as browser, page_of(browser, as_url(tmp_path / "page.html"), 1440, 700) as shown:
        cells, edge = shown.evaluate(
            "() => ['td', 'section'].map(name => Math.max("
            "...[...document.querySelectorAll(name)].map(element => element.getBoundingClientRect().right)))"
        )
        assert cells < edge
