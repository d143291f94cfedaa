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
from flightsw.capture.sequencer import plan
from flightsw.icd.mission import ConfigError, Mission, load_mission
from flightsw.icd.quaternion import quat_to_matrix
from flightsw.icd.tle import orbit_axes
from flightsw.navigation.orbit import propagate
from flightsw.navigation.pose import PoseTagger
from hil.cameras.virtual import CameraServer
from hil.world.clock import LONGEST_WAIT_S, SimulatedClock
from hil.world.navigation import write_flight_inputs
from hil.world.navigation_errors import draw, stated_sigmas
from hil.world.scenario import SCENARIOS, load_scenario
from hil.world.world import World, load_world, told
from obbgs_base.physics.navigation_errors import NominalMotion, SharedParameters, displaced
from tests.hil.test_scenario import BY_BASILISK

NS = 1_000_000_000
MISSION = load_mission(Path(__file__).parents[2] / "mission.yaml")
NAMES = sorted(p.stem for p in SCENARIOS.glob("*.yaml") if load_scenario(p).basilisk is None)


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
    assert mission.bracket.interval_s * mission.bracket.count == pytest.approx(scenario.duration_s)
    half_width = mission.camera.width / 2 / mission.camera.fx_px
    assert 2 * math.degrees(math.atan(half_width)) == pytest.approx(scenario.fov_deg)
    short = few_brackets(world, 1, 2.0)
    read = load_mission(write_flight_inputs(short, tmp_path, None).mission_path)
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
    mission = load_mission(write_flight_inputs(world, tmp_path, None).mission_path)
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


def errors_at_start(seed: int, latitude_rad: float, rate_rad_s: float) -> np.ndarray:
    """Return drawn errors in the order of the stated sigmas: position, velocity (RTN), boresight, clock, spin rate."""
    drawn = draw(400.0, seed)

    def position_m(elapsed_s: float) -> np.ndarray:
        return drawn.position_rtn_m(latitude_rad + rate_rad_s * elapsed_s, elapsed_s, rate_rad_s)

    velocity_m_s = (position_m(1.0) - position_m(-1.0)) / 2
    boresight_deg = np.degrees(drawn.boresight_rad)
    return np.array([*position_m(0.0), *velocity_m_s, *boresight_deg, drawn.clock_s, drawn.spin_rate * 1.5])


def test_errors_are_as_large_as_what_is_stated_says():
    """The mean of squares in units of the stated variances is 1 (consistency of a filter, Bar-Shalom 2001, 5.4)."""
    rate_rad_s = 1.1e-3
    stated = stated_sigmas(400.0, np.array([0.0, 1.5, 0.0]), rate_rad_s)
    sigmas = [
        *stated.position_m,
        *stated.velocity_m_s,
        *[stated.boresight_deg] * 3,
        stated.clock_s,
        stated.rate_deg_s[1],
    ]
    latitudes = np.random.default_rng(5).uniform(0, 2 * np.pi, 600)
    squares = np.array([(errors_at_start(i, u, rate_rad_s) / sigmas) ** 2 for i, u in enumerate(latitudes)])
    four_deviations = 4 * squares.std(axis=0) / math.sqrt(len(squares))
    assert (np.abs(squares.mean(axis=0) - 1) < four_deviations).all()
    assert stated.rate_deg_s[0] == stated.focal == stated.attitude_deg == 0


def geometry(world: World, times_ns: list[int]) -> dict[str, np.ndarray]:
    to_body = np.array([world.gcrs_to_body(ns) for ns in times_ns])
    poses = [world.pose_at(ns) for ns in times_ns]
    return {
        "position_m": np.array([b.T @ p.position_body_m for b, p in zip(to_body, poses, strict=True)]),
        "inertial_to_camera": np.array(
            [quat_to_matrix(p.quat_body_to_camera) @ b for b, p in zip(to_body, poses, strict=True)]
        ),
        "inertial_to_body": to_body,
    }


