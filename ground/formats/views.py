"""Turns pictures with known cameras, from other tools and data sets, into a session."""

import dataclasses
import hashlib
import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from enum import StrEnum
from pathlib import Path

import imagecodecs
import numpy as np
from scipy.ndimage import map_coordinates

from flightsw.icd.frame import Frame, PoseTag
from flightsw.icd.mission import CameraSection
from flightsw.icd.quaternion import matrix_to_quat
from ground.formats.srgb import from_srgb
from ground.session import ENCODINGS, SCHEMA_VERSION, SessionError
from ground.session_writer import frame_line
from obbgs_base.files import write_whole

# Other data sets do not state their noise: a small one is assumed, the same in every pixel.
FOREIGN_READ_NOISE = 2 / 255  # of full scale
FOREIGN_ELECTRONS_PER_DN = 1e3
FRAME_SPACING_NS = 1_000_000_000  # between pictures without a time


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

    def __post_init__(self):
        numbers = (*(value for row in self.K for value in row), *self.distortion)
        if not (all(map(math.isfinite, numbers)) and self.fx_px > 0 and self.fy_px > 0):
            raise ValueError(f"expected finite intrinsics with positive focal lengths, got {self}")

    @property
    def K(self) -> list[list[float]]:
        """The 3x3 pinhole matrix, px."""
        return [[self.fx_px, 0.0, self.cx_px], [0.0, self.fy_px, self.cy_px], [0.0, 0.0, 1.0]]


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
    covariance: np.ndarray | None = None  # [6, 6] of the pose, as in a session's frames; None: not stated
    split: str | None = None  # train, val or test; stated for all views or for none


@dataclass(frozen=True)
class PoseSigmas:
    """Standard deviations of imported poses, the same about every axis and for every picture."""

    rotation_rad: float
    position_m: float

    def __post_init__(self):
        if not all(0 <= value < math.inf for value in (self.rotation_rad, self.position_m)):
            raise ValueError(f"expected deviations of at least 0, got {self}")


EXACT = PoseSigmas(0.0, 0.0)


class Values(StrEnum):
    """What the values of imported pictures stand for, and whether a session keeps them."""

    LINEAR = "linear"  # light
    DISPLAY = "display"  # sRGB-coded values for a display, which are kept
    DECODE = "decode"  # the same, which are made linear


@dataclass(frozen=True)
class Exported:
    """What our own export says of its pictures beside their cameras; the fields are those of `Session`."""

    camera: CameraSection
    background: float
    encoding: str

    def __post_init__(self):
        if type(self.background) not in (int, float) or not 0 <= self.background < math.inf:
            raise ValueError(f"background must be a radiance of at least 0, got {self.background!r}")
        if self.encoding not in ENCODINGS:
            raise ValueError(f"encoding must be one of {', '.join(ENCODINGS)}, got {self.encoding!r}")


def write_session(
    views: Sequence[View],
    folder: Path,
    source: str,
    values: Values | None = None,
    white_background: bool | None = None,
    exported: Exported | None = None,
    on_view: Callable[[], None] = lambda: None,
    sigmas: PoseSigmas = EXACT,
    registration: dict | None = None,
    origin_moved: np.ndarray | None = None,
) -> int:
    """Write a new session from pictures and return the number of its frames.

    Lens distortion is removed, and transparent pictures are put on the background. Radiance 1 is full scale at the
    longest exposure, unless the pictures bring their calibration along.

    Args:
        source: what the session was made from; its digest takes the place of the mission file's.
        values: what the pixel values stand for; None: what the export says, otherwise display values where the
            pictures have colours of 8 bits, and linear ones where they have not.
        white_background: whether what is seen where the target is not has full scale at the longest exposure, or is
            black; None: as the export says, otherwise black.
        exported: what our own export says of the pictures; their 8 bits span its camera's range from black level to
            full scale.
        sigmas: how far the poses can err; the training corrects what is not exact. If exact, what the views say counts.
        registration: what structure from motion says of the pictures, for the session to keep.
        origin_moved: [3] where in the data set's axes the session has its origin; None: in the same place.

    Raises:
        FormatError: there are no views, their sizes differ, or a picture cannot be read or has another size.
        SessionError: the folder holds a session already.
    """
    if not views:
        raise FormatError(f"{source}: no pictures found")
    if (folder / "session.json").exists():
        raise SessionError(f"{folder} holds a session already; choose a new folder")
    target = _target(views, values, white_background, exported)
    camera = target.camera
    (folder / "frames").mkdir(parents=True, exist_ok=True)
    lines = []
    for number, view in enumerate(views):
        name = f"frames/{number:06d}.png"
        dn = _digital_numbers(view, target)
        write_whole(folder / name, bytes(imagecodecs.png_encode(dn, level=1)))
        sha256 = hashlib.sha256(view.image.read_bytes()).hexdigest()
        line = frame_line(_frame(view, number, dn, camera, sigmas), name, sha256)
        if view.split is not None:
            line["split"] = view.split
        if view.intrinsics.K != camera.K:
            line["K"] = view.intrinsics.K
        lines.append(json.dumps(line, allow_nan=False))
        on_view()
    write_whole(folder / "frames.jsonl", ("\n".join(lines) + "\n").encode())
    header = {
        "schema_version": SCHEMA_VERSION,
        "mission_sha256": hashlib.sha256(source.encode()).hexdigest(),
        "imported_from": source,
        "camera": dataclasses.asdict(camera),
        "background": target.background,
        "encoding": target.encoding,
        **({} if registration is None else {"registration": registration}),
        **({} if origin_moved is None else {"origin_moved": origin_moved.tolist()}),
        "tles": {},
        "losses": {},
        "frames_received": len(views),
        "bytes_received": 0,
        "created_utc": datetime.now(UTC).isoformat(timespec="seconds"),
    }
    write_whole(folder / "session.json", json.dumps(header, indent=2).encode() + b"\n")
    return len(views)


