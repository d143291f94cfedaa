"""What lies in some folders: sessions with their runs, and what differs between two runs; read, never changed."""

import dataclasses
import json
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from ground.run.live.status import line, read_status
from ground.run.runs import is_live, read_config, read_metrics, unfinished_folder
from ground.session.check import damage
from ground.session.folder import SessionError, flight_counts, read_header, read_records
from obbgs_base.errors import counted
from obbgs_core.methods.presets import QUALITIES, preset

DEEPEST = 3  # levels of folders below the given ones in which sessions are looked for
FIGURES = (  # of metrics.json, in the order of a comparison
    *(
        "psnr_clean_db",
        "psnr_clean_foreground_db",
        "psnr_noisy_db",
        "psnr_srgb_db",
        "ssim_clean",
        "lpips_clean",
    ),
    *("chi2", "chamfer", "hausdorff", "completeness_surface", "accuracy_surface", "gaussians", "ply_bytes"),
    *(
        "poses",
        "pose_error_tagged_px",
        "pose_error_px",
        "pose_error_deg",
        "pose_error_range",
        "size_error_percent",
    ),
    *("train_seconds", "schedule_steps", "train_steps", "frames_trained", "frames_held_out"),
)
LOST_ON_BOARD = {
    "frames_failed": "exposures failed",
    "frames_refused": "refused for lack of room",
    "frames_dropped": "deleted undelivered",
}
LOST_ON_GROUND = {"frames_rejected": "unusable"}
DIGEST = "_sha256"  # names of settings that end so say nothing to a person


@dataclass(frozen=True)
class RunEntry:
    """One run of a session; figures that it does not have are None.

    problem: why its metrics cannot be read, or that it is unfinished; empty for a whole run.
    state: of a live run that is unfinished: waiting, training or settled; else empty.
    """

    name: str
    method: str | None
    quality: str | None  # draft, standard or best by its steps, or the number of steps
    poses: str | None  # what was decided of them, and why
    pose_error_px: float | None  # root mean square of refined poses, where the truth is known
    pose_error_deg: float | None
    psnr_clean_db: float | None
    psnr_noisy_db: float | None
    gaussians: int | None
    seconds: float | None
    made_utc: str
    problem: str
    state: str


@dataclass(frozen=True)
class SessionEntry:
    """One session; frames_captured is None where the spacecraft did not say how many it took.

    frames_lost: frames that will never come, by what became of them; without those that are 0.
    frames_missing: frames that have not come and are not known to be lost; at least, where frames_captured is None.
    damage: what is damaged in its files; pictures are looked at on demand only.
    link: what was counted on the link, such as segments that came again: it costs time, and no frame.
    problem: why the session cannot be read; its other values are then 0, None or empty.
    """

    folder: str
    created_utc: str
    imported_from: str | None
    frames: int
    frames_captured: int | None
    brackets: int
    frames_lost: dict[str, int]
    frames_missing: int
    link: dict[str, int]
    size: str  # of the pictures, such as 256x256
    runs: list[RunEntry]
    problem: str
    damage: list[str]


def find_sessions(folders: Sequence[Path], with_pictures: bool = False) -> list[SessionEntry]:
    """Return the sessions in some folders and below them, in the order of their paths.

    Args:
        with_pictures: whether to look for damage in the pictures too.

    Raises:
        SessionError: a folder is not there.
    """
    found: dict[Path, SessionEntry] = {}
    for folder in folders:
        if not folder.is_dir():
            raise SessionError(f"{folder} is not a folder")
        for session in sorted(_sessions_below(folder, DEEPEST, {})):
            found.setdefault(session.resolve(), _session_entry(session, with_pictures))
    return list(found.values())


def _sessions_below(folder: Path, levels: int, looked_at: dict[Path, int]) -> Iterator[Path]:
    """Give the sessions in a folder, behind symbolic links too; `looked_at` has the levels below each real folder.

    A folder that several links lead to is looked at once, so that no circle of links ends this never.
    """
    real = folder.resolve()
    if looked_at.get(real, -1) >= levels:
        return
    looked_at[real] = levels
    if (folder / "session.json").is_file():
        yield folder
    elif levels:
        names = [name for name in os.listdir(folder) if not name.startswith(".")]
        for below in sorted((folder / name for name in names), key=lambda path: (path.is_symlink(), path)):
            try:
                if below.is_dir():
                    yield from _sessions_below(below, levels - 1, looked_at)
            except OSError:  # somebody else's folder is no session of ours, and a link may lead to itself
                continue


