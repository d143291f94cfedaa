"""LLFF folders: images/ and poses_bounds.npy, one row for each picture in the order of their names.

A row holds a matrix [3, 5], camera to world with axes down, right and backwards and a last column of height, width and
focal length (px), then the nearest and farthest depth. A folder masks/ beside images/ holds pictures of the same names,
white where the target is.

Source: Mildenhall et al., Local Light Field Fusion, 2019; github.com/Fyusion/LLFF.
"""

from pathlib import Path

import numpy as np

from ground.formats.axes import rigid_inverse
from ground.formats.pictures.files import FormatError, pictures_in, read_header, within
from ground.formats.pictures.lens import Intrinsics
from ground.formats.pictures.view import View
from obbgs_base.errors import counted, reason

COLUMNS = 17
ROTATION_TOLERANCE = 1e-3
# columns of LLFF's camera axes down, right, backwards as ours: x is right, y is down, z is forwards
TO_OPENCV = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])


def read_llff(folder: Path) -> list[View]:
    """Return the pictures of an LLFF folder, in the order of their names, with their masks if there are any.

    Pictures may be smaller than the poses say; the focal length is then made smaller with them.

    Raises:
        FormatError: a file is missing or not valid, or pictures and poses differ in number.
    """
    path = folder / "poses_bounds.npy"
    try:
        with open(path, "rb") as file:
            rows = np.load(file, allow_pickle=False)
    except (OSError, ValueError, EOFError, MemoryError) as error:
        raise FormatError(f"{path}: the poses cannot be read: {reason(error)}") from error
    if rows.ndim != 2 or rows.shape[1] != COLUMNS or rows.dtype.kind != "f" or not np.isfinite(rows).all():
        raise FormatError(
            f"{path}: expected rows of {COLUMNS} finite numbers, got {rows.dtype} {list(rows.shape)}"
        )
    names = pictures_in(folder / "images")
    if len(names) != len(rows):
        raise FormatError(
            f"{path}: it has {counted(len(rows), 'pose')}, but images/ has "
            f"{counted(len(names), 'picture')}; LLFF gives the poses of all "
            "pictures in the order of their names: take those out that have none"
        )
    masks = _masks(folder / "masks")
    return [
        _view(within(folder, f"images/{name}", path), row, masks.get(Path(name).stem), path)
        for name, row in zip(names, rows, strict=True)
    ]


def _masks(folder: Path) -> dict[str, Path]:
    """Return the masks of a folder by the name of their picture without its suffix; none where there is no folder."""
    return {Path(name).stem: folder / name for name in pictures_in(folder)} if folder.is_dir() else {}


def _view(image: Path, row: np.ndarray, mask: Path | None, where: Path) -> View:
    matrix = row[:15].reshape(3, 5)
    R, (height, width, focal_px) = matrix[:, :3] @ TO_OPENCV, matrix[:, 4]
    if np.abs(R @ R.T - np.eye(3)).max() > ROTATION_TOLERANCE or np.linalg.det(R) < 0:
        raise FormatError(f"{where}: {image.name}: the pose holds no rotation")
    header = read_header(image)
    scale_x, scale_y = header.width / width, header.height / height
    if not (
        scale_x > 0 and abs(scale_y * width / header.width - 1) < max(1 / header.width, 1 / header.height)
    ):
        raise FormatError(
            f"{where}: {image.name}: the pose is of a picture of {width:g}x{height:g} pixels, this one has "
            f"{header.width}x{header.height}, which is of another shape"
        )
    camera_to_world = np.eye(4)
    camera_to_world[:3, :3], camera_to_world[:3, 3] = R, matrix[:, 3]
    try:
        lens = Intrinsics(
            *(header.width, header.height, float(focal_px * scale_x), float(focal_px * scale_y)),
            cx_px=header.width / 2,
            cy_px=header.height / 2,
        )
    except ValueError as error:
        raise FormatError(f"{where}: {image.name}: {error}") from error
    return View(image, rigid_inverse(camera_to_world), lens, mask=mask)
