"""`flightsw selftest` with real ports, disks and sockets: what it finds when all is well, and what can fail."""

import contextlib
import dataclasses
import errno
import json
import os
import random
import socket
import subprocess
import threading
import time
import types
from collections.abc import Callable, Iterator
from pathlib import Path

import can
import numpy as np
import pytest
from typer.testing import CliRunner

from flightsw.capture.planning import pass_plan
from flightsw.cli import app
from flightsw.errors import OrbitError
from flightsw.icd.config import ConfigError
from flightsw.icd.link.can import FLIGHT_SIDE, GROUND_SIDE
from flightsw.icd.mission import NavigationSection, StoreSection
from flightsw.ports import LinkError, open_link
from flightsw.selftest import computer, devices, planned_pass, self_test
from tests.small_disk import read_only

ROOT = Path(__file__).parents[2]
NS = 1_000_000_000


@contextlib.contextmanager
def port(answer: Callable[[bytes], bytes]) -> Iterator[str]:
    """Give the URL of a pseudo-terminal whose other side answers what it receives."""
    ours, theirs = os.openpty()
    url = f"serial://{os.ttyname(theirs)}?baud=921600"
    stop = threading.Event()

    def run() -> None:
        os.set_blocking(ours, False)
        while not stop.wait(0.001):
            with contextlib.suppress(BlockingIOError, OSError):
                pending = answer(os.read(ours, 65_536))
                while pending and not stop.is_set():
                    with contextlib.suppress(BlockingIOError):
                        pending = pending[os.write(ours, pending) :]

    thread = threading.Thread(target=run)
    thread.start()
    try:
        yield url
    finally:
        stop.set()
        thread.join()
        os.close(ours)
        os.close(theirs)


@contextlib.contextmanager
def camera(expose: Callable[[float], np.ndarray], slower: float = 1.0, late_s: float = 0.0) -> Iterator[str]:
    """Give the URL of a camera on a socket, which speaks as the simulated one does and shows what `expose` gives."""
    with socket.create_server(("127.0.0.1", 0)) as server:

        def run() -> None:
            with contextlib.suppress(OSError):
                while True:
                    connection, _ = server.accept()
                    with connection, connection.makefile("rwb") as stream:
                        for line in stream:
                            request = json.loads(line)
                            dn = expose(request["exposure_time_s"]).astype("<u2")
                            exposure_s = slower * request["exposure_time_s"]
                            reply = {"ok": True, "height": dn.shape[0], "width": dn.shape[1], "channels": 1}
                            middle_ns = request["start_utc_ns"] + round((exposure_s / 2 + late_s) * NS)
                            reply |= {"exposure_time_s": exposure_s, "mid_exposure_utc_ns": middle_ns}
                            stream.write(json.dumps(reply | {"nbytes": dn.nbytes}).encode() + b"\n")
                            stream.write(dn.tobytes())
                            stream.flush()

        thread = threading.Thread(target=run, daemon=True)
        thread.start()
        yield f"hil://127.0.0.1:{server.getsockname()[1]}"
        server.shutdown(socket.SHUT_RDWR)
        thread.join()


def noisy(exposure_time_s: float) -> np.ndarray:
    """Return a picture of 48x48 with a bright square: 64 DN of black, noise of 8 DN."""
    signal = np.zeros((48, 48))
    signal[10:30, 10:30] = 0.3 * 4e7 * exposure_time_s
    noise = np.random.default_rng(round(exposure_time_s * 1e9)).normal(0, 8, (48, 48))
    return (64 + signal + noise).round().clip(0, 4095).astype(np.uint16)


@pytest.fixture
def in_the_pass(small_mission, monkeypatch) -> None:
    """Let the checks believe that the pass is about to begin, on a machine whose clock is synchronised."""
    clock = types.SimpleNamespace(**{name: getattr(time, name) for name in dir(time)})
    clock.time_ns = lambda: small_mission.orbit.start_utc_ns - 60 * NS
    for module in (computer, planned_pass):
        monkeypatch.setattr(module, "time", clock)
    monkeypatch.setattr(computer, "synchronisation", lambda: (True, 0.002))
    monkeypatch.setattr(os, "getloadavg", lambda: (0.1, 0.1, 0.1))


