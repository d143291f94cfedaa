"""The house rules: which room may import which, no cycles, no long files, no long functions; read from the source."""

import ast
import collections
import graphlib
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PARTS = ("obbgs_base", "obbgs_core", "flightsw", "ground", "compare", "hil")
LONGEST_FILE, LONGEST_FUNCTION = 800, 80  # lines
FULLEST_FOLDER = 15  # files
CORE = {"obbgs_base", "obbgs_core.model", "obbgs_core"}  # what every room of the library may use
LIBRARY = {
    f"obbgs_core.{room}" for room in ("model", "render", "poses", "methods", "train", "io", "score")
} | {"obbgs_core"}
CONTRACT = {"obbgs_base", "flightsw.icd", "flightsw.icd.transfer"}
GROUND = {"ground.session", "ground.formats"}
ARROWS = {  # room: the rooms that its modules may import besides their own; a module stands in the innermost one
    "obbgs_base": set(),
    "obbgs_core.model": {"obbgs_base"},
    "obbgs_core": {
        "obbgs_base",
        "obbgs_core.model",
    },  # the flat modules: errors, sensor, losses, obb, frames, ...
    "obbgs_core.render": CORE,
    "obbgs_core.poses": CORE | {"obbgs_core.render"},
    "obbgs_core.evidence": CORE | {"obbgs_core.render", "obbgs_core.poses"},
    "obbgs_core.published": CORE,
    "obbgs_core.start": CORE | {"obbgs_core.poses"},
    "obbgs_core.attitude": CORE | {"obbgs_core.poses", "obbgs_core.start"},
    "obbgs_core.methods": CORE | {"obbgs_core.published", "obbgs_core.start"},
    "obbgs_core.train": CORE
    | {f"obbgs_core.{room}" for room in ("render", "poses", "evidence", "published", "start", "methods")},
    "obbgs_core.io": CORE | {"obbgs_core.render"},
    "obbgs_core.inspect": CORE,
    "obbgs_core.score": CORE | {"obbgs_core.render", "obbgs_core.poses"},
    "obbgs_core.mesh": CORE | {"obbgs_core.render", "obbgs_core.score"},
    "flightsw.icd": {"obbgs_base"},
    "flightsw.icd.link": {"obbgs_base", "flightsw.icd"},
    "flightsw.icd.transfer": {"obbgs_base", "flightsw.icd", "flightsw.icd.link"},
    "flightsw.icd.ndm": {"obbgs_base", "flightsw.icd"},
    "flightsw.ports": {"obbgs_base", "flightsw.icd.link"},
    "flightsw.errors": {"obbgs_base"},
    "flightsw.clock": set(),
    "flightsw.cameras": {"obbgs_base", "flightsw.icd", "flightsw.errors", "flightsw.clock"},
    "flightsw.storage": CONTRACT | {"flightsw.errors"},
    "flightsw.navigation": {"obbgs_base", "flightsw.icd", "flightsw.icd.ndm", "flightsw.errors"},
    "flightsw.capture": {"obbgs_base", "flightsw.icd", "flightsw.errors", "flightsw.cameras"}
    | {"flightsw.navigation", "flightsw.storage"},
    "flightsw.triage": {"obbgs_base", "flightsw.icd", "flightsw.errors", "flightsw.storage"},
    "flightsw.downlink": CONTRACT
    | {"flightsw.icd.link", "flightsw.ports", "flightsw.errors", "flightsw.clock"}
    | {"flightsw.storage", "flightsw.triage"},
    "flightsw": {"obbgs_base", "flightsw.icd"}
    | {
        "flightsw.icd.ndm",
        "flightsw.icd.link",
        "flightsw.ports",
        "flightsw.errors",
        "flightsw.clock",
        "flightsw.cameras",
    }
    | {f"flightsw.{room}" for room in ("storage", "navigation", "capture", "triage", "downlink")},
    "ground.session": {"obbgs_base", "flightsw.icd", "obbgs_core", "obbgs_core.model", "obbgs_core.render"},
    "ground.link": CONTRACT | {"flightsw.icd.link", "flightsw.ports", "ground.session"},
    "ground.formats": {"obbgs_base", "flightsw.icd", "flightsw.icd.ndm", "ground.session"},
    "ground.run": {
        "obbgs_base",
        "flightsw.icd",
        "flightsw.icd.ndm",
        "flightsw.icd.link",
        "ground.session",
        "ground.link",
        "obbgs_core.attitude",
        "obbgs_core.start",
        "obbgs_core.mesh",
    }
    | LIBRARY,
    "ground.show": {
        "obbgs_base",
        "flightsw.icd",
        "ground.session",
        "ground.link",
        "ground.run",
        "obbgs_core.inspect",
    }
    | LIBRARY - {"obbgs_core.train"}
    | {"obbgs_core.attitude"},
    "ground.commands": {
        "obbgs_base",
        "flightsw.icd",
        "flightsw.icd.link",
        *GROUND,
        "ground.link",
        "ground.run",
        "ground.show",
    }
    | {"obbgs_core", "obbgs_core.train"},
    "ground": {"obbgs_base", "flightsw.icd", "ground.link", "ground.commands"},
    "compare.opponents": CORE
    | {"obbgs_core.start", "obbgs_core.score", "obbgs_core.poses", "ground.formats"},
    "compare": {"obbgs_base", "flightsw.icd", "ground.session", "ground.run", "compare.opponents"} | LIBRARY,
    "compare.grid": CORE
    | {"obbgs_core.render", "ground.session", "ground.run", "compare", "compare.opponents"},
    "compare.charts": {"obbgs_base", "ground.show", "compare", "compare.grid"},
    "compare.command": {"obbgs_base", "ground.commands", "compare", "compare.grid", "compare.charts"},
    "hil.watched": {"obbgs_base"},
    "hil.sky": {"obbgs_base", "flightsw.icd"},
    "hil.world": {
        "obbgs_base",
        "flightsw.icd",
        "flightsw.navigation",
        "flightsw.capture",
        "flightsw.cameras",
    },
    "hil.links": {"obbgs_base", "flightsw.icd.link", "hil.watched"},
    "hil.cameras": {
        *("obbgs_base", "flightsw.icd", "flightsw.cameras", "flightsw.errors"),
        "flightsw.navigation",
        *("hil.sky", "hil.world", "hil.watched"),
    },
    "hil": {
        *(
            "obbgs_base",
            "flightsw.icd",
            "flightsw.navigation",
            "flightsw.capture",
            "ground.session",
            "ground.formats",
            "ground.show",
        ),
        *("hil.sky", "hil.world", "hil.links", "hil.cameras"),
    },
}


