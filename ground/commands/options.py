"""Options that several commands of `ground` share, and the choices that its help lists."""

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from flightsw.icd.link.auth import Key
from flightsw.icd.mission import METHODS, VARIANTS, ConfigError
from obbgs_base.command_line import KEY_HELP, MISSION_HELP, SEED_HELP, SET_HELP
from obbgs_base.errors import reason

SessionDir = Annotated[Path, typer.Option("--session", help="The session folder.")]
RunName = Annotated[str, typer.Option("--name", help="The run's name: its folder below runs/.")]
RunAt = Annotated[
    Path,
    typer.Argument(
        metavar="RUN", help="A run's folder, such as pass-12/runs/first, or a session: its newest run."
    ),
]
ListenKey = Annotated[
    Path | None,
    typer.Option(
        "--key",
        help=f"{KEY_HELP}: a spacecraft with a key believes no other listener that it has stored a frame. Default: "
        "mission.key if it is there.",
    ),
]


def listening_key(file: Path | None) -> Key | None:
    """Return the key of a listener; None where no file is named and mission.key is not there.

    Raises:
        ConfigError: the file cannot be read, or holds no key.
    """
    path = file or Path("mission.key")
    if file is None and not path.exists():
        return None
    try:
        return Key.parse(path.read_text(), str(path))
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(str(path), f"cannot read the key: {reason(error)}") from error


def workers_at(given: str | None) -> tuple[str | None, int | None]:
    """Return the dask scheduler and the number of processes that --workers asks for, one of them or none."""
    if given is not None and "://" in given:
        return given, None
    if given is not None and not (given.isascii() and given.isdigit() and int(given) > 0):
        raise ValueError(
            f"--workers: expected a number of at least 1 or a URL such as tls://10.0.0.1:8786, got {given!r}"
        )
    return None, None if given is None else int(given)


class Quality(StrEnum):
    """How many steps and Gaussians a training may use."""

    DRAFT = "draft"
    STANDARD = "standard"
    BEST = "best"


class AttitudeChoice(StrEnum):
    """Where the target's attitude comes from, as `ground.run.reconstruct.AttitudeSource`."""

    AUTO = "auto"
    TAGGED = "tagged"
    UNKNOWN = "unknown"


class ImportFormat(StrEnum):
    """Formats that a session can be made from."""

    NERF = "nerf"
    NERFSTUDIO = "nerfstudio"
    COLMAP = "colmap"
    SHIRT = "shirt"
    LLFF = "llff"
    MIDDLEBURY = "middlebury"
    NDM = "ndm"
    SPICE = "spice"
    IMAGES = "images"
    VIDEO = "video"


class PixelValues(StrEnum):
    """What the values of imported pictures stand for, as `ground.formats.pictures.views.Values`."""

    LINEAR = "linear"
    DISPLAY = "display"
    DECODE = "decode"


class Background(StrEnum):
    """What transparent pictures are put on."""

    BLACK = "black"
    WHITE = "white"


class PoseChoice(StrEnum):
    """What is done about stated cameras that their pictures contradict."""

    CHECK = "check"
    MEND = "mend"
    STATED = "stated"


class ExportFormat(StrEnum):
    """Formats that a session can be written in."""

    NERF = "nerf"
    NERFSTUDIO = "nerfstudio"
    COLMAP = "colmap"
    NDM = "ndm"


class MeshFormatName(StrEnum):
    """Formats of meshes."""

    GLB = "glb"
    OBJ = "obj"
    STL = "stl"
    PLY = "ply"


class UplinkCommand(StrEnum):
    """The commands that the spacecraft obeys."""

    PING = "ping"
    BRACKET = "bracket"
    NEAR = "near"
    PRIORITY = "priority"
    MODEL = "model"
    ARM = "arm"
    DELETE = "delete"
    SAFE = "safe"
    RESUME = "resume"
    RETIRE = "retire"
    RESEND = "resend"
    FSCK = "fsck"


