"""What is installed by `pip install obbgs` and by its extras, and what a command says where its extra is missing."""

import subprocess
import sys
import tomllib
from importlib import metadata
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from obbgs_base.extras import EXTRAS

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
GOLDEN = str(ROOT / "tests" / "golden" / "session")
ANY_LATER = "9999"  # stands for every release to come


def requirements(*extras: str) -> list[Requirement]:
    texts = PROJECT["dependencies"] + [t for e in extras for t in PROJECT["optional-dependencies"][e]]
    return [Requirement(text) for text in texts if not text.startswith("obbgs")]


def test_what_a_pinned_dependency_bounds_is_bounded_here_too():
    """Or pip fetches the newest release first, which for a wheel that it lacks means a compiler, and then goes back."""
    ours = {canonicalize_name(r.name): r for r in requirements("onnx", "ground", "hil")}
    unbounded = []
    for name in [name for name, r in ours.items() if any(s.operator == "==" for s in r.specifier)]:
        for text in metadata.requires(name) or []:
            theirs = Requirement(text)
            own = ours.get(canonicalize_name(theirs.name))
            if own is None or (theirs.marker and not theirs.marker.evaluate({"extra": ""})):
                continue
            if own.specifier.contains(ANY_LATER) and not theirs.specifier.contains(ANY_LATER):
                unbounded.append(f"{own} here, {name} wants {theirs}")
    assert unbounded == []


def test_the_installed_releases_are_those_that_are_asked_for():
    for requirement in requirements("onnx", "ground", "hil"):
        assert requirement.specifier.contains(metadata.version(requirement.name), prereleases=True), (
            requirement
        )


def run_without(modules: set[str], tool: str, *arguments: str) -> subprocess.CompletedProcess:
    """Run a command line where some modules are not installed."""
    code = f"""
import sys
class Missing:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {modules!r}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)
sys.meta_path.insert(0, Missing())
sys.argv = [{tool!r}, *{list(arguments)!r}]
from {tool}.cli import main
main()
"""
    return subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, timeout=120)


ALL = set().union(*EXTRAS.values())


@pytest.mark.parametrize(
    ("missing", "tool", "arguments"),
    [
        (ALL, "ground", ["reconstruct", "--session", GOLDEN, "--name", "never"]),
        (ALL, "ground", ["evaluate", "--session", GOLDEN, "--name", "never"]),
        (ALL, "ground", ["report", "--session", GOLDEN, "--name", "never"]),
        ({"plotly"}, "ground", ["report", "--session", GOLDEN, "--name", "never"]),
        (ALL, "hil", ["demo"]),
        (ALL, "hil", ["camera"]),
        (ALL, "hil", ["scenario"]),
        ({"trimesh"}, "hil", ["dataset", "--out", "never"]),
    ],
)
def test_a_command_without_its_extra_says_what_to_install(missing, tool, arguments):
    done = run_without(missing, tool, *arguments)
    assert done.returncode == 2, done.stderr
    (line,) = done.stderr.splitlines()
    assert line.startswith(f"{tool}: this command needs ") and f"pip install 'obbgs[{tool}]'" in line
    assert any(f"needs {module}," in line for module in missing)


@pytest.mark.parametrize("missing", [ALL, {"distributed"}, {"matplotlib"}])
def test_a_comparison_without_its_extra_names_that_extra(missing):
    done = run_without(missing, "ground", "compare", "--sessions", GOLDEN, "--out", "never")
    assert done.returncode == 2, done.stderr
    assert "pip install 'obbgs[compare]'" in done.stderr and not (ROOT / "never").exists()


@pytest.mark.parametrize(
    ("tool", "arguments"),
    [
        ("ground", ["--help"]),
        ("ground", ["key", "{tmp}/k"]),
        ("hil", ["--help"]),
        ("hil", ["demo", "--help"]),
        ("hil", ["target", "--out", "{tmp}/t.glb"]),
    ],
)
def test_what_needs_no_extra_runs_without_any(tmp_path, tool, arguments):
    done = run_without(ALL, tool, *(a.replace("{tmp}", str(tmp_path)) for a in arguments))
    assert done.returncode == 0, done.stderr


def test_a_module_that_no_extra_brings_is_a_defect_and_stays_one():
    done = run_without({"sgp4"}, "hil", "scenario")
    assert done.returncode == 1 and "ModuleNotFoundError: No module named 'sgp4'" in done.stderr


def test_every_extra_of_the_package_is_known_to_the_message():
    modules = {
        "opencv-contrib-python-headless": "cv2",
        "scikit-image": "skimage",
    }  # where the package has another name
    listed = {extra: requirements(extra)[len(requirements()) :] for extra in EXTRAS}
    names = {extra: {modules.get(r.name, r.name) for r in wanted} for extra, wanted in listed.items()}
    assert names == EXTRAS