def _session_entry(folder: Path, with_pictures: bool) -> SessionEntry:
    try:
        header, records = read_header(folder), read_records(folder)
        flight = flight_counts(header)
        last = max((record.id for record in records), default=-1)
        captured = flight.captured(last) if flight and records else None
        counts = {**(dataclasses.asdict(flight) if flight else {}), **header["losses"]}
        lost = {
            w: counts[name] for name, w in {**LOST_ON_BOARD, **LOST_ON_GROUND}.items() if counts.get(name)
        }
        never_came = sum(
            counts.get(name, 0) for name in ("frames_refused", "frames_dropped", "frames_rejected")
        )
        taken = last + 1 if captured is None else captured
        camera = header["camera"]
        return SessionEntry(
            str(folder),
            str(header["created_utc"]),
            header.get("imported_from"),
            len(records),
            captured,
            len({record.bracket for record in records}),
            lost,
            0 if "imported_from" in header else max(0, taken - len(records) - never_came),
            {name: n for name, n in header["losses"].items() if n and name not in LOST_ON_GROUND},
            f"{camera['width']}x{camera['height']}",
            _runs(folder),
            "",
            damage(folder, with_pictures),
        )
    except (SessionError, KeyError, TypeError, ValueError, AttributeError) as error:
        return SessionEntry(str(folder), "", None, 0, None, 0, {}, 0, {}, "", [], str(error), [])


def _runs(session: Path) -> list[RunEntry]:
    folder = session / "runs"
    if not folder.is_dir():
        return []
    paths = sorted(path for path in folder.iterdir() if path.is_dir() and not path.name.endswith(".replaced"))
    hidden = {unfinished_folder(path) for path in paths if is_live(path)}  # a live run shows itself
    paths = [path for path in paths if path not in hidden]
    return sorted(map(_run_entry, paths), key=lambda run: run.made_utc)


def _run_entry(folder: Path) -> RunEntry:
    name, made = folder.name, folder.stat().st_mtime
    metrics: dict[str, Any] = {}
    problem = state = ""
    if name.startswith(".") and name.endswith(".part"):
        name, problem = (
            name[1 : -len(".part")],
            "unfinished: `ground reconstruct` with this name goes on with it",
        )
    elif is_live(folder):
        facts = read_status(folder)
        problem = f"unfinished, `ground live` with this name goes on with it: {line(facts)}"
        state = facts.get("state", "its status cannot be read")
    else:
        try:
            metrics = read_metrics(folder / "metrics.json")
            made = (folder / "metrics.json").stat().st_mtime
        except SessionError as error:
            problem = str(error)
    return RunEntry(
        name,
        metrics.get("method"),
        _quality(metrics),
        metrics.get("poses"),
        metrics.get("pose_error_px"),
        metrics.get("pose_error_deg"),
        metrics.get("psnr_clean_db"),
        metrics.get("psnr_noisy_db"),
        metrics.get("gaussians"),
        metrics.get("train_seconds"),
        datetime.fromtimestamp(made, UTC).isoformat(timespec="seconds"),
        problem,
        state,
    )


def _quality(metrics: dict[str, Any]) -> str | None:
    """Return the quality whose steps a run's schedule has, such as `draft`; other numbers of steps as they are."""
    steps = metrics.get("schedule_steps", metrics.get("train_steps"))  # older runs do not tell their schedule
    if steps is None:
        return None
    try:
        of_method = preset(metrics["method"]).steps
    except ValueError:  # of an older version, or of changed settings
        return counted(steps, "step")
    named = {round(of_method * factor): quality for quality, factor in QUALITIES.items()}
    return named.get(steps, counted(steps, "step"))


def compare_runs(first: Path, second: Path) -> dict[str, dict[str, list]]:
    """Return what differs between two run folders: {"settings": {name: [first, second]}, "figures": the same}.

    Settings are those of config.yaml by their dotted names that are not equal. Digests are not shown: where those of
    the frames differ, `session.frames` says so. Figures are the quality and those of metrics.json that either has, also
    where they are equal.

    Raises:
        SessionError: a folder is not a finished run, or its files are damaged.
    """
    settings = [_flat(read_config(folder)) for folder in (first, second)]
    metrics = [read_metrics(folder / "metrics.json") for folder in (first, second)]
    differing = {
        name: [tree.get(name) for tree in settings]
        for name in sorted(settings[0].keys() | settings[1].keys())
        if settings[0].get(name) != settings[1].get(name)
    }
    if "session.frames_jsonl_sha256" in differing:
        counts = [m["frames_received"] for m in metrics]
        differing["session.frames"] = [
            counted(counts[0], "frame"),
            f"{counted(counts[1], 'frame')}, not the same ones",
        ]
    figures = {"quality": [_quality(m) for m in metrics]}
    figures |= {key: [m.get(key) for m in metrics] for key in FIGURES}
    return {
        "settings": {name: pair for name, pair in differing.items() if not name.endswith(DIGEST)},
        "figures": {key: pair for key, pair in figures.items() if pair != [None, None]},
    }


def _flat(tree: dict, above: str = "") -> dict[str, Any]:
    """Return the leaves of nested settings by their dotted names."""
    leaves: dict[str, Any] = {}
    for name, value in tree.items():
        if isinstance(value, dict):
            leaves |= _flat(value, f"{above}{name}.")
        else:
            leaves[f"{above}{name}"] = value if isinstance(value, int | float | str) else json.dumps(value)
    return leaves
