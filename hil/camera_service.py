"""The simulated camera as a service: its frames rendered beforehand or when asked for, until it is stopped."""

import json
import threading
from collections.abc import Callable
from pathlib import Path

from rich.console import Console

from hil.cameras.gige import GigeCameraServer
from hil.cameras.virtual import CameraServer
from hil.progress import progress_bar
from hil.sky.render_farm import RenderFarm
from hil.world.clock import SimulatedClock
from hil.world.scenario import true_exposures
from hil.world.world import World

WORKERS = 2  # Blender processes that render beforehand


def serve_camera(
    world: World,
    mesh: Path,
    cache: Path,
    listen: str | None,
    real_time: float,
    prerender: bool,
    stop_event: Callable[[], threading.Event],
    console: Console,
    as_json: bool = False,
) -> None:
    """Serve the world's camera until stopped; its URL goes to stdout, progress and counts to the console.

    Args:
        cache: folder of rendered frames; what an interrupted run has rendered is used again.
        listen: address for our own protocol (`CameraServer`); None serves GigE Vision on 127.0.0.1.
        real_time: speed of simulated time as a multiple of real time; 0 is lock step.
        prerender: render the planned exposures first; a GigE client that gives no times then sees only these.
        stop_event: called when the service begins; gives the event that ends it.

    Raises:
        MeshError, BlenderError: the mesh or Blender is not usable.
        CaptureError, ValueError, OSError: the camera cannot be served.
    """
    SimulatedClock(world.mission, real_time)  # refuses an impossible factor before anything is rendered
    with RenderFarm(world.mission, mesh, cache, WORKERS) as farm:
        if listen is not None:  # opened and closed: an address that cannot be served is refused, too
            CameraServer(world.mission, farm.radiance, listen, 0, world.pose_at, real_time).close()
        moments = []
        if prerender:
            exposures = true_exposures(world.mission, world.pose_at)
            with progress_bar(console) as progress:
                task = progress.add_task("render", total=len(exposures))
                farm.prerender([e.pose for e in exposures], lambda: progress.advance(task))
            moments = sorted(e.mid_exposure_utc_ns for e in exposures)
        stop = stop_event()
        serving = (
            GigeCameraServer(world.mission, farm.radiance, 0, world.pose_at, real_time, moments)
            if listen is None
            else CameraServer(world.mission, farm.radiance, listen, 0, world.pose_at, real_time)
        )
        with serving as server:
            print(json.dumps({"url": server.url}) if as_json else server.url, flush=True)
            while not stop.wait(1.0):
                server.check()
            counts = f"{server.late_frames} late, {server.failures} failed"
            console.print(f"{server.exposures} exposures served, {counts}")
