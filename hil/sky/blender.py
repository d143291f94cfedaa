"""Blender as a worker process with one mesh loaded: found, started, asked, and restarted when it crashes."""

import contextlib
import hashlib
import json
import logging
import os
import re
import shutil
import subprocess
import tempfile
from pathlib import Path

from hil.sky import SHIPPED, SHIPPED_FOIL, Materials
from obbgs_base.errors import ObbgsError

log = logging.getLogger(__name__)
WORKER = Path(__file__).with_name("blender_worker.py")
SOURCES = tuple(
    WORKER.with_name(f"{name}.py") for name in ("blender_worker", "blender_materials", "crinkles")
)
SAMPLES = 16  # a pixel, before denoising (OIDN); rendering time grows in proportion, quality hardly
OLDEST = (4, 1)  # Blender; that of Debian 13 is 4.3
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
        return [
            installed,
            "--background",
            "--factory-startup",
            "--python-exit-code",
            "1",
            "--python",
            str(WORKER),
        ]
    raise BlenderError(
        f"Blender is missing: run `make setup`, put a `blender` ({_dotted(OLDEST)} or newer) on the PATH, or point "
        "OBBGS_BLENDER_PYTHON at a Python 3.11 or 3.13 into which `pip install bpy` has put Blender"
    )


def _dotted(version: tuple[int, ...]) -> str:
    return ".".join(map(str, version))


def _remedy(reason: str) -> str:
    if "No module named 'bpy'" in reason:
        return f"run `make setup`, or {blender_command()[0]} -m pip install bpy"
    if "No module named 'numpy'" in reason:
        return "on Debian: apt-get install -y --no-install-recommends python3-numpy"
    return f"on Debian: apt-get install -y --no-install-recommends {LIBRARIES}"


class Worker:
    """A Blender process with one mesh loaded; it is started again when it crashes.

    Args:
        samples: light paths a pixel.
        ambient: radiance of the uniform light from all around; default the worker's own (blender_worker.py).
        materials: those of the mesh, or foil and cell glass in their place; the shipped target in foil keeps its own.

    Raises:
        MeshError: the mesh cannot be loaded.
        BlenderError: Blender cannot be started.
    """

    def __init__(
        self, mesh: Path, samples: int = SAMPLES, ambient: float | None = None, materials: Materials = "own"
    ):
        self.mesh, self.samples, self.ambient, self.materials = mesh, samples, ambient, materials
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
        if tuple(int(part) for part in re.findall(r"\d+", self.version)[:2]) < OLDEST:
            self.close()
            raise BlenderError(
                f"{blender_command()[0]} is Blender {self.version}; expected {_dotted(OLDEST)} or newer: "
                "run `make setup`, or point OBBGS_BLENDER_PYTHON at a Python 3.11 or 3.13 with bpy"
            )
        load = {"op": "load", "mesh": str(self.mesh.resolve()), "samples": self.samples}
        digest = mesh_sha256(self.mesh)
        foil = digest == mesh_sha256(SHIPPED_FOIL)
        load["shipped"] = foil or digest == mesh_sha256(SHIPPED)
        load["materials"] = "own" if foil else self.materials
        if self.ambient is not None:
            load["ambient"] = self.ambient
        reply = self._exchange(load)
        if reply is None or not reply["ok"]:
            reason = reply["error"] if reply else self._end_of_log()
            self.close()
            raise MeshError(f"{self.mesh}: not a mesh that Blender can load: {reason}")
        if not reply["denoises"]:
            if not self.restarts:
                log.warning(
                    "Blender %s has no denoiser, as Debian's: it renders 16 times as many light paths instead, "
                    "which is slower and differs from the usual pictures by the denoiser's smoothing",
                    self.version,
                )
            self.version += " without denoiser"
        self.facts = {key: value for key, value in reply.items() if key not in ("ok", "denoises")}

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
