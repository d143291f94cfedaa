"""`flightsw mission new` and `flightsw service`: what they write is read, plausible and verified by its readers."""

import re
import shutil
import subprocess
import sys
from datetime import datetime
from pathlib import Path

import pytest

from flightsw.capture.planning import field_of_view, pass_plan
from flightsw.icd.config import ConfigError
from flightsw.icd.mission import load_mission
from flightsw.new_mission import EXAMPLE, write_mission
from flightsw.selftest.planned_pass import check_orbit, check_view
from flightsw.service import unit
from tests.commands import call

ROOT = Path(__file__).parents[2]
MISSION = load_mission(ROOT / "mission.yaml")
START = "2026-07-21T10:52:30Z"
LINK = "serial:///dev/ttyS1?baud=921600"


@pytest.fixture
def elements(tmp_path) -> tuple[str, str]:
    """Files with two-line elements, one of them with a name before."""
    target, chaser = tmp_path / "target.tle", tmp_path / "chaser.tle"
    target.write_text("TERRASAR-X\n" + "\n".join(MISSION.orbit.target_tle) + "\n")
    chaser.write_text("\r\n".join(MISSION.orbit.chaser_tle))
    return str(target), str(chaser)


def test_the_example_is_the_project_s_mission_file():
    assert EXAMPLE.read_bytes() == (ROOT / "mission.yaml").read_bytes()


def test_a_new_mission_has_what_was_given_and_passes_its_checks(tmp_path, elements):
    out = tmp_path / "new.yaml"
    options = ["--target-tle", elements[0], "--chaser-tle", elements[1], "--target-size", "2.5"]
    options += ["--picture", "1600x1200x3", "--focal-length", "200", "--pixel-pitch", "4", "--start", START]
    done = call("flightsw", "mission", "new", "--out", str(out), *options)
    assert done.returncode == 0, done.stderr
    mission = load_mission(out)
    assert mission.orbit == MISSION.orbit and mission.bracket.target_extent_m == 2.5
    camera = mission.camera
    assert (camera.width, camera.height, camera.channels) == (1600, 1200, 3)
    assert (camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px) == (50_000, 50_000, 800, 600)
    # all but these lines and their remarks are the example's
    theirs = {re.sub(r"[^a-z_].*", "", line.lstrip(" #")) for line in EXAMPLE.read_text().splitlines()}
    ours = {re.sub(r"[^a-z_].*", "", line.lstrip(" #")) for line in out.read_text().splitlines()}
    assert ours == theirs and out.read_text().count("#") > 40
    assert {finding.state for finding in check_orbit(mission)} <= {"ok", "warning"}  # the pass is over by now
    assert [finding.state for finding in check_view(mission)] == ["ok"]
    planned = call("flightsw", "plan", "--mission", str(out))
    assert (
        planned.returncode == 0
        and "1600 x 1200 px see 1.83 x 1.38 degrees; a target of 2.5 m" in planned.stdout
    )
    again = call("flightsw", "mission", "new", "--out", str(out), *options)
    assert again.returncode == 2 and "exists already" in again.stderr


