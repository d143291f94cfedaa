"""Turns pictures with known cameras, from other tools and data sets, into a session."""

import dataclasses
import hashlib
import json
import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from enum import StrEnum
from pathlib import Path

import imagecodecs
import numpy as np

from flightsw.icd.frame import Frame, PoseTag
from flightsw.icd.mission import CameraSection
from flightsw.icd.quaternion import matrix_to_quat
from ground.formats.pictures.files import FormatError, decode, image_size
from ground.formats.pictures.judgement import Judgement, judge
from ground.formats.pictures.lens import Intrinsics, pinhole_of, undistort
from ground.formats.pictures.view import FULL_SCALE, View, colours_of, grey_light, read_image, read_mask
from ground.session.folder import ENCODINGS, SCHEMA_VERSION, SessionError
from ground.session.writer import frame_line
from obbgs_base.files import write_whole
from obbgs_base.srgb import from_srgb

log = logging.getLogger(__name__)
# Other data sets do not state their noise: a small one is assumed, the same in every pixel.
FOREIGN_READ_NOISE = 2 / 255  # of full scale
FOREIGN_ELECTRONS_PER_DN = 1e3
FRAME_SPACING_NS = 1_000_000_000  # between pictures without a time
EQUAL_EXPOSURES = 0.01  # times that differ by less are one


@dataclass(frozen=True)
class PoseSigmas:
    """Standard deviations of imported poses, the same about every axis and for every picture."""

    rotation_rad: float
    position_m: float

    def __post_init__(self):
        if not all(0 <= value < math.inf for value in (self.rotation_rad, self.position_m)):
            raise ValueError(f"expected deviations of at least 0, got {self}")

    @property
    def covariance(self) -> np.ndarray:
        """The covariance [6, 6] of a pose, as in a session's frames."""
        return np.diag(np.repeat([self.position_m**2, self.rotation_rad**2], 3))


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


def check_is_new(folder: Path) -> None:
    """Check that a session can be made in a folder.

    Raises:
        SessionError: it holds one already.
    """
    if (folder / "session.json").exists():
        raise SessionError(f"{folder} holds a session already; choose a new folder")


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
    transparent_on_white: bool = False,
) -> int:
    """Write a new session from pictures and return the number of its frames.

    Lens distortion is removed, and what is transparent or outside a mask is put on the background. Pixels that the lens
    has not seen do not get into the session: focal lengths grow until there are none (`pinhole_of`). Radiance 1 is full
    scale at the longest exposure, unless the pictures bring their calibration along. What the pictures are is judged on
    all of them (`judge`).

    Args:
        source: what the session was made from; its digest takes the place of the mission file's.
        values: what the pixel values stand for; None: what the export says, otherwise display values where the
            pictures have colours of 8 bits, and linear ones where they have not.
        white_background: whether what is seen where the target is not has full scale at the longest exposure, or is
            black; None: as the export says, otherwise black, or white as `transparent_on_white` says.
        exported: what our own export says of the pictures; their 8 bits span its camera's range from black level to
            full scale.
        sigmas: how far the poses can err; the training corrects what is not exact. If exact, what the views say counts.
        registration: what structure from motion says of the pictures, for the session to keep.
        origin_moved: [3] where in the data set's axes the session has its origin; None: in the same place.
        transparent_on_white: whether transparent pictures, which no export of ours describes, are put on white.

    Raises:
        FormatError: there are no views, their sizes differ, a picture cannot be read or has another size, or a lens
            folds back.
        SessionError: the folder holds a session already.
    """
    if not views:
        raise FormatError(f"{source}: no pictures found")
    check_is_new(folder)
    views = _with_pinholes(views)
    judged = judge(views)
    if transparent_on_white and judged.transparent and white_background is None and exported is None:
        white_background = True
    target = _target(views, judged, values, white_background, exported)
    camera = target.camera
    if judged.bright_borders > len(views) / 2 and not target.background:
        log.warning(
            "the borders of %d of %d pictures are bright (%.0f %% of full scale) where the background counts as black: "
            "give --background white if it is white, --masks screen if it is of one other colour, or --masks FOLDER if "
            "other things are in the pictures",
            *(judged.bright_borders, len(views), 100 * judged.border),
        )
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
        if view.target_position_m is not None:
            line["target_position_m"] = view.target_position_m.tolist()
        if (K := pinhole_of(view.intrinsics).K) != camera.K:
            line["K"] = K
        lines.append(json.dumps(line, allow_nan=False))
        on_view()
    write_whole(folder / "frames.jsonl", ("\n".join(lines) + "\n").encode())
    header = _header(target, source, len(views), registration, origin_moved)
    if not all(view.attitude_known for view in views):
        header["navigation"] = {"attitude": "unknown"}
    write_whole(folder / "session.json", json.dumps(header, indent=2).encode() + b"\n")
    return len(views)


