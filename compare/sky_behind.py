"""What stands behind the target in a condition: the Earth from a stated orbit, and stars."""

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from obbgs_base.physics.earth import RADIUS_M, camera_rays, earth_radiance
from obbgs_base.physics.stars import star_radiance
from obbgs_core.frames import TrainingFrame

HEIGHT_M = 500_000.0  # of the circular orbit, over the Earth's day side
LOWEST_SUN = 0.1  # cosine of the Sun's angle from the zenith
SEED = 20261127
TRIES = 200  # to find a place on the orbit by day
GOLDEN = (math.sqrt(5) - 1) / 2  # its multiples spread evenly between 0 and 1


@dataclass(frozen=True)
class SkyBehind:
    """The radiance [H, W, C] behind the target, and where the Earth is, as in `TrainingFrame`; None: not in view."""

    radiance: np.ndarray
    earth_m: Tensor | None


def behind(frame: TrainingFrame, earth_share: float, star_gain: float) -> SkyBehind:
    """Return what is behind the target of a frame; it depends on the frame's number, pose and Sun only.

    The target's axes do not turn, so that the stars do not move in them. Each frame with the Earth is taken over
    another place, with the Earth's centre or its limb in the picture, and the camera over the day side where the
    target's Sun allows that.

    Args:
        earth_share: of all frames, those that have the Earth in view.
        star_gain: how many times brighter than real ones stars are, times the solid angle of a pixel, sr.
    """
    height, width, channels = frame.dn.shape
    K, body_to_camera = frame.K.double().numpy(), frame.world_to_camera[:3, :3].double().numpy()
    light, earth_m = np.zeros((height, width, channels)), None
    if star_gain:
        pixel_sr = 1 / (K[0, 0] * K[1, 1])
        light += star_gain * pixel_sr * star_radiance(body_to_camera, K, width, height)[..., None]
    if ((frame.id + 1) * GOLDEN) % 1 < earth_share:
        rng = np.random.default_rng((SEED, frame.id))
        sun = None if frame.sun_dir is None else body_to_camera @ frame.sun_dir.double().numpy()
        up, sun = _place(rng, sun, math.atan(math.hypot(width, height) / (K[0, 0] + K[1, 1])))
        position_m = (RADIUS_M + HEIGHT_M) * up
        to_ground, _ = np.linalg.qr(rng.standard_normal((3, 3)))
        seen = earth_radiance(camera_rays(K, width, height), position_m, sun, 1 / K[0, 0], to_ground)
        light = np.where((seen > 0).any(axis=2, keepdims=True), 0, light)
        light += seen if channels == 3 else seen.mean(axis=2, keepdims=True)
        earth_m = torch.from_numpy(-position_m).float()
    return SkyBehind(light, earth_m)


def _place(
    rng: np.random.Generator, sun: np.ndarray | None, half_view_rad: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return the zenith and the Sun, unit vectors in the camera's axes, of a place with the Earth in the picture.

    Args:
        sun: [3] towards it, in the camera's axes; None: at random, in the sky over the camera.
        half_view_rad: from the picture's middle to its corners.
    """
    limb_rad = math.asin(RADIUS_M / (RADIUS_M + HEIGHT_M))
    best = (-math.inf, np.zeros(3), np.zeros(3))
    for _ in range(TRIES):
        cosine = rng.uniform(math.cos(limb_rad + half_view_rad / 2), 1)  # of the nadir from the camera's axis
        around, sine = rng.uniform(0, 2 * math.pi), math.sqrt(1 - cosine**2)
        up = -np.array([sine * math.cos(around), sine * math.sin(around), cosine])
        there = _over(rng, up) if sun is None else sun
        best = max(best, (float(up @ there), up, there), key=lambda place: place[0])
        if best[0] > LOWEST_SUN:
            break
    return best[1], best[2]


def _over(rng: np.random.Generator, up: np.ndarray) -> np.ndarray:
    """Return a direction at random, even over the sky above a place whose zenith is `up`."""
    drawn = rng.standard_normal(3)
    drawn /= np.linalg.norm(drawn)
    return drawn if drawn @ up > 0 else -drawn
