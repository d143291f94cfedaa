"""Turns pictures with known cameras, from other tools and data sets, into a session."""

import dataclasses
import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path

import imagecodecs
import numpy as np
from scipy.ndimage import map_coordinates

from flightsw.icd.frame import Frame, PoseTag
from flightsw.icd.mission import CameraSection
from flightsw.icd.quaternion import matrix_to_quat
from ground.session import SCHEMA_VERSION, SessionError
from ground.session_writer import frame_line
from obbgs_base.files import write_whole

# Other data sets do not state their noise: a small one is assumed, the same in every pixel.
FOREIGN_READ_NOISE = 2 / 255  # of full scale
FOREIGN_ELECTRONS_PER_DN = 1e3
FRAME_SPACING_NS = 1_000_000_000  # between pictures without a time
# x right, y up, z backwards (OpenGL, Blender) to x right, y down, z forward (OpenCV), and back
FLIP_YZ = np.diag([1.0, -1.0, -1.0, 1.0])


class FormatError(SessionError):
    """A folder is not in the expected format; the message names the file."""


@dataclass(frozen=True)
class Intrinsics:
    """A pinhole camera with OpenCV's lens distortion, px, pixel centres at +0.5."""

    width: int
    height: int
    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
    distortion: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0, 0.0)  # k1, k2, p1, p2, k3


@dataclass(frozen=True, eq=False)
class View:
    """One picture to import; what its format does not state has the default value."""

    image: Path
    world_to_camera: np.ndarray  # [4, 4], OpenCV axes
    intrinsics: Intrinsics
    exposure_time_s: float = 1.0
    mid_exposure_utc_ns: int | None = None
    bracket: int | None = None
    bracket_index: int = 0
    sun_dir_body: np.ndarray = field(default_factory=lambda: np.zeros(3))  # unit; zero where unknown
    in_eclipse: bool = False


def write_session(
    views: Sequence[View],
    folder: Path,
    source: str,
    srgb: bool = False,
    camera: CameraSection | None = None,
    on_view: Callable[[], None] = lambda: None,
) -> int:
    """Write a new session from pictures and return the number of its frames.

    Lens distortion is removed, and transparent pictures are put on black. Radiance 1 is full scale at the longest
    exposure, unless `camera` gives the calibration that the pictures were exported with.

    Args:
        source: what the session was made from; its digest takes the place of the mission file's.
        srgb: undo the sRGB curve; otherwise pixel values are taken as linear.
        camera: the original calibration; the pictures' 8 bits span its range from black level to full scale.

    Raises:
        FormatError: there are no views, their cameras differ, or a picture cannot be read or has another size.
        SessionError: the folder holds a session already.
    """
    if not views:
        raise FormatError(f"{source}: no pictures found")
    if (folder / "session.json").exists():
        raise SessionError(f"{folder} holds a session already; choose a new folder")
    intrinsics = views[0].intrinsics
    for view in views:
        if view.intrinsics != intrinsics:
            raise FormatError(
                f"{view.image}: a session has one camera, but this picture's {view.intrinsics} is not the first's "
                f"{intrinsics}"
            )
    first = _read_image(views[0].image, intrinsics)
    if camera is None:
        bit_depth = 16 if srgb or first.dtype == np.uint16 else 8
        camera = _foreign_camera(
            intrinsics, _channels(first), bit_depth, max(v.exposure_time_s for v in views)
        )
    (folder / "frames").mkdir(parents=True, exist_ok=True)
    lines = []
    for number, view in enumerate(views):
        image = _read_image(view.image, intrinsics)
        if _channels(image) < camera.channels:
            raise FormatError(
                f"{view.image}: expected {camera.channels} colours a pixel, got {_channels(image)}"
            )
        dn = _digital_numbers(image, intrinsics, camera, srgb)
        name = f"frames/{number:06d}.png"
        write_whole(folder / name, bytes(imagecodecs.png_encode(dn, level=1)))
        frame = _frame(view, number, dn, camera)
        sha256 = hashlib.sha256(view.image.read_bytes()).hexdigest()
        lines.append(json.dumps(frame_line(frame, name, sha256), allow_nan=False))
        on_view()
    write_whole(folder / "frames.jsonl", ("\n".join(lines) + "\n").encode())
    header = {
        "schema_version": SCHEMA_VERSION,
        "mission_sha256": hashlib.sha256(source.encode()).hexdigest(),
        "imported_from": source,
        "camera": dataclasses.asdict(camera),
        "tles": {},
        "losses": {},
        "frames_received": len(views),
        "bytes_received": 0,
        "created_utc": datetime.now(UTC).isoformat(timespec="seconds"),
    }
    write_whole(folder / "session.json", json.dumps(header, indent=2).encode() + b"\n")
    return len(views)


