"""Navigation states of a simulated pass, against the truth and by statistics; the simulated clock of the camera."""

import dataclasses
import json
import math
import socket
import time
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from flightsw.cameras import open_camera
from flightsw.icd.mission import ConfigError, Mission, load_mission
from flightsw.icd.quaternion import quat_to_matrix
from flightsw.pose import PoseTagger
from flightsw.sequencer import plan
from hil.cameras.virtual import CameraServer
from hil.world.clock import LONGEST_WAIT_S, SimulatedClock
from hil.world.navigation import write_flight_inputs
from hil.world.scenario import SCENARIOS, load_scenario
from hil.world.world import World, load_world

NS = 1_000_000_000
MISSION = load_mission(Path(__file__).parents[2] / "mission.yaml")
NAMES = sorted(path.stem for path in SCENARIOS.glob("*.yaml"))


def few_brackets(world: World, count: int, interval_s: float) -> World:
    bracket = dataclasses.replace(world.mission.bracket, count=count, interval_s=interval_s)
    return dataclasses.replace(world, mission=dataclasses.replace(world.mission, bracket=bracket))


@pytest.mark.parametrize("name", NAMES)
def test_a_scenario_s_mission_has_its_orbits_and_brackets_and_survives_the_file(tmp_path, name):
    scenario = load_scenario(name)
    world = load_world(MISSION, name)
    mission = world.mission
    assert mission.orbit.chaser_tle == scenario.orbit.chaser_tle
    assert mission.orbit.start_utc_ns == scenario.orbit.start_utc_ns
    assert mission.bracket.count == min(MISSION.bracket.count, scenario.brackets)
    assert mission.bracket.interval_s * (mission.bracket.count - 1) == pytest.approx(scenario.duration_s)
    half_width = mission.camera.width / 2 / mission.camera.fx_px
    assert 2 * math.degrees(math.atan(half_width)) == pytest.approx(scenario.fov_deg)
    short = few_brackets(world, 1, 2.0)
    read = load_mission(write_flight_inputs(short, tmp_path))
    assert read.navigation.source == f"file://{tmp_path / 'navigation.jsonl'}"
    assert read == dataclasses.replace(short.mission, navigation=read.navigation, sha256=read.sha256)


def lvlh_scenario(folder: Path) -> str:
    text = (SCENARIOS / "v-bar.yaml").read_text()
    path = folder / "held.yaml"
    path.write_text(text[: text.index("attitude:")] + "attitude: {mode: lvlh}\n")
    return str(path)


@pytest.mark.parametrize("name", ["tumbling", "approach", "v-bar", "lvlh"])
def test_flight_tags_frames_of_any_target_with_the_truth(tmp_path, name):
    world = load_world(MISSION, lvlh_scenario(tmp_path) if name == "lvlh" else name)
    world = few_brackets(world, 20, 23.0)
    mission = load_mission(write_flight_inputs(world, tmp_path))
    tagger = PoseTagger(mission)
    for shot in plan(mission):
        tag, true = tagger(shot.mid_exposure_utc_ns), world.pose_at(shot.mid_exposure_utc_ns)
        assert tag.valid and tag.source == "navigation"
        turn = quat_to_matrix(tag.quat_body_to_camera) @ quat_to_matrix(true.quat_body_to_camera).T
        # the tumble accelerates by its rate squared, 5e-4 rad/s², for half of a second between states: 6e-5 rad
        assert Rotation.from_matrix(turn).magnitude() < 6e-5
        in_camera = [t.world_to_camera[:3, 3] for t in (tag, true)]
        np.testing.assert_allclose(*in_camera, atol=1e-3)  # the target's position in the picture
        np.testing.assert_allclose(tag.sun_dir_body, true.sun_dir_body, atol=6e-5)
        assert tag.in_eclipse == true.in_eclipse
    tagger.close()
    assert tagger.navigation_gaps == 0


def test_navigation_errors_are_as_large_as_the_tags_say(tmp_path):
    """The normalised squared error of a consistent filter has the mean of chi² (Bar-Shalom 2001, 5.4): 6 here."""
    world = few_brackets(load_world(MISSION, "v-bar"), 1, 2.0)
    utc_ns = world.mission.orbit.start_utc_ns + NS // 2
    true = world.pose_at(utc_ns)
    errors = []
    for seed in range(100):
        tagger = PoseTagger(load_mission(write_flight_inputs(world, tmp_path, seed)))
        tag = tagger(utc_ns)
        tagger.close()
        turn = quat_to_matrix(tag.quat_body_to_camera) @ quat_to_matrix(true.quat_body_to_camera).T
        rotation = Rotation.from_matrix(turn).as_rotvec()
        error = np.concatenate([tag.position_body_m - true.position_body_m, rotation])
        errors.append(error @ np.linalg.solve(tag.covariance, error))
    four_sigma = 4 * math.sqrt(2 * 6 / len(errors))
    assert np.mean(errors) == pytest.approx(6, abs=four_sigma)


