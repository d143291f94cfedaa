"""Rendered targets for comparisons: true radiance of 120 views, exposed and read out by the benchmark itself.

The folder (default ../shared/data, or OBBGS_TARGETS) holds NAME_400.npz: radiance [120, 400, 400, 3] (scene-linear),
alpha [120, 400, 400] (255 = full), world_to_camera [120, 4, 4], K [3, 3] px and cloud [M, 3]; the target's largest
dimension is 2 units. Nothing else of the project reads them.
"""

import dataclasses
import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from ground.cameras import exposed, sensor_of
from ground.session import open_session
from ground.training_frames import split, training_frame
from ground.truth import Truth
from hil.sky.sensor import converted
from obbgs_core.frames import TrainingFrame, cameras_of
from obbgs_core.model.gaussians import Gaussians
from obbgs_core.render import render
from obbgs_core.score.metrics import cloud_distances, foreground_psnr_db, psnr_db, ssim
from obbgs_core.score.surface import surface_points
from obbgs_core.sensor import Sensor

FOLDER = Path(os.environ.get("OBBGS_TARGETS", Path(__file__).parents[3] / "shared" / "data"))
BRACKET_S = (5e-5, 1e-4, 2e-4)
HELD_OUT = 8  # views i mod 8 = 7
MID_SIGNAL = 0.7  # of full scale: the 97th percentile of covered pixels at the middle exposure
PAPER_SIGMA = 0.025  # of full scale
SURFACE_POINTS = 100_000


@dataclass(frozen=True)
class Target:
    """One target's frames, what they look like without noise, and its visible surface."""

    name: str
    sensor: Sensor
    training: list[TrainingFrame]
    held_out: list[TrainingFrame]
    clean: list[Tensor]  # [H, W, C] in 0..1, one a held-out frame
    alpha: list[Tensor]  # [H, W] in 0..1, one a held-out frame
    cloud: np.ndarray  # [M, 3]


def names() -> list[str]:
    """Return the targets that are there."""
    return sorted(path.name.removesuffix("_400.npz") for path in FOLDER.glob("*_400.npz"))


def load(
    name: str,
    size: int = 400,
    sigma: float = PAPER_SIGMA,
    bracket_s: tuple[float, ...] = BRACKET_S,
    frames: int = 120,
    seed: int = 0,
    exposure_error: float = 0.0,
) -> Target:
    """Return a target seen by an 8-bit camera of the paper: Gaussian noise of `sigma` (full scale 1), then clipped.

    Args:
        size: pixels along a side; 400, or 200 and 100 by averaging.
        bracket_s: exposure times; view i takes number i mod len(bracket_s).
        frames: how many of the 120 views, spread evenly.
        exposure_error: deviation of ln(true / tagged exposure time) of the training frames.

    Raises:
        FileNotFoundError: no such target.
    """
    with np.load(FOLDER / f"{name}_400.npz") as arrays:
        radiance = torch.from_numpy(arrays["radiance"].astype(np.float32))
        alpha = torch.from_numpy(arrays["alpha"].astype(np.float32) / 255)
        poses = torch.from_numpy(arrays["world_to_camera"].astype(np.float32))
        K = torch.from_numpy(arrays["K"].astype(np.float32))
        cloud = arrays["cloud"].astype(np.float64)
    lit = radiance.mean(-1)[alpha >= 230 / 255]
    mid_s = BRACKET_S[1]
    gain = MID_SIGNAL / (float(np.percentile(lit.numpy(), 97)) * mid_s)  # full scale per radiance and second
    if size != radiance.shape[1]:
        factor = radiance.shape[1] // size
        radiance = F.avg_pool2d(radiance.movedim(-1, 1), factor).movedim(1, -1)
        alpha = F.avg_pool2d(alpha[:, None], factor)[:, 0]
        K = K * torch.tensor([[1 / factor], [1 / factor], [1.0]])
    sensor = Sensor(0.0, 255.0, 255.0 * gain, 1e9, 255.0 * sigma)
    noise = np.random.default_rng(seed)
    shutter = np.random.default_rng([seed, 1])  # a stream of its own: the noise stays the same
    training, held_out, clean, covers = [], [], [], []
    for i in np.unique(np.linspace(0, len(radiance) - 1, frames).round().astype(int)).tolist():
        exposure_s = bracket_s[i % len(bracket_s)]
        kept = i % HELD_OUT == HELD_OUT - 1
        longer = 1.0 if kept else float(np.exp(shutter.normal(0, exposure_error)))
        signal = radiance[i] * gain * exposure_s * longer  # full scale = 1, not clipped yet
        dn = converted(255 * signal.double().numpy(), 255 * sigma, 255, noise)
        frame = TrainingFrame(torch.from_numpy(dn.astype(np.float32)), exposure_s, poses[i], K, i)
        if kept:
            held_out.append(frame)
            clean.append(signal.clamp(0, 1))
            covers.append(alpha[i])
        else:
            training.append(frame)
    return Target(name, sensor, training, held_out, clean, covers, cloud)