# of `ground import`
ValuesGiven = Annotated[
    PixelValues | None,
    typer.Option(
        "--values",
        help="linear: proportional to light; display: sRGB-coded, kept as they are, which is how published PSNR is "
        "measured; decode: sRGB-coded, made linear. Default: for colours of 8 bits display, or decode where exposure "
        "times differ; otherwise linear.",
    ),
]
BackgroundGiven = Annotated[
    Background | None,
    typer.Option(
        "--background",
        help="What is seen where the target is not; transparent pictures are put on it. Default: white for transparent "
        "pictures of the format nerf, otherwise black.",
    ),
]
ExposuresGiven = Annotated[
    str | None,
    typer.Option(
        "--exposures",
        metavar="FILE.csv|unknown",
        help="Exposures that the pictures do not state: a table with the columns name and exposure_time_s, iso, "
        "f_number, gain or mid_exposure_utc; unknown: estimated, one a picture, from features that neighbours share. "
        "Default: what the data set or the pictures' headers state (EXIF, FITS).",
    ),
]
MasksGiven = Annotated[
    Path | None,
    typer.Option(
        "--masks",
        metavar="FOLDER|VIDEO|screen",
        help="A folder of pictures with the names of the pictures, white where the target is, or a video of them "
        "beside a video; screen: all that has the plain colour of the pictures' borders is left out. What masks leave "
        "out counts as background.",
    ),
]
PoseSigmaGiven = Annotated[
    str | None,
    typer.Option(
        "--pose-sigma",
        metavar="DEG,M",
        help="How far the poses can err, as standard deviations in degrees and metres; the training "
        "corrects them if the pictures say that they do. Default: a pixel; for our own exports and the format images "
        "what they say.",
    ),
]
PosesGiven = Annotated[
    PoseChoice,
    typer.Option(
        "--poses",
        help="Whether the pictures fit their stated cameras, as features show that neighbours share. check: the others "
        "are named; mend: cameras that fit when turned by 180 degrees are turned, other pictures that do not fit are "
        "left out; stated: not looked at.",
    ),
]
# of `ground reconstruct`
MethodName = Annotated[
    str | None,
    typer.Option(
        metavar="METHOD[+VARIANT]...",
        help=f"The training method: {', '.join(METHODS)}; default: obbgs. "
        f"Variants ({', '.join(VARIANTS)}) are added to its name, as in 3dgs+exposure.",
    ),
]
QualityName = Annotated[
    Quality | None,
    typer.Option(
        help="draft: 0.3 of the steps of standard; best: three times its steps, and 30,000 instead of "
        "10,000 Gaussians at most, where the number of lit pixels allows them; default: standard."
    ),
]
Budget = Annotated[
    str, typer.Option(help="The largest number of Gaussians; auto: by the number of lit pixels.")
]
SettingsGiven = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        help=f"{SET_HELP}; of the method: steps=2000, or GROUP.NAME=VALUE.",
    ),
]
ReconstructMission = Annotated[
    Path | None,
    typer.Option(
        help=f"{MISSION_HELP}; its reconstruct section counts where no option is given. Default: none is read."
    ),
]
TimeLimit = Annotated[float, typer.Option(help="Seconds for each training; then the model is made as it is.")]
Seed = Annotated[int | None, typer.Option(min=0, help=f"{SEED_HELP}; default: 7.")]
AttitudeGiven = Annotated[
    AttitudeChoice,
    typer.Option(
        "--attitude",
        help="The target's attitude. tagged: as the pose tags assume it; unknown: found from the frames; auto: unknown "
        "where the tags say so.",
    ),
]
SessionDirs = Annotated[
    list[Path],
    typer.Option(
        "--session", help="The session folder. Several, each with an option of its own, run at a time."
    ),
]
WorkersGiven = Annotated[
    str | None,
    typer.Option(
        "--workers",
        metavar="N|URL",
        help="Processes at a time; default: one a core, of one thread each. Or the URL of a dask scheduler, such "
        "as tls://10.0.0.1:8786.",
    ),
]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace a finished run of the same name.")]
