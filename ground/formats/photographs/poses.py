"""Photographs without poses: their cameras by structure from motion (COLMAP), in a frame of the object's own.

Source: Schönberger and Frahm, Structure-from-Motion Revisited, 2016, through its Python package pycolmap.
"""

import contextlib
import dataclasses
import hashlib
import logging
import math
import shutil
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ground.formats.photographs.brackets import alike, brackets_of, feature_name, write_for_features
from ground.formats.photographs.epipolar import turned
from ground.formats.photographs.exposures import with_exposures
from ground.formats.photographs.turned_pictures import turned_back
from ground.formats.pictures.files import FormatError, Light, pictures_in
from ground.formats.pictures.lens import Intrinsics
from ground.formats.pictures.view import View
from ground.formats.pictures.views import PoseSigmas, unposed
from obbgs_base.errors import Interrupted
from obbgs_base.files import write_whole

if TYPE_CHECKING:
    import pycolmap

SEED = 0
FEWEST = 3  # pictures that a model must register
PICTURES_AT_ONCE = 8  # between looks at whether to stop
RADIUS_SHARE = 0.9  # of the points lie within one metre of the origin
COLMAP_READS = {".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff"}
PICTURES = "pictures.sha256"  # of the pictures that features and matches are of
log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Registered:
    """What structure from motion made of a folder of photographs.

    views: the registered pictures. Origin: the points' median; one metre: the radius that holds nine tenths of them, as
        the true scale cannot be known.
    left_out: names of the pictures that were not registered.
    turned: names of those that were turned by 180 degrees against the others, which told the principal point.
    reprojection_px: mean distance of the features from where their points are projected to.
    sigmas: how far the poses can err: that distance as an angle, and at the median range.
    """

    views: list[View]
    left_out: tuple[str, ...]
    turned: tuple[str, ...]
    reprojection_px: float
    sigmas: PoseSigmas

    def described(self) -> dict:
        """Return what the session keeps of it."""
        return {
            "registered": len(self.views),
            "left_out": list(self.left_out),
            "turned": list(self.turned),
            "reprojection_px": self.reprojection_px,
            "scale": "unknown: one metre is the radius that holds nine tenths of the points",
        }


def _keep_only_of(work: Path, folder: Path, names: Sequence[str], exposures: str) -> None:
    """Make the folder of features and matches, without those of other pictures: COLMAP knows pictures by name alone.

    Args:
        exposures: what is known of the pictures' exposures, by which their copies for the features are made.

    Raises:
        FormatError: there is a folder of that name that no import has made.
    """
    digest = hashlib.sha256(exposures.encode())
    for name in names:
        content = (folder / name).read_bytes()
        digest.update(f"{name}\0{len(content)}\0".encode() + content)
    noted = work / PICTURES
    if work.exists() and any(work.iterdir()) and not noted.is_file():
        raise FormatError(
            f"{work} is there and not from an import: choose another --session, or move it away"
        )
    if noted.is_file() and noted.read_text(errors="replace") != digest.hexdigest():
        log.warning("%s is of other pictures and begins anew", work)
        shutil.rmtree(work)
    work.mkdir(parents=True, exist_ok=True)
    write_whole(noted, digest.hexdigest().encode())


def read_photographs(
    folder: Path,
    work: Path,
    on_share: Callable[[float], None] = lambda share: None,
    should_stop: Callable[[], bool] = lambda: False,
    count: int | None = None,
    table: dict[str, Light] | None = None,
) -> Registered:
    """Return the photographs of a folder, in the order of their names, with the cameras that took them.

    Photographs of one bracket, as exposures that come again in the same order tell, have one camera (`brackets_of`).
    Features are sought on pictures brought to one exposure where exposures differ.

    One camera with one focal length is assumed to have taken them all; its focal length and a radial distortion are
    estimated. Its line of sight is taken to meet the pictures' middle, which from a distance cannot be told from a turn
    of all cameras, unless some pictures were turned by 180 degrees (`turned_back`).

    Args:
        work: keeps features and matches, so that the same call goes on after an interruption; removed at the end.
        on_share: is told how much is done, from 0 to 1.
        count: take only the first so many; None: all.
        table: what is known of the photographs' exposures beside what they say themselves.

    Raises:
        FormatError: fewer than three pictures, different sizes, or no model is found that registers three of them.
        Interrupted: `should_stop` returned true; what was found is kept in `work`.
    """
    import pycolmap

    names = pictures_in(folder)[:count]
    if len(names) < FEWEST:
        raise FormatError(f"{folder}: expected at least {FEWEST} photographs, found {len(names)}")
    stated = with_exposures([unposed(folder / name) for name in names], table)
    if len(sizes := {(view.intrinsics.width, view.intrinsics.height) for view in stated}) > 1:
        raise FormatError(f"{folder}: the pictures of a session have one size, found {sorted(sizes)}")
    brackets = brackets_of(stated)
    _keep_only_of(work, folder, names, repr([view.exposure_time_s for view in stated]))
    originals, named = folder, {view.image.name: [view] for view in stated}
    if not all(_as_colmap_reads_it(view) for view in stated) or not alike(stated):
        folder, named = work / "pictures", {feature_name(group): group for group in brackets}
        write_for_features(folder, brackets)
    names = sorted(named)
    if len(names) < FEWEST:
        raise FormatError(f"{originals}: expected at least {FEWEST} brackets, found {len(names)}")
    database = work / "database.db"

    def step(share: float) -> None:
        on_share(share)
        if should_stop():
            raise Interrupted(
                f"stopped after {100 * share:.0f} % of structure from motion; what was found is kept in {work}"
            )

    with silent_colmap():
        pycolmap.set_random_seed(SEED)
        _find_features(database, folder, names, step)
        verification = pycolmap.TwoViewGeometryOptions()
        verification.ransac.random_seed = SEED
        matching = pycolmap.FeatureMatchingOptions(num_threads=1, use_gpu=False)
        pycolmap.match_exhaustive(
            database, matching, verification_options=verification, device=pycolmap.Device.cpu
        )
        step(0.7)
        model = _mapped(database, folder, work / "models", len(names), step)
        if model is None:
            raise FormatError(
                f"{folder}: no {FEWEST} of {len(names)} photographs have enough features in common to find their "
                "cameras; take more of them, with more overlap, of a textured object"
            )
        model, upside_down = turned_back(model, lambda: step(0.95))
    registered = _registered(model, named, upside_down)
    shutil.rmtree(work)
    return registered


