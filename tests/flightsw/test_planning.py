"""The plan of a pass: light, eclipses and expected counts, against skyfield and the sensor."""

import dataclasses
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from skyfield.almanac import find_discrete
from skyfield.api import EarthSatellite

from flightsw.capture.planning import pass_plan
from flightsw.icd.mission import load_mission
from flightsw.navigation.orbit import shadow_crossings
from flightsw.navigation.pose import pose_tag
from hil.sky.sensor import clean_dn

MISSION = load_mission(Path(__file__).parents[2] / "mission.yaml")
ISS = (  # crosses the shadow each revolution; published elements of 2008-09-20
    "1 25544U 98067A   08264.51782528 -.00002182  00000-0 -11606-4 0  2927",
    "2 25544  51.6416 247.4627 0006703 130.5360 325.0288 15.72125391563537",
)


def skyfield_time(timescale, utc_ns: int):
    return timescale.from_datetime(datetime.fromtimestamp(utc_ns / 1e9, UTC))


def test_shadow_crossings_of_a_day_match_skyfield_to_three_seconds(skyfield_oracle):
    start_ns, end_ns = 1_221_913_540_000_000_000, 1_221_913_540_000_000_000 + 12 * 3600 * 10**9
    satellite = EarthSatellite(*ISS, ts=skyfield_oracle[0])

    def dark(t):
        return (~satellite.at(t).is_sunlit(skyfield_oracle[1])).astype(int)

    dark.step_days = 0.0005
    times, values = find_discrete(
        skyfield_time(skyfield_oracle[0], start_ns), skyfield_time(skyfield_oracle[0], end_ns), dark
    )
    expected = [(t.utc_datetime().timestamp(), bool(v)) for t, v in zip(times, values, strict=True)]
    ours = shadow_crossings(ISS, start_ns, end_ns)
    assert len(ours) == len(expected) > 12
    for (our_ns, enters), (their_s, their_enters) in zip(ours, expected, strict=True):
        # skyfield's shadow is that of a point Sun: half a disc of it is hidden within a second
        assert enters == their_enters and abs(our_ns / 1e9 - their_s) < 3


def test_range_phase_and_sun_angle_match_skyfield(skyfield_oracle):
    planned = pass_plan(MISSION).brackets
    satellites = [
        EarthSatellite(*tle, ts=skyfield_oracle[0])
        for tle in (MISSION.orbit.target_tle, MISSION.orbit.chaser_tle)
    ]
    for bracket in planned[::13]:
        time = skyfield_time(
            skyfield_oracle[0], round(datetime.fromisoformat(bracket.utc).timestamp() * 1000) * 1_000_000
        )
        target, chaser = (s.at(time).xyz.m for s in satellites)
        to_sun = (skyfield_oracle[1]["sun"] - skyfield_oracle[1]["earth"]).at(time).xyz.m
        to_sun /= np.linalg.norm(to_sun)
        line = chaser - target
        assert abs(bracket.range_m - np.linalg.norm(line)) < 0.02  # a centimetre each of rounding and frames
        phase = np.degrees(np.arccos(to_sun @ line / np.linalg.norm(line)))
        assert abs(bracket.phase_deg - phase) < 0.01 and abs(bracket.sun_deg - (180 - phase)) < 0.02


def test_expected_counts_are_the_sensors_of_a_white_face():
    bracket = pass_plan(MISSION).brackets[0]
    white = np.ones((1, 1, 1))
    expected = [clean_dn(white, t / 1e3, MISSION.camera).item() for t in bracket.exposure_times_ms]
    np.testing.assert_allclose(bracket.expected_dn, expected, atol=0.5)
    assert bracket.target_px > 1000 and not bracket.eclipse and bracket.pose_valid


def test_passes_end_where_the_shadow_begins():
    # two orbits of the ISS from a second ISS 2 seconds ahead
    ahead = (ISS[0], "2 25544  51.6416 247.4627 0006703 130.5360 325.1588 15.72125391563531")
    orbit = dataclasses.replace(
        MISSION.orbit, target_tle=ISS, chaser_tle=ahead, start_utc="2008-09-20T12:25:40Z"
    )
    bracket = dataclasses.replace(MISSION.bracket, count=200, interval_s=60.0, auto=True)
    plan = pass_plan(dataclasses.replace(MISSION, orbit=orbit, bracket=bracket))
    assert len(plan.passes) >= 2 and len(plan.shadow) >= 4
    for planned_pass in plan.passes:
        inside = plan.brackets[planned_pass.first_bracket : planned_pass.last_bracket + 1]
        assert not any(b.eclipse for b in inside) and planned_pass.frames == 3 * len(inside)
        for utc, _ in plan.shadow:
            assert not planned_pass.start_utc < utc < planned_pass.end_utc
    dark = next(b for b in plan.brackets if b.eclipse)
    assert set(dark.expected_dn) == {round(MISSION.camera.black_dn)}
    lit = plan.brackets[plan.passes[0].first_bracket]
    assert lit.expected_dn[0] < MISSION.camera.white_dn  # the first guess of an automatic bracket


def test_the_phase_is_the_angle_between_tag_and_sun():
    tag = pose_tag(MISSION, MISSION.orbit.start_utc_ns)
    cosine = tag.position_body_m @ tag.sun_dir_body / np.linalg.norm(tag.position_body_m)
    assert pass_plan(MISSION).brackets[0].phase_deg == pytest.approx(np.degrees(np.arccos(cosine)), abs=0.01)
