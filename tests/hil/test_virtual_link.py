"""The virtual serial line: rate, back-pressure, and faults that are seeded and counted."""

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from subprocess import PIPE

import pytest
import serial

from flightsw.icd.link.framing import Deframer, frame_packet
from hil.links.faults import Faults
from hil.links.virtual_link import VirtualLink, control, run_link
from hil.links.virtual_serial import VirtualSerial

PACKETS = [bytes([number % 256]) * (20 + number % 50) for number in range(300)]
STREAM = b"".join(map(frame_packet, PACKETS))
FIRST_PACKETS = b"".join(map(frame_packet, PACKETS[:20]))


def send(line: VirtualSerial, stream: bytes) -> bytes:
    """Send a stream down the line as fast as it takes it; return what arrives until every byte is accounted for."""
    received, end_s = b"", time.monotonic() + 60
    lane = line.statistics()["down"]
    bytes_in_at_end, bytes_out_before = lane.bytes_in + len(stream), lane.bytes_out
    with (
        serial.Serial(line.flight_device, timeout=0, write_timeout=0, exclusive=True) as near,
        serial.Serial(line.ground_device, timeout=0, exclusive=True) as far,
    ):
        while (
            lane.bytes_in < bytes_in_at_end
            or lane.bytes_in + lane.duplicated_bytes
            > lane.bytes_out + lane.lost_bytes + lane.cut_bytes + lane.overrun_bytes
            or len(received) < lane.bytes_out - bytes_out_before
        ):
            assert time.monotonic() < end_s, f"the line stands still: {lane}"
            with contextlib.suppress(BlockingIOError):
                stream = stream[os.write(near.fileno(), stream) :]
            received += far.read(65_536)
            time.sleep(0.001)
        return received + far.read(65_536)


def assert_counts_add_up(line: VirtualSerial) -> None:
    for lane in line.statistics().values():
        assert lane.bytes_in + lane.duplicated_bytes == (
            lane.bytes_out + lane.lost_bytes + lane.cut_bytes + lane.overrun_bytes + lane.held_bytes
        )


def test_without_faults_every_byte_passes_at_the_line_s_rate():
    baud_rate = 115_200
    with VirtualSerial(baud_rate) as line:
        began_s = time.monotonic()
        assert send(line, STREAM) == STREAM
        seconds = time.monotonic() - began_s
        ideal_s = len(STREAM) * 10 / baud_rate
        assert seconds > 0.95 * ideal_s  # it may be faster by the burst of 10 ms only
        assert_counts_add_up(line)
        assert line.statistics()["down"].packets == len(PACKETS)


def test_without_a_reader_the_writer_is_held_back_and_nothing_is_lost():
    with (
        VirtualSerial(3_000_000) as line,
        serial.Serial(line.flight_device, timeout=0, write_timeout=0) as near,
        serial.Serial(line.ground_device, timeout=0.5) as far,
    ):
        end_s, written = time.monotonic() + 0.7, 0
        while time.monotonic() < end_s:
            try:
                written += os.write(near.fileno(), b"x" * 1000)
            except BlockingIOError:
                time.sleep(0.001)
        assert written < 150_000  # the buffers of both terminals; the line alone would take 210 kB
        assert far.read(written + 1) == b"x" * written
        assert_counts_add_up(line)


def test_each_fault_happens_about_as_often_as_asked_and_is_counted():
    faults = Faults(loss=0.1, bit_flip=0.1, duplicate=0.1, reorder=0.1)
    with VirtualSerial(3_000_000, faults, seed=5) as line:
        received = send(line, STREAM)
        lane = line.statistics()["down"]
        assert_counts_add_up(line)
    assert len(received) == lane.bytes_out
    counts = (lane.packets_lost, lane.packets_flipped, lane.packets_duplicated, lane.packets_reordered)
    assert all(10 <= count <= 60 for count in counts)  # 30 expected of 300, 5 sigma either way
    deframer = Deframer(200)
    packets = deframer.feed(received)
    assert set(packets) <= set(PACKETS)
    assert deframer.crc_errors > 0
    # a damaged delimiter joins two packets, a new one splits one: either damages at most two
    expected = len(PACKETS) - lane.packets_lost + lane.packets_duplicated
    assert expected - 3 * lane.packets_flipped <= len(packets) <= expected


def test_the_same_seed_brings_the_same_faults():
    def run(seed: int) -> bytes:
        with VirtualSerial(3_000_000, Faults(loss=0.2, bit_flip=0.2), seed) as line:
            return send(line, STREAM)

    first = run(1)
    assert first == run(1)
    assert first != run(2)


def test_a_cut_cable_swallows_bytes_and_a_mended_one_passes_them():
    with VirtualSerial(3_000_000) as line:
        line.cut()
        assert send(line, STREAM[:1000]) == b""
        assert line.statistics()["down"].cut_bytes == 1000
        line.mend()
        assert send(line, STREAM[:1000]) == STREAM[:1000]
        assert_counts_add_up(line)


