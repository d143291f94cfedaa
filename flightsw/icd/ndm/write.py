"""Orbits and attitudes as navigation data messages in KVN: OEM 2.0 and AEM 2.0, in GCRF and UTC."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from flightsw.icd.ndm.times import epoch_text, tai_ns


@dataclass(frozen=True)
class Object:
    """What a message says of its object: a name, and the international designator, such as 2007-026A, or UNKNOWN."""

    name: str
    identifier: str = "UNKNOWN"


def write_oem(
    of: Object,
    centre: str,
    utc_ns: Sequence[int],
    positions_m: np.ndarray,
    velocities_m_s: np.ndarray,
    covariances: np.ndarray | None,
    created_utc_ns: int,
    interpolation: tuple[str, int] = ("HERMITE", 3),
) -> bytes:
    """Return an OEM of states in GCRS axes.

    Args:
        centre: EARTH, or the name of the object that positions are relative to.
        utc_ns: [N] increasing.
        positions_m, velocities_m_s: [N, 3].
        covariances: [N, 6, 6], m and m/s.
        interpolation: method and degree that give the states in between.
    """
    lines = [
        *_header("OEM", created_utc_ns),
        *_meta(of, utc_ns, (f"CENTER_NAME = {centre}", "REF_FRAME = GCRF")),
        f"INTERPOLATION = {interpolation[0]}",
        f"INTERPOLATION_DEGREE = {interpolation[1]}",
        *("META_STOP", ""),
    ]
    for at_ns, position, velocity in zip(utc_ns, positions_m, velocities_m_s, strict=True):
        numbers = " ".join(f"{x / 1e3:.13f}" for x in (*position, *velocity))
        lines.append(f"{epoch_text(tai_ns(at_ns))} {numbers}")
    if covariances is not None:
        lines += ["", "COVARIANCE_START"]
        for at_ns, matrix in zip(utc_ns, covariances, strict=True):
            lines += [f"EPOCH = {epoch_text(tai_ns(at_ns))}", "COV_REF_FRAME = GCRF"]
            lines += [" ".join(f"{x / 1e6:.12e}" for x in row[: i + 1]) for i, row in enumerate(matrix)]
        lines.append("COVARIANCE_STOP")
    return ("\n".join(lines) + "\n").encode()


def write_aem(
    of: Object,
    body_frame: str,
    utc_ns: Sequence[int],
    quats_gcrs_to_body: np.ndarray,
    rates_rad_s: np.ndarray | None,
    created_utc_ns: int,
) -> bytes:
    """Return an AEM of attitudes relative to GCRS, with angular velocities where they are known.

    Args:
        body_frame: such as SC_BODY_1.
        utc_ns: [N] increasing.
        quats_gcrs_to_body: [N, 4] w, x, y, z.
        rates_rad_s: [N, 3] along the body's axes.
    """
    kind = "QUATERNION" if rates_rad_s is None else "QUATERNION/ANGVEL"
    more = [] if rates_rad_s is None else [f"ANGVEL_FRAME = {body_frame}"]
    method = ("LINEAR", 1) if rates_rad_s is None else ("HERMITE", min(7, 2 * len(utc_ns) - 1))
    lines = [
        *_header("AEM", created_utc_ns),
        *_meta(of, utc_ns, ("REF_FRAME_A = GCRF", f"REF_FRAME_B = {body_frame}")),
        *(f"ATTITUDE_TYPE = {kind}", *more),
        f"INTERPOLATION_METHOD = {method[0]}",
        f"INTERPOLATION_DEGREE = {method[1]}",
        *("META_STOP", "", "DATA_START"),
    ]
    for row, at_ns in enumerate(utc_ns):
        w, x, y, z = quats_gcrs_to_body[row]
        numbers = [-x, -y, -z, w]  # the turn of the axes, scalar last
        if rates_rad_s is not None:
            numbers += np.degrees(rates_rad_s[row]).tolist()
        lines.append(f"{epoch_text(tai_ns(at_ns))} " + " ".join(f"{number:.15f}" for number in numbers))
    return ("\n".join([*lines, "DATA_STOP"]) + "\n").encode()


def _header(kind: str, created_utc_ns: int) -> list[str]:
    created = epoch_text(tai_ns(created_utc_ns)).partition(".")[0]
    return [f"CCSDS_{kind}_VERS = 2.0", f"CREATION_DATE = {created}", "ORIGINATOR = OBBGS", ""]


def _meta(of: Object, utc_ns: Sequence[int], frames: Sequence[str]) -> list[str]:
    return [
        "META_START",
        f"OBJECT_NAME = {of.name}",
        f"OBJECT_ID = {of.identifier}",
        *frames,
        "TIME_SYSTEM = UTC",
        f"START_TIME = {epoch_text(tai_ns(utc_ns[0]))}",
        f"STOP_TIME = {epoch_text(tai_ns(utc_ns[-1]))}",
    ]