def test_all_is_well(small_mission, in_the_pass, tmp_path):
    lens = {"fx_px": 1200.0, "fy_px": 1200.0, "cx_px": 24.0, "cy_px": 24.0}  # sees as much as the demo's
    camera_section = dataclasses.replace(small_mission.camera, **lens)
    small_mission = dataclasses.replace(small_mission, camera=camera_section)
    with port(lambda data: data) as link, camera(noisy) as url:
        seen = []
        store = tmp_path / "not yet" / "store"
        findings = self_test(small_mission, store, url, link, loopback=True, on_finding=seen.append)
    assert seen == findings
    assert [(f.check, f.state) for f in findings] == [
        (name, "ok") for name in ("clock", "disk", "computer", "orbit", "view", "link", "camera")
    ], findings
    texts = {f.check: f.found for f in findings}
    assert "came back unchanged" in texts["link"] and "0.05, 0.1, 0.2 ms" in texts["camera"]
    assert "range 433 m" in texts["orbit"]
    assert list(tmp_path.iterdir()) == [tmp_path / "small.yaml"], "nothing is left behind"


@pytest.mark.parametrize(
    ("answer", "loopback", "state", "found"),
    [
        (lambda data: b"", False, "ok", "nothing came from the other side"),
        (lambda data: b"", True, "failed", "none of"),
        (
            lambda data: bytes(b ^ (n % 40 == 7) for n, b in enumerate(data)),
            True,
            "failed",
            "came back whole",
        ),
        (lambda data: b"\0hello\0", False, "ok", "came from the other side"),
    ],
)
def test_what_comes_back_over_the_link(answer, loopback, state, found, monkeypatch):
    monkeypatch.setattr(devices, "ECHO_S", 0.1)
    monkeypatch.setattr(devices, "LOOP_S", 0.5)
    with port(answer) as url:
        (finding,) = devices.check_link(url, loopback, 1100)
    assert finding.state == state and found in finding.found


@pytest.mark.parametrize(("fd", "keeps"), [(0, 1.0), (1, 1.0), (0, 0.5), (0, 0.0)])
def test_packets_go_through_a_can_interface_and_back(fd, keeps, monkeypatch):
    """On python-can's virtual bus, of which a part of the frames is lost."""
    real_bus, rng = can.Bus, random.Random(0)

    def virtual_bus(channel, interface, fd):
        bus = real_bus(channel, interface="virtual")
        send = bus.send
        bus.send = lambda message, timeout=None: send(message, timeout) if rng.random() < keeps else None
        return bus

    monkeypatch.setattr(can, "Bus", virtual_bus)
    monkeypatch.setattr(devices, "LOOP_S", 0.5)
    monkeypatch.setattr(devices, "ECHO_S", 5.0 if keeps == 1 else 0.1)
    monkeypatch.setattr("flightsw.ports.port.CLOSE_S", 0.1)
    url = f"can://self{keeps}{fd}?fd={fd}"
    (finding,) = devices.check_link(url, True, 1100)
    assert finding.state == ("ok" if keeps == 1 else "failed"), finding
    assert (
        "5 packets went through the interface and back" if keeps == 1 else "of 5 packets"
    ) in finding.found
    (finding,) = devices.check_link(url, False, 1100)
    assert finding.state == "ok" and "--loopback tests the interface" in finding.found


@pytest.mark.skipif(not Path("/proc/net/can").exists(), reason="the kernel has no CAN (modprobe can vcan)")
def test_packets_go_through_a_real_virtual_can_interface_and_back():
    add = subprocess.run(["ip", "link", "add", "dev", "obbgs1", "type", "vcan"], capture_output=True)
    if add.returncode:
        pytest.skip(f"no virtual CAN interface: {add.stderr.decode().strip()}")
    try:
        subprocess.run(["ip", "link", "set", "obbgs1", "up"], check=True)
        (finding,) = devices.check_link("can://obbgs1", True, 1100)
        assert finding.state == "ok" and "through the interface and back" in finding.found
    finally:
        subprocess.run(["ip", "link", "del", "obbgs1"], check=True)


@pytest.mark.parametrize(
    ("answer", "state", "found"),
    [
        (lambda data: b"\r" * data.count(b"\r"), "ok", "the adapter answers"),
        (lambda data: b"", "ok", "the adapter says nothing"),
        (lambda data: b"\a" * data.count(b"\r"), "failed", "refuses to open the bus"),
    ],
)
def test_an_slcan_adapter_is_asked_whether_it_opens_the_bus(answer, state, found):
    with port(answer) as url:
        adapter = url.replace("serial://", "slcan://").replace("?baud=921600", "")
        (finding,) = devices.check_link(adapter, False, 1100)
        assert finding.state == state and found in finding.found
        (finding,) = devices.check_link(adapter, True, 1100)
        assert finding.state == "failed" and "returns nobody" in finding.found


