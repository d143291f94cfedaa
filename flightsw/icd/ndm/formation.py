"""Target and chaser from the files of a folder: where they are and how they are turned at any time."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from flightsw.icd.config import ConfigError, in_file
from flightsw.icd.ndm.attitude import Attitude, read_attitude
from flightsw.icd.ndm.orbit import NoState, Orbit, State, read_orbit
from flightsw.icd.ndm.text import read_messages

ROLES = ("target", "chaser")
EARTH = "EARTH"
# natural centres; the name of anything else is that of an object
NATURAL = (
    *("SUN", "MOON", "MERCURY", "VENUS", "MARS", "JUPITER", "SATURN", "URANUS", "NEPTUNE", "PLUTO"),
    *("EARTH BARYCENTER", "SOLAR SYSTEM BARYCENTER", "SSB", "EMB"),
)


@dataclass(frozen=True, eq=False)
class Geometry:
    """Where both are at one time, GCRS axes; None where no file says it."""

    chaser_from_target_m: np.ndarray  # [3]
    chaser_velocity_m_s: np.ndarray  # [3] relative to the target
    target: State | None  # relative to the Earth
    covariance: np.ndarray | None  # [6, 6] of chaser minus target: m, m/s
    quat_gcrs_to_body: np.ndarray | None  # [4] of the target
    quat_gcrs_to_chaser: np.ndarray | None  # [4]


@dataclass(frozen=True)
class Formation:
    """What the files say of both objects.

    The orbit of the chaser is about the Earth like the target's, or relative to the target; then the target's own may
    be missing.
    """

    chaser: Orbit
    target: Orbit | None = None
    target_attitude: Attitude | None = None
    chaser_attitude: Attitude | None = None

    @staticmethod
    def of(files: Mapping[str, bytes]) -> "Formation":
        """Return what files say whose names begin with `target.` or `chaser.`; others are not looked at.

        Each object has one orbit (OEM, OPM or OMM) and at most one attitude (AEM), in one file or in two.

        Raises:
            ConfigError: a file is not valid, or they do not go together; the message names file and key.
        """
        orbits: dict[str, Orbit] = {}
        attitudes: dict[str, Attitude] = {}
        for name, content in sorted(files.items()):
            role = role_of(name)
            if role is None:
                continue
            with in_file(name):
                for message in read_messages(content):
                    found = attitudes if message.kind == "AEM" else orbits
                    if role in found:
                        what = "attitude" if message.kind == "AEM" else "orbit"
                        raise ConfigError(
                            "message", f"expected one {what} of the {role}, got another {message.kind}"
                        )
                    if message.kind == "AEM":
                        attitudes[role] = read_attitude(message)
                    else:
                        orbits[role] = read_orbit(message)
        if "chaser" not in orbits:
            raise ConfigError(
                "chaser",
                "its orbit is missing: expected a file whose name begins with chaser., such as chaser.oem",
            )
        return _consistent(
            Formation(
                orbits["chaser"], orbits.get("target"), attitudes.get("target"), attitudes.get("chaser")
            )
        )

    def at(self, utc: int) -> Geometry:
        """Return where both are at a time, UTC, Unix ns.

        Raises:
            NoState: a file does not cover it; the message names the object.
        """
        with _of("target"):
            target = None if self.target is None else self.target.at(utc)
        with _of("chaser"):
            chaser = self.chaser.at(utc)
        position, velocity, covariance = chaser.position_m, chaser.velocity_m_s, chaser.covariance
        if self.chaser.centre == EARTH:
            assert target is not None
            position, velocity = position - target.position_m, velocity - target.velocity_m_s
            if covariance is not None and target.covariance is not None:
                covariance = covariance + target.covariance  # as independent
        with _of("target's attitude"):
            body = None if self.target_attitude is None else self.target_attitude.at(utc, self._target_at)
        with _of("chaser's attitude"):
            own = None if self.chaser_attitude is None else self.chaser_attitude.at(utc, self._chaser_at)
        return Geometry(position, velocity, target, covariance, body, own)

    def _target_at(self, utc: int) -> State:
        assert self.target is not None
        return self.target.at(utc)

    def _chaser_at(self, utc: int) -> State:
        """Return the chaser's state about the Earth."""
        state = self.chaser.at(utc)
        if self.chaser.centre == EARTH:
            return state
        target = self._target_at(utc)
        return State(state.position_m + target.position_m, state.velocity_m_s + target.velocity_m_s, None)


class _of:
    """Let NoState say of what."""

    def __init__(self, what: str):
        self._what = what

    def __enter__(self) -> None:
        return None

    def __exit__(self, _kind: object, error: BaseException | None, _traceback: object) -> None:
        if isinstance(error, NoState):
            raise NoState(f"{self._what}: {error}") from error


def role_of(name: str) -> str | None:
    """Return `target` or `chaser` for a file that a formation reads; None for any other."""
    role = name.partition(".")[0]
    return role if role in ROLES and name != role else None


def _consistent(formation: Formation) -> Formation:
    """Return the formation once its files are known to be of the same objects and about centres that we know.

    Raises:
        ConfigError: they are not.
    """
    target, chaser = formation.target, formation.chaser
    for role, orbit, attitude in (
        ("target", target, formation.target_attitude),
        ("chaser", chaser, formation.chaser_attitude),
    ):
        if orbit is not None and attitude is not None and orbit.object_id != attitude.object_id:
            raise ConfigError(
                f"{role}, OBJECT_ID",
                f"expected {orbit.object_id!r} as of its orbit, got {attitude.object_id!r}",
            )
        lacks_orbit = target is None and (role == "target" or chaser.centre != EARTH)
        if attitude is not None and attitude.needs_orbit and lacks_orbit:
            raise ConfigError(
                f"{role}, REF_FRAME_A",
                "is a frame that goes along with an orbit: add target.oem with the target's orbit about the Earth",
            )
    if target is not None and target.centre != EARTH:
        raise ConfigError("target, CENTER_NAME", f"expected EARTH, got {target.centre!r}")
    known = (
        {f"{name}".upper() for name in (target.object_name, target.object_id)} if target is not None else None
    )
    if chaser.centre == EARTH:
        if target is None:
            raise ConfigError(
                "chaser, CENTER_NAME",
                "is EARTH: add target.oem, or give the chaser's orbit about the target, with its name as CENTER_NAME",
            )
    elif chaser.centre in NATURAL or (known is not None and chaser.centre not in known):
        names = " or ".join(sorted(known)) if known else "the target's name"
        raise ConfigError("chaser, CENTER_NAME", f"expected EARTH or {names}, got {chaser.centre!r}")
    return formation
