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
    for name in ("bash", "env", "cat", "dirname", "grep", "sed", "head"):
        (tmp_path / name).symlink_to(shutil.which(name) or "")
    script(tmp_path / "id", "echo 1000")
    script(tmp_path / "arv-fake-gv-camera-0.8", "true")
    # the libraries that are looked for come first, and more than a pipe holds after them
    lines = " ".join(f"lib{name}" for name in LIBRARIES.split())
    script(
        tmp_path / "ldconfig", f"printf '%s\\n' {lines}; printf 'libother.so.1 => /lib/%s\\n' {{1..20000}}"
    )
    return tmp_path


def told(machine: Path, python: str | None) -> str:
    """Return what setup.sh says before it ends with 2."""
    environment = {"PATH": str(machine), "HOME": os.environ.get("HOME", "/")}
    environment |= {} if python is None else {"PYTHON": python}
    result = subprocess.run(
        [ROOT / "setup.sh"], env=environment, cwd=machine, capture_output=True, text=True, timeout=60
    )
    assert result.returncode == 2 and result.stderr.count("\n") == 1, result
    return result.stderr


def test_only_what_is_missing_is_asked_for(machine):
    said = told(machine, sys.executable)
    assert "system packages are missing; run: sudo apt-get install -y" in said and "g++" in said
    assert "lib" not in said and "aravis" not in said


def test_a_python_that_is_too_old_too_new_or_missing_is_told(machine):
    assert "no Python from 3.11 to 3.14 found; install one" in told(machine, None)
    for version in ("3.10.13", "3.15.0"):
        old = machine / f"python{version}"
        script(old, f'[ "$1" = -V ] && echo Python {version} || exit 1')
        said = told(machine, str(old))
        assert f"Python 3.11 to 3.14 is needed, {old} is Python {version}; set PYTHON=" in said