def test_the_same_seed_gives_the_same_errors_and_no_seed_none(tmp_path):
    # the mission's own orbits: navigation is what SGP4 says
    world = few_brackets(load_world(MISSION), 2, 5.0)

    def states(seed: int | None) -> bytes:
        return (write_flight_inputs(world, tmp_path, seed).parent / "navigation.jsonl").read_bytes()

    assert states(1) == states(1) != states(2)
    mission = load_mission(write_flight_inputs(world, tmp_path))
    tagger = PoseTagger(mission)
    for shot in plan(mission):
        tag, true = tagger(shot.mid_exposure_utc_ns), world.pose_at(shot.mid_exposure_utc_ns)
        np.testing.assert_allclose(tag.position_body_m, true.position_body_m, atol=2e-3)
    tagger.close()


def test_an_unknown_scenario_is_refused_with_the_known_ones():
    with pytest.raises(ConfigError, match="fly-around"):
        load_world(MISSION, "flyaround")


# ---- simulated time ----


def at_pace(interval_s: float) -> Mission:
    bracket = dataclasses.replace(MISSION.bracket, interval_s=interval_s)
    return dataclasses.replace(MISSION, bracket=bracket)


@given(
    st.floats(0.1, 1000),
    st.lists(st.tuples(st.floats(0.01, 50), st.floats(0.001, 5)), min_size=1, max_size=20),
)
def test_a_picture_leaves_at_its_time_or_late_and_is_then_counted(factor, frames):
    """Frames are pairs: simulated s since the last exposure, and real s from the last release until it is ready."""
    now_s, waited_s = 0.0, []
    clock = SimulatedClock(at_pace(max(1.5, factor)), factor, clock_s=lambda: now_s)
    elapsed_s, started_s, late = 0.0, None, 0
    for simulated_s, ready_after_s in frames:
        now_s += ready_after_s
        elapsed_s += simulated_s
        if started_s is None:
            started_s, first_s = now_s, elapsed_s
        due_s = started_s + (elapsed_s - first_s) / factor
        late += now_s > due_s + 1e-6
        clock.release(round(elapsed_s * NS), waited_s.append)
        now_s += waited_s[-1]
        assert now_s >= due_s - 1e-6
        assert waited_s[-1] == 0 or now_s == pytest.approx(due_s, abs=1e-6)
    assert clock.late_frames == late


def test_in_lock_step_nothing_waits_and_nothing_is_late():
    clock = SimulatedClock(MISSION)
    for elapsed_s in (5, 0, 10_000):
        clock.release(elapsed_s * NS, lambda seconds: pytest.fail("waited"))
    assert clock.late_frames == 0


@pytest.mark.parametrize("factor", [-1.0, math.nan, math.inf])
def test_an_invalid_factor_is_refused(factor):
    with pytest.raises(ValueError, match="lock step"):
        SimulatedClock(MISSION, factor)


def test_a_factor_at_which_flight_would_time_out_is_refused_and_the_smallest_possible_is_named():
    slow = at_pace(10 * LONGEST_WAIT_S)
    with pytest.raises(ValueError, match="at least 10"):
        SimulatedClock(slow, 1.0)
    SimulatedClock(slow, 10.0)


def test_the_camera_holds_pictures_back_and_says_how_many_were_late():
    size_px = MISSION.camera.width
    slow = iter((0.0, 0.1, 0.0))

    def sky(pose):
        time.sleep(next(slow))
        return np.zeros((size_px, size_px, 1))

    with CameraServer(MISSION, sky, "hil://127.0.0.1:0", real_time=100.0) as server:
        camera = open_camera(server.url, MISSION.camera)
        began_s = time.monotonic()
        for elapsed_s in (0, 1, 150):  # 1.5 s in all; the second is not ready after 0.01 s
            camera.expose(1e-4, MISSION.orbit.start_utc_ns + elapsed_s * NS)
        assert time.monotonic() - began_s >= 1.5
        camera.close()
        with socket.create_connection(server.url.removeprefix("hil://").rsplit(":", 1)) as other:
            slow = iter((0.0,))
            request = {"op": "expose", "exposure_time_s": 1e-4, "start_utc_ns": MISSION.orbit.start_utc_ns}
            other.sendall(json.dumps(request).encode() + b"\n")
            reply = json.loads(other.makefile("rb").readline())
    assert (server.exposures, server.late_frames) == (4, 2)  # the last one was asked for after its time
    assert reply["late_frames"] == 2