@pytest.mark.parametrize("scheme", ["serial", "slcan"])
def test_a_port_that_another_program_holds_is_told_with_what_to_do(scheme, caplog):
    """A real terminal, held as flightsw and ground hold a port."""
    ours, theirs = os.openpty()
    try:
        with open_link(f"serial://{os.ttyname(theirs)}", FLIGHT_SIDE):
            url = f"{scheme}://{os.ttyname(theirs)}"
            (held,) = devices.check_link(url, False, 1100)
            assert held.state == "failed" and held.found.endswith(": another program holds it")
            assert "end that one" in held.advice and "dialout" not in held.advice
            with pytest.raises(LinkError, match="another program holds it; end that one"):
                open_link(url, GROUND_SIDE)
            open_link(url, FLIGHT_SIDE, must_be_there=False).close()
        assert "is awaited: it cannot be opened yet: another program holds it; end that one" in caplog.text
    finally:
        os.close(ours)
        os.close(theirs)


def test_a_port_that_is_missing_hangs_up_or_takes_nothing_is_told_apart(monkeypatch, tmp_path):
    (missing,) = devices.check_link(f"serial://{tmp_path}/ttyX", False, 1100)
    assert missing.state == "failed" and "ttyX" in missing.found and "dialout" in missing.advice
    ours, theirs = os.openpty()
    url = f"serial://{os.ttyname(theirs)}?baud=921600"
    os.close(theirs)
    closing = threading.Timer(0.3, os.close, [ours])
    closing.start()
    (gone,) = devices.check_link(url, False, 1100)
    closing.join()
    assert gone.state == "failed" and "hung up" in gone.found
    monkeypatch.setattr(devices, "ECHO_S", 0.0)
    monkeypatch.setattr(devices, "LOOP_S", 0.5)
    ours, theirs = os.openpty()  # nobody reads: the line is full after some 64 KiB
    try:
        (stuck,) = devices.check_link(f"serial://{os.ttyname(theirs)}?baud=9216000", False, 60_000)
    finally:
        os.close(ours)
        os.close(theirs)
    assert stuck.state == "failed" and "does not take bytes" in stuck.found
    with pytest.raises(ConfigError, match="carrier"):
        devices.check_link("carrier://pigeon", False, 1100)


@pytest.mark.parametrize(
    ("show", "options", "state", "found"),
    [
        (lambda t: noisy(t)[:40], {}, "failed", "(40, 48)"),
        (lambda t: noisy(t) * 4, {}, "failed", "12 bits end at 4095"),
        (lambda t: np.full((48, 48), 64), {}, "failed", "reads 64 everywhere"),
        (lambda t: noisy(t) - noisy(t).min(), {}, "failed", "below the black level"),
        (lambda t: noisy(3e-4 - t), {}, "failed", "longest exposure is darker"),
        (lambda t: np.maximum(noisy(t), 4094 + noisy(t) % 2), {}, "warning", "saturated"),
        (lambda t: noisy(1e-9 * t), {}, "warning", "no light"),
        (noisy, {"slower": 2.0}, "failed", "took 0.1 ms"),
        (noisy, {"late_s": -5.0}, "failed", "-5.000 s beside the time"),
    ],
)
def test_a_camera_that_cannot_be_right_is_named(small_mission, show, options, state, found):
    with camera(show, **options) as url:
        (finding,) = devices.check_camera(small_mission, url)
    assert "mission." not in finding.advice  # a key is named as it stands in the file
    assert finding.state == state and found in finding.found and finding.advice


def test_a_camera_that_is_not_there(small_mission, tmp_path):
    (finding,) = devices.check_camera(small_mission, f"hil://{tmp_path}/nobody")
    assert finding.state == "failed" and "no camera at" in finding.found


def test_a_disk_that_is_mounted_for_reading_is_a_finding(small_mission, tmp_path):
    with read_only(tmp_path):
        (finding,) = computer.check_disk(small_mission, tmp_path)
    assert finding.state == "failed" and "Read-only" in finding.found and "for writing" in finding.advice


