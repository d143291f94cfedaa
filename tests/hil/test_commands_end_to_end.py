"""The loop closed over a pseudo-terminal: the ground commands a bracket, sends a model, the downlink follows it."""

import contextlib
import json
import os
import re
import select
import signal
import subprocess
import sys
import termios
import threading
import time
from collections.abc import Callable
from pathlib import Path

import imagecodecs
import numpy as np
import pytest

from flightsw.downlink.commands import KeyRing
from flightsw.downlink.loop import DownlinkProgress, run_downlink
from flightsw.icd.command import Command
from flightsw.icd.frame import PoseTag
from flightsw.icd.link.can import FLIGHT_SIDE
from flightsw.icd.mission import Mission, load_mission
from flightsw.icd.model_file import SENSOR_METADATA
from flightsw.ports import open_link
from flightsw.storage.store import FrameStore
from flightsw.triage.scores import Renderer
from ground.link.ingest import ListenSummary, listen
from ground.link.uplink import make_key, outcome, submit
from ground.session.folder import open_session
from hil.cameras.virtual import CameraServer
from hil.links.faults import Faults
from hil.links.virtual_serial import VirtualSerial
from obbgs_core.io.onnx import export_onnx
from obbgs_core.sensor import Sensor
from tests.ground.test_uplink import foreign_model
from tests.scenes import ball

GOLDEN = Path(__file__).parents[1] / "golden"
BRACKETS = 6
FRAMES = 3 + 2 * (BRACKETS - 1)  # the second bracket and later ones are commanded to have two
NEW_BRACKETS = 2  # the last ones, in which the target has something that the model does not know


@pytest.fixture(scope="module")
def mission_file(tmp_path_factory) -> Path:
    text = (GOLDEN / "mission.yaml").read_text()
    text, changes = re.subn(r"count: \d+", f"count: {BRACKETS}", text)
    assert changes == 1
    path = tmp_path_factory.mktemp("mission") / "mission.yaml"
    path.write_text(text)
    return path


@pytest.fixture(scope="module")
def model(tmp_path_factory, mission_file) -> Path:
    """A small bright ball as an ONNX renderer for the mission's camera."""
    camera = load_mission(mission_file).camera
    path = tmp_path_factory.mktemp("model") / "ball.onnx"
    sensor = Sensor(
        camera.black_dn,
        camera.white_dn,
        camera.dn_per_radiance_s,
        camera.electrons_per_dn,
        camera.read_noise_dn,
    )
    export_onnx(ball(60, 0.8, -0.7, 0.5), sensor, path, camera.width, camera.height, (5e-5, 2e-4))
    return path


class Sky:
    """The ball's radiance, with something beside it from a given bracket on. Waits until `shutter` is set."""

    def __init__(self, mission: Mission, model: Path):
        self.shutter = threading.Event()
        self._renderer, self._camera = Renderer(model), mission.camera
        self._new_from_exposure = FRAMES - 2 * NEW_BRACKETS
        self._exposures = 0

    def radiance(self, pose: PoseTag) -> np.ndarray:
        assert self.shutter.wait(120)
        K, camera, exposure_s = np.array(self._camera.K), self._camera, 1e-4
        dn = self._renderer.expected_dn(pose.world_to_camera, K, exposure_s)
        radiance = (dn - camera.black_dn) / (camera.dn_per_radiance_s * exposure_s)
        if self._exposures >= self._new_from_exposure:
            row, column = camera.height // 2 - 5, camera.width // 2 + 4
            radiance[row : row + 10, column : column + 10] += 0.3
        self._exposures += 1
        return radiance.astype(np.float32)


