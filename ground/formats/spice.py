"""Pictures with times beside SPICE kernels of NAIF: paths, attitudes, frames and clocks give the cameras' poses.

    spice.yaml    which kernels, which bodies and frames, and the lens (`Scene`)
    images/       the pictures, or they lie beside the files
    kernels of the names that spice.yaml gives, in that order: SPK, CK, FK, SCLK, LSK, IK, PCK

Source: the SPICE toolkit, https://naif.jpl.nasa.gov/naif/, through its Python package spiceypy.
"""

import contextlib
import dataclasses
import logging
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from flightsw.icd.config import (
    MAX_YAML_BYTES,
    build,
    in_file,
    parse_yaml,
    require,
    require_counts,
    require_unit_quaternion,
)
from flightsw.icd.quaternion import matrix_to_quat, quat_to_matrix
from ground.formats.photographs.brackets import in_brackets
from ground.formats.photographs.exposures import middle_utc_ns, unposed_pictures
from ground.formats.pictures.files import FormatError, Light, within
from ground.formats.pictures.lens import Intrinsics, StatedLens
from ground.formats.pictures.view import View
from obbgs_base.errors import in_words
from obbgs_base.files import read_bounded

SCENE = "spice.yaml"
INERTIAL = "J2000"  # within 0.03 arcseconds of GCRS
CORNERS = 4  # of a rectangular field of view
ALIKE = 0.01  # focal lengths of rows and columns that differ by more are of pictures of another shape
LIGHT_TIMES = 3  # each is nearer by the speed of the body over that of light
SPANS_NAMED = 12  # in a message
log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class Scene(StatedLens):
    """What a folder's kernels are asked for. Bodies and frames are names, or numbers as text, that the kernels know.

    kernels: their files, loaded in this order; where two cover a time, the later one counts.
    spacecraft: at whose place the camera is; an SPK gives its path.
    body: the target. body_frame: axes fixed to it; null: its attitude is not known, and `ground reconstruct` finds it.
    camera_frame: axes fixed to the camera; null: those that the instrument's IK names.
    instrument: whose field of view an IK gives, which makes the lens; not needed with fx_px.
    quat_frame_to_camera: from the camera frame to x right, y down, z forwards in the picture, scalar first.
    """

    kernels: tuple[str, ...]
    spacecraft: str
    body: str
    body_frame: str | None = None
    camera_frame: str | None = None
    instrument: str | None = None
    quat_frame_to_camera: tuple[float, ...] = (1.0, 0.0, 0.0, 0.0)
    fx_px: float | None = None

    def __post_init__(self):
        require(bool(self.kernels), "spice.kernels", "expected the names of kernels, got none")
        self.check(self.fx_px, "spice")
        require_counts(self, "spice", quat_frame_to_camera=4)
        require_unit_quaternion(self.quat_frame_to_camera, "spice.quat_frame_to_camera")
        told = self.instrument is not None
        require(
            told or self.camera_frame is not None,
            "spice.camera_frame",
            "expected the camera's frame, or an instrument",
        )
        require(
            told or self.fx_px is not None,
            "spice.fx_px",
            "expected the focal length, or an instrument with an IK",
        )


def read_spice(folder: Path, table: dict[str, Light] | None = None) -> list[View]:
    """Return the pictures of a folder with the poses that its kernels give at their times, in the order of time.

    The body is seen as it was when the light left it: in the place relative to the spacecraft, and turned, as then.
    This is SPICE's LT+S, light time with stellar aberration, to the first order in the speeds over that of light, and
    needs no path about the solar system's centre; the distance is that in the spacecraft's own frame of reference.

    Args:
        table: what is known of the pictures' exposures and times beside what they say themselves.

    Raises:
        FormatError: a file is missing or is no kernel, a picture states no time, or the kernels do not cover it or do
            not know a name.
        ConfigError: spice.yaml is not valid.
    """
    try:
        content = read_bounded(folder / SCENE, MAX_YAML_BYTES)
    except OSError as error:
        raise FormatError(
            f"{in_words(error)}; expected {SCENE}, which names the kernels, the spacecraft, the "
            "body and their frames"
        ) from error
    with in_file(folder / SCENE):
        scene = build(Scene, parse_yaml(content, "spice"), "spice")
    views = unposed_pictures(folder, table)
    paths = [within(folder, name, folder / SCENE) for name in scene.kernels]
    with _loaded(paths):
        for body in (scene.spacecraft, scene.body):
            _check_body(body, folder / SCENE)
        camera_frame, corners = _camera(scene, folder / SCENE)
        for frame in (camera_frame, scene.body_frame or INERTIAL):
            _check_frame(frame, folder / SCENE)
        posed = []
        for view in views:
            utc_ns = middle_utc_ns(view.image, scene.times, (table or {}).get(view.image.name))
            posed.append(_posed(view, utc_ns, scene, camera_frame, corners, paths))
    if posed and not any(view.sun_dir_body.any() for view in posed):
        log.warning(
            "no kernel says where the Sun is from %s: shadows are not modelled; add an SPK of the planets, such as "
            "de440s.bsp",
            scene.body,
        )
    return in_brackets(posed)


