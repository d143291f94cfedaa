"""Errors of exposure times from frame to frame, told beside the model by frames that are seen from near each other.

What a frame reads over what the model expects of it is off by the frame's own error, and by what the model does not
show of that view. The one is the same in both halves of the picture and has nothing to do with the frames beside it;
the other changes from half to half, and, where the whole target glares, slowly with the direction of view. So the part
of the variance is taken that is left between frames whose directions of view come together: the nugget of a variogram.
A frame's error is then what its neighbours do not predict.

Source: Matheron, Principles of geostatistics, 1963, for variogram and nugget.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch

from obbgs_core.batches import Batch, Batches
from obbgs_core.compiled import each
from obbgs_core.frames import TrainingFrame
from obbgs_core.misfit import sampled
from obbgs_core.model.gaussians import Gaussians
from obbgs_core.render import render
from obbgs_core.sensor import Sensor

LEAST = 0.05  # standard deviation: less is harmless (docs/experiments/014), and glare leaves as much
CERTAIN = 3.0  # standard errors
MOST = 120  # frames that decide
FEWEST, FEWEST_PAIRS = 24, 24  # frames that tell, and pairs of them
NEAR_DEG = 45.0  # between directions of view of a pair
FEWEST_OF_SETTING = 5  # frames whose mean may be that of their exposure setting
OUTLIER = 3.0  # deviations
BELOW_FULL_SCALE = 0.9  # of the range: readings above may be clipped
HALF_ERROR = 0.05  # of ln(read / expected) of half a picture by noise: what is less certain tells nothing
PARTS = 10  # of the frames, each left out once (jackknife)


@torch.no_grad()
def frame_errors(model: Gaussians, batches: Batches, sensor: Sensor, used: np.ndarray) -> np.ndarray | None:
    """Return ln(true / stated exposure time) of each frame [F], 0 in the mean; None if it does not surely scatter.

    Args:
        used: [F] what is taken for it in the batches.
    """
    frames = batches.frames
    towards = _directions(frames)
    some = np.linspace(0, len(frames) - 1, min(len(frames), MOST)).round().astype(int)
    told = _told(some, model, batches, sensor)
    if not _Scatter.of(told, used, frames, towards).is_sure:
        return None
    told |= _told(np.setdiff1d(np.arange(len(frames)), list(told)), model, batches, sensor)
    scatter = _Scatter.of(told, used, frames, towards)
    errors = used.copy()
    errors[scatter.frames] = scatter.shared + scatter.own()
    # what all share is the unit of light; few frames that are far off do not move it
    return errors - _clipped(errors[:, None]).mean()


def jackknifed(
    estimate: Callable[[np.ndarray], np.ndarray], parts: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return an estimate of all, given which are taken, and its standard error by leaving out each part once."""
    without = np.array([estimate(parts != part) for part in np.unique(parts)])
    return estimate(parts >= 0), np.sqrt((len(without) - 1) * without.var(axis=0))


def _directions(frames: list[TrainingFrame]) -> np.ndarray:
    """Return unit vectors [F, 3] from the target to the camera."""
    poses = np.stack([frame.world_to_camera.double().numpy() for frame in frames])
    places = -np.einsum("fji,fj->fi", poses[:, :3, :3], poses[:, :3, 3])
    return places / np.linalg.norm(places, axis=1, keepdims=True)


def _told(
    indices: np.ndarray, model: Gaussians, batches: Batches, sensor: Sensor
) -> dict[int, tuple[float, float]]:
    """Return ln(read / expected light) of the upper and the lower half of frames that show enough, by index."""
    found = each(lambda i: _halves(model, batches.batch([i]), sensor), indices.tolist())
    return {i: halves for i, halves in zip(indices.tolist(), found, strict=True) if halves is not None}


def _halves(model: Gaussians, batch: Batch, sensor: Sensor) -> tuple[float, float] | None:
    radiance, dn = sampled(sensor, render(model, batch.cameras).radiance, batch.dn)
    prediction = sensor.predicted(radiance, batch.exposure_time_s)
    light, variance = prediction.expected_dn - sensor.black_dn, prediction.variance_dn2
    lit = (light > variance.sqrt()) & (light < BELOW_FULL_SCALE * (sensor.white_dn - sensor.black_dn))
    light, variance, read = light[lit], variance[lit], dn[lit] - sensor.black_dn
    middle, found = len(light) // 2, []
    for half in (slice(None, middle), slice(middle, None)):
        expected, seen = float(light[half].sum()), float(read[half].sum())
        if seen <= 0 or math.sqrt(float(variance[half].sum())) > HALF_ERROR * expected:
            return None
        found.append(math.log(seen / expected))
    return found[0], found[1]


