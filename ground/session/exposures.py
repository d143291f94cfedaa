"""Exposure times as the report and the viewer write them and offer them for choice."""

from collections.abc import Iterable

from ground.session.spread import evenly_spread

MOST_OFFERED = 6  # buttons; with automatic brackets every frame of a pass may have a time of its own


def in_ms(exposure_time_s: float) -> str:
    """Return an exposure time in ms to four figures, without the unit."""
    return f"{float(f'{1e3 * exposure_time_s:.4g}'):g}"


def offered_s(exposure_times_s: Iterable[float]) -> dict[str, float]:
    """Return at most six of the times by what `in_ms` writes, spread evenly by rank, shortest and longest included."""
    times_s = {in_ms(time_s): time_s for time_s in sorted(exposure_times_s)}
    return dict(evenly_spread(list(times_s.items()), MOST_OFFERED))