@dataclass(frozen=True)
class _Target:
    """What the digital numbers of a session stand for."""

    camera: CameraSection
    background: float  # radiance
    encoding: str
    decode: bool  # whether the sRGB curve of the pictures is undone
    full_scale: dict[str, float]  # value of full scale, by the pictures' type of numbers


def _header(
    target: "_Target",
    source: str,
    count: int,
    registration: dict | None,
    origin_moved: np.ndarray | None,
) -> dict:
    """Return what session.json holds; the arguments are those of `write_session`."""
    camera = target.camera
    return {
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
        "frames_received": count,
        "bytes_received": 0,
        "created_utc": datetime.now(UTC).isoformat(timespec="seconds"),
    }


def _with_pinholes(views: Sequence[View]) -> list[View]:
    """Return the views, having checked their sizes and lenses; what a lens makes of the pictures is logged."""
    first, zoomed = views[0].intrinsics, {}
    for view in views:
        lens = view.intrinsics
        if (lens.width, lens.height) != (first.width, first.height):
            raise FormatError(
                f"{view.image}: the pictures of a session have one size, but this one is {lens.width}x{lens.height} "
                f"and the first is {first.width}x{first.height}; make them equal, or import them as two sessions"
            )
        try:
            zoomed[lens] = pinhole_of(lens).fx_px / lens.fx_px
        except ValueError as error:
            raise FormatError(
                f"{view.image}: {error}; undistort the pictures first, as with `colmap image_undistorter`"
            ) from error
    if (largest := max(zoomed.values())) > 1.0:
        log.warning(
            "the lens's distortion leaves a border that it has not seen, or folds back: pictures are cropped to what "
            "it saw, by focal lengths that are up to %.4g times longer",
            largest,
        )
    return list(views)


def _target(
    views: Sequence[View],
    judged: Judgement,
    values: Values | None,
    white_background: bool | None,
    exported: Exported | None,
) -> _Target:
    """Return what the session will hold; the arguments are those of `write_session`."""
    times_s = [view.exposure_time_s for view in views]
    longest_s, differ = max(times_s), max(times_s) > (1 + EQUAL_EXPOSURES) * min(times_s)
    if values is None and exported is None:
        values = Values.DISPLAY if judged.display else Values.LINEAR
        if judged.display and differ:
            values = Values.DECODE
            log.warning(
                "the pictures hold display values, and their exposure times differ (%.4g to %.4g ms): they are made "
                "linear, as with --values decode, so that light is proportional to time",
                *(1e3 * min(times_s), 1e3 * longest_s),
            )
    elif values is Values.DISPLAY and differ:
        log.warning(
            "display values are not proportional to light, but exposure times differ: --values decode makes them linear"
        )
    decode = values is Values.DECODE
    encoding = "srgb" if values is Values.DISPLAY else "linear"
    full_scale = judged.full_scale
    if exported is not None:
        camera, background = exported.camera, exported.background
        encoding = exported.encoding if values is None else encoding
        full_scale = {name: FULL_SCALE[name] for name in full_scale}
    else:
        bit_depth = 16 if decode else judged.bit_depth
        camera = _foreign_camera(pinhole_of(views[0].intrinsics), judged.channels, bit_depth, longest_s)
        background = 0.0
    if white_background is not None:
        white = (camera.white_dn - camera.black_dn) / (camera.dn_per_radiance_s * longest_s)
        background = white if white_background else 0.0
    return _Target(camera, background, encoding, decode, full_scale)