def test_the_same_elements_for_target_and_chaser_are_told_in_a_line(tmp_path, elements, caplog):
    target, chaser = map(Path, elements)
    write_mission(tmp_path / "two.yaml", target, chaser, 6.0, "1024x1024", 100.0, 5.5)
    assert not caplog.records
    out = tmp_path / "one.yaml"
    write_mission(out, target, target, 6.0, "1024x1024", 100.0, 5.5)
    (line,) = caplog.messages
    assert out.exists() and "have the same elements" in line and f"--mission {out}" in line


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"picture": "1024"}, "--picture: expected width and height"),
        ({"target_size_m": 0.0}, "--target-size: expected 0.01 to 1000 m"),
        ({"focal_length_mm": float("nan")}, "--focal-length: expected 1 to 100000 mm"),
        ({"picture": "9000x9000"}, "--picture: width: expected 1 to 8192, got 9000"),
        ({"start_utc": "soon"}, "--start: expected a time such as"),
        ({"focal_length_mm": 1e9}, "--focal-length: expected 1 to 100000 mm, got 1e+09"),
        ({"chaser_tle": Path("torn.tle")}, "torn.tle[0]: checksum is 0, but the line adds up to"),
        ({"target_tle": Path("nowhere")}, "nowhere: cannot read the two-line elements: No such file"),
    ],
)
def test_a_wrong_figure_is_named_and_nothing_is_written(tmp_path, elements, change, message, monkeypatch):
    given = {
        "target_tle": Path(elements[0]),
        "chaser_tle": Path(elements[1]),
        "target_size_m": 6.0,
        "picture": "1024x1024",
        "focal_length_mm": 100.0,
        "pixel_pitch_um": 5.5,
        "start_utc": START,
    }
    torn = "\n".join(f"{line[:68]}{'0' if line[68] != '0' else '1'}" for line in MISSION.orbit.chaser_tle)
    (tmp_path / "torn.tle").write_text(torn)
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ConfigError, match=re.escape(message)):
        write_mission(tmp_path / "new.yaml", **(given | change))
    assert not (tmp_path / "new.yaml").exists()
    with pytest.raises(
        ConfigError, match=r"cannot be written: .*; give --out a file in a folder that is there"
    ):
        write_mission(tmp_path / "nowhere" / "new.yaml", **given)


@pytest.mark.parametrize(
    ("old", "new", "word"),
    [
        ("cx_px: 128.0", "cx_px: 300", "camera.cx_px is 300 and the picture ends at 256"),
        ("fx_px: 6600.0", "fx_px: 50", "the camera sees 137 degrees"),
        ("# target_extent_m: 6.0 ", "target_extent_m: 0.01", "fewer than 8 px"),
        ("# target_extent_m: 6.0 ", "target_extent_m: 60", "does not fit into the picture"),
    ],
)
def test_implausible_figures_are_told_by_plan_and_selftest(tmp_path, old, new, word):
    path = tmp_path / "odd.yaml"
    path.write_text((ROOT / "mission.yaml").read_text().replace(old, new))
    planned = call("flightsw", "plan", "--mission", str(path))
    assert planned.returncode == 0 and "warning: " in planned.stdout and word in planned.stdout
    found = check_view(load_mission(path))
    assert {finding.state for finding in found} == {"warning"}
    assert word in " ".join(finding.found for finding in found)


def test_plan_and_selftest_state_the_same_ranges():
    """The target comes nearest in the middle of the pass, where neither its first nor its last bracket sees it."""
    planned = pass_plan(MISSION)
    (found,) = check_view(MISSION)
    assert (
        found.found == planned.view and f"at {min(b.range_m for b in planned.brackets):.0f} m" in found.found
    )
    assert planned.problems == []


def test_a_plan_says_that_its_poses_will_be_stale(tmp_path):
    path = tmp_path / "late.yaml"
    path.write_text(
        (ROOT / "mission.yaml").read_text().replace("2026-07-21T10:52:30Z", "2026-09-21T10:52:30Z")
    )
    (problem,) = [text for text in pass_plan(load_mission(path)).problems if "elements" in text]
    assert problem.startswith("the elements are more than 7 days from 40 of 40 brackets")


def test_a_plan_says_that_states_will_come_from_elsewhere_and_a_constant_range_once(tmp_path):
    path = tmp_path / "filtered.yaml"
    text = (ROOT / "mission.yaml").read_text().replace("  count: 40 ", "  count: 1 ")
    path.write_text(text + "navigation: {source: 'file:///states.jsonl'}\n")
    planned = call("flightsw", "plan", "--mission", str(path)).stdout
    assert (
        "orbits: by the two-line elements; during the pass states come from file:///states.jsonl" in planned
    )
    assert re.search(r"a target of 6 m is \d+ px at \d+ m, \d+% of the picture's smaller side", planned)
    assert "orbits:" not in call("flightsw", "plan", "--mission", str(ROOT / "mission.yaml")).stdout


