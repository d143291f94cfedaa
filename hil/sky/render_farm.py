"""Renders the target on several Blender workers and keeps every picture in a cache, by the digest of its inputs."""

import contextlib
import hashlib
import json
import queue
import tempfile
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Literal

import numpy as np

from flightsw.icd.frame import PoseTag
from flightsw.icd.mission import Mission
from hil.sky import Materials
from hil.sky.blender import SAMPLES, SOURCES, Worker, check_mesh, mesh_sha256

Op = Literal["render", "geometry"]  # radiance and coverage, or depth and normals


class RenderFarm:
    """Renders the mission's target at any pose, once; afterwards the picture is read from the cache.

    Raises:
        MeshError: `mesh` cannot be loaded.
        BlenderError: Blender is missing or cannot be started.
    """

    def __init__(
        self, mission: Mission, mesh: Path, cache: Path, workers: int = 2, materials: Materials = "own"
    ):
        check_mesh(mesh)
        self.mission, self.mesh, self.cache = mission, mesh, cache
        self.materials: Materials = materials
        self._count = workers
        self._workers: list[Worker] = []
        self._lock = threading.Lock()
        self._first = self._worker(0)  # at once, so that a bad mesh is reported here
        cache.mkdir(parents=True, exist_ok=True)
        settings = f"{mesh_sha256(mesh)} {SAMPLES} {self._first.version} {materials} ".encode()
        self._identity = hashlib.sha256(settings + b"".join(s.read_bytes() for s in SOURCES)).hexdigest()

    def __enter__(self) -> "RenderFarm":
        return self

    def __exit__(self, *_) -> None:
        for worker in self._workers:
            worker.close()
        with contextlib.suppress(OSError):  # it holds something
            self.cache.rmdir()

    @property
    def version(self) -> str:
        """The version of the Blender that renders."""
        return self._first.version

    @property
    def facts(self) -> dict:
        """What the worker found in the mesh: largest_dimension_m, triangles, normals_recomputed."""
        return self._first.facts

    def path(self, pose: PoseTag, op: Op = "render") -> Path:
        """Return the cache's file for the picture of this pose, or for its depth and normals."""
        content = json.dumps(self._request(pose, op), sort_keys=True)
        return self.cache / (hashlib.sha256((self._identity + content).encode()).hexdigest()[:32] + ".npz")

    def radiance(self, pose: PoseTag) -> np.ndarray:
        """Return the scene-linear radiance [H, W, C] float16, premultiplied by coverage."""
        return self._array(pose, "render", "radiance")

    def alpha(self, pose: PoseTag) -> np.ndarray:
        """Return how much of each pixel the target covers, [H, W] uint8, 255 for all of it."""
        return self._array(pose, "render", "alpha")

    def geometry(self, pose: PoseTag) -> tuple[np.ndarray, np.ndarray]:
        """Return depth and normal of what each pixel's centre sees.

        Returns:
            depth [H, W] float32, planar, m, inf where nothing is seen; normals [H, W, 3] float16, unit, body axes.
        """
        return self._array(pose, "geometry", "depth"), self._array(pose, "geometry", "normals")

    def prerender(
        self,
        poses: Sequence[PoseTag],
        on_rendered: Callable[[], None] = lambda: None,
        ops: Sequence[Op] = ("render",),
    ) -> int:
        """Render, on all workers, the poses that are not in the cache yet; return how many those were.

        `on_rendered` is called once for each pose, from the workers' threads.
        """
        waiting: queue.SimpleQueue[PoseTag] = queue.SimpleQueue()
        missing = 0
        for pose in poses:
            if all(self.path(pose, op).exists() for op in ops):
                on_rendered()
            else:
                waiting.put(pose)
                missing += 1
        stop = threading.Event()

        def work(worker: Worker) -> None:
            try:
                while not stop.is_set():
                    pose = waiting.get_nowait()
                    for op in ops:
                        self._rendered(worker, pose, op)
                    on_rendered()
            except queue.Empty:
                pass
            finally:  # every pose is rendered, or one worker failed
                stop.set()

        with ThreadPoolExecutor(self._count) as pool:
            try:
                count = min(self._count, missing)
                for running in [pool.submit(work, self._worker(index)) for index in range(count)]:
                    running.result()
            finally:  # when interrupted, the frames being rendered are finished and kept
                stop.set()
        return missing

    def surface(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the mesh as it is rendered: vertices [V, 3] m in the body frame, faces [F, 3]."""
        with tempfile.TemporaryDirectory() as folder:
            out = Path(folder) / "surface.npz"
            self._first.ask(op="surface", out=str(out))
            with np.load(out) as arrays:
                return arrays["vertices"], arrays["faces"]

    def visible(self, points: np.ndarray, centres: np.ndarray) -> np.ndarray:
        """Return which of the points [N, 3] at least one of the camera centres [M, 3] sees, as bool [N]; cached."""
        content = self._identity.encode() + points.tobytes() + centres.tobytes()
        path = self.cache / (hashlib.sha256(content).hexdigest()[:32] + ".npz")
        if not path.exists():
            with tempfile.TemporaryDirectory() as folder, self._lock:
                given = Path(folder) / "points.npz"
                np.savez(given, points=points, centres=centres)
                self._first.ask(op="visible", points=str(given), out=str(path))
        with np.load(path) as arrays:
            return arrays["seen"]

    def _worker(self, index: int) -> Worker:
        while len(self._workers) <= index:
            self._workers.append(Worker(self.mesh, materials=self.materials))
        return self._workers[index]

    def _request(self, pose: PoseTag, op: Op) -> dict:
        camera = self.mission.camera
        return {
            "op": op,
            "world_to_camera": pose.world_to_camera.tolist(),
            "K": camera.K,
            "width": camera.width,
            "height": camera.height,
            "channels": camera.channels,
            "sun_dir_body": pose.sun_dir_body.tolist(),
            "in_eclipse": pose.in_eclipse,
        }

    def _array(self, pose: PoseTag, op: Op, name: str) -> np.ndarray:
        with self._lock:
            path = self._rendered(self._first, pose, op)
        with np.load(path) as arrays:
            return arrays[name]

    def _rendered(self, worker: Worker, pose: PoseTag, op: Op) -> Path:
        path = self.path(pose, op)
        if not path.exists():
            worker.ask(**self._request(pose, op), out=str(path))
        return path
