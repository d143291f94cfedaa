"""Builds the wheels of this project, and environments that hold one of them and what it asks for, nothing else."""

import os
import subprocess
import sys
import venv
from importlib import metadata
from importlib.util import find_spec
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[1]
FLIGHT = ROOT / "packaging" / "flight"
BUILD_FLIGHT = "import sys; from hatchling.build import build_wheel; print(build_wheel(sys.argv[1]))"
COMPILED = os.environ.get("OBBGS_WHEEL")  # `make test-wheel` builds it
# without the compiled module, which `installed` takes from where it is: compiling anew takes minutes
BUILD_WHOLE = """
import sys; from scikit_build_core.build import build_wheel
print(build_wheel(sys.argv[1], {"wheel.cmake": "false", "wheel.py-api": "py3"}))
"""


def flight_wheel(folder: Path) -> Path:
    """Build the wheel of the flight software alone into a folder and return its path."""
    return _built(BUILD_FLIGHT, FLIGHT, folder)


def whole_wheel(folder: Path) -> Path:
    """Return the path of the wheel that OBBGS_WHEEL names, or of one without compiled module, built into a folder."""
    if COMPILED:
        return Path(COMPILED).resolve()
    return _built(BUILD_WHOLE, ROOT, folder)


def _built(code: str, sources: Path, folder: Path) -> Path:
    command = [sys.executable, "-c", code, str(folder)]
    done = subprocess.run(command, cwd=sources, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    return folder / done.stdout.split()[-1]


def environment(wheel: Path, extras: set[str], folder: Path) -> Path:
    """Install a wheel into a new environment and return its folder of commands.

    What the wheel and its extras ask for, and what that asks for, is linked from the environment of the tests; so
    something that the wheel needs without asking for it is missing there.
    """
    venv.EnvBuilder(symlinks=True).create(folder)
    (site,) = (folder / "lib").glob("python*/site-packages")
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "--python", str(folder / "bin/python")]
    done = subprocess.run(
        [*pip, "install", "-q", "--no-deps", "--no-index", "--no-compile", str(wheel)],
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 0, done.stderr
    (own,) = metadata.distributions(path=[str(site)])
    linked: set[str] = set()
    _link(own, extras, site, linked)
    if (site / "obbgs_core").is_dir() and not COMPILED:
        spec = find_spec("obbgs_core._rasterizer")
        assert spec is not None and spec.origin is not None, (
            "the compiled module is missing: run `make setup`"
        )
        (site / "obbgs_core" / Path(spec.origin).name).symlink_to(spec.origin)
    return folder / "bin"


def _link(package: metadata.Distribution, extras: set[str], site: Path, linked: set[str]) -> None:
    """Link what a package and these extras of it ask for into a folder of packages."""
    for requirement in map(Requirement, package.requires or []):
        name, marker = canonicalize_name(requirement.name), requirement.marker
        key = f"{name}[{','.join(sorted(requirement.extras))}]"
        if key in linked or (marker and not any(marker.evaluate({"extra": e}) for e in extras | {""})):
            continue
        linked.add(key)
        needed = (
            package if name == "obbgs" else metadata.distribution(name)
        )  # an extra that includes another one
        if needed is not package:
            for top in {file.parts[0] for file in needed.files or []} - {"..", "__pycache__"}:
                if not (site / top).exists():
                    (site / top).symlink_to(Path(str(needed.locate_file(top))))
        _link(needed, requirement.extras, site, linked)
