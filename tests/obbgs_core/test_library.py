"""The library's own door: its example runs as it is written, every public name is there, and importing it is quick."""

import doctest
import subprocess
import sys

import obbgs_core


def test_the_example_of_the_docstring_runs():
    results = doctest.testmod(obbgs_core)
    assert results.attempted > 10 and results.failed == 0


def test_every_public_name_is_there_and_no_other():
    assert all(getattr(obbgs_core, name).__name__ == name for name in obbgs_core.__all__ if name != "PRESETS")
    assert "obbgs" in obbgs_core.PRESETS and not hasattr(obbgs_core, "magic")


def test_the_library_is_imported_without_torch():
    code = "import sys, obbgs_core; assert 'torch' not in sys.modules"
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0
