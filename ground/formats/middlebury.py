"""The Middlebury multi-view data: pictures and a file NAME_par.txt with K, R and t of K [R t] for each of them.

The centre of the first pixel is at (0, 0) there; here it is at (0.5, 0.5). Poses are world to camera in OpenCV axes.

Source: Seitz, Curless, Diebel, Scharstein, Szeliski, CVPR 2006; vision.middlebury.edu/mview/data.
"""

from pathlib import Path

import numpy as np

from ground.formats.pictures.files import FormatError, image_size, within
from ground.formats.pictures.lens import Intrinsics
from ground.formats.pictures.view import View
from obbgs_base.errors import counted, reason

NUMBERS = 21  # of a picture: K, R and t
ROTATION_TOLERANCE = 1e-3


def read_middlebury(folder: Path) -> list[View]:
    """Return the pictures of a folder with their published cameras, by name; a skew in K is kept (`Intrinsics`).

    Raises:
        FormatError: there is no single file NAME_par.txt, or a line of it is no camera.
    """
    stated = [path for path in sorted(folder.glob("*_par.txt")) if not path.name.startswith(".")]
    if len(stated) != 1:
        raise FormatError(f"{folder}: expected one file NAME_par.txt, the cameras; found {len(stated)}")
    try:
        count, *lines = filter(str.strip, stated[0].read_text().splitlines())
        views = [_view(folder, stated[0], line) for line in sorted(lines)]
        if int(count) != len(views):
            raise ValueError(
                f"expected {counted(int(count), 'picture')}, as the first line says, got {len(views)}"
            )
    except (OSError, ValueError) as error:
        raise FormatError(f"{stated[0]}: {reason(error)}") from error
    return views


def _view(folder: Path, stated: Path, line: str) -> View:
    name, *numbers = line.split()
    values = np.array(numbers, dtype=np.float64)
    if values.shape != (NUMBERS,) or not np.isfinite(values).all():
        raise ValueError(f"{name}: expected {NUMBERS} finite numbers (K, R and t), got {len(values)}")
    K, R, pose = values[:9].reshape(3, 3), values[9:18].reshape(3, 3), np.eye(4)
    if np.abs(R @ R.T - np.eye(3)).max() > ROTATION_TOLERANCE or np.linalg.det(R) < 0:
        raise ValueError(f"{name}: R is no rotation")
    if K[1, 0] or K[2, 0] or K[2, 1] or K[2, 2] != 1:
        raise ValueError(f"{name}: expected K as [[fx, skew, cx], [0, fy, cy], [0, 0, 1]], got {K.tolist()}")
    pose[:3, :3], pose[:3, 3] = R, values[18:]
    image = within(folder, name, stated)
    lens = Intrinsics(
        *image_size(image),
        *(float(K[0, 0]), float(K[1, 1])),
        cx_px=float(K[0, 2]) + 0.5,
        cy_px=float(K[1, 2]) + 0.5,
        skew_px=float(K[0, 1]),
    )
    return View(image, pose, lens)
