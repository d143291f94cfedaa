"""What is installed by `pip install obbgs` and by its extras, what a command says where its extra is missing, and that
every command runs from the wheels, where nothing is but what they hold and ask for."""

import os
import shutil
import subprocess
import sys
import tomllib
from importlib import metadata
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from obbgs_base.extras import EXTRAS
from obbgs_core import _rasterizer
from tests.wheels import COMPILED, environment, flight_wheel, whole_wheel

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
        (ALL, "ground", ["evaluate", f"{GOLDEN}/runs/never"]),
        (ALL, "ground", ["report", f"{GOLDEN}/runs/never"]),
        ({"plotly"}, "ground", ["report", f"{GOLDEN}/runs/never"]),
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
    done = run_without(missing, "ground", "compare", GOLDEN, "--out", "never")
    assert done.returncode == 2, done.stderr
    assert "pip install 'obbgs[compare]'" in done.stderr and not (ROOT / "never").exists()


def test_a_scenario_by_basilisk_without_it_names_that_extra():
    done = run_without({"Basilisk"}, "hil", "scenario", "v-bar-drag")
    assert done.returncode == 2, done.stderr
    (line,) = done.stderr.splitlines()
    assert line.startswith("hil: this command needs Basilisk, ") and "pip install 'obbgs[basilisk]'" in line


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
        "fast-simplification": "fast_simplification",
        "pillow": "PIL",
        "bsk": "Basilisk",
    }  # where the package has another name
    listed = {extra: requirements(extra)[len(requirements()) :] for extra in EXTRAS}
    names = {extra: {modules.get(r.name, r.name) for r in wanted} for extra, wanted in listed.items()}
    assert names == EXTRAS


@pytest.fixture(scope="module")
def flight(tmp_path_factory) -> Path:
    """The commands of the flight software's wheel, without its extra."""
    folder = tmp_path_factory.mktemp("flight")
    return environment(flight_wheel(folder), set(), folder / "environment")


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Path:
    """The commands of the whole wheel with the extras that the simulator needs."""
    folder = tmp_path_factory.mktemp("whole")
    return environment(whole_wheel(folder), {"hil"}, folder / "environment")


def run_installed(commands: Path, tool: str, *arguments: str, code: int = 0) -> str:
    """Run a command of an environment away from the sources; return what it says where its exit code is this."""
    environment = {k: v for k, v in os.environ.items() if not k.startswith(("PYTHON", "COV"))}
    done = subprocess.run(
        [str(commands / tool), *arguments],
        cwd=commands,
        env=environment,
        capture_output=True,
        text=True,
        timeout=240,
    )
    assert done.returncode == code and "Traceback" not in done.stderr, done.stderr
    return done.stdout + done.stderr


HELP_OF_ALL = """
import importlib, sys
import typer
from typer.testing import CliRunner

def commands(group, *path):
    for name, command in group.commands.items():
        yield from commands(command, *path, name) if hasattr(command, "commands") else [(*path, name)]

for tool in sys.argv[1:]:
    module = importlib.import_module(f"{tool}.cli")
    assert module.__file__.startswith(sys.prefix), module.__file__
    for path in [(), *commands(typer.main.get_command(module.app))]:
        done = CliRunner().invoke(module.app, [*path, "--help"])
        assert done.exit_code == 0 and "Usage:" in done.output, (tool, path, done.output, done.exception)
        print(tool, *path)
"""


def test_every_command_of_the_flight_wheel_runs_from_it(flight, tmp_path):
    helped = run_installed(flight, "python", "-c", HELP_OF_ALL, "flightsw").splitlines()
    assert {"flightsw", "flightsw serve", "flightsw plan", "flightsw selftest"} <= set(helped)
    version = PROJECT["version"]
    assert run_installed(flight, "flightsw", "--version") == f"obbgs-flight {version}\n"
    mission = ("--mission", str(ROOT / "mission.yaml"))
    assert "pass: brackets 0 to " in run_installed(flight, "flightsw", "plan", *mission)
    model = ("--model", str(ROOT / "no.onnx"), "--store", str(tmp_path))
    hint = run_installed(flight, "flightsw", "triage", *model, *mission, code=2)
    assert "pip install 'obbgs-flight[onnx]'" in hint
    assert "no frame store" in run_installed(flight, "flightsw", "fsck", "--store", str(tmp_path), code=1)


def test_every_command_of_the_whole_wheel_runs_from_it(whole, tmp_path):
    helped = run_installed(whole, "python", "-c", HELP_OF_ALL, "flightsw", "ground", "hil").splitlines()
    assert {"flightsw plan", "ground reconstruct", "ground list", "hil demo"} <= set(helped)
    for tool in ("flightsw", "ground", "hil"):
        assert run_installed(whole, tool, "--version") == f"obbgs {PROJECT['version']}\n"
    session = tmp_path / "session"
    shutil.copytree(GOLDEN, session)
    run_installed(whole, "hil", "target", "--out", str(tmp_path / "target.glb"))
    run_installed(whole, "ground", "key", str(tmp_path / "mission.key"))
    run_installed(
        whole, "ground", "reconstruct", "--session", str(session), "--name", "two", "--set", "steps=2"
    )
    assert "two" in run_installed(whole, "ground", "list", str(tmp_path))
    hint = run_installed(whole, "ground", "compare", str(session), "--out", str(tmp_path / "c"), code=2)
    assert "pip install 'obbgs[compare]'" in hint


@pytest.mark.skipif(not COMPILED, reason="make test-wheel builds the compiled wheel, which takes a minute")
def test_the_compiled_wheel_brings_the_rasterizer_of_every_instruction_set(whole):
    assert "obbgs_core/_rasterizer" in run_installed(
        whole, "python", str(ROOT / "packaging" / "load_rasterizer.py")
    )
    asked = "from obbgs_core import _rasterizer; print(*_rasterizer.kernels())"
    assert run_installed(whole, "python", "-c", asked).split() == _rasterizer.kernels()
