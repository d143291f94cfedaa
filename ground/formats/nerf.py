"""NeRF-synthetic folders: transforms_{train,val,test}.json, camera-to-world in OpenGL axes, pictures of 8 bits.

Keys that other readers ignore keep what the format has no place for: the calibration, and of each frame exposure time,
time, bracket, Sun direction, covariance of the pose, and the target's place and attitude, by which the Earth is known.
"""

import dataclasses
import json
import logging
import math
from pathlib import Path
from typing import Any

import imagecodecs
import numpy as np

from flightsw.icd.config import MAX_JSON_BYTES, ConfigError, build, keys_below, parse_json
from flightsw.icd.mission import CameraSection
from ground.formats.axes import opengl_to_world_to_camera, world_to_camera_to_opengl
from ground.formats.pictures.files import KINDS, FormatError, image_size, within
from ground.formats.pictures.lens import Intrinsics
from ground.formats.pictures.views import Exported, View
from ground.session.earth import target_place_m
from ground.session.folder import SPLITS, FrameRecord, Session
from obbgs_base.errors import counted, reason
from obbgs_base.files import read_bounded, write_whole

log = logging.getLogger(__name__)
PINHOLE_MODELS = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE")
DISTORTION_KEYS = ("k1", "k2", "p1", "p2", "k3")
# a fisheye, OpenCV's rational, thin-prism and tilted models, and instant-ngp's other lenses
OTHER_LENSES = (
    *("is_fisheye", "k4", "k5", "k6", "s1", "s2", "s3", "s4", "tau_x", "tau_y", "ftheta_p0", "latlong"),
    *("equirectangular", "rolling_shutter"),
)
UNIT_WITHIN = 1e-3
# Of eleven brackets six are for training, two for validation, three for testing; 121 brackets of three frames give
# 198, 66 and 99 frames, the published split.
SPLIT_PATTERN = (0, 1, 0, 2, 0, 2, 0, 1, 0, 2, 0)


def read_nerf(folder: Path) -> tuple[list[View], Exported | None]:
    """Return the pictures of all splits, by frame number, and what `export_nerf` says of them if it wrote them.

    Raises:
        FormatError: there is no transforms_*.json, or one is not valid.
    """
    numbered: list[tuple[int, View]] = []
    exported = None
    for split in SPLITS:
        path = folder / f"transforms_{split}.json"
        if not path.is_file():
            continue
        tree = load_transforms(path)
        exported = exported or read_exported(tree, path)
        for frame in tree["frames"]:
            image = image_path(folder, frame, path)
            view = read_frame(frame, image, _intrinsics({**tree, **frame}, image, path), path)
            number = frame.get("frame_id", len(numbered))
            if type(number) is not int:
                raise FormatError(
                    f"{path}: {image.name}: expected a whole number as frame_id, got {number!r}"
                )
            numbered.append((number, dataclasses.replace(view, split=split)))
    if not numbered:
        raise FormatError(f"{folder}: no transforms_train.json, transforms_val.json or transforms_test.json")
    return as_exported([view for _, view in sorted(numbered, key=lambda entry: entry[0])], exported)


def export_nerf(session: Session, out: Path) -> dict[str, int]:
    """Write a session's frames with a valid pose as a NeRF-synthetic folder, and return their number in each split.

    Pictures are opaque: black level to full scale becomes 0 to 255. Beside them, in readings/, lie the digital numbers
    of 16 bits as the session has them, which our import takes. Frames are in the splits of `split_frames`.
    """
    split_of, posed = split_frames(session), posed_frames(session)
    camera = session.camera
    counts = {}
    for split in SPLITS:
        records = [record for record in posed if split_of[record.id] == split]
        counts[split] = len(records)
        if not records:
            continue
        (out / split).mkdir(parents=True, exist_ok=True)
        frames = []
        for record in records:
            name = f"{split}/r_{record.id:04d}"
            write_whole(out / f"{name}.png", picture(session, record))
            keys = {**frame_keys(session, record), **write_readings(session, record, out)}
            frames.append({"file_path": f"./{name}", "rotation": 0.0, **keys})
        tree = {
            "camera_angle_x": 2 * math.atan(camera.width / (2 * camera.fx_px)),
            **camera_keys(session),
            "frames": frames,
        }
        write_whole(out / f"transforms_{split}.json", json.dumps(tree, indent=1).encode() + b"\n")
    return counts