def from_session(folder: Path) -> Target:
    """Return a simulated session with its truth, such as `hil dataset` makes, in the same units.

    Raises:
        SessionError: there is no such session, or no truth beside it.
    """
    session = open_session(folder)
    truth, sensor = Truth(session), sensor_of(session.camera)
    units_per_m = 2 / truth.largest_dimension_m
    sides: list[list[TrainingFrame]] = []
    training, held_out = split(session)
    for records in (training, map(truth.posed, held_out)):
        sides.append([])
        for record in records:
            frame = training_frame(session, record)
            pose = frame.world_to_camera.clone()
            pose[:3, 3] *= units_per_m
            sides[-1].append(dataclasses.replace(frame, world_to_camera=pose, pose_covariance=None))
    true = [tuple(map(torch.from_numpy, truth.radiance(record))) for record in held_out]
    clean = [exposed(light, sensor, r.exposure_time_s) for (light, _), r in zip(true, held_out, strict=True)]
    alpha, cloud = [alpha for _, alpha in true], truth.cloud_m * units_per_m
    return Target(session.path.parent.name, sensor, sides[0], sides[1], clean, alpha, cloud)


@torch.no_grad()
def predicted(gaussians: Gaussians, frame: TrainingFrame, sensor: Sensor, exposure_s: float) -> Tensor:
    """Return the model's image of a frame [H, W, C] in 0..1."""
    radiance = render(gaussians, cameras_of([frame])).radiance[0]
    return (sensor.expected_dn(radiance, exposure_s) / sensor.white_dn).clamp(0, 1)


def clean_psnr_db(gaussians: Gaussians, target: Target, reference_exposure_s: float | None = None) -> float:
    """Return the mean PSNR over the held-out views against the noiseless exposures."""
    values = [
        psnr_db(predicted(gaussians, f, target.sensor, reference_exposure_s or f.exposure_time_s), exact)
        for f, exact in zip(target.held_out, target.clean, strict=True)
    ]
    return sum(values) / len(values)


def image_figures(
    gaussians: Gaussians, target: Target, reference_exposure_s: float | None
) -> dict[str, float]:
    """Return the mean clean and noisy PSNR, the clean PSNR of the foreground, and the clean SSIM."""
    sums = {"psnr_clean_db": 0.0, "psnr_noisy_db": 0.0, "ssim_clean": 0.0}
    images = [
        predicted(gaussians, frame, target.sensor, reference_exposure_s or frame.exposure_time_s)
        for frame in target.held_out
    ]
    for image, frame, exact in zip(images, target.held_out, target.clean, strict=True):
        sums["psnr_clean_db"] += psnr_db(image, exact)
        sums["psnr_noisy_db"] += psnr_db(image, frame.dn / target.sensor.white_dn)
        sums["ssim_clean"] += ssim(image, exact)
    figures = {key: value / len(target.held_out) for key, value in sums.items()}
    return figures | {
        "psnr_foreground_db": foreground_psnr_db(zip(images, target.clean, target.alpha, strict=True))
    }


def cloud_figures(gaussians: Gaussians, target: Target, seed: int = 0) -> dict[str, float]:
    """Return Chamfer, Hausdorff, completeness of the centres; completeness, accuracy of 100,000 surface points."""
    centres = cloud_distances(gaussians.means.double().numpy(), target.cloud)
    points, _ = surface_points(gaussians, cameras_of(target.training), SURFACE_POINTS, seed)
    figures = {
        "chamfer": centres["chamfer"],
        "hausdorff": centres["hausdorff"],
        "completeness_centres": centres["completeness"],
        "completeness_surface": 0.0,
        "accuracy_surface": float("inf"),
    }
    if len(points):
        surface = cloud_distances(points.double().numpy(), target.cloud)
        figures |= {"completeness_surface": surface["completeness"], "accuracy_surface": surface["accuracy"]}
    return figures
