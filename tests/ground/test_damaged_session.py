"""Bits that flip in a session's files, and files that are zeroed or cut: nothing is lost or altered in silence."""

import json
import random

import numpy as np
import pytest
from typer.testing import CliRunner

from flightsw.icd.frame import encode_frame
from flightsw.icd.packet import APID_EVENTS
from flightsw.icd.telemetry import DICTIONARY
from ground import cli
from ground.session.check import damage
from ground.session.folder import MissingFrames, SessionCorrupt, open_session, read_header
from ground.session.telemetry import TelemetryLog
from ground.session.training_frames import split
from ground.session.writer import SessionWriter

NUMBERS = (2, 0, 1, 3)


@pytest.fixture
def session(tmp_path, small_mission, make_frame):
    folder = tmp_path / "session"
    writer = SessionWriter(folder, small_mission)
    for number in NUMBERS:
        writer.add(make_frame(number), encode_frame(make_frame(number)))
    writer.save({"crc_errors": 4}, 5000)
    return folder


def facts(session):
    """What a session says in all, without its pictures."""
    frames = [json.dumps(vars(r), default=np.ndarray.tolist) for r in open_session(session).frames]
    return frames, read_header(session)


def flip(path, bit):
    content = bytearray(path.read_bytes())
    content[bit // 8] ^= 1 << bit % 8
    path.write_bytes(bytes(content))


@pytest.mark.parametrize("name", ["session.json", "session.json.copy", "frames.jsonl", "frames.jsonl.copy"])
def test_no_bit_of_a_file_that_stands_twice_alters_a_session(session, small_mission, name):
    """Reading writes nothing; the listener makes both whole again, in the order of arrival."""
    before, path, source = facts(session), session / name, random.Random(1)
    whole = path.read_bytes()
    for bit in source.sample(range(8 * len(whole)), 60):
        flip(path, bit)
        damaged = path.read_bytes()
        assert facts(session) == before and path.read_bytes() == damaged, bit
        path.write_bytes(whole)
    for content in (bytes(len(whole)), b"", whole[: len(whole) // 2], None):
        path.unlink()
        if content is not None:
            path.write_bytes(content)
        assert facts(session) == before, content
    SessionWriter(session, small_mission)
    lines = (session / "frames.jsonl").read_bytes()
    assert [json.loads(line)["id"] for line in lines.splitlines()] == list(NUMBERS)
    for each in ("session.json", "frames.jsonl"):
        assert (session / each).read_bytes() == (session / f"{each}.copy").read_bytes()


def test_a_line_that_is_damaged_twice_costs_its_frame_alone_and_is_counted(
    session, small_mission, make_frame, caplog
):
    for name in ("frames.jsonl", "frames.jsonl.copy"):
        path = session / name
        flip(path, 8 * (path.read_bytes().index(b"\n") + 300))  # in the second line, of frame 0
    opened = open_session(session)
    assert [record.id for record in opened.frames] == [1, 2, 3]
    assert opened.losses["lines_damaged"] == 1 and "1 frame lost" in caplog.text
    damaged = (session / "frames.jsonl").read_bytes()
    writer = SessionWriter(session, small_mission)
    assert (session / "frames.jsonl.unused-1").read_bytes() == damaged
    assert writer.add(make_frame(0), encode_frame(make_frame(0)))  # sent again
    opened = open_session(session)
    assert len(opened.frames) == 4 and opened.losses["lines_damaged"] == 1


def test_a_picture_with_a_flipped_bit_is_never_shown_and_is_taken_again(session, small_mission, make_frame):
    opened = open_session(session)
    record, path = opened.frames[1], session / "frames" / "000001.png"
    whole = path.read_bytes()
    for bit in random.Random(2).sample(range(8 * len(whole)), 100):
        flip(path, bit)
        with pytest.raises(SessionCorrupt, match=r"frame 1: .* resend 1 1"):
            opened.dn(record)
        path.write_bytes(whole)
    flip(path, 4000)
    writer = SessionWriter(session, small_mission)
    assert writer.add(make_frame(1), encode_frame(make_frame(1)))
    np.testing.assert_array_equal(opened.dn(record), make_frame(1).dn)
    assert not writer.add(make_frame(1), encode_frame(make_frame(1)))


def test_both_headers_damaged_is_said(session):
    for name in ("session.json", "session.json.copy"):
        flip(session / name, 800)
    with pytest.raises(SessionCorrupt, match=r"session\.json: .*no good copy"):
        open_session(session)


def test_what_is_written_by_hand_needs_no_checksum_and_its_copy_is_not_looked_at(session):
    lines = [json.loads(line) for line in (session / "frames.jsonl").read_text().splitlines()]
    for line in lines:
        del line["crc32"]
    (session / "frames.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines[:2]))
    header = json.loads((session / "session.json").read_text())
    del header["crc32"]
    (session / "session.json").write_text(json.dumps(header | {"background": 2.5}))
    opened = open_session(session)
    assert [record.id for record in opened.frames] == [0, 2] and opened.background == 2.5


def test_a_disk_that_refuses_the_copy_leaves_the_frame_out(session, small_mission, make_frame, monkeypatch):
    from obbgs_base import checked

    writer, before = SessionWriter(session, small_mission), (session / "frames.jsonl").read_bytes()
    append = checked.append_line

    def refuse(path, line):
        if path.name.endswith(".copy"):
            raise OSError(28, "No space left on device")
        append(path, line)

    monkeypatch.setattr(checked, "append_line", refuse)
    with pytest.raises(OSError, match="No space"):
        writer.add(make_frame(4), encode_frame(make_frame(4)))
    assert (session / "frames.jsonl").read_bytes() == before
    monkeypatch.undo()
    assert writer.add(make_frame(4), encode_frame(make_frame(4)))


def test_a_session_of_which_every_line_is_damaged_says_so(session):
    for name in ("frames.jsonl", "frames.jsonl.copy"):
        (session / name).write_bytes(bytes(4000))
    with pytest.raises(MissingFrames, match="holds no frames"):
        open_session(session)


def test_ground_list_says_what_is_damaged(session, tmp_path):
    def listed(*options):
        done = CliRunner().invoke(cli.app, ["list", str(tmp_path), "--json", *options])
        (entry,) = json.loads(done.stdout)
        return entry["damage"]

    log = TelemetryLog(session)
    for number in range(3):
        log.add(APID_EVENTS, DICTIONARY.events["stopped"].pack(utc_ns=number))
    assert listed("--pictures") == []
    flip(session / "frames.jsonl", 2400)
    flip(session / "session.json", 800)
    flip(session / "events.jsonl", 400)
    flip(session / "frames" / "000003.png", 900)
    header, frames, events = listed()
    assert "session.json or its copy was damaged" in header
    assert "frames.jsonl: has 1 damaged line (" in frames and "1 frame found in its copy only" in frames
    assert events.startswith("events.jsonl has 1 damaged line (line 1:")
    assert listed("--pictures") == [header, frames, events, "frames/000003.png is damaged"]


def test_a_log_that_lost_its_last_lines_is_told(session, small_mission, caplog):
    log = TelemetryLog(session)
    for number in range(3):
        log.add(APID_EVENTS, DICTIONARY.events["stopped"].pack(utc_ns=number))
    SessionWriter(session, small_mission)  # notes how long it is
    lines = (session / "events.jsonl").read_bytes().splitlines(keepends=True)
    (session / "events.jsonl").write_bytes(lines[0])
    (told,) = damage(session)
    assert told.startswith("events.jsonl was cut: ")
    SessionWriter(session, small_mission)
    assert told in caplog.text and damage(session) == []


def test_a_damaged_picture_costs_its_frame_alone_when_a_model_is_made(session, caplog):
    training, held_out = split(open_session(session))
    assert {record.id for record in training + held_out} == {0, 1, 2, 3}
    flip(session / "frames" / "000002.png", 1000)
    training, held_out = split(open_session(session))
    assert {record.id for record in training + held_out} == {0, 1, 3}
    assert "the picture of 1 frame is damaged and left out: 2;" in caplog.text
