"""`ground list` and `ground compare-runs`: what lies in folders is shown as it is, whatever its state."""

import json
import shutil
from pathlib import Path

import pytest
from typer.testing import CliRunner

from ground import cli
from ground.run.live.status import LiveStatus
from ground.run.reconstruct import reconstruct
from obbgs_core.methods.presets import preset

GOLDEN = Path(__file__).parents[1] / "golden" / "session"
TINY = {"steps": 8, "start.count": 300, "growth.max_gaussians": 300}


@pytest.fixture(scope="module")
def passes(tmp_path_factory) -> Path:
    """A folder with a session of two real runs, one unfinished and one damaged run, and a damaged session."""
    folder = tmp_path_factory.mktemp("passes")
    session = folder / "2026" / "pass-12"
    shutil.copytree(GOLDEN, session)
    reconstruct(session, "first", "obbgs", TINY)
    reconstruct(session, "second", "3dgs", TINY | {"growth.interval": 10})
    (session / "runs" / ".third.part").mkdir()
    (session / "runs" / "fourth").mkdir()
    (session / "runs" / "fourth" / "metrics.json").write_text("{")
    (session / "runs" / "fourth" / "config.yaml").write_text("seed: [")
    shutil.copytree(session / "runs" / "first", session / "runs" / "fifth")
    (session / "runs" / "fifth" / "config.yaml").write_text("seed: 0")
    (folder / "damaged").mkdir()
    (folder / "damaged" / "session.json").write_text("not JSON")
    return folder


def called(*arguments: str, columns: int = 200) -> str:
    result = CliRunner().invoke(cli.app, arguments, env={"COLUMNS": str(columns)}, catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return result.output


def test_sessions_are_found_below_a_folder_and_damaged_ones_are_shown_with_the_reason(passes):
    session, damaged = json.loads(called("list", str(passes), "--json"))
    lines = (GOLDEN / "frames.jsonl").read_text().splitlines()
    assert session["folder"].endswith("2026/pass-12") and session["problem"] == ""
    assert session["frames"] == len(lines)
    assert session["brackets"] == len({json.loads(line)["bracket"] for line in lines})
    assert damaged["folder"].endswith("damaged") and "session.json" in damaged["problem"]


def test_sessions_behind_links_are_found_once_and_circles_of_links_end(passes, tmp_path):
    (tmp_path / "latest").symlink_to(passes / "2026" / "pass-12")
    (tmp_path / "again").symlink_to(passes / "2026")
    (tmp_path / "up").symlink_to(tmp_path)
    (tmp_path / "self").symlink_to("self")
    (session,) = json.loads(called("list", str(tmp_path), "--json"))
    assert session["folder"] == str(tmp_path / "again" / "pass-12") and session["problem"] == ""
    both = json.loads(called("list", str(tmp_path), str(passes), "--json"))
    assert len(both) == 2


def test_every_run_is_listed_finished_or_not(passes):
    session = json.loads(called("list", str(passes / "2026"), "--json"))[0]
    runs = {run["name"]: run for run in session["runs"]}
    assert set(runs) == {"first", "second", "third", "fourth", "fifth"}
    for name, method in (("first", "obbgs"), ("second", "3dgs")):
        metrics = json.loads((passes / "2026/pass-12/runs" / name / "metrics.json").read_text())
        assert (runs[name]["method"], runs[name]["gaussians"]) == (method, metrics["gaussians"])
        assert runs[name]["seconds"] == metrics["train_seconds"] and runs[name]["problem"] == ""
    assert runs["third"]["problem"].startswith("unfinished")
    assert "metrics.json" in runs["fourth"]["problem"]


def test_a_session_given_twice_is_listed_once_and_the_screen_shows_it(passes):
    text = called("list", str(passes), str(passes / "2026" / "pass-12"))
    assert text.count("48 in 16 brackets") == 1
    assert "unfinished" in text and "first" in text


def test_a_waiting_live_run_shows_its_state_in_the_table_and_its_whole_status_in_json(tmp_path):
    shutil.copytree(GOLDEN, tmp_path / "pass")
    why = "frames.jsonl cannot be read yet: " + "what was expected and what came, " * 6
    LiveStatus("waiting", why, 0, 0, 0, 0, 0, 0.0, None, None, None, None, 0.0, 0).write(
        tmp_path / "pass" / "runs" / "live"
    )
    table = called("list", str(tmp_path), columns=80)
    assert "waiting" in table and "expected" not in table
    ((run,),) = (session["runs"] for session in json.loads(called("list", str(tmp_path), "--json")))
    assert run["state"] == "waiting" and run["problem"].endswith(why) and "goes on with it" in run["problem"]


def test_comparing_runs_names_exactly_the_settings_that_differ(passes, tmp_path):
    runs = passes / "2026" / "pass-12" / "runs"
    found = json.loads(called("compare-runs", str(runs / "first"), str(runs / "second"), "--json"))
    assert found["settings"]["method.name"] == ["obbgs", "3dgs"]
    assert found["settings"]["method.growth.interval"] == [preset("obbgs").growth.interval, 10]
    assert "method.steps" not in found["settings"] and "seed" not in found["settings"]
    assert found["figures"]["train_steps"] == [8, 8]
    same = json.loads(called("compare-runs", str(runs / "first"), str(runs / "first"), "--json"))
    assert same["settings"] == {}
    assert "no difference" in called("compare-runs", str(runs / "first"), str(runs / "first"))


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (("list", "{missing}"), "not a folder"),
        (("compare-runs", "{runs}/first", "{runs}/third"), "third is not a finished run"),
        (("compare-runs", "{runs}/..", "{runs}/first"), "give the folder of one, such as SESSION/runs/run"),
        (("compare-runs", "{runs}/fourth", "{runs}/first"), "config.yaml cannot be read"),
        (
            ("report", "{runs}/fifth"),
            "config.yaml should hold the settings of a run",
        ),
    ],
)
def test_what_is_not_there_is_said(passes, tmp_path, arguments, told):
    names = {"missing": tmp_path / "nowhere", "runs": passes / "2026" / "pass-12" / "runs"}
    result = CliRunner().invoke(cli.app, [a.format(**names) for a in arguments])
    assert result.exit_code != 0 and told in str(result.exception)


