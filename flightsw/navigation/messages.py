"""Navigation from a folder of CCSDS messages: target.oem, chaser.oem and, where they are known, target.aem, chaser.aem.

Files are taken by the beginning of their names; OPM, OMM and XML do as well (flightsw/icd/ndm).
"""

from pathlib import Path

from flightsw.errors import NavigationError
from flightsw.icd.config import ConfigError
from flightsw.icd.ndm.formation import Formation, role_of
from flightsw.icd.ndm.orbit import NoState
from flightsw.icd.ndm.text import MAX_NDM_BYTES
from flightsw.navigation.orbit import propagate
from flightsw.navigation.stream import SatelliteStates
from obbgs_base.errors import reason
from obbgs_base.files import read_bounded

SCHEME = "ndm://"


class MessageNavigation:
    """The states of both satellites as the messages in a folder say, which are read once.

    Args:
        source: ndm:///folder.
        target_tle: where the target is if the chaser's orbit is relative to it and no file says it; this counts for
            the Sun, the Earth's shadow and the camera's roll only.

    Raises:
        NavigationError: a file cannot be read, or is not valid.
    """

    def __init__(self, source: str, target_tle: tuple[str, ...]):
        folder = Path(source.removeprefix(SCHEME))
        try:
            paths = [path for path in sorted(folder.iterdir()) if role_of(path.name)]
            self.formation = Formation.of({path.name: read_bounded(path, MAX_NDM_BYTES) for path in paths})
        except OSError as error:
            raise NavigationError(f"no navigation messages in {folder}: {reason(error)}") from error
        except ConfigError as error:
            raise NavigationError(f"{folder}: {error}") from error
        self._target_tle = target_tle

    def close(self) -> None:
        """Do nothing: no file is open."""

    def at(self, utc_ns: int) -> SatelliteStates:
        """Return the states at a time.

        Raises:
            NavigationError: a message does not cover it.
            OrbitError: the target's two-line elements, where they are in use, cannot be propagated.
        """
        try:
            found = self.formation.at(utc_ns)
        except NoState as error:
            raise NavigationError(f"gap in the navigation messages: {error}") from error
        target = found.target or propagate(self._target_tle, utc_ns)
        return SatelliteStates(
            utc_ns,
            target.position_m,
            target.velocity_m_s,
            target.position_m + found.chaser_from_target_m,
            target.velocity_m_s + found.chaser_velocity_m_s,
            found.quat_gcrs_to_body,
            found.quat_gcrs_to_chaser,
            found.covariance,
        )