@dataclass(frozen=True)
class _Target:
    """What the digital numbers of a session stand for."""

    camera: CameraSection
    background: float  # radiance
    encoding: str
    decode: bool  # whether the sRGB curve of the pictures is undone


def _target(
    views: Sequence[View], values: Values | None, white_background: bool | None, exported: Exported | None
) -> _Target:
    """Return what the session will hold; the arguments are those of `write_session`."""
    first = views[0].intrinsics
    for view in views:
        size = (view.intrinsics.width, view.intrinsics.height)
        if size != (first.width, first.height):
            raise FormatError(
                f"{view.image}: the pictures of a session have one size, but this one is {size[0]}x{size[1]} and the "
                f"first is {first.width}x{first.height}; make them equal, or import them as two sessions"
            )
    image = _read_image(views[0].image, first)
    if values is None and exported is None:
        coloured = _channels(image) == 3 and image.dtype == np.uint8
        values = Values.DISPLAY if coloured else Values.LINEAR
    decode = values is Values.DECODE
    encoding = "srgb" if values is Values.DISPLAY else "linear"
    longest_s = max(view.exposure_time_s for view in views)
    if exported is not None:
        camera, background = exported.camera, exported.background
        encoding = exported.encoding if values is None else encoding
    else:
        bit_depth = 16 if decode or image.dtype == np.uint16 else 8
        camera, background = _foreign_camera(first, _channels(image), bit_depth, longest_s), 0.0
    if white_background is not None:
        full_scale = (camera.white_dn - camera.black_dn) / (camera.dn_per_radiance_s * longest_s)
        background = full_scale if white_background else 0.0
    return _Target(camera, background, encoding, decode)


def first_of_each_split(views: Sequence[View], count: int | None) -> list[View]:
    """Return the first `count` views of each split, or of all where no split is stated; None: all views."""
    taken: dict[str | None, int] = {}
    chosen = []
    for view in views:
        taken[view.split] = taken.get(view.split, 0) + 1
        if count is None or taken[view.split] <= count:
            chosen.append(view)
    return chosen


def is_transparent(path: Path) -> bool:
    """Return whether a picture has pixels that are not opaque.

    Raises:
        FormatError: it cannot be read.
    """
    image = _decode(path)
    return image.shape[2] in (2, 4) and bool((image[..., -1] < np.iinfo(image.dtype).max).any())


def undistort(image: np.ndarray, intrinsics: Intrinsics, empty: float = 0.0) -> np.ndarray:
    """Return the picture [H, W, C] that a pinhole camera with the same K would take; `empty` outside the original.

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
        map_coordinates(image[..., c].astype(np.float64), source, order=1, cval=empty)
        for c in range(image.shape[2])
    ]
    return np.stack(channels, axis=2)


def image_size(path: Path) -> tuple[int, int]:
    """Return width and height of a picture.

    Raises:
        FormatError: it cannot be read.
    """
    height, width = _decode(path).shape[:2]
    return width, height


def read_grey(view: View) -> np.ndarray:
    """Return the mean colour [H, W] of a view's picture, 0..1, on black where it is transparent.

    Raises:
        FormatError: it cannot be read, or has another size than its camera.
    """
    image = _read_image(view.image, view.intrinsics)
    image = image / float(np.iinfo(image.dtype).max)
    colours = _channels(image)
    grey = image[..., :colours].mean(axis=2)
    return grey * image[..., -1] if image.shape[2] > colours else grey


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


def _digital_numbers(view: View, target: _Target) -> np.ndarray:
    """Return a picture as digital numbers [H, W] or [H, W, 3] of the session's camera."""
    image, camera = _read_image(view.image, view.intrinsics), target.camera
    colours = _channels(image)
    if colours < camera.channels:
        raise FormatError(f"{view.image}: expected {camera.channels} colours a pixel, got {colours}")
    full = float(np.iinfo(image.dtype).max)
    value = image[..., :colours] / full
    if target.decode:
        value = from_srgb(value)
    empty_dn = target.background * camera.dn_per_radiance_s * view.exposure_time_s
    empty = min(1.0, empty_dn / (camera.white_dn - camera.black_dn))
    if image.shape[2] > colours:
        alpha = image[..., colours:] / full
        value = value * alpha + (1 - alpha) * empty
    if colours > camera.channels:  # pictures of a mono camera, exported with three equal colours
        value = value.mean(axis=2, keepdims=True)
    value = undistort(value, view.intrinsics, empty)
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


def _frame(view: View, number: int, dn: np.ndarray, camera: CameraSection, sigmas: PoseSigmas) -> Frame:
    w2c = view.world_to_camera
    same_for_all = np.diag(np.repeat([sigmas.position_m**2, sigmas.rotation_rad**2], 3))
    pose = PoseTag(
        quat_body_to_camera=matrix_to_quat(w2c[:3, :3]),
        position_body_m=-w2c[:3, :3].T @ w2c[:3, 3],
        covariance=view.covariance if sigmas == EXACT and view.covariance is not None else same_for_all,
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
