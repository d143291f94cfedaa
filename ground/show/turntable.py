"""A model seen from all around: cameras on a circle about the target, and their pictures as one moving picture."""

import math

import imagecodecs
import numpy as np
import torch

from ground.session.cameras import exposed, median_sun_direction
from ground.session.folder import Session
from ground.show.pictures import tone
from obbgs_core.model.cameras import Cameras
from obbgs_core.model.gaussians import Gaussians
from obbgs_core.render import render
from obbgs_core.sensor import Sensor

VIEWS, FRAME_MS = 30, 100
DISTANCE = 8.0  # of the camera from the target's centre, in radii of the model
FITTED = 1.0  # radii of the model that fit into half of the shorter side
ELEVATION_RAD = math.radians(25)  # above the body's xy plane
LEAST_OPACITY, INLIERS = 0.5, 0.98  # fainter Gaussians and the farthest 2 % do not count for the model's size


def extent(gaussians: Gaussians) -> tuple[torch.Tensor, float]:
    """Return centre [3] m and radius, m, of a ball around the visible model, body frame, without its outliers.

    Where all is faint, as in a start that no step has trained, all of it counts.
    """
    places = gaussians.means.isfinite().all(dim=1)
    visible = places & (gaussians.opacities > LEAST_OPACITY)
    means = gaussians.means[visible if visible.any() else places].double()
    if len(means) == 0:
        return torch.zeros(3), 1.0
    ends = torch.quantile(means, torch.tensor([1 - INLIERS, INLIERS], dtype=torch.float64), dim=0)
    centre = ends.mean(dim=0)
    return centre.float(), max(1e-6, float((means - centre).norm(dim=1).quantile(INLIERS)))


def metres_per_pixel(session: Session) -> float:
    """Return the width that a pixel of the session's camera covers at the target, median over the frames."""
    return float(np.median([np.linalg.norm(r.position_body_m) / session.K(r)[0, 0] for r in session.frames]))


def circle(gaussians: Gaussians, session: Session, views: int, width: int, height: int) -> Cameras:
    """Return cameras on a circle that see the whole model, body z upwards, the Sun as in the session's median frame."""
    centre, radius_m = extent(gaussians)
    focal_px = DISTANCE * min(width, height) / 2 / FITTED
    K = torch.tensor([[focal_px, 0, width / 2], [0, focal_px, height / 2], [0, 0, 1.0]])
    azimuths = 2 * math.pi * torch.arange(views, dtype=torch.float64) / views
    poses = [looking_at(centre, DISTANCE * radius_m, float(a), ELEVATION_RAD) for a in azimuths]
    sun_dir = median_sun_direction(list(session.frames))
    return Cameras(
        torch.stack(poses),
        K.expand(views, 3, 3),
        width,
        height,
        sun_dir=None if sun_dir is None else sun_dir.expand(views, 3),
        background=session.background,
        psf_sigma_px=session.camera.psf_sigma_px,
        scale=focal_px / (DISTANCE * radius_m) * metres_per_pixel(session),
    )


def looking_at(
    centre: torch.Tensor, distance_m: float, azimuth_rad: float, elevation_rad: float
) -> torch.Tensor:
    """Return world_to_camera [4, 4] of a camera that sees `centre` [3] from this direction, with body z upwards."""
    a, e = azimuth_rad, elevation_rad
    forward = -np.array([math.cos(e) * math.cos(a), math.cos(e) * math.sin(a), math.sin(e)])
    right = np.array([-math.sin(a), math.cos(a), 0.0])
    pose = np.eye(4)
    pose[:3, :3] = right, np.cross(forward, right), forward  # OpenCV axes: right, down, forward
    pose[:3, 3] = -pose[:3, :3] @ (centre.double().numpy() - distance_m * forward)
    return torch.tensor(pose, dtype=torch.float32)


@torch.no_grad()
def pictures(
    gaussians: Gaussians, session: Session, sensor: Sensor, exposure_time_s: float, cameras: Cameras
) -> np.ndarray:
    """Return the model as the sensor would see it from each camera, in screen brightness: bytes [views, H, W, 3]."""
    shown = []
    for i in range(len(cameras)):
        radiance = render(gaussians, cameras.one(i)).radiance[0]
        shown.append(tone(exposed(radiance, sensor, exposure_time_s).numpy(), sensor, session.encoding))
    return np.stack(shown)


def moving_png(images: np.ndarray) -> bytes:
    """Return pictures, bytes [views, H, W, 3], as an animated PNG that repeats; grey ones take a third of the room."""
    if (images[..., :1] == images).all():
        images = images[..., 0]
    return bytes(imagecodecs.apng_encode(np.ascontiguousarray(images), level=6, delay=FRAME_MS))
