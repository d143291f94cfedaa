"""A camera that answers over a socket: hil:///path/to/socket or hil://host:port.

A request is a line of JSON, a reply a line of JSON and the pixels, little-endian 16-bit numbers.
"""

import contextlib
import json
import socket
from io import BufferedRWPair

import numpy as np

from flightsw.cameras.camera import OWN_CLOCK_ANSWER_S, Exposure
from flightsw.errors import CameraLost, CaptureError
from obbgs_base.errors import reason

CONNECT_S = 10.0
MAX_BYTES = 8192 * 8192 * 3 * 2


class NetworkedCamera:
    """Client of a camera server, which has a clock of its own.

    After a broken connection, or a reply that cannot be read, the next exposure connects anew.

    Raises:
        CameraLost: there is no server.
        ValueError: the URL names neither a socket nor a host and its port.
    """

    has_own_clock = True
    packets_lost = 0  # the socket loses none

    def __init__(self, url: str):
        host, _, port = url.removeprefix("hil://").rpartition(":")
        is_socket = url.startswith("hil:///") and len(url) > len("hil:///")
        if not is_socket and not (host and port.isdecimal() and 0 < int(port) < 65_536):
            raise ValueError(f"expected hil:///path/to/socket or hil://host:port, got {url!r}")
        self._url = url
        self._stream: BufferedRWPair | None = None
        self.open()

    def open(self) -> None:
        """Connect, unless connected.

        Raises:
            CameraLost: there is no server.
        """
        if self._stream is not None:
            return
        address = self._url.removeprefix("hil://")
        try:
            if address.startswith("/"):
                connection = socket.socket(socket.AF_UNIX)
                connection.settimeout(CONNECT_S)
                try:
                    connection.connect(address)
                except OSError:
                    connection.close()
                    raise
            else:
                host, _, port = address.rpartition(":")
                connection = socket.create_connection((host, int(port)), timeout=CONNECT_S)
        except OSError as error:
            raise CameraLost(
                f"no camera at {self._url}: {reason(error)}; start the camera's server"
            ) from error
        connection.settimeout(OWN_CLOCK_ANSWER_S)
        self._stream = connection.makefile("rwb")
        connection.close()  # the stream keeps the connection

    def expose(self, exposure_time_s: float, start_utc_ns: int) -> Exposure:
        """Return one exposure.

        Raises:
            CameraLost: the connection broke, or the reply cannot be read.
            CaptureError: the camera refuses.
        """
        self.open()
        assert self._stream is not None
        request = {"op": "expose", "exposure_time_s": exposure_time_s, "start_utc_ns": start_utc_ns}
        try:
            self._stream.write(json.dumps(request).encode() + b"\n")
            self._stream.flush()
            return self._read_reply(self._stream)
        except CameraLost:
            self.close()
            raise
        except (OSError, KeyError, TypeError, ValueError) as error:
            self.close()
            raise CameraLost(f"the camera's reply cannot be read: {reason(error)}") from error

    def close(self) -> None:
        """Close the connection; the next exposure connects anew."""
        stream, self._stream = self._stream, None
        if stream is not None:
            with contextlib.suppress(OSError):  # a request that was never sent
                stream.close()

    def _read_reply(self, stream: BufferedRWPair) -> Exposure:
        line = stream.readline()
        if not line:
            raise CameraLost("the camera closed the connection")
        reply = json.loads(line)
        if not reply["ok"]:
            raise CaptureError(f"the camera refused: {reply['error']}")
        shape = (int(reply["height"]), int(reply["width"]), int(reply["channels"]))
        if reply["nbytes"] != 2 * shape[0] * shape[1] * shape[2] or reply["nbytes"] > MAX_BYTES:
            raise CameraLost(f"the camera announced {reply['nbytes']} bytes for {shape}")
        pixels = stream.read(reply["nbytes"])
        if len(pixels) != reply["nbytes"]:
            raise CameraLost(f"the camera sent {len(pixels)} of {reply['nbytes']} bytes")
        dn = np.frombuffer(pixels, dtype="<u2").astype(np.uint16).reshape(shape)
        return Exposure(
            dn[..., 0] if shape[2] == 1 else dn, reply["exposure_time_s"], reply["mid_exposure_utc_ns"]
        )
