"""The session folder: each step written whole or not at all, read strictly, opened again after a power cut."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from flightsw.icd.frame import encode_frame
from flightsw.icd.pose_sections import NavigationErrorsSection
from ground.session.folder import MissingFrames, SessionCorrupt, SessionError, open_session
from ground.session.training_frames import usable
from ground.session.writer import SessionWriter

GOLDEN_RECORD = open_session(Path(__file__).parents[1] / "golden" / "session").frames[0]


@pytest.fixture
def session(tmp_path, small_mission, make_frame):
    """A session folder of three frames."""
    folder = tmp_path / "session"
    writer = SessionWriter(folder, small_mission)
    for number in (2, 0, 1):
        assert writer.add(make_frame(number), encode_frame(make_frame(number)))
    writer.save({"crc_errors": 4, "duplicates": 0}, 5000)
    return folder


def edit_line(folder, number, **changes):
    lines = (folder / "frames.jsonl").read_text().splitlines()
    lines[number] = json.dumps(without_checksum(lines[number]) | changes)
    (folder / "frames.jsonl").write_text("\n".join(lines) + "\n")


def without_checksum(text):
    """Return the object in a text as someone who edits it by hand leaves it."""
    tree = json.loads(text)
    del tree["crc32"]
    return tree


def test_a_session_gives_back_what_was_written(session, small_mission, make_frame):
    opened = open_session(session)
    assert [record.id for record in opened.frames] == [0, 1, 2]
    assert opened.camera == small_mission.camera
    assert opened.tles["target"] == small_mission.orbit.target_tle
    assert opened.losses == {"crc_errors": 4, "duplicates": 0}
    assert opened.bytes_received == 5000
    assert opened.mission_sha256 == small_mission.sha256
    for record in opened.frames:
        frame = make_frame(record.id)
        np.testing.assert_array_equal(opened.dn(record), frame.dn)
        np.testing.assert_array_equal(record.world_to_camera, frame.world_to_camera)
        np.testing.assert_array_equal(record.covariance, frame.pose.covariance)
        assert record.mid_exposure_utc_ns == frame.mid_exposure_utc_ns
        assert (record.bracket, record.bracket_index) == (frame.bracket_id, frame.bracket_index)
        assert record.saturated == frame.saturated_count
        assert record.file == f"frames/{record.id:06d}.png"


def test_a_session_keeps_what_flight_says_of_its_poses(tmp_path, small_mission, make_frame):
    mission = dataclasses.replace(
        small_mission,
        pose=dataclasses.replace(small_mission.pose, correlation_time_s=30.0),
        navigation_errors=NavigationErrorsSection(position_m=(1.0, 8.0, 1.0), boresight_deg=0.1),
    )
    writer = SessionWriter(tmp_path / "session", mission)
    stated = dataclasses.replace(
        make_frame(0).pose, attitude="rate_only", quat_inertial_to_body=[0, 0.6, 0, 0.8]
    )
    for frame in (dataclasses.replace(make_frame(0), pose=stated), make_frame(1)):
        writer.add(frame, encode_frame(frame))
    writer.save({}, 0)
    SessionWriter(tmp_path / "session", mission)  # one that continues forgets nothing
    session = open_session(tmp_path / "session")
    navigation = session.navigation
    assert (navigation.attitude, navigation.correlation_time_s) == ("rate_only", 30.0)
    assert navigation.epoch_utc_ns == mission.orbit.start_utc_ns
    assert navigation.mean_motion_rad_s == pytest.approx(2 * np.pi * 15.19 / 86_400, rel=1e-3)
    np.testing.assert_array_equal(navigation.sigmas.vector(), mission.navigation_errors.sigmas.vector())
    np.testing.assert_array_equal(session.frames[0].quat_inertial_to_body, [0, 0.6, 0, 0.8])
    assert session.frames[1].quat_inertial_to_body is None


def test_a_session_from_before_navigation_was_kept_opens_as_one_of_known_attitude(session):
    header = without_checksum((session / "session.json").read_text())
    del header["navigation"]
    (session / "session.json").write_text(json.dumps(header))
    navigation = open_session(session).navigation
    assert navigation.attitude == "known" and not navigation.sigmas.vector().any()


@pytest.mark.parametrize(
    ("section", "problem"),
    [
        ({"attitude": "guessed"}, "session.navigation.attitude: expected one of known, rate_only, unknown"),
        ({"sigmas": {"clock_s": [-1.0]}}, "sigmas must not be negative"),
        ({"sigmas": {"position_m": [1.0]}}, "expected 3 finite numbers"),
        ({"quat_inertial_to_rtn": [1.0, 1.0, 0.0, 0.0]}, "expected a unit quaternion"),
    ],
)
def test_a_wrong_section_of_navigation_is_named(session, section, problem):
    header = without_checksum((session / "session.json").read_text())
    (session / "session.json").write_text(json.dumps(header | {"navigation": section}))
    with pytest.raises(SessionCorrupt, match=problem):
        open_session(session)


def test_colour_frames_keep_their_channels(tmp_path, small_mission, make_frame):
    camera = dataclasses.replace(small_mission.camera, channels=3)
    mission = dataclasses.replace(small_mission, camera=camera)
    frame = make_frame(0, channels=3)
    SessionWriter(tmp_path / "colour", mission).add(frame, encode_frame(frame))
    opened = open_session(tmp_path / "colour")
    np.testing.assert_array_equal(opened.dn(opened.frames[0]), frame.dn)


def test_a_session_cut_off_at_any_byte_opens_with_the_frames_before(session, small_mission, make_frame):
    lines = (session / "frames.jsonl").read_bytes()
    ends = [position + 1 for position, byte in enumerate(lines) if byte == ord("\n")]
    for length in range(ends[0], len(lines) + 1, 97):
        for name in ("frames.jsonl", "frames.jsonl.copy"):
            (session / name).write_bytes(lines[:length])
        whole = sum(end <= length for end in ends)
        assert len(open_session(session).frames) == whole
    for name, length in (("frames.jsonl", ends[1] + 30), ("frames.jsonl.copy", ends[1])):
        (session / name).write_bytes(lines[:length])
    writer = SessionWriter(session, small_mission)
    assert writer.frame_count == 2
    assert writer.add(make_frame(1), encode_frame(make_frame(1)))
    assert [record.id for record in open_session(session).frames] == [0, 1, 2]


def test_counts_of_several_runs_add_up(session, small_mission):
    writer = SessionWriter(session, small_mission)
    writer.save({"crc_errors": 2, "hang_ups": 1}, 100)
    writer.save({"crc_errors": 3, "hang_ups": 1}, 200)
    opened = open_session(session)
    assert opened.losses == {"crc_errors": 7, "duplicates": 0, "hang_ups": 1}
    assert opened.bytes_received == 5200


def test_a_frame_that_came_before_is_not_written_again(session, small_mission, make_frame):
    before = (session / "frames.jsonl").read_bytes()
    assert not SessionWriter(session, small_mission).add(make_frame(1), encode_frame(make_frame(1)))
    assert (session / "frames.jsonl").read_bytes() == before


def test_another_frame_of_the_same_number_is_refused(session, small_mission, make_frame):
    other = dataclasses.replace(make_frame(5), frame_id=1)
    with pytest.raises(SessionError, match="another frame 1"):
        SessionWriter(session, small_mission).add(other, encode_frame(other))


def test_a_frame_of_another_size_is_refused(session, small_mission, make_frame):
    frame = make_frame(9, size_px=16)
    with pytest.raises(SessionError, match=r"shape \(16, 16\)"):
        SessionWriter(session, small_mission).add(frame, encode_frame(frame))


def test_another_mission_s_session_is_not_continued(session, small_mission):
    with pytest.raises(SessionError, match="another mission"):
        SessionWriter(session, dataclasses.replace(small_mission, sha256="0" * 64))


def test_a_folder_without_a_session_is_a_session_error(tmp_path):
    with pytest.raises(SessionError, match=r"it has no session\.json"):
        open_session(tmp_path)


def test_another_schema_version_is_a_session_error(session):
    header = without_checksum((session / "session.json").read_text())
    (session / "session.json").write_text(json.dumps(header | {"schema_version": 2}))
    with pytest.raises(SessionError, match="schema version 2; this software reads 1"):
        open_session(session)


def test_an_empty_session_is_missing_its_frames(tmp_path, small_mission):
    SessionWriter(tmp_path / "empty", small_mission)
    with pytest.raises(MissingFrames, match="holds no frames"):
        open_session(tmp_path / "empty")


@given(
    st.lists(st.tuples(st.booleans(), st.booleans(), st.booleans()), min_size=1, max_size=30),
    st.integers(0, 30),
)
def test_frames_without_the_sun_are_left_out_where_the_first_has_it(tags, first_come):
    records = [
        dataclasses.replace(
            GOLDEN_RECORD,
            id=number,
            pose_valid=valid,
            in_eclipse=dark,
            sun_dir_body=np.array([0.0, 0.0, 1.0 if sun else 0.0]),
        )
        for number, (valid, dark, sun) in enumerate(tags)
    ]
    posed = [number for number, (valid, dark, _) in enumerate(tags) if valid and not dark]
    sunny = [number for number in posed if tags[number][2]]
    chosen = [record.id for record in usable(records)]
    assert chosen == (sunny if posed and tags[posed[0]][2] else posed)
    earlier = [record.id for record in usable(records[:first_come])]
    assert earlier == chosen[: len(earlier)]  # what comes later changes nothing of it


def test_missing_pictures_are_named(session):
    (session / "frames" / "000001.png").unlink()
    with pytest.raises(MissingFrames, match="1 of 3 pictures missing: 1") as caught:
        open_session(session)
    assert caught.value.ids == (1,)


def test_a_damaged_picture_is_corrupt(session):
    opened = open_session(session)
    path = session / opened.frames[0].file
    path.write_bytes(path.read_bytes()[:60])
    with pytest.raises(SessionCorrupt, match=r"000000\.png cannot be read"):
        opened.dn(opened.frames[0])
    path.write_bytes((session / "frames" / "000001.png").read_bytes())
    assert opened.dn(opened.frames[0]).shape == (48, 48)


@pytest.mark.parametrize(
    ("changes", "problem"),
    [
        ({"exposure_time_s": "short"}, "exposure_time_s is 'short'"),
        ({"exposure_time_s": float("nan")}, "exposure_time_s is nan"),
        ({"id": True}, "id is True"),
        ({"id": -1}, "expected a frame of at least 0"),
        ({"exposure_time_s": 0.0}, "an exposure time above 0, got frame 1 and 0.0 s"),
        ({"world_to_camera": [[0.0] * 4] * 4}, "world_to_camera must turn and move"),
        ({"world_to_camera": np.diag([1.0, 1.0, -1.0, 1.0]).tolist()}, "world_to_camera must turn and move"),
        ({"covariance": [[1.0]]}, r"covariance must be \(6, 6\)"),
        ({"world_to_camera": None}, "world_to_camera"),
        ({"file": "../../etc/passwd"}, "file is '../../etc/passwd'"),
        ({"file": "frames/../000001.png"}, "file is"),
        ({"id": 1}, "frame 1 is there twice"),
    ],
)
def test_a_wrong_value_names_its_line(session, changes, problem):
    edit_line(session, 2 if "id" not in changes else 0, **changes)
    with pytest.raises(SessionCorrupt, match=rf"frames.jsonl line \d: .*{problem}"):
        open_session(session)


@pytest.mark.parametrize(
    ("content", "problem"),
    [
        (b"{", "is not JSON"),
        (b"[]", "should hold an object"),
        (b'{"schema_version": 1}', "session.json: 'camera'"),
        (b'{"schema_version": 1, "camera": {"width": 0}}', "camera"),
    ],
)
def test_a_damaged_header_is_corrupt(session, content, problem):
    (session / "session.json").write_bytes(content)
    (session / "session.json.copy").unlink()
    with pytest.raises(SessionCorrupt, match=problem):
        open_session(session)
