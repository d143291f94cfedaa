"""Structure from motion by COLMAP, without the known poses: features, matches, and incremental mapping.

Source: Schönberger and Frahm, Structure-from-Motion Revisited, 2016, through its Python package pycolmap.
"""

import contextlib
import hashlib
import shutil
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import torch

from compare.opponents.reconstruction import Reconstruction, Work
from ground.formats.photographs.poses import silent_colmap
from obbgs_base.errors import Interrupted
from obbgs_base.files import write_whole
from obbgs_core.frames import TrainingFrame, mean_exposure_s, usable
from obbgs_core.sensor import Sensor

if TYPE_CHECKING:
    import pycolmap

Pictures = Literal["raw", "fused", "one-exposure"]
SEED = 0
BYTES_A_POINT = 12  # three floats of 32 bits
FEWEST_CAMERAS = 3  # fewer centres do not determine a similarity


@dataclass(frozen=True)
class Picture:
    """What COLMAP sees of one frame or fused bracket: image [H, W] or [H, W, 3] uint8, and its camera in truth."""

    image: np.ndarray
    world_to_camera: np.ndarray  # [4, 4], used only after the mapping
    K: np.ndarray  # [3, 3] px


def reconstruct_sfm(
    frames: list[TrainingFrame], sensor: Sensor, work: Work, pictures: Pictures
) -> Reconstruction:
    """Return the sparse points that incremental structure from motion finds, moved into the body frame.

    The intrinsics are known and fixed. The poses serve only afterwards, for the similarity that moves the registered
    cameras onto the known ones. Of several models the one with the most registered pictures counts.

    Args:
        pictures: raw: each frame as it is. fused: brackets of one pose by exposure fusion; a frame whose pose no other
            shares stays as it is. one-exposure: each frame divided by its exposure time.

    Returns:
        Nothing, with the reason, where no model is found or its cameras cannot be aligned.

    Raises:
        TooFewFrames, ReconstructionError: the frames do not fit together.
        Interrupted: `work.should_stop` returned true; features and matches are kept in `work.folder`.
    """
    import pycolmap

    frames, _ = usable(frames, exposure_aware=True)
    views = pictures_of(frames, sensor, pictures)
    with _folder(views, work) as folder, silent_colmap():
        clock = _Clock(folder / "seconds", work)
        _write_pictures(views, folder / "images")
        pycolmap.set_random_seed(SEED)
        _extract(views, folder)
        clock.step(0.2)
        counts = _match(folder / "database.db")
        figures: dict[str, Any] = {"frames": len(frames), "pictures": len(views), "registered": 0, **counts}
        clock.step(0.5)
        model, count = _map(folder, len(views), clock)
        if model is None:
            reason = (
                f"no pair of {len(views)} pictures could start a model: {counts['features_median']:.0f} features in "
                f"the median picture, {counts['verified_pairs']} pairs whose matches fit one motion"
            )
            return replace(
                Reconstruction.nothing(clock.seconds(), reason), figures={**figures, "failed": reason}
            )
        figures |= {
            "models": count,
            "registered": model.num_reg_images(),
            "reprojection_px": model.compute_mean_reprojection_error(),
        }
        return _in_body_frame(model, views, figures, clock.seconds())


def pictures_of(frames: list[TrainingFrame], sensor: Sensor, kind: Pictures) -> list[Picture]:
    """Return the pictures that structure from motion is run on; 255 is full scale, of the mean exposure if it is one.

    Raises:
        ValueError: an unknown kind.
    """
    if kind not in ("raw", "fused", "one-exposure"):
        raise ValueError(f"expected pictures raw, fused or one-exposure, got {kind!r}")
    full_dn, reference_s = sensor.white_dn - sensor.black_dn, mean_exposure_s(frames)
    groups: dict[bytes | int, list[np.ndarray]] = {}
    first: dict[bytes | int, TrainingFrame] = {}
    for i, f in enumerate(frames):
        gain = reference_s / f.exposure_time_s if kind == "one-exposure" else 1.0
        signal = ((f.dn - sensor.black_dn) * (gain / full_dn)).clamp(0, 1)
        image = (255 * signal).round().to(torch.uint8).numpy()
        key = i if kind != "fused" else f.world_to_camera.numpy().tobytes() + f.K.numpy().tobytes()
        groups.setdefault(key, []).append(image[..., 0] if image.shape[2] == 1 else image[..., :3])
        first.setdefault(key, f)
    return [
        Picture(
            images[0] if len(images) == 1 else fused(images),
            first[key].world_to_camera.double().numpy(),
            first[key].K.double().numpy(),
        )
        for key, images in groups.items()
    ]


