"""The simulated camera as a GigE Vision camera on 127.0.0.1, by the fake camera of Aravis, which speaks the protocol.

A picture may take seconds to render, but the fake camera answers its client's heartbeat only between pictures. The
client therefore writes to trigger registers of our own (see gige.xml), and the fake camera is triggered when the
picture is ready.
"""

import ctypes
import dataclasses
import functools
import logging
import socket
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from flightsw.cameras.aravis import PIXEL_FORMATS, aravis
from flightsw.icd.frame import PoseTag
from flightsw.icd.mission import CameraSection, Mission
from flightsw.navigation.pose import pose_tag
from hil.sky.sensor import expose
from hil.watched import WatchedThread
from hil.world.clock import SimulatedClock
from hil.world.surroundings import Surroundings, seen

log = logging.getLogger(__name__)
DESCRIPTION = Path(__file__).with_name("gige.xml")
LOOPBACK, GVCP_PORT = "127.0.0.1", 3956
POLL_S = 1e-3
SEND_S = 1.0  # longest wait for the fake camera to take a picture
NS = 1_000_000_000

# Registers of Aravis' fake camera (arvfakecamera.h), and ours (gige.xml).
WIDTH, HEIGHT, GAIN_TENTH_DB, SENSOR_HEIGHT, SENSOR_WIDTH = 0x100, 0x104, 0x110, 0x118, 0x11C
EXPOSURE_US, ACQUISITION, PIXEL_FORMAT, OFFSET_X, OFFSET_Y = 0x120, 0x124, 0x128, 0x130, 0x134
FAKE_TRIGGER_MODE, FAKE_TRIGGER_SOURCE, FAKE_TRIGGER = 0x300, 0x304, 0x30C
TRIGGER_MODE, TRIGGER, LATE_FRAMES, FRAME_PERIOD_US, START_UTC_NS = 0xA000, 0xA00C, 0xA010, 0xA014, 0xA020
FillPattern = ctypes.CFUNCTYPE(
    None, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_uint32, ctypes.c_uint32, ctypes.c_uint32
)