# not tumbling-disturbed: the model is free of torque, and a tumble about the middle axis soon leaves it
@pytest.mark.parametrize("name", ["", "v-bar", "tumbling", "fly-around-disturbed", "v-bar-drag"])
def test_tags_err_as_the_model_of_shared_errors_says(tmp_path, name):
    """From the truth, the model that the ground estimates with leads to flight's tags, but for their noise."""
    if name in BY_BASILISK:
        pytest.importorskip("Basilisk", reason="needs Basilisk: pip install 'obbgs[basilisk]'")
    world = load_world(MISSION, name)
    count = 12
    world = few_brackets(world, count, 60.0)
    inputs = write_flight_inputs(world, tmp_path, seed=4)
    mission, errors = load_mission(inputs.mission_path), inputs.errors
    assert errors is not None
    start_ns = mission.orbit.start_utc_ns
    times_ns = [start_ns + i * 60 * NS + NS // 2 for i in range(count)]
    rate, axes = orbit_axes(mission.orbit.target_tle, start_ns)
    spin = world.gcrs_to_body(start_ns + NS // 100) @ world.gcrs_to_body(start_ns).T
    spin_rad_s = -100 * Rotation.from_matrix(spin).as_rotvec()
    inertia = np.array(load_scenario(name).attitude.inertia) if name else np.ones(3)
    motion = NominalMotion(
        (np.array(times_ns) - start_ns) / NS,
        **geometry(world, times_ns),
        mean_motion_rad_s=rate,
        inertial_to_rtn=axes,
        rate_rad_s=spin_rad_s,
        inertia=inertia,
    )
    state = propagate(mission.orbit.target_tle, start_ns)
    normal = np.cross(state.position_m, state.velocity_m_s)
    node = np.cross([0, 0, 1], normal)
    cosine = node @ state.position_m / np.linalg.norm(node) / np.linalg.norm(state.position_m)
    latitude = math.acos(cosine) if state.position_m[2] > 0 else 2 * math.pi - math.acos(cosine)
    at_start = errors.position_rtn_m(latitude, 0.0, rate)
    before, after = (errors.position_rtn_m(latitude + t * rate, t, rate) for t in (-1.0, 1.0))
    parameters = SharedParameters(
        position_m=at_start,
        velocity_m_s=(after - before) / 2,
        rate_rad_s=errors.spin_rate * spin_rad_s,
        boresight_rad=errors.boresight_rad,
        clock_s=[-errors.clock_s],
    )
    expected = displaced(motion, parameters)
    tagger = PoseTagger(mission)
    tags = [tagger(ns) for ns in times_ns]
    tagger.close()
    turns = []
    for tag, pose in zip(tags, expected, strict=True):
        turns.append(Rotation.from_matrix(tag.world_to_camera[:3, :3] @ pose[:3, :3].T).as_rotvec())
        centre_m = -pose[:3, :3].T @ pose[:3, 3]
        error_m = np.linalg.norm(tag.position_body_m - centre_m)
        assert error_m < 0.01 * np.linalg.norm(at_start)
    noise = math.degrees(np.std(turns))
    assert 0.012 < noise < 0.03  # 0.02 degrees, of 36 numbers
    assert np.linalg.norm(tags[0].position_body_m - world.pose_at(times_ns[0]).position_body_m) > 0.01 * 60


@pytest.mark.parametrize("spacing_s, alike", [(0.5, True), (None, False)])
def test_the_noise_of_navigation_differs_between_exposures_that_are_far_apart(tmp_path, spacing_s, alike):
    world = few_brackets(load_world(MISSION, "v-bar"), 6, 24.0)
    bracket = dataclasses.replace(world.mission.bracket, frame_spacing_s=spacing_s)
    world = dataclasses.replace(world, mission=dataclasses.replace(world.mission, bracket=bracket))
    mission = load_mission(write_flight_inputs(world, tmp_path, 3).mission_path)
    tagger = PoseTagger(mission)
    turns = []
    for shot in plan(mission):
        true = world.pose_at(shot.start_utc_ns).world_to_camera[:3, :3]
        turn = tagger(shot.start_utc_ns).world_to_camera[:3, :3] @ true.T
        turns.append(np.degrees(Rotation.from_matrix(turn).as_rotvec()))
    tagger.close()
    # the shared errors hardly change within a bracket
    turns = np.array(turns).reshape(6, 3, 3)
    within = np.std(turns - turns.mean(axis=1, keepdims=True))
    assert (within < 0.004) == alike


@pytest.mark.parametrize("knowledge", ["rate_only", "unknown"])
def test_flight_is_told_no_more_of_the_attitude_than_the_mission_says(tmp_path, knowledge):
    world = few_brackets(load_world(told(MISSION, knowledge), "tumbling"), 3, 60.0)
    mission = load_mission(write_flight_inputs(world, tmp_path, None).mission_path)
    tagger = PoseTagger(mission)
    start_ns = mission.orbit.start_utc_ns
    for shot in plan(mission):
        tag, true = tagger(shot.mid_exposure_utc_ns), world.pose_at(shot.mid_exposure_utc_ns)
        assert tag.attitude == knowledge
        free_ns = start_ns if knowledge == "rate_only" else shot.mid_exposure_utc_ns
        to_body = world.gcrs_to_body(free_ns)
        np.testing.assert_allclose(to_body @ tag.position_body_m, true.position_body_m, atol=0.05)
        turn = (
            quat_to_matrix(tag.quat_body_to_camera) @ to_body.T @ quat_to_matrix(true.quat_body_to_camera).T
        )
        assert Rotation.from_matrix(turn).magnitude() < 1e-4
        np.testing.assert_allclose(to_body @ tag.sun_dir_body, true.sun_dir_body, atol=1e-4)
    tagger.close()


def test_the_same_seed_gives_the_same_errors_and_no_seed_none(tmp_path):
    # the mission's own orbits: navigation is what SGP4 says
    world = few_brackets(load_world(MISSION), 2, 5.0)

    def states(seed: int | None) -> bytes:
        write_flight_inputs(world, tmp_path, seed)
        return (tmp_path / "navigation.jsonl").read_bytes()

    assert states(1) == states(1) != states(2)
    mission = load_mission(write_flight_inputs(world, tmp_path, None).mission_path)
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
