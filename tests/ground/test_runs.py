"""Run folders: no training is lost, no run is overwritten unasked, and options and settings take effect."""

import io
import json
import math
import os
import re
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest
import trimesh
import yaml
from rich.console import Console
from typer.testing import CliRunner

from flightsw.icd import model_file
from flightsw.icd.mission import METHODS, VARIANTS, ConfigError, ReconstructSection, load_mission
from flightsw.icd.telemetry import DICTIONARY
from ground import cli
from ground.commands.options import ExportFormat, ImportFormat, Quality, UplinkCommand
from ground.commands.progress import Stop, steps_shown
from ground.link import uplink
from ground.run.card import model_card
from ground.run.evaluate import evaluate
from ground.run.reconstruct import reconstruct
from ground.run.settings import all_changes, changes_for, mission_changes, set_changes
from ground.session.folder import SessionError
from ground.show.report.document import write_report
from ground.show.summary import model_rows
from obbgs_base.errors import Interrupted
from obbgs_core.errors import Diverged
from obbgs_core.io.ply import load_ply
from obbgs_core.methods import presets
from obbgs_core.methods.presets import PRESETS, QUALITIES
from obbgs_core.train.result import StepInfo
from tests.commands import call

GOLDEN = Path(__file__).parents[1] / "golden"
QUICK = {"steps": 8, "start.count": 600, "growth.max_gaussians": 800, "published.sh_degree": 0}
FILES = {"model.ply", "model.spz", "splats.glb", "model.glb", "surface.ply", "model.onnx"}


@pytest.fixture
def session(tmp_path) -> Path:
    return Path(shutil.copytree(GOLDEN / "session", tmp_path / "session"))


@pytest.fixture(scope="module")
def finished(tmp_path_factory) -> Path:
    """A session with a finished run; tests must not write to it."""
    folder = tmp_path_factory.mktemp("finished") / "session"
    shutil.copytree(GOLDEN / "session", folder)
    reconstruct(folder, "run", "obbgs", QUICK)
    return folder


def fail(*arguments, **named):
    raise RuntimeError("no such luck")


@pytest.mark.parametrize(
    ("part", "missing"),
    [
        ("save_spz", "model.spz"),
        ("save_gltf_splats", "splats.glb"),
        ("surface_points", "surface.ply"),
        ("write_mesh", "model.glb"),
        ("export_onnx", "model.onnx"),
        ("onnx_parity_db", "onnx_parity_db"),
    ],
)
def test_what_cannot_be_made_of_a_model_is_named_and_the_rest_is_there(session, monkeypatch, part, missing):
    monkeypatch.setattr(f"ground.run.model_files.{part}", fail)
    folder = reconstruct(session, "run", "obbgs", QUICK)
    metrics = evaluate(session, "run")
    assert metrics["missing_outputs"] == {missing: "RuntimeError: no such luck"}
    assert {path.name for path in folder.iterdir()} >= FILES - {missing}
    assert metrics["gaussians"] == len(load_ply(folder / "model.ply")) and metrics["psnr_clean_db"] > 0
    line = f"{missing} is missing: RuntimeError: no such luck"
    assert line in (folder / "model_card.md").read_text() and line in write_report(session, "run").read_text()
    log = (folder / "log").read_text()
    assert f"{missing} is not made: RuntimeError: no such luck" in log and "Traceback" in log
    assert (f"not made: {missing}", "RuntimeError: no such luck") in model_rows(metrics)