def test_a_disk_that_cannot_be_written_or_is_too_small(small_mission, tmp_path):
    (tmp_path / "file").write_text("no folder")
    for store in (tmp_path / "file" / "store", Path("/proc/store")):
        (finding,) = computer.check_disk(small_mission, store)
        assert finding.state == "failed" and "cannot be written" in finding.found and finding.advice
    for quota_mb, state in ((0.01, "failed"), (0.1, "warning"), (10.0, "ok")):
        mission = dataclasses.replace(small_mission, store=StoreSection(quota_mb=quota_mb))
        (finding,) = computer.check_disk(mission, tmp_path)
        assert finding.state == state, finding  # a bracket takes 13.8 kB, the pass 0.55 MB


def test_on_a_disk_with_little_room_that_is_what_is_told(small_mission, tmp_path, monkeypatch):
    """The probe takes no more than there is, so a small disk is not called one that cannot be written."""
    free, written = 200_000, []

    def write(path: Path, content: bytes) -> None:
        written.append(len(content))
        if 2 * len(content) > free:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        path.write_bytes(content)

    monkeypatch.setattr(computer, "write_whole", write)
    monkeypatch.setattr(computer.shutil, "disk_usage", lambda folder: types.SimpleNamespace(free=free))
    (finding,) = computer.check_disk(small_mission, tmp_path)
    assert finding.state == "warning" and "room for 0.2 MB, the pass takes 0.55 MB" in finding.found
    free = 5_000
    (finding,) = computer.check_disk(small_mission, tmp_path)
    assert finding.state == "failed" and "not even one bracket fits" in finding.found
    assert max(written) <= 100_000 and not list(tmp_path.glob(".selftest*"))


def test_the_same_elements_for_both_spacecraft_are_told(small_mission, in_the_pass):
    orbit = dataclasses.replace(small_mission.orbit, chaser_tle=small_mission.orbit.target_tle)
    mission = dataclasses.replace(small_mission, orbit=orbit)
    (finding,) = planned_pass.check_orbit(mission)
    assert finding.state == "failed" and "at the same place" in finding.found
    assert planned_pass.check_view(mission) == []
    with pytest.raises(OrbitError, match="cannot point at the target 0 m away"):
        pass_plan(mission)


def test_elements_too_old_or_beyond_use_and_a_pass_that_is_over(small_mission, in_the_pass, monkeypatch):
    def found_with(**changes: str) -> list:
        orbit = dataclasses.replace(small_mission.orbit, **changes)
        return planned_pass.check_orbit(dataclasses.replace(small_mission, orbit=orbit))

    (old,) = found_with(start_utc="2026-08-21T10:52:30Z")
    assert old.state == "failed" and "31.0 days old at the first trigger, 7 are allowed" in old.found
    states = NavigationSection(source="file:///none")
    orbit = dataclasses.replace(small_mission.orbit, start_utc="2026-08-21T10:52:30Z")
    told, _ = planned_pass.check_orbit(dataclasses.replace(small_mission, orbit=orbit, navigation=states))
    assert told.state == "warning" and "poses come from navigation" in told.found
    long = dataclasses.replace(small_mission.bracket, interval_s=86_400.0, count=30)
    (late,) = planned_pass.check_orbit(dataclasses.replace(small_mission, bracket=long))
    assert late.state == "warning" and "29.0 days old at the last trigger, 7 are allowed" in late.found
    (decayed,) = found_with(
        target_tle=(
            "1 29141U 85108AA  06170.26783845  .99999999  00000-0  13519-0 0   718",
            "2 29141  82.4288 273.4882 0015848 277.2124  83.9133 15.93343074  6828",
        )
    )
    assert decayed.state == "failed" and "cannot be propagated" in decayed.found
    monkeypatch.setattr(planned_pass.time, "time_ns", lambda: small_mission.orbit.start_utc_ns + 86_400 * NS)
    (over,) = found_with()
    assert over.state == "warning" and "ended 1.0 days ago" in over.found


def test_a_navigation_source_without_states(small_mission, in_the_pass, tmp_path):
    (tmp_path / "states.jsonl").write_text("not a state\n")
    with socket.create_server(("127.0.0.1", 0)) as unused:
        address = unused.getsockname()
    for source, found in (
        (f"file://{tmp_path}/none.jsonl", "no navigation states"),
        (f"file://{tmp_path}/states.jsonl", "1 unreadable line)"),
        (f"tcp://127.0.0.1:{address[1]}", "no state came from"),
    ):
        section = NavigationSection(source=source, wait_s=0.3)
        *_, finding = planned_pass.check_orbit(dataclasses.replace(small_mission, navigation=section))
        assert (finding.check, finding.state) == ("navigation", "failed") and found in finding.found


