"""What multi-view stereo knows of each frame before it looks for depths: light, camera, range, and neighbours."""

import hashlib
import math
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from obbgs_core.errors import ReconstructionError
from obbgs_core.frames import TrainingFrame, mean_exposure_s, usable
from obbgs_core.sensor import Sensor
from obbgs_core.start import hull, initialisation

# the score of a neighbour falls off from this angle between the lines of sight, on each side at its own rate
BEST_ANGLE_DEG, NARROW_DEG, WIDE_DEG = 15.0, 5.0, 15.0
WIDEST_ANGLE_DEG = 60.0  # beyond, two views share too little to be matched
SPHERE_POINTS = 256  # on which the overlap of two views is measured
REACH_PX = 7  # farther from certain light nothing is matched
FEWEST_LIT_PX = 20  # a frame with fewer certainly lit pixels is not matched


@dataclass(frozen=True)
class View:
    """One frame for matching.

    image: [C, H, W], 1 is full scale, of the one exposure to which all frames were brought, or of each frame's own.
    full_scale: at this value the view's own exposure saturates.
    lit: [H, W] pixels that are probably light; only these get a depth.
    """

    image: Tensor
    full_scale: float
    lit: Tensor
    world_to_camera: Tensor  # [4, 4] float64
    K: Tensor  # [3, 3] float64, px

    @property
    def centre(self) -> Tensor:
        """Return the camera's centre [3], m, body frame."""
        return -self.world_to_camera[:3, :3].T @ self.world_to_camera[:3, 3]


@dataclass(frozen=True)
class Views:
    """All frames that show light, and how far from the body's origin the target reaches."""

    views: list[View]
    radius_m: float
    digest: str  # of all frames and of how they were prepared


def prepare(frames: list[TrainingFrame], sensor: Sensor, one_exposure: bool) -> Views:
    """Return the frames that show light, brought to the geometric mean of their exposures or as they are.

    Args:
        one_exposure: readings are divided by the exposure time. If false, they are taken as they are, as by somebody
            who does not know that the exposures differ.

    Raises:
        TooFewFrames, ReconstructionError: the frames do not fit together, or are black.
    """
    frames, _ = usable(frames, exposure_aware=True)
    radius_m = hull.radius_m(list(initialisation.silhouettes(frames, sensor).values()))
    if radius_m == 0:
        raise ReconstructionError(
            f"all {len(frames)} frames are black (eclipse, or exposures too short): nothing rises above the noise"
        )
    reference_s, full_dn = mean_exposure_s(frames), sensor.white_dn - sensor.black_dn
    views, digest = [], hashlib.sha256(f"{sensor} {one_exposure}".encode())
    for f in frames:
        outline = hull.silhouette(f.dn, sensor, f.world_to_camera, f.K)
        for value in (f.dn, f.world_to_camera, f.K):
            digest.update(value.detach().contiguous().numpy().tobytes())
        digest.update(repr(f.exposure_time_s).encode())
        if outline.certain.sum() < FEWEST_LIT_PX:
            continue
        gain = reference_s / f.exposure_time_s if one_exposure else 1.0
        image = (f.dn - sensor.black_dn).movedim(-1, 0) * (gain / full_dn)
        # probable light far from any certain light is mostly noise
        lit = outline.likely & _near(outline.certain)
        views.append(View(image.float(), gain, lit, f.world_to_camera.double(), f.K.double()))
    return Views(views, radius_m, digest.hexdigest())


def _near(mask: Tensor) -> Tensor:
    """Return which pixels [H, W] have a pixel of the mask within `REACH_PX` rows and columns."""
    return F.max_pool2d(mask.float()[None], 2 * REACH_PX + 1, 1, REACH_PX)[0] > 0


def neighbours(views: Views, count: int) -> list[list[int]]:
    """Return for each view the indices of up to `count` others to match it with, the best first.

    The score is the overlap, the share of the sphere around the target seen by the one that the other sees as well,
    times a Gaussian of the angle between the lines of sight, as for sparse points in Yao et al., MVSNet, 2018.
    """
    points = _sphere() * views.radius_m
    seen = torch.stack([_sees(view, points) for view in views.views]).double()  # [V, P]
    directions = torch.stack([view.centre / view.centre.norm() for view in views.views])
    angle_deg = torch.rad2deg((directions @ directions.T).clamp(-1, 1).acos())
    overlap = (seen @ seen.T) / seen.sum(dim=1, keepdim=True).clamp(min=1)
    width_deg = torch.where(angle_deg < BEST_ANGLE_DEG, NARROW_DEG, WIDE_DEG)
    score = overlap * torch.exp(-0.5 * ((angle_deg - BEST_ANGLE_DEG) / width_deg) ** 2)
    score[angle_deg > WIDEST_ANGLE_DEG] = 0
    score.fill_diagonal_(0)
    best = score.sort(dim=1, descending=True, stable=True)
    return [
        [int(j) for j, s in zip(order[:count], scores[:count], strict=True) if s > 0]
        for order, scores in zip(best.indices, best.values, strict=True)
    ]


def _sphere() -> Tensor:
    """Return points [P, 3] spread evenly over the unit sphere (Fibonacci's lattice)."""
    k = torch.arange(SPHERE_POINTS, dtype=torch.float64)
    z = 1 - (2 * k + 1) / SPHERE_POINTS
    longitude = k * math.pi * (3 - math.sqrt(5))
    ring = (1 - z * z).sqrt()
    return torch.stack([ring * longitude.cos(), ring * longitude.sin(), z], dim=1)


def _sees(view: View, points: Tensor) -> Tensor:
    """Return which points [P, 3] of a sphere about the origin face the view and lie in its picture."""
    height, width = view.lit.shape
    p = points @ view.world_to_camera[:3, :3].T + view.world_to_camera[:3, 3]
    uv = (p @ view.K.T)[:, :2] / p[:, 2:].clamp(min=1e-9)
    inside = (p[:, 2] > 0) & (uv >= 0).all(dim=1) & (uv[:, 0] < width) & (uv[:, 1] < height)
    return inside & (((view.centre - points) * points).sum(dim=1) > 0)


def depth_range_m(view: View, radius_m: float) -> tuple[float, float]:
    """Return the least and the greatest depth, m, that a target of a radius about the origin has in a view."""
    middle_m = float(view.world_to_camera[2, 3])
    return max(middle_m - radius_m, 0.02 * middle_m), middle_m + radius_m


def pixel_rays(rows: Tensor, columns: Tensor, K: Tensor) -> Tensor:
    """Return the points [..., 3] at depth 1 on the rays of pixels, in the camera's frame."""
    pixels = torch.stack([columns + 0.5, rows + 0.5, torch.ones_like(rows, dtype=K.dtype)], dim=-1)
    return pixels.to(K.dtype) @ torch.linalg.inv(K).T


def relative(reference: View, source: View) -> tuple[Tensor, Tensor]:
    """Return rotation [3, 3] and translation [3] m from the reference's camera frame into the source's."""
    pose = source.world_to_camera @ torch.linalg.inv(reference.world_to_camera)
    return pose[:3, :3], pose[:3, 3]