@pytest.mark.parametrize(("format_", "name"), [("glb", "model.glb"), ("stl", "mesh.stl")])
def test_the_mesh_of_a_finished_run_is_written_in_the_format_asked_for(session, finished, format_, name):
    copy = Path(shutil.copytree(finished / "runs", session / "runs", dirs_exist_ok=True)) / "run" / name
    copy.unlink(missing_ok=True)
    metrics = json.loads((copy.parent / "metrics.json").read_text())
    # as an older version wrote them
    (copy.parent / "metrics.json").write_text(json.dumps(metrics | {"mesh_triangles": 12}))
    done = CliRunner().invoke(cli.app, ["mesh", str(session), "--format", format_, "--json"])
    assert done.exit_code == 0, done.output
    facts = json.loads(done.stdout)
    kept = json.loads((copy.parent / "metrics.json").read_text())
    assert (kept["mesh_triangles"] == facts["mesh_triangles"]) == (name == "model.glb")
    if name == "model.glb":
        assert f"- Mesh: {facts['mesh_triangles']:,} triangles" in (copy.parent / "model_card.md").read_text()
    assert facts["mesh"] == str(copy) and 0 < facts["mesh_triangles"] <= 50_000
    read = trimesh.load_mesh(copy)
    read.merge_vertices(merge_norm=True, merge_tex=True)
    assert read.is_watertight and len(read.faces) == facts["mesh_triangles"]
    card = model_card("today", json.loads((finished / "runs" / "run" / "metrics.json").read_text()))
    assert f"- Mesh: {facts['mesh_triangles']:,} triangles" in card and "| model.glb |" in card


def test_the_command_trains_and_ends_well_where_the_model_is_too_large_for_onnx(session, monkeypatch):
    monkeypatch.setattr("obbgs_core.io.onnx.MAX_PROTOBUF_BYTES", 1000)
    arguments = ["reconstruct", "--session", str(session), "--set", "steps=5"]
    done = CliRunner().invoke(cli.app, arguments, env={"COLUMNS": "200"})
    assert done.exit_code == 0, done.output
    assert "not made: model.onnx" in done.stdout and "train with a smaller budget" in done.stdout
    metrics = json.loads((session / "runs" / "run" / "metrics.json").read_text())
    assert metrics["onnx_bytes"] is None and metrics["onnx_parity_db"] is None and metrics["ply_bytes"] > 0


def test_the_limit_of_the_uplink_stops_no_model_of_the_ground_but_the_uplink(session, tmp_path, monkeypatch):
    assert uplink.MAX_MODEL_BYTES == model_file.MAX_MODEL_BYTES
    monkeypatch.setattr("ground.run.model_files.MAX_MODEL_BYTES", 1000)
    monkeypatch.setattr("ground.link.uplink.MAX_MODEL_BYTES", 1000)
    folder = reconstruct(session, "run", "obbgs", QUICK)
    metrics = evaluate(session, "run")
    assert metrics["onnx_bytes"] > 1000 and metrics["onnx_fits_uplink"] is False
    assert metrics["missing_outputs"] == {} and metrics["onnx_parity_db"] > 40
    assert "comparing model.onnx with our renderer" in (folder / "log").read_text()
    assert "too large for the uplink" in (folder / "model_card.md").read_text()
    assert "too large for the uplink" in dict(model_rows(metrics))["model.onnx"]
    with pytest.raises(ConfigError, match=r"accepts 1 to 1,000; .*smaller --budget"):
        command, model = uplink.parse_command("model", [str(folder / "model.onnx")])
        uplink.make_key(tmp_path / "mission.key", 1)
        uplink.submit(session, tmp_path / "mission.key", command, model, 60.0)


def test_a_model_that_the_disk_does_not_take_is_kept_and_written_later(session, monkeypatch):
    def full(*arguments):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr("ground.run.model_files.save_ply", full)
        with pytest.raises(
            SessionError, match="No space left on device; the same command resumes from the training"
        ):
            reconstruct(session, "run", "obbgs", QUICK)
    assert [path.name for path in (session / "runs").iterdir()] == [".run.part"]
    steps = []
    reconstruct(session, "run", "obbgs", QUICK, on_progress=steps.append)
    assert steps == [] and evaluate(session, "run")["train_steps"] == QUICK["steps"]


def test_a_blind_training_that_fails_does_not_cost_the_one_that_did_not(session, monkeypatch):
    from obbgs_core.train.trainer import train

    def blindly_diverging(frames, sensor, config, *more):
        if not config.exposure_aware:
            raise Diverged(7, math.inf)
        return train(frames, sensor, config, *more)

    monkeypatch.setattr("ground.run.reconstruct.train", blindly_diverging)
    reconstruct(session, "run", "obbgs", QUICK | {"blind_reference": True})
    metrics = evaluate(session, "run")
    assert "the loss became inf at step 7" in metrics["missing_outputs"]["blind.ply"]
    assert metrics["psnr_clean_db"] > 0 and "psnr_clean_blind_db" not in metrics
    assert write_report(session, "run").exists()


