"""Every Blender that is on this machine renders the same pictures: bpy of several releases, an installed `blender`.

OBBGS_BLENDERS names more Pythons with bpy, or programs `blender`, separated by colons. A test's name says which ran.
"""

import os
import shutil
import stat
from pathlib import Path

import numpy as np
import pytest

from hil.sky import SHIPPED, SHIPPED_FOIL
from hil.sky.blender import BlenderError, Worker, blender_command
from tests.hil.test_blender import camera_mission, pose_at, render

SAME_DB = 45.0  # of the pictures of two Blenders; a white plate in sunlight has radiance 1
OWN = Path(__file__).parents[2] / ".venv-blender" / "bin" / "python"
OTHERS = [
    path for path in (shutil.which("blender"), *os.environ.get("OBBGS_BLENDERS", "").split(":")) if path
]
MISSION = camera_mission(128, 2000.0, 64.0)
POSES = (((30, 60, 40), (1, 0.5, 0.2)), ((-50, 40, -50), (-0.2, 1, 0.3)))
# Debian builds Blender without the denoiser, which this takes from bpy
NO_DENOISER = """
import runpy, sys, bpy, _cycles
_cycles.with_openimagedenoise = False
runpy.run_path(sys.argv[1], run_name="__main__")
"""


def program(folder: Path, name: str, text: str) -> Path:
    path = folder / name
    path.write_text(f"#!/bin/sh\n{text}\n")
    path.chmod(path.stat().st_mode | stat.S_IXUSR)
    return path


def use(monkeypatch, folder: Path, blender: str) -> None:
    """Let a Python with bpy, or a program `blender`, be the only Blender."""
    is_python = "python" in Path(blender).name
    monkeypatch.setenv("OBBGS_BLENDER_PYTHON", blender if is_python else str(folder / "none"))
    if not is_python:
        monkeypatch.setattr(shutil, "which", lambda name: blender)
    assert blender_command()[0] == blender


def pictures(mesh: Path, out: Path) -> tuple[str, np.ndarray]:
    """Return the version of the Blender and the radiance [pose, H, W, 1] of two views."""
    worker = Worker(mesh)
    try:
        views = [
            render(worker, MISSION, pose_at(*p), out / f"{i}.npz", float32=True) for i, p in enumerate(POSES)
        ]
    finally:
        worker.close()
    return worker.version, np.stack([view["radiance"] for view in views])


def difference_db(a: np.ndarray, b: np.ndarray) -> float:
    return float(-10 * np.log10(max(np.mean((a - b) ** 2), 1e-30)))


@pytest.fixture
def undenoised(tmp_path) -> str:
    return str(program(tmp_path, "python-without-denoiser", f"exec {OWN} -c '{NO_DENOISER}' \"$@\""))


@pytest.mark.parametrize("other", OTHERS or [None], ids=lambda o: o or "no other Blender on this machine")
@pytest.mark.parametrize("mesh", [SHIPPED, SHIPPED_FOIL], ids=lambda m: m.stem)
def test_another_blender_renders_the_same(mesh, other, undenoised, tmp_path, monkeypatch, record_property):
    if other is None or not OWN.exists():
        pytest.skip(f"two Blenders are needed: {OWN} and one on the PATH or in OBBGS_BLENDERS")
    use(monkeypatch, tmp_path, other)
    version, theirs = pictures(mesh, tmp_path)
    use(monkeypatch, tmp_path, undenoised if "without denoiser" in version else str(OWN))
    own_version, ours = pictures(mesh, tmp_path)
    apart_db = difference_db(ours, theirs)
    record_property("blenders", f"{own_version}, {version}: {apart_db:.1f} dB")
    print(f"{mesh.stem}: {own_version}, {version}: {apart_db:.1f} dB")
    assert apart_db >= SAME_DB


def test_a_blender_without_a_denoiser_averages_more_light_paths(undenoised, tmp_path, monkeypatch, caplog):
    use(monkeypatch, tmp_path, undenoised)
    version, averaged = pictures(SHIPPED, tmp_path)
    use(monkeypatch, tmp_path, str(OWN))
    own_version, denoised = pictures(SHIPPED, tmp_path)
    assert version == f"{own_version} without denoiser" and "has no denoiser" in caplog.text
    # what the denoiser smooths lies at edges: some 40 dB below a white plate, and nothing on average
    assert difference_db(averaged, denoised) > 30
    assert averaged.mean() == pytest.approx(denoised.mean(), rel=0.01)


def test_a_blender_that_is_too_old_is_named(tmp_path, monkeypatch):
    old = program(tmp_path, "blender", """echo 'Blender 3.4.1'; echo '{"ready": "3.4.1"}'; cat >/dev/null""")
    use(monkeypatch, tmp_path, str(old))
    with pytest.raises(BlenderError, match=r"blender is Blender 3\.4\.1; expected 4\.1 or newer"):
        Worker(SHIPPED)


def test_a_python_without_bpy_says_what_to_install(tmp_path, monkeypatch):
    bare = program(tmp_path, "python", "echo \"ModuleNotFoundError: No module named 'bpy'\" >&2; exit 1")
    use(monkeypatch, tmp_path, str(bare))
    with pytest.raises(BlenderError, match="pip install bpy"):
        Worker(SHIPPED)
