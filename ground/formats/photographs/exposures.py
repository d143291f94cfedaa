"""How much of the light each picture holds: from its own header, from a table, or estimated from the pictures.

Light is the product of exposure time, sensitivity (ISO or gain) and the area of the aperture. A session has one number
for it, its exposure time: that of a camera with the sensitivity and aperture that most of the pictures have.
"""

import csv
import dataclasses
import functools
import logging
import math
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Literal

import numpy as np

from flightsw.icd.config import in_file
from flightsw.icd.ndm.text import Value
from flightsw.icd.ndm.times import parse_epoch, utc_ns
from ground.formats.photographs.epipolar import matched_points
from ground.formats.pictures.files import FormatError, Light, pictures_in, read_header
from ground.formats.pictures.view import View, colours_of, grey_light, has_display_values, read_image
from ground.formats.pictures.views import Values, unposed
from obbgs_base.errors import counted, reason

log = logging.getLogger(__name__)
COLUMNS = ("name", "exposure_time_s", "iso", "f_number", "gain", "mid_exposure_utc")
LARGEST_TABLE = 1 << 24  # bytes
PATCH_PX = 2  # around a feature, on every side, whose mean is compared
DARKEST, BRIGHTEST = 0.02, 0.95  # of full scale: values that are compared
PICTURES_KEPT = 16  # in memory
LEAST_DEVIATION = 0.05  # of the logarithm of a ratio: surfaces are not matt
USUAL_SPREAD = 1.0  # of logarithms of gains
ROUNDS = 20
FEWEST_POINTS = 8  # of a pair of pictures
UNKNOWN = "unknown"


def read_table(path: Path) -> dict[str, Light]:
    """Return what a CSV file says of each picture, by its file name without folders.

    The first line names the columns: name, and exposure_time_s, iso, f_number, gain or mid_exposure_utc (ISO 8601), of
    which some may be left out.

    Raises:
        FormatError: it cannot be read, has another column, names a picture twice, or a value is no positive number.
    """
    try:
        if path.stat().st_size > LARGEST_TABLE:
            raise FormatError(f"{path}: expected a table of at most {LARGEST_TABLE >> 20} MiB")
        rows = list(csv.reader(path.read_text(encoding="utf-8-sig").splitlines(), strict=True))
    except UnicodeDecodeError as error:
        raise FormatError(
            f"{path}: byte {error.start} is no text in UTF-8; expected a table of comma-separated values"
        ) from error
    except (OSError, csv.Error) as error:
        raise FormatError(f"{path}: the table cannot be read: {reason(error)}") from error
    names = [name.strip() for name in rows[0]] if rows else []
    unknown = next((f"; there is no column {name!r}" for name in names if name not in COLUMNS), "")
    if "name" not in names or len(names) < 2 or unknown or len(set(names)) < len(names):
        raise FormatError(
            f"{path}: expected a first line with name and some of {', '.join(COLUMNS[1:])}, got "
            f"{','.join(names)!r}{unknown}"
        )
    table: dict[str, Light] = {}
    for number, row in enumerate(rows[1:], start=2):
        if not row:
            continue
        if len(row) != len(names):
            raise FormatError(f"{path}, line {number}: expected {len(names)} values, got {len(row)}")
        values = {name: text.strip() for name, text in zip(names, row, strict=True)}
        picture = Path(values.pop("name").replace("\\", "/")).name
        if picture in table:
            raise FormatError(f"{path}, line {number}: {picture} is listed twice")
        taken = values.pop("mid_exposure_utc", None)
        entries = {name: _positive(text, f"{path}, line {number}: {name}") for name, text in values.items()}
        known = {"time_s" if name == "exposure_time_s" else name: value for name, value in entries.items()}
        middle = None if taken is None else _utc_ns(taken, f"{path}, line {number}: mid_exposure_utc")
        table[picture] = dataclasses.replace(Light(), **known, middle_utc_ns=middle)
    return table


