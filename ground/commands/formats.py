"""Commands of `ground` that turn other formats into sessions and back: import and export."""

import functools
import json
import math
import shutil
import signal
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from ground.commands.options import (
    Background,
    BackgroundGiven,
    ExportFormat,
    ExposuresGiven,
    ImportFormat,
    MasksGiven,
    PoseChoice,
    PosesGiven,
    PoseSigmaGiven,
    SessionDir,
    ValuesGiven,
)
from obbgs_base.command_line import FRAMES_HELP, OUT_HELP, AsJson
from obbgs_base.errors import Interrupted, ObbgsError, counted, in_words
from obbgs_base.stopping import StopRequest

if TYPE_CHECKING:
    from ground.formats.photographs.poses import Registered
    from ground.formats.pictures.files import Light
    from ground.formats.pictures.views import Exported, PoseSigmas, View

TIMED = (ImportFormat.NDM, ImportFormat.SPICE)  # formats whose readers need the table for the poses
VIDEO_FRAMES = "video-frames"  # in a session that is being made of a video
MOST_NAMED = 5  # pictures in one line; --json names all

stderr = Console(stderr=True)


def _leaves_nothing(command: Callable[..., None]) -> Callable[..., None]:
    """Let a refused import take the session's folder away that it made; an interrupted one goes on there later."""

    @functools.wraps(command)
    def checked(session: Path, **given: Any) -> None:
        is_new = not session.exists()
        try:
            command(session=session, **given)
        except (ObbgsError, ValueError) as error:
            if is_new and not isinstance(error, Interrupted):
                shutil.rmtree(session, ignore_errors=True)
            raise

    return checked


@_leaves_nothing
def import_command(
    folder: Annotated[Path, typer.Option("--from", help="The data set's folder.")],
    session: SessionDir,
    format_: Annotated[ImportFormat, typer.Option("--format", help="The format.")],
    values: ValuesGiven = None,
    background: BackgroundGiven = None,
    exposures: ExposuresGiven = None,
    masks: MasksGiven = None,
    pose_sigma: PoseSigmaGiven = None,
    poses: PosesGiven = PoseChoice.CHECK,
    frames: Annotated[
        int | None,
        typer.Option(
            min=1,
            help=f"{FRAMES_HELP}; the first of each split, of a video the sharpest of so many equal spans of time. "
            "Default: all, of a video 120.",
        ),
    ] = None,
    json_: AsJson = False,
) -> None:
    """Make a session of pictures with known cameras, or of photographs.

    Splits that the data set states are kept: `ground reconstruct` trains on train and holds out test, or val if there
    is no test. Of images, a folder of photographs by one camera, and of a video (--from is its file), structure from
    motion finds the cameras; it takes minutes, and goes on where it was interrupted. Pictures are PNG, JPEG, TIFF, BMP,
    WebP, Radiance HDR, and with obbgs[pictures] FITS, OpenEXR and DNG.

    Example: ground import --format shirt --from shirtv1/roe1/lightbox --frames 363 --session roe1
    """
    from ground.formats.photographs.brackets import in_brackets_of_places
    from ground.formats.photographs.exposures import UNKNOWN, estimated, read_table, with_exposures
    from ground.formats.pictures.placement import placed, with_stated_errors
    from ground.formats.pictures.views import EXACT, Values, first_of_each_split, write_session

    _check_there(format_, folder, masks)
    given_sigmas = None if pose_sigma is None else _pose_sigmas(pose_sigma)
    table = None if exposures in (None, UNKNOWN) else read_table(Path(exposures))
    sigmas, exported, registration = EXACT, None, None
    unposed = format_ in (ImportFormat.IMAGES, ImportFormat.VIDEO)
    if unposed:
        found = _photographs(format_, folder, session, frames, table)
        views, sigmas, registration = found.views, found.sigmas, found.described()
        if format_ is ImportFormat.VIDEO and masks is not None and masks.is_file():
            masks = _masks_of_video(masks, views, session)
    else:
        views, exported = _read(format_, folder, table, session)
        views = first_of_each_split(views, frames)
        if exposures != UNKNOWN and format_ not in TIMED:
            views = in_brackets_of_places(with_exposures(views, table))
    views, found_poses, source = _masked(views, masks, session), {}, f"{format_.value}: {folder}"
    given = None if values is None else Values(values.value)
    if exposures == UNKNOWN:
        views = estimated(views, given)
    in_body_axes = all(view.attitude_known for view in views)
    if not unposed and poses is not PoseChoice.STATED and in_body_axes:
        views, found_poses = _checked_poses(views, given_sigmas or sigmas, poses is PoseChoice.MEND)
        if poses is PoseChoice.MEND:
            source += "".join(f", {counted(len(p), 'pose')} {kind}" for kind, p in found_poses.items())
    views, origin_moved = placed(views)
    if given_sigmas is None and exported is None:
        views = with_stated_errors(views)  # what an export of ours does not state is exact
    with Progress(TextColumn("importing"), BarColumn(), TimeRemainingColumn(), console=stderr) as progress:
        task = progress.add_task("import", total=len(views))
        count = write_session(
            views,
            session,
            source,
            given,
            None if background is None else background is Background.WHITE,
            exported,
            lambda: progress.advance(task),
            given_sigmas or sigmas,
            registration,
            origin_moved,
            transparent_on_white=format_ is ImportFormat.NERF,
        )
    shutil.rmtree(session / VIDEO_FRAMES, ignore_errors=True)
    told = {"frames": count, "session": str(session), **(registration or {}), **found_poses}
    print(json.dumps(told) if json_ else _told(count, session, registration or {}))


