"""One picture to import with its camera, and its pixels."""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from ground.formats.pictures.files import FormatError, decode
from ground.formats.pictures.lens import Intrinsics
from obbgs_base.srgb import from_srgb

FULL_SCALE = {"uint8": 255.0, "uint16": 65535.0, "float32": 1.0}  # of alpha and masks, and of display values


@dataclass(frozen=True, eq=False)
class View:
    """One picture to import; what its format does not state has the default value."""

    image: Path
    world_to_camera: np.ndarray  # [4, 4], OpenCV axes
    intrinsics: Intrinsics
    exposure_time_s: float = 1.0  # proportional to light, as `exposures` makes it
    exposure_stated: bool = False  # whether anything states it
    mask: Path | None = None  # a picture that is white where the target is, for what else is in the picture
    mid_exposure_utc_ns: int | None = None
    bracket: int | None = None
    bracket_index: int = 0
    sun_dir_body: np.ndarray = field(default_factory=lambda: np.zeros(3))  # unit; zero where unknown
    in_eclipse: bool = False
    covariance: np.ndarray | None = None  # [6, 6] of the pose, as in a session's frames; None: not stated
    attitude_known: bool = True  # of the target; otherwise poses are in GCRS axes about it
    quat_inertial_to_body: np.ndarray | None = None  # [4] attitude of the target that the pose assumes, GCRS
    target_position_m: np.ndarray | None = None  # [3] of the target from the Earth's centre, GCRS
    split: str | None = None  # train, val or test; stated for all views or for none
    readings: Path | None = None  # of our own export: the digital numbers of the session that it was made of


def colours_of(image: np.ndarray) -> int:
    """Return how many colours a picture [H, W, 1 to 4] has beside its alpha: 1 or 3."""
    return 1 if image.shape[2] <= 2 else 3


def has_display_values(image: np.ndarray) -> bool:
    """Return whether a picture is one of colours of 8 bits, which are sRGB-coded unless someone says otherwise."""
    return image.dtype == np.uint8 and colours_of(image) == 3


def grey_light(image: np.ndarray, coded: bool, full_scale: float | None = None) -> np.ndarray:
    """Return the mean colour [H, W] of a picture as a share of full scale, proportional to light.

    Args:
        coded: whether the values are sRGB-coded.
        full_scale: None: of the picture's type of numbers, and of floats the largest value.
    """
    if full_scale is None:
        full_scale = (
            float(np.iinfo(image.dtype).max) if image.dtype.kind == "u" else float(image.max()) or 1.0
        )
    value = image[..., : colours_of(image)] / full_scale
    return (from_srgb(value) if coded else value).mean(axis=2)


def read_image(view: View) -> np.ndarray:
    """Return a view's picture [H, W, 1 to 4].

    Raises:
        FormatError: it cannot be read, or has another size than its camera.
    """
    image, lens = decode(view.image), view.intrinsics
    if image.shape[:2] != (lens.height, lens.width):
        raise FormatError(
            f"{view.image}: expected {lens.width}x{lens.height} pixels, got {image.shape[1]}x{image.shape[0]}"
        )
    return image


def read_mask(view: View) -> np.ndarray:
    """Return what a view's mask says of each pixel [H, W], 0 (not the target) to 1.

    Raises:
        FormatError: it cannot be read, or has another size than its picture.
    """
    assert view.mask is not None
    image, lens = decode(view.mask), view.intrinsics
    if image.shape[:2] != (lens.height, lens.width):
        raise FormatError(
            f"{view.mask}: expected a mask of {lens.width}x{lens.height} pixels, that of its picture, got "
            f"{image.shape[1]}x{image.shape[0]}"
        )
    full = FULL_SCALE[image.dtype.name]
    colours = image[..., : colours_of(image)].mean(axis=2) / full
    return colours if colours.max() > 1 / full else np.minimum(1.0, colours * full)  # masks of 0 and 1 too
