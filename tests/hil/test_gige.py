"""GigE Vision on loopback: our driver with Aravis' fake camera, Aravis' client with our camera, and ours with ours."""

import contextlib
import ctypes
import dataclasses
import json
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from flightsw.cameras import open_camera
from flightsw.cameras.aravis import aravis
from flightsw.cameras.gige import GigeCamera, demosaic
from flightsw.capture.sequencer import capture
from flightsw.errors import CameraLost, CaptureError
from flightsw.icd.frame import decode_frame
from flightsw.icd.mission import CameraSection, Mission, load_mission
from flightsw.storage.store import FrameStore
from hil.cameras.gige import DESCRIPTION, GigeCameraServer
from hil.sky.sensor import demosaic as simulator_demosaic

MISSION = load_mission(Path(__file__).parents[2] / "mission.yaml")
SIZE_PX = 96
LISTENING = "0100007F:0F74"  # 127.0.0.1:3956 in /proc/net/udp
FAKE_CAMERA, CAMERA_TEST = "arv-fake-gv-camera-0.8", "arv-camera-test-0.8"


pytestmark = pytest.mark.usefixtures("the_only_camera_on_loopback")


@pytest.fixture(scope="module", autouse=True)
def aravis_tools() -> None:
    tools = [tool for tool in (FAKE_CAMERA, CAMERA_TEST) if shutil.which(tool) is None]
    if tools:
        pytest.skip(f"{', '.join(tools)} missing; on Debian: apt-get install aravis-tools")


