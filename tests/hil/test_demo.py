"""The whole demo at small size: Blender, camera, flight, link, ground, model and report, each a separate process."""

import json
import re
import socket
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import yaml
from rich.console import Console

from compare.case import load_case
from compare.references import black
from flightsw.icd.config import ConfigError
from flightsw.icd.mission import load_mission
from hil import cli
from hil.cameras.gige import GVCP_PORT, LOOPBACK
from hil.demo import simulate_pass
from hil.processes import installed
from hil.simulated_pass import PassConfig, PassError, fly
from hil.sky import SHIPPED
from hil.world.navigation import write_flight_inputs
from hil.world.scenario import Scene, load_scenario
from hil.world.world import load_world
from tests.commands import call

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def mission(tmp_path_factory) -> Path:
    text = (ROOT / "tests" / "golden" / "mission.yaml").read_text()
    for old, new in (("72", "48"), ("1900.0", "1270.0"), ("36.0", "24.0"), ("count: 16", "count: 5")):
        text = re.sub(rf"(?<=[ :]){re.escape(old)}(?=\s|$)" if old[0].isdigit() else old, new, text)
    text += "  steps: 200\n"  # into the last section, reconstruct
    path = tmp_path_factory.mktemp("mission") / "mission.yaml"
    path.write_text(text)
    return path


def hil(*arguments: str) -> subprocess.CompletedProcess:
    command = [str(Path(sys.executable).with_name("hil")), *arguments]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=280)


def test_demo_ends_in_a_report_with_every_frame_across(mission, tmp_path):
    out = tmp_path / "demo"
    options = ("--mission", str(mission), "--navigation", "perfect", "--json")
    done = hil("demo", "--out", str(out), *options)
    assert done.returncode == 0, done.stderr
    figures = json.loads(done.stdout)
    assert figures["frames_captured"] == figures["frames_received"] == 15
    assert figures["link"]["lost_bytes"] == figures["link"]["cuts"] == 0
    case = load_case(out / "session")
    black_db = case.image_scores(black(case, case.training))["psnr_clean_db"]
    assert figures["onnx_parity_db"] >= max(45, black_db + 10)  # 45 dB says little of dark pictures
    assert figures["navigation"] == {
        "source": "sgp4",
        "errors": "none",
        "attitude": "known",
        "position_error_m": 0.0,
        "rotation_error_deg": 0.0,
    }
    run = out / "session" / "runs" / "demo"
    assert all((run / name).exists() for name in ("model.ply", "model.onnx", "metrics.json", "report.html"))
    page = (run / "report.html").read_text()
    for words in (
        "The simulated world",
        "camera: late frames",
        "link: kind",
        "navigation: position error, m",
    ):
        assert words in page
    metrics = json.loads((run / "metrics.json").read_text())
    for key in (
        "psnr_clean_db",
        "psnr_clean_blind_db",
        "chamfer",
        "gaussians",
        "frames_captured",
        "frames_received",
        "train_seconds",
    ):
        assert key in metrics
    stored = [
        json.loads(line)["sha256"] for line in (out / "flight" / "index.jsonl").read_text().splitlines()
    ]
    arrived = [
        json.loads(line)["sha256"] for line in (out / "session" / "frames.jsonl").read_text().splitlines()
    ]
    assert sorted(stored) == sorted(arrived)
    kept = [np.load(path).files for path in (out / "renders").iterdir()]  # cached for the next run
    assert sum("radiance" in names for names in kept) == 15


@pytest.fixture
def quick(mission, tmp_path) -> Path:
    """The small mission with two brackets of two."""
    text = mission.read_text().replace("count: 5", "count: 2").replace("[0.05, 0.1, 0.2]", "[0.05, 0.2]")
    path = tmp_path / "quick.yaml"
    path.write_text(text)
    return path


def plate(pose) -> np.ndarray:
    """A bright square in the middle of the picture, wherever the camera is."""
    picture = np.zeros((48, 48, 1))
    picture[18:30, 18:30] = 0.4
    return picture


def noise(pose) -> np.ndarray:
    """A picture that does not compress: every frame is several packets of the link."""
    return np.random.default_rng(1).uniform(0, 0.4, (48, 48, 1))