def unposed(image: Path) -> View:
    """Return a picture by itself, with a camera that stands for one that is not known yet.

    Raises:
        FormatError: it cannot be read.
    """
    width, height = image_size(image)
    lens = Intrinsics(width, height, float(width), float(width), width / 2, height / 2)
    return View(image, np.eye(4), lens)


def first_of_each_split(views: Sequence[View], count: int | None) -> list[View]:
    """Return the first `count` views of each split, or of all where no split is stated; None: all views."""
    taken: dict[str | None, int] = {}
    chosen = []
    for view in views:
        taken[view.split] = taken.get(view.split, 0) + 1
        if count is None or taken[view.split] <= count:
            chosen.append(view)
    return chosen


def read_grey(view: View) -> np.ndarray:
    """Return the mean colour [H, W] of a view's picture, 0..1, on black where it is transparent or outside its mask.

    Raises:
        FormatError: it cannot be read, or has another size than its camera.
    """
    image = read_image(view)
    grey = grey_light(image, coded=False)
    if image.shape[2] > colours_of(image):
        grey = grey * (image[..., -1] / FULL_SCALE[image.dtype.name])
    return grey if view.mask is None else grey * read_mask(view)


def _digital_numbers(view: View, target: _Target) -> np.ndarray:
    """Return a picture as digital numbers [H, W] or [H, W, 3] of the session's camera."""
    if view.readings is not None and not target.decode:
        return _readings(view, view.readings, target)
    image, camera = read_image(view), target.camera
    colours = colours_of(image)
    value = np.clip(image[..., :colours] / target.full_scale[image.dtype.name], 0, 1)
    if target.decode:
        value = from_srgb(value)
    empty_dn = target.background * camera.dn_per_radiance_s * view.exposure_time_s
    empty = min(1.0, empty_dn / (camera.white_dn - camera.black_dn))
    alpha = None
    if image.shape[2] > colours:
        alpha = np.clip(image[..., colours:] / FULL_SCALE[image.dtype.name], 0, 1)
    if view.mask is not None:
        mask = read_mask(view)[..., None]
        alpha = mask if alpha is None else mask * alpha
    if alpha is not None:
        value = value * alpha + (1 - alpha) * empty
    if colours > camera.channels:  # pictures of a mono camera, exported with three equal colours
        value = value.mean(axis=2, keepdims=True)
    elif colours < camera.channels:  # grey ones among coloured
        value = np.repeat(value, camera.channels, axis=2)
    value = undistort(value, view.intrinsics, empty, pinhole_of(view.intrinsics))
    dn = np.rint(camera.black_dn + value * (camera.white_dn - camera.black_dn)).astype(np.uint16)
    return np.ascontiguousarray(dn[..., 0] if camera.channels == 1 else dn)


def _readings(view: View, path: Path, target: _Target) -> np.ndarray:
    """Return the digital numbers that our own export keeps of a picture, the background where a mask leaves it out."""
    dn, camera = decode(path), target.camera
    expected = (camera.height, camera.width, camera.channels)
    if dn.shape != expected or dn.dtype != np.uint16 or dn.max() > camera.white_dn:
        raise FormatError(
            f"{path}: expected readings of 16 bits {expected}, at most {camera.white_dn:g}, got {dn.dtype} {dn.shape}; "
            "export again"
        )
    if view.mask is not None:
        mask = read_mask(view)[..., None]
        empty_dn = camera.black_dn + target.background * camera.dn_per_radiance_s * view.exposure_time_s
        dn = np.rint(dn * mask + min(empty_dn, camera.white_dn) * (1 - mask)).astype(np.uint16)
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
    pose = PoseTag(
        quat_body_to_camera=matrix_to_quat(w2c[:3, :3]),
        position_body_m=-w2c[:3, :3].T @ w2c[:3, 3],
        covariance=view.covariance if sigmas == EXACT and view.covariance is not None else sigmas.covariance,
        sun_dir_body=view.sun_dir_body,
        in_eclipse=view.in_eclipse,
        valid=True,
        source="none",
        attitude="known" if view.attitude_known else "unknown",
        quat_inertial_to_body=view.quat_inertial_to_body,
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
