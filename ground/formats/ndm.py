"""Pictures with times beside navigation data messages of CCSDS (NDM): orbits and attitudes give the cameras' poses.

    camera.yaml      the lens, and how the camera is mounted on the chaser (`Camera`)
    images/          the pictures, or they lie beside the files
    target.oem, chaser.oem, target.aem, chaser.aem    as flight reads them (flightsw/icd/ndm)

Without target.aem the target's attitude is unknown, and `ground reconstruct` finds it.
"""

import dataclasses
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from flightsw.icd.config import (
    MAX_YAML_BYTES,
    build,
    in_file,
    parse_yaml,
    require_counts,
    require_unit_quaternion,
)
from flightsw.icd.ndm.formation import Formation, Geometry, role_of
from flightsw.icd.ndm.orbit import NoState
from flightsw.icd.ndm.text import MAX_NDM_BYTES
from flightsw.icd.quaternion import matrix_to_quat, quat_to_matrix
from flightsw.icd.reference_frames import EARTH_RADIUS_M, low_precision_sun
from ground.formats.photographs.brackets import in_brackets
from ground.formats.photographs.exposures import middle_utc_ns, unposed_pictures
from ground.formats.pictures.files import FormatError, Light
from ground.formats.pictures.lens import StatedLens
from ground.formats.pictures.view import View
from obbgs_base.errors import in_words
from obbgs_base.files import read_bounded

CAMERA = "camera.yaml"


@dataclass(frozen=True, kw_only=True)
class Camera(StatedLens):
    """The lens, and where the camera is on the chaser.

    quat_chaser_to_camera, camera_position_m: as in a mission file.
    """

    fx_px: float
    quat_chaser_to_camera: tuple[float, ...] = (1.0, 0.0, 0.0, 0.0)
    camera_position_m: tuple[float, ...] = (0.0, 0.0, 0.0)

    def __post_init__(self):
        self.check(self.fx_px, "camera")
        require_counts(self, "camera", quat_chaser_to_camera=4, camera_position_m=3)
        require_unit_quaternion(self.quat_chaser_to_camera, "camera.quat_chaser_to_camera")


def read_ndm(folder: Path, table: dict[str, Light] | None = None) -> list[View]:
    """Return the pictures of a folder with the poses that its messages give at their times, in the order of time.

    Args:
        table: what is known of the pictures' exposures and times beside what they say themselves.

    Raises:
        FormatError: a file is missing, a picture states no time, or a message does not cover one.
        ConfigError: camera.yaml or a message is not valid.
    """
    try:
        content = read_bounded(folder / CAMERA, MAX_YAML_BYTES)
        paths = [path for path in sorted(folder.iterdir()) if role_of(path.name)]
        files = {path.name: read_bounded(path, MAX_NDM_BYTES) for path in paths}
    except OSError as error:
        raise FormatError(
            f"{in_words(error)}; expected {CAMERA}, target.oem, chaser.oem and chaser.aem there"
        ) from error
    with in_file(folder / CAMERA):
        camera = build(Camera, parse_yaml(content, "camera"), "camera")
    with in_file(folder):
        formation = Formation.of(files)
    if formation.chaser_attitude is None:
        raise FormatError(f"{folder}: chaser.aem is missing, which says where the camera looks")
    posed = [_posed(view, camera, formation, table or {}) for view in unposed_pictures(folder, table)]
    return in_brackets(posed)


def _posed(view: View, camera: Camera, formation: Formation, table: dict[str, Light]) -> View:
    utc_ns = middle_utc_ns(view.image, camera.times, table.get(view.image.name))
    try:
        found = formation.at(utc_ns)
    except NoState as error:
        raise FormatError(f"{view.image}: {error}") from error
    assert found.quat_gcrs_to_chaser is not None
    to_chaser, known = quat_to_matrix(found.quat_gcrs_to_chaser), found.quat_gcrs_to_body is not None
    to_body = quat_to_matrix(found.quat_gcrs_to_body) if found.quat_gcrs_to_body is not None else np.eye(3)
    position_m = to_body @ (found.chaser_from_target_m + to_chaser.T @ np.array(camera.camera_position_m))
    pose = np.eye(4)
    pose[:3, :3] = quat_to_matrix(np.array(camera.quat_chaser_to_camera)) @ to_chaser @ to_body.T
    pose[:3, 3] = -pose[:3, :3] @ position_m
    covariance = None
    if found.covariance is not None:
        covariance = np.zeros((6, 6))
        covariance[:3, :3] = to_body @ found.covariance[:3, :3] @ to_body.T
    sun = low_precision_sun(utc_ns)
    return dataclasses.replace(
        view,
        world_to_camera=pose,
        intrinsics=camera.lens(view.intrinsics.width, view.intrinsics.height, camera.fx_px),
        mid_exposure_utc_ns=utc_ns,
        sun_dir_body=to_body @ sun,
        in_eclipse=_in_eclipse(found, sun),
        covariance=covariance,
        attitude_known=known,
        quat_inertial_to_body=matrix_to_quat(to_body),
        target_position_m=None if found.target is None else found.target.position_m,
    )


def _in_eclipse(found: Geometry, sun: np.ndarray) -> bool:
    """Return whether the Earth hides the middle of the Sun from the target; False where its place is not known."""
    if found.target is None:
        return False
    along = found.target.position_m @ sun
    across_m = np.linalg.norm(found.target.position_m - along * sun)
    return bool(along < 0 and across_m < EARTH_RADIUS_M)
