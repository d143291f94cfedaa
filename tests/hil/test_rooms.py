"""The arrows between the rooms of `hil`, as its docstring says: read from the import statements, lazy ones included."""

import ast
from pathlib import Path

import pytest

HIL = Path(__file__).parents[2] / "hil"
MAY_IMPORT = {
    "world": set(),
    "sky": set(),
    "links": {"watched"},
    "cameras": {"world", "sky", "watched"},
    "choices": set(),
    "processes": set(),
    "progress": set(),
    "watched": set(),
    "truth": {"sky"},
    "simulated_pass": {"cameras", "choices", "links", "processes", "progress", "world"},
    "demo": {"processes", "progress", "simulated_pass", "sky", "truth", "world"},
    "dataset": {"choices", "sky", "truth", "world"},
}


def imported_parts(file: Path) -> set[str]:
    """Return the rooms and modules directly in `hil` that a file imports."""
    names = set()
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module == "hil":
            names |= {f"hil.{alias.name}" for alias in node.names if alias.name != "SHIPPED"}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names.add(node.module)
    return {name.split(".")[1] for name in names if name.startswith("hil.")}


@pytest.mark.parametrize("part", MAY_IMPORT)
def test_a_part_of_the_simulator_imports_only_what_it_may(part):
    files = (HIL / part).rglob("*.py") if (HIL / part).is_dir() else [HIL / f"{part}.py"]
    found = {file.name: imported_parts(file) - MAY_IMPORT[part] - {part} for file in files}
    assert found and not any(found.values()), found


def test_every_part_has_its_arrows():
    parts = {path.stem for path in HIL.iterdir() if path.suffix == ".py" or (path / "__init__.py").exists()}
    assert parts == set(MAY_IMPORT) | {"__init__", "cli"}
