"""What the service manager hears of the flight software, and when it no longer hears that it is alive."""

import os
import shutil
import socket
import subprocess
import threading
from pathlib import Path

import pytest

from flightsw.icd.mission import load_mission
from flightsw.run import run_pass
from flightsw.watchdog import Watchdog, notify

ROOT = Path(__file__).parents[2]
UNIT = ROOT / "flightsw" / "obbgs-flight.service"


@pytest.fixture
def manager(tmp_path, monkeypatch):
    """The service manager's socket."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listening:
        listening.bind(str(tmp_path / "notify"))
        listening.settimeout(20)
        monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
        yield listening


def test_a_loop_that_is_overdue_silences_the_watchdog_until_it_reports(manager):
    now_s = [0.0]
    watchdog = Watchdog(clock_s=lambda: now_s[0])
    manager.setblocking(False)
    watchdog.expect("capture", 10.0)
    watchdog.alive()
    assert manager.recv(100) == b"WATCHDOG=1"
    now_s[0] = 10.5
    watchdog.alive()
    with pytest.raises(BlockingIOError):
        manager.recv(100)
    watchdog.expect("capture", 1.0)
    watchdog.alive()
    assert manager.recv(100) == b"WATCHDOG=1"
    now_s[0] = 1000.0
    watchdog.ended("capture")
    watchdog.alive()
    assert manager.recv(100) == b"WATCHDOG=1"


def test_the_downlink_says_ready_then_alive_then_stopping(manager, tmp_path):
    ours, theirs = os.openpty()
    stop = threading.Event()
    flight = threading.Thread(
        target=run_pass,
        args=(load_mission(ROOT / "mission.yaml"), tmp_path / "store", stop),
        kwargs={"link_url": f"serial://{os.ttyname(theirs)}?baud=115200"},
    )
    flight.start()
    try:
        heard = [manager.recv(100) for _ in range(4)]
        stop.set()
        while heard[-1] != b"STOPPING=1":
            heard.append(manager.recv(100))
    finally:
        stop.set()
        flight.join(timeout=20)
        os.close(ours)
        os.close(theirs)
    assert heard.count(b"READY=1") == 1 and heard.count(b"WATCHDOG=1") >= 3
    assert set(heard) == {b"READY=1", b"WATCHDOG=1", b"STOPPING=1"}


def test_nothing_fails_without_a_manager_or_when_it_is_gone(monkeypatch, tmp_path, caplog):
    monkeypatch.delenv("NOTIFY_SOCKET", raising=False)
    notify("READY=1")
    assert caplog.records == []
    monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "nobody"))
    notify("READY=1")
    assert "was not told READY=1" in caplog.text


def test_systemd_finds_no_fault_in_the_unit():
    if shutil.which("systemd-analyze") is None:
        pytest.skip("systemd-analyze is not installed")
    arguments = ["systemd-analyze", "verify", "--man=no", str(UNIT)]
    done = subprocess.run(arguments, capture_output=True, text=True, timeout=60)
    about_it = [line for line in (done.stdout + done.stderr).splitlines() if UNIT.name in line]
    assert about_it == [] and done.returncode == 0, done.stderr
