"""What a planned pass will see: range, light, eclipse and what the sensor should read, bracket by bracket."""

import itertools
from dataclasses import dataclass

import numpy as np

from flightsw.capture.bracket import Geometry, bracket_times_s, expected_light
from flightsw.capture.sequencer import NS, plan
from flightsw.icd.mission import Mission
from flightsw.navigation.orbit import shadow_crossings
from flightsw.navigation.pose import pose_tag

WIDEST_DEG = 120.0  # a pinhole camera; lenses that see more are no pinholes
SAME_RANGE = 1.01  # ranges whose ratio is smaller show the target equally large
FEWEST_PX = 8  # across the target, for a picture of it


@dataclass(frozen=True)
class PlannedBracket:
    bracket: int
    utc: str
    range_m: float
    phase_deg: float  # between Sun and camera, seen from the target: 0 is full light
    sun_deg: float  # between the camera's axis and the Sun: small is blinding
    px_per_m: float
    filled: float  # the target's largest dimension as a share of the picture's smaller side
    target_px: int  # pixels a face of the target's largest dimension would cover
    eclipse: bool
    pose_valid: bool
    exposure_times_ms: tuple[float, ...]
    # brightest of a white target in each exposure (`expected_light`); full scale is saturated
    expected_dn: tuple[int, ...]


@dataclass(frozen=True)
class PlannedPass:
    """Consecutive brackets in sunlight."""

    first_bracket: int
    last_bracket: int
    start_utc: str
    end_utc: str
    frames: int
    range_m: tuple[float, float]  # least and greatest
    phase_deg: tuple[float, float]


@dataclass(frozen=True)
class PassPlan:
    view: str  # picture, field of view and how much of the picture the target fills, in words
    problems: list[str]  # what makes the camera's figures implausible
    brackets: list[PlannedBracket]
    passes: list[PlannedPass]
    shadow: list[tuple[str, str]]  # UTC, "enters" or "leaves": the target and the Earth's shadow


def pass_plan(mission: Mission) -> PassPlan:
    """Return the plan of the mission's bracket section, from SGP4; automatic exposure times are the first guess.

    Raises:
        OrbitError: the orbits or the Sun cannot be computed for these times.
    """
    triggers = [shot.start_utc_ns for shot in plan(mission) if shot.bracket_index == 0]
    brackets = [_bracket(mission, number, trigger_ns) for number, trigger_ns in enumerate(triggers)]
    passes = []
    for eclipse, group in itertools.groupby(brackets, key=lambda b: b.eclipse):
        if not eclipse:
            passes.append(_pass(list(group)))
    end_ns = triggers[-1] + round(mission.bracket.interval_s * NS)
    crossings = shadow_crossings(mission.orbit.target_tle, triggers[0], end_ns)
    shadow = [(_utc(utc_ns), "enters" if enters else "leaves") for utc_ns, enters in crossings]
    view, problems = field_of_view(mission, [bracket.range_m for bracket in brackets])
    if stale := sum(not bracket.pose_valid for bracket in brackets):
        problems.append(
            f"the elements are more than {mission.orbit.max_element_age_days:g} days from {stale} of {len(brackets)} "
            "brackets, whose poses will be marked invalid: are orbit.start_utc and the elements right?"
        )
    return PassPlan(view, problems, brackets, passes, shadow)


