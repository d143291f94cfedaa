"""COLMAP models: cameras and images as text or binary; poses are world to camera in OpenCV axes, like ours.

Source: colmap.github.io/format.html.
"""

import struct
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from flightsw.icd.quaternion import quat_to_matrix
from ground.formats.views import FormatError, Intrinsics, View

# Model number in binary files: its name and the names of its parameters (f is both focal lengths).
MODELS = {
    0: ("SIMPLE_PINHOLE", ("f", "cx", "cy")),
    1: ("PINHOLE", ("fx", "fy", "cx", "cy")),
    2: ("SIMPLE_RADIAL", ("f", "cx", "cy", "k1")),
    3: ("RADIAL", ("f", "cx", "cy", "k1", "k2")),
    4: ("OPENCV", ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")),
}
PARAMETERS = dict(MODELS.values())
PLACES = ("", "sparse/0", "sparse")  # where the model may lie in the folder


def read_colmap(folder: Path) -> list[View]:
    """Return the registered pictures of a COLMAP model, in the order of their names.

    A file test.txt beside the model, with the names of the test pictures, states the splits, as for 3DGS.

    Args:
        folder: holds images/, and the model itself or in sparse/0 or sparse/; binary files are preferred to text.

    Raises:
        FormatError: there is no model, it is damaged, or it has a camera model that is not in `MODELS`.
    """
    for place in PLACES:
        model = folder / place
        for suffix, cameras, images in (
            (".bin", _cameras_bin, _images_bin),
            (".txt", _cameras_txt, _images_txt),
        ):
            if (model / f"cameras{suffix}").is_file() and (model / f"images{suffix}").is_file():
                try:
                    known = dict(cameras(model / f"cameras{suffix}"))
                    split_of = _splits(model / "test.txt")
                    views = [
                        View(
                            folder / "images" / name,
                            _world_to_camera(quat, t),
                            known[camera_id],
                            split=split_of(name),
                        )
                        for quat, t, camera_id, name in images(model / f"images{suffix}")
                    ]
                except (ValueError, IndexError, KeyError, struct.error, OSError) as error:
                    raise FormatError(f"{model}: damaged or not a COLMAP model: {error}") from error
                return sorted(views, key=lambda view: view.image.name)
    raise FormatError(f"{folder}: no cameras and images files (.bin or .txt), nor in sparse/0")


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
    lines = [line for line in path.read_text().splitlines() if not line.startswith("#")]
    for line in lines[::2]:  # every second line lists the picture's points, and may be empty
        if line.strip():
            _, *numbers, camera_id, name = line.split(maxsplit=9)
            values = np.array(numbers, dtype=np.float64)
            yield values[:4], values[4:], int(camera_id), name


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
        raise ValueError(f"expected a camera model of {', '.join(PARAMETERS)}, got {model}")
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
