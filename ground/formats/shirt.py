"""SHIRT (Park and D'Amico 2022): rendezvous trajectories ROE1 and ROE2, rendered (synthetic) and in the lab (lightbox).

All pictures have the same exposure time, which the data set does not state.
"""

from pathlib import Path
from typing import Any

import numpy as np

from flightsw.icd.config import MAX_JSON_BYTES, ConfigError, parse_json
from flightsw.icd.quaternion import quat_to_matrix
from ground.formats.pictures.files import FormatError
from ground.formats.pictures.lens import Intrinsics
from ground.formats.pictures.view import View
from obbgs_base.files import read_bounded


def read_shirt(folder: Path) -> list[View]:
    """Return the pictures of one trajectory in one domain, in the order of flight.

    Args:
        folder: for example shirtv1/roe1/synthetic, which holds images/; roe1.json, camera.json and metadata.json lie in
            it or in one of the two folders above.

    Raises:
        FormatError: a file is missing or not valid.
    """
    trajectory = folder.resolve().parent
    intrinsics = _intrinsics(_load(folder, "camera.json"))
    step_s, to_camera = _metadata(_load(folder, "metadata.json"))
    entries = _load(folder, f"{trajectory.name}.json")
    views = []
    try:
        for number, entry in enumerate(entries):
            target_to_servicer = _transform(entry["q_vbs2tango_true"], entry["r_Vo2To_vbs_true"])
            views.append(
                View(
                    folder / "images" / Path(entry["filename"]).name,
                    to_camera @ target_to_servicer,
                    intrinsics,
                    mid_exposure_utc_ns=round(number * step_s * 1e9),
                )
            )
    except (KeyError, TypeError, ValueError) as error:
        raise FormatError(
            f"{trajectory.name}.json: expected a list of filename, q_vbs2tango_true, r_Vo2To_vbs_true: {error!r}"
        ) from error
    return views


def _load(folder: Path, name: str) -> Any:
    places = [folder.resolve(), *folder.resolve().parents[:2]]
    for place in places:
        if (place / name).is_file():
            try:
                return parse_json(read_bounded(place / name, MAX_JSON_BYTES), Path(name).stem)
            except ConfigError as error:
                raise FormatError(f"{place / name}: {error}") from error
    raise FormatError(f"{folder}: {name} is neither in it nor in the two folders above")


def _transform(quat: Any, translation: Any) -> np.ndarray:
    """Return [4, 4], p_b = R(q) p_a + t. SHIRT's q_b2a is the rotation from a's axes to b's (checked on SPEED+)."""
    q, t = np.array(quat, dtype=np.float64), np.array(translation, dtype=np.float64)
    if q.shape != (4,) or t.shape != (3,) or not 0.9 < np.linalg.norm(q) < 1.1:
        raise ValueError(f"expected a unit quaternion and a vector, got {quat} and {translation}")
    matrix = np.eye(4)
    matrix[:3, :3] = quat_to_matrix(q / np.linalg.norm(q))
    matrix[:3, 3] = t
    return matrix


def _metadata(tree: Any) -> tuple[float, np.ndarray]:
    """Return the seconds between pictures, and the transform [4, 4] from the servicer's axes to the camera's."""
    try:
        mounting = tree["pMdl"]
        # Named like the poses: q_pri2cam rotates camera axes to servicer axes; r is the camera's place in the latter.
        camera_to_servicer = _transform(mounting["q_pri2cam"], mounting["r_pri2cam_pri"])
        return float(tree["pSim"]["cam_step"]), np.linalg.inv(camera_to_servicer)
    except (KeyError, TypeError, ValueError) as error:
        raise FormatError(
            f"metadata.json: expected pSim.cam_step and pMdl.q_pri2cam, r_pri2cam_pri: {error!r}"
        ) from error


def _intrinsics(tree: Any) -> Intrinsics:
    try:
        K = np.array(tree["cameraMatrix"], dtype=np.float64).reshape(3, 3)
        distortion = [float(value) for value in np.ravel(tree["distCoeffs"])]
        if len(distortion) not in (4, 5):
            raise ValueError(f"expected 4 or 5 distortion coefficients, got {len(distortion)}")
        k1, k2, p1, p2, k3 = [*distortion, 0.0][:5]
        fx, fy, cx, cy = (float(K[i, j]) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
        return Intrinsics(int(tree["Nu"]), int(tree["Nv"]), fx, fy, cx, cy, (k1, k2, p1, p2, k3))
    except (KeyError, TypeError, ValueError) as error:
        raise FormatError(f"camera.json: expected cameraMatrix, distCoeffs, Nu and Nv: {error!r}") from error
