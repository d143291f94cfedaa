"""Work goes on where its output fails, is not read or was closed at the start: real processes, pipes and terminals."""

import fcntl
import os
import pty
import subprocess
import sys
import threading
import tty
from pathlib import Path

import pytest

from flightsw.downlink.loop import run_downlink
from flightsw.icd.link.can import FLIGHT_SIDE
from flightsw.ports import open_link
from flightsw.storage.store import FrameStore
from hil.links.virtual_serial import VirtualSerial

BIN = Path(sys.executable).parent
WORK = """
import logging, os, sys
from obbgs_base.output import open_standard_streams, output_may_fail
open_standard_streams()
logging.basicConfig(filename=sys.argv[1])
with output_may_fail():
    for number in range(int(sys.argv[2])):
        print(f"{number:099d}")
    print("the end of the work", file=sys.stderr)
    sys.exit(7)
"""
PATIENT_S = 60


def work(log: Path, lines: int, **streams) -> subprocess.Popen:
    return subprocess.Popen([sys.executable, "-c", WORK, str(log), str(lines)], **streams)


def full_pipe() -> tuple[int, int]:
    """Return both ends of a pipe that takes nothing more, as one whose reader has stopped."""
    reader, writer = os.pipe()
    fcntl.fcntl(writer, fcntl.F_SETPIPE_SZ, 4096)
    os.write(writer, bytes(4096))
    return reader, writer


def closed_pipe() -> int:
    reader, writer = os.pipe()
    os.close(reader)
    return writer