def field_of_view(mission: Mission, ranges_m: list[float]) -> tuple[str, list[str]]:
    """Return in words the camera's field of view, how much of it the target fills, and what is implausible about it.

    Args:
        ranges_m: of the target at each bracket.
    """
    camera, extent_m = mission.camera, mission.bracket.target_extent_m
    least_m, greatest_m = min(ranges_m), max(ranges_m)
    degrees = [
        float(np.degrees(np.arctan((size - centre) / focal) + np.arctan(centre / focal)))
        for size, centre, focal in (
            (camera.width, camera.cx_px, camera.fx_px),
            (camera.height, camera.cy_px, camera.fy_px),
        )
    ]
    side_px = min(camera.width, camera.height)
    most_px, least_px = (camera.fx_px * extent_m / range_m for range_m in (least_m, greatest_m))
    ends = [(most_px, least_m), (least_px, greatest_m)]
    if greatest_m < SAME_RANGE * least_m:
        ends = ends[:1]
    sizes = " and ".join(f"{px:.0f} px at {range_m:.0f} m" for px, range_m in ends)
    shares = " and ".join(f"{px / side_px:.0%}" for px, _ in ends)
    view = (
        f"{camera.width} x {camera.height} px see {degrees[0]:.3g} x {degrees[1]:.3g} degrees; "
        f"a target of {extent_m:g} m is {sizes}, {shares} "
        "of the picture's smaller side"
    )
    problems = []
    for name, centre, size in (("cx_px", camera.cx_px, camera.width), ("cy_px", camera.cy_px, camera.height)):
        if not 0 <= centre <= size:
            problems.append(
                f"camera.{name} is {centre:g} and the picture ends at {size}: "
                "the line of sight lies outside the picture"
            )
    if max(degrees) > WIDEST_DEG:
        problems.append(
            f"the camera sees {max(degrees):.0f} degrees: is fx_px the focal length in pixels, not in millimetres?"
        )
    if most_px < FEWEST_PX:
        problems.append(
            f"the target is {most_px:.1f} px at {least_m:.0f} m, fewer than {FEWEST_PX} px show nothing: are the "
            "orbits, fx_px and bracket.target_extent_m right?"
        )
    if least_px > side_px:
        problems.append(
            f"the target does not fit into the picture even at {greatest_m:.0f} m: are the orbits, "
            "fx_px and bracket.target_extent_m right?"
        )
    return view, problems


def _bracket(mission: Mission, number: int, trigger_ns: int) -> PlannedBracket:
    camera, section = mission.camera, mission.bracket
    tag = pose_tag(mission, trigger_ns)
    range_m = float(np.linalg.norm(tag.position_body_m))
    geometry = Geometry.of(tag)
    times_s: tuple[float, ...] = tuple(sorted(section.exposure_times_s))
    highlight = 0.0
    if geometry is not None:
        light = expected_light(geometry, camera, section.target_extent_m)
        highlight = light.highlight
        if section.auto:
            times_s = bracket_times_s(light, camera, section)
    signals_dn = [camera.black_dn + camera.dn_per_radiance_s * t * highlight for t in times_s]
    boresight = tag.world_to_camera[2, :3]
    px_per_m = camera.fx_px / range_m
    return PlannedBracket(
        bracket=number,
        utc=_utc(trigger_ns),
        range_m=round(range_m, 2),
        phase_deg=_angle_deg(tag.position_body_m / range_m, tag.sun_dir_body),
        sun_deg=_angle_deg(boresight, tag.sun_dir_body),
        px_per_m=round(px_per_m, 2),
        filled=round(px_per_m * section.target_extent_m / min(camera.width, camera.height), 4),
        target_px=round((px_per_m * section.target_extent_m) ** 2),
        eclipse=tag.in_eclipse,
        pose_valid=tag.valid,
        exposure_times_ms=tuple(round(t * 1e3, 4) for t in times_s),
        expected_dn=tuple(min(round(dn), camera.white_dn) for dn in signals_dn),
    )


def _pass(brackets: list[PlannedBracket]) -> PlannedPass:
    ranges, phases = [b.range_m for b in brackets], [b.phase_deg for b in brackets]
    return PlannedPass(
        brackets[0].bracket,
        brackets[-1].bracket,
        brackets[0].utc,
        brackets[-1].utc,
        sum(len(b.exposure_times_ms) for b in brackets),
        (min(ranges), max(ranges)),
        (min(phases), max(phases)),
    )


def _angle_deg(a: np.ndarray, b: np.ndarray) -> float:
    return round(float(np.degrees(np.arccos(np.clip(a @ b, -1, 1)))), 2)


def _utc(utc_ns: int) -> str:
    return str(np.datetime64(utc_ns, "ns"))[:23] + "Z"