def _clipped(values: np.ndarray) -> np.ndarray:
    """Return values [N, K] of which none is further from its column's median than outliers are."""
    middle = np.median(values, axis=0)
    most = OUTLIER * 1.4826 * np.median(np.abs(values - middle), axis=0)
    return values.clip(middle - most, middle + most)


@dataclass
class _Scatter:
    """What is left of frames' ratios beside what settings, a bent response and a drift do to all of their frames.

    frames: [N] indices. shared: [N] what those explain. left: [N, 2] the rest, of both halves.
    angles: [N, N] between directions of view, degrees.
    nugget, error: the variance of the frames' own errors, with its standard error.
    slope: of the variance over the angle, 1/degree.
    """

    frames: np.ndarray
    shared: np.ndarray
    left: np.ndarray
    angles: np.ndarray
    nugget: float = 0.0
    error: float = math.inf
    slope: float = 0.0

    @staticmethod
    def of(
        told: dict[int, tuple[float, float]],
        used: np.ndarray,
        frames: list[TrainingFrame],
        towards: np.ndarray,
    ) -> "_Scatter":
        if len(told) < FEWEST:
            return _Scatter(np.zeros(0, int), np.zeros(0), np.zeros((0, 2)), np.zeros((0, 0)))
        known = np.array(sorted(told))
        halves = np.array([told[i] for i in known.tolist()]).reshape(-1, 2) + used[known, None]
        logs = np.log([frames[i].exposure_time_s for i in known.tolist()])
        _, which, counts = np.unique(logs, return_inverse=True, return_counts=True)
        settings = [which == k for k in np.flatnonzero(counts >= FEWEST_OF_SETTING)]
        design = np.stack([np.ones(len(known)), logs, known / len(frames), *settings], axis=1).astype(float)
        shared, left = np.zeros_like(halves), halves
        for _ in range(3):
            shared = design @ np.linalg.lstsq(design, halves - left + _clipped(left), rcond=None)[0]
            left = halves - shared
        left = _clipped(left)
        angles = np.degrees(np.arccos(np.clip(towards[known] @ towards[known].T, -1, 1)))
        scatter = _Scatter(known, shared.mean(axis=1), left, angles)
        scatter._find_nugget()
        return scatter

    @property
    def is_sure(self) -> bool:
        """Whether frames surely have errors of their own that count."""
        return self.nugget > max(LEAST**2, CERTAIN * self.error)

    def own(self) -> np.ndarray:
        """Return each frame's own error [N]: what the frames around it do not predict (kriging)."""
        values, noise = self.left.mean(axis=1), (self.left[:, 0] - self.left[:, 1]).var() / 4
        smooth = max(0.0, float((self.left[:, 0] * self.left[:, 1]).mean()) - self.nugget)
        alike = np.exp(-self.angles * self.slope / smooth) if smooth else np.zeros_like(self.angles)
        covariance = smooth * alike + (self.nugget + noise) * np.eye(len(values))
        return self.nugget * np.linalg.solve(covariance, values)

    def _find_nugget(self) -> None:
        one, other = np.triu_indices(len(self.frames), 1)
        near = self.angles[one, other] < NEAR_DEG
        one, other = one[near], other[near]
        if len(one) < FEWEST_PAIRS:
            return
        apart = self.left[one] - self.left[other]
        angles, products = self.angles[one, other], apart[:, 0] * apart[:, 1] / 2

        def line(kept: np.ndarray) -> np.ndarray:
            both = kept[one] & kept[other]
            x, y = angles[both], products[both]
            # frames that are further apart are not more alike
            slope = max(0.0, float(np.cov(x, y)[0, 1] / max(x.var(ddof=1), 1e-9)))
            return np.array([y.mean() - slope * x.mean(), slope])

        (self.nugget, self.slope), (self.error, _) = jackknifed(
            line, np.arange(len(self.frames)) * PARTS // len(self.frames)
        )