def _posed(
    view: View, utc_ns: int, scene: Scene, camera_frame: str, corners: np.ndarray | None, paths: list[Path]
) -> View:
    import spiceypy

    utc = _text(utc_ns)
    fixed = scene.body_frame or INERTIAL
    with _asked(view.image, utc, "how UTC differs from TDB, as a leap seconds kernel (naif0012.tls) does"):
        et = spiceypy.utc2et(utc)
    left, place_km = et, np.zeros(3)
    with _asked(
        view.image, utc, f"where {scene.body} is from {scene.spacecraft}", lambda: _spans(paths, "SPK")
    ):
        for _ in range(LIGHT_TIMES):
            place_km, light_s = spiceypy.spkpos(scene.body, left, INERTIAL, "NONE", scene.spacecraft)
            left = et - float(light_s)
    with _asked(view.image, utc, f"how {camera_frame} is turned", lambda: _spans(paths, "CK")):
        to_camera = quat_to_matrix(np.array(scene.quat_frame_to_camera)) @ spiceypy.pxform(
            INERTIAL, camera_frame, et
        )
    with _asked(view.image, utc, f"how {fixed} is turned", lambda: _spans(paths, "CK")):
        to_body = spiceypy.pxform(INERTIAL, fixed, left)
    pose = np.eye(4)
    pose[:3, :3] = to_camera @ to_body.T
    pose[:3, 3] = to_camera @ (1e3 * np.asarray(place_km))
    lens = view.intrinsics
    return dataclasses.replace(
        view,
        world_to_camera=pose,
        intrinsics=_lens(scene, corners, lens.width, lens.height, view.image),
        mid_exposure_utc_ns=utc_ns,
        sun_dir_body=to_body @ _sun(scene.body, left),
        attitude_known=scene.body_frame is not None,
        quat_inertial_to_body=matrix_to_quat(to_body),
    )


def _sun(body: str, et: float) -> np.ndarray:
    """Return the unit vector [3] from the body to the Sun, inertial axes; zero where no kernel says it."""
    import spiceypy

    try:
        towards = np.asarray(spiceypy.spkpos("SUN", et, INERTIAL, "NONE", body)[0])
    except spiceypy.exceptions.SpiceyError:
        return np.zeros(3)
    length = np.linalg.norm(towards)
    return towards / length if length > 0 else np.zeros(3)


def _camera(scene: Scene, where: Path) -> tuple[str, np.ndarray | None]:
    """Return the camera's frame, and the directions [4, 3] of the picture's corners in picture axes by an IK."""
    import spiceypy

    if scene.instrument is None:
        assert scene.camera_frame is not None
        return scene.camera_frame, None
    try:
        number = spiceypy.bods2c(scene.instrument)
        shape, frame, _, count, bounds = spiceypy.getfov(number, CORNERS)
    except (spiceypy.exceptions.SpiceyError, spiceypy.exceptions.NotFoundError) as error:
        raise FormatError(
            f"{where}: no kernel gives the field of view of the instrument {scene.instrument} by at most {CORNERS} "
            f"directions ({_short(error)}); name its IK, or give camera_frame and fx_px instead"
        ) from error
    camera_frame = scene.camera_frame or frame
    if scene.fx_px is not None:
        return camera_frame, None
    if shape not in ("RECTANGLE", "POLYGON") or count != CORNERS:
        raise FormatError(
            f"{where}: the field of view of {scene.instrument} is of the shape {shape}, which does not tell the "
            "picture's edges: give fx_px"
        )
    if camera_frame != frame:
        _check_frame(frame, where)
        with _asked(
            where, "the picture's corners", f"how {frame} and {camera_frame} are turned to each other"
        ):
            bounds = np.asarray(bounds) @ spiceypy.pxform(frame, camera_frame, 0.0).T
    corners = np.asarray(bounds) @ quat_to_matrix(np.array(scene.quat_frame_to_camera)).T
    if (corners[:, 2] <= 0).any():
        raise FormatError(
            f"{where}: the field of view of {scene.instrument} does not lie along the camera's z axis: give "
            f"quat_frame_to_camera, from {camera_frame} to x right, y down, z forwards"
        )
    return camera_frame, corners


