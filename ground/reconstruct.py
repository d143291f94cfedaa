"""A session's frames to a run folder: the model, its ONNX renderer, what was done and how it went."""

import contextlib
import dataclasses
import hashlib
import importlib.metadata
import json
import logging
import math
import platform
import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np
import onnxruntime
import torch
import yaml
from torch import Tensor

from flightsw.icd.mission import CameraSection
from ground.session import FrameRecord, Session, SessionError, open_session
from ground.uplink import MAX_MODEL_BYTES
from obbgs_base.errors import Interrupted
from obbgs_core.errors import ReconstructionError
from obbgs_core.frames import TrainingFrame
from obbgs_core.io.onnx import export_onnx
from obbgs_core.io.ply import save_ply, save_surface_ply
from obbgs_core.io.spz import save_spz
from obbgs_core.model.cameras import Cameras, stacked_suns
from obbgs_core.model.gaussians import Gaussians
from obbgs_core.render import native_kernels, render
from obbgs_core.score.surface import surface_points
from obbgs_core.sensor import Sensor
from obbgs_core.train.config import MethodConfig
from obbgs_core.train.presets import preset
from obbgs_core.train.result import StepInfo, TrainResult
from obbgs_core.train.trainer import train

log = logging.getLogger(__name__)
T = TypeVar("T")
KNOWN, BLIND = "known exposure", "blind to exposure"  # the trainings of a run
HELD_OUT = 8  # every eighth bracket is never trained on
LOG_EVERY = 10  # steps
PARITY_VIEWS = 5
SURFACE_POINTS = 100_000
PACKAGES = ("obbgs", "torch", "numpy", "onnxruntime", "plotly")


@dataclass(frozen=True)
class Progress:
    """One step of one of the trainings of a run."""

    label: str  # KNOWN or BLIND
    info: StepInfo


def reconstruct(
    session_dir: Path,
    name: str = "run",
    method: str = "obbgs",
    changes: dict | None = None,
    seed: int = 7,
    time_limit_s: float = math.inf,
    blind_reference: bool = False,
    on_progress: Callable[[Progress], None] = lambda progress: None,
    out: Path | None = None,
    overwrite: bool = False,
    should_stop: Callable[[], bool] = lambda: False,
) -> Path:
    """Train on a session and return the run folder, written whole or not at all.

    A run that was killed goes on from its last checkpoint when it is asked for again, to the same model. A training
    that has ended is never lost: what cannot be made of it is named under `missing_outputs` in metrics.json, with the
    reason.

    Truth is never read here. With `blind_reference` the same training runs a second time with every exposure taken for
    their geometric mean, so that a report can show what knowing the exposure is worth.

    Args:
        out: the folder of runs; none: `runs` in the session.
        overwrite: replace a finished run of the same name.
        should_stop: asked after each step and each file; when it says yes, all is kept and the run is `Interrupted`.

    Raises:
        SessionError: the session cannot be used, the name is not a plain folder name or taken, or the folder of runs
            does not take the model.
        ReconstructionError: the frames do not allow a model (too few, all black).
        ValueError: no such method or setting, or a time limit that is none.
        Interrupted: should_stop said so.
    """
    if not time_limit_s > 0:
        raise ValueError(f"the time limit must be longer than 0 s, got {time_limit_s:g}")
    config = preset(method, changes)
    session = open_session(session_dir)
    folder = run_folder(session, name, out)
    if folder.exists():
        _check_replaceable(folder, overwrite)
    training, held_out = split(session)
    sensor = sensor_of(session.camera)
    frames = [training_frame(session, record) for record in training]
    part = folder.with_name(f".{name}.part")  # what an interrupted run left there is gone on with
    labels = [KNOWN, *([BLIND] if blind_reference and config.exposure_aware else [])]
    with written_to(folder.parent):
        part.mkdir(parents=True, exist_ok=True)
        _clear(part, ["log", *(_checkpoint(part, label).name for label in labels)])
        log_file = logging.FileHandler(part / "log")
    with _discarded_on_failure(part), _logged_to(log_file):

        def trained(label: str, config: MethodConfig) -> TrainResult:
            def on_step(info: StepInfo) -> None:
                on_progress(Progress(label, info))

            checkpoint = _checkpoint(part, label)
            made = train(frames, sensor, config, seed, on_step, time_limit_s, checkpoint, should_stop)
            log.info("%s: start from %s; %s", label, made.start, made.stop_reason)
            return made

        outputs = _Outputs(part, should_stop)
        result, blind = trained(KNOWN, config), None
        if BLIND in labels:
            try:
                blind = trained(BLIND, dataclasses.replace(config, exposure_aware=False))
            except ReconstructionError as error:
                outputs.miss("blind.ply", str(error))
        parity_db = _write_models(outputs, result, blind, session, training, held_out, sensor)
        outputs.require("model.ply")
        metrics = _metrics(method, result, blind, session, training, held_out)
        metrics |= {"onnx_parity_db": parity_db} | _sizes(part) | {"missing_outputs": outputs.missing}
        with written_to(folder.parent):
            (part / "metrics.json").write_text(json.dumps(metrics, indent=2) + "\n")
            _write_history({KNOWN: result, BLIND: blind}, part / "metrics.jsonl")
            resolved = _resolved(session, result.config, seed)
            (part / "config.yaml").write_text(yaml.safe_dump(resolved, sort_keys=False))
        log.info("%d Gaussians in %.1f s: %s", len(result.gaussians), result.seconds, result.stop_reason)
    with written_to(folder.parent):
        replaced = folder.with_name(f".{name}.replaced")
        shutil.rmtree(replaced, ignore_errors=True)
        if folder.exists():
            folder.rename(replaced)
        part.rename(folder)
        shutil.rmtree(replaced, ignore_errors=True)
        for checkpoint in folder.glob("*.checkpoint"):
            checkpoint.unlink()
    return folder


