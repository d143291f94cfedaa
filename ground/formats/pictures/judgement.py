"""What imported pictures are, judged on all of them: colours, bits, full scale, alpha, and brightness of borders."""

import logging
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from ground.formats.pictures.view import FULL_SCALE, View, colours_of, read_image
from obbgs_base.errors import counted

log = logging.getLogger(__name__)
DEPTHS = (8, 10, 12, 14, 16)  # bits that cameras have
FEWEST_PILED = 30  # pixels at the largest value, and so many times those at a value just below
TIMES_PILED = 20.0
NEAR_FULL = 0.95  # of a power of two: cameras of 12 bits end at 4095 or somewhat below
JUST_BELOW = 0.9  # of the largest value
BRIGHT_BORDER = 0.15  # of full scale: space is darker


@dataclass(frozen=True)
class Judgement:
    """What pictures are.

    channels: 1 or 3: of those with the most colours.
    display: whether they hold display values (colours of 8 bits) rather than light: what most of them do.
    bit_depth: of the readings.
    full_scale: the value of full scale of each type of numbers: at it a pixel is saturated.
    transparent: whether any pixel is.
    bright_borders: how many opaque pictures without a mask have a border that space does not have.
    border: the median over those pictures of their borders' medians, 0 to 1.
    """

    channels: int
    display: bool
    bit_depth: int
    full_scale: dict[str, float]
    transparent: bool
    bright_borders: int
    border: float


@dataclass
class _Seen:
    """What is counted of the pictures of one type of numbers."""

    pictures: int = 0
    top: float = 0.0
    at_top: Counter = field(default_factory=Counter)  # of each picture's largest value, by exposure time
    histogram: np.ndarray = field(default_factory=lambda: np.zeros(1 << 16, dtype=np.int64))


def judge(views: Sequence[View], on_view: Callable[[], None] = lambda: None) -> Judgement:
    """Return what some pictures are; what is unusual is logged.

    Raises:
        FormatError: one cannot be read, or has another size than its camera.
    """
    seen: dict[str, _Seen] = {}
    colours, transparent, borders = [], False, []
    for view in views:
        image = read_image(view)
        count = colours_of(image)
        colours.append((count, image.dtype.name))
        kind = seen.setdefault(image.dtype.name, _Seen())
        kind.pictures += 1
        values, top = image[..., :count], float(image[..., :count].max())
        kind.top = max(kind.top, top)
        if image.dtype.kind == "u":
            kind.histogram += np.bincount(values.reshape(-1), minlength=1 << 16)
            kind.at_top[(top, view.exposure_time_s)] += int((values == top).sum())
        masked = view.mask is not None
        if image.shape[2] > count:
            clear = bool((image[..., -1] < FULL_SCALE[image.dtype.name]).any())
            transparent |= clear
            masked |= clear
        if not masked:  # a mask or transparency says what the target is, also at the border
            borders.append(_border(values))
        on_view()
    return _judged(seen, colours, transparent, borders)


def _border(values: np.ndarray) -> tuple[str, float]:
    """Return the type of a picture and the median of its border's brightest colour."""
    rim = np.zeros(values.shape[:2], bool)
    rim[[0, -1]] = rim[:, [0, -1]] = True
    return values.dtype.name, float(np.median(values[rim].max(axis=1)))


def _judged(
    seen: dict[str, _Seen],
    colours: list[tuple[int, str]],
    transparent: bool,
    borders: list[tuple[str, float]],
) -> Judgement:
    common, number = Counter(colours).most_common(1)[0]
    if number < len(colours):
        kinds = ", ".join(f"{n} of {c} colours as {name}" for (c, name), n in Counter(colours).most_common())
        log.warning("the pictures are not all alike (%s): all are brought to one kind", kinds)
    full_scale, depth = {}, 8
    for name, kind in seen.items():
        full_scale[name], bits = _full_scale(name, kind)
        depth = max(depth, bits)
    bright = [value / full_scale[name] for name, value in borders]
    return Judgement(
        channels=max(count for count, _ in colours),
        display=common == (3, "uint8"),
        bit_depth=depth,
        full_scale=full_scale,
        transparent=transparent,
        bright_borders=sum(value > BRIGHT_BORDER for value in bright),
        border=float(np.median(bright)) if bright else 0.0,
    )


def _full_scale(name: str, seen: _Seen) -> tuple[float, int]:
    """Return the value of full scale of a type of numbers, and the bits of its readings.

    Values pile up at full scale. Where that is a little below a power of two, or the same at several exposure times, it
    is believed; a flat bright surface piles up too, but at one exposure and anywhere.
    """
    if name == "float32":
        log.warning(
            "floats in %s: full scale is their largest value, %.6g",
            counted(seen.pictures, "picture"),
            seen.top,
        )
        return seen.top or 1.0, 16
    top, most = int(seen.top), 255 if name == "uint8" else 65535
    if top == 0:  # nothing to tell it by
        return float(most), 8
    bits = 8 if name == "uint8" else next(bits for bits in DEPTHS if top < 1 << bits)
    exposures = {time_s for (value, time_s), count in seen.at_top.items() if value == top and count}
    near = name != "uint8" and top >= NEAR_FULL * ((1 << bits) - 1)
    piled = (near or len(exposures) > 1) and _piled_up(seen.histogram, top)
    full = top if piled else (1 << bits) - 1
    if full < most:
        log.warning(
            "no picture goes above %d of %d (%d pixels are exactly there): full scale is taken to be %d, %d bits",
            *(top, most, int(seen.histogram[top]), full, bits),
        )
    return float(full), bits


def _piled_up(histogram: np.ndarray, top: int) -> bool:
    """Return whether far more pixels have the largest value than values just below it: they are clipped."""
    below = histogram[int(JUST_BELOW * top) : top]
    usual = below.sum() / max(len(below), 1)
    return bool(histogram[top] >= FEWEST_PILED and histogram[top] > TIMES_PILED * usual)