def posed_frames(session: Session) -> list[FrameRecord]:
    """Return the frames that are exported, those whose pose is valid; what is left out is logged."""
    posed = [record for record in session.frames if record.pose_valid]
    if left_out := len(session.frames) - len(posed):
        log.warning("left out: %s without a valid pose", counted(left_out, "frame"))
    if session.navigation.sigmas.vector().any():
        log.warning("how far the pass's poses err together is not exported: they are as tagged")
    return posed


def split_frames(session: Session) -> dict[int, str]:
    """Return the split of each frame by its number: the stated one.

    Where none is stated, whole brackets are in train, val or test, 6:2:3 as published, interleaved along the pass.
    """
    brackets = sorted({record.bracket for record in session.frames})
    split_of = {b: SPLITS[SPLIT_PATTERN[i % len(SPLIT_PATTERN)]] for i, b in enumerate(brackets)}
    return {record.id: record.split or split_of[record.bracket] for record in session.frames}


def picture(session: Session, record: FrameRecord) -> bytes:
    """Return a frame as PNG, RGBA of 8 bits, its values as in the session and opaque."""
    camera = session.camera
    dn = session.dn(record).astype(np.float64)
    value = np.clip((dn - camera.black_dn) / (camera.white_dn - camera.black_dn), 0, 1)
    rgba = np.full((*dn.shape[:2], 4), 255, dtype=np.uint8)
    rgba[..., :3] = np.rint(255 * value.reshape(*dn.shape[:2], -1))
    return bytes(imagecodecs.png_encode(rgba, level=6))


def write_readings(session: Session, record: FrameRecord, out: Path) -> dict[str, str]:
    """Write a frame's digital numbers as the session has them, and return the key of a frame that names their file."""
    name = f"readings/frame_{record.id:06d}.png"
    (out / "readings").mkdir(exist_ok=True)
    write_whole(out / name, (session.path / record.file).read_bytes())
    return {"readings": name}


def frame_keys(session: Session, record: FrameRecord) -> dict[str, Any]:
    """Return a frame's pose, its intrinsics where they are its own, and the keys that only we write."""
    start_ns = session.frames[0].mid_exposure_utc_ns
    own = {} if record.K is None else intrinsics_keys(record.K.tolist())
    place_m, attitude = target_place_m(session, record), record.quat_inertial_to_body
    return {
        **own,
        "transform_matrix": world_to_camera_to_opengl(record.world_to_camera).tolist(),
        "exposure_time_s": record.exposure_time_s,
        "time": (record.mid_exposure_utc_ns - start_ns) * 1e-9,  # s since the first frame
        "mid_exposure_utc_ns": record.mid_exposure_utc_ns,
        "frame_id": record.id,
        "bracket": record.bracket,
        "bracket_index": record.bracket_index,
        "sun_dir_body": record.sun_dir_body.tolist(),
        "in_eclipse": record.in_eclipse,
        **({"pose_covariance": record.covariance.tolist()} if record.covariance.any() else {}),
        **({} if attitude is None else {"quat_inertial_to_body": attitude.tolist()}),
        **({} if place_m is None else {"target_position_m": place_m.tolist()}),
    }


def camera_keys(session: Session) -> dict[str, Any]:
    """Return the intrinsics under nerfstudio's names, our calibration, and what the values stand for."""
    camera = session.camera
    return {
        **intrinsics_keys(camera.K),
        "w": camera.width,
        "h": camera.height,
        "calibration": dataclasses.asdict(camera),
        "background": session.background,
        "encoding": session.encoding,
    }


