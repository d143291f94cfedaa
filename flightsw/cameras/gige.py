"""GigE Vision and USB3 Vision cameras through Aravis: gige://<device id or IP address>?pixel_format=Mono12."""

import ctypes
import logging
import threading
import time
from collections.abc import Callable
from urllib.parse import parse_qs

import numpy as np

from flightsw.cameras.aravis import (
    BUFFER_CLEARED,
    BUFFER_STATUS,
    BUFFER_SUCCESS,
    PIXEL_FORMATS,
    AravisError,
    aravis,
)
from flightsw.cameras.camera import OWN_CLOCK_ANSWER_S, Exposure
from flightsw.clock import utc_ns
from flightsw.errors import CameraLost, CaptureError
from flightsw.icd.mission import CameraSection
from obbgs_base.errors import counted

log = logging.getLogger(__name__)
NS = 1_000_000_000
BUFFERS = 3
ANSWER_S = 3.0  # from the end of an exposure to its last packet
LATE_S = 0.5  # an exposure that is asked for so long after its time is not taken
CLOCK_S = 1.0  # a camera whose time stamps differ from our clock by less keeps UTC (PTP, IEEE 1588)
# What changes readings in other proportion than the exposure time (Standard Features Naming Convention of GenICam):
AUTOMATIC, GAMMA = (b"ExposureAuto", b"GainAuto", b"BalanceWhiteAuto"), b"GammaEnable"
START_TIME = b"ExposureStartUtcNs"  # feature of a camera whose clock can be set to the start of an exposure