def run_folder(session: Session, name: str, out: Path | None = None) -> Path:
    """Return where a run is, or will be: below the session's own folder of runs, or below another one.

    Raises:
        SessionError: the name is not a plain folder name.
    """
    if not name or Path(name).name != name or name.startswith("."):
        raise SessionError(f"a run's name is a plain folder name, got {name!r}")
    return (session.path / "runs" if out is None else out) / name


@contextlib.contextmanager
def written_to(folder: Path) -> Iterator[None]:
    """Say in one line that a folder of runs cannot be written to, and what to do.

    Raises:
        SessionError: in place of any OSError.
    """
    try:
        yield
    except OSError as error:
        reason = error.strerror or str(error)
        raise SessionError(
            f"cannot write to {folder}: {reason}; --out DIR names another folder of runs"
        ) from error


def _check_replaceable(folder: Path, overwrite: bool) -> None:
    """Raise SessionError where a run of the name is there, unless it may be overwritten."""
    if not (folder / "metrics.json").is_file():
        raise SessionError(
            f"{folder} is there and is no finished run: it stays as it is; give another --name"
        )
    if not overwrite:
        raise SessionError(f"{folder} is a finished run: --overwrite replaces it, --name makes another")


def _checkpoint(part: Path, label: str) -> Path:
    return part / f"{label.replace(' ', '-')}.checkpoint"


def _clear(part: Path, kept: list[str]) -> None:
    """Remove what an interrupted run left, but for what the present one goes on with."""
    for path in part.iterdir():
        if path.name not in kept:
            shutil.rmtree(path) if path.is_dir() else path.unlink()


class _Outputs:
    """What is made of a finished training: all that can be, and for the rest the reason why not."""

    def __init__(self, folder: Path, should_stop: Callable[[], bool]):
        self.folder, self.missing = folder, {}
        self._should_stop = should_stop

    def make(self, name: str, make: Callable[[Path], T]) -> T | None:
        """Return what `make` returns for the file's path, or nothing where it fails: that is noted."""
        if self._should_stop():
            raise Interrupted(f"interrupted before {name} was made; {self._kept()}")
        log.info("making %s", name)
        try:
            return make(self.folder / name)
        # whatever goes wrong with one file, the model and the others are worth keeping
        except Exception as error:
            (self.folder / f"{name}.part").unlink(missing_ok=True)  # half of it
            expected = isinstance(error, (ReconstructionError, OSError))
            if not expected:
                log.info("%s failed", name, exc_info=True)
            self.miss(name, str(error) if expected else f"{type(error).__name__}: {error}")
            return None

    def miss(self, name: str, reason: str) -> None:
        """Note that an output is not there."""
        self.missing[name] = reason
        log.warning("%s is not made: %s", name, reason)

    def require(self, name: str) -> None:
        """Raise SessionError where an output is missing without which there is no run."""
        if name in self.missing:
            raise SessionError(f"{name} cannot be written: {self.missing[name]}; {self._kept()}")

    def _kept(self) -> str:
        """Return what there is to go on with."""
        if not _checkpoint(self.folder, KNOWN).exists():
            return f"nor could the training be saved in {self.folder}"
        return f"the same command goes on from the training that is saved in {self.folder}"


