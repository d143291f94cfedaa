"""Where the Earth is in a session's frames: from the target's orbit, the attitude that a tag assumes, and the time."""

import numpy as np

from flightsw.icd.quaternion import matrix_to_quat, quat_to_matrix
from flightsw.icd.reference_frames import low_precision_sun
from flightsw.icd.tle import position_gcrs_m
from ground.session.folder import FrameRecord, Session
from obbgs_base.physics.earth import OCEAN, THICK_CLOUD, camera_rays, earth_radiance

RAYS = 24  # along a side of the picture, at which light is expected
BLOCK_PX = 4
LOW_SHARE = 0.2  # of the Earth beside the target, at least, is darker than the target's bright faces
FAINT = 0.25  # of the noise of one reading: light that nobody need take for anything


def target_place_m(session: Session, record: FrameRecord) -> np.ndarray | None:
    """Return where the target is at a frame's mid-exposure: [3] m from the Earth's centre, GCRS; None: not known.

    It is the frame's `target_position_m` or, if that is None, follows from the target's two-line elements by SGP4.

    Raises:
        ConfigError: SGP4 cannot propagate the elements.
    """
    if record.target_position_m is None and session.tles.get("target"):
        return position_gcrs_m(session.tles["target"], record.mid_exposure_utc_ns)
    return record.target_position_m


def attitude_behind(quat_inertial_to_body: np.ndarray, was: np.ndarray, now: np.ndarray) -> np.ndarray:
    """Return the attitude [4] of the target that a frame's new pose assumes, where its camera's stays what it was.

    Earth, Sun and stars are then where the old pose has them, in which pose and assumed attitude err alike.

    Args:
        quat_inertial_to_body: [4] the attitude that the old pose assumes.
        was, now: [4, 4] world_to_camera.
    """
    return matrix_to_quat(now[:3, :3].T @ was[:3, :3] @ quat_to_matrix(quat_inertial_to_body))


def earth_m(session: Session, record: FrameRecord, dn: np.ndarray) -> np.ndarray | None:
    """Return where the Earth's centre is in a frame that shows it: [3] m from the camera, in the camera's axes.

    None comes back where the target's place is not known, or the attitude that the pose assumes; where the Earth and
    its air are beside the picture, or at night all over it; and where the readings stay at the black level though the
    Earth should shine: a simulator left it out, or flight sent it as black.

    Args:
        dn: [H, W] or [H, W, C] the frame's readings.

    Raises:
        ConfigError: SGP4 cannot propagate the elements.
    """
    place_m = target_place_m(session, record)
    if place_m is None or record.quat_inertial_to_body is None:
        return None
    to_body = quat_to_matrix(record.quat_inertial_to_body)
    to_camera = record.world_to_camera[:3, :3] @ to_body
    position_m = to_camera @ (place_m + to_body.T @ record.position_body_m)
    sun = to_camera @ low_precision_sun(record.mid_exposure_utc_ns)
    return -position_m if _shines(session, record, dn, position_m, sun) else None


def _shines(
    session: Session, record: FrameRecord, dn: np.ndarray, position_m: np.ndarray, sun: np.ndarray
) -> bool:
    """Return whether a frame shows light of the Earth, where there is some to be seen."""
    camera, gain = session.camera, session.camera.dn_per_radiance_s * record.exposure_time_s
    rows, columns = ((np.arange(RAYS) + 0.5) * size / RAYS for size in (camera.height, camera.width))
    scale = np.diag([RAYS / camera.width, RAYS / camera.height, 1.0])
    rays = camera_rays(scale @ session.K(record).astype(float), RAYS, RAYS)
    least, most = (
        gain * earth_radiance(rays, position_m, sun, 1.0, albedo=_even(value)).mean(axis=2)
        for value in (OCEAN, THICK_CLOUD)
    )
    noise_dn = max(camera.read_noise_dn, 0.3)  # and that of rounding
    if most.max() <= FAINT * noise_dn:
        return False
    if least.max() <= FAINT * noise_dn:
        return True
    lit = least > least.max() / 2
    around = np.s_[: camera.height // BLOCK_PX * BLOCK_PX, : camera.width // BLOCK_PX * BLOCK_PX]
    grey = dn.reshape(camera.height, camera.width, -1).mean(axis=2)[around]
    blocks = grey.reshape(camera.height // BLOCK_PX, BLOCK_PX, -1, BLOCK_PX).mean(axis=(1, 3))
    y = np.searchsorted(rows, (np.arange(blocks.shape[0]) + 0.5) * BLOCK_PX).clip(max=RAYS - 1)
    x = np.searchsorted(columns, (np.arange(blocks.shape[1]) + 0.5) * BLOCK_PX).clip(max=RAYS - 1)
    low_dn = np.quantile(blocks[lit[np.ix_(y, x)]], LOW_SHARE) - camera.black_dn
    return bool(low_dn > np.median(least[lit]) / 2)


def _even(albedo: float):
    """Return an Earth of one albedo all over."""
    return lambda normals, finest_rad: np.full(len(normals), albedo)