def test_what_is_read_comes_whole_and_in_order_and_the_last_line_too(tmp_path):
    """As much as is more than a pipe holds, so that the reader is waited for."""
    process = work(tmp_path / "log", 5000, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    stdout, stderr = process.communicate(timeout=PATIENT_S)
    assert stdout.splitlines() == [f"{number:099d}" for number in range(5000)]
    assert (process.returncode, stderr) == (7, "the end of the work\n")
    assert (tmp_path / "log").read_text() == ""


@pytest.mark.parametrize(
    ("output", "reason"),
    [(closed_pipe, "Broken pipe"), (lambda: os.open("/dev/full", os.O_WRONLY), "No space left on device")],
)
def test_output_that_fails_changes_no_exit_code_and_is_told_once(tmp_path, output, reason):
    descriptor, log = output(), tmp_path / "log"
    process = work(log, 300, stdout=descriptor, stderr=subprocess.PIPE, text=True)
    os.close(descriptor)
    _, stderr = process.communicate(timeout=PATIENT_S)
    assert (process.returncode, stderr) == (7, "the end of the work\n")
    told, counted = log.read_text().splitlines()
    assert told.endswith(f"stdout does not take what is printed, the work goes on: {reason}")
    assert counted.endswith("300 lines of stdout were dropped")


def test_a_reader_that_never_reads_stops_nothing_and_what_was_dropped_is_counted(tmp_path):
    reader, writer = full_pipe()
    process = work(tmp_path / "log", 50_000, stdout=writer, stderr=writer)
    os.close(writer)
    assert process.wait(PATIENT_S) == 7
    told, of_stdout, of_stderr = (tmp_path / "log").read_text().splitlines()
    assert told.endswith("stdout does not take what is printed, the work goes on: nobody reads it")
    assert of_stdout.endswith("50000 lines of stdout were dropped")
    assert of_stderr.endswith("1 lines of stderr were dropped")
    assert os.read(reader, 1 << 20) == bytes(4096)
    os.close(reader)


def test_streams_that_were_closed_at_the_start_leave_their_numbers_to_nothing_else(tmp_path):
    script = "exec <&- >&- 2>&-; exec " + sys.executable + ' -c "$0" "$@"'
    opened = "f = open('/dev/zero'); open(sys.argv[2], 'w').write(f'{f.fileno()} {os.readlink(\"/proc/self/fd/1\")}')"
    code = (
        f"import os, sys; from obbgs_base.output import *; open_standard_streams(); {opened}; print('lost')"
    )
    subprocess.run(["sh", "-c", script, code, "0", str(tmp_path / "said")], check=True, timeout=PATIENT_S)
    number, stdout = (tmp_path / "said").read_text().split()
    assert int(number) > 2 and stdout == os.devnull


@pytest.fixture
def mission_file(small_mission, tmp_path) -> Path:
    return tmp_path / "small.yaml"


def unread_terminal() -> tuple[int, int]:
    """Return both ends of a terminal that nobody reads, as one after Ctrl-S."""
    master, slave = pty.openpty()
    tty.setraw(slave)
    return master, slave


def received(tmp_path, mission, mission_file, make_frame, options: list[str], **streams) -> tuple[int, int]:
    """Listen until four frames have come; return the listener's exit code and how many are in its session."""
    store, stop = FrameStore(tmp_path / "store"), threading.Event()
    for number in range(4):
        store.put(make_frame(number))
    with VirtualSerial(3_000_000) as line, open_link(line.flight_url, FLIGHT_SIDE) as link:
        command = [BIN / "ground", "listen", "--link", line.ground_url, "--session", tmp_path / "session"]
        command += ["--mission", mission_file, "--exit-after", "4", *options]
        listener = subprocess.Popen([str(word) for word in command], **streams)
        sender = threading.Thread(
            target=run_downlink, args=(store, link, mission), kwargs={"should_stop": stop.is_set}
        )
        sender.start()
        try:
            code = listener.wait(PATIENT_S)
        finally:
            listener.kill()
            stop.set()
            sender.join()
    return code, len((tmp_path / "session" / "frames.jsonl").read_text().splitlines())


def test_frames_are_received_where_all_output_fails(tmp_path, small_mission, mission_file, make_frame):
    gone = closed_pipe()
    with open("/dev/full", "w") as full:
        streams = {"stdin": subprocess.DEVNULL, "stdout": gone, "stderr": full}
        result = received(tmp_path, small_mission, mission_file, make_frame, [], **streams)
    os.close(gone)
    assert result == (0, 4)
    assert "the work goes on" in (tmp_path / "session" / "listener.log").read_text()


def test_frames_are_received_where_the_terminal_stands_still(
    tmp_path, small_mission, mission_file, make_frame
):
    master, slave = unread_terminal()
    reader, writer = full_pipe()
    streams = {"stdin": slave, "stdout": writer, "stderr": slave}
    result = received(tmp_path, small_mission, mission_file, make_frame, [], **streams)
    for descriptor in (master, slave, reader, writer):
        os.close(descriptor)
    assert result == (0, 4)


def test_frames_are_received_without_any_standard_stream(tmp_path, small_mission, mission_file, make_frame):
    """The port must not become what is printed to: its bytes would be the listener's own lines."""
    close_all = {"preexec_fn": lambda: os.closerange(0, 3)}
    assert received(tmp_path, small_mission, mission_file, make_frame, ["--json"], **close_all) == (0, 4)


def test_flight_ends_with_the_exit_code_of_its_work_whatever_became_of_its_output(tmp_path, mission_file):
    gone, (reader, writer) = closed_pipe(), full_pipe()
    with VirtualSerial(3_000_000) as line, open("/dev/full", "w") as full:
        good = (line.flight_url, 0)
        bad = ("serial:///nowhere/tty", 1)
        flights = []
        for number, ((url, expected), stderr) in enumerate([(good, writer), (bad, full), (bad, gone)]):
            FrameStore(store := tmp_path / f"store{number}")
            words = [
                "downlink",
                "--link",
                url,
                "--store",
                store,
                "--mission",
                mission_file,
                "--exit-when-empty",
            ]
            command = [str(word) for word in (BIN / "flightsw", *words)]
            flights.append((subprocess.Popen(command, stdout=writer, stderr=stderr), expected))
        for flight, expected in flights:
            assert flight.wait(PATIENT_S) == expected
    for descriptor in (gone, reader, writer):
        os.close(descriptor)