def test_a_clock_before_the_elements_and_one_that_steps(small_mission, in_the_pass, monkeypatch):
    monkeypatch.setattr(computer.time, "time_ns", lambda: 1000 * NS)
    (reset,) = computer.check_clock(small_mission)
    assert (
        reset.state == "failed" and "1970-01-01T00:16:40Z, before the elements of 2026-07-21" in reset.found
    )
    monkeypatch.setattr(computer.time, "time_ns", time.time_ns)
    steps = iter((100.0, 101.5))
    monkeypatch.setattr(computer.time, "time", lambda: next(steps))
    (stepped,) = computer.check_clock(small_mission)
    assert stepped.state == "failed" and "stepped by +1.2" in stepped.found


@pytest.mark.parametrize(
    ("state", "found"), [((False, 16.0), "not synchronised"), ((True, 0.5), "by 0.500 s")]
)
def test_a_clock_that_is_not_synchronised_is_a_warning(small_mission, in_the_pass, monkeypatch, state, found):
    monkeypatch.setattr(computer, "synchronisation", lambda: state)
    (finding,) = computer.check_clock(small_mission)
    assert finding.state == "warning" and found in finding.found


def test_the_kernel_s_word_on_its_clock_is_read_as_c_reads_it(tmp_path):
    (tmp_path / "clock.c").write_text(
        "#include <stdio.h>\n#include <sys/timex.h>\n"
        "int main(void) { struct timex t = {0}; int s = adjtimex(&t);"
        ' printf("%d %ld", s != TIME_ERROR && s >= 0 && !(t.status & STA_UNSYNC), t.esterror); return 0; }'
    )
    subprocess.run(["gcc", "clock.c", "-o", "clock"], cwd=tmp_path, check=True)
    words = subprocess.run([tmp_path / "clock"], capture_output=True, text=True, check=True).stdout.split()
    synchronised, error_s = computer.synchronisation()
    assert synchronised == bool(int(words[0]))
    assert error_s == pytest.approx(int(words[1]) * 1e-6, rel=0.1)  # it grows with time


def test_a_key_that_is_missing_or_open_to_others(tmp_path):
    (missing,) = computer.check_key(tmp_path / "mission.key")
    assert missing.state == "failed" and "mission.key" in missing.found
    subprocess.run(
        [Path(os.sys.executable).with_name("ground"), "key", tmp_path / "mission.key"],
        check=True,
        capture_output=True,
    )
    (good,) = computer.check_key(tmp_path / "mission.key")
    assert good.state == "ok" and "last command 0" in good.found
    (tmp_path / "mission.key").chmod(0o644)
    (readable,) = computer.check_key(tmp_path / "mission.key")
    assert readable.state == "warning" and "chmod 600" in readable.advice


def test_the_command_exits_with_1_where_a_check_failed_and_says_so_in_json(tmp_path):
    common = ["selftest", "--mission", str(ROOT / "mission.yaml"), "--store", str(tmp_path / "store")]
    good = CliRunner().invoke(app, [*common, "--json"])
    assert good.exit_code == 0 and json.loads(good.stdout)["ok"]
    bad = CliRunner().invoke(app, [*common, "--link", f"serial://{tmp_path}/ttyX"])
    assert bad.exit_code == 1
    failed = [line for line in bad.stdout.splitlines() if line.startswith("failed")]
    assert len(failed) == 1 and "link" in failed[0] and "ttyX" in failed[0] and " -> look at" in bad.stdout


def test_a_can_interface_that_does_not_open_has_nothing_to_do_with_serial_ports(monkeypatch):
    def refuse(*_, **__) -> None:
        raise OSError(errno.EAFNOSUPPORT, os.strerror(errno.EAFNOSUPPORT))

    monkeypatch.setattr("can.Bus", refuse)
    (finding,) = devices.check_link("can://can0", False, 1100)
    assert finding.state == "failed" and "this kernel has no CAN" in finding.found
    assert "ip link" in finding.advice and "modprobe" in finding.advice
    assert "dialout" not in finding.advice and "/dev" not in finding.advice