def intrinsics_keys(K: list[list[float]]) -> dict[str, float]:
    """Return a pinhole matrix under nerfstudio's names, px."""
    return {"fl_x": K[0][0], "fl_y": K[1][1], "cx": K[0][2], "cy": K[1][2]}


def load_transforms(path: Path) -> dict[str, Any]:
    """Return the content of a transforms file.

    Raises:
        FormatError: it cannot be read, or its "frames" is not a list of objects.
    """
    try:
        tree = parse_json(read_bounded(path, MAX_JSON_BYTES), "transforms")
    except (OSError, ConfigError) as error:
        raise FormatError(f"{path}: {reason(error)}") from error
    frames = tree.get("frames") if isinstance(tree, dict) else None
    if not isinstance(frames, list) or not all(isinstance(frame, dict) for frame in frames):
        raise FormatError(f'{path}: expected an object with a list "frames"')
    if not frames:
        raise FormatError(f"{path}: it has no frames")
    return tree


def image_path(folder: Path, frame: dict[str, Any], where: Path) -> Path:
    """Return the path of a frame's picture, in the data set's folder; NeRF-synthetic omits the suffix .png."""
    name = frame.get("file_path")
    if not isinstance(name, str):
        raise FormatError(f"{where}: a frame has no file_path")
    image = within(folder, name, where)
    if image.is_file() or image.suffix.lower() in KINDS:
        return image
    return within(folder, f"{name}.png", where)


def read_frame(frame: dict[str, Any], image: Path, intrinsics: Intrinsics, where: Path) -> View:
    """Return one frame of a transforms file.

    Raises:
        FormatError: the pose or one of our extra keys is not valid.
    """
    pose = opengl_to_world_to_camera(frame.get("transform_matrix"), f"{where}: {image.name}")
    try:
        time_ns, bracket = frame.get("mid_exposure_utc_ns"), frame.get("bracket")
        sun = np.array(frame.get("sun_dir_body", (0.0, 0.0, 0.0)), dtype=np.float64)
        covariance = _array(frame, "pose_covariance", (6, 6))
        attitude = _array(frame, "quat_inertial_to_body", (4,))
        if attitude is not None and abs(np.linalg.norm(attitude) - 1) > UNIT_WITHIN:
            raise ValueError(f"quat_inertial_to_body: expected a unit quaternion, got {attitude.tolist()}")
        exposure_time_s = float(frame.get("exposure_time_s", 1.0))
        mask = frame.get("mask_path")
        if mask is not None and not isinstance(mask, str):
            raise ValueError(f"mask_path: expected a file name, got {mask!r}")
        if sun.shape != (3,) or not 0 < exposure_time_s < math.inf:
            raise ValueError(f"exposure_time_s {exposure_time_s}, sun_dir_body {sun.tolist()}")
        return View(
            image,
            pose,
            intrinsics,
            exposure_time_s=exposure_time_s,
            exposure_stated="exposure_time_s" in frame,
            mask=None if mask is None else within(where.parent, mask, where),
            mid_exposure_utc_ns=None if time_ns is None else int(time_ns),
            bracket=None if bracket is None else int(bracket),
            bracket_index=int(frame.get("bracket_index", 0)),
            sun_dir_body=sun,
            in_eclipse=bool(frame.get("in_eclipse", False)),
            covariance=covariance,
            quat_inertial_to_body=attitude,
            target_position_m=_array(frame, "target_position_m", (3,)),
            readings=_readings_path(frame, where),
        )
    except (ValueError, TypeError, OverflowError) as error:
        raise FormatError(f"{where}: {image.name}: {error}") from error


def _array(frame: dict[str, Any], key: str, shape: tuple[int, ...]) -> np.ndarray | None:
    """Return the numbers that a frame has under a key of ours; None where it has none."""
    told = frame.get(key)
    if told is None:
        return None
    array = np.array(told, dtype=np.float64)
    if array.shape != shape or not np.isfinite(array).all():
        raise ValueError(f"{key}: expected {list(shape)} finite numbers, got {told!r}")
    return array


