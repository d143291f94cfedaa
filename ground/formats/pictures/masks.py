"""Masks in a folder of their own: pictures that are white where the target is, by the names of the pictures."""

import dataclasses
import logging
from collections.abc import Sequence
from pathlib import Path

from ground.formats.pictures.files import FormatError, pictures_in
from ground.formats.pictures.view import View
from obbgs_base.errors import counted

log = logging.getLogger(__name__)


def with_masks(views: Sequence[View], folder: Path | None) -> list[View]:
    """Return the views with the masks of a folder, or with their own where none is given.

    The mask of a.jpg is a.png or a.jpg.png, as COLMAP names it, or has another picture's suffix.

    Raises:
        FormatError: the folder lacks the mask of a picture, or two could be meant.
    """
    if folder is not None:
        by_name: dict[str, list[Path]] = {}
        for name in pictures_in(folder):
            by_name.setdefault(Path(name).stem, []).append(folder / name)
        found = [by_name.get(view.image.name) or by_name.get(view.image.stem, []) for view in views]
        if missing := [view.image.name for view, paths in zip(views, found, strict=True) if not paths]:
            raise FormatError(
                f"{folder}: no mask is there of {counted(len(missing), 'picture')}: {', '.join(missing[:5])}"
            )
        for view, paths in zip(views, found, strict=True):
            if len(paths) > 1:
                raise FormatError(
                    f"{folder}: two masks for {view.image.name}: {paths[0].name}, {paths[1].name}"
                )
        views = [dataclasses.replace(view, mask=paths[0]) for view, paths in zip(views, found, strict=True)]
    if count := sum(view.mask is not None for view in views):
        log.warning(
            "%d of %d pictures have masks: what a mask leaves out counts as background", count, len(views)
        )
    return list(views)
