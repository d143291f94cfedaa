"""The arrows between the parts, and what flight may never need."""

import functools
import json
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FORBIDDEN = {
    "flightsw": {
        "torch",
        "cv2",
        "imagecodecs",
        "obbgs_core",
        "ground",
        "compare",
        "hil",
        "scipy",
        "plotly",
        "trimesh",
    },
    "flightsw.icd": {"torch", "cv2", "obbgs_core", "ground", "compare", "hil", "serial"},
    "flightsw.ports": {"torch", "cv2", "obbgs_core", "ground", "compare", "hil"},
    "obbgs_core": {"flightsw", "ground", "compare", "hil", "typer", "rich", "serial"},
    "ground": {"compare", "hil", "cv2", "trimesh"},
    "ground.link": {"torch", "cv2", "obbgs_core", "hil"},  # a pass is received where no PyTorch is
    "compare": {"hil"},
    "hil": {"obbgs_core", "compare", "bpy"},
}
BLENDER_ONLY = {"hil.sky.blender_worker", "hil.sky.blender_materials"}  # run in Blender's own Python
ALL_COMMANDS = {"ground.cli"}  # finds the command of the part `compare` by its name


def modules_of(part: str) -> list[str]:
    folder = ROOT / part.replace(".", "/")
    names = [".".join(path.relative_to(ROOT).with_suffix("").parts) for path in sorted(folder.rglob("*.py"))]
    return [n.removesuffix(".__init__") for n in names if n not in BLENDER_ONLY | ALL_COMMANDS]


@functools.cache
def loaded_after_importing(part: str) -> set[str]:
    modules = modules_of(part)
    code = f"import importlib, json, sys\nfor m in {modules!r}: importlib.import_module(m)\n"
    code += "print(json.dumps(sorted(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    return set(json.loads(done.stdout))


@pytest.mark.parametrize("part", FORBIDDEN)
def test_part_imports_only_what_it_may(part):
    loaded = loaded_after_importing(part)
    assert not {name for name in loaded if name.partition(".")[0] in FORBIDDEN[part]}


@pytest.mark.parametrize("part", ["ground", "flightsw.ports"])
def test_ground_and_the_ports_use_only_the_icd_and_the_ports_of_flight(part):
    loaded = loaded_after_importing(part)
    flight = {name for name in loaded if name.startswith("flightsw.")}
    assert flight and all(name.startswith(("flightsw.icd", "flightsw.ports")) for name in flight)


def test_the_icd_needs_nothing_else_of_flight():
    loaded = loaded_after_importing("flightsw.icd")
    assert {n for n in loaded if n.startswith("flightsw.") and not n.startswith("flightsw.icd")} == set()


def test_flight_runs_where_torch_and_the_ground_are_not_installed():
    code = """
import sys
class Blocked:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {"torch", "cv2", "obbgs_core", "ground", "hil", "scipy"}:
            raise ModuleNotFoundError(f"{name} is not installed on board")
sys.meta_path.insert(0, Blocked())
sys.argv = ["flightsw", "plan", "--json"]
from flightsw.cli import main
main()
"""
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert len(json.loads(done.stdout)["brackets"]) == 40
