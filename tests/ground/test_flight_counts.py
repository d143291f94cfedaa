"""How many frames flight took, as its telemetry tells: over restarts of both sides, lost packets and lost frames."""

import dataclasses
import json
import os
import shutil
import threading
import time
import tty
from pathlib import Path

import imagecodecs
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from flightsw.downlink.loop import run_downlink
from flightsw.icd.frame import HEADER, encode_frame
from flightsw.icd.link.framing import frame_packet
from flightsw.icd.packet import APID_FRAME_HEADERS
from flightsw.ports import SerialLink
from flightsw.storage.store import FrameStore
from ground.formats.pictures.views import Intrinsics, View, write_session
from ground.link.ingest import listen
from ground.run.evaluate import evaluate
from ground.run.reconstruct import reconstruct
from ground.session.folder import SessionCorrupt, open_session
from ground.session.telemetry import FlightCounts, TelemetryLog
from ground.session.writer import SessionWriter
from ground.show.report.document import write_report
from hil.links.virtual_serial import VirtualSerial
from tests.dictionary_packets import packets

GOLDEN = Path(__file__).parents[1] / "golden" / "session"
QUICK = {"steps": 10, "start.count": 300, "growth.max_gaussians": 300, "published.sh_degree": 0}
NS = 1_000_000_000
START_NS = 1_784_631_150 * NS


def packet(utc_s: float, uptime_s: float, stored: int, dropped=0, refused=0, failed=0, boot=1) -> dict:
    """Return what FlightCounts takes of a housekeeping packet."""
    return {
        "utc_ns": START_NS + round(utc_s * NS),
        "uptime_s": int(uptime_s),
        "boot": boot,
        "frames_stored": stored,
        "frames_dropped": dropped,
        "frames_refused": refused,
        "frames_failed": failed,
    }


def told(*packets: dict) -> FlightCounts:
    counts = FlightCounts()
    for values in packets:
        counts = counts.after_housekeeping(values)
    return counts


def test_frames_lost_at_both_ends_of_a_pass_are_counted():
    assert told(packet(9, 9, 48)).captured(last_frame_id=35) == 48


def test_frames_deleted_on_board_are_still_frames_that_were_taken():
    counts = told(packet(9, 9, 40), packet(20, 20, 30, dropped=10), packet(30, 30, 12, dropped=10))
    assert counts.captured() == 40 and counts.frames_dropped == 10
    assert counts.after_header(59).captured() == 60  # numbers are never used twice
    assert counts.captured(last_frame_id=44) == 45


@pytest.mark.parametrize(
    "packets",
    [
        [packet(100, 100, 9, refused=3, failed=1), packet(130, 5, 9, refused=2, failed=4, boot=2)],
        # the ground was away: the new run is older than the old one was when it was last heard
        [packet(5, 5, 9, refused=3, failed=1), packet(905, 600, 9, refused=2, failed=4, boot=2)],
        # a computer without a clock starts in the past
        [packet(100, 100, 9, refused=3, failed=1), packet(-9000, 5, 9, refused=2, failed=4, boot=2)],
        [packet(5, 5, 9, refused=3, failed=1), packet(9, 2, 9, refused=2, failed=4, boot=(1 << 31) + 7)],
        [
            packet(5, 5, 9, refused=3, failed=1),
            packet(9, 2, 9, refused=2, failed=4, boot=2),
            packet(5, 5, 9, refused=3, failed=1),
            packet(9, 2, 9, refused=2, failed=4, boot=2),
        ],
    ],
    ids=["heard through", "unheard for long", "clock set back", "number lost", "late"],
)
def test_counters_that_begin_anew_with_flight_are_added_up(packets):
    counts = told(*packets)
    assert (counts.frames_refused, counts.frames_failed, counts.captured()) == (5, 5, 14)