class GigeCamera:
    """One camera, triggered by software; opened again after it was lost.

    The region and the pixel format are set to the mission's camera: Mono8, Mono12 or Mono16 by its bit depth,
    unless the URL names a format. Automatic exposure, gain and white balance and gamma are switched off. A Bayer
    mosaic goes as it is into a frame of one channel, interpolated into one of three.

    Raises:
        CameraLost: the camera does not answer, or cannot be what the mission expects, or leaves something
            automatic on.
        ValueError: the URL names no camera, an unknown pixel format or another option.
    """

    def __init__(self, url: str, section: CameraSection):
        device, _, query = url.removeprefix("gige://").partition("?")
        options = parse_qs(query, keep_blank_values=True)
        if not device or set(options) - {"pixel_format"}:
            raise ValueError(
                f"expected gige://ID, its IP address for the ID, and no option but ?pixel_format=Mono12, got {url!r}"
            )
        self._format = options["pixel_format"][0] if options else _format_for(section)
        if self._format not in PIXEL_FORMATS:
            raise ValueError(
                f"pixel format {self._format!r} of {url!r}; expected one of {', '.join(PIXEL_FORMATS)}"
            )
        if PIXEL_FORMATS[self._format][1] != section.bit_depth:
            raise ValueError(
                f"{self._format} has {PIXEL_FORMATS[self._format][1]} bits, the mission's camera "
                f"{section.bit_depth}: name another pixel_format in {url!r}"
            )
        self._url, self._device, self._section = url, device.encode(), section
        self._aravis = aravis()
        self._camera = self._stream = None
        self._packets_before = (0, 0)
        self.has_own_clock = False  # known once the camera is open
        self.open()

    @property
    def packets_lost(self) -> int:
        """Packets of pictures that never came, resends included, since the first opening."""
        return self._packets_before[0] + self._packets()[0]

    @property
    def packets_resent(self) -> int:
        return self._packets_before[1] + self._packets()[1]

    def expose(self, exposure_time_s: float, start_utc_ns: int) -> Exposure:
        """Return one exposure. A camera with a clock of its own is told the time at which it begins.

        The exposure time is the one that the camera reports; its middle is counted from the camera's time stamp when
        the camera's clock keeps UTC, otherwise from the moment of the trigger.

        Raises:
            CameraLost: the camera does not answer any more.
            CaptureError: too late, no picture, a picture with packets missing, or of another size.
        """
        self.open()
        late_s = (utc_ns() - start_utc_ns) / NS
        if not self.has_own_clock and late_s > LATE_S:
            raise CaptureError(f"the exposure was due {late_s:.1f} s ago")
        try:
            return self._expose(exposure_time_s, start_utc_ns)
        except CaptureError as error:
            if isinstance(error, AravisError) or not self._alive():
                # in a thread: closing a camera that does not answer takes Aravis ten seconds
                threading.Thread(target=self._release(), name="gige close", daemon=True).start()
                raise CameraLost(f"{self._url}: {error}") from error
            raise

    def close(self) -> None:
        """Stop the acquisition and give the camera back, if it is open."""
        if self._camera is not None:
            try:
                self._aravis.call("arv_camera_stop_acquisition", self._camera)
            except AravisError as error:
                log.warning("%s: %s", self._url, error)
        self._release()()

    def open(self) -> None:
        """Open the camera and set it up, unless it is open.

        Raises:
            CameraLost: it does not answer, or refuses a setting.
        """
        if self._camera is not None:
            return
        call, section = self._aravis.call, self._section
        try:
            self._camera = call("arv_camera_new", self._device)
            if not self._camera:
                raise CaptureError("it does not answer")
            call("arv_camera_set_pixel_format_from_string", self._camera, self._format.encode())
            call("arv_camera_set_region", self._camera, 0, 0, section.width, section.height)
            self._switch_off_automatics()
            call("arv_camera_set_trigger", self._camera, b"Software")
            self.has_own_clock = bool(call("arv_camera_is_feature_available", self._camera, START_TIME))
            self._stream = call("arv_camera_create_stream", self._camera, None, None)
            payload_bytes = call("arv_camera_get_payload", self._camera)
            for _ in range(BUFFERS):
                call("arv_stream_push_buffer", self._stream, call("arv_buffer_new_allocate", payload_bytes))
            call("arv_camera_start_acquisition", self._camera)
        except CaptureError as error:
            self._release()()
            raise CameraLost(
                f"no camera at {self._url}: {error}; `arv-tool-0.8` of Debian's aravis-tools lists those that answer"
            ) from error

    def _switch_off_automatics(self) -> None:
        """Switch off whatever keeps readings from following the exposure time, and read back whether it is off.

        Raises:
            CaptureError: the camera leaves it on.
        """
        call, camera = self._aravis.call, self._camera

        def state(name: bytes) -> str:
            if name == GAMMA:
                return "On" if call("arv_camera_get_boolean", camera, name) else "Off"
            return call("arv_camera_get_string", camera, name).decode()

        for name in (*AUTOMATIC, GAMMA):
            if not call("arv_camera_is_feature_available", camera, name) or (before := state(name)) == "Off":
                continue
            refusal = ""
            try:
                if name == GAMMA:
                    call("arv_camera_set_boolean", camera, name, 0)
                else:
                    call("arv_camera_set_string", camera, name, b"Off")
            except AravisError as error:
                refusal = f" ({error})"
            if (after := state(name)) != "Off":
                raise CaptureError(
                    f"{name.decode()} stays {after}{refusal}: readings would not follow the exposure time; switch it "
                    "off with the vendor's program and keep that in the user set that the camera starts with"
                )
            log.warning("%s: %s was %s and is switched off", self._url, name.decode(), before)

    def _release(self) -> Callable[[], None]:
        """Forget the camera, and return what gives it back to Aravis."""
        self._packets_before = (self.packets_lost, self.packets_resent)
        stream, camera, self._stream, self._camera = self._stream, self._camera, None, None

        def give_back() -> None:
            self._aravis.unref(stream)
            self._aravis.unref(camera)

        return give_back

    def _alive(self) -> bool:
        try:
            self._aravis.call("arv_camera_get_exposure_time", self._camera)
        except AravisError:
            return False
        return True

    def _packets(self) -> tuple[int, int]:
        if self._stream is None:
            return 0, 0
        lost, resent = (
            self._aravis.call("arv_stream_get_info_uint64_by_name", self._stream, name)
            for name in (b"n_missing_packets", b"n_resent_packets")
        )
        return lost, resent

    def _expose(self, exposure_time_s: float, start_utc_ns: int) -> Exposure:
        call = self._aravis.call
        while stale := call("arv_stream_try_pop_buffer", self._stream):  # of an exposure given up before
            call("arv_stream_push_buffer", self._stream, stale)
        call("arv_camera_set_exposure_time", self._camera, round(exposure_time_s * 1e6, 3))
        taken_s = call("arv_camera_get_exposure_time", self._camera) / 1e6
        if self.has_own_clock:
            call("arv_camera_set_integer", self._camera, START_TIME, start_utc_ns)
        triggered_utc_ns = utc_ns()
        call("arv_camera_software_trigger", self._camera)
        wait_s = exposure_time_s + (OWN_CLOCK_ANSWER_S if self.has_own_clock else ANSWER_S)
        buffer = self._next_buffer(wait_s)
        if not buffer:
            raise CaptureError(f"no picture within {wait_s:.1f} s")
        try:
            status = call("arv_buffer_get_status", buffer)
            if status != BUFFER_SUCCESS:
                raise CaptureError(
                    f"the picture is incomplete ({BUFFER_STATUS.get(status, 'unknown')}); "
                    f"{counted(self.packets_lost, 'packet')} lost so far"
                )
            stamp_ns = call("arv_buffer_get_timestamp", buffer)
            dn = self._pixels(buffer)
        finally:
            call("arv_stream_push_buffer", self._stream, buffer)
        keeps_utc = self.has_own_clock or abs(stamp_ns - triggered_utc_ns) < CLOCK_S * NS
        opened_utc_ns = stamp_ns if keeps_utc else triggered_utc_ns
        return Exposure(dn, taken_s, opened_utc_ns + round(taken_s * NS / 2))

    def _next_buffer(self, wait_s: float) -> int | None:
        """Return the next buffer that is not empty; None if none came in time.

        On busy computers Aravis has handed out buffers that it had only cleared; they are given back to it.
        """
        deadline_s = time.monotonic() + wait_s
        while (left_s := deadline_s - time.monotonic()) > 0:
            buffer = self._aravis.call("arv_stream_timeout_pop_buffer", self._stream, round(left_s * 1e6))
            if not buffer or self._aravis.call("arv_buffer_get_status", buffer) != BUFFER_CLEARED:
                return buffer
            log.warning("%s: Aravis handed out an empty buffer; still waiting for the picture", self._url)
            self._aravis.call("arv_stream_push_buffer", self._stream, buffer)
        return None

    def _pixels(self, buffer: int) -> np.ndarray:
        call = self._aravis.call
        width, height = (
            call("arv_buffer_get_image_width", buffer),
            call("arv_buffer_get_image_height", buffer),
        )
        number, bits, pattern = PIXEL_FORMATS[self._format]
        sent = call("arv_buffer_get_image_pixel_format", buffer)
        if sent != number or (width, height) != (self._section.width, self._section.height):
            raise CaptureError(
                f"asked for {self._section.width}x{self._section.height} {self._format}, "
                f"got {width}x{height} format {sent:#x}"
            )
        size = ctypes.c_size_t()
        data = call("arv_buffer_get_data", buffer, ctypes.byref(size))
        kind = np.dtype(np.uint8 if bits == 8 else "<u2")
        if size.value < width * height * kind.itemsize:
            raise CaptureError(f"{size.value} bytes for {width}x{height} {self._format}")
        raw = np.frombuffer(ctypes.string_at(data, width * height * kind.itemsize), kind)
        dn = raw.astype(np.uint16).reshape(height, width)
        if self._section.channels == 1:
            return dn
        return demosaic(dn, pattern) if pattern else np.repeat(dn[..., None], 3, axis=2)


