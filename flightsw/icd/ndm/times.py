"""Times of navigation data messages: their text, and what the time systems differ by.

Within these files a time is a whole number of nanoseconds of TAI since 1970-01-01T00:00:00 TAI: it has no leap seconds.
"""

import bisect
import math
import re
from datetime import date

from flightsw.icd.config import ConfigError
from flightsw.icd.ndm.text import Value

NS = 1_000_000_000
DAY_S = 86_400
EPOCH = re.compile(
    r"(\d{4})-(?:(\d{2})-(\d{2})|(\d{3}))T(\d{2}):(\d{2}):(\d{2})(?:\.(\d{1,18}))?Z?", re.ASCII
)
SYSTEMS = ("UTC", "TAI", "TT", "GPS", "TDB")
TAI_MINUS = {"TAI": 0, "GPS": 19 * NS, "TT": -32_184_000_000}  # ns
# the days from which on TAI is one second more ahead of UTC, 10 s from the first; until 2026 no other was announced
LEAPS = (
    *("1972-01-01", "1972-07-01", "1973-01-01", "1974-01-01", "1975-01-01", "1976-01-01", "1977-01-01"),
    *("1978-01-01", "1979-01-01", "1980-01-01", "1981-07-01", "1982-07-01", "1983-07-01", "1985-07-01"),
    *("1988-01-01", "1990-01-01", "1991-01-01", "1992-07-01", "1993-07-01", "1994-07-01", "1996-01-01"),
    *("1997-07-01", "1999-01-01", "2006-01-01", "2009-01-01", "2012-07-01", "2015-07-01", "2017-01-01"),
)
UNIX_DAY = date(1970, 1, 1).toordinal()
LEAP_DAYS = [date.fromisoformat(day).toordinal() - UNIX_DAY for day in LEAPS]
FIRST_LEAP_S = 10
J2000_TT_NS = 946_728_000 * NS  # 2000-01-01T12:00:00, counted like the others


def tai_ns(utc_ns: int) -> int:
    """Return the TAI time of a UTC time (Unix nanoseconds), from 1972 on."""
    count = bisect.bisect_right(LEAP_DAYS, utc_ns // (DAY_S * NS))
    return utc_ns + (FIRST_LEAP_S + count - 1) * NS


def utc_ns(tai: int) -> int:
    """Return the UTC time (Unix nanoseconds) of a TAI time; a leap second has the numbers of the second before it."""
    latest = tai - FIRST_LEAP_S * NS
    return next(utc for leap in range(len(LEAPS)) if tai_ns(utc := latest - leap * NS) <= tai)


def parse_epoch(value: Value, system: str) -> int:
    """Return the time of an epoch such as 2026-07-21T10:52:30.5 or 2026-202T10:52:30.5Z in a time system.

    Raises:
        ConfigError: it is no time, or before 1972.
    """
    where, text = value.where, value.text
    match = EPOCH.fullmatch(text)
    if match is None:
        raise ConfigError(where, f"expected a time such as 2026-07-21T10:52:30.5, got {text[:40]!r}")
    year, month, day, day_of_year, hour, minute, second = (int(part or 0) for part in match.groups()[:7])
    try:
        if day_of_year:
            days = date(year, 1, 1).toordinal() + day_of_year - 1
            if date.fromordinal(days).year != year:
                raise ValueError("there is no such day")
        else:
            days = date(year, month, day).toordinal()
        leap = system == "UTC" and second == 60 and (hour, minute) == (23, 59)
        if hour > 23 or minute > 59 or (second > 59 and not leap):
            raise ValueError("hours reach 23, minutes and seconds 59")
    except (ValueError, OverflowError) as error:
        raise ConfigError(where, f"expected a time of the calendar, got {text[:40]!r}: {error}") from error
    days -= UNIX_DAY
    if days < LEAP_DAYS[0]:
        raise ConfigError(where, f"expected a time from 1972 on, when UTC began, got {text[:40]!r}")
    seconds = days * DAY_S + hour * 3600 + minute * 60 + second
    ns = seconds * NS + int((match[8] or "")[:9].ljust(9, "0"))
    if system == "UTC":
        return tai_ns(ns - leap * NS) + leap * NS
    if system == "TDB":
        return ns - round(tdb_minus_tt_s(ns) * NS) + TAI_MINUS["TT"]
    return ns + TAI_MINUS[system]


def tdb_minus_tt_s(tdb_ns: int) -> float:
    """Return how far TDB is ahead of TT, s, good to 10 microseconds (Kaplan, USNO Circular 179, equation 2.6)."""
    T = (tdb_ns - J2000_TT_NS) / NS / (36_525 * DAY_S)
    terms = (
        (0.001657, 628.3076, 6.2401),
        (0.000022, 575.3385, 4.2970),
        (0.000014, 1256.6152, 6.1969),
        (0.000005, 606.9777, 4.0212),
        (0.000005, 52.9691, 0.4444),
        (0.000002, 21.3299, 5.5431),
    )
    return sum(a * math.sin(f * T + p) for a, f, p in terms) + 0.000010 * T * math.sin(628.3076 * T + 4.2490)


def epoch_text(tai: int) -> str:
    """Return a time as UTC, to the nanosecond."""
    utc = utc_ns(tai)
    days, rest = divmod(utc, DAY_S * NS)
    seconds, ns = divmod(rest, NS)
    day = date.fromordinal(days + UNIX_DAY).isoformat()
    return f"{day}T{seconds // 3600:02}:{seconds // 60 % 60:02}:{seconds % 60:02}.{ns:09}"