@pytest.mark.parametrize(
    "packets",
    [
        [packet(0.3, 0.3, 4, refused=1), packet(1.9, 1.9, 5, refused=2), packet(2.9, 2.9, 5, refused=2)],
        [packet(50, 50, 5, refused=2), packet(49, 49, 4, refused=1), packet(51, 51, 5, refused=2)],
        [packet(50, 50, 4, refused=1), packet(80, 51, 5, refused=2), packet(40, 52, 5, refused=2)],
        [packet(-1.7e9, 59, 4, refused=1), packet(60, 60, 5, refused=2), packet(3660, 61, 5, refused=2)],
    ],
    ids=["just started", "overtaken", "clock stepped", "clock set"],
)
def test_one_run_of_flight_is_not_counted_twice(packets):
    assert told(*packets).frames_refused == 2


@given(st.data())
def test_the_count_is_never_more_than_was_taken_and_exact_once_all_is_heard(data):
    """Flight takes, refuses and fails, crashes and starts; the ground hears some of its packets."""
    now_s, stored, refused, failed = 0.0, 0, 0, 0
    counts, boot = FlightCounts(), 0
    clock_s = st.floats(-1e9, 1e9)  # it is set, right or wrong
    for _ in range(data.draw(st.integers(1, 4))):
        now_s += data.draw(st.floats(2, 100))
        began_s, run_refused, run_failed, boot = now_s, 0, 0, boot + 1
        for _ in range(data.draw(st.integers(1, 5))):
            now_s += data.draw(st.floats(1, 50))
            new = data.draw(st.tuples(*(st.integers(0, 5) for _ in range(3))))
            stored, run_refused, run_failed = stored + new[0], run_refused + new[1], run_failed + new[2]
            refused, failed = refused + new[1], failed + new[2]
            if heard := data.draw(st.booleans()):
                values = packet(data.draw(clock_s), now_s - began_s, stored, 0, run_refused, run_failed, boot)
                counts = counts.after_housekeeping(values)
                assert counts.frames_stored == stored
            assert counts.frames_refused <= refused and counts.frames_failed <= failed
        if not heard:  # each run's last packet, before it is killed
            values = packet(data.draw(clock_s), now_s - began_s, stored, 0, run_refused, run_failed, boot)
            counts = counts.after_housekeeping(values)
        assert (counts.frames_refused, counts.frames_failed) == (refused, failed)
        assert counts.captured() == stored + refused


def test_a_header_without_its_frame_tells_of_it(tmp_path, make_frame):
    log = TelemetryLog(tmp_path)
    assert log.flight is None
    log.add(APID_FRAME_HEADERS, encode_frame(make_frame(12))[: HEADER.size])
    assert log.flight is not None and log.flight.captured() == 13


def test_a_session_keeps_what_flight_told_when_the_ground_starts_again(tmp_path, small_mission, make_frame):
    writer = SessionWriter(tmp_path / "s", small_mission)
    writer.add(make_frame(3), encode_frame(make_frame(3)))
    writer.save({}, 0)
    assert open_session(tmp_path / "s").frames_captured is None
    writer.save({}, 0, told(packet(50, 50, 9, refused=2)))
    assert open_session(tmp_path / "s").frames_captured == 11
    again = SessionWriter(tmp_path / "s", small_mission)
    assert again.flight is not None and open_session(tmp_path / "s").frames_captured == 11
    again.save({}, 0, again.flight.after_housekeeping(packet(51, 51, 10, refused=2)))
    assert open_session(tmp_path / "s").frames_captured == 12


def test_counts_of_an_earlier_version_are_read():
    """It told starts of flight software apart by clocks."""
    told = {"frames_stored": 9, "frames_refused": 2, "run_utc_ns": -5, "run_uptime_s": 4, "run_refused": 2}
    assert FlightCounts.from_tree(told) == FlightCounts(frames_stored=9, frames_refused=2, run_refused=2)


@pytest.mark.parametrize(
    "wrong", [{"frames_stored": -1}, {"frames_stored": "9"}, {"frames_stored": True}, {"unheard_of": 1}, 7]
)
def test_a_damaged_count_is_corrupt(tmp_path, small_mission, make_frame, wrong):
    writer = SessionWriter(tmp_path / "s", small_mission)
    writer.add(make_frame(0), encode_frame(make_frame(0)))
    writer.save({}, 0)
    path = tmp_path / "s" / "session.json"
    header = json.loads(path.read_text()) | {"flight": wrong}
    del header["crc32"]  # as someone who edits it by hand
    path.write_text(json.dumps(header))
    for read in (open_session, lambda folder: SessionWriter(folder, small_mission)):
        with pytest.raises(SessionCorrupt, match=r"session\.json"):
            read(tmp_path / "s")


