"""A folder is held by one command at a time, and by none that has ended; with real processes."""

import subprocess
import sys
from pathlib import Path

import pytest

from obbgs_base.locks import LOCK, InUse, one_command_in

HOLD = """
import sys, time
from pathlib import Path
from obbgs_base.locks import one_command_in
with one_command_in(Path(sys.argv[1]), "hil"):
    print("held", flush=True)
    time.sleep(600)
"""


def test_a_folder_that_another_process_holds_is_refused_until_that_is_killed(tmp_path):
    out = tmp_path / "out"
    with subprocess.Popen(
        [sys.executable, "-c", HOLD, str(out)], stdout=subprocess.PIPE, text=True
    ) as holder:
        try:
            assert holder.stdout is not None and holder.stdout.readline() == "held\n"
            with (
                pytest.raises(InUse, match=f"another hil command works in {out}: wait"),
                one_command_in(out, "hil"),
            ):
                pass
        finally:
            holder.kill()
    assert (out / LOCK).exists()  # what it left holds nobody up
    with one_command_in(out, "hil"):
        pass


def test_a_process_that_the_holder_started_does_not_hold_the_folder(tmp_path):
    with one_command_in(tmp_path, "hil"):
        child = subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE)
    with child, one_command_in(tmp_path, "hil"):
        assert child.poll() is None
        assert child.stdin is not None
        child.stdin.close()


def test_a_file_in_the_place_of_the_folder_is_told(tmp_path):
    (tmp_path / "out").write_bytes(b"")
    with (
        pytest.raises(NotADirectoryError, match="is a file: give a folder"),
        one_command_in(tmp_path / "out", "hil"),
    ):
        pass


def test_a_folder_is_left_as_it_was(tmp_path):
    made, found = tmp_path / "made" / "here", tmp_path / "found"
    found.mkdir()
    for folder in (made, found):
        with one_command_in(folder, "hil"):
            assert [path.name for path in folder.iterdir()] == [LOCK]
    assert not made.exists() and list(found.iterdir()) == []
    with one_command_in(made, "hil"):
        (made / "result").touch()
    assert [path.name for path in made.iterdir()] == ["result"]


def test_a_lock_file_that_was_removed_meanwhile_holds_nothing(tmp_path):
    """The one who waits for it opens the file of the next."""
    with one_command_in(tmp_path, "hil"):
        Path(tmp_path / LOCK).unlink()
        with one_command_in(tmp_path, "hil"):
            assert (tmp_path / LOCK).exists()