class Tools:
    """Our command lines as processes; leaving the `with` block ends them."""

    def __init__(self, folder: Path):
        self._folder, self._running = folder, []

    def __enter__(self) -> "Tools":
        return self

    def __exit__(self, *_: object) -> None:
        for process in self._running:
            process.kill()
            process.wait()

    def start(self, tool: str, *arguments: object) -> subprocess.Popen:
        with open(self._folder / f"{tool}-{len(self._running)}.log", "w") as log:
            process = subprocess.Popen(self._command(tool, arguments), stdout=log, stderr=subprocess.STDOUT)
        self._running.append(process)
        return process

    def run(self, tool: str, *arguments: object) -> subprocess.CompletedProcess:
        return subprocess.run(self._command(tool, arguments), capture_output=True, text=True, timeout=120)

    def stop(self, process: subprocess.Popen) -> None:
        process.send_signal(signal.SIGTERM)
        assert process.wait(30) == 0

    def _command(self, tool: str, arguments: tuple) -> list[str]:
        return [str(Path(sys.executable).with_name(tool)), *map(str, arguments)]


def wait_for(condition: Callable[[], bool], limit_s: float = 60) -> None:
    end_s = time.monotonic() + limit_s
    while not condition():
        assert time.monotonic() < end_s
        time.sleep(0.05)


def lines(path: Path) -> list[dict]:
    """Return the whole lines of a file that another process is writing."""
    content = path.read_text() if path.exists() else ""
    return [json.loads(line) for line in content.splitlines(keepends=True) if line.endswith("\n")]


def test_the_ground_changes_the_bracket_and_uplinks_a_model_and_the_downlink_follows_it(
    tmp_path, mission_file, model
):
    mission = load_mission(mission_file)
    store, session, key = tmp_path / "store", tmp_path / "session", tmp_path / "mission.key"
    sky = Sky(mission, model)
    with (
        VirtualSerial(460_800) as line,
        Tools(tmp_path) as tools,
        CameraServer(mission, sky.radiance, tmp_path / "camera.sock") as camera,
    ):
        assert tools.run("ground", "key", key).returncode == 0
        common = ("--mission", mission_file, "--key", key)
        ground = tools.start(
            "ground", "listen", "--link", line.ground_url, "--session", session, *common, "--json"
        )
        flight_options = ("--link", line.flight_url, "--store", store, *common)
        flight = tools.start("flightsw", "serve", "--camera", camera.url, *flight_options)
        wait_for((session / "listener.lock").exists)

        def command(*words: object) -> tuple[int, list[str]]:
            done = tools.run("ground", "uplink", *words, "--session", session, "--key", key, "--json")
            assert done.stdout, done.stderr
            return done.returncode, [report["stage"] for report in json.loads(done.stdout)["reports"]]

        everything = (0, ["accepted", "started", "completed"])
        assert command("ping") == everything
        assert command("bracket", "0.02,0.08") == everything
        assert command("priority", "triage") == everything
        assert command("delete", 0, 99) == (1, ["refused"])
        unfit = ("model", GOLDEN / "mission.yaml", "--session", session, "--key", key)
        done = tools.run("ground", "uplink", *unfit)
        assert done.returncode == 2 and "expected a run's model.onnx" in done.stderr
        other = tmp_path / "other.onnx"  # says what triage asks for, and is no renderer
        other.write_bytes(foreign_model(**dict.fromkeys(("width", "height", *SENSOR_METADATA), "1")))
        assert command("model", other) == (1, ["accepted", "started", "failed"])
        assert not list(store.glob("model*"))
        assert command("model", model) == everything
        assert (store / "model.onnx").read_bytes() == model.read_bytes()

        line.cut()  # nothing goes down while the pass is taken: the order is decided among all frames
        sky.shutter.set()
        wait_for(lambda: len(lines(store / "index.jsonl")) == FRAMES)
        tools.stop(flight)
        line.mend()
        captured = {f.frame_id: f for f in FrameStore(store).frames}
        flight = tools.start("flightsw", "downlink", *flight_options)
        wait_for(lambda: len(lines(session / "frames.jsonl")) == len(captured))
        tools.stop(flight)
        tools.stop(ground)

    received = lines(session / "frames.jsonl")
    assert {r["id"]: r["sha256"] for r in received} == {i: f.sha256 for i, f in captured.items()}
    # the bracket was commanded while its first exposure waited for the shutter; all later ones have two frames
    commanded = [r["exposure_time_s"] for r in received if r["bracket"] == BRACKETS - 1]
    assert sorted(commanded) == pytest.approx([2e-5, 8e-5])
    new = {i for i, f in captured.items() if f.bracket_id >= BRACKETS - NEW_BRACKETS and f.bracket_index == 1}
    places = [place for place, r in enumerate(received) if r["id"] in new]
    assert sorted(places) == list(range(NEW_BRACKETS)), [r["id"] for r in received]
    housekeeping = [line for line in lines(session / "telemetry.jsonl") if line["packet"] == "housekeeping"]
    assert housekeeping[-1]["priority"] == "triage" and housekeeping[-1]["model"] != "00000000"
    assert housekeeping[-1]["exposure_times_ms"] == [0.02, 0.08]
    assert housekeeping[-1]["command_counter"] == 6
    headers = {line["frame_id"] for line in lines(session / "telemetry.jsonl") if line["packet"] == "frame"}
    assert headers == set(captured)
    events = [event["event"] for event in lines(session / "events.jsonl")]
    assert events.count("model_in_use") == 2 and "stopped" in events  # uplinked, and again after the restart
    stages = [r["stage"] for r in lines(session / "reports.jsonl")]
    assert stages.count("completed") == 4
    printed = lines(tmp_path / "ground-0.log")
    assert printed[-1]["type"] == "summary" and printed[-1]["frames_in_session"] == len(captured)
    assert {line["type"] for line in printed} == {"status", "event", "summary"}