def undistort(image: np.ndarray, intrinsics: Intrinsics) -> np.ndarray:
    """Return the picture [H, W, C] that a pinhole camera with the same K would take; black outside the original.

    Source: OpenCV's model, radial k1, k2, k3 and tangential p1, p2.
    """
    if not any(intrinsics.distortion):
        return image
    k1, k2, p1, p2, k3 = intrinsics.distortion
    height, width = image.shape[:2]
    y, x = np.mgrid[0.5:height, 0.5:width]
    x, y = (x - intrinsics.cx_px) / intrinsics.fx_px, (y - intrinsics.cy_px) / intrinsics.fy_px
    r2 = x**2 + y**2
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    bent_x = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x**2)
    bent_y = y * radial + p1 * (r2 + 2 * y**2) + 2 * p2 * x * y
    source = np.stack(
        [
            bent_y * intrinsics.fy_px + intrinsics.cy_px - 0.5,
            bent_x * intrinsics.fx_px + intrinsics.cx_px - 0.5,
        ]
    )
    channels = [
        map_coordinates(image[..., c].astype(np.float64), source, order=1) for c in range(image.shape[2])
    ]
    return np.stack(channels, axis=2)


def opengl_to_world_to_camera(camera_to_world: object, where: str) -> np.ndarray:
    """Return world_to_camera [4, 4], OpenCV axes, of a camera-to-world matrix in OpenGL axes.

    Raises:
        FormatError: it is not a rotation with a translation.
    """
    try:
        matrix = np.array(camera_to_world, dtype=np.float64)
    except (ValueError, TypeError) as error:
        raise FormatError(f"{where}: transform_matrix is not a matrix of numbers") from error
    if matrix.shape == (3, 4):
        matrix = np.vstack([matrix, [0.0, 0.0, 0.0, 1.0]])
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        raise FormatError(
            f"{where}: transform_matrix must be 4x4 finite numbers, got shape {list(matrix.shape)}"
        )
    R = matrix[:3, :3]
    if np.abs(R @ R.T - np.eye(3)).max() > 1e-3 or np.linalg.det(R) < 0:
        raise FormatError(f"{where}: transform_matrix holds no rotation")
    return rigid_inverse(matrix @ FLIP_YZ)


def world_to_camera_to_opengl(world_to_camera: np.ndarray) -> np.ndarray:
    """Return the camera-to-world matrix [4, 4] in OpenGL axes."""
    return rigid_inverse(world_to_camera) @ FLIP_YZ


def rigid_inverse(matrix: np.ndarray) -> np.ndarray:
    """Return the inverse [4, 4] of a rotation with a translation."""
    inverse = np.eye(4)
    inverse[:3, :3] = matrix[:3, :3].T
    inverse[:3, 3] = -matrix[:3, :3].T @ matrix[:3, 3]
    return inverse


def image_size(path: Path) -> tuple[int, int]:
    """Return width and height of a picture.

    Raises:
        FormatError: it cannot be read.
    """
    height, width = _decode(path).shape[:2]
    return width, height