def test_a_time_limit_before_the_first_step_gives_the_untrained_start_and_says_so(session, caplog):
    folder = reconstruct(session, "run", "obbgs", QUICK, time_limit_s=1e-6)
    metrics = evaluate(session, "run")
    assert metrics["train_steps"] == 0 and metrics["chi2"] is None and metrics["gaussians"] > 0
    assert metrics["stop_reason"].endswith("before the first step: the model is its untrained start")
    assert metrics["stop_reason"] in (folder / "model_card.md").read_text()
    assert "No step was done" in write_report(session, "run").read_text()
    assert "NaN" not in (folder / "metrics.json").read_text() and "training" in dict(model_rows(metrics))


@pytest.mark.parametrize("limit", ["0", "-3", "nan"])
def test_a_time_limit_that_is_none_is_wrong_usage(session, monkeypatch, capsys, limit):
    arguments = ["ground", "reconstruct", "--session", str(session), "--time-limit", limit]
    monkeypatch.setattr("sys.argv", arguments)
    with pytest.raises(SystemExit) as exit_info:
        cli.main()
    assert exit_info.value.code == 2 and "time limit must be longer than 0 s" in capsys.readouterr().err
    assert not (session / "runs").exists()


def test_a_run_holds_nothing_of_an_interrupted_one_before_it(session):
    part = session / "runs" / ".run.part"
    with pytest.raises(Interrupted, match=r"before model\.spz was made; the same command resumes"):
        reconstruct(
            session,
            "run",
            "obbgs",
            QUICK | {"blind_reference": True},
            should_stop=lambda: (part / "blind.ply").exists(),
        )
    (part / "left.npz").write_text("by who knows whom")
    folder = reconstruct(session, "run", "obbgs", QUICK)
    written = {"config.yaml", "log", "metrics.json", "metrics.jsonl"}
    assert {path.name for path in folder.iterdir()} == FILES | written
    assert "psnr_clean_blind_db" not in evaluate(session, "run")


def test_a_stray_blind_model_of_an_older_run_is_not_scored(finished, tmp_path):
    session = Path(shutil.copytree(finished, tmp_path / "session"))
    shutil.copy(session / "runs" / "run" / "model.ply", session / "runs" / "run" / "blind.ply")
    assert "psnr_clean_blind_db" not in evaluate(session, "run")


def test_a_finished_run_is_replaced_only_when_asked_for(finished, tmp_path):
    session = Path(shutil.copytree(finished, tmp_path / "session"))
    model = session / "runs" / "run" / "model.ply"
    before = model.read_bytes()
    with pytest.raises(SessionError, match="--overwrite replaces it, --name makes another"):
        reconstruct(session, "run", "obbgs", QUICK, seed=1)
    assert model.read_bytes() == before
    reconstruct(session, "run", "obbgs", QUICK, seed=1, overwrite=True)
    assert model.read_bytes() != before
    assert [path.name for path in (session / "runs").iterdir()] == ["run"]
    precious = session / "runs" / "mine" / "thesis.txt"
    precious.parent.mkdir()
    precious.write_text("years")
    with pytest.raises(SessionError, match="is not a finished run, so it is not replaced"):
        reconstruct(session, "mine", "obbgs", QUICK, overwrite=True)
    assert precious.read_text() == "years"


def test_runs_go_to_another_folder_and_are_scored_there(session, tmp_path):
    out = tmp_path / "elsewhere" / "runs"
    reconstruct(session, "a", "obbgs", QUICK, out=out)
    assert evaluate(session, "a", out)["gaussians"] > 0 and write_report(session, "a", out).is_file()
    assert (out / "a" / "report.html").exists() and not (session / "runs").exists()
    header = json.loads((session / "session.json").read_text())
    (session / "session.json").write_text(json.dumps(header | {"created_utc": "2030-01-01T00:00:00Z"}))
    with pytest.raises(SessionError, match=r"is a run of the session of .* that of 2030-01-01T00:00:00Z"):
        evaluate(session, "a", out)