def split(session: Session) -> tuple[list[FrameRecord], list[FrameRecord]]:
    """Return the frames to train on and the held-out ones: whole brackets, every eighth; the last if there are fewer.

    Frames in eclipse or with an invalid pose are left out of both.

    Raises:
        SessionError: no frame is left.
    """
    usable = [r for r in session.frames if r.pose_valid and not r.in_eclipse]
    if not usable:
        eclipsed = sum(r.in_eclipse for r in session.frames)
        raise SessionError(
            f"none of the {len(session.frames)} frames can be used: {eclipsed} in eclipse, the others with stale poses"
        )
    if len(usable) < len(session.frames):
        log.warning(
            "%d frames in eclipse or with stale poses are left out", len(session.frames) - len(usable)
        )
    brackets = sorted({r.bracket for r in usable})
    chosen = {b for i, b in enumerate(brackets) if i % HELD_OUT == HELD_OUT - 1}
    if not chosen and len(brackets) > 1:
        chosen = {brackets[-1]}
    return [r for r in usable if r.bracket not in chosen], [r for r in usable if r.bracket in chosen]


def sensor_of(camera: CameraSection) -> Sensor:
    """Return the image model of a session's camera."""
    return Sensor(
        camera.black_dn,
        camera.white_dn,
        camera.dn_per_radiance_s,
        camera.electrons_per_dn,
        camera.read_noise_dn,
    )


def training_frame(session: Session, record: FrameRecord) -> TrainingFrame:
    dn = session.dn(record).astype(np.float32)
    world_to_camera = torch.tensor(record.world_to_camera, dtype=torch.float32)
    return TrainingFrame(
        dn=torch.from_numpy(dn.reshape(*dn.shape[:2], session.camera.channels)),
        exposure_time_s=record.exposure_time_s,
        world_to_camera=world_to_camera,
        K=torch.tensor(session.camera.K),
        id=record.id,
        bracket=record.bracket,
        pose_covariance=torch.from_numpy(
            motion_covariance(record.covariance, record.world_to_camera[:3, :3])
        ),
        sun_dir=sun_direction(record),
    )


def motion_covariance(tag_covariance: np.ndarray, body_to_camera: np.ndarray) -> np.ndarray:
    """Return the covariance [6, 6] of the motion that makes a tagged pose the true one, from that of the tag's errors.

    The motion stands in front of world_to_camera: rotation vector about (rad), then shift along (m) the camera's axes.
    The tag's errors are position minus the true one, dp (m, body), and the rotation vector a (rad, camera) in
    R_tag = exp(a) R_true. As t = -R p, the motion is the rotation -a and the shift t_true - exp(-a) t_tag = R_true dp,
    to first order R_tag dp. The turn is about the camera's centre, whose position it leaves alone: no term of the range
    couples the two. Their signs differ, and with them the sign of the correlation between position and rotation.
    """
    motion_by_tag = np.zeros((6, 6))
    motion_by_tag[:3, 3:] = -np.eye(3)
    motion_by_tag[3:, :3] = body_to_camera
    return motion_by_tag @ tag_covariance @ motion_by_tag.T


def sun_direction(record: FrameRecord) -> Tensor | None:
    """Return the direction [3] of a frame's Sun, unit, body frame; None where the tag does not know it."""
    length = float(np.linalg.norm(record.sun_dir_body))
    return torch.tensor(record.sun_dir_body / length, dtype=torch.float32) if length > 0 else None


def _middle_sun(records: list[FrameRecord]) -> Tensor | None:
    """Return the frames' Sun direction that is nearest to all the others: what a picture of the model is lit from."""
    known = [sun for record in records if (sun := sun_direction(record)) is not None]
    if not known:
        return None
    directions = torch.stack(known)
    return directions[torch.cdist(directions, directions).sum(dim=1).argmin()]


def camera_of(session: Session, record: FrameRecord) -> Cameras:
    return cameras_of(session, [record])


def cameras_of(session: Session, records: list[FrameRecord]) -> Cameras:
    """Return the cameras of some frames, with their Sun where all tags know it."""
    poses = torch.stack([torch.tensor(r.world_to_camera, dtype=torch.float32) for r in records])
    camera = session.camera
    return Cameras(
        poses,
        torch.tensor(camera.K).expand(len(records), 3, 3),
        camera.width,
        camera.height,
        sun_dir=stacked_suns([sun_direction(record) for record in records]),
    )