@contextlib.contextmanager
def fake_camera(*arguments: str) -> Iterator[None]:
    """Run Aravis' own fake camera, independent of our code."""
    process = subprocess.Popen(
        [FAKE_CAMERA, "-i", "127.0.0.1", *arguments], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    try:
        deadline_s = time.monotonic() + 10
        while LISTENING not in Path("/proc/net/udp").read_text():
            assert time.monotonic() < deadline_s, "the fake camera does not listen"
            time.sleep(0.01)
        yield
    finally:
        process.kill()
        process.wait()


def section(bit_depth: int, channels: int = 1, size_px: int = SIZE_PX) -> CameraSection:
    """Return the mission's 12-bit camera scaled to another bit depth."""
    scale = 2.0 ** (bit_depth - 12)
    return dataclasses.replace(
        MISSION.camera,
        width=size_px,
        height=size_px,
        bit_depth=bit_depth,
        channels=channels,
        black_dn=64 * scale,
        dn_per_radiance_s=4e7 * scale,
        read_noise_dn=8 * scale,
    )


def is_ramp(dn: np.ndarray, exposure_us: float, scale: int) -> bool:
    """Return whether this is the pattern of Aravis' fake camera (arvfakecamera.c): a ramp that moves by one a frame.

    Its frame numbers begin at 65401.
    """
    y, x = np.mgrid[: dn.shape[0], : dn.shape[1]]
    white = 255 if scale == 1 else 65535
    for frame in range(65_401, 65_440):
        value = (scale * (x + y + frame) % white) * (1 + np.log10(exposure_us / 10_000))
        if np.array_equal(dn, np.clip(value, 0, white).astype(np.uint16)):
            return True
    return False


@pytest.mark.parametrize(("name", "bit_depth", "scale"), [("Mono8", 8, 1), ("Mono16", 16, 256)])
def test_pictures_of_aravis_fake_camera_arrive_bit_for_bit(name, bit_depth, scale):
    with fake_camera():
        camera = open_camera(f"gige://127.0.0.1?pixel_format={name}", section(bit_depth))
        for exposure_us in (10_000, 15_000, 20_000):
            before_ns = time.time_ns()
            exposure = camera.expose(exposure_us / 1e6, before_ns)
            assert exposure.exposure_time_s == exposure_us / 1e6
            # the fake camera stamps when it sends, without waiting for the exposure
            opened_ns = exposure.mid_exposure_utc_ns - exposure_us * 500
            assert before_ns <= opened_ns <= time.time_ns()
            assert is_ramp(exposure.dn, exposure_us, scale)
        assert not camera.has_own_clock
        camera.close()


def test_a_bayer_mosaic_is_received_raw_or_interpolated():
    with fake_camera():
        raw = open_camera("gige://127.0.0.1?pixel_format=BayerRG8", section(8))
        mosaic = raw.expose(0.01, time.time_ns()).dn
        raw.close()
        camera = open_camera("gige://127.0.0.1?pixel_format=BayerRG8", section(8, channels=3))
        colours = camera.expose(0.01, time.time_ns()).dn
        camera.close()
    assert mosaic.shape == (SIZE_PX, SIZE_PX) and colours.shape == (SIZE_PX, SIZE_PX, 3)
    assert mosaic.std() > 10 and colours.std() > 10


@pytest.mark.parametrize("pattern", ["RG", "GR", "GB", "BG"])
def test_interpolated_colours_match_an_independent_demosaic(pattern):
    cv2 = pytest.importorskip("cv2")
    rng = np.random.default_rng(3)
    y, x = np.mgrid[:32, :32]
    mosaic = (1000 + 20 * x + 30 * y + rng.integers(0, 200, (32, 32))).astype(np.uint16)
    # OpenCV names a pattern by its second row's second and third pixel, and gives blue, green, red
    code = {
        "RG": cv2.COLOR_BayerBG2BGR,
        "GR": cv2.COLOR_BayerGB2BGR,
        "GB": cv2.COLOR_BayerGR2BGR,
        "BG": cv2.COLOR_BayerRG2BGR,
    }[pattern]
    expected = cv2.cvtColor(mosaic, code)[..., ::-1].astype(int)
    inside = (slice(2, -2), slice(2, -2))
    assert np.abs(demosaic(mosaic, pattern).astype(int) - expected)[inside].max() <= 1  # rounding of halves
    if pattern == "RG":
        theirs = simulator_demosaic(mosaic).astype(int)
        assert np.abs(demosaic(mosaic, pattern).astype(int) - theirs)[inside].max() <= 1


def test_lost_packets_are_counted_and_the_frame_is_rejected():
    with fake_camera("-r", "20"):  # 2 % of the packets; the fake camera resends none
        camera = open_camera("gige://127.0.0.1?pixel_format=Mono8", section(8, size_px=256))
        whole = failed = 0
        for _ in range(12):
            try:
                exposure = camera.expose(0.01, time.time_ns())
            except CaptureError as error:
                assert "incomplete" in str(error) or "no picture" in str(error)
                failed += 1
            else:
                assert is_ramp(exposure.dn, 10_000, 1)
                whole += 1
        assert failed and camera.packets_lost > 0
        camera.close()


def test_a_camera_that_comes_back_is_opened_again():
    with fake_camera():
        camera = open_camera("gige://127.0.0.1?pixel_format=Mono8", section(8))
        camera.expose(0.01, time.time_ns())
    with pytest.raises(CaptureError):
        camera.expose(0.01, time.time_ns())
    with fake_camera():
        assert camera.expose(0.01, time.time_ns()).dn.shape == (SIZE_PX, SIZE_PX)
        camera.close()


AUTOMATIC_FEATURES = "".join(
    f'''<Enumeration Name="{name}" NameSpace="Standard">
    <EnumEntry Name="Off" NameSpace="Standard"><Value>0</Value></EnumEntry>
    <EnumEntry Name="Once" NameSpace="Standard"><Value>1</Value></EnumEntry>
    <EnumEntry Name="Continuous" NameSpace="Standard"><Value>2</Value></EnumEntry>
    <pValue>{name}Register</pValue></Enumeration>
    <IntReg Name="{name}Register" NameSpace="Custom"><Address>{address:#x}</Address><Length>4</Length>
    <AccessMode>RW</AccessMode><pPort>Device</pPort><Sign>Unsigned</Sign><Endianess>BigEndian</Endianess></IntReg>'''
    for name, address in (("ExposureAuto", 0xB000), ("GainAuto", 0xB004), ("BalanceWhiteAuto", 0xB008))
)
AUTOMATIC_FEATURES += """<Boolean Name="GammaEnable" NameSpace="Standard"><pValue>GammaRegister</pValue>
    <OnValue>1</OnValue><OffValue>0</OffValue></Boolean>
    <IntReg Name="GammaRegister" NameSpace="Custom"><Address>0xb00c</Address><Length>4</Length>
    <AccessMode>RW</AccessMode><pPort>Device</pPort><Sign>Unsigned</Sign><Endianess>BigEndian</Endianess></IntReg>"""


@contextlib.contextmanager
def automatic_camera(folder: Path, description: str) -> Iterator[Callable[[], list[int]]]:
    """Run Aravis' fake camera with all that is automatic switched on; give what reads its registers."""
    library = aravis()
    (folder / "camera.xml").write_text(description)
    names = (b"127.0.0.1", b"OBGF", str(folder / "camera.xml").encode())
    device = library.call("arv_gv_fake_camera_new_full", *names)
    memory = library.call("arv_gv_fake_camera_get_fake_camera", device)
    value = ctypes.create_string_buffer(4)
    for address, number in ((0xB000, 2), (0xB004, 1), (0xB008, 2), (0xB00C, 1)):
        value.raw = number.to_bytes(4, "big")
        library.call("arv_fake_camera_write_memory", memory, address, 4, value)

    def registers() -> list[int]:
        numbers = []
        for address in (0xB000, 0xB004, 0xB008, 0xB00C):
            library.call("arv_fake_camera_read_memory", memory, address, 4, value)
            numbers.append(int.from_bytes(value.raw, "big"))
        return numbers

    try:
        yield registers
    finally:
        library.unref(device)


def described(features: str) -> str:
    return DESCRIPTION.read_text().replace("<Port ", f"{features}<Port ")


def test_what_is_automatic_is_switched_off_and_said(tmp_path, caplog):
    """Cameras are often delivered so, or another program left them so."""
    with automatic_camera(tmp_path, described(AUTOMATIC_FEATURES)) as registers:
        assert registers() == [2, 1, 2, 1]
        camera = open_camera("gige://127.0.0.1?pixel_format=Mono8", section(8))
        assert registers() == [0, 0, 0, 0]
        camera.close()
        told = [record.getMessage().partition(": ")[2] for record in caplog.records]
        before = ("ExposureAuto was Continuous", "GainAuto was Once", "BalanceWhiteAuto was Continuous")
        assert told == [f"{words} and is switched off" for words in (*before, "GammaEnable was On")]
        caplog.clear()
        camera.open()
        camera.close()
        assert not caplog.records


@pytest.mark.parametrize("name", ["ExposureAuto", "GainAuto", "BalanceWhiteAuto", "GammaEnable"])
def test_a_camera_that_leaves_something_automatic_on_is_refused_with_what_to_do(tmp_path, name):
    register = "GammaRegister" if name == "GammaEnable" else f"{name}Register"
    locked = AUTOMATIC_FEATURES.replace(f"<pValue>{register}</pValue>", "<pValue>Locked</pValue>")
    locked += '<IntSwissKnife Name="Locked" NameSpace="Custom"><Formula>1</Formula></IntSwissKnife>'
    with (
        automatic_camera(tmp_path, described(locked)),
        pytest.raises(CameraLost, match=rf"{name} stays \w+.*: readings would not follow .*; switch it off"),
    ):
        open_camera("gige://127.0.0.1?pixel_format=Mono8", section(8))


def test_impossible_requests_are_refused_with_the_reason():
    with pytest.raises(ValueError, match="Mono13"):
        open_camera("gige://127.0.0.1?pixel_format=Mono13", section(12))
    with pytest.raises(ValueError, match="Mono8 has 8 bits, the mission's camera 12"):
        open_camera("gige://127.0.0.1?pixel_format=Mono8", section(12))
    for url in (
        "gige://",
        "gige://?pixel_format=Mono12",
        "gige://127.0.0.1?pixelformat=Mono12",
        "gige://1?x",
    ):
        with pytest.raises(ValueError, match="expected gige://ID, .* got '" + re.escape(url)):
            GigeCamera(url, section(12))
    with pytest.raises(
        CaptureError, match="no camera at gige://nobody: Device 'nobody' not found; `arv-tool"
    ):
        open_camera("gige://nobody", section(12))
    with fake_camera():
        camera = open_camera("gige://127.0.0.1?pixel_format=Mono8", section(8))
        with pytest.raises(CaptureError, match=r"due 60\.\d s ago"):
            camera.expose(0.01, time.time_ns() - 60_000_000_000)
        camera.close()


def mission_now(camera: CameraSection, count: int) -> Mission:
    start = np.datetime64(time.time_ns() + 1_500_000_000, "ns")
    return dataclasses.replace(
        MISSION,
        camera=camera,
        orbit=dataclasses.replace(MISSION.orbit, start_utc=f"{str(start)[:26]}Z"),
        bracket=dataclasses.replace(
            MISSION.bracket,
            exposure_times_ms=(10.0, 15.0, 20.0),
            count=count,
            interval_s=0.4,
            frame_spacing_s=0.1,
        ),
        link=dataclasses.replace(MISSION.link, roi_sigma=0.01, roi_margin_px=SIZE_PX),
    )


def test_a_frame_of_the_gige_driver_goes_through_store_and_container_unchanged(tmp_path):
    with fake_camera():
        mission = mission_now(section(16), count=2)
        camera = open_camera("gige://127.0.0.1?pixel_format=Mono16", mission.camera)
        taken = []

        class Watched:
            has_own_clock = False

            def expose(self, exposure_time_s: float, start_utc_ns: int):
                taken.append(camera.expose(exposure_time_s, start_utc_ns))
                return taken[-1]

            def close(self) -> None:
                camera.close()

        store = FrameStore(tmp_path)
        counts = capture(
            mission,
            Watched(),
            store,
            wait_until=lambda ns: time.sleep(max(0.0, (ns - time.time_ns()) / 1e9)),
        )
        camera.close()
    assert counts.stored == counts.planned == 6
    for exposure, stored in zip(taken, store.frames, strict=True):
        frame = decode_frame(store.read(stored.frame_id))
        np.testing.assert_array_equal(frame.dn, exposure.dn)
        assert frame.mid_exposure_utc_ns == exposure.mid_exposure_utc_ns
        assert frame.exposure_time_s == exposure.exposure_time_s
        assert frame.bit_depth == 16


def test_the_command_line_captures_from_the_fake_camera_now(tmp_path):
    text = (Path(__file__).parents[2] / "mission.yaml").read_text()
    for old, new in {
        "width: 256": f"width: {SIZE_PX}",
        "height: 256": f"height: {SIZE_PX}",
        "bit_depth: 12": "bit_depth: 8",
        "black_dn: 64.0": "black_dn: 4.0",
        "interval_s: 27.0": "interval_s: 0.5",
    }.items():
        text = text.replace(old, new)
    (tmp_path / "mission.yaml").write_text(text)
    command = [
        str(Path(sys.executable).with_name("flightsw")),
        "capture",
        *("--camera", "gige://127.0.0.1", "--bracket", "10,20", "--count", "3"),
        *("--start", "now", "--mission", str(tmp_path / "mission.yaml"), "--store", str(tmp_path / "store")),
        "--json",
    ]
    with fake_camera():
        done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr
    counts = json.loads(done.stdout)["capture"]
    # triggers at 0, 0.5 and 1 s
    assert (counts["stored"], counts["failed"], counts["packets_lost"]) == (6, 0, 0)
    store = FrameStore(tmp_path / "store")
    times_ns = [decode_frame(store.read(f.frame_id)).mid_exposure_utc_ns for f in store.frames]
    assert abs(times_ns[4] - times_ns[0] - 1_000_000_000) < 400_000_000  # they waited for their time
    assert abs(times_ns[0] - time.time_ns()) < 60_000_000_000


def plate(radiance: float, size_px: int = SIZE_PX, channels: int = 1):
    """Return a scene of uniform radiance, wherever the camera is."""
    return lambda pose: np.full((size_px, size_px, channels), radiance)


def simulated(bit_depth: int = 12, channels: int = 1) -> Mission:
    return dataclasses.replace(MISSION, camera=section(bit_depth, channels))


def test_a_hundred_frames_at_three_exposures_are_complete_and_proportional_to_exposure():
    mission = simulated()
    with GigeCameraServer(mission, plate(0.4)) as server:
        camera = open_camera(server.url, mission.camera)
        signal_dn: dict[int, list[float]] = {50: [], 100: [], 200: []}
        for number in range(100):
            exposure_us = (50, 100, 200)[number % 3]
            start_ns = mission.orbit.start_utc_ns + number * 1_000_000_000
            exposure = camera.expose(exposure_us / 1e6, start_ns)
            assert exposure.exposure_time_s == exposure_us / 1e6
            assert exposure.mid_exposure_utc_ns == start_ns + exposure_us * 500
            assert exposure.dn.max() < mission.camera.white_dn
            signal_dn[exposure_us].append(float(exposure.dn.mean()) - mission.camera.black_dn)
        assert camera.packets_lost == 0
        camera.close()
    assert server.exposures == 100 and server.failures == 0
    for exposure_us, means_dn in signal_dn.items():
        expected_dn = 0.4 * mission.camera.dn_per_radiance_s * exposure_us / 1e6
        assert np.mean(means_dn) == pytest.approx(expected_dn, rel=0.01)


def test_aravis_own_client_grabs_every_frame_from_the_simulated_camera():
    with GigeCameraServer(simulated(), plate(0.4)):
        for extra in (["-o", "20"], ["-f", "10"]):  # software trigger, free running
            done = subprocess.run(
                [CAMERA_TEST, "-n", "127.0.0.1", "-e", "200", "--duration=1", *extra],
                capture_output=True,
                text=True,
                timeout=60,
                check=True,
            )
            counts = {
                name: int(value) for name, value in re.findall(r"^(n_\w+)\s*= (\d+)$", done.stdout, re.M)
            }
            assert "exposure               = 200 µs" in done.stdout
            assert f"image width            = {SIZE_PX}" in done.stdout
            assert counts["n_completed_buffers"] >= 5
            for problem in ("n_failures", "n_missing_packets", "n_missing_frames", "n_size_mismatch_errors"):
                assert counts[problem] == 0


def test_an_empty_buffer_that_comes_first_costs_no_picture(monkeypatch):
    """As Aravis hands it out on busy computers; a new buffer has the same status."""
    mission = simulated(12)
    with GigeCameraServer(mission, plate(0.4)) as server:
        camera = open_camera(server.url, section(12))
        assert isinstance(camera, GigeCamera)
        camera.open()
        call, empty = camera._aravis.call, []

        def called(name, *arguments):
            if name == "arv_stream_timeout_pop_buffer" and not empty:
                empty.append(call("arv_buffer_new_allocate", call("arv_camera_get_payload", camera._camera)))
                return empty[0]
            return call(name, *arguments)

        monkeypatch.setattr(camera._aravis, "call", called)
        exposure = camera.expose(1e-4, mission.orbit.start_utc_ns)
        camera.close()
    assert empty and exposure.dn.max() > 64


def test_the_client_gets_the_pixel_format_that_it_asked_for():
    seen = {}
    for name, depth in (("Mono8", 8), ("Mono16", 16), ("Mono12", 12)):
        mission = simulated(12)
        with GigeCameraServer(mission, plate(0.4)) as server:
            camera = open_camera(f"{server.url}?pixel_format={name}", section(depth))
            seen[name] = camera.expose(1e-4, mission.orbit.start_utc_ns).dn
            camera.close()
    np.testing.assert_array_equal(seen["Mono16"], seen["Mono12"] << 4)  # the same exposure, the same noise
    np.testing.assert_array_equal(seen["Mono8"], seen["Mono12"] >> 4)


def test_gain_amplifies_signal_and_noise_but_not_the_black_level():
    mission = simulated()
    library = ctypes.CDLL("libaravis-0.8.so.0")  # gain is for other clients: our driver leaves it alone
    with GigeCameraServer(mission, plate(0.2)) as server:
        camera = open_camera(server.url, mission.camera)
        assert isinstance(camera, GigeCamera)
        frames = []
        for gain_db in (0.0, 6.0):
            library.arv_camera_set_gain(ctypes.c_void_p(camera._camera), ctypes.c_double(gain_db), None)
            frames.append(camera.expose(1e-4, mission.orbit.start_utc_ns).dn.astype(float))
        camera.close()
    plain, amplified = frames
    assert (amplified.mean() - 64) / (plain.mean() - 64) == pytest.approx(10 ** (6 / 20), rel=0.01)
    assert amplified.std() > 1.5 * plain.std()


def test_a_colour_sensor_sends_its_mosaic():
    mission = simulated(12, channels=3)
    sky = np.broadcast_to([0.1, 0.2, 0.4], (SIZE_PX, SIZE_PX, 3))
    with GigeCameraServer(mission, lambda pose: sky) as server:
        camera = open_camera(server.url, mission.camera)
        dn = camera.expose(1e-4, mission.orbit.start_utc_ns).dn
        camera.close()
    np.testing.assert_allclose(dn.mean(axis=(0, 1)) - 64, [400, 800, 1600], rtol=0.01)


def test_slow_rendering_does_not_lose_the_client():
    """Rendering takes longer than the client's heartbeat allows a silent camera (3 s)."""
    mission = simulated()

    def slow(pose):
        time.sleep(4.0)
        return np.full((SIZE_PX, SIZE_PX, 1), 0.2)

    with GigeCameraServer(mission, slow) as server:
        camera = open_camera(server.url, mission.camera)
        exposure = camera.expose(1e-4, mission.orbit.start_utc_ns)
        assert float(exposure.dn.mean()) - 64 == pytest.approx(800, rel=0.02)
        camera.close()


def test_frames_captured_through_gige_have_the_poses_of_the_mission_s_times(tmp_path):
    mission = dataclasses.replace(simulated(), bracket=dataclasses.replace(MISSION.bracket, count=3))
    poses = []

    def sky(pose):
        poses.append(pose.position_body_m)
        return np.full((SIZE_PX, SIZE_PX, 1), 0.3)

    store = FrameStore(tmp_path)
    with GigeCameraServer(mission, sky) as server:
        camera = open_camera(server.url, mission.camera)
        assert camera.has_own_clock
        counts = capture(mission, camera, store)
        camera.close()
    assert counts.stored == 9
    for pose, stored in zip(poses, store.frames, strict=True):
        frame = decode_frame(store.read(stored.frame_id))
        np.testing.assert_allclose(frame.pose.position_body_m, pose, atol=1e-9)


def test_a_failure_in_rendering_loses_one_picture_and_not_the_camera(monkeypatch):
    monkeypatch.setattr("flightsw.cameras.gige.OWN_CLOCK_ANSWER_S", 1.0)
    failures = [ZeroDivisionError("a defect")]
    plain = plate(0.4)

    def sky(pose):
        if failures:
            raise failures.pop()
        return plain(pose)

    mission = simulated()
    with GigeCameraServer(mission, sky) as server:
        camera = open_camera(server.url, mission.camera)
        with pytest.raises(CaptureError, match="no picture"):
            camera.expose(1e-4, mission.orbit.start_utc_ns)
        monkeypatch.undo()
        assert camera.expose(1e-4, mission.orbit.start_utc_ns).dn.shape == (SIZE_PX, SIZE_PX)
        camera.close()
        assert (server.failures, server.exposures) == (1, 1)


def test_a_triggered_frame_that_is_not_ready_in_time_is_late_and_counted_by_the_camera():
    """The second picture takes longer than the simulated second at 100 times real time, the third does not."""
    mission = simulated()
    slow = iter((0.0, 0.1, 0.0))

    def sky(pose):
        time.sleep(next(slow))
        return np.full((SIZE_PX, SIZE_PX, 1), 0.2)

    with GigeCameraServer(mission, sky, real_time=100.0) as server:
        camera = open_camera(server.url, mission.camera)
        assert isinstance(camera, GigeCamera)
        began_s = time.monotonic()
        for elapsed_s in (0, 1, 150):
            camera.expose(1e-4, mission.orbit.start_utc_ns + elapsed_s * 1_000_000_000)
        assert time.monotonic() - began_s >= 1.5  # the last one was not given before its time
        late = aravis().call("arv_camera_get_integer", camera._camera, b"LateFrameCount")
        camera.close()
    assert (server.exposures, server.late_frames, late) == (3, 1, 1)


def test_a_taken_port_is_an_error_and_not_a_silent_camera():
    with fake_camera(), pytest.raises(OSError, match="in use"), GigeCameraServer(simulated(), plate(0.1)):
        pass