@pytest.mark.parametrize(("ranges_m", "told"), [([60.4, 60.6], 1), ([60.4, 61.2], 2), ([60.0, 400.0], 2)])
def test_ranges_that_show_the_target_equally_large_are_told_as_one(ranges_m, told):
    """By their values: 60.4 and 60.6 m are written differently, and are the same."""
    view, _ = field_of_view(MISSION, ranges_m)
    assert view.count(" px at ") == told and view.count("%") == told


def test_a_line_of_sight_far_from_the_picture_is_refused(tmp_path):
    path = tmp_path / "odd.yaml"
    path.write_text((ROOT / "mission.yaml").read_text().replace("cx_px: 128.0", "cx_px: 100000"))
    with pytest.raises(ConfigError, match=r"mission\.camera\.cx_px: expected .* -8192 to 8192, got 100000"):
        load_mission(path)


@pytest.fixture
def installed(tmp_path, monkeypatch) -> Path:
    """An environment in a place that a service may read."""
    program = Path("/opt/obbgs-of-a-test/bin/flightsw")
    monkeypatch.setattr(sys, "prefix", str(program.parents[1]))
    exists = Path.is_file
    monkeypatch.setattr(Path, "is_file", lambda path: path == program or exists(path))
    return program


def test_the_unit_names_its_user_and_its_environment(installed, tmp_path):
    text = unit(
        "gige://10.0.0.1",
        "slcan:///dev/serial/by id/100%?bitrate=500000",
        Path("/etc/m.yaml"),
        None,
        "imager",
    )
    lines = text.splitlines()
    (start,) = [line for line in lines if line.startswith("ExecStart=")]
    assert lines.count("User=imager") == 1 and not any(line == "User=obbgs" for line in lines)
    assert start == (
        f"ExecStart={installed} serve --mission /etc/m.yaml --key /var/lib/obbgs/mission.key "
        "--store /var/lib/obbgs/store "
        '--camera gige://10.0.0.1 --link "slcan:///dev/serial/by id/100%%?bitrate=500000"'
    )
    if shutil.which("systemd-analyze") is not None:
        path = tmp_path / "obbgs-flight.service"
        path.write_text(text.replace(str(installed), "/bin/true").replace("User=imager", "User=root"))
        done = subprocess.run(
            ["systemd-analyze", "verify", "--man=no", str(path)], capture_output=True, text=True
        )
        assert not [line for line in done.stderr.splitlines() if path.name in line], done.stderr


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"user": "two words"}, "--user: expected the name of a user"),
        ({"mission": Path("mission.yaml")}, "--mission: expected an absolute path"),
        ({"key": Path("/home/me/mission.key")}, "--key: a service cannot read /home/me/mission.key"),
        ({"link_url": "carrier://pigeon"}, "carrier://pigeon"),
        ({"link_url": ""}, "the link's URL is empty: expected serial://"),
        ({"camera_url": "v4l2://0"}, "no camera driver for 'v4l2://0'"),
        ({"camera_url": "gige"}, "no camera driver for 'gige'"),
    ],
)
def test_a_unit_that_could_not_start_is_not_made(installed, change, message):
    given = {
        "camera_url": "gige://1",
        "link_url": LINK,
        "mission": Path("/m.yaml"),
        "key": None,
        "user": "obbgs",
    }
    with pytest.raises(ValueError, match=re.escape(message)):
        unit(**(given | change))


def test_the_first_trigger_is_an_hour_from_now_where_none_is_given(tmp_path, elements):
    write_mission(tmp_path / "new.yaml", Path(elements[0]), Path(elements[1]), 6.0, "64x64", 10.0, 5.0)
    start = datetime.fromisoformat(load_mission(tmp_path / "new.yaml").orbit.start_utc)
    assert abs((start - datetime.now(start.tzinfo)).total_seconds() - 3600) < 600
