"""A lost camera is tried again: one log line when it is lost, one when it is back, and lost exposures are counted."""

import contextlib
import itertools
import json
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from flightsw import run
from flightsw.cameras import open_camera
from flightsw.cameras.camera import Exposure
from flightsw.cameras.reconnecting import PATIENCE_S, RETRY_S, ReconnectingCamera
from flightsw.capture.sequencer import capture
from flightsw.errors import CameraLost, CaptureError
from flightsw.icd.mission import load_mission
from flightsw.storage.boot_counter import count_boot
from flightsw.storage.store import FrameStore, remove_unused
from flightsw.watchdog import Watchdog
from hil.links.virtual_serial import VirtualSerial

MISSION = load_mission(Path(__file__).parents[1] / "golden" / "mission.yaml")
LOST, STUCK = CameraLost("no answer"), CaptureError("the shutter stuck")


class Scripted:
    """A camera whose calls end as told; None is a picture, and so is everything after the script."""

    packets_lost = 0

    def __init__(self, *script: Exception | None, has_own_clock: bool = True):
        self.script, self.has_own_clock, self.calls = list(script), has_own_clock, 0

    def _next(self) -> None:
        self.calls += 1
        error = self.script.pop(0) if self.script else None
        if error is not None:
            raise error

    def open(self) -> None:
        self._next()

    def expose(self, exposure_time_s: float, start_utc_ns: int) -> Exposure:
        self._next()
        dn = np.full((MISSION.camera.height, MISSION.camera.width), 70, np.uint16)
        return Exposure(dn, exposure_time_s, start_utc_ns + round(exposure_time_s * 5e8))

    def close(self) -> None:
        pass


class Clock:
    def __init__(self) -> None:
        self.now_s = 0.0

    def __call__(self) -> float:
        return self.now_s

    def pause(self, seconds: float) -> None:
        self.now_s += seconds


def keeper(camera: Scripted, clock: Clock | None = None) -> ReconnectingCamera:
    clock = clock or Clock()
    return ReconnectingCamera(camera, clock.pause, clock)


def test_a_camera_with_its_own_clock_that_comes_back_costs_no_exposure(tmp_path, caplog):
    camera = Scripted(None, None, LOST, LOST, LOST)
    kept = keeper(camera)
    counts = capture(MISSION, kept, FrameStore(tmp_path))
    assert (counts.planned, counts.stored, counts.failed) == (48, 48, 0)
    assert (kept.losses, kept.lost) == (1, False)
    assert [record.getMessage() for record in caplog.records] == [
        "the camera is lost, it is tried again every 1 s: no answer",
        "the camera is back after 3.0 s, 0 exposures lost",
    ]


def test_a_camera_with_its_own_clock_that_never_comes_back_is_given_up_once_with_the_counts(tmp_path, caplog):
    camera = Scripted(*[None] * 4, *[LOST] * 1000)
    clock = Clock()
    kept = keeper(camera, clock)
    counts = capture(MISSION, kept, FrameStore(tmp_path))
    assert (counts.planned, counts.stored, counts.failed) == (48, 4, 44)
    assert (counts.lost_with_camera, counts.brackets_short) == (44, 15)  # the second bracket kept one frame
    assert clock.now_s == PATIENCE_S and camera.calls == 4 + 1 + PATIENCE_S / RETRY_S
    assert kept.lost and len(caplog.records) == 1


def test_a_camera_without_its_own_clock_is_tried_at_each_exposure_and_the_lost_ones_are_counted(
    tmp_path, caplog
):
    camera = Scripted(None, LOST, LOST, None, LOST, has_own_clock=False)
    kept = keeper(camera)
    counts = capture(MISSION, kept, FrameStore(tmp_path))
    assert (counts.stored, counts.failed, counts.lost_with_camera, counts.brackets_short) == (45, 3, 3, 2)
    assert (kept.losses, kept.lost, camera.calls) == (2, False, 48)
    assert [r.getMessage().partition(",")[2] for r in caplog.records if "back" in r.getMessage()] == [
        " 2 exposures lost",
        " 1 exposure lost",
    ]


def test_between_exposures_a_lost_camera_is_reached_without_losing_one():
    camera = Scripted(LOST, LOST, None, has_own_clock=False)
    kept = keeper(camera)
    with pytest.raises(CameraLost):
        kept.expose(1e-4, 0)
    kept.reconnect()
    assert kept.lost
    kept.reconnect()
    assert not kept.lost
    kept.reconnect()
    assert camera.calls == 3  # there was nothing to reconnect


def test_a_stop_ends_the_waiting_for_a_camera():
    camera = Scripted(*[LOST] * 1000)
    with pytest.raises(CameraLost):
        ReconnectingCamera(camera, lambda seconds: True).expose(1e-4, 0)
    assert camera.calls == 1


