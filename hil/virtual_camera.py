"""The camera that flight sees: a socket server that renders and exposes the simulated sky at the asked time.

Protocol hil://: one JSON line a request, one JSON line a reply, then `nbytes` of little-endian uint16 pixels.
Simulated time is in lock step: the request says when the shutter opens, and the reply comes when it is done.
"""

import json
import logging
import socketserver
import threading
from pathlib import Path

import numpy as np

from flightsw.errors import FlightError
from flightsw.icd.mission import Mission
from flightsw.pose import pose_tag
from hil.blender import BlenderError, RenderFarm
from hil.sensor import expose

log = logging.getLogger(__name__)


class CameraServer:
    """Serves the mission's camera on a Unix socket until closed; `url` is what `flightsw --camera` takes."""

    def __init__(self, mission: Mission, farm: RenderFarm, socket_path: Path, seed: int = 0):
        self.mission, self.farm, self.seed = mission, farm, seed
        self.exposures = 0
        self.url = f"hil://{socket_path.resolve()}"
        socket_path.unlink(missing_ok=True)
        camera = self

        class Handler(socketserver.StreamRequestHandler):
            def handle(self) -> None:
                for line in self.rfile:
                    header, pixels = camera.answer(line)
                    self.wfile.write(json.dumps(header).encode() + b"\n" + pixels)

        class Server(socketserver.ThreadingUnixStreamServer):
            daemon_threads = True

        self._server = Server(str(socket_path), Handler)
        self._thread = threading.Thread(target=self._server.serve_forever, daemon=True)
        self._thread.start()

    def __enter__(self) -> "CameraServer":
        return self

    def __exit__(self, *_) -> None:
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()

    def answer(self, line: bytes) -> tuple[dict, bytes]:
        """Return the reply to one request line: header and pixel bytes. A bad request gets ok=False, never a crash."""
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
            return {"ok": False, "error": str(error)}, b""

    def _info(self) -> dict:
        camera = self.mission.camera
        return {
            "width": camera.width,
            "height": camera.height,
            "channels": camera.channels,
            "bit_depth": camera.bit_depth,
        }

    def _expose(self, exposure_time_s: float, start_utc_ns: int) -> tuple[dict, bytes]:
        if not 0 < exposure_time_s <= 60:
            raise ValueError(f"exposure_time_s must be in 0 to 60, got {exposure_time_s}")
        mid_ns = start_utc_ns + round(exposure_time_s * 5e8)
        radiance = self.farm.radiance(pose_tag(self.mission, mid_ns))
        rng = np.random.default_rng((self.seed, mid_ns))
        dn = expose(radiance, exposure_time_s, self.mission.camera, rng)
        pixels = np.ascontiguousarray(dn, dtype="<u2").tobytes()
        self.exposures += 1
        header = {
            "ok": True,
            **self._info(),
            "exposure_time_s": exposure_time_s,
            "mid_exposure_utc_ns": mid_ns,
        }
        return {**header, "nbytes": len(pixels)}, pixels