def test_of_an_import_the_pictures_were_taken(tmp_path):
    views = []
    for i in range(3):
        path = tmp_path / f"{i}.png"
        path.write_bytes(bytes(imagecodecs.png_encode(np.full((8, 8), 9, dtype=np.uint8))))
        views.append(View(path, np.eye(4), Intrinsics(8, 8, 8.0, 8.0, 4.0, 4.0)))
    write_session(views, tmp_path / "s", "nerf: there")
    session = open_session(tmp_path / "s")
    assert session.flight is None and session.frames_captured == session.frames_imported == 3


def test_ground_that_leaves_in_the_middle_of_a_pass_knows_what_is_missing(
    tmp_path, small_mission, make_frame
):
    store = FrameStore(tmp_path / "store")
    for _ in range(12):
        store.put(make_frame(store.next_frame_id))
    with VirtualSerial(115_200) as line:  # twelve frames of 4 kB take four seconds
        done = threading.Event()

        def fly() -> None:
            with SerialLink(line.flight_url) as link:
                run_downlink(store, link, small_mission, should_stop=done.is_set)

        flight = threading.Thread(target=fly)
        flight.start()
        end_s = time.monotonic() + 60
        heard = []
        summary = listen(
            line.ground_url,
            tmp_path / "session",
            small_mission,
            on_progress=heard.append,
            should_stop=lambda: (heard and heard[-1].frames_received >= 2) or time.monotonic() > end_s,
        )
        done.set()
        flight.join(30)
    session = open_session(tmp_path / "session")
    assert 2 <= len(session.frames) < 12
    assert session.frames_captured == summary.frames_captured == 12


@pytest.mark.parametrize(
    ("flight", "captured", "card", "missing"),
    [
        (FlightCounts(frames_stored=46, frames_refused=4, frames_dropped=3), 50, "24 / 50", ">26<"),
        (None, None, "24 / unknown", ">at least 12<"),
    ],
)
def test_run_card_and_report_count_the_frames_of_both_ends(tmp_path, flight, captured, card, missing):
    """24 of 48 frames are lost, 12 at each end: what is left has no gap."""
    session = tmp_path / "session"
    shutil.copytree(GOLDEN, session)
    lines = (GOLDEN / "frames.jsonl").read_text().splitlines(keepends=True)
    (session / "frames.jsonl").write_text(
        "".join(line for line in lines if 12 <= json.loads(line)["id"] < 36)
    )
    header = json.loads((session / "session.json").read_text())
    header["flight"] = dataclasses.asdict(flight) if flight else None
    (session / "session.json").write_text(json.dumps(header))
    reconstruct(session, "run", "obbgs", QUICK)
    metrics = evaluate(session, "run")
    assert metrics["frames_received"] == 24 and metrics["frames_captured"] == captured
    assert f"received / captured on board: {card}." in (session / "runs/run/model_card.md").read_text()
    page = write_report(session, "run").read_text()
    assert f"<b>{card}</b><span>frames received / captured" in page
    assert missing in page[page.index("frames missing") :][:80]
    assert ("the store had no room" in page) == (flight is not None)


def test_what_lies_in_the_port_when_listening_ends_is_received(tmp_path, small_mission):
    ours, theirs = os.openpty()
    tty.setraw(theirs)
    sent = b"".join(frame_packet(packet) for packet, *_ in packets(3, seed=4))

    def stop() -> bool:
        os.write(ours, sent)
        return True

    try:
        url = f"serial://{os.ttyname(theirs)}"
        summary = listen(url, tmp_path / "session", small_mission, should_stop=stop)
    finally:
        os.close(ours)
        os.close(theirs)
    assert summary.packets_received == 3
