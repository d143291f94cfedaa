"""The ready-made scenarios, and their geometry and light against skyfield."""

from datetime import UTC, datetime

import numpy as np
import pytest
from skyfield.api import EarthSatellite

from flightsw.icd.mission import ConfigError, Mission, TargetAttitudeSection
from flightsw.navigation.pose import pose_tag
from hil.world.scenario import SCENARIOS, Scenario, Scene, describe, load_scenario

NAMES = ["approach", "eclipse", "fly-around", "slow-tumble", "sparse", "tumbling", "v-bar"]
BY_BASILISK = ["fly-around-disturbed", "tumbling-disturbed", "v-bar-drag"]  # tests/hil/test_basilisk.py


def test_the_ready_made_scenarios_are_these():
    assert sorted(path.stem for path in SCENARIOS.glob("*.yaml")) == sorted(NAMES + BY_BASILISK)


@pytest.mark.parametrize("name", ["fly-around", "approach"])
def test_range_phase_angle_sun_and_eclipse_match_skyfield(skyfield_oracle, name):
    timescale, ephemeris = skyfield_oracle
    scenario = load_scenario(name)
    scene = Scene(scenario)
    target, chaser = (
        EarthSatellite(*tle, ts=timescale) for tle in (scene.orbit.target_tle, scene.orbit.chaser_tle)
    )
    for elapsed_s in (0, 1700, 3900):
        utc_ns = scene.orbit.start_utc_ns + elapsed_s * 10**9
        state = scene.state(utc_ns)
        time = timescale.from_datetime(datetime.fromtimestamp(utc_ns / 1e9, UTC))
        relative_m = chaser.at(time).xyz.m - target.at(time).xyz.m
        assert state.range_m == pytest.approx(np.linalg.norm(relative_m), abs=0.01)
        # 0.15 arcsec of frame over 400 m is a millimetre
        np.testing.assert_allclose(state.chaser.position_m - state.target.position_m, relative_m, atol=0.01)
        sun_m = (ephemeris["sun"] - ephemeris["earth"]).at(time).xyz.m - target.at(time).xyz.m
        cosine = sun_m @ relative_m / np.linalg.norm(sun_m) / np.linalg.norm(relative_m)
        # the Sun as seen from the Earth's centre: parallax of the orbit 0.003 degrees
        assert np.degrees(state.phase_angle_rad) == pytest.approx(np.degrees(np.arccos(cosine)), abs=0.01)
        assert (state.sunlit > 0.5) == bool(target.at(time).is_sunlit(ephemeris))
        # directions in the body frame keep the angles of the inertial ones
        earth = -target.at(time).xyz.m / np.linalg.norm(target.at(time).xyz.m)
        body_angle = state.earth_dir_body @ state.pose.sun_dir_body
        assert body_angle == pytest.approx(earth @ sun_m / np.linalg.norm(sun_m), abs=2e-4)


def test_the_eclipse_scenario_enters_and_leaves_the_shadow_when_skyfield_says(skyfield_oracle):
    timescale, ephemeris = skyfield_oracle
    scene = Scene(load_scenario("eclipse"))
    target = EarthSatellite(*scene.orbit.target_tle, ts=timescale)
    times_s = np.arange(0, 5690, 10)
    ours = np.array([scene.state(scene.orbit.start_utc_ns + int(t) * 10**9).sunlit < 0.5 for t in times_s])
    start = datetime.fromtimestamp(scene.orbit.start_utc_ns / 1e9, UTC)
    theirs = ~target.at(
        timescale.utc(start.year, start.month, start.day, start.hour, start.minute, start.second + times_s)
    ).is_sunlit(ephemeris)
    assert 60 < ours.sum() < 200
    assert (ours != theirs).sum() <= 4  # skyfield's Sun is a point: some seconds at each of two edges
    assert not ours[0] and not ours[-1]  # the shadow is in the middle


def test_the_camera_looks_at_the_target_and_is_where_the_orbits_are():
    scene = Scene(load_scenario("tumbling"))
    for elapsed_s in (0, 500, 3000):
        state = scene.state(scene.orbit.start_utc_ns + elapsed_s * 10**9)
        origin = state.pose.world_to_camera @ [0, 0, 0, 1]
        np.testing.assert_allclose(origin[:3], [0, 0, state.range_m], atol=1e-6)
        assert np.linalg.norm(state.relative_rtn_m) == pytest.approx(state.range_m)
        # the phase angle is the same in the body frame as in the inertial one
        cosine = state.pose.position_body_m @ state.pose.sun_dir_body / state.range_m
        assert np.arccos(cosine) == pytest.approx(state.phase_angle_rad, abs=1e-6)


