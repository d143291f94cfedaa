"""Rows of benchmarks carry where they come from, and the page made of them shows every one."""

import json
import re
import statistics

import pytest

from tests.benchmarks import charts, rows


def test_a_row_says_commit_machine_load_and_command():
    row = json.loads(rows.shown({"method": "obbgs", "psnr_clean_db": 40.0}, "triage", as_json=True))
    assert row["bench"] == "triage" and row["psnr_clean_db"] == 40.0
    assert {"commit", "machine", "threads", "load", "utc", "command"} <= set(row)
    assert row["command"].startswith("python -m tests.benchmarks.triage")
    own = json.loads(rows.shown({"threads": 7}, "rasterizer", as_json=True))
    assert own["threads"] == 7


def test_the_page_has_a_line_a_method_and_target_with_the_mean_over_seeds(tmp_path):
    made = [
        {"method": method, "target": "TDRS", "seed": seed, "psnr_clean_db": psnr, "commit": "abc1234"}
        for method, values in {"ours": (40.0, 41.0, 42.5), "theirs": (30.0,)}.items()
        for seed, psnr in enumerate(values)
    ]
    (tmp_path / "some-targets.jsonl").write_text("".join(json.dumps(row) + "\n" for row in made))
    page = rows.page([tmp_path / "some-targets.jsonl"])
    assert "## some targets" in page and "abc1234" in page
    deviation = statistics.stdev([40.0, 41.0, 42.5])
    assert f"| ours | TDRS | 3 | 41.17 dB ± {deviation:.2f} |" in page
    assert "| theirs | TDRS | 1 | 30.00 dB |" in page


def test_budgets_stand_on_lines_of_their_own_where_rows_differ_in_them(tmp_path):
    made = [{"method": "ours", "target": "T", "largest": n, "psnr_clean_db": n / 100} for n in (1000, 2000)]
    whole = {"method": "ours", "target": "T", "psnr_clean_db": 30.0}
    (tmp_path / "size.jsonl").write_text("".join(json.dumps(row) + "\n" for row in [*made, whole]))
    page = rows.page([tmp_path / "size.jsonl"])
    assert "| method | target | at most Gaussians | seeds |" in page
    assert "| ours | T | 2000 | 1 | 20.00 dB |" in page and "| ours | T |  | 1 | 30.00 dB |" in page


def test_the_committed_page_is_made_of_the_committed_rows():
    page = rows.FOLDER / "RESULTS.md"
    assert page.read_text() == rows.page(sorted(rows.FOLDER.glob("*.jsonl")))


@pytest.mark.parametrize("name", charts.CHARTS)
def test_the_charts_are_drawn_from_the_committed_rows(name):
    figure, drawn = charts.CHARTS[name]()
    assert drawn and all(axis.lines for axis in figure.axes)
    path = rows.ROOT / "docs" / f"{name}.png"
    assert charts.drawn_from(path) == charts.digest(drawn), "run: python -m tests.benchmarks.charts"


def test_a_training_that_ends_below_an_image_without_training_is_listed_with_the_reason(tmp_path):
    values = {"black": 24.0, "mean": 23.0, "untrained": 25.0, "ours": 40.0, "theirs": 23.5}
    made = [
        {"method": m, "target": "T", "condition": "as taken", "psnr_clean_db": v} for m, v in values.items()
    ]
    made[-1]["why_below"] = "it fits the noise"
    (tmp_path / "some.jsonl").write_text("".join(json.dumps(row) + "\n" for row in made))
    page = rows.page([tmp_path / "some.jsonl"])
    assert "- theirs, T, as taken, seed 0: 23.50 dB, below untrained, black; it fits the noise" in page
    assert "- ours" not in page


@pytest.mark.parametrize("name", ["opponents-200x200", "opponents-400x400", "frozen-targets-200x200"])
def test_every_opponent_beats_images_without_training_or_its_row_says_why_not(name):
    made = [json.loads(line) for line in (rows.FOLDER / f"{name}.jsonl").read_text().splitlines()]
    usual = [row for row in made if row.get("condition", "as taken") == "as taken"]
    silent = [(r["method"], r["target"]) for r, _ in rows.ending_below(usual) if "why_below" not in r]
    assert silent == []


def test_commands_name_no_path_of_a_machine():
    for file in rows.FOLDER.glob("*.jsonl"):
        made = [json.loads(line) for line in file.read_text().splitlines()]
        assert [row["command"] for row in made if re.search(r"(^|[ =])/", row["command"])] == [], file.name


def test_no_row_stands_twice():
    for file in rows.FOLDER.glob("*.jsonl"):
        lines = file.read_text().splitlines()
        assert len(set(lines)) == len(lines), f"{file.name} has a row twice"


def test_the_page_says_where_each_method_breaks_and_why(tmp_path):
    def row(method: str, condition: str, psnr_db: float, **more) -> dict:
        figures = {"psnr_clean_db": psnr_db, "f_02_surface": 90.0} | more
        name = {
            "method": method,
            "condition": condition,
            "target": "T",
            "seed": 0,
            "size": 64,
            "steps_share": 1.0,
        }
        return name | {"digest": f"{method} {condition}"} | figures

    conditions = {"as taken": {}, "noise x4": {"noise": 4}, "noise x8": {"noise": 8}}
    made = []
    for (condition, changes), ours, theirs in zip(
        conditions.items(), (40, 35, 30), (38, 33, 22), strict=True
    ):
        changed = {"changes": changes} if changes else {}
        made += [
            row("black", condition, 24, **changed),
            row("obbgs", condition, ours, **changed),
            row("3dgs", condition, theirs, **changed),
        ]
    made[7]["f_02_surface"] = 51.0  # enough
    (tmp_path / "stability.jsonl").write_text("".join(json.dumps(r) + "\n" for r in made))
    page = rows.page([tmp_path / "stability.jsonl"])
    assert "| holds at 8 | **8** (T: 22.00 dB, and 24.00 dB without any model) |" in page
    made[7]["f_02_surface"] = 49.0
    (tmp_path / "stability.jsonl").write_text("".join(json.dumps(r) + "\n" for r in made))
    assert "| **8** (T: F within .02 is 49.0 %) |" in rows.page([tmp_path / "stability.jsonl"])