def test_every_frame_crosses_a_faulty_can_bus_from_a_gige_camera(
    mission, tmp_path, monkeypatch, the_only_camera_on_loopback
):
    monkeypatch.setattr("hil.links.faults.STANDARD_CUT_S", 2.0)  # five timer intervals of the link
    config = PassConfig(gige=True, link="slcan-fd", faults="standard")
    world = load_world(load_mission(mission))
    figures = fly(tmp_path, world, mission, noise, config, Console(stderr=True))
    assert figures["frames"] == {"captured": 15, "received": 15, "without_valid_pose": 0}
    assert figures["camera"]["exposures"] == 15
    assert figures["camera"]["packets_lost"] == figures["camera"]["failures"] == 0
    link = figures["link"]
    assert link["cuts"] == 1
    for name in ("destroyed", "flipped", "duplicated", "reordered", "cut"):
        assert link[f"can_frames_{name}"] > 0
    assert link["segments_resent"] > 0


def test_a_pass_that_stalls_is_an_error(quick, tmp_path, monkeypatch):
    monkeypatch.setattr("hil.simulated_pass.STALL_S", 2.0)
    monkeypatch.setattr("hil.simulated_pass._Cut.update", lambda cut, received: cut._line.cut())
    world = load_world(load_mission(quick))
    with pytest.raises(PassError, match="0 received of 4"):
        fly(tmp_path, world, quick, plate, PassConfig(), Console(stderr=True))


def test_a_tumbling_target_is_flown_in_time_and_its_truth_is_kept(quick, tmp_path):
    out = tmp_path / "demo"
    config = PassConfig(link="slcan", scenario="tumbling", navigation="realistic", real_time=3000.0, seed=3)
    simulation = simulate_pass(out, quick, SHIPPED, config, Console(stderr=True))
    assert simulation["frames"] == {"captured": 4, "received": 4, "without_valid_pose": 0}
    link = simulation["link"]  # without faults, a CAN bus
    assert link["can_frames_lost"] == link["can_frames_overrun"] == link["segments_resent"] == 0
    # frames of a bracket are a sixth of a millisecond apart, less than storing one takes
    assert 2 <= simulation["camera"]["late_frames"] <= 3
    # 2 % of 400 m, and in body axes what 4700 degrees of tumbling make of 0.2 %
    assert 0.01 * 400 < simulation["navigation"]["position_error_m"] < 0.3 * 400
    assert simulation["navigation"]["clock_error_s"] != 0
    scene = Scene(load_scenario("tumbling"))
    truth = json.loads((out / "session" / "truth" / "truth.json").read_text())
    assert truth["simulation"] == simulation
    lines = (out / "session" / "frames.jsonl").read_text().splitlines()
    tags = {tag["id"]: tag for tag in map(json.loads, lines)}
    assert len(truth["frames"]) == 4
    for entry in truth["frames"]:
        tag = tags[entry["id"]]
        true = scene.state(tag["mid_exposure_utc_ns"]).pose.world_to_camera
        np.testing.assert_allclose(entry["world_to_camera"], true, atol=1e-9)
        assert 1 < np.abs(np.array(tag["world_to_camera"]) - true).max() < 20  # m: navigation errs


def test_impossible_options_are_refused_before_anything_is_written(mission, tmp_path, monkeypatch, capsys):
    for chosen, reason in (
        (("--bus", "radio"), "'radio' is not one of 'serial', 'slcan', 'slcan-fd'"),
        (("--faults", "all"), "--faults: expected none, standard, or loss,"),
        (("--faults", "loss=2"), "as in loss=0.02,seed=3; got 'loss=2'"),
        (("--navigation", "realistic:x"), "expected realistic, realistic:SEED or perfect, got 'realistic:x'"),
        (("--scenario", "fly_around"), "expected a YAML file or one of approach"),
        (("--real-time", "-1"), "0 (lock step) or positive"),
    ):
        command = ["hil", "demo", "--out", str(tmp_path / "d"), "--mission", str(mission), *chosen]
        monkeypatch.setattr(sys, "argv", command)
        with pytest.raises(SystemExit) as ended:
            cli.main()
        told = capsys.readouterr().err
        assert ended.value.code == 2 and reason in told
    assert not (tmp_path / "d").exists()


def test_what_no_demo_made_is_never_overwritten(mission, tmp_path):
    (tmp_path / "a" / "session").mkdir(parents=True)
    (tmp_path / "b").mkdir()
    (tmp_path / "b" / "flight.log").write_text("mine\n")
    for folder in (tmp_path / "a", tmp_path / "b"):
        done = call("hil", "demo", "--out", folder, "--mission", mission)
        assert done.returncode == 1 and "was not made by a demo" in done.stderr
    assert (tmp_path / "b" / "flight.log").read_text() == "mine\n"


def test_a_mission_of_one_s_own_is_not_replaced_by_the_inputs_of_a_simulation(tmp_path):
    world = load_world(load_mission(ROOT / "mission.yaml"), "v-bar")
    (tmp_path / "mission.yaml").write_text("# mine\n")
    with pytest.raises(ConfigError, match=r"mission.yaml: is not of an earlier run.*choose another folder"):
        write_flight_inputs(world, tmp_path, None)
    assert (tmp_path / "mission.yaml").read_text() == "# mine\n"
    for _ in range(2):  # its own are written again
        write_flight_inputs(world, tmp_path / "spaces in its name", None)