def _readings_path(frame: dict[str, Any], where: Path) -> Path | None:
    """Return the path of a frame's readings, in the data set's folder; None where there are none."""
    name = frame.get("readings")
    if name is None:
        return None
    if not isinstance(name, str):
        raise ValueError(f"readings: expected a file name, got {name!r}")
    path = within(where.parent, name, where)
    return path if path.is_file() else None


def as_exported(views: list[View], exported: Exported | None) -> tuple[list[View], Exported | None]:
    """Return the pictures of an export of ours with their readings, where all have them.

    Otherwise they are the pictures of 8 bits, whose rounding is added to the noise that the export states.
    """
    if exported is not None and all(view.readings is not None for view in views):
        return views, exported
    views = [dataclasses.replace(view, readings=None) for view in views]
    return views, None if exported is None else _rounded(exported)


def _rounded(exported: Exported) -> Exported:
    camera = exported.camera
    step_dn = (camera.white_dn - camera.black_dn) / 255
    if step_dn <= 1:
        return exported
    noise_dn = math.hypot(camera.read_noise_dn, step_dn / math.sqrt(12))
    return dataclasses.replace(exported, camera=dataclasses.replace(camera, read_noise_dn=noise_dn))


def read_exported(tree: dict[str, Any], where: Path) -> Exported | None:
    """Return what our export says of its pictures; None if it is not ours.

    Raises:
        FormatError: it is damaged.
    """
    if "calibration" not in tree:
        return None
    try:
        with keys_below("transforms.calibration", "mission.camera"):
            camera: CameraSection = build(CameraSection, tree["calibration"], "transforms.calibration")
        return Exported(camera, tree.get("background", 0.0), tree.get("encoding", "linear"))
    except (ConfigError, ValueError) as error:
        raise FormatError(f"{where}: {error}") from error


def distortion_of(keys: dict[str, Any], where: Path) -> tuple[float, ...]:
    """Return the coefficients of lens distortion in a frame's keys, as DISTORTION_KEYS names them.

    Raises:
        FormatError: the camera is not a perspective camera, or has another lens model.
        ValueError, TypeError: one is no number.
    """
    model = keys.get("camera_model", "OPENCV")
    if model not in PINHOLE_MODELS:
        raise FormatError(f"{where}: expected a camera model of {', '.join(PINHOLE_MODELS)}, got {model!r}")
    for name in OTHER_LENSES:
        if keys.get(name):
            raise FormatError(
                f"{where}: {name} belongs to a lens model that is not supported; undistort the pictures first, as with "
                "`colmap image_undistorter`"
            )
    return tuple(float(keys.get(name, 0.0)) for name in DISTORTION_KEYS)


def _intrinsics(tree: dict[str, Any], image: Path, where: Path) -> Intrinsics:
    """Return a frame's intrinsics; `tree` holds the file's keys, overridden by the frame's own."""
    try:
        if "w" in tree and "h" in tree:
            width, height = int(tree["w"]), int(tree["h"])
        else:
            width, height = image_size(image)
        focal_px = tree.get("fl_x") or width / (2 * math.tan(tree["camera_angle_x"] / 2))
        focal_y_px = tree.get("fl_y", focal_px)
        if "fl_y" not in tree and "fl_x" not in tree and "camera_angle_y" in tree:
            focal_y_px = height / (2 * math.tan(tree["camera_angle_y"] / 2))
        return Intrinsics(
            width,
            height,
            float(focal_px),
            float(focal_y_px),
            float(tree.get("cx", width / 2)),
            float(tree.get("cy", height / 2)),
            distortion_of(tree, where),
            float(tree.get("skew", 0.0)),
        )
    except KeyError as error:
        raise FormatError(f"{where}: {error} is missing") from error
    except (TypeError, ValueError, ZeroDivisionError, OverflowError) as error:
        raise FormatError(f"{where}: {image.name}: the intrinsics are not valid: {error}") from error
