"""Poses from CCSDS messages: those of the same orbits and attitudes, and none where a message does not reach."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from flightsw.errors import NavigationError
from flightsw.icd.mission import Mission, NavigationSection, load_mission
from flightsw.icd.ndm.write import Object, write_aem, write_oem
from flightsw.icd.quaternion import matrix_to_quat
from flightsw.navigation.messages import MessageNavigation
from flightsw.navigation.orbit import propagate
from flightsw.navigation.pose import PoseTagger, pose_tag, target_attitude
from flightsw.selftest import planned_pass

MISSION = load_mission(Path(__file__).parents[2] / "mission.yaml")
START_NS = MISSION.orbit.start_utc_ns
NS = 1_000_000_000
TIMES = [START_NS + seconds * NS for seconds in range(-100, 1201, 10)]
NAMES = {"target": Object("TARGET", "2007-026A"), "chaser": Object("CHASER", "2010-030A")}
LAGRANGE = ("LAGRANGE", 9)  # SGP4's velocities are not quite the slopes of its positions


def states(role: str) -> tuple[np.ndarray, np.ndarray]:
    """Positions and velocities [N, 3] of an object at `TIMES` by its elements."""
    found = [propagate(getattr(MISSION.orbit, f"{role}_tle"), t) for t in TIMES]
    return np.stack([s.position_m for s in found]), np.stack([s.velocity_m_s for s in found])


@pytest.fixture
def folder(tmp_path) -> Path:
    """Messages that say what the mission's elements and its attitude of the target say."""
    quats = np.stack([matrix_to_quat(target_attitude(MISSION, t)) for t in TIMES])
    rates = np.tile([0, 0, 2 * np.pi / MISSION.target_attitude.period_s], (len(TIMES), 1))
    covariances = np.tile(np.diag([0.01, 0.04, 0.09, 1e-8, 1e-8, 1e-8]), (len(TIMES), 1, 1))
    for role, name in NAMES.items():
        content = write_oem(name, "EARTH", TIMES, *states(role), covariances, START_NS, LAGRANGE)
        (tmp_path / f"{role}.oem").write_bytes(content)
    (tmp_path / "target.aem").write_bytes(
        write_aem(NAMES["target"], "SC_BODY_1", TIMES, quats, rates, START_NS)
    )
    return tmp_path


def with_messages(folder: Path) -> Mission:
    return dataclasses.replace(MISSION, navigation=NavigationSection(f"ndm://{folder}"))


def test_tags_are_those_of_the_same_orbits_and_attitude(folder):
    # another attitude in the mission shows that the one of the message counts
    other = dataclasses.replace(MISSION.target_attitude, period_s=5000.0)
    tagger = PoseTagger(dataclasses.replace(with_messages(folder), target_attitude=other))
    for seconds in (0.0, 33.3, 1053.7):
        at_ns = START_NS + round(seconds * NS)
        tag, expected = tagger(at_ns), pose_tag(MISSION, at_ns)
        assert (tag.valid, tag.source) == (True, "navigation")
        np.testing.assert_allclose(tag.position_body_m, expected.position_body_m, rtol=0, atol=1e-3)
        assert abs(tag.quat_body_to_camera @ expected.quat_body_to_camera) > 1 - 1e-12
        np.testing.assert_allclose(tag.sun_dir_body, expected.sun_dir_body, rtol=0, atol=1e-8)
        # of the difference of two independent positions, turned to body axes
        assert np.trace(tag.covariance[:3, :3]) == pytest.approx(2 * 0.14)
    assert tagger.navigation_gaps == 0


def test_an_orbit_about_the_target_needs_no_other_file(folder):
    (positions, velocities), (around, slopes) = states("chaser"), states("target")
    relative = write_oem(
        *(NAMES["chaser"], "TARGET", TIMES, positions - around, velocities - slopes, None, START_NS, LAGRANGE)
    )
    (folder / "chaser.oem").write_bytes(relative)
    (folder / "target.oem").unlink()
    tag = PoseTagger(with_messages(folder))(START_NS + 4_500_000_000)
    expected = pose_tag(MISSION, START_NS + 4_500_000_000)
    np.testing.assert_allclose(tag.position_body_m, expected.position_body_m, rtol=0, atol=1e-3)
    assert abs(tag.quat_body_to_camera @ expected.quat_body_to_camera) > 1 - 1e-12


def test_outside_of_a_message_there_is_no_pose(folder):
    tagger = PoseTagger(with_messages(folder))
    tag = tagger(START_NS + 1300 * NS)
    assert (tag.valid, tag.source, tagger.navigation_gaps) == (False, "none", 1)
    with pytest.raises(NavigationError, match="target: nothing at 2026-07-21T11:14:10"):
        MessageNavigation(f"ndm://{folder}", MISSION.orbit.target_tle).at(START_NS + 1300 * NS)


def test_the_self_test_says_whether_messages_cover_the_pass(folder):
    *_, finding = planned_pass.check_orbit(with_messages(folder))
    assert (finding.check, finding.state) == ("navigation", "ok") and "covers the pass" in finding.found
    longer = dataclasses.replace(MISSION.bracket, count=60)
    *_, finding = planned_pass.check_orbit(dataclasses.replace(with_messages(folder), bracket=longer))
    assert finding.state == "failed" and "the message covers" in finding.found


def test_a_damaged_message_ends_the_start_with_its_name(folder):
    (folder / "target.oem").write_bytes(
        (folder / "target.oem").read_bytes().replace(b"REF_FRAME", b"REFFRAME")
    )
    with pytest.raises(NavigationError, match=r"target\.oem: line \d+, REFFRAME: unknown key"):
        PoseTagger(with_messages(folder))
    with pytest.raises(NavigationError, match="no navigation messages in /nowhere"):
        MessageNavigation("ndm:///nowhere", MISSION.orbit.target_tle)