def fused(images: list[np.ndarray]) -> np.ndarray:
    """Return one picture uint8 of a bracket's pictures uint8 by OpenCV's exposure fusion (Mertens et al. 2007)."""
    import cv2

    coloured = [cv2.cvtColor(i, cv2.COLOR_GRAY2BGR) if i.ndim == 2 else i for i in images]
    merged = cv2.createMergeMertens().process(coloured)
    merged = np.clip(255 * merged, 0, 255).round().astype(np.uint8)
    return merged[..., 0] if images[0].ndim == 2 else merged


class _Clock:
    """Seconds of the method's own work, over interrupted parts, and its reports to whoever follows it."""

    def __init__(self, path: Path, work: Work):
        self.path, self.work = path, work
        self.before_s = float(path.read_text()) if path.is_file() else 0.0
        self.started = time.monotonic()

    def seconds(self) -> float:
        return self.before_s + time.monotonic() - self.started

    def report(self, share: float) -> None:
        seconds = self.seconds()
        self.work.on_step(
            share, seconds, lambda _: Reconstruction.nothing(seconds, "the mapping has not ended")
        )
        self.started += self.seconds() - seconds  # the report's own time does not count

    def step(self, share: float) -> None:
        """Report the end of a stage whose results are kept, and stop if asked to."""
        write_whole(self.path, f"{self.seconds()}".encode())
        self.report(share)
        if self.work.should_stop():
            raise Interrupted(f"stopped after {100 * share:.0f} % of structure from motion; {self.kept()}")

    def kept(self) -> str:
        if self.work.folder is None:
            return "nothing is kept"
        return f"features and matches are kept in {self.path.parent}"


@contextlib.contextmanager
def _folder(views: list[Picture], work: Work) -> Iterator[Path]:
    """Yield the folder for the database and pictures, one for each input; without `work.folder` a temporary one."""
    if work.folder is None:
        with tempfile.TemporaryDirectory() as folder:
            yield Path(folder)
        return
    digest = hashlib.sha256()
    for view in views:
        digest.update(view.image.tobytes() + view.K.tobytes())
    folder = work.folder / f"sfm-{digest.hexdigest()[:16]}"
    folder.mkdir(parents=True, exist_ok=True)
    yield folder


def _name(index: int) -> str:
    return f"{index:05d}.png"


def _write_pictures(views: list[Picture], folder: Path) -> None:
    import cv2

    folder.mkdir(exist_ok=True)
    for i, view in enumerate(views):
        image = view.image[..., ::-1] if view.image.ndim == 3 else view.image  # OpenCV writes blue first
        write_whole(folder / _name(i), cv2.imencode(".png", np.ascontiguousarray(image))[1].tobytes())


def _extract(views: list[Picture], folder: Path) -> None:
    """Find features in the pictures that have none yet; pictures of equal intrinsics share a camera."""
    import pycolmap

    by_camera: dict[tuple[float, ...], list[str]] = {}
    for i, view in enumerate(views):
        # COLMAP's pixel centres are at .5 like ours
        parameters = (view.K[0, 0], view.K[1, 1], view.K[0, 2], view.K[1, 2])
        by_camera.setdefault(tuple(map(float, parameters)), []).append(_name(i))
    options = pycolmap.FeatureExtractionOptions(num_threads=1, use_gpu=False)
    for parameters, names in by_camera.items():
        reader = pycolmap.ImageReaderOptions(
            camera_model="PINHOLE", camera_params=",".join(map(repr, parameters))
        )
        pycolmap.extract_features(
            folder / "database.db",
            folder / "images",
            names,
            pycolmap.CameraMode.SINGLE,
            reader,
            options,
            pycolmap.Device.cpu,
        )


