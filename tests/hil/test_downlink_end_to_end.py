"""Flight, a real pseudo-terminal pair with faults, ground: every frame arrives, every loss is counted."""

import os
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from flightsw.downlink.loop import DownlinkProgress, run_downlink
from flightsw.icd.link.framing import PacketStream, frame_packet
from flightsw.icd.link.link_url import parse_link_url
from flightsw.icd.mission import Mission, load_mission
from flightsw.icd.packet import APID_FILES, TELEMETRY
from flightsw.icd.transfer import Sender
from flightsw.ports import SerialLink
from flightsw.storage.store import FrameStore
from ground.link.ingest import ListenSummary, listen
from ground.session.folder import open_session
from hil.links.faults import Faults
from hil.links.virtual_serial import VirtualSerial

BAUD_RATE = 3_000_000


class Listening:
    """`ground listen` in a thread, stopped and joined at the end of the `with` block."""

    def __init__(self, line: VirtualSerial, folder: Path, mission: Mission, exit_after: int | None = None):
        self._stop = False
        self.summary = ListenSummary()

        def work() -> None:
            self.summary = listen(
                line.ground_url,
                folder,
                mission,
                exit_after,
                on_progress=self._note,
                should_stop=lambda: self._stop,
            )

        self._thread = threading.Thread(target=work)

    def _note(self, summary: ListenSummary) -> None:
        self.summary = summary

    def __enter__(self) -> "Listening":
        self._thread.start()
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        self._stop = self._stop or kind is not None
        self._thread.join(30)
        assert not self._thread.is_alive()

    def stop(self) -> None:
        self._stop = True


def stored(folder: Path, make_frame, count: int) -> FrameStore:
    store = FrameStore(folder)
    for _ in range(count):
        store.put(make_frame(store.next_frame_id))
    return store


def assert_same_frames(store: FrameStore, session: Path, make_frame) -> None:
    opened = open_session(session)
    assert {record.id: record.sha256 for record in opened.frames} == {
        frame.frame_id: frame.sha256 for frame in store.frames
    }
    for record in opened.frames:
        assert (opened.dn(record) == make_frame(record.id).dn).all()


def downlink_all(
    line: VirtualSerial, store: FrameStore, mission: Mission, limit_s: float = 60
) -> DownlinkProgress:
    end_s = time.monotonic() + limit_s
    with SerialLink(line.flight_url) as link:
        return run_downlink(
            store, link, mission, exit_when_empty=True, should_stop=lambda: time.monotonic() > end_s
        )


@pytest.mark.parametrize(
    "faults",
    [
        Faults(),
        Faults(loss=0.02, bit_flip=0.02),
        Faults(loss=0.1, bit_flip=0.02, duplicate=0.02, reorder=0.02),
    ],
    ids=["clean", "2 % loss and flips", "10 % loss and all others"],
)
def test_every_frame_arrives_bit_identical_and_the_counts_add_up(tmp_path, small_mission, make_frame, faults):
    store = stored(tmp_path / "store", make_frame, 12)
    with VirtualSerial(BAUD_RATE, faults, seed=11) as line:
        with Listening(line, tmp_path / "session", small_mission) as ground:
            flight = downlink_all(line, store, small_mission)
            end_s = time.monotonic() + 10  # until the last telemetry is across too
            while line.statistics()["down"].bytes_in < flight.bytes_sent and time.monotonic() < end_s:
                time.sleep(0.05)
            time.sleep(0.3)
            ground.stop()
        lanes = line.statistics()
    heard = ground.summary
    assert_same_frames(store, tmp_path / "session", make_frame)
    assert store.outbox() == []
    assert flight.delivered == heard.frames_received == heard.frames_in_session == 12
    assert flight.payload_bytes == heard.payload_bytes == sum(frame.size_bytes for frame in store.frames)
    assert flight.bytes_sent == lanes["down"].bytes_in
    assert heard.bytes_received <= lanes["down"].bytes_out
    assert open_session(tmp_path / "session").losses == heard.losses
    damaged = lanes["down"].packets_lost + lanes["down"].packets_flipped
    if faults.any:
        assert flight.segments_resent > 0
        assert heard.crc_errors > 0
        assert heard.skipped_bytes > 0
        assert 0 < heard.packets_missing <= 2 * damaged  # a damaged delimiter also spoils the next packet
    else:
        assert damaged == 0
        assert set(heard.losses.values()) == {0}
        assert (flight.segments_resent, flight.crc_errors, flight.packets_missing) == (0, 0, 0)
        assert flight.bytes_sent == lanes["down"].bytes_out
        # the ground may open after flight's first byte, and leave before its last telemetry
        assert 0 <= flight.bytes_sent - heard.bytes_received <= 64


