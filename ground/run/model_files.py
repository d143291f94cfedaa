"""The files made of a finished training: the model in each format, its ONNX renderer, and points of its surface."""

import logging
import math
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import numpy as np
import onnxruntime

from ground.link.uplink import MAX_MODEL_BYTES
from ground.run.card import SIZES
from ground.run.mesh_files import write_mesh
from ground.session.cameras import cameras_of, median_sun_direction, predicted_image, sensor_of, sun_direction
from ground.session.folder import FrameRecord, Session, SessionError
from obbgs_base.errors import Interrupted
from obbgs_core.errors import ReconstructionError
from obbgs_core.io.gltf_splats import save_gltf_splats
from obbgs_core.io.onnx import export_onnx
from obbgs_core.io.ply import save_ply, save_surface_ply
from obbgs_core.io.spz import save_spz
from obbgs_core.model.gaussians import Gaussians
from obbgs_core.score.surface import surface_points
from obbgs_core.sensor import Sensor

log = logging.getLogger(__name__)
PARITY = "onnx_parity_db"  # of the agreement of model.onnx with our renderer, in metrics.json
T = TypeVar("T")
PARITY_VIEWS = 5
SURFACE_POINTS = 100_000


class Outputs:
    """Makes files in a folder one by one; where one fails, the reason is noted in `missing` and the others follow."""

    def __init__(self, folder: Path, should_stop: Callable[[], bool]):
        self.folder = folder
        self.missing: dict[str, str] = {}  # name of a file to the reason why it was not made
        self._should_stop = should_stop

    def make(self, name: str, make: Callable[[Path], T]) -> T | None:
        """Return what `make` returns for the file's path; None where it fails.

        Raises:
            Interrupted: should_stop returned True.
        """
        if self._should_stop():
            raise Interrupted(f"interrupted before {name} was made; {self._kept()}")
        log.info("%s", "comparing model.onnx with our renderer" if name == PARITY else f"making {name}")
        try:
            return make(self.folder / name)
        # Whatever goes wrong with one file, the model and the other files are worth keeping.
        except Exception as error:
            (self.folder / f"{name}.part").unlink(missing_ok=True)  # a half-written file
            expected = isinstance(error, (ReconstructionError, OSError))
            if not expected:
                log.info("%s failed", name, exc_info=True)
            self.miss(name, str(error) if expected else f"{type(error).__name__}: {error}")
            return None

    def miss(self, name: str, reason: str) -> None:
        """Note that an output is missing."""
        self.missing[name] = reason
        log.warning("%s is not made: %s", name, reason)

    def require(self, name: str) -> None:
        """Raise SessionError if a file is missing without which there is no run."""
        if name in self.missing:
            raise SessionError(f"{name} cannot be written: {self.missing[name]}; {self._kept()}")

    def _kept(self) -> str:
        if not any(self.folder.glob("*.checkpoint")):
            return f"the training could not be saved in {self.folder} either"
        return f"the same command resumes from the training saved in {self.folder}"


