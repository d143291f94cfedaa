"""Pictures as other people's files: the header is looked at first, and one decoder is chosen by suffix and first bytes.

Values are as stored: 8 or 16 bits, or floats (EXR, HDR, FITS, TIFF), which are linear in light. What a header says of
exposure and time comes with it; `exposures` makes light of it.
"""

import contextlib
import importlib
import math
import os
import re
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any

import imagecodecs
import numpy as np

from ground.session.folder import SessionError
from obbgs_base.errors import reason

MOST_PX = 8192  # a side, that of a session's camera
MOST_FILE_BYTES = 1 << 30
LONGEST_HDR_HEADER = 1 << 14  # bytes
FIRST_BYTES = {
    "png": (b"\x89PNG\r\n\x1a\n",),
    "jpeg": (b"\xff\xd8\xff",),
    "bmp": (b"BM",),
    "webp": (b"RIFF",),
    "tiff": (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+"),
    "dng": (b"II*\0", b"MM\0*"),
    "exr": (b"v/1\x01",),
    "hdr": (b"#?RADIANCE", b"#?RGBE"),
    "fits": (b"SIMPLE  =",),
}
KINDS = {
    ".png": "png",
    **dict.fromkeys((".jpg", ".jpeg"), "jpeg"),
    ".bmp": "bmp",
    ".webp": "webp",
    **dict.fromkeys((".tif", ".tiff"), "tiff"),
    ".dng": "dng",
    ".exr": "exr",
    **dict.fromkeys((".hdr", ".pic"), "hdr"),
    **dict.fromkeys((".fits", ".fit", ".fts"), "fits"),
}
HDR_SIZE = re.compile(rb"\n-Y (\d{1,6}) \+X (\d{1,6})\n")
EXIF_IFD, EXIF_TIME_S, EXIF_F_NUMBER, EXIF_ISO, EXIF_ISO_SPEED = 0x8769, 0x829A, 0x829D, 0x8827, 0x8833
EXIF_SHUTTER, EXIF_APERTURE, ORIENTATION = 0x9201, 0x9202, 0x0112
EXIF_TAKEN, EXIF_SUBSECONDS, EXIF_ZONE = 0x9003, 0x9291, 0x9011
MOST_CHANNELS, MOST_BITS = 4, 64
MOST_VALUES = 1 << 30  # of all channels
TIFF_COLOURS = (0, 1, 2)  # white is zero, black is zero, RGB
LARGEST_APEX = 64.0
FITS_TIME_S = ("EXPTIME", "EXPOSURE", "EXPOSURE_DURATION", "EXPOSURE DURATION")


class FormatError(SessionError):
    """A folder is not in the expected format; the message names the file."""


@dataclass(frozen=True)
class Light:
    """What says how much of the light a picture holds; None where nothing says it."""

    time_s: float | None = None
    iso: float | None = None
    f_number: float | None = None
    gain: float | None = None  # of the sensor, in whatever unit the camera has
    taken_utc_ns: int | None = (
        None  # the beginning, by the camera's own clock, taken for UTC where it states no zone
    )
    middle_utc_ns: int | None = None  # of the exposure


@dataclass(frozen=True)
class Header:
    """What is known of a picture before it is decoded."""

    width: int
    height: int
    light: Light = field(default_factory=Light)
    orientation: int = 1  # EXIF's; 1: as stored


def within(folder: Path, name: str, where: object) -> Path:
    """Return the path of a file that a data set names, which lies in the data set's folder.

    Backslashes of Windows are understood. Links are followed; they must lead to a place in the folder too.

    Raises:
        FormatError: it is absolute and elsewhere, or leads out of the folder.
    """
    if "\0" in name:
        raise FormatError(f"{where}: a file name holds a byte 0: {name!r}")
    given = PurePosixPath(name)
    if "\\" in name and not (folder / name).exists():
        given = PurePosixPath(PureWindowsPath(name).as_posix())
    path = folder / given
    inside = Path(os.path.realpath(path)).is_relative_to(os.path.realpath(folder))
    if not inside:
        raise FormatError(
            f"{where}: {name} leads out of the data set's folder {folder}; copy the file into it and name it "
            "relative to the folder"
        )
    return path


def pictures_in(folder: Path) -> list[str]:
    """Return the names of the pictures in a folder, sorted, without hidden files.

    Raises:
        FormatError: it is no folder.
    """
    if not folder.is_dir():
        raise FormatError(f"{folder} is not a folder: expected one with pictures")
    names = (path.name for path in folder.iterdir() if path.suffix.lower() in KINDS)
    return sorted(name for name in names if not name.startswith("."))


def read_header(path: Path) -> Header:
    """Return size, exposure and time of a picture, without decoding it.

    Raises:
        FormatError: it is missing, of another kind than its suffix says, too large, or damaged.
    """
    kind = _kind(path)
    with _named(path):
        header = _HEADERS[kind](path)
    if not (1 <= header.width <= MOST_PX and 1 <= header.height <= MOST_PX):
        raise FormatError(
            f"{path}: expected at most {MOST_PX} pixels a side, got {header.width}x{header.height}; make it smaller"
        )
    return header


def image_size(path: Path) -> tuple[int, int]:
    """Return width and height of a picture, without decoding it.

    Raises:
        FormatError: as `read_header`.
    """
    header = read_header(path)
    return header.width, header.height


def decode(path: Path) -> np.ndarray:
    """Return a picture [H, W, 1 to 4], uint8, uint16 or float32 with values of at least 0.

    Raises:
        FormatError: as `read_header`, or it is cut off, or holds other numbers.
    """
    header = read_header(path)
    with _named(path):
        image = np.asarray(_DECODERS[_kind(path)](path))
    if image.dtype == bool:
        image = image.astype(np.uint8) * 255
    if image.dtype.kind == "f":
        if not np.isfinite(image).all():
            raise FormatError(f"{path}: holds {np.sum(~np.isfinite(image))} values that are not finite")
        image = np.maximum(image, 0).astype(np.float32)  # below black there is no light
    if image.dtype not in (np.uint8, np.uint16, np.float32) or image.ndim not in (2, 3):
        raise FormatError(
            f"{path}: expected a picture of 8 or 16 bits or of floats, got {image.dtype} {image.shape}"
        )
    image = image.reshape(*image.shape[:2], -1)
    if image.shape[:2] != (header.height, header.width) or image.shape[2] > 4:
        raise FormatError(f"{path}: its header says {header.width}x{header.height}, it has {image.shape}")
    return image


def _kind(path: Path) -> str:
    try:
        if path.exists() and not path.is_file():  # a pipe would keep us waiting
            raise FormatError(f"{path}: the picture cannot be read: it is no file")
        with open(path, "rb") as file:
            start = file.read(16)
        size = path.stat().st_size
    except OSError as error:
        raise FormatError(f"{path}: the picture cannot be read: {reason(error)}") from error
    if not start:
        raise FormatError(
            f"{path}: the picture is an empty file, as an interrupted copy leaves; copy it again"
        )
    if size > MOST_FILE_BYTES:
        raise FormatError(f"{path}: expected at most {MOST_FILE_BYTES >> 30} GiB a picture, got {size} bytes")
    kind = KINDS.get(path.suffix.lower())
    if kind is None:
        hint = (
            "; convert PDS pictures to FITS or TIFF"
            if path.suffix.lower() in (".img", ".lbl", ".xml")
            else ""
        )
        raise FormatError(
            f"{path}: expected a picture that ends in {', '.join(KINDS)}, got {path.suffix!r}{hint}"
        )
    if not start.startswith(FIRST_BYTES[kind]):
        found = next((k for k, starts in FIRST_BYTES.items() if start.startswith(starts)), None)
        what = f"are those of {found.upper()}: rename it" if found else "are not: copy it again"
        raise FormatError(
            f"{path}: the picture cannot be read: its suffix says {kind.upper()}, its first bytes {what}"
        )
    return kind


@contextlib.contextmanager
def _named(path: Path):
    """Turn what a decoder raises into one line that names the picture."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    except (FormatError, ModuleNotFoundError):
        raise
    except MemoryError as error:
        raise FormatError(f"{path}: the picture needs more memory than there is; make it smaller") from error
    except Exception as error:  # every decoder has errors of its own
        text = str(error).splitlines()
        raise FormatError(
            f"{path}: the picture cannot be read: {text[0] if text else type(error).__name__}; it may be cut off or "
            "damaged: copy it again"
        ) from error


def _module(name: str) -> Any:
    """Return a module of the extra `pictures`, without which most pictures can be read."""
    return importlib.import_module(name)


def _number(value: Any) -> float | None:
    """Return a positive finite number of an EXIF entry or a header; None of anything else."""
    number = _real(value)
    return number if number is not None and 0 < number < math.inf else None


def _real(value: Any) -> float | None:
    """Return the number of an EXIF entry: a fraction, a pair that stands for one, or the first of several."""
    try:
        several: Any = value if isinstance(value, (tuple, list)) else (value,)
        return float(several[0]) / float(several[1]) if len(several) == 2 else float(several[0])
    except (TypeError, ValueError, ZeroDivisionError, IndexError, OverflowError):
        return None


def _light(exif: Any) -> Light:
    """Return what EXIF entries by number say; APEX values where the plain ones are missing."""

    def apex(tag: int) -> float | None:
        value = _real(exif.get(tag))
        return 2.0**value if value is not None and abs(value) < LARGEST_APEX else None

    shutter, aperture = apex(EXIF_SHUTTER), apex(EXIF_APERTURE)
    return Light(
        time_s=_number(exif.get(EXIF_TIME_S)) or (None if shutter is None else 1 / shutter),
        iso=_number(exif.get(EXIF_ISO)) or _number(exif.get(EXIF_ISO_SPEED)),
        f_number=_number(exif.get(EXIF_F_NUMBER)) or (None if aperture is None else math.sqrt(aperture)),
        taken_utc_ns=_taken_ns(exif.get(EXIF_TAKEN), exif.get(EXIF_SUBSECONDS), exif.get(EXIF_ZONE)),
    )


def _taken_ns(text: Any, subseconds: Any, zone: Any) -> int | None:
    """Return the time of EXIF entries; without a time zone that of UTC."""
    zone = str(zone or "").strip("\0 ") or "+00:00"
    try:
        taken = datetime.strptime(str(text).strip("\0 ") + zone, "%Y:%m:%d %H:%M:%S%z")
        digits = str(subseconds or "").strip("\0 ")
        return int(taken.timestamp()) * 10**9 + (int(digits[:9].ljust(9, "0")) if digits.isdecimal() else 0)
    except ValueError:
        return None


# --- headers ---


def _header_of_pillow(path: Path) -> Header:
    from PIL import Image

    try:
        with Image.open(path) as opened:
            exif = opened.getexif()
            orientation = exif.get(ORIENTATION, 1)
            light = _light({**exif, **exif.get_ifd(EXIF_IFD)})
            return Header(*opened.size, light, orientation if isinstance(orientation, int) else 1)
    except Image.DecompressionBombError as error:
        raise FormatError(f"{path}: expected at most {MOST_PX} pixels a side: {error}") from error


def _header_of_tiff(path: Path) -> Header:
    import tifffile

    with tifffile.TiffFile(path) as file:
        page = file.pages.first
        sizes = (page.imagewidth, page.imagelength, page.samplesperpixel, page.bitspersample)
        if not all(isinstance(size, int) for size in sizes):
            raise ValueError(f"expected whole numbers for width, height, channels and bits, got {sizes}")
        tags = {tag.code: tag.value for tag in page.tags.values()}
        exif = tags.get(EXIF_IFD)
        by_name = exif if isinstance(exif, dict) else {}
        numbered = {number: by_name.get(tifffile.TIFF.EXIF_TAGS[number]) for number in _EXIF_NUMBERS}
        if page.samplesperpixel > MOST_CHANNELS or page.bitspersample > MOST_BITS:
            raise ValueError(
                f"{page.samplesperpixel} values of {page.bitspersample} bits a pixel are too many"
            )
        light = _light({**tags, **{number: value for number, value in numbered.items() if value is not None}})
        return Header(page.imagewidth, page.imagelength, light)


def _header_of_dng(path: Path) -> Header:
    rawpy = _module("rawpy")

    light = _header_of_tiff(path).light
    with rawpy.imread(str(path)) as raw:
        return Header(raw.sizes.iwidth, raw.sizes.iheight, light)


def _header_of_exr(path: Path) -> Header:
    OpenEXR = _module("OpenEXR")

    with OpenEXR.File(str(path), header_only=True) as file:
        header = file.header()
        (left, top), (right, bottom) = header["dataWindow"]
        size = int(right) - int(left) + 1, int(bottom) - int(top) + 1
        if (values := size[0] * size[1] * len(header["channels"])) > MOST_VALUES:
            raise ValueError(f"{values} values in all its channels are too many")
        return Header(*size, Light(time_s=_number(header.get("expTime"))))


def _header_of_hdr(path: Path) -> Header:
    with open(path, "rb") as file:
        size = HDR_SIZE.search(file.read(LONGEST_HDR_HEADER))
    if size is None:
        raise ValueError("no line such as -Y 480 +X 640 in its header")
    return Header(int(size[2]), int(size[1]))


def _header_of_fits(path: Path) -> Header:
    fits = _module("astropy.io.fits")

    with fits.open(path, memmap=True) as opened:
        header = opened[_fits_picture(opened)].header
        common = opened[0].header
        shape = [header[f"NAXIS{i + 1}"] for i in range(header["NAXIS"])]
        if len(shape) not in (2, 3) or (len(shape) == 3 and shape[2] not in (1, 3)):
            raise ValueError(f"expected a picture of 1 or 3 planes, got axes of {shape}")

        def said(*names: str) -> Any:
            return next((h[name] for name in names for h in (header, common) if name in h), None)

        utc = str(said("TIMESYS") or "UTC").strip().upper() == "UTC"
        light = Light(
            time_s=_number(said(*FITS_TIME_S)),
            gain=_number(said("GAIN")),
            taken_utc_ns=_fits_time_ns(said("DATE-OBS", "DATE-BEG")) if utc else None,
            middle_utc_ns=_fits_time_ns(said("DATE-AVG")) if utc else None,
        )
        return Header(shape[0], shape[1], light)


def _fits_picture(opened: Any) -> int:
    """Return the number of the first unit of a FITS file that holds a picture."""
    for number, unit in enumerate(opened):
        if unit.is_image and unit.header.get("NAXIS", 0) >= 2:
            return number
    raise ValueError("it holds no picture")


def _fits_time_ns(text: Any) -> int | None:
    try:
        since = datetime.fromisoformat(str(text)).replace(tzinfo=UTC) - datetime(1970, 1, 1, tzinfo=UTC)
        return (since.days * 86400 + since.seconds) * 10**9 + since.microseconds * 1000
    except ValueError:
        return None


# --- pixels ---


def _pillow(path: Path) -> np.ndarray:
    from PIL import Image

    with Image.open(path) as opened:
        opened.load()  # raises where the file is cut off
        plain = opened if opened.mode in ("L", "LA", "RGB", "RGBA") else opened.convert(_mode(opened))
        return np.asarray(plain)


def _mode(opened: Any) -> str:
    if opened.mode == "1":
        return "L"
    return "RGBA" if "transparency" in opened.info or opened.mode in ("PA", "RGBa") else "RGB"


def _png(path: Path) -> np.ndarray:
    return imagecodecs.png_decode(path.read_bytes())


def _tiff(path: Path) -> np.ndarray:
    import tifffile

    with tifffile.TiffFile(path) as file:
        page = file.pages.first
        if page.photometric not in TIFF_COLOURS:
            raise ValueError(f"expected a TIFF of grey or RGB, got {page.photometric!r}")
        image = page.asarray()
        if page.planarconfig == 2 and image.ndim == 3:  # planes one after another
            image = np.moveaxis(image, 0, 2)
        if page.photometric == 0 and image.dtype.kind == "u":  # white is zero
            image = np.iinfo(image.dtype).max - image
        return image


def _dng(path: Path) -> np.ndarray:
    rawpy = _module("rawpy")

    with rawpy.imread(str(path)) as raw:
        return raw.postprocess(
            gamma=(1, 1),
            no_auto_bright=True,
            output_bps=16,
            user_wb=[1.0, 1.0, 1.0, 1.0],
            output_color=rawpy.ColorSpace.raw,
            user_flip=0,
        )


def _exr(path: Path) -> np.ndarray:
    OpenEXR = _module("OpenEXR")

    with OpenEXR.File(str(path)) as file:
        channels = {name: channel.pixels for name, channel in file.channels().items()}
    for names in ("RGBA", "RGB", "Y"):
        if names not in channels and set(names) <= channels.keys():  # the library puts most of them together
            channels[names] = np.stack([channels[name] for name in names], axis=2)
        if names in channels:
            image = channels[names].astype(np.float32)
            if names == "RGBA":  # colours are stored times alpha
                image[..., :3] /= np.where(image[..., 3:] > 0, image[..., 3:], 1)
            return image
    raise ValueError(f"expected channels R, G, B or Y, got {', '.join(channels)}")


def _hdr(path: Path) -> np.ndarray:
    return imagecodecs.rgbe_decode(path.read_bytes())


def _fits(path: Path) -> np.ndarray:
    fits = _module("astropy.io.fits")

    with fits.open(path, memmap=False) as opened:
        unit = opened[_fits_picture(opened)]
        data = np.asarray(unit.data)
        top_down = str(unit.header.get("ROWORDER", "BOTTOM-UP")).strip().upper() == "TOP-DOWN"
    if data.ndim == 3:  # planes one after another
        data = np.moveaxis(data, 0, 2)
    if not top_down:  # the standard counts rows from the bottom
        data = data[::-1]
    if data.dtype.kind == "i" and data.min() >= 0 and data.max() <= 65535:
        data = data.astype(np.uint16)
    elif data.dtype.kind in "iu" and data.dtype.itemsize > 2:
        data = data.astype(np.float64)
    elif data.dtype.kind == "i":
        data = np.maximum(data, 0).astype(np.uint16)
    return np.ascontiguousarray(data.astype(data.dtype.newbyteorder("=")))


_EXIF_NUMBERS = (
    EXIF_TIME_S,
    EXIF_F_NUMBER,
    EXIF_ISO,
    EXIF_SHUTTER,
    EXIF_APERTURE,
    EXIF_TAKEN,
    EXIF_SUBSECONDS,
    EXIF_ZONE,
)
_HEADERS: dict[str, Callable[[Path], Header]] = {
    **dict.fromkeys(("png", "jpeg", "bmp", "webp"), _header_of_pillow),
    "tiff": _header_of_tiff,
    "dng": _header_of_dng,
    "exr": _header_of_exr,
    "hdr": _header_of_hdr,
    "fits": _header_of_fits,
}
_DECODERS: dict[str, Callable[[Path], np.ndarray]] = {
    **dict.fromkeys(("jpeg", "bmp", "webp"), _pillow),
    "png": _png,
    "tiff": _tiff,
    "dng": _dng,
    "exr": _exr,
    "hdr": _hdr,
    "fits": _fits,
}