def test_a_pass_with_a_cut_cable_continues_when_it_is_mended(tmp_path, small_mission, make_frame):
    store = stored(tmp_path / "store", make_frame, 8)
    with VirtualSerial(460_800) as line:
        timers = [threading.Timer(0.2, line.cut), threading.Timer(1.2, line.mend)]
        with Listening(line, tmp_path / "session", small_mission, exit_after=8):
            for timer in timers:
                timer.start()
            downlink_all(line, store, small_mission)
        for timer in timers:
            timer.join()
        assert line.statistics()["down"].cut_bytes > 0
    assert_same_frames(store, tmp_path / "session", make_frame)


def test_nothing_leaves_the_outbox_while_nobody_listens(tmp_path, small_mission, make_frame):
    store = stored(tmp_path / "store", make_frame, 2)
    with VirtualSerial(BAUD_RATE) as line:
        progress = downlink_all(line, store, small_mission, limit_s=1.0)
    assert progress.delivered == 0
    assert store.outbox() == [0, 1]


DOWNLINK = """
import sys
from pathlib import Path
from flightsw.downlink.loop import run_downlink
from flightsw.icd.mission import load_mission
from flightsw.ports import SerialLink
from flightsw.storage.store import FrameStore
with SerialLink(sys.argv[1]) as link:
    run_downlink(FrameStore(Path(sys.argv[2])), link, load_mission(sys.argv[3]), exit_when_empty=True)
"""
LISTEN = """
import sys
from flightsw.icd.mission import load_mission
from ground.link.ingest import listen
listen(sys.argv[1], sys.argv[2], load_mission(sys.argv[3]), exit_after=int(sys.argv[4]))
"""


class Processes:
    """Flight and ground as separate processes; leaving the `with` block ends them."""

    def __init__(self):
        self._running: dict[str, subprocess.Popen] = {}

    def __enter__(self) -> "Processes":
        return self

    def __exit__(self, *_: object) -> None:
        for name in self._running:
            self.kill(name)

    def start(self, name: str, script: str, *arguments: object) -> None:
        self._running[name] = subprocess.Popen([sys.executable, "-c", script, *map(str, arguments)])

    def kill(self, name: str) -> None:
        self._running[name].kill()
        self._running[name].wait()

    def exit_codes(self) -> list[int | None]:
        return [process.poll() for process in self._running.values()]


def test_either_side_killed_in_the_middle_loses_and_repeats_nothing(tmp_path, small_mission, make_frame):
    store = stored(tmp_path / "store", make_frame, 30)
    session, mission = tmp_path / "session", tmp_path / "small.yaml"
    assert load_mission(mission) == small_mission
    with VirtualSerial(460_800, Faults(loss=0.02), seed=3) as line, Processes() as processes:
        listen_arguments = (LISTEN, line.ground_url, session, mission, 30)
        downlink_arguments = (DOWNLINK, line.flight_url, tmp_path / "store", mission)
        processes.start("ground", *listen_arguments)
        processes.start("flight", *downlink_arguments)
        kills = [(5, "flight", downlink_arguments), (15, "ground", listen_arguments)]
        end_s = time.monotonic() + 90
        while None in processes.exit_codes() and time.monotonic() < end_s:
            time.sleep(0.02)
            frames = session / "frames.jsonl"
            lines = frames.read_bytes().count(b"\n") if frames.exists() else 0
            if kills and lines >= kills[0][0]:
                _, name, arguments = kills.pop(0)
                processes.kill(name)
                processes.start(name, *arguments)
        assert not kills
        assert processes.exit_codes() == [0, 0]
    assert store.outbox() == []
    assert_same_frames(store, session, make_frame)


def send_files(
    line: VirtualSerial, mission: Mission, files: dict[str, bytes], until_s: float = 10
) -> set[str]:
    """Send any files over the line, whatever their names; return those reported as delivered."""
    stream = PacketStream(TELEMETRY, mission.link.max_packet_bytes)
    sender = Sender(stream.max_data_bytes, 1.0)
    delivered: set[str] = set()
    end_s = time.monotonic() + until_s
    with SerialLink(line.flight_url) as link:
        for number, (name, content) in enumerate(files.items()):
            sender.put(name, content, number + 1, time.monotonic())
        while sender.in_flight and time.monotonic() < end_s:
            pdu = sender.next_pdu(time.monotonic()) if link.ready else None
            if pdu is not None:
                link.write(stream.encode(APID_FILES, pdu))
            for _, answer in stream.decode(link.exchange(0.01)):
                sender.receive(answer, time.monotonic())
            delivered |= {outcome.name for outcome in sender.outcomes() if outcome.delivered}
    return delivered


