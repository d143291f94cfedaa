"""Renders with Blender: worker processes that are restarted when they crash, and a cache of every picture."""

import contextlib
import hashlib
import json
import logging
import os
import queue
import shutil
import subprocess
import tempfile
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Literal

import numpy as np

from flightsw.icd.frame import PoseTag
from flightsw.icd.mission import Mission
from hil.sky import spacecraft
from obbgs_base.errors import ObbgsError

log = logging.getLogger(__name__)
Op = Literal["render", "geometry"]  # light and coverage, or depth and normals
WORKER = Path(__file__).with_name("blender_worker.py")
SAMPLES = 16  # a pixel, before denoising (OIDN); rendering time grows in proportion, quality hardly
BPY_VERSION = "4.5.15"
RETRIES = 2  # of a request on which Blender crashed
SIDE_FILES = (".mtl", ".bin", ".png", ".jpg", ".jpeg")  # files that an OBJ or glTF may refer to
LIBRARIES = "libx11-6 libxrender1 libxfixes3 libxi6 libxkbcommon0 libsm6 libgl1"


class MeshError(ObbgsError, ValueError):
    """The file is not a mesh that can be rendered."""

    exit_code = 2


class BlenderError(ObbgsError):
    """Blender cannot be started, refused a request, or crashed on it every time."""


def blender_command() -> list[str]:
    """Return the command that runs the worker, by the first of these that exists.

    The Python that the environment variable OBBGS_BLENDER_PYTHON names, .venv-blender in the project's root, `blender`.

    Raises:
        BlenderError: none of them exists.
    """
    own = os.environ.get("OBBGS_BLENDER_PYTHON") or str(WORKER.parents[2] / ".venv-blender/bin/python")
    if Path(own).exists():
        return [own, str(WORKER)]
    if installed := shutil.which("blender"):
        return [installed, "--background", "--factory-startup", "--python", str(WORKER)]
    raise BlenderError(
        "Blender is missing: run `make setup`, put a `blender` (4.5) on the PATH, or point OBBGS_BLENDER_PYTHON "
        "at a Python 3.11 that has "
        f"bpy=={BPY_VERSION}"
    )


def _remedy(reason: str) -> str:
    if "No module named 'bpy'" in reason:
        return f"run `make setup`, or {blender_command()[0]} -m pip install bpy=={BPY_VERSION}"
    return f"on Debian: apt-get install -y --no-install-recommends {LIBRARIES}"


class Worker:
    """A Blender process with one mesh loaded; it is started again when it crashes.

    Args:
        samples: light paths a pixel.
        ambient: radiance of the uniform light from all around; default the worker's own (blender_worker.py).

    Raises:
        MeshError: the mesh cannot be loaded.
        BlenderError: Blender cannot be started.
    """

    def __init__(self, mesh: Path, samples: int = SAMPLES, ambient: float | None = None):
        self.mesh, self.samples, self.ambient = mesh, samples, ambient
        self.restarts = -1
        self.facts: dict = {}
        self._start()

    def _start(self) -> None:
        self.restarts += 1
        self._log = tempfile.TemporaryFile("w+")  # noqa: SIM115 (closed with the process)
        try:
            self._process = subprocess.Popen(
                blender_command(),
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=self._log,
                text=True,
                start_new_session=True,  # Ctrl-C goes to us alone: the frame being rendered is finished and kept
            )
        except BaseException:
            self._log.close()
            raise
        greeting = self._reply()
        if greeting is None:
            reason = self._end_of_log()
            self.close()
            raise BlenderError(f"Blender did not start: {reason}; {_remedy(reason)}")
        self.version = greeting["ready"]
        load = {"op": "load", "mesh": str(self.mesh.resolve()), "samples": self.samples}
        load["keep_scale"] = mesh_sha256(self.mesh) == mesh_sha256(spacecraft.SHIPPED)
        if self.ambient is not None:
            load["ambient"] = self.ambient
        reply = self._exchange(load)
        if reply is None or not reply["ok"]:
            reason = reply["error"] if reply else self._end_of_log()
            self.close()
            raise MeshError(f"{self.mesh}: not a mesh that Blender can load: {reason}")
        self.facts = {key: value for key, value in reply.items() if key != "ok"}

    def ask(self, **request) -> dict:
        """Return the worker's reply to a request; after a crash Blender is restarted and asked again.

        Raises:
            BlenderError: Blender refused the request, or crashed on it every time.
        """
        for _ in range(1 + RETRIES):
            reply = self._exchange(request)
            if reply is None:
                log.warning("Blender crashed (%s); starting it again", self._end_of_log())
                self.close()
                self._start()
                continue
            if not reply["ok"]:
                raise BlenderError(f"Blender refused {request['op']}: {reply['error']}")
            return reply
        raise BlenderError(f"Blender crashed {1 + RETRIES} times on the same request")

    def _exchange(self, request: dict) -> dict | None:
        assert self._process.stdin
        try:
            self._process.stdin.write(json.dumps(request) + "\n")
            self._process.stdin.flush()
        except OSError:
            return None
        return self._reply()

    def _reply(self) -> dict | None:
        assert self._process.stdout
        for line in self._process.stdout:
            if line.startswith(
                "{"
            ):  # an installed Blender prints its version before the worker redirects stdout
                return json.loads(line)
        return None

    def _end_of_log(self) -> str:
        self._log.seek(0)
        lines = [line.strip() for line in self._log.read().splitlines() if line.strip()]
        return " ".join(lines[-2:])[-300:] or "no message"

    def close(self) -> None:
        """End the process; the frame that it is rendering is given 5 s."""
        assert self._process.stdin and self._process.stdout
        with contextlib.suppress(OSError):
            self._process.stdin.close()
        try:
            self._process.wait(timeout=5)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._process.stdout.close()
        self._log.close()


class RenderFarm:
    """Renders the mission's target at any pose, once; afterwards the picture is read from the cache.

    Raises:
        MeshError: `mesh` cannot be loaded.
        BlenderError: Blender is missing or cannot be started.
    """

    def __init__(self, mission: Mission, mesh: Path, cache: Path, workers: int = 2):
        check_mesh(mesh)
        self.mission, self.mesh, self.cache = mission, mesh, cache
        cache.mkdir(parents=True, exist_ok=True)
        self._count = workers
        self._workers: list[Worker] = []
        self._lock = threading.Lock()
        self._first = self._worker(0)  # at once, so that a bad mesh is reported here
        settings = f"{mesh_sha256(mesh)} {SAMPLES} {self._first.version} ".encode()
        self._identity = hashlib.sha256(settings + WORKER.read_bytes()).hexdigest()

    def __enter__(self) -> "RenderFarm":
        return self

    def __exit__(self, *_) -> None:
        for worker in self._workers:
            worker.close()

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
            self._workers.append(Worker(self.mesh))
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


def check_mesh(mesh: Path) -> None:
    """Raise MeshError if the file does not exist; whether Blender can load it is found when it does."""
    if not mesh.is_file():
        raise MeshError(f"{mesh}: no such file")


def mesh_sha256(mesh: Path) -> str:
    """Return the SHA-256 of a mesh file and, for formats that refer to other files, of the materials beside it."""
    files = [mesh]
    if mesh.suffix.lower() in (".obj", ".gltf"):
        files += sorted(path for path in mesh.parent.iterdir() if path.suffix.lower() in SIDE_FILES)
    digest = hashlib.sha256()
    for path in files:
        digest.update(path.read_bytes())
    return digest.hexdigest()
