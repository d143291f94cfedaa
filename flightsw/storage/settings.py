"""Settings that the ground has commanded, kept in the store's folder so that they survive a restart."""

import contextlib
import dataclasses
import logging
from dataclasses import dataclass
from pathlib import Path

from flightsw.errors import StoreError
from flightsw.icd.config import ConfigError
from flightsw.icd.mission import BracketSection, Mission
from flightsw.storage.store import RESERVE, write_with_reserve
from obbgs_base.checked import copy_of, read_twice, write_twice
from obbgs_base.errors import in_words, reason
from obbgs_base.files import set_aside

log = logging.getLogger(__name__)
FILE = "settings.json"  # in the store's folder
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
    """Return what was commanded last, the mission's own settings when nothing was.

    They stand twice, with checksums. Where neither copy is good, flight is in safe mode with the mission's own
    settings: an unreadable safe mode means safe. That is kept, so that it is said once, and the damaged files are set
    aside, unless `fsck` has done so before.
    """
    default = Settings(mission.link.priority)
    path = folder / FILE
    try:
        tree = read_twice(path, log.warning)
        if tree is None:
            if not any((folder / "quarantine").glob(f"*-{FILE}")):
                return default
            raise ValueError("fsck set both copies aside")
        if tree["exposure_times_ms"] is not None:
            tree["exposure_times_ms"] = tuple(map(float, tree["exposure_times_ms"]))
        tree["max_error_dn"] = tree.pop("near")
        settings = Settings(**tree)
    except (OSError, ValueError, TypeError, KeyError) as error:
        log.error("%s is not usable: safe mode, and the mission's own settings: %s", path, reason(error))
        safe = dataclasses.replace(default, safe_mode=True)
        if isinstance(error, OSError):  # the disk may be read again later
            return safe
        with contextlib.suppress(OSError, StoreError):  # on a disk that cannot be written to it is said again
            for each in (path, copy_of(path)):
                if each.exists():
                    set_aside(each)
            save_settings(folder, safe)
        return safe
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
        write_twice(folder / FILE, tree, lambda file, data: write_with_reserve(file, data, folder / RESERVE))
    except OSError as error:
        raise StoreError(f"cannot keep the settings: {in_words(error)}") from error