def test_hostile_names_and_bad_containers_are_counted_and_never_leave_the_session(
    tmp_path, small_mission, make_frame
):
    store = stored(tmp_path / "store", make_frame, 3)
    good = [store.read(number) for number in range(3)]
    files = {
        "../../outside.obf": good[0],
        str(tmp_path / "absolute.obf"): good[0],
        "../00000000.obt": good[0],  # a thumbnail
        "00000007.obf": good[0],  # another frame's name
        "00000001.obf": good[1][:-1],  # cut
        "00000005.obf": b"no frame at all",
        "00000002.obf": good[2],
    }
    before = {path for path in tmp_path.rglob("*") if "session" not in path.parts}
    with VirtualSerial(BAUD_RATE) as line, Listening(line, tmp_path / "session", small_mission) as ground:
        assert send_files(line, small_mission, files) == {"00000002.obf"}
        ground.stop()
    assert ground.summary.frames_rejected == 6
    assert ground.summary.frames_received == 1
    assert [record.id for record in open_session(tmp_path / "session").frames] == [2]
    session_files = {path.name for path in (tmp_path / "session").rglob("*") if path.is_file()}
    twice = {f"{name}{end}" for name in ("session.json", "frames.jsonl") for end in ("", ".copy")}
    assert session_files == {*twice, "000002.png", "listener.lock", "listener.log"}
    assert {path for path in tmp_path.rglob("*") if "session" not in path.parts} == before


def test_a_ground_disk_that_refuses_leaves_the_frame_on_board_until_it_takes_it(
    tmp_path, small_mission, make_frame
):
    store = stored(tmp_path / "store", make_frame, 2)
    session = tmp_path / "session"
    with VirtualSerial(BAUD_RATE) as line, Listening(line, session, small_mission, exit_after=2) as ground:
        while not (session / "session.json").exists():
            time.sleep(0.01)
        os.rmdir(session / "frames")
        (session / "frames").write_text("in the way")  # permissions would not stop root

        def make_way() -> None:
            (session / "frames").unlink()
            (session / "frames").mkdir()

        timer = threading.Timer(1.0, make_way)
        timer.start()
        flight = downlink_all(line, store, small_mission)
        timer.join()
    assert ground.summary.store_failures > 0
    assert flight.transfers_failed > 0
    assert_same_frames(store, session, make_frame)


def test_noise_on_the_line_is_counted_and_does_not_stop_the_pass(tmp_path, small_mission, make_frame):
    store = stored(tmp_path / "store", make_frame, 2)
    noise = bytes(range(1, 256)) * 40 + b"\0"
    with (
        VirtualSerial(BAUD_RATE) as line,
        Listening(line, tmp_path / "session", small_mission, exit_after=2) as ground,
    ):
        while not (tmp_path / "session" / "session.json").exists():  # opening a port empties it
            time.sleep(0.01)
        with SerialLink(line.flight_url) as link:
            link.write(noise)
            while not link.ready:
                link.exchange(0.01)
            time.sleep(0.2)
        downlink_all(line, store, small_mission)
    assert ground.summary.skipped_bytes == len(noise)
    assert ground.summary.crc_errors == 1
    assert_same_frames(store, tmp_path / "session", make_frame)


def test_a_packet_under_way_when_listening_begins_is_no_error_of_the_link(
    tmp_path, small_mission, make_frame
):
    store = stored(tmp_path / "store", make_frame, 2)
    rest = frame_packet(bytes(range(200)))[90:]
    with (
        VirtualSerial(BAUD_RATE) as line,
        Listening(line, tmp_path / "session", small_mission, exit_after=2) as ground,
    ):
        while not (tmp_path / "session" / "session.json").exists():  # opening a port empties it
            time.sleep(0.01)
        terminal = os.open(parse_link_url(line.flight_url).device, os.O_WRONLY | os.O_NOCTTY)
        os.write(terminal, rest)
        os.close(terminal)
        downlink_all(line, store, small_mission)
    assert ground.summary.joined_bytes == len(rest)
    assert set(ground.summary.losses.values()) == {0}
    assert_same_frames(store, tmp_path / "session", make_frame)


def test_a_silent_link_ends_after_the_idle_timeout(tmp_path, small_mission):
    began_s = time.monotonic()
    with VirtualSerial(BAUD_RATE) as line:
        summary = listen(line.ground_url, tmp_path / "session", small_mission, idle_timeout_s=0.3)
    assert 0.3 <= time.monotonic() - began_s < 5
    assert summary.frames_in_session == 0
