"""The whole loop, small: Blender, camera, flight, pseudo-terminal, ground, model, report; each a process of its own."""

import json
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

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
    done = hil("demo", "--out", str(out), "--mission", str(mission), "--json")
    assert done.returncode == 0, done.stderr
    figures = json.loads(done.stdout)
    assert figures["frames_captured"] == figures["frames_received"] == 15
    assert figures["line_bytes_lost"] == 0 and figures["onnx_parity_db"] >= 45
    run = out / "session" / "runs" / "demo"
    assert all((run / name).exists() for name in ("model.ply", "model.onnx", "metrics.json", "report.html"))
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
    kept = [np.load(path).files for path in (out / "renders").iterdir()]  # for the next run
    assert sum("radiance" in names for names in kept) == 15


def test_a_session_that_is_no_demos_is_never_overwritten(mission, tmp_path):
    (tmp_path / "session").mkdir()
    done = hil("demo", "--out", str(tmp_path), "--mission", str(mission))
    assert done.returncode == 1 and "was not made by a demo" in done.stderr


def test_a_mesh_that_is_none_and_a_broken_mission_are_one_clear_line(mission, tmp_path):
    (tmp_path / "bad.glb").write_bytes(b"not a mesh")
    done = hil(
        "demo", "--out", str(tmp_path / "d"), "--mission", str(mission), "--mesh", str(tmp_path / "bad.glb")
    )
    assert done.returncode == 2 and "not a mesh that Blender can load" in done.stderr
    assert "Traceback" not in done.stderr
    done = hil("demo", "--out", str(tmp_path / "e"), "--mission", "nowhere.yaml")
    assert (
        done.returncode == 2
        and "cannot read the mission file" in done.stderr
        and not (tmp_path / "e").exists()
    )