def with_exposures(views: Sequence[View], table: dict[str, Light] | None = None) -> list[View]:
    """Return the views with the exposure times, and the times of exposure, that the table or the pictures state.

    What a data set itself states stays, unless there is a table. What is found, or that nothing is, is logged.

    Raises:
        FormatError: the table lacks a picture, or gains differ without a table, whose unit is not known.
    """
    headers = {view.image: read_header(view.image) for view in views}
    if turned := sum(header.orientation != 1 for header in headers.values()):
        log.warning(
            "files say of %s to show them turned; cameras are taken to be of the pixels as stored",
            counted(turned, "picture"),
        )
    if table is not None:
        missing = [view.image.name for view in views if view.image.name not in table]
        if missing and len(missing) == len(views):
            named = (
                f"none of the {len(views)} pictures: it has {next(iter(table))}" if table else "no picture"
            )
            raise FormatError(f"the table of exposures names {named}, and the first picture is {missing[0]}")
        if missing:
            raise FormatError(
                f"the table of exposures lacks {counted(len(missing), 'picture')}: {', '.join(missing[:5])}"
            )
        lights = [table[view.image.name] for view in views]
        if all(light == Light(middle_utc_ns=light.middle_utc_ns) for light in lights):
            lights = [headers[view.image].light for view in views]  # the table tells times only
    elif all(view.exposure_stated for view in views):
        return list(views)
    else:
        lights = [headers[view.image].light for view in views]
        if len({light.gain for light in lights}) > 1:
            raise FormatError(
                "the pictures' headers state gains that differ, in a unit that they do not state: give "
                "--exposures FILE.csv with the columns name,exposure_time_s,gain (times of light)"
            )
        lights = [dataclasses.replace(light, gain=None) for light in lights]
    timed = _with_times(views, [headers[view.image].light for view in views], table or {})
    unknown = [view.image.name for view, light in zip(views, lights, strict=True) if not _says(light, table)]
    if len(unknown) == len(views) and table is None:
        log.warning(
            "nothing states the pictures' exposure times: all count as 1 s; give --exposures FILE.csv, or "
            "--exposures unknown to estimate them"
        )
        return timed
    if unknown:
        log.warning(
            "%d of %d pictures state no exposure time (%s): all count as 1 s; give --exposures FILE.csv, or "
            "--exposures unknown to estimate them",
            *(len(unknown), len(views), ", ".join(unknown[:5])),
        )
        return timed
    seconds = light_s(lights)
    log.info("exposure times of %d pictures: %s", len(views), described(seconds))
    return [
        dataclasses.replace(view, exposure_time_s=time_s, exposure_stated=True)
        for view, time_s in zip(timed, seconds, strict=True)
    ]


def unposed_pictures(folder: Path, table: dict[str, Light] | None) -> list[View]:
    """Return the pictures of a folder, or of images/ in it, as in `unposed` and `with_exposures`."""
    pictures = folder / "images" if (folder / "images").is_dir() else folder
    return with_exposures([unposed(pictures / name) for name in pictures_in(pictures)], table)


def middle_utc_ns(image: Path, stated: Literal["start", "middle"], row: Light | None) -> int:
    """Return the middle of a picture's exposure, by its row of a table or by the picture.

    Args:
        stated: what the picture's own time is of, unless it says that itself.

    Raises:
        FormatError: neither states a time.
    """
    if row is not None and row.middle_utc_ns is not None:
        return row.middle_utc_ns
    light = read_header(image).light
    if light.middle_utc_ns is not None:
        return light.middle_utc_ns
    if light.taken_utc_ns is None:
        raise FormatError(
            f"{image}: states no time (EXIF DateTimeOriginal, FITS DATE-OBS); give --exposures FILE.csv with the "
            "columns name,mid_exposure_utc"
        )
    if stated == "middle":
        return light.taken_utc_ns
    seconds = (row.time_s if row is not None else None) or light.time_s or 0.0
    return light.taken_utc_ns + round(seconds * 5e8)


def light_s(lights: Sequence[Light]) -> list[float]:
    """Return exposure times, s, proportional to light: at the sensitivity and aperture that most pictures have.

    Where only some pictures state an ISO, an F-number or a gain, the others are taken to have the commonest.
    """
    usual = {
        name: Counter(value for light in lights if (value := getattr(light, name)) is not None).most_common(1)
        for name in ("iso", "f_number", "gain")
    }

    def ratio(light: Light, name: str) -> float:
        value = getattr(light, name)
        return 1.0 if value is None else value / usual[name][0][0]

    return [
        (light.time_s or 1.0) * ratio(light, "iso") * ratio(light, "gain") / ratio(light, "f_number") ** 2
        for light in lights
    ]


def described(seconds: Sequence[float]) -> str:
    """Return how often each exposure time occurs, in ms, in one line."""
    counts = sorted(Counter(float(f"{1e3 * time_s:.4g}") for time_s in seconds).items())
    shown = [f"{count} of {ms:g} ms" for ms, count in counts[:8]]
    return ", ".join(shown) + (", ..." if len(counts) > 8 else "")


