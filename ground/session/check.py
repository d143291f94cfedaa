"""Looks for damage in a session: what its checksums say of each file."""

from pathlib import Path

from ground.session.folder import (
    LOGS,
    SessionError,
    damage_of,
    header_damage,
    is_whole_png,
    log_damage,
    read_header,
    read_records,
    shortened_logs,
)
from obbgs_base.checked import copy_of, read_lines, read_lines_twice
from obbgs_base.errors import in_words


def damage(session: Path, with_pictures: bool = False) -> list[str]:
    """Return what is damaged, a sentence for each file; nothing is written.

    Args:
        with_pictures: whether to read the pictures as well, which takes longest.
    """
    frames = session / "frames.jsonl"
    try:
        found = header_damage(session)
        lines = read_lines_twice(frames, "id")
        words = damage_of(lines)
        if not words and copy_of(frames).exists() and len(read_lines(copy_of(frames)).raw) < len(lines.raw):
            words = ": its copy is not whole"
        found += [f"{frames.name}{words}"] if words else []
        for name in LOGS:
            if words := log_damage(read_lines(session / name)):
                found.append(f"{name} {words}")
        found += shortened_logs(session, read_header(session))
        if with_pictures:
            found += _pictures(session)
    except (OSError, SessionError) as error:
        return [in_words(error)]
    return found


def _pictures(session: Path) -> list[str]:
    paths = {session / record.file for record in read_records(session)}
    thumbnails = session / "thumbnails"
    paths |= set(thumbnails.glob("*.png")) if thumbnails.is_dir() else set()
    found = []
    for path in sorted(paths):
        if not path.is_file():
            found.append(f"{path.relative_to(session)} is missing")
        elif not is_whole_png(path.read_bytes()):
            found.append(f"{path.relative_to(session)} is damaged")
    return found
