"""What a run records of itself: figures in metrics.json, steps in metrics.jsonl, and config.yaml to repeat it."""

import dataclasses
import importlib.metadata
import json
import math
import platform
from pathlib import Path

import torch
import yaml

from ground.run.model_files import exposure_times_s
from ground.run.runs import session_facts
from ground.session.cameras import median_sun_direction
from ground.session.folder import FrameRecord, Session
from obbgs_core.methods.config import MethodConfig
from obbgs_core.model.gaussians import Gaussians
from obbgs_core.render import native_kernels
from obbgs_core.train.result import TrainResult

LOG_EVERY = 10  # steps
PACKAGES = ("obbgs", "torch", "numpy", "onnxruntime", "plotly")


def budget_told(result: TrainResult) -> str:
    """Return what limited the number of Gaussians, also where growth went on beyond the budget that it began with."""
    most = f"{result.config.growth.max_gaussians:,}"
    if result.budget.startswith(f"at most {most} Gaussians"):
        return result.budget
    return f"{result.budget}; raised to {most}, as many as a picture can show, when growth went on"


def training_metrics(
    result: TrainResult,
    blind: TrainResult | None,
    session: Session,
    training: list[FrameRecord],
    held_out: list[FrameRecord],
) -> dict:
    """Return how a run's trainings went, for metrics.json; `blind` is the training that ignored exposure times."""
    sun_dir = median_sun_direction(training)
    chi2 = result.history[-1].chi2 if result.history else math.nan
    metrics = {
        "method": result.config.name,
        "gaussians": len(result.gaussians),
        "max_gaussians": result.config.growth.max_gaussians,
        "budget": budget_told(result),
        "sh_degree": math.isqrt(result.gaussians.sh.shape[1]) - 1,
        "shading": result.gaussians.shading,
        "highlights": _highlights(result.gaussians),
        "appearance": result.appearance,
        "growth": result.growth,
        "poses": result.poses,
        "background": session.background,
        "sun_span_deg": round(result.sun_span_deg, 2),
        "shown_under_sun_dir_body": None if sun_dir is None else [round(x, 6) for x in sun_dir.tolist()],
        "train_seconds": round(result.seconds, 3),
        "train_steps": len(result.history),  # with those that were done again once poses were refined
        "schedule_steps": result.history[-1].steps if result.history else 0,
        "stop_reason": result.stop_reason,
        "start": result.start,
        "removed_outliers": result.removed_outliers,
        "removed_not_finite": result.removed_not_finite,
        "dark_frames": result.dark_frames,
        "sky_level": None if result.sky_level.fits else str(result.sky_level),  # null: the stated black level
        "sky_level_dn": None if result.sky_level.fits else result.sky_level.by_frame(),
        # null: linear, and exposure times right, as stated
        "response": None if result.response.is_as_stated else str(result.response),
        "response_exponent": result.response.exponent,
        "misfit_frames": result.misfit_frames,
        "chi2": None if math.isnan(chi2) else chi2,
        "misfit": result.misfit,  # null: not learnt
        "misfit_unseen_factor": result.unseen_factor,  # null: it is that of the training frames
        "frames_received": len(session.frames),
        "frames_captured": session.frames_captured,  # null: flight did not say
        "frames_imported": session.frames_imported,  # null: they came over a link
        "nominal_exposures": session.nominal_exposures,
        "frames_trained": len(training),
        "frames_held_out": len(held_out),
        "exposures_s": exposure_times_s(training),
        "bytes_received": session.bytes_received,
        "session_created_utc": session.created_utc,
        "reference_exposure_s": result.reference_exposure_s,
    }
    if result.pose_estimate is not None:
        tree = result.pose_estimate.tree()
        metrics["pose_estimate"] = {key: tree[key] for key in ("shared", "unobservable")}
    if blind is not None:
        metrics |= {
            "blind_gaussians": len(blind.gaussians),
            "blind_budget": blind.budget,
            "blind_removed_not_finite": blind.removed_not_finite,
            "blind_train_seconds": round(blind.seconds, 3),
            "blind_reference_exposure_s": blind.reference_exposure_s,
        }
    return metrics


def _highlights(gaussians: Gaussians) -> dict | None:
    """Return the material that the highlights share, for metrics.json; None without highlights."""
    if not gaussians.has_highlights:
        return None
    alpha, *peak = (round(value, 5) for value in gaussians.gloss.exp().tolist())
    return {"alpha": alpha, "peak_radiance": peak}


def write_history(results: dict[str, TrainResult | None], path: Path) -> None:
    """Write every tenth step of each training, and its last, as a line of JSON."""
    with open(path, "w") as lines:
        for label, result in results.items():
            for info in result.history if result is not None else []:
                if info.step % LOG_EVERY == 0 or info.step == info.steps:
                    line = {"training": label, **dataclasses.asdict(info)}
                    lines.write(json.dumps({k: None if v != v else v for k, v in line.items()}) + "\n")


def write_config(session: Session, config: MethodConfig, seed: int, path: Path) -> None:
    """Write everything needed to repeat a run: settings, seed, digests of its input, versions, machine."""
    versions = {name: importlib.metadata.version(name) for name in PACKAGES}
    kernels = native_kernels()
    tree = {
        "method": _plain(dataclasses.asdict(config)),
        "seed": seed,
        "threads": torch.get_num_threads(),
        "rasterizer": f"native {kernels[0]}" if kernels else "reference",
        "session": session_facts(session),
        "versions": {"python": platform.python_version(), **versions},
        "machine": platform.machine(),
    }
    path.write_text(yaml.safe_dump(tree, sort_keys=False))


def _plain(value):
    """Return tuples as lists, which YAML can write."""
    if isinstance(value, dict):
        return {name: _plain(item) for name, item in value.items()}
    return [_plain(item) for item in value] if isinstance(value, tuple) else value
