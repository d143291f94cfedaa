"""Checks of what the pass needs to be tagged with poses: elements, the Sun's ephemeris, the navigation source."""

import time
from datetime import UTC, datetime

import numpy as np

from flightsw.capture.planning import field_of_view
from flightsw.errors import NavigationError, OrbitError
from flightsw.icd.mission import Mission
from flightsw.navigation.messages import MessageNavigation
from flightsw.navigation.orbit import propagate, sun_position_gcrs
from flightsw.navigation.pose import open_navigation
from flightsw.selftest.finding import Finding
from obbgs_base.errors import counted

NS = 1_000_000_000
MOST_LOOKED_AT = 400  # brackets, spread over the pass, for the range of the target
NEWER = "put newer two-line elements into the mission file, on the ground as well"


def check_orbit(mission: Mission) -> list[Finding]:
    """Check that both satellites and the Sun can be computed in the pass and now, and how old the elements are."""
    orbit, bracket = mission.orbit, mission.bracket
    now_ns, first_ns = time.time_ns(), mission.orbit.start_utc_ns
    last_ns = first_ns + round((bracket.count - 1) * bracket.interval_s * NS)
    times = {"the first trigger": first_ns, "the last trigger": last_ns, "now": now_ns}
    ages_days, ranges_m = {}, {}
    for name, utc_ns in times.items():
        try:
            states = [propagate(tle, utc_ns) for tle in (orbit.target_tle, orbit.chaser_tle)]
            sun_position_gcrs(utc_ns)
        except OrbitError as error:
            state = Finding.warning if name == "now" else Finding.failed
            return [state("orbit", f"at {name} ({_utc(utc_ns)}): {error}", NEWER)]
        ages_days[name] = max(abs(state.element_age_days) for state in states)
        ranges_m[name] = float(np.linalg.norm(states[0].position_m - states[1].position_m))
    findings = []
    by_elements = mission.navigation.source == "sgp4"
    if not all(ranges_m.values()):
        state = Finding.failed if by_elements else Finding.warning
        found = "target and chaser are at the same place: are these the elements of two spacecraft?"
        findings.append(state("orbit", found, "correct orbit.target_tle or orbit.chaser_tle"))
    elif not by_elements and ages_days["the last trigger"] > orbit.max_element_age_days:
        found = (
            f"elements are {ages_days['the last trigger']:z.1f} days old at the last trigger, "
            f"{orbit.max_element_age_days:g} are allowed: poses come from navigation, but the plan of the pass and the "
            "Earth's shadow are less exact"
        )
        findings.append(Finding.warning("orbit", found, NEWER))
    elif ages_days["the first trigger"] > orbit.max_element_age_days:
        found = (
            f"elements are {ages_days['the first trigger']:z.1f} days old at the first trigger, "
            f"{orbit.max_element_age_days:g} are allowed: every pose will be marked invalid"
        )
        findings.append(Finding.failed("orbit", found, NEWER))
    elif ages_days["the last trigger"] > orbit.max_element_age_days:
        found = (
            f"elements are {ages_days['the last trigger']:z.1f} days old at the last trigger, "
            f"{orbit.max_element_age_days:g} are allowed: poses at the end of the pass will be marked invalid"
        )
        findings.append(Finding.warning("orbit", found, NEWER))
    if last_ns < now_ns:
        days = (now_ns - last_ns) / (86_400 * NS)
        found = f"the pass ended {days:z.1f} days ago; elements are {ages_days['now']:z.1f} days old now"
        findings.append(
            Finding.warning("orbit", found, "set orbit.start_utc, or give --start now on a bench")
        )
    if not findings:
        found = (
            f"first trigger at {_utc(first_ns)}, range {ranges_m['the first trigger']:.0f} m, elements "
            f"{ages_days['the first trigger']:z.1f} days old then, {ages_days['now']:z.1f} now"
        )
        findings.append(Finding.ok("orbit", found))
    if not by_elements:
        findings += _navigation(mission)
    return findings


def check_view(mission: Mission) -> list[Finding]:
    """Check that the camera's figures fit to the target: field of view, share of the picture, line of sight.

    Says nothing where the orbits cannot be computed or are one, which `check_orbit` tells.
    """
    orbit, bracket = mission.orbit, mission.bracket
    ranges_m = []
    for trigger in np.linspace(0, bracket.count - 1, min(bracket.count, MOST_LOOKED_AT)).round().tolist():
        utc_ns = orbit.start_utc_ns + round(trigger * bracket.interval_s * NS)
        try:
            states = [propagate(tle, utc_ns) for tle in (orbit.target_tle, orbit.chaser_tle)]
        except OrbitError:
            return []
        ranges_m.append(float(np.linalg.norm(states[0].position_m - states[1].position_m)))
    if not all(ranges_m):
        return []
    view, problems = field_of_view(mission, ranges_m)
    advice = "correct camera and bracket.target_extent_m, and look at `flightsw plan`"
    return [Finding.warning("view", problem, advice) for problem in problems] or [Finding.ok("view", view)]


def _navigation(mission: Mission) -> list[Finding]:
    """Check that the navigation source can be opened and sends states; of messages, that they cover the pass."""
    advice, section = "start the navigation filter, or correct navigation.source", mission.navigation
    try:
        stream = open_navigation(mission)
        if isinstance(stream, MessageNavigation):
            first_ns = mission.orbit.start_utc_ns
            last_ns = first_ns + round((mission.bracket.count - 1) * mission.bracket.interval_s * NS)
            for utc_ns in (first_ns, last_ns):
                stream.at(utc_ns)
            return [
                Finding.ok(
                    "navigation", f"{section.source} covers the pass, {_utc(first_ns)} to {_utc(last_ns)}"
                )
            ]
    except (NavigationError, OrbitError) as error:
        return [Finding.failed("navigation", str(error), advice)]
    assert stream is not None
    try:
        state = stream.first(section.wait_s)
    finally:
        stream.close()
    if state is None:
        unreadable = counted(stream.bad_lines, "unreadable line")
        found = f"no state came from {section.source} in {section.wait_s:g} s ({unreadable})"
        return [Finding.failed("navigation", found, advice)]
    return [Finding.ok("navigation", f"{section.source} sends states, the first of {_utc(state.utc_ns)}")]


def _utc(utc_ns: int) -> str:
    return datetime.fromtimestamp(utc_ns / NS, UTC).strftime("%Y-%m-%dT%H:%M:%SZ")
