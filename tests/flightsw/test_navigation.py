"""Navigation states: interpolated to mid-exposure, and where there are none, no pose is invented."""

import contextlib
import dataclasses
import json
import socket
import threading
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import CubicHermiteSpline
from scipy.spatial.transform import Rotation, Slerp

from flightsw.errors import NavigationError
from flightsw.icd.mission import Mission, NavigationSection, load_mission
from flightsw.icd.quaternion import quat_to_matrix
from flightsw.navigation.orbit import propagate
from flightsw.navigation.pose import PoseTagger, navigation_tag, pose_tag, target_attitude
from flightsw.navigation.stream import (
    NavigationStream,
    RelativePose,
    SatelliteStates,
    interpolate,
    parse_state,
)

MISSION = load_mission(Path(__file__).parents[2] / "mission.yaml")
START_NS = MISSION.orbit.start_utc_ns
NS = 1_000_000_000


def states_line(utc_ns: int, **more) -> bytes:
    """What a filter would say that knows the orbits as SGP4 does."""
    entry: dict = {"utc_ns": utc_ns, **more}
    for name, tle in (("target", MISSION.orbit.target_tle), ("chaser", MISSION.orbit.chaser_tle)):
        state = propagate(tle, utc_ns)
        entry[name] = {
            "position_m": state.position_m.tolist(),
            "velocity_m_s": state.velocity_m_s.tolist(),
        }
    return json.dumps(entry).encode() + b"\n"


def pose_line(utc_ns: int, covariance: np.ndarray | None = None) -> bytes:
    tag = pose_tag(MISSION, utc_ns)
    return (
        json.dumps(
            {
                "utc_ns": utc_ns,
                "quat_body_to_camera": tag.quat_body_to_camera.tolist(),
                "position_body_m": tag.position_body_m.tolist(),
                "covariance": (tag.covariance if covariance is None else covariance).tolist(),
            }
        ).encode()
        + b"\n"
    )


def correlated(sigma_position_m: float, sigma_rad: float, correlation: float) -> np.ndarray:
    """Return a covariance in which the position along x goes with the rotation about x."""
    covariance = np.diag(np.repeat([sigma_position_m**2, sigma_rad**2], 3))
    covariance[0, 3] = covariance[3, 0] = correlation * sigma_position_m * sigma_rad
    return covariance


def with_navigation(source: str, max_gap_s: float = 2.0, wait_s: float = 0.05) -> Mission:
    return dataclasses.replace(MISSION, navigation=NavigationSection(source, max_gap_s, wait_s))


@pytest.mark.parametrize("line", [states_line, pose_line])
def test_tags_between_states_are_those_of_the_true_orbit(tmp_path, line):
    path = tmp_path / "states.jsonl"
    path.write_bytes(b"".join(line(START_NS + second * NS) for second in range(20)))
    tagger = PoseTagger(with_navigation(f"file://{path}"))
    for offset_s in (0.0, 0.37, 5.5, 5.501, 12.999, 19.0):
        utc_ns = START_NS + round(offset_s * NS)
        tag, true = tagger(utc_ns), pose_tag(MISSION, utc_ns)
        assert tag.valid and tag.source == "navigation"
        # the target turns 1.5 degrees a second; the camera's own turn leaves a millimetre over one second
        assert np.linalg.norm(tag.position_body_m - true.position_body_m) < 2e-3
        turn = quat_to_matrix(tag.quat_body_to_camera) @ quat_to_matrix(true.quat_body_to_camera).T
        assert np.degrees(Rotation.from_matrix(turn).magnitude()) < 1e-3
        np.testing.assert_allclose(tag.sun_dir_body, true.sun_dir_body, atol=1e-9)
    tagger.close()


