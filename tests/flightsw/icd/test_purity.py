"""What `icd/README.md` says of this folder: the files it reads, no clock, and that it touches nothing else."""

import ast
import json
import subprocess
import sys
from pathlib import Path

ICD = Path(__file__).parents[3] / "flightsw" / "icd"
OUTSIDE = {"asyncio", "can", "os", "select", "serial", "socket", "subprocess", "threading", "time"}
READING = {
    "open",
    "read_bounded",
    "read_bytes",
    "read_text",
    "iterdir",
    "glob",
    "rglob",
    "exists",
    "is_file",
    "stat",
}
WRITING = {"write_bytes", "write_text", "touch", "mkdir", "unlink", "rename", "replace_file"}
CLOCKS = {"now", "today", "utcnow", "monotonic", "perf_counter", "time_ns"}


def test_the_code_reads_two_files_and_names_no_clock_port_or_thread():
    imported, called = set(), set()
    for path in sorted(ICD.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import):
                imported |= {(path.name, alias.name.partition(".")[0]) for alias in node.names}
            elif isinstance(node, ast.ImportFrom):
                imported.add((path.name, (node.module or "").partition(".")[0]))
            elif isinstance(node, ast.Call):
                function = node.func
                name = function.attr if isinstance(function, ast.Attribute) else getattr(function, "id", "")
                called.add((path.name, name))
    assert {entry for entry in imported if entry[1] in OUTSIDE} == set()
    assert {entry for entry in imported if entry[1] == "isotp"} == {
        ("can.py", "isotp"),
        ("slcan.py", "isotp"),
    }
    assert {entry for entry in called if entry[1] in READING | WRITING | CLOCKS} == {
        ("mission.py", "read_bounded"),
        ("telemetry.py", "read_bytes"),
    }
    text = " ".join((ICD / "README.md").read_text().split())
    assert (
        "It reads two files, `dictionary.yaml` when `telemetry.py` is imported and the mission file in"
        in text
    )
    assert "and no clock: bytes and times are passed in" in text


def test_importing_all_of_it_opens_only_the_dictionary():
    """Seen by Python's own audit; modules and what other packages bring along are left out."""
    paths = sorted(path.relative_to(ICD).with_suffix("") for path in ICD.rglob("[a-z]*.py"))
    modules = [".".join(("flightsw.icd", *path.parts)) for path in paths]
    code = f"""
import importlib, json, sys
opened = []
sys.addaudithook(lambda event, given: opened.append(str(given[0])) if event == "open" else None)
for module in {modules!r}:
    importlib.import_module(module)
print(json.dumps(opened))
"""
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ICD.parents[1]
    )
    opened = {Path(path).name for path in json.loads(done.stdout) if Path(path).is_relative_to(ICD)}
    assert {name for name in opened if not name.endswith((".py", ".pyc"))} == {"dictionary.yaml"}
