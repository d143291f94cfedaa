"""Whole comparisons through the command line: a killed worker, Ctrl-C, and folders that go on."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import dask.config
import pytest
from distributed import Client
from distributed.security import Security
from typer.testing import CliRunner

from ground import cli
from ground.run.cluster import ClusterError, connected, share_memory
from obbgs_base.command_line import in_words
from tests.commands import call
from tests.small_sessions import small_session

pytestmark = pytest.mark.timeout(900)  # half a minute on an idle core
ENVIRONMENT = os.environ | {"OMP_WAIT_POLICY": "passive", "OMP_NUM_THREADS": "1"}
LONG = ["--methods", "black,3dgs", "--budgets", "0.02@400"]  # 600 steps: some seconds


@pytest.fixture
def compare() -> Iterator[Callable[..., subprocess.Popen]]:
    """Starts `ground compare`; whatever still runs at the end of the test is killed."""
    started: list[subprocess.Popen] = []

    def start(*arguments: str | Path, **options) -> subprocess.Popen:
        command = [sys.executable, "-m", "ground.cli", "compare", *map(str, arguments)]
        pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
        started.append(subprocess.Popen(command, env=ENVIRONMENT, **pipes, **options))
        return started[-1]

    yield start
    for process in started:
        process.kill()
        process.communicate()


def rows_of(folder: Path) -> list[dict]:
    return [json.loads(line) for line in (folder / "rows.jsonl").read_text().splitlines()]


def await_that(ready: Callable[[], object], process: subprocess.Popen) -> None:
    """Wait until something is the case, as long as a process runs and for at most ten minutes."""
    until_s = time.monotonic() + 600
    while not ready():
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < until_s, "nothing happened in time"
        time.sleep(0.1)


def training_under_way(folder: Path) -> list[dict]:
    """Return what the trainings that have a checkpoint told of their progress."""
    told = []
    for checkpoint in folder.glob("work/*/training.checkpoint"):
        path = checkpoint.with_name("progress.json")
        if path.exists() and (text := path.read_text()):
            told.append(json.loads(text))
    return told


@pytest.fixture(scope="module")
def sessions(tmp_path_factory) -> list[Path]:
    folder = tmp_path_factory.mktemp("sessions")
    return [small_session(folder / f"target-{seed}", seed) for seed in range(2)]


@pytest.fixture
def scheduler(tmp_path) -> Iterator[str]:
    """A dask scheduler and two workers, each a process of its own."""
    dask = [sys.executable, "-m", "distributed.cli"]
    file = tmp_path / "scheduler.json"
    quiet = {"env": ENVIRONMENT, "stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    modules = ("dask_scheduler", "--port", "0", "--no-dashboard", "--scheduler-file", str(file))
    processes = [subprocess.Popen([*dask[:2], f"distributed.cli.{modules[0]}", *modules[1:]], **quiet)]
    await_that(file.exists, processes[0])
    address = json.loads(file.read_text())["address"]
    worker = [
        *dask[:2],
        "distributed.cli.dask_worker",
        address,
        "--no-nanny",
        "--no-dashboard",
        "--nthreads",
        "1",
    ]
    processes += [subprocess.Popen([*worker, "--local-directory", str(tmp_path)], **quiet) for _ in range(2)]
    yield address
    for process in processes:
        process.kill()
        process.wait()


def test_a_grid_survives_a_killed_worker_and_is_not_made_twice(sessions, scheduler, compare, tmp_path):
    out, conditions = tmp_path / "out", tmp_path / "conditions.yaml"
    conditions.write_text("as taken: {}\nnoise x2: {noise: 2}\n")
    grid = [*sessions, *LONG, "--conditions", conditions, "--out", out]
    running = compare(*grid, "--workers", scheduler)
    await_that(lambda: training_under_way(out), running)
    os.kill(training_under_way(out)[0]["pid"], signal.SIGKILL)
    _, told = running.communicate()
    assert running.returncode == 0, told
    rows = rows_of(out)
    assert len({row["digest"] for row in rows}) == len(rows) == 8
    assert {(r["method"], r["target"], r["condition"]) for r in rows} == {
        (method, f"target-{seed}", condition)
        for method in ("black", "3dgs")
        for seed in range(2)
        for condition in ("as taken", "noise x2")
    }
    trained = [row for row in rows if row["method"] == "3dgs"]
    assert any(row.get("resumed_at", 0) > 0 for row in trained)  # that of the killed worker
    assert all(row["seconds"] > 0 and row["curve"][-1]["share"] == 1 for row in trained)
    assert not list(out.glob("work/*/training.checkpoint"))  # finished trainings need none

    again = CliRunner().invoke(cli.app, ["compare", *map(str, grid), "--json", "--workers", "1"])
    assert again.exit_code == 0, again.output
    assert json.loads(again.stdout) | {"page": ""} == {
        "rows": str(out / "rows.jsonl"), "page": "", "made": 0, "were_done": 8, "failed": {}
    }  # fmt: skip


def test_ctrl_c_saves_a_training_and_the_same_command_goes_on(sessions, compare, tmp_path):
    out = tmp_path / "out"
    grid = [
        sessions[0],
        "--methods",
        "3dgs",
        "--budgets",
        "0.06@400",  # long enough that the signal arrives before the end
        "--workers",
        "1",
        "--out",
        out,
    ]
    running = compare(*grid, start_new_session=True)
    await_that(lambda: training_under_way(out), running)
    os.killpg(running.pid, signal.SIGINT)  # as a terminal does: the workers get it too
    _, told = running.communicate()
    assert running.returncode == 1
    assert "the same command goes on from there" in told and "Traceback" not in told
    assert rows_of(out) == [] if (out / "rows.jsonl").exists() else True
    saved = training_under_way(out)
    assert len(saved) == 1

    running = compare(*grid)
    _, told = running.communicate()
    assert running.returncode == 0, told
    (row,) = rows_of(out)
    assert row["resumed_at"] >= saved[0]["share"] * row["steps"] - 1


def test_a_scheduler_that_dies_is_one_sentence_and_the_same_command_goes_on(sessions, compare, tmp_path):
    file, out = tmp_path / "scheduler.json", tmp_path / "out"
    quiet = {"env": ENVIRONMENT, "stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    module = [sys.executable, "-m", "distributed.cli.dask_scheduler", "--port", "0", "--no-dashboard"]
    scheduler = subprocess.Popen([*module, "--scheduler-file", str(file)], **quiet)
    await_that(file.exists, scheduler)
    address = json.loads(file.read_text())["address"]
    running = compare(sessions[0], *LONG, "--out", out, "--workers", address)
    await_that(lambda: (out / "work").is_dir(), running)  # no worker takes its cells
    scheduler.kill()
    scheduler.wait()
    _, told = running.communicate()
    assert running.returncode == 1 and "Traceback" not in told, told
    assert "the same command goes on" in told
    assert f"the scheduler {address} has its workers run code" in told and "should stand at tls://" in told


@pytest.mark.parametrize(
    ("workers", "needs", "available", "expected"),
    [
        (4, [100, 900], 2000, (2, 1000)),
        (4, [100], 2000, (4, 500)),
        (2, [1900], 2000, (1, 2000)),
        (3, [], 9, (3, 3)),
    ],
)
def test_no_more_workers_are_started_than_the_memory_holds(workers, needs, available, expected):
    assert share_memory(workers, needs, available) == expected


def test_a_cell_that_the_memory_does_not_hold_is_refused():
    with pytest.raises(ClusterError, match=r"about 2\.0 GB of memory, 1\.0 GB are available"):
        share_memory(2, [2000], 1000)


def test_the_command_refuses_to_compare_no_method(sessions, tmp_path):
    done = call("ground", "compare", str(sessions[0]), "--methods", " ,", "--out", str(tmp_path / "out"))
    assert done.returncode == 1 and "no method is named" in done.stderr and not (tmp_path / "out").exists()


def test_processes_that_do_not_start_in_time_are_told_in_one_sentence(monkeypatch):
    def busy(**settings):
        raise TimeoutError

    monkeypatch.setattr("ground.run.cluster.LocalCluster", busy)
    with pytest.raises(ClusterError, match=r"did not start in time.* the same command tries again"):
        connected(None, 1, [10.0], "compare.grid.local_worker").__enter__()
    assert in_words(TimeoutError()) == "TimeoutError"


def test_a_comparison_s_own_cluster_takes_only_its_own_credentials():
    """A scheduler has its workers run whatever a client sends."""
    with connected(None, 1, [10.0], "compare.grid.local_worker") as client:
        address = client.scheduler_info()["address"]
        assert address.startswith("tls://") and client.submit(max, 3, 7).result() == 7
        plain = {"address": address.replace("tls://", "tcp://")}
        with dask.config.set({"distributed.comm.timeouts.connect": "2s"}):
            for stranger in (plain, {"address": address, "security": Security.temporary()}):
                with pytest.raises(OSError):
                    Client(**stranger, timeout="2s", set_as_default=False)