@torch.no_grad()
def predicted_image(
    gaussians: Gaussians, session: Session, record: FrameRecord, sensor: Sensor, exposure_time_s: float
) -> Tensor:
    """Return the model's image of a frame [H, W, C], expected digital numbers over full scale, 0..1."""
    return exposed(render(gaussians, camera_of(session, record)).radiance[0], sensor, exposure_time_s)


def exposed(radiance: Tensor, sensor: Sensor, exposure_time_s: float) -> Tensor:
    """Return the noiseless image [H, W, C] of a radiance over full scale, clipped as the sensor clips."""
    return (sensor.expected_dn(radiance, exposure_time_s) / sensor.white_dn).clamp(0, 1)


def onnx_parity_db(
    path: Path, gaussians: Gaussians, session: Session, views: list[FrameRecord], sensor: Sensor
) -> float:
    """Return the lowest PSNR of onnxruntime's images against our renderer's over some views."""
    runtime = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    K = np.array(session.camera.K, dtype=np.float32)
    worst = math.inf
    for record in views:
        feed = {
            "world_to_camera": record.world_to_camera.astype(np.float32),
            "K": K,
            "exposure_time_s": np.array(record.exposure_time_s, dtype=np.float32),
        }
        if (sun_dir := sun_direction(record)) is not None and gaussians.shading != "view":
            feed["sun_dir"] = sun_dir.numpy()
        image = np.asarray(runtime.run(["image"], feed)[0])
        ours = predicted_image(gaussians, session, record, sensor, record.exposure_time_s).numpy()
        worst = min(worst, -10 * math.log10(max(float(np.mean((image - ours) ** 2)), 1e-12)))
    return round(worst, 2)


