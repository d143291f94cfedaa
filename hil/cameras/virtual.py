"""The simulated camera as a socket server: it renders and exposes the target at the requested time.

Protocol hil://: each request is one JSON line, each reply one JSON line and `nbytes` of little-endian uint16 pixels.
The request says when the shutter opens. In lock step the reply is sent when the picture is ready; with a real-time
factor not before the exposure has ended on the simulated clock, and `late_frames` counts the pictures that were not
ready by then.
"""

import json
import logging
import os
import socket
import socketserver
import threading
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

from flightsw.errors import FlightError
from flightsw.icd.frame import PoseTag
from flightsw.icd.mission import Mission
from flightsw.navigation.pose import pose_tag
from hil.sky.blender import BlenderError
from hil.sky.sensor import expose
from hil.watched import WatchedThread
from hil.world.clock import SimulatedClock
from hil.world.surroundings import Surroundings, seen
from obbgs_base.errors import in_words, reason

log = logging.getLogger(__name__)
MAX_SOCKET_PATH_BYTES = 107  # sun_path of Linux
POLL_S = 0.02  # how soon it notices that it is closed
ANSWER_S = 1.0  # how long another server may take to accept a connection


class CameraServer:
    """Serves the mission's camera until closed; `url` is what `flightsw --camera` takes.

    Args:
        radiance: gives the scene-linear radiance [H, W, C] for a true pose.
        surroundings: what else is in the pictures; None: a black sky.
        listen: path of a Unix socket, or hil:///path/to/socket, or hil://host:port (port 0 chooses a free one).
        pose_at: UTC ns to the true pose; by default the mission's own orbits and attitude.
        real_time: how many times as fast as real time the simulated clock runs; 0 is lock step.

    Raises:
        ValueError: `listen` is none of these, its path is too long or holds a file that is not a socket; or flight
            cannot follow the real-time factor.
        OSError: the address is taken, by another camera for instance, or not this machine's.
    """

    def __init__(
        self,
        mission: Mission,
        radiance: Callable[[PoseTag], np.ndarray],
        listen: Path | str,
        seed: int = 0,
        pose_at: Callable[[int], PoseTag] | None = None,
        real_time: float = 0.0,
        surroundings: Surroundings | None = None,
    ):
        self.mission, self.radiance, self.seed = mission, radiance, seed
        self.surroundings = surroundings
        self.pose_at = pose_at or partial(pose_tag, mission)
        self.clock = SimulatedClock(mission, real_time)
        self.exposures = self.failures = 0
        self._closing = threading.Event()
        camera = self

        class Handler(socketserver.StreamRequestHandler):
            def handle(self) -> None:
                try:
                    for line in self.rfile:
                        header, pixels = camera.answer(line)
                        self.wfile.write(json.dumps(header).encode() + b"\n" + pixels)
                except OSError as error:
                    log.warning("a client disconnected during a request: %s", in_words(error))

        address = _address(listen)
        try:
            if isinstance(address, str):
                self._server = _UnixServer(address, Handler)
                self.url = f"hil://{address}"
            else:
                self._server = _TcpServer(address, Handler)
                host, port = self._server.server_address[:2]
                self.url = f"hil://{host}:{port}"
        except OSError as error:  # which does not say where
            raise OSError(error.errno, error.strerror, str(listen)) from error
        self._socket_file = Path(address) if isinstance(address, str) else None
        self._bound = _identity(self._socket_file)
        self._thread = WatchedThread("camera server", lambda: self._server.serve_forever(POLL_S))
        self._thread.start()

    def __enter__(self) -> "CameraServer":
        return self

    @property
    def late_frames(self) -> int:
        return self.clock.late_frames

    def check(self) -> None:
        """Raise ServerError if the server's thread has failed."""
        self._thread.check()

    def __exit__(self, kind: object, *_: object) -> None:
        self.close()
        if kind is None:
            self.check()

    def close(self) -> None:
        """Serve no more, and give the address free."""
        self._closing.set()
        if self._thread.is_alive():
            self._server.shutdown()
        self._server.server_close()
        self._thread.join()
        if self._socket_file and _identity(self._socket_file) == self._bound:  # not another server's
            self._socket_file.unlink(missing_ok=True)

    def answer(self, line: bytes) -> tuple[dict, bytes]:
        """Return the reply to one request line: header and pixel bytes; ok=False and the reason if it failed."""
        try:
            request = json.loads(line)
            if request["op"] == "info":
                return {"ok": True, **self._info()}, b""
            if request["op"] == "expose":
                return self._expose(float(request["exposure_time_s"]), int(request["start_utc_ns"]))
            return {"ok": False, "error": f"unknown operation {request['op']!r}"}, b""
        except (ValueError, KeyError, TypeError, OverflowError) as error:
            return {"ok": False, "error": f"bad request: {type(error).__name__}: {error}"}, b""
        except (FlightError, BlenderError) as error:
            self.failures += 1
            return {"ok": False, "error": str(error)}, b""
        except Exception as error:  # whatever fails in rendering, the client must be told
            self.failures += 1
            log.error("no picture: %r", error, exc_info=error)
            return {"ok": False, "error": f"the simulated sky failed: {error!r}"}, b""

    def _info(self) -> dict:
        camera = self.mission.camera
        return {
            "start_utc_ns": self.mission.orbit.start_utc_ns,
            "width": camera.width,
            "height": camera.height,
            "channels": camera.channels,
            "bit_depth": camera.bit_depth,
        }

    def _expose(self, exposure_time_s: float, start_utc_ns: int) -> tuple[dict, bytes]:
        if not 0 < exposure_time_s <= 60:
            raise ValueError(f"exposure_time_s must be in 0 to 60, got {exposure_time_s}")
        mid_ns = start_utc_ns + round(exposure_time_s * 5e8)
        pose = self.pose_at(mid_ns)
        radiance, camera = seen(self.mission, self.radiance, self.surroundings, pose, mid_ns)
        rng = np.random.default_rng((self.seed, mid_ns))
        dn = expose(radiance, exposure_time_s, camera, rng)
        pixels = np.ascontiguousarray(dn, dtype="<u2").tobytes()
        self.clock.release(start_utc_ns + round(exposure_time_s * 1e9), self._closing.wait)
        self.exposures += 1
        header = {
            "ok": True,
            **self._info(),
            "exposure_time_s": exposure_time_s,
            "mid_exposure_utc_ns": mid_ns,
            "late_frames": self.late_frames,
        }
        return {**header, "nbytes": len(pixels)}, pixels