def _format_for(section: CameraSection) -> str:
    colour = "Mono" if section.channels == 1 else "BayerRG"
    return f"{colour}{section.bit_depth}"


def demosaic(mosaic: np.ndarray, pattern: str) -> np.ndarray:
    """Return the colours [H, W, 3] of a Bayer mosaic [H, W]: what a pixel saw, else the mean of its neighbours.

    Args:
        pattern: the colours of the first two pixels of the first row: RG, GR, GB or BG.
    """
    tile = np.array([list(pattern), list({"RG": "GB", "GR": "BG", "GB": "RG", "BG": "GR"}[pattern])])
    height, width = mosaic.shape
    colours = np.tile(tile, (height // 2 + 1, width // 2 + 1))[:height, :width]
    kernel = ((1, 2, 1), (2, 4, 2), (1, 2, 1))
    out = np.empty((height, width, 3), np.uint16)
    for index, name in enumerate("RGB"):
        seen = colours == name
        values, weights = np.where(seen, mosaic, 0.0), seen.astype(float)
        mean = _convolve(values, kernel) / np.maximum(_convolve(weights, kernel), 1e-9)
        out[..., index] = np.where(seen, mosaic, np.rint(mean)).astype(np.uint16)
    return out


def _convolve(image: np.ndarray, kernel: tuple) -> np.ndarray:
    padded = np.pad(image, 1)
    height, width = image.shape
    return sum(
        (kernel[dy][dx] * padded[dy : dy + height, dx : dx + width] for dy in range(3) for dx in range(3)),
        start=np.zeros(image.shape),
    )