@given(st.integers(0, 2**32 - 1), st.floats(0, 1), st.floats(0.01, 100))
def test_interpolation_matches_scipy(seed, u, step_s):
    rng = np.random.default_rng(seed)
    step_ns = round(step_s * NS)
    ends = []
    for utc_ns in (START_NS, START_NS + step_ns):
        vectors = rng.normal(size=(4, 3)) * 7e6
        quats = [Rotation.random(rng=rng).as_quat(scalar_first=True) for _ in range(2)]
        root = rng.normal(size=(6, 6))
        ends.append(SatelliteStates(utc_ns, *vectors, *quats, root @ root.T))
    at_ns = START_NS + round(u * step_ns)
    ours = interpolate(ends[0], ends[1], at_ns)
    assert isinstance(ours, SatelliteStates)
    at = (at_ns - START_NS) / NS
    for who in ("target", "chaser"):
        positions = [getattr(e, f"{who}_position_m") for e in ends]
        velocities = [getattr(e, f"{who}_velocity_m_s") for e in ends]
        spline = CubicHermiteSpline([0, step_ns / NS], positions, velocities)
        np.testing.assert_allclose(getattr(ours, f"{who}_position_m"), spline(at), rtol=1e-9, atol=1e-3)
    for name in ("quat_gcrs_to_body", "quat_gcrs_to_chaser"):
        rotations = Rotation.from_quat([getattr(e, name) for e in ends], scalar_first=True)
        expected = Slerp([0, step_ns / NS], rotations)(at).as_matrix()
        np.testing.assert_allclose(quat_to_matrix(getattr(ours, name)), expected, atol=1e-6)
    assert ours.covariance is not None
    assert np.linalg.eigvalsh(ours.covariance)[0] > -1e-9  # a mean of covariances is one


@pytest.mark.parametrize("u", [0.0, 0.3, 1.0])
def test_an_error_along_the_line_of_sight_stays_along_it_while_the_target_spins(u):
    """Range is far less certain than direction; the body axes turn by 80 degrees from one state to the next."""
    sigmas_camera_m, sigma_rad = np.array([0.1, 0.1, 2.0]), 1e-3
    ends = []
    for share in (0, 1):
        body_to_camera = Rotation.from_euler("y", 80.0 * share, degrees=True)
        camera_to_body = body_to_camera.as_matrix().T
        covariance = np.diag([*sigmas_camera_m, *np.full(3, sigma_rad)]) ** 2
        covariance[0, 3] = covariance[3, 0] = 0.5 * sigmas_camera_m[0] * sigma_rad
        covariance[:3] = camera_to_body @ covariance[:3]
        covariance[:, :3] = covariance[:, :3] @ camera_to_body.T
        position_body_m = camera_to_body @ [0.0, 0.0, -20.0]
        quat = body_to_camera.as_quat(scalar_first=True)
        ends.append(RelativePose(START_NS + share * NS, quat, position_body_m, covariance))
    between = interpolate(ends[0], ends[1], START_NS + round(u * NS))
    assert isinstance(between, RelativePose)
    body_to_camera = quat_to_matrix(between.quat_body_to_camera)
    seen = between.covariance.copy()
    seen[:3] = body_to_camera @ seen[:3]
    seen[:, :3] = seen[:, :3] @ body_to_camera.T
    np.testing.assert_allclose(np.sqrt(np.diag(seen)[:3]), sigmas_camera_m, rtol=1e-9)
    np.testing.assert_allclose(seen[0, 3], 0.5 * sigmas_camera_m[0] * sigma_rad, rtol=1e-9)
    np.testing.assert_allclose(body_to_camera @ between.position_body_m, [0, 0, -20.0], atol=1e-9)


def test_each_frame_of_a_bracket_has_its_own_pose_and_covariance(tmp_path):
    path = tmp_path / "states.jsonl"
    small, large = np.eye(6) * 1e-4, np.eye(6) * 4e-4
    path.write_bytes(pose_line(START_NS, small) + pose_line(START_NS + NS, large))
    tagger = PoseTagger(with_navigation(f"file://{path}"))
    tags = [tagger(START_NS + round(s * NS)) for s in (0.0, 0.5, 1.0)]
    np.testing.assert_allclose([t.covariance[0, 0] for t in tags], [1e-4, 2.5e-4, 4e-4])
    assert len({tuple(t.position_body_m) for t in tags}) == 3
    tagger.close()


