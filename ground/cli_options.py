"""Options that several commands of `ground` share, and the choices that its help lists."""

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

SessionDir = Annotated[Path, typer.Option("--session", help="The session folder.")]
RunName = Annotated[str, typer.Option("--name", help="The run's name: its folder below runs/.")]
RunsDir = Annotated[
    Path | None, typer.Option("--out", help="The folder of runs; default: runs/ in the session.")
]
AsJson = Annotated[bool, typer.Option("--json", help="Print the result as JSON.")]


class Method(StrEnum):
    """The training methods."""

    OBBGS = "obbgs"
    JIANG2025 = "jiang2025"
    GAUSSIAN_SPLATTING = "3dgs"
    PIXEL_GS = "pixel-gs"
    MVGS = "mvgs"


class Quality(StrEnum):
    """How many steps and Gaussians a training may use."""

    DRAFT = "draft"
    STANDARD = "standard"
    BEST = "best"


class ImportFormat(StrEnum):
    """Formats that a session can be made from."""

    NERF = "nerf"
    NERFSTUDIO = "nerfstudio"
    COLMAP = "colmap"
    SHIRT = "shirt"


class ExportFormat(StrEnum):
    """Formats that a session can be written in."""

    NERF = "nerf"
    NERFSTUDIO = "nerfstudio"


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
