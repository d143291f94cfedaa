"""No process that a benchmark or a demo starts outlives it, however it ends; tested with real processes."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from hil.processes import tied
from tests.commands import call

ROOT = Path(__file__).parents[2]
pytestmark = pytest.mark.skipif(
    sys.platform != "linux", reason="needs /proc and the kernel's parent-death signal"
)


def parent_of(pid: int) -> int | None:
    """Return the parent's number, None if the process has ended (a zombie has)."""
    try:
        state, parent = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[:2]
    except OSError:
        return None
    return None if state in "ZX" else int(parent)


def descendants(pid: int) -> dict[int, str]:
    """Return the command lines of the running processes below `pid`, by number."""
    parents = {int(path.name): parent_of(int(path.name)) for path in Path("/proc").glob("[0-9]*")}
    found = {pid}
    while more := {child for child, parent in parents.items() if parent in found} - found:
        found |= more
    lines = {}
    for child in found - {pid}:
        try:
            lines[child] = Path(f"/proc/{child}/cmdline").read_bytes().replace(b"\0", b" ").decode()
        except OSError:
            continue
    return lines


def wait_for(condition, limit_s: float = 60.0) -> None:
    end_s = time.monotonic() + limit_s
    while not condition():
        assert time.monotonic() < end_s, "the condition was not met in time"
        time.sleep(0.02)


def end_in_the_middle(command: list[str], number: int, tmp_path: Path) -> int:
    """Send a signal to a command while its flight and ground processes run; return how it ended.

    Fails if any of its descendants survives.
    """
    with open(tmp_path / "log", "wb") as log:
        process = subprocess.Popen(
            command,
            cwd=ROOT,
            env=os.environ | {"TMPDIR": str(tmp_path)},
            stdout=log,
            stderr=log,
            # a shell that starts the tests in the background lets them ignore Ctrl-C, and the command would inherit it
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
        )
    started: dict[int, str] = {}
    try:

        def both_run() -> bool:
            assert process.poll() is None, (tmp_path / "log").read_text()
            started.update(descendants(process.pid))
            lines = [line for line in descendants(process.pid).values() if "prctl" not in line]
            return any("flightsw" in line for line in lines) and any("listen" in line for line in lines)

        wait_for(both_run)
        process.send_signal(number)
        process.wait(60)
        wait_for(lambda: all(parent_of(pid) is None for pid in started), 20.0)
    finally:
        for pid in [process.pid, *started]:
            if parent_of(pid) is not None:
                os.kill(pid, signal.SIGKILL)
        process.wait()
    return process.returncode


BENCHMARK = [sys.executable, "-m", "tests.benchmarks.link", "--quick", "--clean", "--link", "can"]


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_link_benchmark_that_is_terminated_ends_its_processes_and_removes_its_files(number, tmp_path):
    assert end_in_the_middle(BENCHMARK, number, tmp_path) != 0
    assert [path.name for path in tmp_path.iterdir()] == ["log"]


def test_a_link_benchmark_that_is_killed_takes_its_processes_with_it(tmp_path):
    assert end_in_the_middle(BENCHMARK, signal.SIGKILL, tmp_path) == -signal.SIGKILL


def test_a_demo_that_is_terminated_ends_blender_flight_and_ground(small_mission, tmp_path):
    text = (tmp_path / "small.yaml").read_text().replace("count: 40", "count: 2")
    (tmp_path / "small.yaml").write_text(text)
    # two brackets with 54 s between them: the pass is still under way when the signal comes
    options = [
        "--mission",
        str(tmp_path / "small.yaml"),
        "--out",
        str(tmp_path / "demo"),
        "--real-time",
        "0.5",
    ]
    command = [str(Path(sys.executable).with_name("hil")), "demo", *options]
    assert end_in_the_middle(command, signal.SIGTERM, tmp_path) == 128 + signal.SIGTERM


def test_a_tied_process_is_the_command_itself():
    process = subprocess.Popen(
        tied([sys.executable, "-c", "import os, sys; print(os.getpid()); sys.exit(int(sys.argv[1]))", "7"]),
        stdout=subprocess.PIPE,
        text=True,
    )
    assert int(process.communicate(timeout=60)[0]) == process.pid
    assert process.returncode == 7


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["dataset", "--out", "{tmp}", "--set", "frames=-3"], "dataset.frames"),
        (["scenario", "--fly-around", "200,-5", "--out", "{tmp}"], "--fly-around"),
        (["link", "--rate", "99999999999999999999"], "--rate"),
        (["link", "--faults", "seed=-1"], "--faults"),
    ],
)
def test_a_number_out_of_range_is_refused_before_anything_is_done(tmp_path, arguments, told):
    done = call("hil", *[a.replace("{tmp}", str(tmp_path / "out")) for a in arguments])
    assert done.returncode == 2 and told in done.stderr
    assert not (tmp_path / "out").exists()