class _UnixServer(socketserver.ThreadingUnixStreamServer):
    daemon_threads = True


class _TcpServer(socketserver.ThreadingTCPServer):
    daemon_threads = True
    allow_reuse_address = True


def _address(listen: Path | str) -> str | tuple[str, int]:
    """Return a Unix socket's absolute path, free of an earlier server's socket, or (host, port)."""
    place = str(listen)
    if isinstance(listen, str):
        if not listen.startswith("hil://"):
            raise ValueError(
                f"expected hil:///path/to/socket or hil://host:port to listen on, got {listen!r}"
            )
        place = listen.removeprefix("hil://")
        host, _, port = place.rpartition(":")
        if not place.startswith("/"):
            if not (host and port.isdecimal() and int(port) < 1 << 16):
                raise ValueError(f"expected hil://host:port with a port below 65536, got {listen!r}")
            return host, int(port)
    path = Path(place).resolve()
    if len(os.fsencode(path)) > MAX_SOCKET_PATH_BYTES:
        raise ValueError(
            f"{path}: a Unix socket's path has at most {MAX_SOCKET_PATH_BYTES} bytes; take a shorter one "
            "or hil://127.0.0.1:0"
        )
    if path.exists() and not path.is_socket():
        raise ValueError(f"{path}: is a file, not a socket; it would be overwritten")
    _make_way(path)
    return str(path)


def _make_way(path: Path) -> None:
    """Remove the socket that a killed server left behind.

    Raises:
        OSError: a server accepts connections there, or its state cannot be told.
    """
    with socket.socket(socket.AF_UNIX) as client:
        client.settimeout(ANSWER_S)
        try:
            client.connect(str(path))
        except FileNotFoundError:
            return
        except ConnectionRefusedError:  # nobody has it open
            path.unlink(missing_ok=True)
            return
        except OSError as error:
            raise OSError(f"{path} cannot be listened on: {reason(error)}; choose another socket") from error
    raise OSError(
        f"{path} is in use: another simulated camera serves there; stop it or choose another socket"
    )


def _identity(path: Path | None) -> tuple[int, int, int] | None:
    """Return what tells a file from one that was made later at the same path; None where there is none."""
    if path is None or not path.exists():
        return None
    status = path.stat()
    return status.st_dev, status.st_ino, status.st_mtime_ns
