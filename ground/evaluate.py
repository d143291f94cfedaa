"""The scores of a finished run: against its held-out frames and, where a simulator left it, against the truth."""

import json
import logging
import math
from pathlib import Path

import numpy as np
import torch

from ground.cameras import camera_of, exposed, predicted_image
from ground.card import model_card
from ground.formats.srgb import from_srgb, to_srgb
from ground.runs import Run, open_run, written_to
from ground.session import FrameRecord
from ground.truth import Truth, read_points
from obbgs_base.files import write_whole
from obbgs_core.render import render
from obbgs_core.score.lpips import WeightsMissing, lpips
from obbgs_core.score.metrics import cloud_distances, foreground_psnr_db, psnr_db, ssim

log = logging.getLogger(__name__)


def evaluate(session_dir: Path, name: str, out: Path | None = None) -> dict:
    """Score a run, add the figures to its metrics.json, write its model card, and return all its metrics.

    Images are compared as fractions of full scale, means over the scored frames. Keys:

    - scored_frames: "held_out", or "training" where nothing was held out and the training frames are scored.
    - psnr_noisy_db: against the frames as received.
    - psnr_srgb_db, psnr_linear_db: of imported pictures in colour, the same of display values (sRGB-coded, black 0,
      full scale 1), as most publications measure it, and of values that are linear in light.

    With a simulator's truth also, from true poses, so that errors of the scored frames' pose tags do not count as
    errors of the model:

    - psnr_clean_db, ssim_clean, lpips_clean (AlexNet; where its weights were fetched): against noiseless exposures.
    - psnr_clean_<exposure>_db: the same by exposure time.
    - psnr_clean_foreground_db: the same, of the pixels that the target covers; missing where it covers none.
    - psnr_clean_blind_db: psnr_clean_db of the training that ignored exposure times.
    - psnr_radiance_db: of scene-linear radiance, the brightest true pixel of a frame as 1.
    - chamfer, hausdorff, accuracy, completeness: of the Gaussians' centres, in units where the target's largest
      dimension is 2; the same with _surface: of the points in surface.ply.

    Raises:
        SessionError: no such session or run, damaged metrics or truth, or a run folder that cannot be written.
    """
    run = open_run(session_dir, name, out)
    figures: dict[str, float] = {}
    figures["psnr_noisy_db"] = _mean(
        psnr_db(
            predicted_image(run.gaussians, run.session, r, run.sensor, _exposure_s(run, r)), _noisy(run, r)
        )
        for r in run.scored
    )
    if run.session.frames_imported is not None and run.session.camera.channels == 3:
        figures |= _display_figures(run)
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


def _display_figures(run: Run) -> dict[str, float]:
    black = run.sensor.black_dn / run.sensor.white_dn
    convert = from_srgb if run.session.encoding == "srgb" else to_srgb
    other = "psnr_linear_db" if run.session.encoding == "srgb" else "psnr_srgb_db"
    figures: dict[str, list[float]] = {"psnr_srgb_db": [], "psnr_linear_db": []}
    for record in run.scored:
        predicted = predicted_image(run.gaussians, run.session, record, run.sensor, _exposure_s(run, record))
        pair = [((image - black) / (1 - black)).clamp(min=0) for image in (predicted, _noisy(run, record))]
        converted = [torch.from_numpy(convert(image.numpy())) for image in pair]
        for key in figures:
            figures[key].append(psnr_db(*(converted if key == other else pair)))
    return {key: _mean(values) for key, values in figures.items()}


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
    """Return the true noiseless image [H, W, C] of a frame as a fraction of full scale, clipped as the sensor clips."""
    return exposed(torch.from_numpy(truth.radiance(record)[0]), run.sensor, record.exposure_time_s)


def _exposure_s(run: Run, record: FrameRecord) -> float:
    """Return the exposure time to render a frame with: the common one if the method ignores exposure times."""
    return run.metrics.get("reference_exposure_s") or record.exposure_time_s


def _noisy(run: Run, record: FrameRecord) -> torch.Tensor:
    """Return a frame as received [H, W, C], as a fraction of full scale."""
    dn = run.session.dn(record).astype(np.float32)
    return torch.from_numpy(dn.reshape(*dn.shape[:2], -1) / run.sensor.white_dn)


def _mean(values) -> float:
    values = list(values)
    return math.fsum(values) / len(values)
