"""The simulator's camera over a socket: hil:///path/to/socket or hil://host:port."""

import json
import socket

import numpy as np

from flightsw.cameras import Exposure
from flightsw.errors import CaptureError

TIMEOUT_S = 120.0  # a frame that is not in the simulator's cache has to be rendered first
MAX_BYTES = 8192 * 8192 * 3 * 2


class HilCamera:
    """Client of the simulator's camera server; its time is the simulator's, which waits for us."""

    waits = False
    packets_lost = 0  # the socket loses none

    def __init__(self, url: str):
        address = url.removeprefix("hil://")
        try:
            if address.startswith("/"):
                self._socket = socket.socket(socket.AF_UNIX)
                self._socket.settimeout(TIMEOUT_S)
                self._socket.connect(address)
            else:
                host, _, port = address.rpartition(":")
                self._socket = socket.create_connection((host, int(port)), timeout=TIMEOUT_S)
        except (OSError, ValueError) as error:
            raise CaptureError(f"no camera at {url}: {error}; start one with `hil camera`") from error
        self._stream = self._socket.makefile("rwb")

    def expose(self, exposure_time_s: float, start_utc_ns: int) -> Exposure:
        request = {"op": "expose", "exposure_time_s": exposure_time_s, "start_utc_ns": start_utc_ns}
        try:
            self._stream.write(json.dumps(request).encode() + b"\n")
            self._stream.flush()
            line = self._stream.readline()
            if not line:
                raise CaptureError("the camera closed the connection")
            reply = json.loads(line)
            if not reply["ok"]:
                raise CaptureError(f"the camera refused: {reply['error']}")
            shape = (int(reply["height"]), int(reply["width"]), int(reply["channels"]))
            if reply["nbytes"] != 2 * shape[0] * shape[1] * shape[2] or reply["nbytes"] > MAX_BYTES:
                raise CaptureError(f"the camera announced {reply['nbytes']} bytes for {shape}")
            pixels = self._stream.read(reply["nbytes"])
        except (OSError, KeyError, TypeError, ValueError) as error:
            raise CaptureError(f"the camera's reply cannot be read: {error}") from error
        if len(pixels) != reply["nbytes"]:
            raise CaptureError(f"the camera sent {len(pixels)} of {reply['nbytes']} bytes")
        dn = np.frombuffer(pixels, dtype="<u2").astype(np.uint16).reshape(shape)
        return Exposure(
            dn[..., 0] if shape[2] == 1 else dn, reply["exposure_time_s"], reply["mid_exposure_utc_ns"]
        )

    def close(self) -> None:
        self._stream.close()
        self._socket.close()
