"""The scores of a finished run: against its held-out frames and, where a simulator left it, against the truth."""

import json
import math
from pathlib import Path

import numpy as np
import torch

from ground.run.card import model_card
from ground.run.estimated_poses import Alignment, estimated_records, read_estimate, scored_records
from ground.run.mesh_files import read_mesh_points
from ground.run.model_files import SURFACE_POINTS
from ground.run.runs import Run, open_run, written_to
from ground.run.scores import (
    ScoredView,
    clean_scores,
    cloud_scores,
    display_scores,
    noisy_psnr_db,
    of_similarity,
)
from ground.session.cameras import camera_of, exposed, predicted_image
from ground.session.folder import FrameRecord
from ground.session.truth import Truth, read_points
from obbgs_base.files import write_whole
from obbgs_core.poses.estimate import PoseEstimate
from obbgs_core.render import render
from obbgs_core.score.intervals import interval_scores, stated_error_scores
from obbgs_core.score.metrics import psnr_db
from obbgs_core.score.shown import shown_points

# of the keys of `evaluate`: an older score that cannot be measured any more is not kept
SCORES = (
    *(
        "psnr_",
        "ssim_",
        "lpips_",
        "interval_",
        "chi2_held_out",
        "chamfer",
        "hausdorff",
        "accuracy",
        "completeness",
    ),
    *("surface_shown", "pose_error_", "size_error_", "similarity_", "scored_poses"),
)


def evaluate(session_dir: Path, name: str, out: Path | None = None) -> dict:
    """Score a run, add the figures to its metrics.json, write its model card, and return all its metrics.

    Images are compared as fractions of full scale, means over the scored frames. Keys:

    - scored_frames: "held_out", or "training" where nothing was held out and the training frames are scored.
    - psnr_noisy_db: against the frames as received.
    - psnr_srgb_db, psnr_linear_db: of imported pictures in colour, the same of display values (sRGB-coded, black 0,
      full scale 1), as most publications measure it, and of values that are linear in light. ssim_srgb and lpips_srgb
      (as lpips_clean): of display values.

    - interval_90_noisy, and with truth interval_90_clean and interval_90_half_width: how often the model's intervals
      hold, as in `interval_scores`; chi2_held_out, chi2_held_out_both: as in `stated_error_scores`, of the poses as
      for psnr_noisy_db. These only where frames are held out and exposure times are known.

    Where the training refined its poses, the scored frames are compared from poses that are settled on each of them,
    with the model fixed, and not from their tags; `scored_poses` is then "settled".

    With a simulator's truth also, from true poses, so that errors of the scored frames' pose tags do not count as
    errors of the model. Where the training refined its poses, the model is moved rigidly first, so that the estimated
    poses of the training are nearest to the true ones:

    - psnr_clean_db, ssim_clean, lpips_clean (AlexNet; where its weights were fetched): against noiseless exposures.
    - psnr_clean_<exposure>_db, psnr_clean_pooled_db, psnr_clean_foreground_db: as in `clean_scores`.
    - psnr_clean_blind_db: psnr_clean_db of the training that ignored exposure times.
    - psnr_radiance_db: of scene-linear radiance, the brightest true pixel of a frame as 1.
    - chamfer, hausdorff, accuracy, completeness: of the Gaussians' centres, in units where the target's largest
      dimension is 2; the same with _surface: of the points in surface.ply; with _mesh: of points on model.glb.
    - surface_shown: percentage of the true surface that the training frames show (`shown_points`); completeness_shown:
      completeness of that part.
    - psnr_clean_settled_db: from the settled poses; pose_error_deg, pose_error_range (of the range), pose_error_px: of
      the training's estimated poses, root mean squares, and pose_error_tagged_... of its tags; only of refined poses.
    - size_error_percent: by how much the model of refined poses is too large, which no picture shows where navigation
      leaves the range open; similarity_psnr_clean_db and other keys with that beginning: after the motion of the model
      that corrects its size as well.

    Raises:
        SessionError: no such session or run, damaged metrics or truth, or a run folder that cannot be written.
    """
    run = open_run(session_dir, name, out)
    estimate, shown = read_estimate(run.folder), scored_records(run)
    figures: dict[str, float] = {
        "psnr_noisy_db": noisy_psnr_db(
            (model_image(run, record), noisy_image(run, record)) for record in shown
        )
    }
    states_errors = run.metrics["scored_frames"] == "held_out" and not run.metrics.get("reference_exposure_s")
    if states_errors:
        frames = map(run.on_black_sky, shown)
        figures |= stated_error_scores(run.gaussians, run.sensor, frames, run.metrics.get("misfit"))
    if run.session.frames_imported is not None and run.session.camera.channels == 3:
        pairs = ((model_image(run, record), noisy_image(run, record)) for record in shown)
        figures |= display_scores(pairs, run.sensor, run.session.encoding)
    truth = Truth(run.session) if Truth.exists(run.session) else None
    if truth is not None:
        motion, (clouds, seen) = None, _geometry(run, truth, estimate)
        if estimate is not None:
            alignment = Alignment.of(estimate, run.session, truth)
            motion = alignment.motion.numpy()
            settled = clean_scores([_scored(run, truth, record) for record in shown])
            figures |= alignment.figures() | {"psnr_clean_settled_db": settled["psnr_clean_db"]}
            similarity = alignment.similarity.numpy()
            sized = [_scored(run, truth, truth.posed(record, similarity)) for record in run.scored]
            figures |= of_similarity(clean_scores(sized) | _cloud_figures(clouds, seen, truth, similarity))
        shown = scored_records(run, truth)
        figures |= clean_scores([_scored(run, truth, record) for record in shown])
        figures |= _radiance_figures(run, truth, shown) | _cloud_figures(clouds, seen, truth, motion)
    if states_errors:
        figures |= _interval_figures(run, truth, shown, estimate)
    kept = {key: value for key, value in run.metrics.items() if not key.startswith(SCORES)}
    metrics = kept | {key: round(value, 5) for key, value in figures.items()}
    if estimate is not None:
        metrics["scored_poses"] = "settled"
    keep_metrics(run, metrics)
    return metrics