def test_a_camera_that_answers_without_a_picture_is_not_lost_and_the_reason_comes_once(tmp_path, caplog):
    camera = Scripted(None, *[STUCK] * 40, CaptureError("too hot"))
    kept = keeper(camera)
    counts = capture(MISSION, kept, FrameStore(tmp_path))
    assert (counts.stored, counts.failed, counts.lost_with_camera, kept.losses) == (7, 41, 0, 0)
    assert [record.getMessage() for record in caplog.records] == [
        "bracket 0 frame 1 lost: the shutter stuck",
        "39 more exposures lost for the same reason: the shutter stuck",
        "bracket 13 frame 2 lost: too hot",
    ]


@pytest.mark.parametrize("answer", [b"", b"no JSON\n", b"[]\n", b'{"ok": true, "height": 2}\n', "short"])
def test_a_networked_camera_that_breaks_off_is_lost_and_connects_anew(answer):
    if answer == "short":
        header = {"ok": True, "height": 2, "width": 2, "channels": 1, "nbytes": 8}
        answer = json.dumps(header).encode() + b"\nabc"
    refusal = b'{"ok": false, "error": "too dark"}\n'
    with socket.create_server(("127.0.0.1", 0)) as server:

        def serve() -> None:
            for reply in (answer, refusal):
                connection, _ = server.accept()
                with connection, connection.makefile("rwb") as stream:
                    stream.readline()
                    stream.write(reply)

        thread = threading.Thread(target=serve)
        thread.start()
        camera = open_camera(f"hil://127.0.0.1:{server.getsockname()[1]}", MISSION.camera)
        with pytest.raises(CameraLost):
            camera.expose(1e-4, 0)
        with pytest.raises(CaptureError, match="too dark"):
            camera.expose(1e-4, 0)
        thread.join()
    with pytest.raises(CameraLost, match="no camera at hil:"):
        for _ in range(2):  # the first finds the old connection closed
            with contextlib.suppress(CaptureError):
                camera.expose(1e-4, 0)
            camera.close()
        camera.open()


@contextlib.contextmanager
def camera_process(tmp_path: Path, limit: int = 10**6) -> Iterator[subprocess.Popen]:
    """The simulated camera as a process of its own that dies with exposure number `limit`."""
    code = f"""
import itertools, os, sys, threading
import numpy as np
from flightsw.icd.mission import load_mission
from hil.cameras.virtual import CameraServer
mission, count = load_mission(sys.argv[1]), itertools.count(1)
def sky(pose):
    if next(count) == {limit}:
        os._exit(3)
    return np.full((mission.camera.height, mission.camera.width, 1), 0.1)
with CameraServer(mission, sky, "hil://" + sys.argv[2]):
    print("ready", flush=True)
    threading.Event().wait()
"""
    arguments = [str(tmp_path / "small.yaml"), str(tmp_path / "camera.sock")]
    with subprocess.Popen(
        [sys.executable, "-c", code, *arguments], stdout=subprocess.PIPE, text=True
    ) as process:
        try:
            assert process.stdout and process.stdout.readline() == "ready\n"
            yield process
        finally:
            process.kill()


