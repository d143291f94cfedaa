"""Housekeeping over time: what is read of a session, and which values are coloured."""

import json
from pathlib import Path

import numpy as np
import pytest

from flightsw.icd.telemetry import DICTIONARY
from ground.show.telemetry_plots import (
    LIMIT_COLOURS,
    SHOWN,
    broken_limits,
    housekeeping_series,
    near_limits,
    telemetry_figures,
)
from ground.show.viewer.pass_plots import scales_of


def packet(second: int, **changes) -> dict:
    values = {item.name: 0 for item in DICTIONARY.telemetry["housekeeping"].items}
    values |= {"utc_ns": second * 10**9, "disk_free_bytes": 5 * 10**9, "packet": "housekeeping"}
    return values | changes


def written(folder: Path, *lines: object) -> Path:
    text = "".join(f"{json.dumps(line)}\n" for line in lines)
    (folder / "telemetry.jsonl").write_text(text + '{"packet": "housekeep')  # cut off by a loss of power
    return folder


def test_series_are_in_order_of_time_and_lines_that_cannot_be_read_are_left_out(tmp_path):
    lines = [
        packet(30, cpu_percent=90.0),
        packet(10, cpu_percent=20.0),
        packet(20, cpu_percent="high"),
        [],
        7,
    ]
    lines += [{"packet": "frame", "utc_ns": 5}, packet(40, cpu_percent=10)]
    series = {each.item.name: each for each in housekeeping_series(written(tmp_path, *lines))}
    assert set(series) == set(SHOWN)
    np.testing.assert_array_equal(series["cpu_percent"].seconds, [0, 20, 30])
    np.testing.assert_array_equal(series["cpu_percent"].values, [20, 90, 10])
    assert series["cpu_percent"].limits == ["green", "yellow", "green"]


def test_limits_are_those_of_the_dictionary_and_stand_in_the_figure(tmp_path):
    lines = [packet(0), packet(1, frames_refused=2, rss_bytes=4e8), packet(2, disk_free_bytes=5e7)]
    series = housekeeping_series(written(tmp_path, *lines))
    assert broken_limits(series) == [
        ("frames_refused", "red"),
        ("disk_free_bytes", "red"),
        ("rss_bytes", "yellow"),
    ]
    figures = dict(zip(SHOWN, telemetry_figures(series), strict=True))
    colours = {name: figure.data[0].marker.color for name, figure in figures.items()}
    assert colours["frames_refused"] == tuple(LIMIT_COLOURS[limit] for limit in ("green", "red", "green"))
    heights = {shape.y0: shape.line.color for shape in figures["rss_bytes"].layout.shapes}
    assert heights[300.0] == LIMIT_COLOURS["yellow"]  # of the memory, in MB
    assert 0.0 not in heights, "nobody has less than no memory"
    assert [shape.y0 for shape in figures["frames_refused"].layout.shapes] == [0.0, 0.0], (
        "none may be refused"
    )


def test_counts_that_stay_at_zero_have_no_axis_below_it(tmp_path):
    series = housekeeping_series(written(tmp_path, packet(0), packet(1)))
    axes = [figure.layout.yaxis.range for figure in telemetry_figures(series)]
    assert any(axes) and all(axis[0] == 0 for axis in axes if axis)
    for each in series:  # in the viewer, whose own axis would go up to 100
        low, high = scales_of(each)["y"]["range"]
        bounds = [bound for bound, _ in near_limits(each)]
        assert low < 0 and high / 1.15 in map(pytest.approx, (1.0, 1.1 * max(bounds, default=0.0), 10_000.0))
    changing = housekeeping_series(written(tmp_path, packet(0), packet(1, delivered=3)))
    assert [each.item.name for each in changing if "y" not in scales_of(each)] == ["delivered"]


def test_a_session_without_telemetry_has_no_series(tmp_path):
    assert housekeeping_series(tmp_path) == []
    assert housekeeping_series(written(tmp_path)) == []