def _match(database: Path) -> dict[str, Any]:
    """Match all pairs that are not matched yet; return the counts of features, matches and verified pairs."""
    import pycolmap

    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = SEED
    matching = pycolmap.FeatureMatchingOptions(num_threads=1, use_gpu=False)
    pycolmap.match_exhaustive(
        database, matching, verification_options=verification, device=pycolmap.Device.cpu
    )
    with pycolmap.Database.open(database) as opened:
        features = [opened.num_keypoints_for_image(image.image_id) for image in opened.read_all_images()]
        inliers = np.array(opened.read_two_view_geometry_num_inliers()[1])
        return {
            "features_median": float(np.median(features)),
            "matches": opened.num_matches(),
            "verified_pairs": int((inliers >= verification.min_num_inliers).sum()),
        }


def _map(folder: Path, count: int, clock: _Clock) -> "tuple[pycolmap.Reconstruction | None, int]":
    """Return the model with the most pictures of all that incremental mapping finds, and their number."""
    import pycolmap

    options = pycolmap.IncrementalPipelineOptions(
        num_threads=1,
        random_seed=SEED,
        extract_colors=False,
        min_model_size=FEWEST_CAMERAS,
        ba_refine_focal_length=False,
        ba_refine_principal_point=False,
        ba_refine_extra_params=False,
    )
    options.mapper.abs_pose_refine_focal_length = False
    options.mapper.abs_pose_refine_extra_params = False
    models = folder / "models"
    shutil.rmtree(models, ignore_errors=True)
    models.mkdir()
    stop, registered = pycolmap.CancellationToken(), 0

    def next_picture() -> None:
        nonlocal registered
        registered += 1
        clock.report(min(0.99, 0.5 + 0.5 * registered / count))
        if clock.work.should_stop():
            stop.cancel()

    found = pycolmap.incremental_mapping(
        folder / "database.db",
        folder / "images",
        models,
        options,
        next_image_callback=next_picture,
        cancellation_token=stop,
    )
    if stop.is_cancelled:
        raise Interrupted(f"stopped in the mapping; {clock.kept()}")
    best = max(found.values(), key=lambda m: (m.num_reg_images(), m.num_points3D()), default=None)
    return best, len(found)


def _in_body_frame(
    model: "pycolmap.Reconstruction", views: list[Picture], figures: dict[str, Any], seconds: float
) -> Reconstruction:
    """Return the model's points after the similarity that moves its cameras onto the known ones."""
    images = [image for image in model.images.values() if image.has_pose]
    found = np.array([image.projection_center() for image in images])
    poses = [views[int(Path(image.name).stem)].world_to_camera for image in images]
    known = np.array([-pose[:3, :3].T @ pose[:3, 3] for pose in poses])
    moved = similarity(found, known)
    if moved is None:
        reason = f"the {len(images)} registered cameras cannot be aligned with the known ones"
        return replace(Reconstruction.nothing(seconds, reason), figures={**figures, "failed": reason})
    points = np.array([point.xyz for point in model.points3D.values()]).reshape(-1, 3)
    errors_m = np.linalg.norm(_apply(moved, found) - known, axis=1)
    cloud = torch.from_numpy(_apply(moved, points)).float()
    figures = {**figures, "points": len(cloud), "camera_error_m": float(errors_m.mean())}
    return Reconstruction(cloud, cloud, None, BYTES_A_POINT * len(cloud), seconds, figures)


def similarity(source: np.ndarray, target: np.ndarray) -> np.ndarray | None:
    """Return the similarity [3, 4] that moves points [N, 3] closest to others in least squares (Umeyama 1991).

    None where the points do not determine it.
    """
    import pycolmap

    if len(source) < FEWEST_CAMERAS:
        return None
    found = pycolmap.estimate_sim3d(source, target)
    return None if found is None or not np.isfinite(found.matrix()).all() else found.matrix()


def _apply(transform: np.ndarray, points: np.ndarray) -> np.ndarray:
    return points @ transform[:, :3].T + transform[:, 3]