def _check_there(format_: ImportFormat, folder: Path, masks: Path | None) -> None:
    """Check that photographs and masks are there, before minutes are spent on one without the other.

    Raises:
        ConfigError: a folder is not; readers of the other formats say themselves what they expect of theirs.
    """
    from flightsw.icd.config import ConfigError

    if format_ is ImportFormat.IMAGES and not folder.is_dir():
        raise ConfigError("--from", f"expected a folder that is there, got {folder}")
    if masks is not None and masks.name != "screen" and not masks.exists():
        raise ConfigError("--masks", f"expected a folder that is there, got {masks}")


def _told(count: int, session: Path, registration: dict) -> str:
    """Return how many pictures there are, and which photographs structure from motion left out or turned."""
    lines = [f"{counted(count, 'picture')} in {session}"]
    if registration.get("left_out"):
        lines.append(f"left out, because they could not be registered: {', '.join(registration['left_out'])}")
    if registration.get("turned"):
        lines.append(f"turned by 180 degrees against the others: {', '.join(registration['turned'])}")
    return "\n".join(lines)


def _read(
    format_: ImportFormat, folder: Path, table: "dict[str, Light] | None", session: Path
) -> "tuple[list[View], Exported | None]":
    """Return the pictures of a data set whose cameras are known, and what our own export says of them.

    Refused at once where the session that is to be made is there already: to check poses takes minutes.
    """
    from ground.formats.colmap import read_colmap_and_export
    from ground.formats.llff import read_llff
    from ground.formats.middlebury import read_middlebury
    from ground.formats.ndm import read_ndm
    from ground.formats.nerf import read_nerf
    from ground.formats.nerfstudio import read_nerfstudio
    from ground.formats.pictures.views import check_is_new
    from ground.formats.shirt import read_shirt
    from ground.formats.spice import read_spice

    check_is_new(session)
    described = {
        ImportFormat.NERF: read_nerf,
        ImportFormat.NERFSTUDIO: read_nerfstudio,
        ImportFormat.COLMAP: read_colmap_and_export,
    }
    timed = {ImportFormat.NDM: read_ndm, ImportFormat.SPICE: read_spice}
    if format_ in described:
        return described[format_](folder)
    if format_ in timed:
        return timed[format_](folder, table), None
    plain = {
        ImportFormat.SHIRT: read_shirt,
        ImportFormat.LLFF: read_llff,
        ImportFormat.MIDDLEBURY: read_middlebury,
    }
    return plain[format_](folder), None


def _checked_poses(
    views: "list[View]", sigmas: "PoseSigmas", mend: bool
) -> "tuple[list[View], dict[str, list[str]]]":
    """Return the views, mended if that is wanted, and the names of those that do not fit, by what is wrong.

    What was found and what to do is said on stderr.
    """
    from ground.formats.photographs.epipolar import check_poses, mended

    with Progress(TextColumn("checking poses"), BarColumn(), TimeRemainingColumn(), console=stderr) as bar:
        task = bar.add_task("check", total=len(views))
        check = check_poses(views, sigmas, lambda: bar.advance(task))
    wrong = {"turned": check.turned, "contradicting": check.contradicting, "unchecked": check.unchecked}
    names = {kind: [views[i].image.name for i in indices] for kind, indices in wrong.items() if indices}
    said = {
        "turned": "fit their pictures when turned by 180 degrees about the line of sight",
        "contradicting": "contradict what their pictures share with their neighbours",
        "unchecked": "could not be checked, as their pictures share too little with others",
    }
    done = {
        "turned": ("they are turned", "--poses mend turns them"),
        "contradicting": ("they are left out", "--poses mend leaves them out"),
        "unchecked": ("they are taken as stated",) * 2,
    }
    for kind, pictures in names.items():
        more = f" and {len(pictures) - MOST_NAMED} more" * (len(pictures) > MOST_NAMED)
        named = ", ".join(pictures[:MOST_NAMED]) + more
        where = "" if len(pictures) == len(views) else f": {named}"
        what = f"{len(pictures)} of {len(views)} cameras {said[kind]}{where}; {done[kind][not mend]}"
        stderr.print(what, soft_wrap=True, highlight=False)
    return mended(views, check) if mend else views, names


def _pose_sigmas(text: str) -> "PoseSigmas":
    from ground.formats.pictures.views import PoseSigmas

    try:
        degrees, metres = map(float, text.split(","))
        return PoseSigmas(math.radians(degrees), metres)
    except ValueError as error:
        raise ValueError(
            f"--pose-sigma: expected degrees and metres, both at least 0, such as 0.2,0.01, got {text!r}"
        ) from error