def test_a_spinning_scenario_has_the_poses_that_flight_computes():
    scenario = load_scenario("fly-around")
    scene = Scene(scenario)
    camera = _camera()
    mission = Mission(scene.orbit, camera, TargetAttitudeSection("spin", "sun", scenario.attitude.period_s))
    for elapsed_s in (0, 1234):
        utc_ns = scene.orbit.start_utc_ns + elapsed_s * 10**9
        theirs, ours = pose_tag(mission, utc_ns), scene.state(utc_ns).pose
        np.testing.assert_allclose(ours.world_to_camera, theirs.world_to_camera, atol=1e-6)
        np.testing.assert_allclose(ours.sun_dir_body, theirs.sun_dir_body, atol=1e-12)
        assert ours.in_eclipse == theirs.in_eclipse


def _camera():
    from hil.sky.sensor import PRESETS

    return PRESETS["spacecam"].camera_section(64, 64, 1000.0)


def test_the_scenarios_are_what_their_descriptions_say():
    facts = {name: describe(load_scenario(name)) for name in NAMES}
    for name in NAMES:
        assert (facts[name]["brackets_in_eclipse"] > 0) == (name == "eclipse")
        assert facts[name]["error_max_m"] < 10
        assert (
            "drift_m_per_orbit" not in facts[name]
        )  # the chaser of `approach` drifts by 94 m: what is told is an error
    assert facts["sparse"]["brackets"] == 12
    assert facts["fly-around"]["sun_moves_deg"] < 0.1 < 90 < facts["tumbling"]["sun_moves_deg"]
    low, high = facts["fly-around"]["range_m"]
    assert low > 395 and high < 405
    low, high = facts["v-bar"]["range_m"]
    assert low > 59 and high < 61
    low, high = facts["approach"]["range_m"]
    assert 50 < low < 70 and 110 < high < 140


def test_brackets_are_spread_over_the_duration():
    scenario = load_scenario("fly-around")
    section = scenario.bracket_section((0.05, 0.1, 0.2), 40)
    assert section.count == 40 and section.interval_s * 39 == pytest.approx(scenario.duration_s)
    assert scenario.bracket_section((0.05,)).count == scenario.brackets


@pytest.mark.parametrize(
    ("change", "key", "wrong"),
    [
        ("degree: 6", "degree: 1", "basilisk.gravity_degree"),
        ("degree: 6", "degree: 7", "basilisk.gravity_degree"),
        ("5.0e-13", "-5.0e-13", "basilisk.density_kg_m3"),
        ("mass_kg: 60.0", "mass_kg: 0.0", "basilisk.chaser.mass_kg"),
        ("[0.1, 0.0, 0.2]", "[0.1, 0.0]", "basilisk.target.drag_offset_m"),
        ("solar_pressure", "sun", "basilisk.sun"),
    ],
)
def test_a_wrong_disturbance_is_refused_by_name_without_basilisk(tmp_path, change, key, wrong):
    path = tmp_path / "mine.yaml"
    text = (SCENARIOS / "fly-around-disturbed.yaml").read_text()
    assert load_scenario("fly-around-disturbed").basilisk is not None and change in text
    path.write_text(text.replace(change, key))
    with pytest.raises(ConfigError, match=rf"scenario\.{wrong}: "):
        load_scenario(path)


@pytest.mark.parametrize(
    ("change", "key"),
    [
        ("radial_m: 200.0", "radial_m: -1.0"),
        ("fly_around:", "flyaround:"),
        ("duration_s: 3900.0", "duration_s: 0.0"),
        ("31698  97.4457", "31698  97.4458"),
        ("mode: spin", "mode: wobble"),
        ("fly_around:", "relative_elements: {dlambda_m: 3.0}\nfly_around:"),
    ],
)
def test_a_wrong_scenario_is_refused_by_name(tmp_path, change, key):
    path = tmp_path / "mine.yaml"
    text = (SCENARIOS / "fly-around.yaml").read_text()
    assert change in text
    path.write_text(text)
    assert isinstance(load_scenario(path), Scenario)
    path.write_text(text.replace(change, key))
    with pytest.raises(ConfigError, match=r"scenario|mission\.orbit"):
        load_scenario(path)


def test_an_unknown_scenario_is_answered_with_the_known_ones():
    with pytest.raises(ConfigError, match="fly-around, fly-around-disturbed, slow-tumble, sparse, tumbling"):
        load_scenario("fly_around")
