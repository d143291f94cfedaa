"""nerfstudio folders: one transforms.json, camera-to-world in OpenGL axes, intrinsics for all or each frame.

Source: docs.nerf.studio, data conventions.
"""

import json
from pathlib import Path
from typing import Any

from flightsw.icd.mission import CameraSection
from ground.formats.nerf import (
    camera_keys,
    frame_keys,
    image_path,
    load_transforms,
    picture,
    read_calibration,
    read_frame,
    split_brackets,
)
from ground.formats.views import FormatError, Intrinsics, View
from ground.session import Session
from obbgs_base.files import write_whole

PINHOLE_MODELS = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE")
DISTORTION_KEYS = ("k1", "k2", "p1", "p2", "k3")


def read_nerfstudio(folder: Path) -> tuple[list[View], CameraSection | None]:
    """Return the pictures of a nerfstudio folder, and the calibration if `export_nerfstudio` wrote it.

    Raises:
        FormatError: transforms.json is missing or not valid, or its camera is not a perspective camera.
    """
    path = folder / "transforms.json"
    tree = load_transforms(path)
    views = []
    for frame in tree["frames"]:
        image = image_path(folder, frame, path)
        views.append(read_frame(frame, image, _intrinsics({**tree, **frame}, path), path))
    return views, read_calibration(tree, path)


def export_nerfstudio(session: Session, out: Path) -> dict[str, int]:
    """Write a session as a nerfstudio folder, pictures as in `export_nerf`; return the frames per split."""
    (out / "images").mkdir(parents=True, exist_ok=True)
    split_of = split_brackets(session)
    frames, splits = [], {"train": [], "val": [], "test": []}
    for record in session.frames:
        name = f"images/frame_{record.id:06d}.png"
        write_whole(out / name, picture(session, record))
        frames.append({"file_path": name, **frame_keys(session, record)})
        splits[split_of[record.bracket]].append(name)
    tree = {
        "camera_model": "OPENCV",
        **camera_keys(session.camera),
        **dict.fromkeys(DISTORTION_KEYS, 0.0),
        **{f"{split}_filenames": names for split, names in splits.items()},
        "frames": frames,
    }
    write_whole(out / "transforms.json", json.dumps(tree, indent=1).encode() + b"\n")
    return {split: len(names) for split, names in splits.items()}


def _intrinsics(keys: dict[str, Any], where: Path) -> Intrinsics:
    """Return a frame's intrinsics; `keys` are the file's, overridden by the frame's own."""
    model = keys.get("camera_model", "OPENCV")
    if model not in PINHOLE_MODELS:
        raise FormatError(f"{where}: expected a camera model of {', '.join(PINHOLE_MODELS)}, got {model!r}")
    if keys.get("k4"):
        raise FormatError(f"{where}: k4 belongs to a lens model that is not supported")
    try:
        return Intrinsics(
            int(keys["w"]),
            int(keys["h"]),
            float(keys["fl_x"]),
            float(keys.get("fl_y", keys["fl_x"])),
            float(keys["cx"]),
            float(keys["cy"]),
            tuple(float(keys.get(name, 0.0)) for name in DISTORTION_KEYS),
        )
    except KeyError as error:
        raise FormatError(f"{where}: {error} is missing") from error
    except (TypeError, ValueError) as error:
        raise FormatError(f"{where}: the intrinsics are not numbers: {error}") from error