def _write_models(
    outputs: _Outputs,
    result: TrainResult,
    blind: TrainResult | None,
    session: Session,
    training: list[FrameRecord],
    held_out: list[FrameRecord],
    sensor: Sensor,
) -> float | None:
    """Write the model in all its forms, its blind twin and points of its surface; return the ONNX renderer's parity."""
    gaussians, camera = result.gaussians, session.camera
    exposures_s = _exposures_s(training)
    white_radiance = (sensor.white_dn - sensor.black_dn) / (sensor.dn_per_radiance_s * exposures_s[0])
    sun_dir = _middle_sun(training)
    outputs.make("model.ply", lambda path: save_ply(gaussians, path, white_radiance, sun_dir))
    if blind is not None:
        outputs.make("blind.ply", lambda path: save_ply(blind.gaussians, path, white_radiance, sun_dir))
    outputs.make("model.spz", lambda path: save_spz(gaussians, path, white_radiance, sun_dir))
    outputs.make("surface.ply", lambda path: _write_surface(gaussians, session, training, path))
    exported = outputs.make(
        "model.onnx",
        lambda path: export_onnx(gaussians, sensor, path, camera.width, camera.height, exposures_s),
    )
    if exported is None:
        return None
    if exported.size_bytes > MAX_MODEL_BYTES:
        log.warning(
            "model.onnx has %d bytes and the spacecraft accepts %d: `ground uplink model` will refuse it",
            exported.size_bytes,
            MAX_MODEL_BYTES,
        )
    views = (held_out or training)[:: max(1, len(held_out or training) // PARITY_VIEWS)][:PARITY_VIEWS]
    return outputs.make(
        "onnx_parity_db", lambda _: onnx_parity_db(exported.path, gaussians, session, views, sensor)
    )


def _write_surface(gaussians: Gaussians, session: Session, training: list[FrameRecord], path: Path) -> None:
    one_a_bracket = {record.bracket: record for record in training}.values()
    cameras = cameras_of(session, list(one_a_bracket))
    points, normals = surface_points(gaussians, cameras, SURFACE_POINTS)
    if len(points) == 0:
        log.warning("the model has no solid surface that two cameras see: surface.ply is empty")
    save_surface_ply(points, normals, path)


def _exposures_s(records: list[FrameRecord]) -> list[float]:
    return sorted({record.exposure_time_s for record in records})


def _metrics(
    method: str,
    result: TrainResult,
    blind: TrainResult | None,
    session: Session,
    training: list[FrameRecord],
    held_out: list[FrameRecord],
) -> dict:
    """Return how the trainings went, for metrics.json."""
    sun_dir = _middle_sun(training)
    chi2 = result.history[-1].chi2 if result.history else math.nan
    metrics = {
        "method": method,
        "gaussians": len(result.gaussians),
        "max_gaussians": result.config.growth.max_gaussians,
        "budget": result.budget,
        "sh_degree": math.isqrt(result.gaussians.sh.shape[1]) - 1,
        "shading": result.gaussians.shading,
        "appearance": result.appearance,
        "growth": result.growth,
        "poses": result.poses,
        "sun_span_deg": round(result.sun_span_deg, 2),
        "shown_under_sun_dir_body": None if sun_dir is None else [round(x, 6) for x in sun_dir.tolist()],
        "train_seconds": round(result.seconds, 3),
        "train_steps": len(result.history),
        "stop_reason": result.stop_reason,
        "start": result.start,
        "removed_outliers": result.removed_outliers,
        "removed_not_finite": result.removed_not_finite,
        "dark_frames": result.dark_frames,
        "chi2": None if math.isnan(chi2) else chi2,
        "frames_received": len(session.frames),
        "frames_captured": session.frames_captured,  # null: flight did not say
        "frames_trained": len(training),
        "frames_held_out": len(held_out),
        "exposures_s": _exposures_s(training),
        "bytes_received": session.bytes_received,
        "session_created_utc": session.created_utc,
        "reference_exposure_s": result.reference_exposure_s,
    }
    if blind is not None:
        metrics |= {
            "blind_gaussians": len(blind.gaussians),
            "blind_budget": blind.budget,
            "blind_removed_not_finite": blind.removed_not_finite,
            "blind_train_seconds": round(blind.seconds, 3),
            "blind_reference_exposure_s": blind.reference_exposure_s,
        }
    return metrics


def _sizes(part: Path) -> dict:
    """Return the bytes of each form of the model, nothing for one that is missing, and whether the uplink takes it."""
    sizes = {}
    for name in ("ply", "spz", "onnx"):
        path = part / f"model.{name}"
        sizes[f"{name}_bytes"] = path.stat().st_size if path.is_file() else None
    onnx_bytes = sizes["onnx_bytes"]
    return sizes | {"onnx_fits_uplink": None if onnx_bytes is None else onnx_bytes <= MAX_MODEL_BYTES}


def _write_history(results: dict[str, TrainResult | None], path: Path) -> None:
    with open(path, "w") as lines:
        for label, result in results.items():
            for info in result.history if result is not None else []:
                if info.step % LOG_EVERY == 0 or info.step == info.steps:
                    line = {"training": label, **dataclasses.asdict(info)}
                    lines.write(json.dumps({k: None if v != v else v for k, v in line.items()}) + "\n")


def _plain(value):
    """Return a setting, or a group of them, as YAML holds it: tuples as lists."""
    if isinstance(value, dict):
        return {name: _plain(item) for name, item in value.items()}
    return [_plain(item) for item in value] if isinstance(value, tuple) else value


def _resolved(session: Session, config: MethodConfig, seed: int) -> dict:
    """Everything needed to repeat the run."""
    frames = (session.path / "frames.jsonl").read_bytes()
    versions = {name: importlib.metadata.version(name) for name in PACKAGES}
    kernels = native_kernels()
    return {
        "method": _plain(dataclasses.asdict(config)),
        "seed": seed,
        "threads": torch.get_num_threads(),
        "rasterizer": f"native {kernels[0]}" if kernels else "reference",
        "session": {
            "mission_sha256": session.mission_sha256,
            "frames_jsonl_sha256": hashlib.sha256(frames).hexdigest(),
            "created_utc": session.created_utc,
        },
        "versions": {"python": platform.python_version(), **versions},
        "machine": platform.machine(),
    }


@contextlib.contextmanager
def _discarded_on_failure(part: Path) -> Iterator[None]:
    """Remove a run that can never finish; one that was interrupted stays, to go on."""
    try:
        yield
    except ReconstructionError:
        shutil.rmtree(part, ignore_errors=True)
        raise


@contextlib.contextmanager
def _logged_to(handler: logging.Handler) -> Iterator[None]:
    """Write what is said in the block to a run's log, whatever the program around it listens to."""
    handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(name)s: %(message)s"))
    root = logging.getLogger()
    root.addHandler(handler)
    levels = {logging.getLogger(name): logging.getLogger(name).level for name in ("ground", "obbgs_core")}
    for ours in levels:
        ours.setLevel(min(logging.INFO, ours.getEffectiveLevel()))
    try:
        yield
    finally:
        for ours, level in levels.items():
            ours.setLevel(level)
        root.removeHandler(handler)
        handler.close()