def keep_metrics(run: Run, metrics: dict) -> None:
    """Write a run's metrics and its card, which tells them.

    Raises:
        SessionError: the folder cannot be written.
    """
    with written_to(run.folder):
        write_whole(run.folder / "metrics.json", (json.dumps(metrics, indent=2) + "\n").encode())
        write_whole(run.folder / "model_card.md", model_card(run.session.created_utc, metrics).encode())


def _geometry(
    run: Run, truth: Truth, estimate: PoseEstimate | None
) -> tuple[dict[str, np.ndarray], np.ndarray | None]:
    """Return the model's points by the names of their scores, and which points of the true surface the frames show."""
    clouds = {"": run.gaussians.means.double().numpy()}
    if (run.folder / "surface.ply").exists():
        clouds["_surface"] = read_points(run.folder / "surface.ply")
    if (run.folder / "model.glb").exists():
        clouds["_mesh"] = read_mesh_points(run.folder / "model.glb", SURFACE_POINTS)
    if run.session.background:
        return clouds, None
    found = {
        record.id: torch.from_numpy(record.world_to_camera).float()
        for record in estimated_records(run.training, estimate)
    }
    training = [run.on_black_sky(truth.posed(record), found.get(record.id)) for record in run.training]
    return clouds, shown_points(truth.cloud_m, training, run.sensor)


def _cloud_figures(
    clouds: dict[str, np.ndarray], shown: np.ndarray | None, truth: Truth, motion: np.ndarray | None
) -> dict[str, float]:
    """Return the scores of the model's geometry, after a motion [4, 4] to the true body frame."""
    if motion is not None:
        clouds = {name: points @ motion[:3, :3].T + motion[:3, 3] for name, points in clouds.items()}
    return cloud_scores(clouds, truth.cloud_m, 2 / truth.largest_dimension_m, shown)


def _interval_figures(
    run: Run, truth: Truth | None, shown: list[FrameRecord], estimate: PoseEstimate | None
) -> dict[str, float]:
    """Return how often the intervals hold that the model states of the held-out frames."""
    radiance = [] if truth is None else [torch.from_numpy(truth.radiance(record)[0]) for record in shown]
    training = estimated_records(run.training, estimate)
    known, scored = ([run.on_black_sky(r) for r in records] for records in (training, shown))
    return interval_scores(run.gaussians, known, run.sensor, scored, radiance)


def model_image(run: Run, record: FrameRecord) -> torch.Tensor:
    """Return the model's image [H, W, C] of a frame as a fraction of full scale, as it is scored."""
    return predicted_image(run.gaussians, run.session, record, run.sensor, _exposure_s(run, record))


def _scored(run: Run, truth: Truth, record: FrameRecord) -> ScoredView:
    """Return the model's image of a frame with its truth."""
    coverage = torch.from_numpy(truth.radiance(record)[1])
    return ScoredView(
        model_image(run, record), clean_image(run, truth, record), coverage, record.exposure_time_s
    )


def _radiance_figures(run: Run, truth: Truth, records: list[FrameRecord]) -> dict[str, float]:
    """Return the scores of scene-linear radiance, and of the training that ignored exposure times if there was one."""
    linear, blind = [], []
    for record in records:
        true = torch.from_numpy(truth.radiance(record)[0])
        with torch.no_grad():
            radiance = render(run.gaussians, camera_of(run.session, record)).radiance[0]
        brightest = true.max().clamp(min=1e-6)
        linear.append(psnr_db(radiance / brightest, true / brightest))
        if run.blind is not None:
            exposure_s = run.metrics["blind_reference_exposure_s"]
            ignoring = predicted_image(run.blind, run.session, record, run.sensor, exposure_s)
            blind.append(psnr_db(ignoring, clean_image(run, truth, record)))
    figures = {"psnr_radiance_db": math.fsum(linear) / len(linear)}
    if blind:
        figures["psnr_clean_blind_db"] = math.fsum(blind) / len(blind)
    return figures


def clean_image(run: Run, truth: Truth, record: FrameRecord) -> torch.Tensor:
    """Return the true noiseless image [H, W, C] of a frame as a fraction of full scale, clipped as the sensor clips."""
    return exposed(torch.from_numpy(truth.radiance(record)[0]), run.sensor, record.exposure_time_s)


def _exposure_s(run: Run, record: FrameRecord) -> float:
    """Return the exposure time to render a frame with: the common one if the method ignores exposure times."""
    return run.metrics.get("reference_exposure_s") or record.exposure_time_s


def noisy_image(run: Run, record: FrameRecord) -> torch.Tensor:
    """Return a frame as received [H, W, C] as a fraction of full scale, without the Earth and what empty sky reads."""
    return run.on_black_sky(record).dn / run.sensor.white_dn