class Side:
    """One side of the link in a thread, stopped and joined at the end of the `with` block."""

    def __init__(self, work: Callable[[Callable[[], bool]], object]):
        self._stop, self.result = False, None

        def run() -> None:
            self.result = work(lambda: self._stop)

        self._thread = threading.Thread(target=run)

    def __enter__(self) -> "Side":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop = True
        self._thread.join(30)
        assert not self._thread.is_alive()


def test_commands_cross_a_line_that_loses_and_damages_packets_and_each_is_executed_once(
    tmp_path, small_mission, make_frame
):
    key, session, store = tmp_path / "k", tmp_path / "session", FrameStore(tmp_path / "store")
    make_key(key)
    keys = KeyRing([key])
    for number in range(4):
        store.put(make_frame(number, size_px=200))
    with VirtualSerial(
        3_000_000, Faults(loss=0.1, bit_flip=0.02, duplicate=0.1, reorder=0.02), seed=4
    ) as line:
        with open_link(line.flight_url, FLIGHT_SIDE) as link:
            flight = Side(lambda stop: run_downlink(store, link, small_mission, should_stop=stop, keys=keys))
            with (
                flight,
                Side(
                    lambda stop: listen(line.ground_url, session, small_mission, should_stop=stop)
                ) as ground,
            ):
                wait_for((session / "session.json").exists)
                counters = [
                    submit(session, key, Command(name, arguments), None, 60)
                    for name, arguments in (
                        ("near", {"near": 1}),
                        ("arm", {"command": "delete"}),
                        ("delete", {"first_frame": 0, "last_frame": 0}),
                        ("delete", {"first_frame": 1, "last_frame": 1}),
                        ("near", {"near": 2}),
                    )
                ]
                wait_for(lambda: all(outcome(session, number) for number in counters))
                # a frame of 200 px does not fit this mission, but its thumbnail is kept
                wait_for(lambda: len(list((session / "thumbnails").glob("*.png"))) >= 2)
        keys.close()
    ends = [outcome(session, number) for number in counters]
    assert [end["stage"] for end in ends if end] == [
        "completed",
        "completed",
        "completed",
        "refused",
        "completed",
    ]
    assert isinstance(flight.result, DownlinkProgress) and isinstance(ground.result, ListenSummary)
    assert (flight.result.commands_accepted, flight.result.commands_refused) == (4, 1)
    assert [frame.frame_id for frame in FrameStore(tmp_path / "store").frames] == [1, 2, 3]
    picture = imagecodecs.png_decode(next((session / "thumbnails").glob("*.png")).read_bytes())
    assert max(picture.shape) <= 64
    with pytest.raises(Exception, match="holds no frames"):
        open_session(session)


