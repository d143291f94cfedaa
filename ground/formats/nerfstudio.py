"""nerfstudio folders: one transforms.json, camera-to-world in OpenGL axes, intrinsics for all or each frame.

Source: docs.nerf.studio, data conventions.
"""

import dataclasses
import json
import logging
from pathlib import Path
from typing import Any

from ground.formats.nerf import (
    DISTORTION_KEYS,
    as_exported,
    camera_keys,
    distortion_of,
    frame_keys,
    image_path,
    load_transforms,
    picture,
    posed_frames,
    read_exported,
    read_frame,
    split_frames,
    write_readings,
)
from ground.formats.pictures.files import FormatError
from ground.formats.pictures.lens import Intrinsics
from ground.formats.pictures.views import Exported, View
from ground.session.folder import SPLITS, Session
from obbgs_base.errors import counted
from obbgs_base.files import write_whole

log = logging.getLogger(__name__)


def read_nerfstudio(folder: Path) -> tuple[list[View], Exported | None]:
    """Return the pictures of a nerfstudio folder, and what `export_nerfstudio` says of them if it wrote them.

    Where the file lists the pictures of its splits, those in no list are left out. Many data sets list the same ones
    for val and test: a picture is then in test, and one that is listed for training too is not trained on.

    Raises:
        FormatError: transforms.json is missing or not valid, or its camera is not a perspective camera.
    """
    path = folder / "transforms.json"
    tree = load_transforms(path)
    split_of = _splits(folder, tree, path)
    views = []
    for frame in tree["frames"]:
        image = image_path(folder, frame, path)
        if split_of and image not in split_of:
            continue
        view = read_frame(frame, image, _intrinsics({**tree, **frame}, path), path)
        views.append(dataclasses.replace(view, split=split_of.get(image)))
    if left_out := len(tree["frames"]) - len(views):
        log.warning("%s: %s in none of its splits, left out", path, counted(left_out, "picture"))
    return as_exported(views, read_exported(tree, path))


def export_nerfstudio(session: Session, out: Path) -> dict[str, int]:
    """Write a session as a nerfstudio folder, frames and pictures as in `export_nerf`; return the frames per split."""
    (out / "images").mkdir(parents=True, exist_ok=True)
    split_of = split_frames(session)
    frames, splits = [], {"train": [], "val": [], "test": []}
    for record in posed_frames(session):
        name = f"images/frame_{record.id:06d}.png"
        write_whole(out / name, picture(session, record))
        keys = {**frame_keys(session, record), **write_readings(session, record, out)}
        frames.append({"file_path": name, **keys})
        splits[split_of[record.id]].append(name)
    tree = {
        "camera_model": "OPENCV",
        **camera_keys(session),
        **dict.fromkeys(DISTORTION_KEYS, 0.0),
        **{f"{split}_filenames": names for split, names in splits.items()},
        "frames": frames,
    }
    write_whole(out / "transforms.json", json.dumps(tree, indent=1).encode() + b"\n")
    return {split: len(names) for split, names in splits.items()}


def _splits(folder: Path, tree: dict[str, Any], where: Path) -> dict[Path, str]:
    """Return the split of each listed picture; empty where the file lists none."""
    pictures = {image_path(folder, frame, where) for frame in tree["frames"]}
    split_of: dict[Path, str] = {}
    for split in SPLITS:  # test comes last and wins
        key = f"{split}_filenames"
        names = tree.get(key, [])
        if not isinstance(names, list):
            raise FormatError(f"{where}: expected a list of file names as {key}, got {names!r}")
        for name in names:
            image = image_path(folder, {"file_path": name}, where)
            if image not in pictures:
                raise FormatError(f"{where}: {key} names {name}, which is not one of the frames")
            if split_of.get(image) == "train":
                log.warning(
                    "%s: %s is in train and in %s: it is held out of the training", where, name, split
                )
            split_of[image] = split
    return split_of


def _intrinsics(keys: dict[str, Any], where: Path) -> Intrinsics:
    """Return a frame's intrinsics; `keys` are the file's, overridden by the frame's own."""
    try:
        return Intrinsics(
            int(keys["w"]),
            int(keys["h"]),
            float(keys["fl_x"]),
            float(keys.get("fl_y", keys["fl_x"])),
            float(keys["cx"]),
            float(keys["cy"]),
            distortion_of(keys, where),
            float(keys.get("skew", 0.0)),
        )
    except KeyError as error:
        raise FormatError(f"{where}: {error} is missing") from error
    except (TypeError, ValueError, OverflowError) as error:
        raise FormatError(f"{where}: the intrinsics are not valid: {error}") from error