class GigeCameraServer:
    """A GigE Vision camera at 127.0.0.1 until closed; `url` is what `flightsw --camera` takes.

    A software trigger exposes at the time in the feature ExposureStartUtcNs or, if that is 0, at the present simulated
    time, which runs from the mission's start in real time or `real_time` times as fast. Without a trigger the camera
    runs freely at its frame rate. LateFrameCount counts frames that were not ready in time: in free running they are
    left out, triggered ones are sent late. A picture's time stamp is the simulated time at which the shutter opened.
    With `moments` the exposures that no client gave a time for are taken at the moment nearest to the present simulated
    time, and after the last one the pass begins again: these pictures can be rendered beforehand.

    Args:
        radiance: gives the scene-linear radiance [H, W, C] for a true pose.
        surroundings: what else is in the pictures; None: a black sky.
        pose_at: UTC ns to the true pose; by default the mission's own orbits and attitude.
        real_time: with a factor a picture that was requested with its time is sent no earlier than its exposure has
            ended on the simulated clock; 0 is lock step.
        moments: mid-exposure times, UTC ns, in ascending order.

    Raises:
        CaptureError: Aravis is not installed.
        ValueError: flight cannot follow the real-time factor.
        OSError: another GigE Vision camera or client holds the port.
    """

    def __init__(
        self,
        mission: Mission,
        radiance: Callable[[PoseTag], np.ndarray],
        seed: int = 0,
        pose_at: Callable[[int], PoseTag] | None = None,
        real_time: float = 0.0,
        moments: Sequence[int] = (),
        surroundings: Surroundings | None = None,
    ):
        self.mission, self.radiance, self.seed = mission, radiance, seed
        self.surroundings = surroundings
        self.moments = moments
        self.pose_at = pose_at or functools.partial(pose_tag, mission)
        self.clock = SimulatedClock(mission, real_time)
        self.url = f"gige://{LOOPBACK}"
        self.exposures = self.failures = 0
        self._aravis = aravis()
        _require_free_port()  # the fake camera would stay silent
        self._device = self._aravis.call(
            "arv_gv_fake_camera_new_full", LOOPBACK.encode(), b"OBGF", str(DESCRIPTION).encode()
        )
        self._camera = self._aravis.call("arv_gv_fake_camera_get_fake_camera", self._device)
        self._picture, self._picture_utc_ns = b"", 0
        self._sent = threading.Event()
        self._stop = threading.Event()
        self._fill_callback = FillPattern(self._fill)  # kept for as long as the camera may call it
        self._set_up()
        self._started_s = time.monotonic()
        self._thread = WatchedThread("GigE camera server", self._run)
        self._thread.start()

    @property
    def late_frames(self) -> int:
        return self.clock.late_frames

    def __enter__(self) -> "GigeCameraServer":
        return self

    def check(self) -> None:
        """Raise ServerError if the server's thread has failed."""
        self._thread.check()

    def __exit__(self, kind: object, *_: object) -> None:
        self._stop.set()
        self._thread.join()
        self._aravis.unref(self._device)
        if kind is None:
            self.check()

    def _set_up(self) -> None:
        camera = self.mission.camera
        bits = next(bits for bits in (8, 12, 16) if bits >= camera.bit_depth)
        number = PIXEL_FORMATS[f"{'Mono' if camera.channels == 1 else 'BayerRG'}{bits}"][0]
        for address, value in (
            (SENSOR_WIDTH, camera.width),
            (SENSOR_HEIGHT, camera.height),
            (WIDTH, camera.width),
            (HEIGHT, camera.height),
            (PIXEL_FORMAT, number),
            (EXPOSURE_US, round(self.mission.bracket.exposure_times_ms[0] * 1e3)),
            (GAIN_TENTH_DB, 0),
            (FRAME_PERIOD_US, 40_000),
            (FAKE_TRIGGER_SOURCE, 1),
            (FAKE_TRIGGER_MODE, 1),
        ):
            self._write(address, value)
        call = self._aravis.call
        # How often the fake camera polls its trigger.
        call("arv_fake_camera_set_trigger_frequency", self._camera, 1 / POLL_S)
        fill = ctypes.cast(self._fill_callback, ctypes.c_void_p)
        call("arv_fake_camera_set_fill_pattern", self._camera, fill, None)

    def _run(self) -> None:
        due_s = time.monotonic()
        while not self._stop.wait(POLL_S):
            now_s = time.monotonic()
            if not self._read(ACQUISITION):
                due_s = now_s
            elif self._read(TRIGGER_MODE):
                if self._read(TRIGGER):
                    self._write(TRIGGER, 0)
                    requested_utc_ns = self._read(START_UTC_NS, 8)
                    self._take(requested_utc_ns or self._simulated_utc_ns(), timed=bool(requested_utc_ns))
            elif now_s >= due_s:
                self._take(self._simulated_utc_ns(), timed=False)
                period_s = max(self._read(FRAME_PERIOD_US), 1000) / 1e6
                late = int((time.monotonic() - due_s) / period_s)
                self.clock.late_frames += late
                self._write(LATE_FRAMES, self.late_frames)
                due_s += (late + 1) * period_s

    def _simulated_utc_ns(self) -> int:
        elapsed_s = (time.monotonic() - self._started_s) * (self.clock.factor or 1.0)
        return self.mission.orbit.start_utc_ns + round(elapsed_s * NS)

    def _moment_for(self, utc_ns: int) -> int:
        """Return the moment of the pass, which is repeated, that is nearest to a time; without moments the time."""
        if not self.moments:
            return utc_ns
        first, last = self.moments[0], self.moments[-1]
        period_ns = last - first + max(1, round(self.mission.bracket.interval_s * NS))
        in_pass_ns = first + (utc_ns - first) % period_ns
        return min(self.moments, key=lambda moment: abs(moment - in_pass_ns))

    def _take(self, start_utc_ns: int, timed: bool) -> None:
        """Expose and let the fake camera send the picture; if its time was given (`timed`), not before that.

        If rendering fails, the client receives no picture.
        """
        exposure_s = self._read(EXPOSURE_US) / 1e6
        half_ns = round(exposure_s * NS / 2)
        noise_seed = (self.seed, start_utc_ns + half_ns)  # two exposures at one moment differ in their noise
        mid_ns = start_utc_ns + half_ns if timed else self._moment_for(start_utc_ns + half_ns)
        gain = 10 ** (self._read(GAIN_TENTH_DB) / 200)
        camera = self.mission.camera
        try:
            pose = self.pose_at(mid_ns)
            radiance, true = seen(self.mission, self.radiance, self.surroundings, pose, mid_ns)
            amplified = dataclasses.replace(
                true,
                dn_per_radiance_s=camera.dn_per_radiance_s * gain,
                electrons_per_dn=camera.electrons_per_dn / gain,
            )
            dn = expose(radiance, exposure_s, amplified, np.random.default_rng(noise_seed))
            self._picture = self._encode(dn, camera)
        except Exception as error:  # whatever fails in rendering, later triggers must be served
            self.failures += 1
            log.warning("no picture: %r", error)
            return
        if timed:
            self.clock.release(mid_ns + half_ns, self._stop.wait)
            self._write(LATE_FRAMES, self.late_frames)
        self._picture_utc_ns = mid_ns - half_ns
        self._sent.clear()
        self._write(FAKE_TRIGGER, 1)
        if self._sent.wait(SEND_S):
            self.exposures += 1
        else:
            self._write(FAKE_TRIGGER, 0)  # the client has stopped meanwhile

    def _encode(self, dn: np.ndarray, camera: CameraSection) -> bytes:
        """Return the region that the client has set, in its pixel format, from the sensor's digital numbers."""
        number = self._read(PIXEL_FORMAT)
        names = [name for name, (known, *_) in PIXEL_FORMATS.items() if known == number]
        if not names:
            raise ValueError(f"pixel format {number:#x} is not offered")
        _, bits, pattern = PIXEL_FORMATS[names[0]]
        dn = dn.reshape(*dn.shape[:2], -1).astype(np.uint32)
        if pattern and dn.shape[2] == 3:  # colour sensor: RGGB
            mosaic = dn[..., 1].copy()
            mosaic[::2, ::2], mosaic[1::2, 1::2] = dn[::2, ::2, 0], dn[1::2, 1::2, 2]
        else:
            mosaic = np.rint(dn.mean(axis=2)).astype(np.uint32)
        shift = camera.bit_depth - bits
        mosaic = mosaic >> shift if shift >= 0 else mosaic << -shift
        x, y = self._read(OFFSET_X), self._read(OFFSET_Y)
        region = mosaic[y : y + self._read(HEIGHT), x : x + self._read(WIDTH)]
        return region.astype(np.uint8 if bits == 8 else "<u2").tobytes()

    def _fill(self, buffer: int, _data: int, _exposure_us: int, _gain: int, _format: int) -> None:
        """Copy the picture into the buffer that the fake camera sends; runs in its thread."""
        size = ctypes.c_size_t()
        data = self._aravis.call("arv_buffer_get_data", buffer, ctypes.byref(size))
        ctypes.memmove(data, self._picture, len(self._picture))
        self._aravis.call("arv_buffer_set_timestamp", buffer, self._picture_utc_ns)
        self._sent.set()

    def _read(self, address: int, size: int = 4) -> int:
        value = ctypes.create_string_buffer(size)
        self._aravis.call("arv_fake_camera_read_memory", self._camera, address, size, value)
        return int.from_bytes(value.raw, "big")

    def _write(self, address: int, value: int) -> None:
        data = value.to_bytes(4, "big")
        self._aravis.call("arv_fake_camera_write_memory", self._camera, address, len(data), data)


def _require_free_port() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.bind((LOOPBACK, GVCP_PORT))
        except OSError as error:
            raise OSError(
                f"UDP port {GVCP_PORT} of {LOOPBACK} is in use: a machine has one simulated GigE camera, and another "
                "camera or client runs; stop it, or use the hil camera"
            ) from error