def _lens(scene: Scene, corners: np.ndarray | None, width: int, height: int, image: Path) -> Intrinsics:
    if corners is None:
        assert scene.fx_px is not None
        return scene.lens(width, height, scene.fx_px)
    low, high = (pick(corners[:, :2] / corners[:, 2:], axis=0) for pick in (np.min, np.max))
    fx_px, fy_px = (float(value) for value in np.array([width, height]) / (high - low))
    if scene.fy_px is None and abs(fx_px - fy_px) > ALIKE * fx_px:
        raise FormatError(
            f"{image}: has {width}x{height} pixels, but the field of view of {scene.instrument} measures "
            f"{np.degrees(high[0] - low[0]):.4g} by {np.degrees(high[1] - low[1]):.4g} degrees: a picture of a "
            "part of the sensor; give fx_px, cx_px and cy_px"
        )
    return scene.lens(width, height, fx_px, (fy_px, -low[0] * fx_px, -low[1] * fy_px))


@contextlib.contextmanager
def _loaded(paths: list[Path]) -> Iterator[None]:
    """Load kernels, and unload them at the end: SPICE has one pool for the whole process."""
    import spiceypy

    with contextlib.ExitStack() as stack:
        for path in paths:
            if not path.is_file():
                raise FormatError(f"{path}: there is no such kernel; mend the list in {SCENE}")
            try:
                kind = spiceypy.getfat(str(path))
                if kind[1] == "MK":
                    raise FormatError(
                        f"{path}: is a meta-kernel, whose paths may lead anywhere: list the kernels that it names in "
                        f"{SCENE}"
                    )
                if kind[1] == "?":
                    raise FormatError(f"{path}: expected a SPICE kernel, got a file of another kind")
                spiceypy.furnsh(str(path))
            except spiceypy.exceptions.SpiceyError as error:
                raise FormatError(f"{path}: is no kernel that SPICE can load: {_short(error)}") from error
            stack.callback(spiceypy.unload, str(path))
        yield


@contextlib.contextmanager
def _asked(where: Path, utc: str, what: str, spans: Callable[[], list[str]] = list) -> Iterator[None]:
    """Turn an error of SPICE into one line: the picture, its time, what the kernels do not say, and what they cover."""
    import spiceypy

    try:
        yield
    except spiceypy.exceptions.SpiceyError as error:
        found = spans()
        shown = ", ".join(found[:SPANS_NAMED]) + ", ..." * (len(found) > SPANS_NAMED)
        raise FormatError(
            f"{where}: {utc}: the kernels do not say {what} ({_short(error)})"
            + (f"; they cover {shown}" if found else "")
            + "; name a kernel that says it, or take the picture out"
        ) from error


def _spans(paths: list[Path], kind: str) -> list[str]:
    """Return what time each kernel of a kind, SPK or CK, covers of each of its objects, from its first to its last."""
    import spiceypy

    spans = []
    for path in paths:
        if spiceypy.getfat(str(path))[1] != kind:
            continue
        for number in spiceypy.spkobj(str(path)) if kind == "SPK" else spiceypy.ckobj(str(path)):
            try:
                if kind == "SPK":
                    window = spiceypy.spkcov(str(path), number)
                else:
                    window = spiceypy.ckcov(str(path), number, False, "INTERVAL", 0.0, "TDB")
                ends = [
                    str(spiceypy.et2utc(window[i], "ISOC", 0)) for i in (0, 2 * spiceypy.wncard(window) - 1)
                ]
            except spiceypy.exceptions.SpiceyError as error:
                ends = [f"an unknown time ({_short(error)})"]
            name = (
                spiceypy.bodc2s(number) if kind == "SPK" else spiceypy.frmnam(spiceypy.ccifrm(3, number)[0])
            )
            spans.append(f"{path.name}: {name or number} {' to '.join(ends)}")
    return spans


def _check_body(name: str, where: Path) -> None:
    import spiceypy

    try:
        spiceypy.bods2c(name)
    except spiceypy.exceptions.NotFoundError as error:
        raise FormatError(
            f"{where}: no kernel names the body {name}; name an FK that does, or its number"
        ) from error


def _check_frame(name: str, where: Path) -> None:
    import spiceypy

    if not spiceypy.namfrm(name):
        raise FormatError(f"{where}: no kernel defines the frame {name}; name the FK that does")


def _short(error: Exception) -> str:
    """Return the first sentence of what SPICE says of an error."""
    text = " ".join(str(getattr(error, "long", "") or getattr(error, "explain", "") or error).split())
    return re.split(r"(?<=[a-z)])\. ", text)[0].rstrip(".")


def _text(utc_ns: int) -> str:
    seconds, ns = divmod(utc_ns, 10**9)
    return datetime.fromtimestamp(seconds, UTC).strftime("%Y-%m-%dT%H:%M:%S") + f".{ns:09}"