def test_lost_is_what_never_comes_and_not_what_the_link_repaired(tmp_path):
    """Of 60 frames taken 5 were refused and 3 deleted on board, 1 was unusable, 48 have come: 3 are still to come."""
    session = tmp_path / "pass"
    shutil.copytree(GOLDEN, session)
    header = json.loads((session / "session.json").read_text())
    header["flight"] = {"frames_stored": 55, "frames_refused": 5, "frames_dropped": 3, "frames_failed": 2}
    header["losses"] = {"segments_resent": 12, "crc_errors": 7, "frames_rejected": 1, "duplicates": 0}
    (session / "session.json").write_text(json.dumps(header))
    (found,) = json.loads(called("list", str(tmp_path), "--json"))
    assert found["frames_lost"] == {
        "exposures failed": 2,
        "refused for lack of room": 5,
        "deleted undelivered": 3,
        "unusable": 1,
    }
    assert (found["frames_captured"], found["frames_missing"]) == (60, 3)
    assert found["link"] == {"segments_resent": 12, "crc_errors": 7}
    text = called("list", str(tmp_path), columns=500)
    assert (
        "48 of 60" in text
        and "repaired; segments resent: 12; CRC errors: 7" in text
        and "3 not received yet" in text
    )


def test_a_run_shows_its_quality_what_was_decided_of_poses_and_their_errors_but_no_digest(passes, tmp_path):
    runs = tmp_path / "pass" / "runs"
    shutil.copytree(passes / "2026" / "pass-12", tmp_path / "pass")
    shutil.rmtree(runs / "second")
    shutil.copytree(runs / "first", runs / "second")
    steps = round(0.3 * preset("obbgs").steps)
    errors = {"pose_error_px": 0.31, "pose_error_deg": 0.02, "poses": "refined (held-out loss fell by 3 %)"}
    metrics = json.loads((runs / "first" / "metrics.json").read_text()) | errors
    metrics |= {"schedule_steps": steps, "train_steps": round(1.24 * steps)}  # poses were refined on the way
    (runs / "second" / "metrics.json").write_text(json.dumps(metrics))
    config = (runs / "second" / "config.yaml").read_text()
    digest = next(line for line in config.splitlines() if "frames_jsonl_sha256" in line)
    (runs / "second" / "config.yaml").write_text(config.replace(digest, digest[:-8] + "01234567"))
    text = called("list", str(tmp_path), columns=500)
    assert "obbgs, draft" in text and "obbgs, 8 steps" in text
    assert "refined, off by" in text and "0.31 px" in text
    text = called("compare-runs", str(runs / "first"), str(runs / "second"), columns=500)
    assert "sha256" not in text and "not the same ones" in text and "held-out loss fell" in text
    found = json.loads(called("compare-runs", str(runs / "first"), str(runs / "second"), "--json"))
    assert found["figures"]["quality"] == ["8 steps", "draft"]
    assert found["figures"]["pose_error_px"] == [None, 0.31]
    assert found["figures"]["schedule_steps"] == [8, steps]
    assert list(found["settings"]) == ["session.frames"]


def test_only_what_came_over_a_link_can_be_lost(passes, tmp_path):
    assert "nothing" in called("list", str(passes / "2026"))
    shutil.copytree(GOLDEN, tmp_path / "taken")
    header = json.loads((tmp_path / "taken" / "session.json").read_text())
    header |= {"imported_from": "nerf: photographs"}
    (tmp_path / "taken" / "session.json").write_text(json.dumps(header))
    told = called("list", str(tmp_path))
    assert "nothing" not in told and "48 pictures" in told and "nerf: photographs" in told


def test_of_a_session_without_one_of_its_pictures_no_line_says_that_nothing_is_lost(tmp_path):
    folder = tmp_path / "A"
    shutil.copytree(GOLDEN, folder)
    assert "nothing" in called("list", str(folder), "--pictures")
    next((folder / "frames").rglob("*.png")).unlink()
    text = called("list", str(folder), "--pictures")
    assert "damaged" in text and "nothing" not in text