def test_without_a_listener_the_command_opens_the_link_itself_and_without_a_link_it_is_an_error(
    tmp_path, small_mission
):
    key, session, mission = tmp_path / "k", tmp_path / "session", tmp_path / "small.yaml"
    make_key(key)
    keys = KeyRing([key])
    store = FrameStore(tmp_path / "store")
    with (
        VirtualSerial(460_800) as line,
        open_link(line.flight_url, FLIGHT_SIDE) as link,
        Side(lambda stop: run_downlink(store, link, small_mission, should_stop=stop, keys=keys)),
        Tools(tmp_path) as tools,
    ):
        options = ("--session", session, "--key", key)
        nobody = tools.run("ground", "uplink", "ping", *options)
        assert nobody.returncode == 1 and "no `ground listen` receives into" in nobody.stderr
        direct = tools.run(
            "ground", "uplink", "ping", *options, "--link", line.ground_url, "--mission", mission
        )
        assert (direct.returncode, direct.stdout.splitlines()[-1]) == (0, "completed: alive")
        wrong = tools.run("ground", "uplink", "near", "77", *options, "--link", line.ground_url)
        assert wrong.returncode == 2 and "near: expected 0 to 16 DN, got 77" in wrong.stderr
    keys.close()
    assert keys.counters[0].last == 1


def test_on_a_terminal_listen_is_a_console_that_shows_the_spacecraft(tmp_path, small_mission, make_frame):
    store = FrameStore(tmp_path / "store")
    store.put(make_frame(0))
    master, slave = os.openpty()
    termios.tcsetwinsize(slave, (50, 140))
    seen = bytearray()
    with VirtualSerial(460_800) as line, open_link(line.flight_url, FLIGHT_SIDE) as link:
        options = (
            "--link",
            line.ground_url,
            "--session",
            tmp_path / "s",
            "--mission",
            tmp_path / "small.yaml",
        )
        command = [str(Path(sys.executable).with_name("ground")), "listen", *map(str, options)]
        environment = os.environ | {"TERM": "xterm-256color", "LINES": "50", "COLUMNS": "140"}
        ground = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=slave, env=environment, text=True)
        os.close(slave)

        def read_until(text: bytes) -> None:
            end_s = time.monotonic() + 60
            while text not in seen and time.monotonic() < end_s:
                if select.select([master], [], [], 0.1)[0]:
                    try:
                        seen.extend(os.read(master, 65_536))
                    except OSError:  # the command has ended and closed its side
                        break
            assert text in seen, seen.decode(errors="replace")[-2000:]

        try:
            read_until(b"no housekeeping yet")
            with Side(lambda stop: run_downlink(store, link, small_mission, should_stop=stop)):
                for text in (b"outbox frames", b"flight software started", b"1 captured, 1 in this run"):
                    read_until(text)
            read_until(b"flight software stopped")
        finally:
            ground.send_signal(signal.SIGTERM)
            end_s = time.monotonic() + 30
            while (
                ground.poll() is None and time.monotonic() < end_s
            ):  # a terminal reads as long as it is written to
                if select.select([master], [], [], 0.1)[0]:
                    with contextlib.suppress(OSError):
                        os.read(master, 65_536)
            stdout, _ = ground.communicate(timeout=1)
            os.close(master)
    assert ground.returncode == 0 and stdout.startswith("1 frame received, 1 in ")
