"""What README and notebook show runs as it stands, on the session that is shipped with them."""

import io
import json
import re
import shutil
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any

import matplotlib
import matplotlib.pyplot as plt
import pytest
import torch

from ground import frames_of, open_session, sensor_of
from ground.session.training_frames import usable
from obbgs_core import load_ply, preset
from obbgs_core.train import train

ROOT = Path(__file__).parents[2]
EXAMPLES = ROOT / "examples"
MOST_BYTES = 400_000
GOOD_DB = 30  # 38 dB are reached


@pytest.fixture
def folder(tmp_path, monkeypatch) -> Path:
    """A folder with a copy of the examples, and the current one."""
    shutil.copytree(EXAMPLES, tmp_path / "examples")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def ran(source: str) -> tuple[dict[str, Any], str]:
    """Return the names that a program defines, and what it prints."""
    names: dict[str, Any] = {}
    with redirect_stdout(io.StringIO()) as printed:
        exec(compile(source, "example", "exec"), names)
    return names, printed.getvalue()


def test_the_snippet_of_the_readme_runs(folder):
    found = re.search(r"## As a library\n+```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    assert found is not None
    names, printed = ran(found[1])
    assert printed.count("\n") == 1 and re.search(r"[\d,]+ Gaussians, PSNR .* all 300 steps done", printed)
    assert len(load_ply(folder / "model.ply")) == len(names["result"].gaussians)


def test_the_notebook_runs_and_its_model_is_good(folder, monkeypatch):
    """All of its cells in one go, as a kernel runs them; its plots hold what they say."""
    matplotlib.use("Agg")
    monkeypatch.chdir(folder / "examples")
    cells = json.loads((EXAMPLES / "first_model.ipynb").read_text())["cells"]
    source = "\n".join("".join(cell["source"]) for cell in cells if cell["cell_type"] == "code")
    names, printed = ran(source)
    try:
        assert "105 frames to train on, 15 held out" in printed
        told = re.search(r"mean PSNR of held-out frames: ([\d.]+) dB", printed)
        assert told and float(told[1]) > GOOD_DB
        lines = [axes.lines[0] for n in plt.get_fignums() for axes in plt.figure(n).axes if axes.lines]
        seconds, psnr = (getattr(lines[0], f"get_{axis}data")() for axis in "xy")
        assert len(seconds) == len(psnr) == 291 and psnr[-1] > psnr[0] + 5
        assert (folder / "examples" / "model.ply").exists() and len(names["scores"]) == 5
    finally:
        plt.close("all")


def test_the_shipped_session_is_small_and_opens():
    session = open_session(EXAMPLES / "small_session")
    assert sum(path.stat().st_size for path in session.path.rglob("*") if path.is_file()) < MOST_BYTES
    assert len(session.frames) == 120 and session.camera.width == 64
    frames = frames_of(session)
    assert [frame.id for frame in frames] == [record.id for record in usable(session.frames)]
    first = frames_of(session, session.frames[:1])[0]
    assert torch.equal(first.dn[..., 0], torch.from_numpy(session.dn(session.frames[0]).astype("float32")))
    result = train(frames, sensor_of(session.camera), preset("obbgs", {"steps": 1, "start.count": 50}))
    for shown in (session, session.frames[0], first, result.gaussians):
        assert "\n" not in repr(shown) and len(repr(shown)) < 120
    assert repr(session).endswith("small_session: 120 frames of 64x64 pixels in 40 brackets>")
    assert repr(first) == "<frame 0 of bracket 0: 64x64 pixels, 1 channel, 0.05 ms>"
    assert str(result) == repr(result) and "\n" not in repr(result) and "1 steps in" in repr(result)
