"""A finished run against the held-out frames and, where a simulator left it, the truth."""

import json
import logging
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from ground.card import model_card
from ground.reconstruct import camera_of, exposed, predicted_image, run_folder, sensor_of, split, written_to
from ground.session import FrameRecord, Session, SessionError, open_session
from ground.truth import Truth, read_points
from obbgs_base.files import write_whole
from obbgs_core.io.ply import load_ply
from obbgs_core.model.gaussians import Gaussians
from obbgs_core.render import render
from obbgs_core.score.lpips import WeightsMissing, lpips
from obbgs_core.score.metrics import cloud_distances, foreground_psnr_db, psnr_db, ssim
from obbgs_core.sensor import Sensor

# what every run's metrics.json says, whatever its age; the rest may be missing
NEEDED_METRICS: dict[str, type] = {
    "method": str,
    "gaussians": int,
    "sh_degree": int,
    "train_seconds": float,
    "stop_reason": str,
    "start": str,
    "frames_received": int,
    "frames_trained": int,
    "frames_held_out": int,
    "exposures_s": list,
}
KINDS = {str: "a text", int: "a whole number", float: "a number", list: "a list"}
log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Run:
    """A run folder with its session and models, as evaluation and report need it."""

    folder: Path
    session: Session
    scored: list[FrameRecord]  # the held-out frames; those trained on where nothing was held out
    sensor: Sensor
    gaussians: Gaussians
    blind: Gaussians | None
    metrics: dict


def open_run(session_dir: Path, name: str, out: Path | None = None) -> Run:
    """Return a finished run; `out` is the folder of runs, if not the session's own.

    Raises:
        SessionError: no such session or run, or its metrics.json is damaged.
    """
    session = open_session(session_dir)
    folder = run_folder(session, name, out)
    if not (folder / "metrics.json").is_file():
        raise SessionError(
            f"{folder} is not a finished run; make one with `ground reconstruct --name {name}`"
        )
    training, held_out = split(session)
    metrics = read_metrics(folder / "metrics.json")
    metrics["scored_frames"] = "held_out" if held_out else "training"
    if metrics.get("session_created_utc", session.created_utc) != session.created_utc:
        raise SessionError(
            f"{folder} is a run of the session of {metrics['session_created_utc']}, and {session.path} is that of "
            f"{session.created_utc}"
        )
    with_blind = (folder / "blind.ply").exists() and "blind_reference_exposure_s" in metrics
    return Run(
        folder,
        session,
        held_out or training,
        sensor_of(session.camera),
        load_ply(folder / "model.ply"),
        load_ply(folder / "blind.ply") if with_blind else None,
        metrics,
    )


def read_metrics(path: Path) -> dict:
    """Return a run's metrics.json.

    Raises:
        SessionError: it is not there, not JSON, or lacks what every run has; the message names the file.
    """
    try:
        metrics = json.loads(path.read_bytes())
    except (OSError, ValueError) as error:  # a UnicodeDecodeError is a ValueError too
        raise SessionError(f"{path} cannot be read: {error}; make the run again") from error
    if not isinstance(metrics, dict):
        raise SessionError(f"{path} should hold an object; make the run again")
    for key, kind in NEEDED_METRICS.items():
        value = metrics.get(key)
        if type(value) is not kind and not (kind is float and type(value) is int):
            raise SessionError(
                f"{path} is damaged: expected {key} as {KINDS[kind]}, got {value!r}; make the run again"
            )
    return metrics


