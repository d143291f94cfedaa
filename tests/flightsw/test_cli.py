"""The flight command line: help with examples, exit codes, one clear line for what went wrong."""

import os
import subprocess
import sys
import threading
import tty
from pathlib import Path

import pytest

from flightsw.cli import log_dead_thread
from tests.commands import call

NOWHERE = ("--camera", "hil:///nowhere.sock")


@pytest.mark.parametrize("tool", ["flightsw", "ground", "hil"])
def test_each_tool_is_installed_and_says_its_version(tool):
    command = [str(Path(sys.executable).with_name(tool)), "--version"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0 and done.stdout.startswith("obbgs ")


@pytest.mark.parametrize(
    ("tool", "command"),
    [("flightsw", c) for c in ("capture", "serve", "downlink", "triage", "plan", "fsck", "selftest")]
    + [("ground", c) for c in ("listen", "key", "uplink", "reconstruct", "evaluate", "report")]
    + [("hil", c) for c in ("demo", "camera", "link", "target")],
)
def test_every_command_has_help_with_an_example(tool, command):
    done = call(tool, command, "--help")
    assert done.returncode == 0 and f"Example: {tool} {command}" in done.stdout


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (["plan", "--mission", "nowhere.yaml"], 2, "nowhere.yaml: cannot read the mission file"),
        (
            ["capture", "--camera", "hil:///nowhere.sock", "--store", "{tmp}"],
            1,
            "no camera at hil:///nowhere.sock",
        ),
        (["capture", "--camera", "ftp://x", "--store", "{tmp}"], 2, "no camera driver for 'ftp://x'"),
        (
            ["capture", "--camera", "hil://", "--store", "{tmp}"],
            2,
            "expected hil:///path/to/socket or hil://host:port",
        ),
        (["capture", "--camera", "hil://h:99999", "--store", "{tmp}"], 2, "host:port, got 'hil://h:99999'"),
        (
            ["capture", "--camera", "hil:///x", "--bracket", "inf"],
            2,
            "--bracket[0]: expected 0.001 to 60000 ms",
        ),
        (
            ["downlink", "--link", "serial:///dev/null", "--store", "{tmp}", "--exit-when-empty"],
            1,
            "cannot open /dev/null: Could not configure port: Inappropriate ioctl for device",
        ),
        (
            ["capture", "--camera", "hil:///x", "--bracket", "0.05,two", "--store", "{tmp}"],
            2,
            "--bracket: expected",
        ),
        (
            ["capture", "--camera", "hil:///x", "--bracket", "-1", "--store", "{tmp}"],
            2,
            "--bracket[0]: expected 0.001 to 60000 ms, got -1.0",
        ),
        (
            ["capture", "--camera", "hil:///x", "--count", "0", "--store", "{tmp}"],
            2,
            "--count: expected 1 to",
        ),
        (
            [
                "downlink",
                "--link",
                "serial:///dev/nowhere?baud=9600",
                "--exit-when-empty",
                "--store",
                "{tmp}",
            ],
            1,
            "/dev/nowhere",
        ),
        (["downlink", "--link", "carrier://pigeon", "--store", "{tmp}"], 2, "carrier://pigeon"),
        (["triage", "--model", "nowhere.onnx", "--store", "{tmp}"], 1, "nowhere.onnx"),
        (["serve", "--camera", "ftp://x", "--link", "can://nowhere", "--store", "{tmp}"], 2, "ftp://x"),
        (
            ["serve", *NOWHERE, "--link", "can://x", "--start", "soon", "--store", "{tmp}"],
            2,
            "--start: expected",
        ),
        (["fsck", "--store", "{tmp}"], 1, "is no frame store"),
        (["frobnicate"], 2, "frobnicate"),
    ],
)
def test_what_goes_wrong_is_one_clear_line_and_an_exit_code(tmp_path, arguments, code, message):
    done = call("flightsw", *[a.replace("{tmp}", str(tmp_path / "store")) for a in arguments])
    assert done.returncode == code, done.stderr
    assert message in done.stderr and "Traceback" not in done.stderr
    assert not (tmp_path / "store").exists(), "a command that cannot start leaves no store behind"


def test_a_thread_that_dies_is_an_error_in_the_log(monkeypatch, caplog):
    monkeypatch.setattr(threading, "excepthook", log_dead_thread)
    thread = threading.Thread(target=lambda: 1 / 0, name="farewell")
    thread.start()
    thread.join()
    (record,) = caplog.records
    assert record.levelname == "ERROR" and record.name.startswith("flightsw")  # so an event for the ground
    assert record.getMessage() == "the thread farewell has ended: ZeroDivisionError('division by zero')"


def test_flight_that_serves_waits_for_its_link(tmp_path, small_mission):
    """A radio that its bus finds late: the pass is not given up for it."""
    arguments = ["serve", *NOWHERE, "--link", f"serial://{tmp_path}/tty", "--store", str(tmp_path / "store")]
    flight = subprocess.Popen(
        [sys.executable, "-m", "flightsw.cli", *arguments, "--mission", str(tmp_path / "small.yaml")],
        stderr=subprocess.PIPE,
        text=True,
    )
    master, slave = os.openpty()
    tty.setraw(slave)
    try:
        assert flight.stderr is not None
        while "is awaited" not in (line := flight.stderr.readline()):
            assert line, "flight has ended"
        (tmp_path / "tty").symlink_to(os.ttyname(slave))
        assert os.read(master, 1) == b"\0"  # the end of whatever came before: flight has opened it
    finally:
        flight.terminate()
        flight.communicate(timeout=60)
        for descriptor in (master, slave):
            os.close(descriptor)
