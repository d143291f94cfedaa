"""The wheel of the flight software alone: pure Python, complete, and it runs without the rest of the project."""

import json
import os
import re
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest

from flightsw.navigation.orbit import EPHEMERIS
from tests.wheels import flight_wheel

ROOT = Path(__file__).parents[2]
PACKAGE = ROOT / "packaging" / "flight"


@pytest.fixture(scope="module")
def wheel(tmp_path_factory) -> Path:
    return flight_wheel(tmp_path_factory.mktemp("wheel"))


def test_it_holds_flight_and_what_it_shares_and_nothing_compiled(wheel):
    assert wheel.name.endswith("-py3-none-any.whl")
    names = set(zipfile.ZipFile(wheel).namelist())
    expected = {
        str(path.relative_to(ROOT))
        for part in ("flightsw", "obbgs_base")
        for path in (ROOT / part).rglob("*.py")
    }
    assert {name for name in names if name.endswith(".py")} == expected
    beside = {
        "flightsw/icd/dictionary.yaml",
        "flightsw/obbgs-flight.service",
        str(EPHEMERIS.relative_to(ROOT)),
    }
    beside |= {"flightsw/example_mission.yaml"}
    assert beside <= names
    assert not [name for name in names if name.endswith((".so", ".cpp", ".pyc"))]


def test_it_asks_for_what_the_whole_package_asks_for_but_the_ground_s_coder_of_pictures():
    ours, whole = (tomllib.loads((f / "pyproject.toml").read_text())["project"] for f in (PACKAGE, ROOT))
    assert [*ours["dependencies"], "imagecodecs"] == whole["dependencies"]
    assert ours["optional-dependencies"]["onnx"] == whole["optional-dependencies"]["onnx"]


AARCH64 = [f"--platform=manylinux{version}_aarch64" for version in ("2014", "_2_27", "_2_28")]


def test_every_dependency_comes_without_a_compiler_on_aarch64(wheel, tmp_path):
    """pip resolves the wheels for that processor, without loading them; skipped where no registry answers."""
    report = tmp_path / "report.json"
    command = [sys.executable, "-m", "pip", "install", "--dry-run", "--target", tmp_path / "none", *AARCH64]
    command += ["--only-binary=:all:", "--python-version=3.11", "--quiet", "--disable-pip-version-check"]
    command += ["--retries=0", "--report", report, f"{wheel}[onnx]"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=240)
    if (
        missing := re.search("No matching distribution found for ([A-Za-z0-9_.-]+)", done.stderr)
    ) is not None:
        ask = [sys.executable, "-m", "pip", "index", "versions", missing[1], "--retries=0"]
        if subprocess.run(ask, capture_output=True, timeout=120).returncode:  # not even for this processor
            pytest.skip("no registry of packages answers")
    assert done.returncode == 0, done.stderr
    files = [
        entry["download_info"]["url"].rpartition("/")[2]
        for entry in json.loads(report.read_text())["install"]
    ]
    assert len(files) > 15 and all("aarch64" in name or "-none-any" in name for name in files), files


def test_its_flightsw_plans_a_pass_without_the_rest_of_the_project(wheel, tmp_path):
    zipfile.ZipFile(wheel).extractall(tmp_path)
    code = """
import sys
from importlib.machinery import PathFinder
class Blocked:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {"torch", "obbgs_core", "ground", "hil", "scipy", "cv2", "imagecodecs"}:
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
