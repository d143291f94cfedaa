"""Settings that the ground has commanded, kept in the store's folder so that they survive a restart."""

import dataclasses
import json
import logging
from dataclasses import dataclass
from pathlib import Path

from flightsw.errors import StoreError
from flightsw.icd.config import ConfigError
from flightsw.icd.mission import BracketSection, Mission
from flightsw.store import RESERVE, write_with_reserve

log = logging.getLogger(__name__)
ORDERS = ("oldest", "triage", "thumbnail-first")


@dataclass(frozen=True)
class Settings:
    """How frames are taken and which goes down first. None leaves the exposures to the mission."""

    priority: str
    exposure_times_ms: tuple[float, ...] | None = None
    max_error_dn: int = 0  # of a coded pixel; `near` in settings.json and in the command
    safe_mode: bool = False  # no exposures

    def __post_init__(self):
        if self.priority not in ORDERS:
            raise ValueError(f"priority must be one of {', '.join(ORDERS)}, got {self.priority!r}")
        if type(self.max_error_dn) is not int or not 0 <= self.max_error_dn <= 255:
            raise ValueError(f"max_error_dn must be 0 to 255, got {self.max_error_dn!r}")
        if type(self.safe_mode) is not bool:
            raise ValueError(f"safe_mode must be true or false, got {self.safe_mode!r}")

    def bracket(self, mission: Mission) -> BracketSection:
        """Return the mission's bracket with the commanded exposures.

        Raises:
            ConfigError: they do not fit the mission's spacing.
        """
        if self.exposure_times_ms is None:
            return mission.bracket
        return dataclasses.replace(mission.bracket, exposure_times_ms=self.exposure_times_ms, auto=False)


def load_settings(folder: Path, mission: Mission) -> Settings:
    """Return what was commanded last, the mission's own settings when nothing was or the file is damaged."""
    default = Settings(mission.link.priority)
    path = folder / "settings.json"
    try:
        tree = json.loads(path.read_bytes())
        if tree["exposure_times_ms"] is not None:
            tree["exposure_times_ms"] = tuple(map(float, tree["exposure_times_ms"]))
        tree["max_error_dn"] = tree.pop("near")
        settings = Settings(**tree)
    except FileNotFoundError:
        return default
    except (OSError, ValueError, TypeError, KeyError) as error:
        log.error("%s is not usable, the mission's own settings are used: %s", path, error)
        return default
    try:
        settings.bracket(mission)
    except ConfigError as error:  # the others still hold, safe mode above all
        log.error("the commanded exposure times do not fit, the mission's own are used: %s", error)
        return dataclasses.replace(settings, exposure_times_ms=None)
    return settings


def save_settings(folder: Path, settings: Settings) -> None:
    """Keep what was commanded.

    Raises:
        StoreError: the disk refuses; what was there before is still there.
    """
    tree = dataclasses.asdict(settings)
    tree["near"] = tree.pop("max_error_dn")
    try:
        write_with_reserve(folder / "settings.json", json.dumps(tree).encode(), folder / RESERVE)
    except OSError as error:
        raise StoreError(f"cannot keep the settings: {error}") from error