@cache
def modules() -> dict[str, Path]:
    """Return the product's modules by their dotted names."""
    found = {}
    for part in PARTS:
        for path in sorted((ROOT / part).rglob("*.py")):
            name = ".".join(path.relative_to(ROOT).with_suffix("").parts)
            found[name.removesuffix(".__init__")] = path
    return found


@cache
def imports(module: str) -> frozenset[str]:
    """Return which of the product's modules a module imports, anywhere in its text."""
    names = set()
    for node in ast.walk(ast.parse(modules()[module].read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{module}: imports are absolute here"
            for alias in node.names:
                whole = f"{node.module}.{alias.name}"
                names.add(whole if whole in modules() else str(node.module))
    return frozenset(name for name in names if name in modules() and name != module)


def room(module: str) -> str:
    """Return the innermost room that a module stands in."""
    return max((r for r in ARROWS if f"{module}.".startswith(f"{r}.")), key=len)


@pytest.mark.parametrize("module", modules())
def test_a_room_imports_only_the_rooms_it_may(module):
    allowed = ARROWS[room(module)] | {room(module)}
    wrong = {name for name in imports(module) if room(name) not in allowed}
    assert not wrong, f"{module} (room {room(module)}) imports {', '.join(sorted(wrong))}"


def test_every_arrow_between_rooms_is_used():
    """An arrow that nothing uses any more is taken out; every room may use the foundations, used or not."""
    used = {(room(module), room(name)) for module in modules() for name in imports(module)}
    idle = {(a, b) for a, targets in ARROWS.items() for b in targets if (a, b) not in used}
    assert {(a, b) for a, b in idle if b not in CORE} == set()


def test_no_module_is_part_of_a_cycle():
    tuple(graphlib.TopologicalSorter({m: imports(m) for m in modules()}).static_order())  # raises CycleError


def sources() -> list[Path]:
    kernels = (p for p in (ROOT / "obbgs_core").rglob("*") if p.suffix in (".cpp", ".h"))
    return [*modules().values(), *sorted(kernels)]


def test_no_file_is_longer_than_a_reader_can_hold():
    lengths = {str(p.relative_to(ROOT)): len(p.read_text().splitlines()) for p in sources()}
    assert {name: n for name, n in lengths.items() if n > LONGEST_FILE} == {}


def test_no_folder_holds_more_files_than_a_reader_can_hold():
    files = [p for p in sources() if p.name != "__init__.py"]
    files += [
        p
        for part in PARTS
        for suffix in ("md", "yaml", "html", "js", "css")
        for p in (ROOT / part).rglob(f"*.{suffix}")
    ]
    counts = collections.Counter(str(p.parent.relative_to(ROOT)) for p in files)
    assert {folder: n for folder, n in counts.items() if n > FULLEST_FOLDER} == {}


def test_no_function_is_longer_than_a_screen_and_a_half():
    long = {}
    for name, path in modules().items():
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                lines = (node.end_lineno or node.lineno) - node.lineno + 1
                if lines > LONGEST_FUNCTION:
                    long[f"{name}.{node.name}"] = lines
    assert long == {}


OF_THE_SYSTEM = {
    "OSError",
    "FileNotFoundError",
    "PermissionError",
    "TimeoutError",
    "CanError",
    "CanOperationError",
}
TELLING = {"log.info", "log.warning", "log.error", "str"}


def test_what_the_system_says_is_told_in_words():
    """An error of the system says `[Errno 2] ...: 'FILE'`; `reason` and `in_words` leave the number out."""
    as_it_stands = []
    for name, path in modules().items():
        for handler in ast.walk(ast.parse(path.read_text())):
            if not isinstance(handler, ast.ExceptHandler) or handler.type is None:
                continue
            caught = {getattr(n, "id", getattr(n, "attr", "")) for n in ast.walk(handler.type)}
            if (
                not caught & OF_THE_SYSTEM or name == "hil.sky.blender_worker"
            ):  # Blender's Python has no obbgs_base
                continue
            for node in ast.walk(handler):
                told = [node.value] if isinstance(node, ast.FormattedValue) and node.conversion == -1 else []
                if (
                    isinstance(node, ast.Call)
                    and ast.unparse(node.func) in TELLING
                    and "%r" not in ast.unparse(node)
                ):
                    told = node.args
                if any(isinstance(each, ast.Name) and each.id == handler.name for each in told):
                    as_it_stands.append(f"{name}:{node.lineno}")
    assert as_it_stands == []