def _photographs(
    format_: ImportFormat, folder: Path, session: Path, count: int | None, table: "dict[str, Light] | None"
) -> "Registered":
    """Return what structure from motion makes of a folder or a video, with a bar.

    SIGINT and SIGTERM stop it at its next step.
    """
    from ground.formats.photographs.poses import read_photographs
    from ground.formats.photographs.video import FRAMES, write_frames
    from ground.formats.pictures.views import check_is_new

    check_is_new(session)
    stop = StopRequest()
    before = {
        number: signal.signal(number, lambda *_: stop.set()) for number in (signal.SIGINT, signal.SIGTERM)
    }
    try:
        columns = TextColumn("finding cameras"), BarColumn(), TimeRemainingColumn()
        # elsewhere than on a terminal nothing is left of it but a line before an error
        with Progress(*columns, console=stderr, transient=True, disable=not stderr.is_terminal) as progress:
            task = progress.add_task("register", total=1.0)
            if format_ is ImportFormat.VIDEO:
                pictures = session / VIDEO_FRAMES / "pictures"
                shutil.rmtree(pictures, ignore_errors=True)
                write_frames(folder, pictures, count or FRAMES, stop.is_set)
                folder, count = pictures, None
            return read_photographs(
                folder,
                session / "registration",
                lambda share: progress.update(task, completed=share),
                stop.is_set,
                count,
                table,
            )
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _masked(views: "list[View]", masks: Path | None, session: Path) -> "list[View]":
    """Return the views with the masks of a folder, or with those of the plain screen that they stand in front of."""
    from ground.formats.pictures.masks import with_masks
    from ground.formats.pictures.screen import with_screen_masks

    if masks is not None and masks.name == "screen" and not masks.exists():
        views, masks = with_screen_masks(views, session / "masks"), None
    return with_masks(views, masks)


def _masks_of_video(video: Path, views: "list[View]", session: Path) -> Path:
    """Return a folder with those frames of a video of masks that belong to the pictures."""
    from ground.formats.photographs.video import write_masks

    folder = session / VIDEO_FRAMES / "masks"
    write_masks(video, folder, [view.image.name for view in views])
    return folder


def export_command(
    source: Annotated[
        Path,
        typer.Argument(
            help="A session's folder; or a run's: its poses as it refined them, its split into train and test, without "
            "the frames that it left out."
        ),
    ],
    out: Annotated[Path, typer.Option(help=f"{OUT_HELP}.")],
    format_: Annotated[ExportFormat, typer.Option("--format", help="The format.")] = ExportFormat.NERF,
    json_: AsJson = False,
) -> None:
    """Write a session's frames for other software, whole brackets split into train, val and test (6:2:3).

    Pictures have 8 bits. Beside them lie the readings of 16 bits, which `ground import` takes with exposure times and
    the sensor's figures, of a COLMAP folder with the cameras of its model, which has points where a run is exported.
    The format ndm writes no pictures, but CCSDS messages: the target's attitude and rate, the camera's attitude and its
    path about the target with covariance.

    Example: ground export pass-12/runs/first --format nerfstudio --out pass-12-nerfstudio
    """
    from ground.formats.colmap_export import export_colmap
    from ground.formats.nerf import export_nerf
    from ground.formats.nerfstudio import export_nerfstudio
    from ground.run.estimated_poses import refined_session
    from ground.run.navigation_messages import export_ndm
    from ground.run.runs import is_session, open_run, run_at
    from ground.session.folder import SessionError, open_session
    from ground.session.truth import read_points

    exporters = {ExportFormat.NERF: export_nerf, ExportFormat.NERFSTUDIO: export_nerfstudio}
    if (out.exists() and not out.is_dir()) or (out / "session.json").exists():
        kind = "a session" if out.is_dir() else "a file"
        raise SessionError(f"{out} is {kind}: give a folder of its own with --out, new or empty")
    if format_ is not ExportFormat.NDM and out.is_dir() and any(out.iterdir()):
        raise SessionError(
            f"{out} is not empty, and an import would take what is there for part of the export: give another --out, "
            "or remove it first"
        )
    opened = open_run(*run_at(source)) if source.is_dir() and not is_session(source) else None
    try:
        if format_ is ExportFormat.NDM:
            counts = export_ndm(open_session(source) if opened is None else opened.session, out, opened)
        else:
            read = open_session(source) if opened is None else refined_session(opened)
            read.check_body_axes()
            if format_ is ExportFormat.COLMAP:
                surface = opened and opened.folder / "surface.ply"
                counts = export_colmap(
                    read, out, read_points(surface) if surface and surface.exists() else None
                )
            else:
                counts = exporters[format_](read, out)
    except OSError as error:
        raise SessionError(
            f"{in_words(error)}; give --out a folder that can be written and has room"
        ) from error
    text = ", ".join(f"{count} {split}" for split, count in counts.items())
    print(json.dumps(counts) if json_ else f"{text} in {out}")