def _find_features(database: Path, folder: Path, names: list[str], step: Callable[[float], None]) -> None:
    """Write the features of pictures to the database; those of all have one camera."""
    import pycolmap

    extraction = pycolmap.FeatureExtractionOptions(num_threads=1, use_gpu=False)
    with pycolmap.Database.open(database) as opened:
        cameras = opened.read_all_cameras()
    for start in range(0, len(names), PICTURES_AT_ONCE):
        # the first pictures make the camera, the others share it
        reader = pycolmap.ImageReaderOptions(camera_model="SIMPLE_RADIAL")
        if cameras:
            reader.existing_camera_id = cameras[0].camera_id
        pycolmap.extract_features(
            database,
            folder,
            names[start : start + PICTURES_AT_ONCE],
            pycolmap.CameraMode.SINGLE,
            reader,
            extraction,
            pycolmap.Device.cpu,
        )
        with pycolmap.Database.open(database) as opened:
            cameras = opened.read_all_cameras()
        step(0.3 * min(1.0, (start + PICTURES_AT_ONCE) / len(names)))


def _mapped(
    database: Path, folder: Path, models: Path, count: int, step: Callable[[float], None]
) -> "pycolmap.Reconstruction | None":
    """Return the model with the most pictures of all that incremental mapping finds."""
    import pycolmap

    options = pycolmap.IncrementalPipelineOptions(
        num_threads=1, random_seed=SEED, extract_colors=False, min_model_size=FEWEST
    )
    shutil.rmtree(models, ignore_errors=True)
    models.mkdir()
    stop, done, asked = pycolmap.CancellationToken(), 0, None

    def next_picture() -> None:
        nonlocal done, asked
        done += 1
        try:
            step(min(0.9, 0.7 + 0.2 * done / count))
        except Interrupted as error:  # it must not pass through the library
            asked = error
            stop.cancel()

    found = pycolmap.incremental_mapping(
        database, folder, models, options, next_image_callback=next_picture, cancellation_token=stop
    )
    if asked is not None:
        raise asked
    return max(found.values(), key=lambda m: (m.num_reg_images(), m.num_points3D()), default=None)


def _registered(
    model: "pycolmap.Reconstruction", named: dict[str, list[View]], upside_down: frozenset[str]
) -> Registered:
    """Return what was found of the pictures by the names under which COLMAP knows them, each of one or more frames."""
    points = np.array([point.xyz for point in model.points3D.values()])
    centre = np.median(points, axis=0)
    metre = float(np.quantile(np.linalg.norm(points - centre, axis=1), RADIUS_SHARE))
    posed, ranges_m = {}, []
    for image in model.images.values():
        if image.has_pose:
            pose = np.vstack([image.cam_from_world().matrix(), [0.0, 0.0, 0.0, 1.0]])
            pose[:3, 3] = (pose[:3, 3] + pose[:3, :3] @ centre) / metre
            lens = _intrinsics(model.cameras[image.camera_id])
            for view in named[image.name]:
                there = dataclasses.replace(view, world_to_camera=pose, intrinsics=lens)
                posed[view.image.name] = turned(there) if image.name in upside_down else there
            ranges_m.append(np.linalg.norm(pose[:3, 3]))
    reprojection_px = model.compute_mean_reprojection_error()
    focal_px = next(iter(posed.values())).intrinsics.fx_px
    sigma_rad = math.atan(reprojection_px / focal_px)
    frames = sorted(view.image.name for group in named.values() for view in group)
    left_out = tuple(name for name in frames if name not in posed)
    in_order = [posed[name] for name in frames if name in posed]
    upside = sorted(view.image.name for name in upside_down for view in named[name])
    sigmas = PoseSigmas(sigma_rad, sigma_rad * float(np.median(ranges_m)))
    return Registered(in_order, left_out, tuple(upside), reprojection_px, sigmas)


def _as_colmap_reads_it(view: View) -> bool:
    return view.image.suffix.lower() in COLMAP_READS


def _intrinsics(camera: "pycolmap.Camera") -> Intrinsics:
    focal_px, cx_px, cy_px, k1 = camera.params  # SIMPLE_RADIAL; COLMAP's pixel centres are at .5 like ours
    return Intrinsics(camera.width, camera.height, focal_px, focal_px, cx_px, cy_px, (k1, 0.0, 0.0, 0.0, 0.0))


@contextlib.contextmanager
def silent_colmap() -> Iterator[None]:
    """Keep COLMAP's log to its fatal errors while it works."""
    import pycolmap

    before = pycolmap.logging.minloglevel, pycolmap.logging.logtostderr
    pycolmap.logging.minloglevel = int(pycolmap.logging.Level.FATAL)
    try:
        yield
    finally:
        pycolmap.logging.minloglevel, pycolmap.logging.logtostderr = before