def test_both_directions_work_at_once():
    with (
        VirtualSerial(3_000_000) as line,
        serial.Serial(line.flight_device, timeout=2) as near,
        serial.Serial(line.ground_device, timeout=2) as far,
    ):
        near.write(b"down")
        far.write(b"up")
        assert (far.read(4), near.read(2)) == (b"down", b"up")


def test_latency_delays_the_first_byte_and_loses_none():
    with VirtualSerial(3_000_000, latency_s=0.3) as line:
        began_s = time.monotonic()
        assert send(line, STREAM) == STREAM
        assert time.monotonic() - began_s > 0.3
        assert_counts_add_up(line)


def test_without_flow_control_what_nobody_reads_in_time_is_lost_and_counted():
    with (
        VirtualSerial(3_000_000, flow_control=False) as line,
        serial.Serial(line.flight_device, timeout=0, write_timeout=0) as near,
        serial.Serial(line.ground_device, timeout=0.5) as far,
    ):
        end_s, written = time.monotonic() + 10, 0
        while written < 100_000 and time.monotonic() < end_s:
            with contextlib.suppress(BlockingIOError):
                written += os.write(near.fileno(), b"x" * 1000)
            time.sleep(0.001)
        received = far.read(written)
        lane = line.statistics()["down"]
        assert lane.overrun_bytes > 0
        assert len(received) == lane.bytes_out == written - lane.overrun_bytes
        assert_counts_add_up(line)


def test_a_running_line_executes_commands():
    with VirtualSerial(3_000_000) as line:
        assert control(line, "cut").startswith("cut")
        assert send(line, FIRST_PACKETS) == b""
        assert control(line, "mend").startswith("whole")
        assert "0.25 s" in control(line, "latency 0.25")
        assert "'loss': 1.0" in control(line, "loss 1")
        assert send(line, FIRST_PACKETS) == b""
        control(line, "loss 0")
        assert send(line, FIRST_PACKETS) == FIRST_PACKETS
        assert_counts_add_up(line)


@pytest.mark.parametrize("command", ["", "loss", "loss 2", "loss much", "latency -1", "cut 3", "explode"])
def test_an_invalid_command_changes_nothing_and_is_explained(command):
    line = VirtualSerial(9600)
    with pytest.raises(ValueError, match=r"expected cut, mend|must be 0 to 1|could not convert"):
        control(line, command)
    assert (line.faults, line.latency_s, line.is_cut) == (Faults(), 0.0, False)


def test_run_link_names_its_ends_and_returns_its_counts():
    seen, reports = [], []

    def on_ready(line: VirtualLink) -> None:
        assert isinstance(line, VirtualSerial)
        seen.append((line.flight_url, line.ground_url))
        assert send(line, STREAM[:500]) == STREAM[:500]

    statistics = run_link(
        VirtualSerial(921_600),
        on_ready,
        should_stop=lambda: bool(reports),
        on_statistics=reports.append,
        every_s=0.1,
    )
    assert seen[0][0].startswith("serial:///dev/") and seen[0][0].endswith("?baud=921600")
    assert seen[0][0] != seen[0][1]
    assert statistics["down"].bytes_out == 500


@pytest.mark.parametrize(
    ("arguments", "scheme"),
    [
        (["--rate", "115200", "--faults", "seed=3"], "serial"),
        (["--bus", "slcan-fd", "--faults", "one_shot,seed=3"], "slcan"),
    ],
)
def test_the_link_command_prints_its_ends_executes_its_input_and_prints_its_counts(arguments, scheme):
    command = [sys.executable, "-m", "hil.cli", "link", *arguments]
    with subprocess.Popen(command, stdin=PIPE, stdout=PIPE, stderr=PIPE, text=True) as process:
        assert process.stdout and process.stdin and process.stderr
        try:
            ends = [process.stdout.readline().split() for _ in range(2)]
            assert [end[0] for end in ends] == ["flight", "ground"]
            assert all(end[1].startswith(f"{scheme}:///dev/") for end in ends)
            assert "'loss': 0.5" in answer(process, "loss 0.5")
            assert "expected cut, mend" in answer(process, "nonsense")
            process.stdin.buffer.write(b"\xff is no UTF-8\n")  # answered too, and the command goes on
            assert "expected cut, mend" in answer(process, "loss 0.5")
            assert "'loss': 0.5" in process.stderr.readline()
            process.send_signal(signal.SIGUSR1)
            deadline_s = time.monotonic() + 60  # the main thread, which handles signals, may wake much later
            while not answer(process, "latency 0.1").startswith("cut, latency 0.1 s"):
                assert time.monotonic() < deadline_s, "SIGUSR1 did not cut the line"
                time.sleep(0.05)
        finally:
            process.terminate()
        counts = json.loads(process.stdout.readline())
        assert set(counts) == {"down", "up"}
    assert process.returncode == 0


def answer(process: subprocess.Popen, line: str) -> str:
    """Return what the command says to a line on its standard input."""
    assert process.stdin and process.stderr
    process.stdin.write(line + "\n")
    process.stdin.flush()
    return process.stderr.readline()


def test_a_fault_s_rate_is_a_probability():
    with pytest.raises(ValueError, match="bit_flip must be 0 to 1"):
        Faults(bit_flip=1.5)