def estimated(
    views: Sequence[View], values: Values | None, on_view: Callable[[], None] = lambda: None
) -> list[View]:
    """Return the views with an exposure time each that features say which neighbours share, the longest of 1 s.

    Two pictures show the same points equally bright but for their exposures: the median of the ratios of the light
    about shared features is their ratio, and all ratios together give one gain a picture. Surfaces that shine break
    that assumption. Pictures that share too little with others take the mean, which is logged.

    Args:
        values: what the pixel values stand for; None: sRGB-coded where pictures have colours of 8 bits.

    Raises:
        FormatError: no two pictures share enough, or a picture cannot be read.
    """

    brightest = _brightest(views)

    @functools.lru_cache(PICTURES_KEPT)
    def light(number: int) -> np.ndarray:
        image = read_image(views[number])
        coded = has_display_values(image) if values is None else values is not Values.LINEAR
        return grey_light(image, coded, brightest[image.dtype.name]).astype(np.float32)

    shared: list[tuple[int, int, float, float]] = []  # two pictures, logarithm of their ratio, its deviation
    for pair in matched_points(views, on_view):
        one, other = (
            _at(light(i), at, views[i])
            for i, at in ((pair.first, pair.at_first), (pair.second, pair.at_second))
        )
        good = (np.minimum(one, other) > DARKEST) & (np.maximum(one, other) < BRIGHTEST)
        if good.sum() >= FEWEST_POINTS:
            ratios = np.log(one[good] / other[good])
            scatter = float(np.median(np.abs(ratios - np.median(ratios))))
            deviation = max(LEAST_DEVIATION, 2 * scatter / math.sqrt(good.sum()))
            shared.append((pair.first, pair.second, float(np.median(ratios)), deviation))
    if not shared:
        raise FormatError(
            "no two pictures share enough features to estimate exposures; give --exposures FILE.csv"
        )
    gains = _gains(len(views), shared)
    connected = {number for first, second, *_ in shared for number in (first, second)}
    if alone := [view.image.name for number, view in enumerate(views) if number not in connected]:
        log.warning(
            "of %s too little is seen in others to estimate exposures, and the mean of all is taken: %s",
            *(counted(len(alone), "picture"), ", ".join(alone[:5])),
        )
    seconds = (gains / gains.max()).tolist()
    log.warning("exposures were estimated, the longest called 1 s: %s", described(seconds))
    return [
        dataclasses.replace(view, exposure_time_s=time_s, exposure_stated=True)
        for view, time_s in zip(views, seconds, strict=True)
    ]


def _gains(count: int, shared: list[tuple[int, int, float, float]]) -> np.ndarray:
    """Return the gains [count] that explain ratios of pairs by least absolute deviations, as some may be far off.

    Logarithms of gains are taken to scatter by `USUAL_SPREAD` about their mean, so that errors do not add up along a
    chain of pictures without end.
    """
    first, second = (np.array([pair[k] for pair in shared]) for k in (0, 1))
    ratio, deviation = (np.array([pair[k] for pair in shared]) for k in (2, 3))
    system = np.zeros((len(shared), count))
    system[np.arange(len(shared)), first], system[np.arange(len(shared)), second] = 1.0, -1.0
    logs, weights = np.zeros(count), 1 / deviation**2
    for _ in range(ROUNDS):
        normal = system.T @ (weights[:, None] * system) + np.eye(count) / USUAL_SPREAD**2
        logs = np.linalg.solve(normal, system.T @ (weights * ratio))
        weights = 1 / (deviation * np.maximum(np.abs(system @ logs - ratio), deviation))
    return np.exp(logs)


def _positive(text: str, where: str) -> float:
    try:
        value = float(text)
    except ValueError as error:
        raise FormatError(f"{where}: expected a number, got {text!r}") from error
    if not 0 < value < math.inf:
        raise FormatError(f"{where}: expected a positive number, got {text}")
    return value


def _says(light: Light, table: dict[str, Light] | None) -> bool:
    """Return whether enough is said: the exposure time; in a table a gain or an ISO alone will do."""
    return light.time_s is not None or (table is not None and (light.gain or light.iso) is not None)


def _utc_ns(text: str, where: str) -> int:
    with in_file(where):
        return utc_ns(parse_epoch(Value(text, "UTC"), "UTC"))


def _with_times(views: Sequence[View], lights: Sequence[Light], table: dict[str, Light]) -> list[View]:
    """Return the views with the times at which they were taken, where the table or all pictures say that."""
    times = [light.taken_utc_ns for light in lights]
    if all(view.image.name in table and table[view.image.name].middle_utc_ns is not None for view in views):
        times = [table[view.image.name].middle_utc_ns for view in views]
    if any(time is None for time in times) or any(view.mid_exposure_utc_ns is not None for view in views):
        return list(views)
    return [
        dataclasses.replace(view, mid_exposure_utc_ns=time) for view, time in zip(views, times, strict=True)
    ]


def _brightest(views: Sequence[View]) -> dict[str, float]:
    """Return the largest value of all pictures by their type of numbers; full scale of 8 bits, which they reach."""
    brightest = {"uint8": 255.0}
    for view in views:
        image = read_image(view)
        if (name := image.dtype.name) != "uint8":
            brightest[name] = max(brightest.get(name, 1e-9), float(image[..., : colours_of(image)].max()))
    return brightest


def _at(light: np.ndarray, at: np.ndarray, view: View) -> np.ndarray:
    """Return the mean light around points [M, 2] px of the pinhole picture; 0 where it is dark or outside."""
    import cv2

    lens = view.intrinsics
    K = np.array(lens.K)
    if not lens.is_pinhole:
        rays = np.column_stack([(at - K[:2, 2]) / [K[0, 0], K[1, 1]], np.ones(len(at))])
        at = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), K, np.array(lens.distortion))[0][:, 0]
        at[:, 0] += lens.skew_px / lens.fy_px * (at[:, 1] - lens.cy_px)
    mean = cv2.blur(light, (2 * PATCH_PX + 1, 2 * PATCH_PX + 1))
    u, v = np.floor(at).astype(int).T
    inside = (u >= 0) & (v >= 0) & (u < lens.width) & (v < lens.height)
    return np.where(inside, mean[np.clip(v, 0, lens.height - 1), np.clip(u, 0, lens.width - 1)], 0.0)