def _decode(path: Path) -> np.ndarray:
    try:
        image = np.asarray(imagecodecs.imread(path))
    except (OSError, ValueError, RuntimeError) as error:
        raise FormatError(f"{path}: the picture cannot be read: {error}") from error
    if image.dtype not in (np.uint8, np.uint16) or image.ndim not in (2, 3):
        raise FormatError(f"{path}: expected a picture of 8 or 16 bits, got {image.dtype} {image.shape}")
    return image.reshape(*image.shape[:2], -1)


def _read_image(path: Path, intrinsics: Intrinsics) -> np.ndarray:
    """Return a picture [H, W, 1 to 4]."""
    image = _decode(path)
    if image.shape[:2] != (intrinsics.height, intrinsics.width):
        raise FormatError(
            f"{path}: expected {intrinsics.width}x{intrinsics.height} pixels, got {image.shape[1]}x{image.shape[0]}"
        )
    return image


def _channels(image: np.ndarray) -> int:
    return 1 if image.shape[2] <= 2 else 3


def _digital_numbers(
    image: np.ndarray, intrinsics: Intrinsics, camera: CameraSection, srgb: bool
) -> np.ndarray:
    """Return a picture [H, W, 1 to 4] as digital numbers [H, W] or [H, W, 3] of a camera."""
    full = float(np.iinfo(image.dtype).max)
    colours = _channels(image)
    value = image[..., :colours] / full
    if srgb:
        value = np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)  # IEC 61966-2-1
    if image.shape[2] > colours:
        value = value * (image[..., colours:] / full)
    if colours > camera.channels:  # pictures of a mono camera, exported with three equal colours
        value = value.mean(axis=2, keepdims=True)
    value = undistort(value, intrinsics)
    dn = np.rint(camera.black_dn + value * (camera.white_dn - camera.black_dn)).astype(np.uint16)
    return np.ascontiguousarray(dn[..., 0] if camera.channels == 1 else dn)


def _foreign_camera(intrinsics: Intrinsics, channels: int, bit_depth: int, longest_s: float) -> CameraSection:
    white_dn = (1 << bit_depth) - 1
    return CameraSection(
        width=intrinsics.width,
        height=intrinsics.height,
        fx_px=intrinsics.fx_px,
        fy_px=intrinsics.fy_px,
        cx_px=intrinsics.cx_px,
        cy_px=intrinsics.cy_px,
        channels=channels,
        bit_depth=bit_depth,
        black_dn=0.0,
        dn_per_radiance_s=white_dn / longest_s,
        electrons_per_dn=FOREIGN_ELECTRONS_PER_DN,
        read_noise_dn=FOREIGN_READ_NOISE * white_dn,
        psf_sigma_px=None,  # not known: it is learnt
    )


def _frame(view: View, number: int, dn: np.ndarray, camera: CameraSection) -> Frame:
    w2c = view.world_to_camera
    pose = PoseTag(
        quat_body_to_camera=matrix_to_quat(w2c[:3, :3]),
        position_body_m=-w2c[:3, :3].T @ w2c[:3, 3],
        covariance=np.zeros((6, 6)),
        sun_dir_body=view.sun_dir_body,
        in_eclipse=view.in_eclipse,
        valid=True,
        source="none",
    )
    time_ns = view.mid_exposure_utc_ns
    return Frame(
        frame_id=number,
        bracket_id=number if view.bracket is None else view.bracket,
        bracket_index=view.bracket_index,
        bracket_count=1,
        exposure_time_s=view.exposure_time_s,
        mid_exposure_utc_ns=number * FRAME_SPACING_NS if time_ns is None else time_ns,
        pose=pose,
        dn=dn,
        bit_depth=camera.bit_depth,
        black_dn=camera.black_dn,
        saturated_count=int((dn.reshape(*dn.shape[:2], -1) >= camera.white_dn).any(axis=2).sum()),
    )
