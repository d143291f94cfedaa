"""Aravis (GigE Vision and USB3 Vision) through ctypes: only the functions that are called here, with their errors."""

import ctypes
import functools
from typing import Any

from flightsw.errors import CaptureError
from obbgs_base.errors import reason

# GenICam pixel formats (PFNC 2.x) that are understood here: name, number, bits of a sample, Bayer pattern.
PIXEL_FORMATS = {
    "Mono8": (0x01080001, 8, ""),
    "Mono10": (0x01100003, 10, ""),
    "Mono12": (0x01100005, 12, ""),
    "Mono14": (0x01100025, 14, ""),
    "Mono16": (0x01100007, 16, ""),
    "BayerGR8": (0x01080008, 8, "GR"),
    "BayerRG8": (0x01080009, 8, "RG"),
    "BayerGB8": (0x0108000A, 8, "GB"),
    "BayerBG8": (0x0108000B, 8, "BG"),
    "BayerGR12": (0x01100010, 12, "GR"),
    "BayerRG12": (0x01100011, 12, "RG"),
    "BayerGB12": (0x01100012, 12, "GB"),
    "BayerBG12": (0x01100013, 12, "BG"),
    "BayerGR16": (0x0110002E, 16, "GR"),
    "BayerRG16": (0x0110002F, 16, "RG"),
    "BayerGB16": (0x01100030, 16, "GB"),
    "BayerBG16": (0x01100031, 16, "BG"),
}
BUFFER_SUCCESS, BUFFER_CLEARED = 0, 1
BUFFER_STATUS = {
    2: "timeout",
    3: "missing packets",
    4: "wrong packet",
    5: "size mismatch",
    6: "filling",
    7: "aborted",
}

P, S, I32, U32, U64, F64 = (
    ctypes.c_void_p,
    ctypes.c_char_p,
    ctypes.c_int,
    ctypes.c_uint32,
    ctypes.c_uint64,
    ctypes.c_double,
)


class AravisError(CaptureError):
    """The library reports an error of the device: it does not answer, or refuses a value."""


class _GError(ctypes.Structure):
    _fields_ = (("domain", ctypes.c_uint32), ("code", ctypes.c_int), ("message", ctypes.c_char_p))


# Functions whose last argument is GError**: result, then the other arguments.
WITH_ERROR = {
    "arv_camera_new": (P, S),
    "arv_camera_create_stream": (P, P, P, P),
    "arv_camera_set_region": (None, P, I32, I32, I32, I32),
    "arv_camera_set_pixel_format_from_string": (None, P, S),
    "arv_camera_get_pixel_format": (U32, P),
    "arv_camera_set_trigger": (None, P, S),
    "arv_camera_software_trigger": (None, P),
    "arv_camera_set_exposure_time": (None, P, F64),
    "arv_camera_get_exposure_time": (F64, P),
    "arv_camera_get_payload": (U32, P),
    "arv_camera_start_acquisition": (None, P),
    "arv_camera_stop_acquisition": (None, P),
    "arv_camera_is_feature_available": (I32, P, S),
    "arv_camera_set_integer": (None, P, S, ctypes.c_int64),
    "arv_camera_get_integer": (ctypes.c_int64, P, S),
    "arv_camera_set_string": (None, P, S, S),
    "arv_camera_get_string": (S, P, S),
    "arv_camera_set_boolean": (None, P, S, I32),
    "arv_camera_get_boolean": (I32, P, S),
}
PLAIN = {
    "arv_buffer_new_allocate": (P, ctypes.c_size_t),
    "arv_buffer_get_status": (I32, P),
    "arv_buffer_get_data": (P, P, ctypes.POINTER(ctypes.c_size_t)),
    "arv_buffer_get_image_width": (I32, P),
    "arv_buffer_get_image_height": (I32, P),
    "arv_buffer_get_image_pixel_format": (U32, P),
    "arv_buffer_get_timestamp": (U64, P),
    "arv_buffer_set_timestamp": (None, P, U64),
    "arv_buffer_get_frame_id": (U64, P),
    "arv_stream_push_buffer": (None, P, P),
    "arv_stream_try_pop_buffer": (P, P),
    "arv_stream_timeout_pop_buffer": (P, P, U64),
    "arv_stream_get_info_uint64_by_name": (U64, P, S),
    "arv_gv_fake_camera_new_full": (P, S, S, S),
    "arv_gv_fake_camera_is_running": (I32, P),
    "arv_gv_fake_camera_get_fake_camera": (P, P),
    "arv_fake_camera_set_fill_pattern": (None, P, P, P),
    "arv_fake_camera_set_trigger_frequency": (None, P, F64),
    "arv_fake_camera_read_memory": (I32, P, U32, U32, P),
    "arv_fake_camera_write_memory": (I32, P, U32, U32, P),
}


class Aravis:
    """The library; `call` turns a GError into an AravisError."""

    def __init__(self) -> None:
        try:
            self._aravis = ctypes.CDLL("libaravis-0.8.so.0")
            self._gobject = ctypes.CDLL("libgobject-2.0.so.0")
            self._glib = ctypes.CDLL("libglib-2.0.so.0")
        except OSError as error:
            raise CaptureError(
                f"Aravis is missing ({reason(error)}); on Debian: apt-get install libaravis-0.8-0"
            ) from error
        self._glib.g_clear_error.argtypes = (ctypes.POINTER(ctypes.POINTER(_GError)),)
        self._gobject.g_object_unref.argtypes = (P,)
        for name, (result, *arguments) in (WITH_ERROR | PLAIN).items():
            function = getattr(self._aravis, name)
            function.restype = result
            function.argtypes = [
                *arguments,
                *([ctypes.POINTER(ctypes.POINTER(_GError))] if name in WITH_ERROR else []),
            ]

    def call(self, name: str, *arguments: Any) -> Any:
        """Return what a function returns.

        Raises:
            AravisError: the function reported an error.
        """
        if name in PLAIN:
            return getattr(self._aravis, name)(*arguments)
        error = ctypes.POINTER(_GError)()
        result = getattr(self._aravis, name)(*arguments, ctypes.byref(error))
        if error:
            message = error.contents.message.decode(errors="replace")
            self._glib.g_clear_error(ctypes.byref(error))
            raise AravisError(
                f"{name.removeprefix('arv_camera_').replace('_', ' ')}: {message}".removeprefix("new: ")
            )
        return result

    def unref(self, thing: int | None) -> None:
        if thing:
            self._gobject.g_object_unref(thing)


@functools.cache
def aravis() -> Aravis:
    """Return the library, loaded once.

    Raises:
        CaptureError: it is not installed.
    """
    return Aravis()
