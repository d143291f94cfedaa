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

import numpy as np
import onnxruntime
import torch
import yaml
from torch import Tensor

from flightsw.icd.mission import CameraSection
from ground.session import FrameRecord, Session, SessionError, open_session
from obbgs_core.cameras import Cameras, stacked_suns
from obbgs_core.errors import ReconstructionError
from obbgs_core.export_onnx import export_onnx
from obbgs_core.frames import TrainingFrame
from obbgs_core.gaussians import Gaussians
from obbgs_core.methods import MethodConfig, preset, with_quality
from obbgs_core.optimize import StepInfo, TrainResult, train
from obbgs_core.ply import save_ply, save_surface_ply
from obbgs_core.render import native_kernels, render
from obbgs_core.sensor import Sensor
from obbgs_core.spz import save_spz
from obbgs_core.surface import surface_points

log = logging.getLogger(__name__)
HELD_OUT = 8  # every eighth bracket is never trained on
LOG_EVERY = 10  # steps
PARITY_VIEWS = 5
SURFACE_POINTS = 100_000
PACKAGES = ("obbgs", "torch", "numpy", "onnxruntime", "plotly")


@dataclass(frozen=True)
class Progress:
    """One step of one of the trainings of a run."""

    label: str  # "known exposure" or "blind to exposure"
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
) -> Path:
    """Train on a session and return the run folder, written whole or not at all; an older run of the name is replaced.

    A run that was killed goes on from its last checkpoint when it is asked for again, to the same model.

    Truth is never read here. With `blind_reference` the same training runs a second time with every exposure taken for
    their geometric mean, so that a report can show what knowing the exposure is worth.

    Raises:
        SessionError: the session cannot be used, or the name is not a plain folder name.
        ReconstructionError: the frames do not allow a model (too few, all black).
        ValueError: no such method or setting.
    """
    if not name or Path(name).name != name or name.startswith("."):
        raise SessionError(f"a run's name is a plain folder name, got {name!r}")
    config = preset(method, **(changes or {}))
    session = open_session(session_dir)
    training, held_out = split(session)
    sensor = sensor_of(session.camera)
    frames = [training_frame(session, record) for record in training]
    folder = session.path / "runs" / name
    part = folder.with_name(f".{name}.part")
    part.mkdir(parents=True, exist_ok=True)  # what an interrupted run left is gone on with
    with _discarded_on_failure(part), _logged_to(part / "log"):
        result = _train("known exposure", frames, sensor, config, seed, time_limit_s, on_progress, part)
        blind = None
        if blind_reference and config.exposure_aware:
            ignoring = dataclasses.replace(config, exposure_aware=False)
            blind = _train(
                "blind to exposure", frames, sensor, ignoring, seed, time_limit_s, on_progress, part
            )
        exposures_s = sorted({record.exposure_time_s for record in training})
        white_radiance = (sensor.white_dn - sensor.black_dn) / (sensor.dn_per_radiance_s * exposures_s[0])
        shown_under = _middle_sun(training)
        _write_models(result.gaussians, blind, session, training, white_radiance, shown_under, part)
        camera = session.camera
        export_onnx(result.gaussians, sensor, part / "model.onnx", camera.width, camera.height, exposures_s)
        views = (held_out or training)[:: max(1, len(held_out or training) // PARITY_VIEWS)][:PARITY_VIEWS]
        metrics = {
            "method": method,
            "gaussians": len(result.gaussians),
            "sh_degree": math.isqrt(result.gaussians.sh.shape[1]) - 1,
            "shading": result.gaussians.shading,
            "appearance": result.appearance,
            "growth": result.growth,
            "poses": result.poses,
            "exposures": result.exposures,
            "sun_span_deg": round(result.sun_span_deg, 2),
            "shown_under_sun_dir_body": None
            if shown_under is None
            else [round(x, 6) for x in shown_under.tolist()],
            "train_seconds": round(result.seconds, 3),
            "stop_reason": result.stop_reason,
            "start": result.start,
            "removed_outliers": result.removed_outliers,
            "dark_frames": result.dark_frames,
            "chi2": result.history[-1].chi2,
            "frames_received": len(session.frames),
            "frames_captured": session.frames_captured,  # null: flight did not say
            "frames_trained": len(training),
            "frames_held_out": len(held_out),
            "exposures_s": exposures_s,
            "bytes_received": session.bytes_received,
            **{f"{name}_bytes": (part / f"model.{name}").stat().st_size for name in ("ply", "spz", "onnx")},
            "onnx_parity_db": onnx_parity_db(part / "model.onnx", result.gaussians, session, views, sensor),
            "reference_exposure_s": result.reference_exposure_s,
        }
        if blind is not None:
            metrics |= {
                "blind_gaussians": len(blind.gaussians),
                "blind_train_seconds": round(blind.seconds, 3),
                "blind_reference_exposure_s": blind.reference_exposure_s,
            }
        (part / "metrics.json").write_text(json.dumps(metrics, indent=2) + "\n")
        _write_history({"known exposure": result, "blind to exposure": blind}, part / "metrics.jsonl")
        (part / "config.yaml").write_text(yaml.safe_dump(_resolved(session, config, seed), sort_keys=False))
        log.info("%d Gaussians in %.1f s: %s", len(result.gaussians), result.seconds, result.stop_reason)
    for checkpoint in part.glob("*.checkpoint"):
        checkpoint.unlink()
    shutil.rmtree(folder, ignore_errors=True)
    part.rename(folder)
    return folder


def changes_for(method: str, quality: str, budget: str, steps: int | None) -> dict:
    """Return the changes to a method's preset that a user's wishes come to.

    Raises:
        ValueError: no such method or quality, or a budget that is neither `auto` nor a number.
    """
    wished = with_quality(preset(method), quality)
    changes: dict = {"steps": steps or wished.steps, "start_count": wished.start_count}
    changes["max_gaussians"] = wished.max_gaussians
    if budget != "auto":
        if not budget.isdigit() or int(budget) == 0:
            raise ValueError(f"--budget must be auto or a number of Gaussians, got {budget!r}")
        changes["max_gaussians"] = int(budget)
        changes["start_count"] = min(wished.start_count, int(budget))
    return changes


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
    body_to_camera = record.world_to_camera[:3, :3]
    position_m2 = body_to_camera @ record.covariance[:3, :3] @ body_to_camera.T
    variances = np.concatenate([np.diag(record.covariance)[3:], np.diag(position_m2)])
    return TrainingFrame(
        dn=torch.from_numpy(dn.reshape(*dn.shape[:2], session.camera.channels)),
        exposure_time_s=record.exposure_time_s,
        world_to_camera=world_to_camera,
        K=torch.tensor(session.camera.K),
        id=record.id,
        bracket=record.bracket,
        pose_sigma=torch.from_numpy(np.sqrt(np.clip(variances, 0, None)).astype(np.float32)),
        sun_dir=sun_direction(record),
    )


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


def _train(
    label: str,
    frames: list[TrainingFrame],
    sensor: Sensor,
    config: MethodConfig,
    seed: int,
    time_limit_s: float,
    on_progress: Callable[[Progress], None],
    part: Path,
) -> TrainResult:
    checkpoint = part / f"{label.replace(' ', '-')}.checkpoint"
    result = train(
        frames,
        sensor,
        config,
        seed,
        lambda info: on_progress(Progress(label, info)),
        time_limit_s,
        checkpoint,
    )
    log.info("%s: start from %s; %s", label, result.start, result.stop_reason)
    return result


def _write_models(
    gaussians: Gaussians,
    blind: TrainResult | None,
    session: Session,
    training: list[FrameRecord],
    white_radiance: float,
    shown_under: Tensor | None,
    part: Path,
) -> None:
    """Write the model in full and compact, its blind twin, and points of its surface."""
    save_ply(gaussians, part / "model.ply", white_radiance, shown_under)
    save_spz(gaussians, part / "model.spz", white_radiance, shown_under)
    if blind is not None:
        save_ply(blind.gaussians, part / "blind.ply", white_radiance, shown_under)
    one_a_bracket = {record.bracket: record for record in training}.values()
    cameras = cameras_of(session, list(one_a_bracket))
    points, normals = surface_points(gaussians, cameras, SURFACE_POINTS)
    if len(points) == 0:
        log.warning("the model has no solid surface that two cameras see: surface.ply is empty")
    save_surface_ply(points, normals, part / "surface.ply")


def _write_history(results: dict[str, TrainResult | None], path: Path) -> None:
    with open(path, "w") as lines:
        for label, result in results.items():
            for info in result.history if result is not None else []:
                if info.step % LOG_EVERY == 0 or info.step == info.steps:
                    line = {"training": label, **dataclasses.asdict(info)}
                    lines.write(json.dumps({k: None if v != v else v for k, v in line.items()}) + "\n")


def _plain(value):
    return [_plain(item) for item in value] if isinstance(value, tuple) else value


def _resolved(session: Session, config: MethodConfig, seed: int) -> dict:
    """Everything needed to repeat the run."""
    frames = (session.path / "frames.jsonl").read_bytes()
    versions = {name: importlib.metadata.version(name) for name in PACKAGES}
    kernels = native_kernels()
    return {
        "method": {k: _plain(v) for k, v in dataclasses.asdict(config).items()},
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
def _logged_to(path: Path) -> Iterator[None]:
    handler = logging.FileHandler(path)
    handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(name)s: %(message)s"))
    root = logging.getLogger()
    root.addHandler(handler)
    try:
        yield
    finally:
        root.removeHandler(handler)
        handler.close()