def test_a_demo_flies_the_bracket_of_its_mission_and_exact_tags_whatever_is_known(quick, tmp_path):
    tree = yaml.safe_load(quick.read_text())
    tree["bracket"]["auto"] = True
    tree["target_attitude"]["knowledge"] = "unknown"
    tree["navigation"] = {"source": "file:///nowhere"}
    mission = tmp_path / "auto.yaml"
    mission.write_text(yaml.safe_dump(tree))
    long = tmp_path / ("a" * 60) / ("b" * 60)  # a socket in it would have too long a path
    figures = simulate_pass(
        long, mission, SHIPPED, PassConfig(attitude="known", navigation="perfect"), Console(stderr=True)
    )
    assert figures["navigation"]["rotation_error_deg"] < 0.01 and figures["frames"]["without_valid_pose"] == 0
    lines = (long / "session" / "frames.jsonl").read_text().splitlines()
    times = {json.loads(line)["exposure_time_s"] for line in lines}
    assert times.isdisjoint({t / 1e3 for t in tree["bracket"]["exposure_times_ms"]})


def test_a_second_demo_in_the_folder_of_a_running_one_is_refused_and_removes_nothing(quick, tmp_path):
    """The first one flies for half a minute: a minute lies between its two brackets."""
    out = tmp_path / "demo"
    options = ["demo", "--out", str(out), "--mission", str(quick), "--real-time", "2"]
    first = subprocess.Popen(
        [installed("hil"), *options], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    try:
        while not (out / "session").exists():
            assert first.poll() is None
            time.sleep(0.05)
        second = hil(*options)
        assert second.returncode == 1 and f"another hil command works in {out}" in second.stderr
        assert (out / "session").exists() and first.poll() is None
    finally:
        first.terminate()
        first.wait()


def test_a_demo_that_cannot_start_leaves_no_files_and_an_earlier_one_as_it_was(
    mission, tmp_path, monkeypatch, capsys
):
    monkeypatch.setenv("OBBGS_BLENDER_PYTHON", str(tmp_path / "no-python"))
    monkeypatch.setenv("PATH", str(tmp_path))  # no `blender` either
    old = tmp_path / "old"
    (old / "session" / "runs").mkdir(parents=True)
    (old / "demo.json").write_text('{"chamfer": 0.01}\n')
    for out in (tmp_path / "new", old):
        for mesh, reason in ((SHIPPED, "Blender is missing"), ("nowhere.glb", "no such file")):
            command = ["hil", "demo", "--out", str(out), "--mission", str(mission), "--mesh", str(mesh)]
            monkeypatch.setattr(sys, "argv", command)
            with pytest.raises(SystemExit) as ended:
                cli.main()
            assert ended.value.code in (1, 2) and reason in capsys.readouterr().err
    assert not (tmp_path / "new").exists()
    assert (old / "session" / "runs").exists()
    assert json.loads((old / "demo.json").read_text()) == {"chamfer": 0.01}


def test_a_pass_that_cannot_start_leaves_only_rendered_frames(quick, tmp_path, the_only_camera_on_loopback):
    out = tmp_path / "demo"
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind((LOOPBACK, GVCP_PORT))
        config = PassConfig(gige=True, scenario="tumbling")
        with pytest.raises(OSError, match="is in use"):
            simulate_pass(out, quick, SHIPPED, config, Console(stderr=True))
    assert [path.name for path in out.iterdir()] == ["renders"]


def test_a_file_that_is_no_mesh_and_a_missing_mission_are_refused_in_one_line(mission, tmp_path):
    (tmp_path / "bad.glb").write_bytes(b"not a mesh")
    here = ("--out", tmp_path / "d", "--mission", mission)
    done = call("hil", "demo", *here, "--mesh", tmp_path / "bad.glb")
    assert done.returncode == 2 and "not a mesh that Blender can load" in done.stderr
    assert "Traceback" not in done.stderr and not (tmp_path / "d").exists()
    done = call("hil", "demo", *here, "--mesh", tmp_path / "nowhere.glb")
    assert done.returncode == 2 and "no such file" in done.stderr and not (tmp_path / "d").exists()
    done = call("hil", "demo", "--out", tmp_path / "d", "--mission", "nowhere.yaml")
    assert done.returncode == 2 and "cannot read the mission file" in done.stderr
    assert not (tmp_path / "d").exists()
