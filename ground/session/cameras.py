"""The cameras, Sun directions and sensor of a session as the library takes them, and a model's image of a frame."""

import numpy as np
import torch
from torch import Tensor

from flightsw.icd.mission import CameraSection
from ground.session.folder import FrameRecord, Session
from obbgs_core.model.cameras import Cameras, stacked_suns
from obbgs_core.model.gaussians import Gaussians
from obbgs_core.render import render
from obbgs_core.sensor import Sensor


def sensor_of(camera: CameraSection) -> Sensor:
    """Return the sensor model of a session's camera."""
    return Sensor(
        camera.black_dn,
        camera.white_dn,
        camera.dn_per_radiance_s,
        camera.electrons_per_dn,
        camera.read_noise_dn,
    )


def camera_of(session: Session, record: FrameRecord) -> Cameras:
    """Return the camera of one frame."""
    return cameras_of(session, [record])


def cameras_of(session: Session, records: list[FrameRecord]) -> Cameras:
    """Return the cameras of frames; they carry Sun directions only where every frame's pose tag knows its own."""
    poses = torch.stack([torch.tensor(r.world_to_camera, dtype=torch.float32) for r in records])
    camera = session.camera
    return Cameras(
        poses,
        torch.stack([torch.from_numpy(session.K(r)) for r in records]),
        camera.width,
        camera.height,
        sun_dir=stacked_suns([sun_direction(record) for record in records]),
        background=session.background,
        psf_sigma_px=camera.psf_sigma_px,
    )


def sun_direction(record: FrameRecord) -> Tensor | None:
    """Return the unit vector [3] from target to Sun at a frame, body frame; None where the pose tag has none."""
    length = float(np.linalg.norm(record.sun_dir_body))
    return torch.tensor(record.sun_dir_body / length, dtype=torch.float32) if length > 0 else None


def range_in_words(record: FrameRecord) -> str:
    """Return how far the camera was from the origin of the body frame, with four digits and the unit."""
    range_m = float(np.linalg.norm(record.position_body_m))
    return f"{range_m:,.0f} m" if range_m >= 1000 else f"{range_m:.4g} m"


def median_sun_direction(records: list[FrameRecord]) -> Tensor | None:
    """Return the Sun direction [3] with the least summed distance to those of all frames; None where none is known.

    Files that can hold only one illumination show the model under this one.
    """
    known = [sun for record in records if (sun := sun_direction(record)) is not None]
    if not known:
        return None
    directions = torch.stack(known)
    return directions[torch.cdist(directions, directions).sum(dim=1).argmin()]


@torch.no_grad()
def predicted_image(
    gaussians: Gaussians, session: Session, record: FrameRecord, sensor: Sensor, exposure_time_s: float
) -> Tensor:
    """Return the model's noiseless image [H, W, C] of a frame as a fraction of full scale, 0 to 1."""
    return exposed(render(gaussians, camera_of(session, record)).radiance[0], sensor, exposure_time_s)


def exposed(radiance: Tensor, sensor: Sensor, exposure_time_s: float) -> Tensor:
    """Return the noiseless image of a radiance [H, W, C] as a fraction of full scale, clipped as the sensor clips."""
    return (sensor.expected_dn(radiance, exposure_time_s) / sensor.white_dn).clamp(0, 1)