TRAINS_UNTIL_TOLD = """
import sys
from pathlib import Path
import ground.run.model_files
from ground.run.reconstruct import reconstruct
ground.run.model_files.SURFACE_POINTS = 1000
def told(progress):
    if progress.info.step == 3:
        print("training", flush=True)
        sys.stdin.readline()
reconstruct(Path(sys.argv[1]), "run", "obbgs", {quick!r}, on_progress=told)
"""


def test_two_processes_do_not_make_one_run_at_once(session):
    """The second one is refused and names the first, which ends as if alone; a killed one leaves no lock behind."""
    command = [sys.executable, "-c", TRAINS_UNTIL_TOLD.format(quick=QUICK), str(session)]
    first = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert first.stdout is not None and first.stdout.readline() == "training\n"
    second = subprocess.run(
        [sys.executable, "-m", "ground.cli", "reconstruct", "--session", str(session), "--overwrite"],
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert second.returncode == 1 and "Traceback" not in second.stderr
    assert f"process {first.pid} on " in second.stderr and "give another --name" in second.stderr
    first.communicate("go on\n", timeout=120)
    assert first.returncode == 0
    assert {path.name for path in (session / "runs").iterdir()} == {"run"}
    assert not (session / "runs" / "run" / "lock").exists()

    shutil.rmtree(session / "runs" / "run")
    killed = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert killed.stdout is not None and killed.stdout.readline() == "training\n"
    killed.kill()
    killed.communicate(timeout=60)
    assert reconstruct(session, "run", "obbgs", QUICK).is_dir()


def test_a_finished_run_is_refused_before_its_frames_are_read(session):
    reconstruct(session, "run", "obbgs", QUICK)
    done = call("ground", "reconstruct", "--session", str(session), "--name", "run")
    assert done.returncode == 1 and "--overwrite replaces it" in done.stderr and "reading" not in done.stderr


def test_a_run_that_another_process_has_just_finished_is_not_replaced(session, monkeypatch):
    """The run appears between the first check of the folder and the lock: the check after locking refuses it."""
    reconstruct(session, "run", "obbgs", QUICK)
    model = (session / "runs" / "run" / "model.ply").read_bytes()
    monkeypatch.setattr("ground.run.reconstruct.check_replaceable", lambda *arguments: None)
    with pytest.raises(SessionError, match="is a finished run"):
        reconstruct(session, "run", "obbgs", QUICK, seed=1)
    assert (session / "runs" / "run" / "model.ply").read_bytes() == model
    assert [path.name for path in (session / "runs").iterdir()] == ["run"]


def test_a_folder_that_cannot_be_written_to_is_named(finished, tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    for out in (tmp_path / "file" / "runs", Path("/proc/runs")):
        with pytest.raises(
            SessionError, match=f"cannot write to {out}: .*; make it writable, or copy the session"
        ):
            reconstruct(finished, out=out)

    def read_only(*arguments):
        raise OSError(30, "Read-only file system")

    monkeypatch.setattr("ground.run.evaluate.write_whole", read_only)
    monkeypatch.setattr("ground.show.report.document.write_whole", read_only)
    for score in (evaluate, write_report):
        with pytest.raises(
            SessionError, match=r"cannot write to .*: Read-only file system; make it writable"
        ):
            score(finished, "run")


def test_a_budget_in_numbers_is_what_happens_and_a_cap_is_recorded(session):
    asked = changes_for("obbgs", budget="3000") | {"steps": 2, "parsimony.prune_at": ()}
    folder = reconstruct(session, "asked", "obbgs", asked)
    config = yaml.safe_load((folder / "config.yaml").read_text())["method"]
    metrics = json.loads((folder / "metrics.json").read_text())
    assert config["growth"]["max_gaussians"] == metrics["max_gaussians"] == config["start"]["count"] == 3000
    asked_for = metrics["gaussians"]
    assert metrics["budget"] == "at most 3,000 Gaussians"
    folder = reconstruct(session, "best", "obbgs", changes_for("obbgs", "best") | {"steps": 2})
    config = yaml.safe_load((folder / "config.yaml").read_text())["method"]
    metrics = json.loads((folder / "metrics.json").read_text())
    assert metrics["gaussians"] <= config["growth"]["max_gaussians"] == metrics["max_gaussians"] < asked_for
    reason = f"at most {metrics['max_gaussians']:,} Gaussians instead of 30,000: 12 times the square root of "
    assert metrics["budget"].startswith(reason) and f"budget: {reason}" in (folder / "log").read_text()
    assert dict(model_rows(metrics))["budget"].startswith(reason)


def test_a_mission_file_says_how_to_train_and_the_command_line_says_otherwise(session, tmp_path):
    path = tmp_path / "mission.yaml"
    text = (GOLDEN / "mission.yaml").read_text().replace("seed: 7", "seed: 11").replace("obbgs", "mvgs")
    path.write_text(
        text
        + "  steps: 6\n  settings: {start: {count: 300}, growth: {max_gaussians: 300}, parsimony: {prune_at: [0.5]}}\n"
    )

    def resolved(name: str, *arguments: str) -> dict:
        start = ["reconstruct", "--session", str(session), "--name", name, "--mission", str(path)]
        done = CliRunner().invoke(cli.app, [*start, *arguments])
        assert done.exit_code == 0, done.output
        return yaml.safe_load((session / "runs" / name / "config.yaml").read_text())

    told = resolved("told")
    assert (told["method"]["name"], told["seed"], told["method"]["steps"]) == ("mvgs", 11, 6)
    assert told["method"]["start"]["count"] == 300 and told["method"]["parsimony"]["prune_at"] == [0.5]
    hash(load_mission(path))  # flight plans with it as a key
    more = ["--set", "start.count=200", "--set", "light.sun_shading=linear", "--set", "rates.means=1e-3"]
    other = resolved("other", "--method", "obbgs", "--seed", "3", "--set", "steps=4", *more)
    assert (other["method"]["name"], other["seed"], other["method"]["steps"]) == ("obbgs", 3, 4)
    assert other["method"]["start"]["count"] == 200 and other["method"]["light"]["sun_shading"] == "linear"
    assert other["method"]["rates"]["means"] == 1e-3 and other["method"]["growth"]["max_gaussians"] == 300


@pytest.mark.parametrize(
    ("line", "message"),
    [
        (
            "method: obgs",
            r"mission\.reconstruct\.method: expected one of obbgs, .*mvgs, with variants .*got 'obgs'",
        ),
        ("settings: 3", r"mission\.reconstruct\.settings: expected a mapping of keys, got 3"),
        ("settings: {stepz: 3}", r"mission\.reconstruct\.settings\.stepz: unknown key; .*steps"),
        ("settings: {steps: many}", r"settings\.steps: expected a whole number, got 'many'"),
        ("settings: {name: mine}", r"settings\.name: unknown key"),
        (
            "settings: {growth: {intervall: 3}}",
            r"settings\.growth\.intervall: unknown key; .*growth\.interval",
        ),
        ("settings: {growth: 3}", r"settings\.growth: expected a mapping of keys, got 3"),
        ("settings: {steps: {growth: 3}}", r"settings\.steps\.growth: unknown key"),
        ("settings: {growth: {interval: 0}}", r"settings: growth\.interval must be at least 1, got 0"),
    ],
)
def test_a_mission_that_asks_for_what_is_not_there_is_refused_by_its_path(tmp_path, line, message):
    path = tmp_path / "mission.yaml"
    text = (GOLDEN / "mission.yaml").read_text()
    path.write_text(text[: text.index("reconstruct:")] + f"reconstruct:\n  {line}\n")
    with pytest.raises(ConfigError, match=message):
        mission_changes(load_mission(path).reconstruct)


def test_the_choices_of_the_commands_are_those_of_the_library_and_the_dictionary():
    assert set(METHODS) == set(PRESETS) and tuple(VARIANTS) == tuple(presets.VARIANTS)
    assert set(Quality) == set(QUALITIES)
    assert set(UplinkCommand) == set(DICTIONARY.commands)
    for command, choices in (
        ("reconstruct", (*METHODS, *VARIANTS, *Quality)),
        ("import", ImportFormat),
        ("export", ExportFormat),
        ("uplink", UplinkCommand),
    ):
        shown = CliRunner().invoke(cli.app, [command, "--help"], env={"COLUMNS": "300"}).stdout
        assert all(choice in shown for choice in choices)


@pytest.mark.parametrize(
    ("command", "work"),
    [
        (["evaluate", "s"], "ground.run.runs.run_at"),
        (["report", "s"], "ground.run.runs.run_at"),
        (["import", "--format", "nerf", "--from", "d", "--session", "s"], "ground.formats.nerf.read_nerf"),
        (["export", "s", "--out", "d"], "ground.session.folder.open_session"),
    ],
)
def test_an_interrupted_command_ends_with_one_line_and_exit_code_1(monkeypatch, capsys, command, work):
    def interrupted(*arguments):
        os.kill(os.getpid(), signal.SIGINT)

    monkeypatch.setattr(work, interrupted)
    monkeypatch.setattr("sys.argv", ["ground", *command])
    # a shell that starts the tests in the background lets them ignore Ctrl-C, and Python keeps it so
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(SystemExit) as exit_info:
            cli.main()
    finally:
        signal.signal(signal.SIGINT, before)
    assert exit_info.value.code == 1
    assert capsys.readouterr().err.startswith("ground: interrupted; ")


def test_the_methods_of_a_mission_file_are_those_of_the_ground():
    for name in PRESETS:
        assert mission_changes(ReconstructSection(method=name, steps=3)) == {"steps": 3}  # type: ignore
    shown = CliRunner().invoke(cli.app, ["reconstruct", "--help"], env={"COLUMNS": "200"}).stdout
    assert all(name in shown for name in PRESETS)


@pytest.mark.parametrize(
    ("assignments", "message"),
    [
        (["stepz=3"], r"^--set stepz: unknown key; expected one of \d+ names, nearest to it: steps"),
        (
            ["sun_shading=linear"],
            r"unknown key; expected one of \d+ names, nearest to it: .*light\.sun_shading",
        ),
        (["light.sun_shading"], "expected NAME=VALUE, got 'light.sun_shading'"),
        (["rates.means=fast"], r"^--set rates\.means: expected a number, got 'fast'"),
        (["start.kind=nowhere"], r"start\.kind: expected one of random, hull, got 'nowhere'"),
        (["start=hull"], "start: expected a mapping of keys, got 'hull'"),
        (["published.sh_degree=9"], r"published\.sh_degree must be from 0 to 3, got 9"),
        (["published.sh_degree=1", "published.sh_degree=2"], r"--set published\.sh_degree: is given twice"),
        (
            ["published.sh_degree=1", "published={sh_degree: 2}"],
            r"--set published\.sh_degree: is given twice",
        ),
        (["parsimony.prune_at=[0.5"], r"--set parsimony\.prune_at: is not valid YAML"),
        (["growth.max_gaussians=5"], r"--set growth\.max_gaussians: is given by --budget too"),
    ],
)
def test_a_setting_that_is_not_there_or_of_the_wrong_kind_is_named(assignments, message):
    with pytest.raises(ConfigError, match=message):
        all_changes(ReconstructSection(), "obbgs", None, "900", assignments)


def test_settings_have_the_types_that_the_method_wants():
    assert set_changes(
        ["rates.means=2e-3", "parsimony.prune_at=[0.5, 1]", "published.coarse=[[0.5, 12, 0.1]]"]
    ) == {
        "rates.means": 0.002,
        "parsimony.prune_at": (0.5, 1.0),
        "published.coarse": ((0.5, 12.0, 0.1),),
    }


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_saves_the_training_and_the_same_command_goes_on(session, number):
    command = [sys.executable, "-m", "ground.cli", "reconstruct", "--session", str(session)]
    command += ["--set", "steps=100000"]
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    process = subprocess.Popen(
        command, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment
    )
    assert process.stderr is not None
    lines = []
    while "step 1 of 100000" not in (lines or [""])[-1]:
        lines.append(process.stderr.readline())
        assert lines[-1], lines
    os.kill(process.pid, number)
    _, said = process.communicate(timeout=120)
    assert process.returncode == 1 and "Traceback" not in said
    interrupted = re.search(r"interrupted at step (\d+) of 100000, saved in", said)
    assert interrupted and "the same command goes on from there" in said
    assert (session / "runs" / ".run.part" / "known-exposure.checkpoint").exists()
    done = int(interrupted[1])
    steps = []
    with pytest.raises(Interrupted, match=f"step {done + 1} of"):
        reconstruct(
            session,
            changes={"steps": 100_000},
            on_progress=lambda progress: steps.append(progress.info.step),
            should_stop=lambda: bool(steps),
        )


def test_a_second_signal_does_not_wait_and_none_does_where_there_is_nothing_to_save():
    stop = Stop()
    before = signal.getsignal(signal.SIGTERM)
    with stop.on_signals():
        stop.raise_at_once()
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGTERM)
        stop.defer()
        assert not stop.requested
        os.kill(os.getpid(), signal.SIGTERM)
        assert stop.requested
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGTERM)
        with pytest.raises(KeyboardInterrupt):
            stop.raise_at_once()
    assert signal.getsignal(signal.SIGTERM) == before