def test_a_gap_gives_no_pose_and_is_counted(tmp_path):
    path = tmp_path / "states.jsonl"
    path.write_bytes(b"".join(states_line(START_NS + s * NS) for s in (0, 1, 2, 7, 8)))
    tagger = PoseTagger(with_navigation(f"file://{path}"))
    assert tagger(START_NS + NS // 2).valid
    for offset_s in (-1.0, 2.5, 5.0, 8.5):  # before the first, twice in the gap, after the last
        tag = tagger(START_NS + round(offset_s * NS))
        assert not tag.valid and tag.source == "none"
        assert not tag.position_body_m.any() and not tag.covariance.any() and not tag.sun_dir_body.any()
    assert tagger.navigation_gaps == 4
    assert tagger(START_NS + round(7.5 * NS)).valid
    with path.open("ab") as stream:  # the filter goes on: the same stream takes it up
        stream.write(states_line(START_NS + 9 * NS))
    assert tagger(START_NS + round(8.5 * NS)).valid
    tagger.close()


def test_a_time_outside_the_ephemeris_gives_no_pose_and_is_counted():
    tagger = PoseTagger(MISSION)
    tag = tagger(4_000_000_000_000_000_000)  # the year 2096
    assert not tag.valid and tag.source == "none" and tagger.outside_ephemeris == 1
    assert tagger(START_NS).valid
    stale = tagger(START_NS + 8 * 86_400 * NS)
    assert not stale.valid and stale.source == "sgp4" and tagger.stale_elements == 1


def test_states_come_over_a_port_that_opens_late_and_hangs_up():
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]

        def filter_process() -> None:
            for first in (0, 2):
                connection, _ = server.accept()
                with connection:
                    for second in (first, first + 1):
                        line = states_line(START_NS + second * NS)
                        connection.sendall(line[:50])
                        connection.sendall(line[50:])

        thread = threading.Thread(target=filter_process)
        thread.start()
        tagger = PoseTagger(with_navigation(f"tcp://127.0.0.1:{port}", wait_s=10))
        assert tagger(START_NS + NS // 2).valid
        assert tagger(START_NS + round(2.5 * NS)).valid
        thread.join()
        assert tagger.navigation is not None and tagger.navigation.hang_ups == 1
        tagger.close()


def test_the_cameras_mounting_and_place_on_the_chaser_go_into_the_pose():
    quat_chaser = Rotation.from_euler("xyz", [10, 20, 30], degrees=True)
    mounting = Rotation.from_euler("y", 90, degrees=True)
    mission = dataclasses.replace(
        MISSION,
        pose=dataclasses.replace(
            MISSION.pose,
            quat_chaser_to_camera=tuple(mounting.as_quat(scalar_first=True)),
            camera_position_m=(0.5, 0.0, 0.1),
        ),
    )
    state = parse_state(states_line(START_NS))
    assert isinstance(state, SatelliteStates)
    state = dataclasses.replace(state, quat_gcrs_to_chaser=quat_chaser.as_quat(scalar_first=True))
    tag = navigation_tag(mission, state)
    gcrs_to_body = target_attitude(mission, START_NS)
    expected = (mounting * quat_chaser).as_matrix() @ gcrs_to_body.T
    np.testing.assert_allclose(quat_to_matrix(tag.quat_body_to_camera), expected, atol=1e-12)
    centre = state.chaser_position_m + quat_chaser.inv().apply([0.5, 0.0, 0.1]) - state.target_position_m
    np.testing.assert_allclose(tag.position_body_m, gcrs_to_body @ centre, atol=1e-9)
    pointing = pose_tag(
        mission, START_NS
    )  # without an attitude the camera looks along the line to the target
    direction = -pose_tag(MISSION, START_NS).position_body_m
    np.testing.assert_allclose(
        pointing.world_to_camera[2, :3], direction / np.linalg.norm(direction), atol=1e-9
    )


def test_a_covariance_in_gcrs_is_turned_into_the_body_frame(tmp_path):
    covariance = np.diag([1.0, 4.0, 9.0, 1e-4, 1e-4, 1e-4])
    tag = navigation_tag(MISSION, parse_state(states_line(START_NS, covariance=covariance.tolist())))
    gcrs_to_body = target_attitude(MISSION, START_NS)
    expected = gcrs_to_body @ covariance[:3, :3] @ gcrs_to_body.T
    np.testing.assert_allclose(tag.covariance[:3, :3], expected, atol=1e-12)


@pytest.mark.parametrize(
    "change",
    [
        {"utc_ns": 1.5},
        {"utc_ns": True},
        {"quat_body_to_camera": [1, 1, 0, 0]},
        {"quat_body_to_camera": [1, 0, 0]},
        {"position_body_m": [0, 0, float("nan")]},
        {"covariance": [[0] * 6] * 5},
        {"covariance": (-np.eye(6)).tolist()},
        {"covariance": np.triu(np.ones((6, 6))).tolist()},
        {"covariance": correlated(1.0, 1e-5, 2.0).tolist()},  # radians have no scale in common with metres
        {"covariance": (correlated(1.0, 1e-5, 0.5) * (1 + 0.1 * np.triu(np.ones((6, 6)), 3))).tolist()},
    ],
)
def test_a_state_that_cannot_be_is_refused(change):
    entry = json.loads(pose_line(START_NS)) | change
    with pytest.raises(NavigationError):
        parse_state(json.dumps(entry).encode())


def test_a_covariance_without_variance_along_some_direction_may_be_printed_in_seven_digits():
    factor = np.random.default_rng(0).normal(size=(6, 4)) * np.repeat([100.0, 1e-5], 3)[:, None]
    printed = np.array([[float(f"{x:.7g}") for x in row] for row in factor @ factor.T])
    state = parse_state(pose_line(START_NS, printed))
    np.testing.assert_allclose(state.covariance, printed, rtol=1e-12)


@given(st.binary(max_size=200) | st.text(max_size=200).map(str.encode))
def test_any_line_is_a_state_or_a_navigation_error(line):
    with pytest.raises(NavigationError):
        parse_state(line)


@given(st.lists(st.binary(max_size=40), max_size=10))
@settings(max_examples=25)
def test_rubbish_between_states_is_counted_and_passed_over(tmp_path_factory, rubbish):
    path = tmp_path_factory.mktemp("navigation") / "states.jsonl"
    lines = [junk.replace(b"\n", b"?") + b"\n" for junk in rubbish]
    late = [states_line(START_NS)] if rubbish else []  # an old state once more
    path.write_bytes(
        states_line(START_NS)
        + b"".join(lines[:5])
        + b"".join(late)
        + b"".join(lines[5:])
        + states_line(START_NS + NS)
    )
    stream = NavigationStream(NavigationSection(f"file://{path}", wait_s=0.0))
    assert isinstance(stream.at(START_NS + NS // 2), SatelliteStates)
    assert stream.bad_lines == len(rubbish) + len(late)
    stream.close()


STATES = 12  # a second apart
LINES = [pose_line(START_NS + second * NS) for second in range(STATES)]
YEAR_NS = 365 * 86_400 * NS


def with_time(line: bytes, utc_ns: int) -> bytes:
    return json.dumps(json.loads(line) | {"utc_ns": utc_ns}).encode() + b"\n"


def poses_of(path: Path, lines: list[bytes]) -> tuple[dict[float, np.ndarray], int]:
    """Return the positions halfway between the true states, by their time in seconds, and the count of bad lines."""
    path.write_bytes(b"".join(lines))
    stream, positions = NavigationStream(NavigationSection(f"file://{path}", wait_s=0.0)), {}
    for second in range(STATES - 1):
        with contextlib.suppress(NavigationError):
            state = stream.at(START_NS + second * NS + NS // 2)
            assert isinstance(state, RelativePose)
            positions[second + 0.5] = state.position_body_m
    stream.close()
    return positions, stream.bad_lines


@given(
    st.integers(0, STATES - 1),
    st.booleans(),
    st.integers(0, (1 << 63) - 1) | st.integers(START_NS - 20 * NS, START_NS + 20 * NS),
)
def test_a_state_with_a_wrong_time_costs_no_more_than_the_exposures_next_to_it(
    tmp_path_factory, place, is_added, wrong_utc_ns
):
    path = tmp_path_factory.mktemp("navigation") / "states.jsonl"
    undisturbed, _ = poses_of(path, LINES)
    assert len(undisturbed) == STATES - 1
    wrong = with_time(LINES[place], wrong_utc_ns)
    disturbed, bad_lines = poses_of(path, [*LINES[:place], wrong, *LINES[place + (not is_added) :]])
    for at_s, position_m in undisturbed.items():
        if abs(at_s - place) > 2:  # the time may be wrong by less than the gap that is allowed
            np.testing.assert_array_equal(disturbed[at_s], position_m)
    assert bad_lines <= 1


@pytest.mark.parametrize("ahead_ns", [YEAR_NS, -YEAR_NS])
@pytest.mark.parametrize("begin", [0, 4])
def test_a_clock_that_is_wrong_for_some_states_costs_the_poses_of_that_time_only(tmp_path, begin, ahead_ns):
    lines = list(LINES)
    for number in range(begin, begin + 4):
        lines[number] = with_time(lines[number], START_NS + number * NS + ahead_ns)
    poses, bad_lines = poses_of(tmp_path / "states.jsonl", lines)
    assert set(poses) >= {second + 0.5 for second in range(STATES - 1) if not begin - 1 <= second < begin + 4}
    assert ahead_ns < 0 or bad_lines == 4  # what lies long before the others does no harm, and may stay


def test_a_file_that_holds_the_whole_pass_keeps_what_later_exposures_need(tmp_path, monkeypatch):
    monkeypatch.setattr("flightsw.navigation.stream.MAX_STATES", 6)
    monkeypatch.setattr("flightsw.navigation.stream.READ_AHEAD", 3)
    path = tmp_path / "states.jsonl"
    path.write_bytes(b"".join(LINES[:1] + LINES[4:]))  # a gap of 4 s at the beginning
    stream = NavigationStream(NavigationSection(f"file://{path}", wait_s=0.0))
    for at_s in (0.5, 1.5, 2.5, 3.5):
        with pytest.raises(NavigationError, match=r"4\.000 s between states"):
            stream.at(START_NS + round(at_s * NS))
    for second in range(4, STATES - 1):
        assert isinstance(stream.at(START_NS + second * NS + NS // 2), RelativePose)
    stream.close()


def test_a_filter_that_starts_again_with_the_right_time_is_followed(monkeypatch):
    """Its time was a year ahead for longer than the stream reads on: flight hangs up, and the filter is there anew."""
    monkeypatch.setattr("flightsw.navigation.stream.READ_AHEAD", 5)
    with socket.create_server(("127.0.0.1", 0)) as server:

        def filter_process() -> None:
            for ahead_ns in (YEAR_NS, 0):
                connection, _ = server.accept()
                with connection, contextlib.suppress(ConnectionError):
                    for second, line in enumerate(LINES):
                        connection.sendall(with_time(line, START_NS + second * NS + ahead_ns))
                    connection.settimeout(30)
                    connection.recv(1)  # until flight hangs up

        thread = threading.Thread(target=filter_process, daemon=True)
        thread.start()
        source = f"tcp://127.0.0.1:{server.getsockname()[1]}"
        with contextlib.closing(NavigationStream(NavigationSection(source, wait_s=30))) as stream:
            with pytest.raises(NavigationError, match="it begins 31536000"):
                stream.at(START_NS)
            for second in range(STATES - 1):
                assert isinstance(stream.at(START_NS + second * NS + NS // 2), RelativePose)
        thread.join(30)
        assert not thread.is_alive()


def test_a_line_without_end_does_not_fill_the_memory(tmp_path):
    path = tmp_path / "states.jsonl"
    path.write_bytes(b"x" * 1_000_000 + b"\n" + states_line(START_NS))
    stream = NavigationStream(NavigationSection(f"file://{path}", wait_s=0.0))
    assert stream.at(START_NS).utc_ns == START_NS
    assert stream.bad_lines >= 1
    stream.close()


@given(st.integers(1, 400))
def test_the_last_state_needs_no_line_feed_but_must_be_whole(tmp_path_factory, cut):
    path = tmp_path_factory.mktemp("navigation") / "states.jsonl"
    last = states_line(START_NS + NS).rstrip(b"\n")
    for lacking, content in ((0, last), (cut, last[: -(cut % (len(last) - 1)) - 1])):
        path.write_bytes(states_line(START_NS) + content)
        stream = NavigationStream(NavigationSection(f"file://{path}", wait_s=0.0))
        if lacking:
            with pytest.raises(NavigationError):
                stream.at(START_NS + NS // 2)
        else:
            assert isinstance(stream.at(START_NS + NS // 2), SatelliteStates)
        assert stream.bad_lines == 0
        stream.close()


def test_a_line_feed_that_comes_after_its_state_is_no_bad_line(tmp_path):
    path = tmp_path / "states.jsonl"
    path.write_bytes(states_line(START_NS) + states_line(START_NS + NS).rstrip(b"\n"))
    stream = NavigationStream(NavigationSection(f"file://{path}", wait_s=0.0))
    assert isinstance(stream.at(START_NS + NS // 2), SatelliteStates)
    with path.open("ab") as file:
        file.write(b"\n" + states_line(START_NS + 2 * NS))
    assert isinstance(stream.at(START_NS + NS + NS // 2), SatelliteStates)
    assert stream.bad_lines == 0
    stream.close()


def test_a_missing_file_is_named():
    with pytest.raises(NavigationError, match=r"/nowhere/states\.jsonl"):
        NavigationStream(NavigationSection("file:///nowhere/states.jsonl"))


def test_states_of_different_kinds_are_not_mixed(tmp_path):
    path = tmp_path / "states.jsonl"
    path.write_bytes(states_line(START_NS) + pose_line(START_NS + NS))
    stream = NavigationStream(NavigationSection(f"file://{path}", wait_s=0.0))
    with pytest.raises(NavigationError, match="gap"):
        stream.at(START_NS + NS // 2)
    assert isinstance(stream.at(START_NS + NS), RelativePose)
    stream.close()
