"""`setup.sh` before it installs anything: what it says of a machine that lacks something."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
LIBRARIES = "X11.so.6 Xrender.so.1 Xfixes.so.3 Xi.so.6 xkbcommon.so.0 SM.so.6 GL.so.1 aravis-0.8.so.0"


def script(path: Path, text: str) -> None:
    path.write_text(f"#!{shutil.which('bash')}\n{text}\n")
    path.chmod(0o755)


@pytest.fixture
def machine(tmp_path) -> Path:
    """The programs of a machine of a user who is not root, with all libraries but without a compiler."""
    for name in ("bash", "env", "cat", "dirname", "sed", "head", "find", "sort", "tr", "sha256sum", "cut"):
        (tmp_path / name).symlink_to(shutil.which(name) or "")
    script(tmp_path / "id", "echo 1000")
    system(tmp_path, "Linux", "x86_64")
    script(tmp_path / "arv-fake-gv-camera-0.8", "true")
    # the libraries that are looked for come first, and more than a pipe holds after them
    lines = " ".join(f"lib{name}" for name in LIBRARIES.split())
    script(
        tmp_path / "ldconfig", f"printf '%s\\n' {lines}; printf 'libother.so.1 => /lib/%s\\n' {{1..20000}}"
    )
    return tmp_path


def system(machine: Path, name: str, processor: str) -> None:
    script(machine / "uname", f'[ "$1" = -s ] && echo {name} || echo {processor}')


def told(machine: Path, python: str | None, root: Path = ROOT) -> str:
    """Return what setup.sh says before it ends with 2."""
    environment = {"PATH": str(machine), "HOME": os.environ.get("HOME", "/")}
    environment |= {} if python is None else {"PYTHON": python}
    result = subprocess.run(
        [root / "setup.sh"], env=environment, cwd=machine, capture_output=True, text=True, timeout=60
    )
    assert result.returncode == 2 and result.stderr.count("\n") == 1, result
    return result.stderr


def test_only_what_is_missing_is_asked_for(machine):
    said = told(machine, sys.executable)
    assert (
        "system packages are missing; on Debian or Ubuntu run: sudo apt-get install -y" in said
        and "g++" in said
    )
    assert "lib" not in said and "aravis" not in said


def test_a_python_that_is_too_old_too_new_or_missing_is_told(machine):
    assert "no Python from 3.11 to 3.14 found; install one" in told(machine, None)
    for version in ("3.10.13", "3.15.0"):
        old = machine / f"python{version}"
        script(old, f'[ "$1" = -V ] && echo Python {version} || exit 1')
        said = told(machine, str(old))
        assert f"Python 3.11 to 3.14 is needed, {old} is Python {version}; set PYTHON=" in said


def test_another_system_than_linux_is_told(machine):
    system(machine, "Darwin", "arm64")
    assert "this sets up Linux, and Darwin was never tried" in told(machine, sys.executable)


@pytest.fixture
def installed(machine) -> Path:
    """A copy of setup.sh whose environment is made of a Python 3.12 that installs what it is told."""
    root = machine / "root"
    (root / ".venv" / "bin").mkdir(parents=True)
    for part in ("flightsw", "obbgs_base", "obbgs_core/render/kernels", "ground", "compare", "hil"):
        (root / part).mkdir(parents=True)
    for name in ("setup.sh", "pyproject.toml", "constraints.txt", "CMakeLists.txt"):
        shutil.copy(ROOT / name, root)
    include = machine / "Python.h"
    include.touch()
    answers = f'case "$*" in -V) echo Python 3.12.1;; *include*) echo {machine};; *"(3, 13)"*) exit 1;; esac'
    for path in (machine / "python3.12", root / ".venv" / "bin" / "python"):
        script(path, answers)
    script(root / ".venv" / "bin" / "pip", "exit 0")
    script(machine / "g++", "true")
    return root


def test_what_blender_needs_is_told_for_the_processor(machine, installed):
    python = str(machine / "python3.12")
    said = told(machine, python, installed)
    assert (
        "there is no bpy for Python 3.12.1 on x86_64, no python3.11 or python3.13 with venv, and no uv"
        in said
    )
    system(machine, "Linux", "aarch64")
    said = told(machine, python, installed)
    assert (
        "there is no bpy for Python 3.12.1 on aarch64. Provide one" in said
        and "blender python3-numpy" in said
    )
    # a blender that is too old does not do, a newer one does
    script(machine / "blender", "echo Blender 3.6.0")
    assert "no `blender` of 4.1 or newer" in told(machine, python, installed)
    script(machine / "blender", "echo Blender 4.3.2")
    environment = {"PATH": str(machine), "PYTHON": python}
    result = subprocess.run(
        [installed / "setup.sh"], env=environment, capture_output=True, text=True, timeout=60
    )
    assert result.returncode == 0, result
    assert f"Blender is {machine}/blender, 4.3; there is no bpy for Python 3.12.1 on aarch64" in result.stdout


def test_packages_that_pip_cannot_install_are_told(machine, installed):
    script(installed / ".venv" / "bin" / "pip", "exit 1")
    said = told(machine, str(machine / "python3.12"), installed)
    assert ".venv is not complete" in said and "Python 3.12.1 on x86_64" in said
    assert not (installed / ".venv" / ".ready").exists()


def test_a_module_that_moves_is_installed_anew(machine, installed):
    """An editable installation lists the files of modules: one that became a folder was not found any more."""
    script(installed / ".venv" / "bin" / "pip", f"echo installed >> {machine}/log")
    script(machine / "blender", "echo Blender 4.3.2")
    environment = {"PATH": str(machine), "PYTHON": str(machine / "python3.12")}
    (installed / "flightsw" / "pose").mkdir()
    (installed / "flightsw" / "pose.py").touch()
    for times, after in ((1, "pose.py"), (1, "pose.py"), (2, "pose/__init__.py")):
        if times == 2:
            (installed / "flightsw" / "pose.py").rename(installed / "flightsw" / after)
        subprocess.run([installed / "setup.sh"], env=environment, check=True, capture_output=True, timeout=60)
        assert (machine / "log").read_text().count("installed") == times
