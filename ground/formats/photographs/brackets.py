"""Photographs in exposure brackets: which belong together, and pictures of one exposure for finding features."""

import dataclasses
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import imagecodecs
import numpy as np
from scipy.spatial.transform import Rotation

from ground.formats.axes import rigid_inverse
from ground.formats.pictures.view import View, colours_of, grey_light, has_display_values, read_image
from ground.formats.pictures.views import EQUAL_EXPOSURES
from obbgs_base.files import write_whole
from obbgs_base.srgb import to_srgb

LONGEST_BREAK_S = 5.0  # between the frames of a bracket, where times are known
WHOLE = 0.8  # share of the brackets that must have every exposure
# radians between views of one place, and the same of their distance as a share of how far all views are apart
SAME_PLACE = 0.003
CLIPPED = 0.98  # of full scale: brighter pixels may be saturated
BRIGHT, SHOWN_AS = (
    0.995,
    0.8,
)  # the light that so many pixels do not exceed, and the light value at which it is shown


def alike(views: Sequence[View]) -> bool:
    """Return whether all have one exposure time."""
    times_s = [view.exposure_time_s for view in views]
    return max(times_s) <= (1 + EQUAL_EXPOSURES) * min(times_s)


def in_brackets(views: Sequence[View]) -> list[View]:
    """Return pictures in the order of `brackets_of`, each with its bracket."""
    return [view for group in brackets_of(views) for view in group] if views else []


def brackets_of(views: Sequence[View]) -> list[list[View]]:
    """Return the views in groups that were taken from one place, numbered as brackets; each alone where none are seen.

    In the order of their times, or of their names where not all tell a time, a bracket ends where an exposure time
    comes again or nothing was taken for five seconds. Most brackets must then have the same two or more exposure times
    in the same order: automatic exposure does not look like that.
    """
    in_order = sorted(views, key=lambda view: (view.mid_exposure_utc_ns or 0, view.image.name))
    groups: list[list[View]] = []
    for view in in_order:
        if groups and not _begins(groups[-1], view):
            groups[-1].append(view)
        else:
            groups.append([view])
    patterns = Counter(tuple(_rounded(view) for view in group) for group in groups)
    pattern, whole = patterns.most_common(1)[0]
    if len(pattern) < 2 or whole < max(2, WHOLE * len(groups)):
        return [[view] for view in views]
    return [
        [dataclasses.replace(view, bracket=number, bracket_index=index) for index, view in enumerate(group)]
        for number, group in enumerate(groups)
    ]


def in_brackets_of_places(views: Sequence[View]) -> list[View]:
    """Return pictures with known cameras with their brackets, where each bracket was taken from one place.

    As they are where they state brackets or splits, or where exposures of a pattern come from different places.
    """
    if any(view.bracket is not None or view.split is not None for view in views):
        return list(views)
    brackets = brackets_of(views)
    centres = np.stack([rigid_inverse(view.world_to_camera)[:3, 3] for view in views])
    nearest = SAME_PLACE * float(np.ptp(centres, axis=0).max())
    if all(_of_one_place(bracket, nearest) for bracket in brackets):
        return [view for bracket in brackets for view in bracket]
    return list(views)


def _of_one_place(bracket: Sequence[View], nearest: float) -> bool:
    """Return whether the cameras of a bracket lie as near to its first and are turned as little as SAME_PLACE asks."""
    first, *others = (rigid_inverse(view.world_to_camera) for view in bracket)
    return all(
        Rotation.from_matrix(first[:3, :3].T @ other[:3, :3]).magnitude() <= SAME_PLACE
        and np.linalg.norm(other[:3, 3] - first[:3, 3]) <= nearest
        for other in others
    )


def write_for_features(folder: Path, brackets: Sequence[Sequence[View]]) -> None:
    """Write one grey picture of each bracket, named by `feature_name`, all of one exposure, as display values.

    Each pixel is the mean of the light in the frames in which it is not saturated, weighted with exposure times.
    """
    folder.mkdir(parents=True, exist_ok=True)
    white = float(np.median([np.quantile(_light(group), BRIGHT) for group in brackets])) / SHOWN_AS or 1.0
    for group in brackets:
        shown = np.rint(255 * to_srgb(np.clip(_light(group) / white, 0, 1))).astype(np.uint8)
        write_whole(folder / feature_name(group), bytes(imagecodecs.png_encode(shown, level=1)))


def feature_name(group: Sequence[View]) -> str:
    """Return the name of the picture that stands for a bracket when features are sought."""
    return f"{group[0].image.name}.png"


def _light(group: Sequence[View]) -> np.ndarray:
    """Return the light per second [H, W] that the frames of a bracket show together, float32."""
    total = weight = np.zeros(1)
    shortest = min(view.exposure_time_s for view in group)
    images = [read_image(view) for view in group]
    top = max(float(image.max()) for image in images) or 1.0  # cameras of 12 bits do not reach 65535
    for view, image in zip(group, images, strict=True):
        full = 255.0 if image.dtype == np.uint8 else top
        good = (image[..., : colours_of(image)] < CLIPPED * full).all(axis=2)
        good |= view.exposure_time_s == shortest
        total = total + good * grey_light(image, has_display_values(image), full)
        weight = weight + good * view.exposure_time_s
    return (total / weight).astype(np.float32)


def _begins(group: Sequence[View], view: View) -> bool:
    """Return whether a view begins a new bracket after the last one's frames."""
    if any(_rounded(view) == _rounded(other) for other in group):
        return True
    before, now = group[-1].mid_exposure_utc_ns, view.mid_exposure_utc_ns
    return before is not None and now is not None and now - before > LONGEST_BREAK_S * 1e9


def _rounded(view: View) -> float:
    return float(f"{view.exposure_time_s:.2g}")