def test_an_interruption_after_the_training_says_that_the_run_is_there(session, monkeypatch):
    def interrupted(*arguments):
        os.kill(os.getpid(), signal.SIGINT)

    monkeypatch.setattr("ground.run.evaluate.evaluate", interrupted)
    done = CliRunner().invoke(cli.app, ["reconstruct", "--session", str(session), "--set", "steps=3"])
    assert isinstance(done.exception, Interrupted)
    assert "the run is finished in" in str(done.exception) and "`ground evaluate`" in str(done.exception)
    assert (session / "runs" / "run" / "model.ply").exists()


def test_a_training_without_a_terminal_says_every_so_often_how_far_it_is(monkeypatch):
    now_s, text = 0.0, io.StringIO()
    monkeypatch.setattr("ground.commands.progress.time.monotonic", lambda: now_s)
    with steps_shown(Console(file=text)) as show:
        for step in range(1, 101):
            now_s += 0.5
            for label in ("known exposure", "blind to exposure"):
                if (label == "known exposure") == (step <= 50):
                    show(label, StepInfo(step, 100, 0.1, 30.0, 1.5, 1234, now_s, 50 - now_s))
    lines = text.getvalue().splitlines()
    assert [int(line.split()[3 if "known" in line else 4]) for line in lines] == [1, 21, 41, 51, 71, 91, 100]
    assert lines[0] == ("known exposure: step 1 of 100 PSNR 30.0 dB chi² 1.5 1234 Gaussians 50 s left")
    with steps_shown(Console(file=(back := io.StringIO()), width=200)) as show:
        for step in (60, 61, 62, 25, 26):
            show("known exposure", StepInfo(step, 100, 0.1, 30.0, 1.5, 1234, now_s, 40.0))
    first, second = back.getvalue().splitlines()
    assert "step 60 of 100 PSNR" in first
    assert "step 25 of 100 (the schedule was set back from step 62) PSNR" in second


def test_the_result_is_a_table_with_units_and_json_as_ever(finished):
    run = str(finished / "runs" / "run")
    shown = CliRunner().invoke(cli.app, ["evaluate", run], env={"COLUMNS": "120"}).stdout
    figures = json.loads(CliRunner().invoke(cli.app, ["evaluate", run, "--json"]).stdout)
    assert f"{figures['psnr_clean_db']:.2f} dB" in shown
    assert "48 / unknown, 42 trained on, 6 held out" in shown
    assert f"{figures['train_seconds']:.0f} s; all 8 steps done" in shown and "MB" in shown
    assert "psnr_clean_db" not in shown and "sun_span_deg" not in shown
    for key in ("method", "gaussians", "chi2", "frames_received", "ply_bytes", "onnx_parity_db", "start"):
        assert key in figures
