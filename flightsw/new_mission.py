"""A mission file from the little that is known at first: orbits, the target's size, the camera's lens and colour."""

import logging
import math
import re
from datetime import UTC, datetime, timedelta
from pathlib import Path

from flightsw.icd.config import ConfigError, build, in_file, keys_below, parse_yaml, require
from flightsw.icd.mission import Mission
from flightsw.icd.ndm.orbit import two_lines
from flightsw.icd.ndm.text import MAX_NDM_BYTES, is_message
from obbgs_base.errors import reason
from obbgs_base.files import read_bounded, write_whole

EXAMPLE = Path(__file__).with_name(
    "example_mission.yaml"
)  # a copy of the project's mission.yaml, as tests check
log = logging.getLogger(__name__)

UNTIL_FIRST_TRIGGER = timedelta(hours=1)


def write_mission(
    out: Path,
    target_tle: Path,
    chaser_tle: Path,
    target_size_m: float,
    picture: str,
    focal_length_mm: float,
    pixel_pitch_um: float,
    start_utc: str | None = None,
) -> None:
    """Write the example with these figures, after reading it as every part does.

    Args:
        target_tle, chaser_tle: files with two lines, or three with a name, or with an OMM of CCSDS.
        target_size_m: largest dimension.
        picture: width and height, px, as 1024x1024, or 1024x1024x3 in colour; the line of sight meets its middle.
        start_utc: ISO 8601, or now; None: an hour from now.

    Raises:
        ConfigError: an option or an element is wrong, or `out` is there already or cannot be written.
    """
    size = re.fullmatch(r"(\d{1,9})x(\d{1,9})(x[13])?", picture)
    if size is None:
        raise ConfigError(
            "--picture",
            f"expected width and height in pixels, such as 1024x768, or 1024x768x3 in colour, got {picture!r}",
        )
    for option, value, least, most, unit in (
        ("--target-size", target_size_m, 0.01, 1000, "m"),
        ("--focal-length", focal_length_mm, 1, 100_000, "mm"),
        ("--pixel-pitch", pixel_pitch_um, 0.5, 100, "micrometres"),
    ):
        require(least <= value <= most, option, f"expected {least:g} to {most:g} {unit}, got {value:g}")
    width, height = int(size[1]), int(size[2])
    focal_px = 1e3 * focal_length_mm / pixel_pitch_um
    field_deg = 2 * math.degrees(math.atan(width / 2 / focal_px))
    if start_utc in (None, "now"):
        first = datetime.now(UTC) + (UNTIL_FIRST_TRIGGER if start_utc is None else timedelta(0))
        start_utc = first.strftime("%Y-%m-%dT%H:%M:%SZ")
    elements = {"target_tle": _elements(target_tle), "chaser_tle": _elements(chaser_tle)}
    text = EXAMPLE.read_text()
    text = re.sub(r"  # TanDEM-X .*\n", "", text)
    for key, two in elements.items():
        lines = "".join(f'    - "{line}"\n' for line in two)
        text = re.sub(rf"(  {key}:\n)(?:    - .*\n){{2}}", lambda m, lines=lines: m[1] + lines, text)
    lens = f"{focal_length_mm:g} mm / {pixel_pitch_um:g} um; {field_deg:.3g} degrees across {width} pixels"
    for key, value, remark in (
        ("start_utc", f'"{start_utc}"', "first bracket"),
        ("width", str(width), ""),
        ("height", str(height), ""),
        ("fx_px", f"{focal_px:.1f}", lens),
        ("fy_px", f"{focal_px:.1f}", ""),
        ("cx_px", f"{width / 2:g}", None),
        ("cy_px", f"{height / 2:g}", ""),
        ("channels", "3" if size[3] == "x3" else "1", None),
        ("target_extent_m", f"{target_size_m:g}", None),
    ):
        text = _set(text, key, value, remark)
    with (
        keys_below("--picture: width", "mission.camera.width"),
        keys_below("--picture: height", "mission.camera.height"),
        keys_below("--start", "mission.orbit.start_utc"),
        keys_below(str(target_tle), "mission.orbit.target_tle"),
        keys_below(str(chaser_tle), "mission.orbit.chaser_tle"),
    ):
        build(Mission, parse_yaml(text.encode(), "mission"), "mission")
    if out.exists():
        raise ConfigError(str(out), "exists already; choose another name, or remove it first")
    try:
        write_whole(out, text.encode())
    except OSError as error:
        why = f"cannot be written: {reason(error)}; give --out a file in a folder that is there"
        raise ConfigError(str(out), why) from error
    if _orbit(elements["target_tle"]) == _orbit(elements["chaser_tle"]):
        log.warning(
            "target and chaser have the same elements, so that they meet: give the chaser's own to --chaser-tle, which "
            "`hil scenario --fly-around METRES --mission %s` designs",
            out,
        )


def _orbit(elements: list[str]) -> tuple[str, str]:
    """Return the epoch and the orbit in two lines of elements, without the number of the object."""
    return elements[0][18:32], elements[1][8:63]


def _elements(path: Path) -> list[str]:
    """Return the two lines of elements in a file: as they are, with or without a name before, or of an OMM."""
    try:
        content = read_bounded(path, MAX_NDM_BYTES)
        with in_file(path):
            text = "\n".join(two_lines(content)) if is_message(content) else content.decode()
        lines = [line.rstrip() for line in text.splitlines() if line.strip()]
    except (OSError, UnicodeDecodeError) as error:
        why = reason(error) if isinstance(error, OSError) else "it is no text"
        raise ConfigError(str(path), f"cannot read the two-line elements: {why}") from error
    elements = lines[-2:]
    if len(lines) not in (2, 3) or any('"' in line or "\\" in line for line in elements):
        raise ConfigError(
            str(path),
            f"expected two lines of elements, with or without a name before, got {len(lines)} lines",
        )
    return elements


def _set(text: str, key: str, value: str, remark: str | None) -> str:
    """Return the file's text with another value of a key, also of one behind a #; a remark of None stays as it is."""
    match = re.search(rf"^  (?:# )?{key}: [^#\n]*?( *)(#.*)?$", text, re.MULTILINE)
    assert match is not None, f"the example has no {key}"
    line = f"  {key}: {value}"
    kept = (match[2] or "").removeprefix("# ") if remark is None else remark
    line = f"{line:<36} # {kept}" if kept else line
    return text[: match.start()] + line + text[match.end() :]