def write_models(
    outputs: Outputs,
    gaussians: Gaussians,
    blind: Gaussians | None,
    session: Session,
    training: list[FrameRecord],
    held_out: list[FrameRecord],
) -> dict:
    """Write the model in every format, the one trained blind to exposure, and the surface as points and as a mesh.

    Returns what metrics.json says of the files: onnx_parity_db, the agreement of the ONNX renderer with ours in dB
    (None where it was not measured), and of the mesh what `write_mesh` returns.
    """
    camera, sensor = session.camera, sensor_of(session.camera)
    exposures_s = exposure_times_s(training)
    white_radiance = white_radiance_of(session, training)
    sun_dir = median_sun_direction(training)
    cameras = cameras_of(session, training)
    outputs.make("model.ply", lambda path: save_ply(gaussians, path, white_radiance, sun_dir, cameras))
    if blind is not None:
        outputs.make("blind.ply", lambda path: save_ply(blind, path, white_radiance, sun_dir, cameras))
    outputs.make("model.spz", lambda path: save_spz(gaussians, path, white_radiance, sun_dir))
    outputs.make(
        "splats.glb", lambda path: save_gltf_splats(gaussians, path, white_radiance, sun_dir, cameras)
    )
    outputs.make("surface.ply", lambda path: _write_surface(gaussians, session, training, path))
    mesh = outputs.make(
        "model.glb", lambda path: write_mesh(gaussians, session, training, path, white_radiance)
    )
    facts: dict = {PARITY: None} | (mesh or {})
    exported = outputs.make(
        "model.onnx",
        lambda path: export_onnx(
            gaussians,
            sensor,
            path,
            camera.width,
            camera.height,
            exposures_s,
            camera.psf_sigma_px,
            session.background,
        ),
    )
    if exported is None:
        return facts
    if exported.size_bytes > MAX_MODEL_BYTES:
        log.warning(
            "model.onnx has %d bytes and the spacecraft accepts %d: `ground uplink model` will refuse it",
            exported.size_bytes,
            MAX_MODEL_BYTES,
        )
    views = held_out or training
    views = views[:: max(1, len(views) // PARITY_VIEWS)][:PARITY_VIEWS]
    parity_db = outputs.make(
        PARITY, lambda _: onnx_parity_db(exported.path, gaussians, session, views, sensor)
    )
    return facts | {PARITY: parity_db}


def onnx_parity_db(
    path: Path, gaussians: Gaussians, session: Session, views: list[FrameRecord], sensor: Sensor
) -> float:
    """Return the lowest PSNR over some views of ONNX Runtime's images against our renderer's, full scale 1."""
    runtime = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    worst = math.inf
    for record in views:
        feed = {
            "world_to_camera": record.world_to_camera.astype(np.float32),
            "K": session.K(record),
            "exposure_time_s": np.array(record.exposure_time_s, dtype=np.float32),
        }
        if (sun_dir := sun_direction(record)) is not None and gaussians.shading != "view":
            feed["sun_dir"] = sun_dir.numpy()
        image = np.asarray(runtime.run(["image"], feed)[0])
        ours = predicted_image(gaussians, session, record, sensor, record.exposure_time_s).numpy()
        worst = min(worst, -10 * math.log10(max(float(np.mean((image - ours) ** 2)), 1e-12)))
    return round(worst, 2)


def model_sizes(folder: Path) -> dict:
    """Return the bytes of each form of the model (None for a missing one) and whether the uplink accepts model.onnx."""
    sizes: dict = {}
    for name, key in SIZES.items():
        path = folder / name
        sizes[key] = path.stat().st_size if path.is_file() else None
    onnx_bytes = sizes["onnx_bytes"]
    return sizes | {"onnx_fits_uplink": None if onnx_bytes is None else onnx_bytes <= MAX_MODEL_BYTES}


def white_radiance_of(session: Session, training: list[FrameRecord]) -> float:
    """Return the radiance that the shortest exposure of the training frames shows as white."""
    sensor = sensor_of(session.camera)
    return (sensor.white_dn - sensor.black_dn) / (sensor.dn_per_radiance_s * exposure_times_s(training)[0])


def exposure_times_s(records: list[FrameRecord]) -> list[float]:
    """Return the different exposure times of frames, shortest first."""
    return sorted({record.exposure_time_s for record in records})


def _write_surface(gaussians: Gaussians, session: Session, training: list[FrameRecord], path: Path) -> None:
    one_per_bracket = {record.bracket: record for record in training}.values()
    cameras = cameras_of(session, list(one_per_bracket))
    points, normals = surface_points(gaussians, cameras, SURFACE_POINTS)
    if len(points) == 0:
        log.warning("the model has no opaque surface that two cameras see: surface.ply is empty")
    save_surface_ply(points, normals, path)
