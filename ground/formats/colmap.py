"""COLMAP models: cameras and images as text or binary; poses are world to camera in OpenCV axes, like ours.

COLMAP's own library, pycolmap 4.2.1, reads these files too, but never ends on some with one flipped bit; it is the
oracle of the tests. Source: colmap.github.io/format.html.
"""

import dataclasses
import logging
import struct
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from flightsw.icd.quaternion import quat_to_matrix
from ground.formats.nerf import as_exported
from ground.formats.nerfstudio import read_nerfstudio
from ground.formats.pictures.files import FormatError, within
from ground.formats.pictures.lens import Intrinsics
from ground.formats.pictures.placement import with_stated_errors
from ground.formats.pictures.views import Exported, View
from ground.session.earth import attitude_behind
from obbgs_base.errors import in_words

log = logging.getLogger(__name__)

# Model number in binary files: its name and the names of its parameters (f is both focal lengths).
MODELS = {
    0: ("SIMPLE_PINHOLE", ("f", "cx", "cy")),
    1: ("PINHOLE", ("fx", "fy", "cx", "cy")),
    2: ("SIMPLE_RADIAL", ("f", "cx", "cy", "k1")),
    3: ("RADIAL", ("f", "cx", "cy", "k1", "k2")),
    4: ("OPENCV", ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")),
}
PARAMETERS = dict(MODELS.values())
SUFFIXES = (".bin", ".txt")
ROUNDED = 1e-6  # a pose of ours that went through a model's quaternion differs by less, of its distance or in radians


def read_colmap(folder: Path) -> list[View]:
    """Return the registered pictures of a COLMAP model, in the order of their names.

    Of several models, as the mapper leaves them in sparse/0, sparse/1 and so on, the one with the most pictures is
    taken and the others are named. A file test.txt beside the model, with the names of the test pictures, states the
    splits, as for 3DGS.

    Args:
        folder: holds images/, and the model itself or in sparse/ or a folder of it; binary files are preferred to text.

    Raises:
        FormatError: there is no model, it is damaged, has no pictures, a camera model that is not in `MODELS`, or names
            a picture outside the folder.
    """
    found = {}
    for model in _models(folder):
        try:
            found[model] = _read(model)
        except (ValueError, IndexError, KeyError, struct.error, OSError, OverflowError) as error:
            raise FormatError(f"{model}: damaged or not a COLMAP model: {in_words(error)}") from error
    if not found:
        raise FormatError(f"{folder}: no cameras and images files (.bin or .txt), nor in sparse/0")
    largest = max(found, key=lambda model: len(found[model]))
    if not found[largest]:
        raise FormatError(f"{largest}: the COLMAP model has no pictures; run its mapper again")
    if others := [f"{model} has {len(images)}" for model, images in found.items() if model != largest]:
        log.warning(
            "%s: the model with the most pictures, %d, is taken; %s; `colmap model_merger` joins models",
            *(largest, len(found[largest]), ", ".join(others)),
        )
    split_of = _splits(largest / "test.txt")
    views = [
        View(within(folder, f"images/{name}", largest), pose, lens, split=split_of(name))
        for name, (pose, lens) in found[largest].items()
    ]
    return sorted(views, key=lambda view: view.image.name)


def read_colmap_and_export(folder: Path) -> tuple[list[View], Exported | None]:
    """Return the pictures of a COLMAP model; of a folder that we exported with what COLMAP has no place for.

    Exposure times, readings of 16 bits and the sensor's figures come from transforms.json of `export_nerfstudio`.
    Cameras are those of the model: other software may have changed them, and then they err as stated cameras do.

    Raises:
        FormatError: as `read_colmap` and `read_nerfstudio`.
    """
    views = read_colmap(folder)
    if not (folder / "transforms.json").is_file():
        return views, None
    told, exported = read_nerfstudio(folder)
    if exported is None:
        return views, None
    told_of = {view.image: view for view in told}
    return as_exported([_completed(view, told_of.get(view.image)) for view in views], exported)


def _completed(view: View, told: View | None) -> View:
    """Return a view with what our export says of its picture, but its own camera."""
    if told is None:
        return view
    was, now, attitude = told.world_to_camera, view.world_to_camera, told.quat_inertial_to_body
    completed = dataclasses.replace(
        told,
        world_to_camera=now,
        intrinsics=view.intrinsics,
        split=view.split,
        quat_inertial_to_body=None if attitude is None else attitude_behind(attitude, was, now),
        sun_dir_body=now[:3, :3].T @ was[:3, :3] @ told.sun_dir_body,
    )
    apart = np.abs(now - was)
    apart[:, 3] /= max(1.0, float(np.linalg.norm(was[:3, 3])))
    if (apart < ROUNDED).all():
        return completed
    return with_stated_errors([dataclasses.replace(completed, covariance=None)])[0]


def _models(folder: Path) -> Iterator[Path]:
    """Return the folders that hold a model: the folder itself, sparse/ or the folders in it."""
    below = sorted(path for path in (folder / "sparse").glob("*") if path.is_dir())
    for place in (folder, folder / "sparse", *below):
        if any(_has(place, suffix) for suffix in SUFFIXES):
            yield place


def _has(model: Path, suffix: str) -> bool:
    return (model / f"cameras{suffix}").is_file() and (model / f"images{suffix}").is_file()


def _read(model: Path) -> dict[str, tuple[np.ndarray, Intrinsics]]:
    """Return pose and camera of each picture of a model by its name."""
    suffix = next(suffix for suffix in SUFFIXES if _has(model, suffix))
    cameras, images = (_cameras_bin, _images_bin) if suffix == ".bin" else (_cameras_txt, _images_txt)
    known = dict(cameras(model / f"cameras{suffix}"))
    read: dict[str, tuple[np.ndarray, Intrinsics]] = {}
    for quat, t, camera_id, name in images(model / f"images{suffix}"):
        if name in read:
            raise ValueError(f"the picture {name} is listed twice")
        if camera_id not in known:
            raise ValueError(f"the picture {name} has camera {camera_id}, which is not listed")
        read[name] = _world_to_camera(quat, t), known[camera_id]
    return read


def _splits(path: Path) -> Callable[[str], str | None]:
    """Return the function from a picture's name to its split, which a list of test pictures gives."""
    if not path.is_file():
        return lambda name: None
    held_out = {line.strip() for line in path.read_text().splitlines()}
    return lambda name: "test" if name in held_out else "train"


def _cameras_txt(path: Path) -> Iterator[tuple[int, Intrinsics]]:
    for line in path.read_text().splitlines():
        if line.strip() and not line.startswith("#"):
            camera_id, model, width, height, *values = line.split()
            yield int(camera_id), _intrinsics(model, int(width), int(height), list(map(float, values)))


def _images_txt(path: Path) -> Iterator[tuple[np.ndarray, np.ndarray, int, str]]:
    """Return the pictures of images.txt: each has a line, and one of its points after it, which may be empty.

    Files of tools that write no lines of points, or more empty lines than COLMAP, are understood: a picture's line is
    known by its numbers, of which COLMAP's points have a multiple of three.
    """
    points_may_follow = False
    for number, line in enumerate(path.read_text().splitlines(), start=1):
        if line.startswith("#"):
            continue
        if not line.strip() or (points_may_follow and _are_points(line)):
            points_may_follow = False
        else:
            parts = line.split(maxsplit=9)
            if len(parts) != 10:
                raise ValueError(
                    f"{path.name}, line {number}: expected a picture (number, quaternion, translation, camera, name), "
                    f"got {line[:80]!r}"
                )
            _, *numbers, camera_id, name = parts
            values = np.array(numbers, dtype=np.float64)
            yield values[:4], values[4:], int(camera_id), name.strip()
            points_may_follow = True


def _are_points(line: str) -> bool:
    """Return whether a line lists points (x, y and a whole number, again and again) and no picture."""
    parts = line.split()
    try:
        np.array(parts, dtype=np.float64)
        return len(parts) % 3 == 0 and all(int(part) >= -1 for part in parts[2::3])
    except (ValueError, OverflowError):
        return False


def _cameras_bin(path: Path) -> Iterator[tuple[int, Intrinsics]]:
    content, at = path.read_bytes(), 8
    for _ in range(struct.unpack_from("<Q", content)[0]):
        camera_id, number, width, height = struct.unpack_from("<iiQQ", content, at)
        model, names = MODELS.get(number, (f"number {number}", ()))
        values = struct.unpack_from(f"<{len(names)}d", content, at + 24)
        at += 24 + 8 * len(names)
        yield camera_id, _intrinsics(model, width, height, list(values))


def _images_bin(path: Path) -> Iterator[tuple[np.ndarray, np.ndarray, int, str]]:
    content, at = path.read_bytes(), 8
    for _ in range(struct.unpack_from("<Q", content)[0]):
        _, *numbers, camera_id = struct.unpack_from("<i7di", content, at)
        end = content.index(b"\0", at + 64)
        name = content[at + 64 : end].decode()
        (points,) = struct.unpack_from("<Q", content, end + 1)
        at = end + 9 + 24 * points
        values = np.array(numbers)
        yield values[:4], values[4:], camera_id, name


def _intrinsics(model: str, width: int, height: int, values: list[float]) -> Intrinsics:
    if model not in PARAMETERS:
        raise ValueError(
            f"expected a camera model of {', '.join(PARAMETERS)}, got {model}; undistort the pictures first, as with "
            "`colmap image_undistorter`"
        )
    given = dict(zip(PARAMETERS[model], values, strict=True))
    focal_px = given.get("f", 0.0)
    distortion = tuple(given.get(name, 0.0) for name in ("k1", "k2", "p1", "p2", "k3"))
    fx_px, fy_px = given.get("fx", focal_px), given.get("fy", focal_px)
    return Intrinsics(width, height, fx_px, fy_px, given["cx"], given["cy"], distortion)


def _world_to_camera(quat_world_to_camera: np.ndarray, translation: np.ndarray) -> np.ndarray:
    length = np.linalg.norm(quat_world_to_camera)
    if not (0.9 < length < 1.1 and np.isfinite(translation).all()):
        raise ValueError(
            f"expected a unit quaternion and a finite translation, got {quat_world_to_camera.tolist()} and "
            f"{translation.tolist()}"
        )
    matrix = np.eye(4)
    matrix[:3, :3] = quat_to_matrix(quat_world_to_camera / length)
    matrix[:3, 3] = translation
    return matrix
