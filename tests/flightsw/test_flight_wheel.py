"""The wheel of the flight software alone: pure Python, complete, and it runs without the rest of the project."""

import json
import os
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest

from flightsw.orbit import EPHEMERIS

ROOT = Path(__file__).parents[2]
PACKAGE = ROOT / "packaging" / "flight"
BUILD = "import sys; from hatchling.build import build_wheel; print(build_wheel(sys.argv[1]))"


@pytest.fixture(scope="module")
def wheel(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("wheel")
    done = subprocess.run(
        [sys.executable, "-c", BUILD, str(folder)], cwd=PACKAGE, capture_output=True, text=True, check=True
    )
    return folder / done.stdout.split()[-1]


def test_it_holds_flight_and_what_it_shares_and_nothing_compiled(wheel):
    assert wheel.name.endswith("-py3-none-any.whl")
    names = set(zipfile.ZipFile(wheel).namelist())
    expected = {
        str(path.relative_to(ROOT))
        for part in ("flightsw", "obbgs_base")
        for path in (ROOT / part).rglob("*.py")
    }
    assert {name for name in names if name.endswith(".py")} == expected
    beside = {"flightsw/icd/dictionary.yaml", "flightsw/obbgs-flight.service", f"flightsw/{EPHEMERIS.name}"}
    assert beside <= names
    assert not [name for name in names if name.endswith((".so", ".cpp", ".pyc"))]


def test_it_asks_for_what_the_whole_package_asks_for():
    ours, whole = (tomllib.loads((f / "pyproject.toml").read_text())["project"] for f in (PACKAGE, ROOT))
    assert ours["dependencies"] == whole["dependencies"]
    assert ours["optional-dependencies"]["onnx"] == whole["optional-dependencies"]["onnx"]


def test_its_flightsw_plans_a_pass_without_the_rest_of_the_project(wheel, tmp_path):
    zipfile.ZipFile(wheel).extractall(tmp_path)
    code = """
import sys
from importlib.machinery import PathFinder
class Blocked:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {"torch", "obbgs_core", "ground", "hil", "scipy", "cv2"}:
            raise ModuleNotFoundError(f"{name} is not on board")
sys.meta_path[:0] = [Blocked(), PathFinder]  # before the finder of an editable installation
import flightsw
print(flightsw.__file__, file=sys.stderr)
from flightsw.cli import main
main()
"""
    arguments = [sys.executable, "-c", code, "plan", "--mission", str(ROOT / "mission.yaml"), "--json"]
    environment = os.environ | {"PYTHONPATH": str(tmp_path)}
    done = subprocess.run(
        arguments, cwd=tmp_path, env=environment, capture_output=True, text=True, check=True, timeout=120
    )
    assert str(tmp_path / "flightsw") in done.stderr and len(json.loads(done.stdout)["brackets"]) == 40