def start_capture(tmp_path: Path, *arguments: str, patience_s: float = PATIENCE_S) -> subprocess.Popen:
    code = "import flightsw.cameras.reconnecting as r; r.RETRY_S = 0.05; "
    code += f"r.PATIENCE_S = {patience_s}; from flightsw.cli import main; main()"
    command = ["capture", "--camera", f"hil://{tmp_path}/camera.sock", "--store", str(tmp_path / "store")]
    command += ["--mission", str(tmp_path / "small.yaml"), "--count", "8", *arguments]
    return subprocess.Popen(
        [sys.executable, "-c", code, *command], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


def test_a_camera_that_dies_and_is_started_again_in_mid_pass_costs_no_frame(tmp_path, small_mission):
    with camera_process(tmp_path, limit=11):
        process = start_capture(tmp_path, "--json")
        assert process.stderr and "the camera is lost, it is tried again" in process.stderr.readline()
    with camera_process(tmp_path):
        out, err = process.communicate(timeout=120)
    result = json.loads(out)
    assert process.returncode == 0, err
    assert (result["capture"]["stored"], result["capture"]["failed"]) == (24, 0)
    assert result["capture"]["camera_losses"] == 1 and "the camera is back after" in err


def test_a_camera_that_never_comes_back_is_two_lines_a_summary_and_a_failure(tmp_path, small_mission):
    with camera_process(tmp_path, limit=11):
        process = start_capture(tmp_path, patience_s=0.2)
        out, err = process.communicate(timeout=120)
    assert process.returncode == 1
    assert "captured 10 frames, 0 were taken before, 14 failed" in out
    assert "the camera was lost once and never came back: 14 exposures of 5 brackets not taken" in out
    assert [line.partition(":")[2].split(",")[0] for line in err.splitlines() if line] == [
        " warning: the camera is lost",
        " error: the camera did not come back: 14 exposures not taken",
    ]


def test_a_camera_that_answers_only_after_flight_has_started_takes_the_pass(tmp_path, small_mission):
    with VirtualSerial(921_600) as line:
        process = start_capture(tmp_path, "--link", line.flight_url)
        assert process.stderr and "no camera yet, it is tried again" in process.stderr.readline()
        with camera_process(tmp_path):
            assert "the camera answers" in process.stderr.readline()
            while len(list((tmp_path / "store").glob("frames/*.obf"))) < 24:
                assert process.poll() is None
                time.sleep(0.05)
            process.terminate()
            out, err = process.communicate(timeout=60)
    assert "captured 24 frames, 0 were taken before, 0 failed" in out, err


def test_a_camera_that_never_answers_is_given_up_and_the_link_goes_on(tmp_path, small_mission):
    with VirtualSerial(921_600) as line:
        process = start_capture(tmp_path, "--link", line.flight_url, patience_s=0.2)
        out, err = process.communicate(timeout=60)
    assert process.returncode == 1 and not out
    first, last = err.splitlines()
    assert "no camera yet, it is tried again every 0.05 s: no camera at hil://" in first
    assert last == "flightsw: no frame was taken: the camera never answered"
    assert not (tmp_path / "store").exists()


def test_a_store_that_holds_anything_is_no_unused_one(tmp_path, make_frame):
    for name in ("empty", "full", "commanded"):
        count_boot(tmp_path / name)
        FrameStore(tmp_path / name)
    FrameStore(tmp_path / "full").put(make_frame(0))
    (tmp_path / "commanded" / "settings.json").write_text("{}")
    for name in ("empty", "full", "commanded", "none"):
        remove_unused(tmp_path / name)
    assert {path.name for path in tmp_path.iterdir()} == {"full", "commanded"}


class ComputersClock:
    """The clock of the computer, which is slow by half an hour until it is set, and a stop that moves both on."""

    def __init__(self, utc_ns: int, set_utc_ns: int):
        self.utc_ns, self._set_utc_ns = utc_ns, set_utc_ns

    def time_ns(self) -> int:
        return self.utc_ns - (0 if self.utc_ns >= self._set_utc_ns else 1800 * 10**9)

    def monotonic(self) -> float:
        return self.utc_ns / 1e9

    def wait(self, seconds: float) -> bool:
        self.utc_ns += round(seconds * 1e9)
        return False

    def is_set(self) -> bool:
        return False


def test_a_clock_that_is_set_during_a_wait_costs_no_exposure(tmp_path, monkeypatch):
    start_ns = MISSION.orbit.start_utc_ns
    clock = ComputersClock(start_ns - 300 * 10**9, set_utc_ns=start_ns - 240 * 10**9)
    monkeypatch.setattr(run, "time", clock)
    late_s = []

    class Punctual(Scripted):
        def expose(self, exposure_time_s: float, start_utc_ns: int) -> Exposure:
            late_s.append((clock.utc_ns - start_utc_ns) / 1e9)
            return super().expose(exposure_time_s, start_utc_ns)

    camera = ReconnectingCamera(Punctual(has_own_clock=False))
    counts = run._capture(MISSION, camera, FrameStore(tmp_path), clock, lambda counts: None, Watchdog())
    assert counts.stored == 48 and max(late_s) < 1e-3


def test_the_ground_is_told_that_the_camera_is_lost(tmp_path, small_mission):
    """In the housekeeping packets of `flightsw capture --link`, while it is tried again and after it was given up."""
    from flightsw.icd.link.can import GROUND_SIDE
    from flightsw.icd.link.framing import PacketStream
    from flightsw.icd.packet import APID_EVENTS, APID_HOUSEKEEPING, TELECOMMAND
    from flightsw.icd.telemetry import DICTIONARY
    from flightsw.ports import open_link

    path = tmp_path / "small.yaml"
    path.write_text(path.read_text().replace("link:", "link:\n  housekeeping_s: 0.1"))
    stream, states, events = PacketStream(TELECOMMAND, 1100), [], []
    with (
        camera_process(tmp_path, limit=2),
        VirtualSerial(921_600) as line,
        open_link(line.ground_url, GROUND_SIDE) as ground,
    ):
        process = start_capture(tmp_path, "--link", line.flight_url, patience_s=1.0)
        for _ in itertools.count():
            for apid, data in stream.decode(ground.exchange(0.05)):
                if apid == APID_HOUSEKEEPING:
                    states.append(DICTIONARY.unpack("telemetry", data)[1]["camera"])
                if apid == APID_EVENTS:
                    events.append(DICTIONARY.unpack("events", data)[1].get("problem", ""))
            if states and states[-1] == "failed" and any("did not come back" in text for text in events):
                break
            assert process.poll() is None
        process.terminate()  # the outbox holds a frame that nobody takes
        process.communicate(timeout=60)
    assert process.returncode == 1
    assert any("the camera is lost" in text for text in events)
