"""Reference frames of navigation data messages: what their axes are in GCRS."""

import numpy as np

from flightsw.icd.config import ConfigError
from flightsw.icd.ndm.text import Section
from flightsw.icd.reference_frames import eme2000_to_gcrs, teme_to_gcrs

INERTIAL = ("GCRF", "ICRF", "GCRS", "ICRS", "EME2000", "J2000", "TEME")
RADIAL = ("RTN", "RSW", "RIC", "QSW")  # radial, transverse, normal, under their many names
LOCAL = (*RADIAL, "TNW", "LVLH")
# frames of the Earth and of dates that need its measured rotation, and others that we do not know
OTHER = ("ITRF", "GTOD", "TOD", "MOD", "TDR", "WGS84", "EFG", "CIRS", "TIRS", "ALIGN", "MCI", "GRC", "DTRF")


def is_other(name: str) -> bool:
    """Return whether a name is that of a frame which is neither inertial, nor local, nor of a body's own."""
    return any(name.startswith(other) for other in OTHER)


def inertial_frame(meta: Section, key: str) -> str:
    """Return the inertial frame that a key names.

    Raises:
        ConfigError: it is another.
    """
    name = meta.text(key).upper().replace(" ", "")
    if name not in INERTIAL:
        value = meta.values[key]
        raise ConfigError(
            f"{value.where}, {key}",
            f"expected one of {', '.join(INERTIAL)}, got {value.text!r}: convert the file to one of them, as "
            "frames of the Earth need its measured rotation",
        )
    return name


def to_gcrs(frame: str, utc_ns: int) -> np.ndarray:
    """Return the rotation [3, 3] from an inertial frame to GCRS; TEME, of the date, to 0.05 arcsec."""
    if frame in ("EME2000", "J2000"):
        return eme2000_to_gcrs()
    if frame == "TEME":
        return teme_to_gcrs(utc_ns)
    return np.eye(3)


def local_axes(frame: str, position_m: np.ndarray, velocity_m_s: np.ndarray) -> np.ndarray:
    """Return the rotation [3, 3] from GCRS to axes that go along with an orbit.

    RTN: x away from the Earth, z along the orbit's normal. TNW: x along the velocity, z along the normal. LVLH: z to
    the Earth, y against the normal (as CCSDS and SANA define it).
    """
    normal = np.cross(position_m, velocity_m_s)
    normal /= np.linalg.norm(normal)
    if frame == "TNW":
        along = velocity_m_s / np.linalg.norm(velocity_m_s)
        return np.stack([along, np.cross(normal, along), normal])
    radial = position_m / np.linalg.norm(position_m)
    transverse = np.cross(normal, radial)
    if frame == "LVLH":
        return np.stack([transverse, -normal, -radial])
    return np.stack([radial, transverse, normal])