def evaluate(session_dir: Path, name: str, out: Path | None = None) -> dict:
    """Score a run, add the figures to its metrics.json and return them all.

    Keys: scored_frames, "held_out", or "training" where nothing was held out and the figures are of the frames that
    the model was trained on; psnr_noisy_db against the frames themselves; with truth also, from the true poses, so
    that an error of a scored frame's tag does not count as the model's: psnr_clean_db (expected image against the
    noiseless exposure, full scale 1, mean over the scored frames), psnr_clean_<exposure>_db, psnr_clean_foreground_db
    (of the pixels that the target covers; left out where it covers none), ssim_clean, lpips_clean (AlexNet, where its
    weights were fetched), psnr_radiance_db (scene-linear, its brightest pixel 1), the clean PSNR of the blind training
    (psnr_clean_blind_db), and chamfer, hausdorff, accuracy, completeness of the Gaussians' centres and *_surface of
    the 100,000 points of surface.ply, where the target's largest dimension is 2.

    Raises:
        SessionError: no such session or run, damaged metrics or truth, or a run that cannot be written to.
    """
    run = open_run(session_dir, name, out)
    figures: dict[str, float] = {}
    figures["psnr_noisy_db"] = _mean(
        psnr_db(
            predicted_image(run.gaussians, run.session, r, run.sensor, _exposure_s(run, r)), _noisy(run, r)
        )
        for r in run.scored
    )
    if Truth.exists(run.session):
        truth = Truth(run.session)
        figures |= _clean_figures(run, truth)
        scale = 2 / truth.largest_dimension_m
        true_cloud = truth.cloud_m * scale
        centres = run.gaussians.means.double().numpy() * scale
        figures |= cloud_distances(centres, true_cloud)
        surface = np.zeros((0, 3))
        if (run.folder / "surface.ply").exists():
            surface = read_points(run.folder / "surface.ply") * scale
        if len(surface):
            on_surface = cloud_distances(surface, true_cloud)
            figures |= {f"{key}_surface": value for key, value in on_surface.items()}
    metrics = {**run.metrics, **{key: round(value, 5) for key, value in figures.items()}}
    with written_to(run.folder):
        write_whole(run.folder / "metrics.json", (json.dumps(metrics, indent=2) + "\n").encode())
        write_whole(run.folder / "model_card.md", model_card(run.session.created_utc, metrics).encode())
    return metrics


def _clean_figures(run: Run, truth: Truth) -> dict[str, float]:
    by_exposure: dict[float, list[float]] = {}
    similarity, blind, linear = [], [], []
    views: list[tuple[torch.Tensor, torch.Tensor, torch.Tensor]] = []  # image, truth, coverage
    for record in map(truth.posed, run.scored):
        true, coverage = map(torch.from_numpy, truth.radiance(record))
        clean = exposed(true, run.sensor, record.exposure_time_s)
        with torch.no_grad():
            radiance = render(run.gaussians, camera_of(run.session, record)).radiance[0]
        predicted = exposed(radiance, run.sensor, _exposure_s(run, record))
        views.append((predicted, clean, coverage))
        by_exposure.setdefault(record.exposure_time_s, []).append(psnr_db(predicted, clean))
        similarity.append(ssim(predicted, clean))
        brightest = true.max().clamp(min=1e-6)
        linear.append(psnr_db(radiance / brightest, true / brightest))
        if run.blind is not None:
            exposure_s = run.metrics["blind_reference_exposure_s"]
            ignoring = predicted_image(run.blind, run.session, record, run.sensor, exposure_s)
            blind.append(psnr_db(ignoring, clean))
    figures = {"psnr_clean_db": _mean(value for values in by_exposure.values() for value in values)}
    for exposure_s, values in sorted(by_exposure.items()):
        figures[f"psnr_clean_{exposure_s * 1e3:g}ms_db"] = _mean(values)
    if not math.isnan(foreground_db := foreground_psnr_db(views)):
        figures["psnr_clean_foreground_db"] = foreground_db
    figures["ssim_clean"] = _mean(similarity)
    try:
        figures["lpips_clean"] = _mean(lpips(image, clean, network="alex") for image, clean, _ in views)
    except WeightsMissing as error:
        log.info("LPIPS is left out: %s", error)
    figures["psnr_radiance_db"] = _mean(linear)
    if blind:
        figures["psnr_clean_blind_db"] = _mean(blind)
    return figures


def clean_image(run: Run, truth: Truth, record: FrameRecord) -> torch.Tensor:
    """Return the noiseless exposure of a frame [H, W, C] over full scale, clipped as the sensor clips."""
    return exposed(torch.from_numpy(truth.radiance(record)[0]), run.sensor, record.exposure_time_s)


def _exposure_s(run: Run, record: FrameRecord) -> float:
    """Return the exposure that the model takes a frame's for: all alike when it was trained blind."""
    return run.metrics.get("reference_exposure_s") or record.exposure_time_s


def _noisy(run: Run, record: FrameRecord) -> torch.Tensor:
    dn = run.session.dn(record).astype(np.float32)
    return torch.from_numpy(dn.reshape(*dn.shape[:2], -1) / run.sensor.white_dn)


def _mean(values) -> float:
    values = list(values)
    return math.fsum(values) / len(values)
