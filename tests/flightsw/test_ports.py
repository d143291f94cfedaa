"""The ports that flight and ground share: URLs, hang-up and return, back-pressure, CAN."""

import contextlib
import errno
import os
import subprocess
import termios
import time
import tty
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import can
import pytest
from isotp import CanMessage

from flightsw.icd.config import ConfigError
from flightsw.icd.link.can import FLIGHT_SIDE, GROUND_SIDE
from flightsw.icd.link.framing import frame_packet
from flightsw.icd.link.link_url import LinkUrl, parse_link_url
from flightsw.icd.link.slcan import format_slcan
from flightsw.ports import LinkError, SlcanLink, SocketCanLink, open_link
from flightsw.ports.slcan import SILENT_S

BOTH_SIDES = pytest.mark.parametrize("side", [FLIGHT_SIDE, GROUND_SIDE], ids=["flight", "ground"])


@pytest.fixture
def terminal(tmp_path):
    """A pseudo-terminal's master, and a link to its slave whose target a test can change."""
    master, slave = os.openpty()
    tty.setraw(slave)
    os.set_blocking(master, False)
    name = tmp_path / "tty"
    name.symlink_to(os.ttyname(slave))
    yield master, slave, name
    for descriptor in (master, slave):
        try:
            os.close(descriptor)
        except OSError:
            continue


def exchange_until(link, condition, timeout_s=5.0) -> bytes:
    data, end_s = b"", time.monotonic() + timeout_s
    while not condition(data) and time.monotonic() < end_s:
        data += link.exchange(0.02)
    return data


def test_a_url_gives_the_device_and_its_rates():
    assert parse_link_url("serial:///dev/ttyUSB0?baud=115200") == LinkUrl("serial", "/dev/ttyUSB0", 115_200)
    assert parse_link_url("serial:///dev/pts/3") == LinkUrl("serial", "/dev/pts/3", 921_600)
    assert parse_link_url("slcan:///dev/ttyACM0?bitrate=500000") == LinkUrl(
        "slcan", "/dev/ttyACM0", 3_000_000, 500_000
    )
    assert parse_link_url("slcan:///dev/ttyACM0?fd=1&baud=115200") == LinkUrl(
        "slcan", "/dev/ttyACM0", 115_200, 1_000_000, True
    )
    assert parse_link_url("can://can0") == LinkUrl("can", "can0", 3_000_000, 1_000_000)


def test_timers_follow_the_rate_at_which_packets_pass():
    rates = [
        parse_link_url(url).payload_baud_rate
        for url in (
            "serial:///dev/x?baud=3000000",
            "slcan:///dev/x",
            "slcan:///dev/x?fd=1",
            "can://can0?bitrate=125000",
        )
    ]
    assert rates[0] == 3_000_000
    assert 500_000 < rates[1] < 700_000  # 7 of 8 bytes in at least 111 bits
    assert 4_000_000 < rates[2] < 5_000_000
    assert rates[3] == rates[1] // 8


@pytest.mark.parametrize(
    ("url", "problem"),
    [
        ("/dev/ttyUSB0", "expected serial:///dev"),
        ("serial://ttyUSB0", "expected serial:///dev"),
        ("slcan://ttyACM0", "slcan:///dev/"),
        ("can:///can0", "can://can0"),
        ("serial:///dev/ttyUSB0?baud=fast", "got 'fast'"),
        ("serial:///dev/ttyUSB0?baud=50", "got '50'"),
        ("serial:///dev/ttyUSB0?parity=even", "unknown option parity"),
        ("serial:///dev/ttyUSB0?fd=1", "unknown option fd"),
        ("slcan:///dev/ttyACM0?bitrate=123456", "got '123456'"),
        ("can://can0?fd=yes", "got 'yes'"),
        ("serial://[", "not a URL"),
    ],
)
def test_an_unusable_url_says_what_is_wrong(url, problem):
    with pytest.raises(ConfigError, match=problem):
        parse_link_url(url)


def test_the_identifiers_that_one_side_sends_with_are_those_that_the_other_receives():
    assert FLIGHT_SIDE.own_ids == GROUND_SIDE.other_ids and FLIGHT_SIDE.other_ids == GROUND_SIDE.own_ids
    assert not set(FLIGHT_SIDE.own_ids) & set(GROUND_SIDE.own_ids)


def test_a_port_that_is_not_there_is_a_link_error(tmp_path):
    with pytest.raises(
        LinkError, match=rf"cannot open {tmp_path}/none: .*; plug the adapter in, or give the name"
    ):
        open_link(f"serial://{tmp_path}/none", FLIGHT_SIDE)
    (tmp_path / "file").write_text("")
    with pytest.raises(LinkError, match="; give a serial port, such as"):
        open_link(f"serial://{tmp_path}/file", FLIGHT_SIDE)
    with pytest.raises(LinkError, match=f"cannot open {tmp_path}/none"):
        open_link(f"slcan://{tmp_path}/none", FLIGHT_SIDE)
    with pytest.raises(LinkError, match="cannot open nocan0"):
        open_link("can://nocan0", FLIGHT_SIDE)


def test_a_port_that_goes_away_while_it_is_opened_is_a_link_error(terminal, monkeypatch):
    """Such a call of termios fails with an error of its own, which is no OSError."""

    def gone(descriptor: int, queue: int) -> None:
        raise termios.error(errno.EIO, "Input/output error")

    monkeypatch.setattr(termios, "tcflush", gone)
    with pytest.raises(LinkError, match="Input/output error"):
        open_link(f"serial://{terminal[2]}", FLIGHT_SIDE)


def test_bytes_pass_unchanged_both_ways(terminal):
    master, _, name = terminal
    every_byte = bytes(range(256))
    with open_link(f"serial://{name}", FLIGHT_SIDE) as link:
        os.write(master, every_byte)
        assert exchange_until(link, lambda data: len(data) >= 256) == every_byte
        link.write(every_byte)
        link.exchange(0.05)
        assert os.read(master, 1000) == b"\0" + every_byte  # the zero ends what may lie unfinished
        assert (link.bytes_read, link.bytes_written) == (256, 257)


def test_the_port_makes_the_writer_wait_and_nothing_is_lost(terminal):
    master, _, name = terminal
    with open_link(f"serial://{name}", FLIGHT_SIDE) as link:
        block, written = b"x" * 1000, 0
        while link.ready and written < 1_000_000:
            link.write(block)
            written += len(block)
        assert written < 1_000_000  # nobody reads: the buffer is full, and write did not block
        received = b""
        end_s = time.monotonic() + 5
        while len(received) < written + 1 and time.monotonic() < end_s:
            link.exchange(0.0)
            try:
                received += os.read(master, 65_536)
            except BlockingIOError:
                continue
        assert received == b"\0" + b"x" * written
        link.exchange(0.0)
        assert link.ready


def test_a_port_that_hung_up_is_opened_again_under_the_same_name(terminal):
    master, slave, name = terminal
    with open_link(f"serial://{name}", FLIGHT_SIDE) as link:
        link.exchange(0.01)
        os.close(slave)
        os.close(master)
        exchange_until(link, lambda data: not link.connected)
        assert not link.connected and not link.ready
        assert link.hang_ups == 1
        new_master, new_slave = os.openpty()
        tty.setraw(new_slave)
        name.unlink()
        name.symlink_to(os.ttyname(new_slave))
        exchange_until(link, lambda data: link.connected)
        os.write(new_master, b"back")
        assert exchange_until(link, lambda data: data) == b"back"
    os.close(new_master)
    os.close(new_slave)


# ---- CAN ----


def read_all(descriptor: int) -> bytes:
    with contextlib.suppress(BlockingIOError):
        return os.read(descriptor, 65_536)
    return b""


def test_an_slcan_adapter_is_set_up_at_opening_and_closed_at_the_end(terminal):
    master, _, name = terminal
    with open_link(f"slcan://{name}?bitrate=500000", FLIGHT_SIDE) as link:
        link.exchange(0.02)
        assert read_all(master) == b"\r\rC\rS6\rO\r"
    assert read_all(master) == b"\rC\r"


@BOTH_SIDES
def test_a_packet_is_one_iso_tp_message_in_frames_of_the_side_s_identifier(side, terminal):
    master, _, name = terminal
    first_frame, flow_control = b"100B", bytes([0x30, 0, 0])
    with open_link(f"slcan://{name}", side) as link:
        link.exchange(0.02)
        read_all(master)
        link.write(b"abcdefghijk\0")
        link.exchange(0.0)
        assert (
            read_all(master)
            == f"t{side.own_ids[0]:03X}8".encode() + first_frame + b"abcdef".hex().encode() + b"\r"
        )
        os.write(master, format_slcan(CanMessage(side.other_ids[0], 3, flow_control)))
        exchange_until(link, lambda data: link.bytes_read)
        link.exchange(0.0)
        assert (
            read_all(master)
            == f"t{side.own_ids[0]:03X}6".encode() + b"21" + b"ghijk".hex().upper().encode() + b"\r"
        )
        os.write(master, format_slcan(CanMessage(side.other_ids[1], 4, b"\x03xyz")))
        assert exchange_until(link, lambda data: data) == b"xyz\0"


def test_an_slcan_adapter_is_not_closed_before_it_has_taken_the_last_frame(terminal):
    master, _, name = terminal
    link = open_link(f"slcan://{name}", FLIGHT_SIDE)
    os.write(master, b"\r\r\r\rz\r")  # to what set it up, and to a frame
    link.write(b"a\0")
    exchange_until(link, lambda data: link.bytes_read == 6)
    link.write(b"b\0")
    with ThreadPoolExecutor(1) as pool:
        closing = pool.submit(link.close)
        time.sleep(0.3)
        assert not read_all(master).endswith(b"\rC\r")
        os.write(master, b"z\r")
        closing.result(10)
    assert read_all(master) == b"\rC\r"


def test_what_an_slcan_adapter_garbles_is_counted(terminal):
    master, _, name = terminal
    with open_link(f"slcan://{name}", FLIGHT_SIDE) as link:
        os.write(
            master,
            b"t0C83x\r\xff\xfe\r\a"
            + b"".join(
                format_slcan(CanMessage(FLIGHT_SIDE.other_ids[0], 2, data)) for data in (b"\x01x", b"\x22x")
            ),
        )
        exchange_until(link, lambda data: link.losses["can_frames_discarded"])
        assert link.losses == {
            "adapter_lines_skipped": 2,
            "adapter_errors": 1,
            "can_frames_discarded": 1,
            "can_frames_repeated": 0,
            "messages_failed": 0,
        }


def test_a_message_without_an_answer_is_given_up_and_counted(terminal):
    _, _, name = terminal
    now_s = [0.0]
    with SlcanLink(f"slcan://{name}", FLIGHT_SIDE, lambda: now_s[0]) as link:
        link.write(frame_packet(bytes(range(100))))
        for _ in range(1000):
            now_s[0] += 0.01
            link.exchange(0.0)
        assert link.losses["messages_failed"] == 1
        assert link.ready


def test_an_adapter_that_came_back_or_fell_silent_is_set_up_again(terminal):
    master, slave, name = terminal
    now_s = [0.0]
    with SlcanLink(f"slcan://{name}", FLIGHT_SIDE, lambda: now_s[0]) as link:
        link.exchange(0.02)
        read_all(master)
        now_s[0] += SILENT_S + 1
        link.exchange(0.0)
        link.exchange(0.02)
        assert b"O\r" in read_all(master)
        os.close(slave)
        os.close(master)
        exchange_until(link, lambda data: not link.connected)
        assert link.hang_ups == 1
        new_master, new_slave = os.openpty()
        tty.setraw(new_slave)
        name.unlink()
        name.symlink_to(os.ttyname(new_slave))
        now_s[0] += 1
        exchange_until(link, lambda data: link.connected)
        link.exchange(0.02)
        assert os.read(new_master, 100).endswith(b"O\r")
    os.close(new_master)
    os.close(new_slave)


def pass_packets(near, far, packets: list[bytes]) -> bytes:
    """Write packets into one link as it takes them; return what the other one received."""
    waiting, received, end_s = list(packets), b"", time.monotonic() + 20
    while received.count(b"\0") < len(packets) and time.monotonic() < end_s:
        if waiting and near.ready:
            near.write(waiting.pop(0))
        near.exchange(0.0)
        received += far.exchange(0.0)
    return received


@pytest.mark.parametrize("fd", [False, True], ids=["classic", "fd"])
def test_a_kernel_interface_carries_packets_both_ways(fd, monkeypatch):
    """On python-can's virtual bus, which works where the kernel has no CAN."""
    real_bus = can.Bus

    def virtual_bus(channel, interface, fd):
        assert interface == "socketcan"
        return real_bus(channel, interface="virtual")

    monkeypatch.setattr(can, "Bus", virtual_bus)
    packets = [frame_packet(os.urandom(size)) for size in (1, 20, 62, 63, 1000, 4096, 30)]
    with (
        open_link(f"can://test{fd}?fd={int(fd)}", FLIGHT_SIDE) as flight,
        open_link(f"can://test{fd}?fd={int(fd)}", GROUND_SIDE) as own,
    ):
        assert pass_packets(flight, own, packets) == b"".join(packets)
        assert pass_packets(own, flight, packets) == b"".join(packets)
        assert own.losses["can_frames_discarded"] == flight.losses["messages_failed"] == 0
        assert own.bytes_read == flight.bytes_written > sum(map(len, packets))


def test_a_kernel_interface_that_goes_away_is_opened_again_and_a_full_queue_only_waits(monkeypatch):
    errors = [can.CanOperationError("Transmit buffer full"), can.CanOperationError("down", 100)]

    class Bus:
        """An interface that refuses once with each error."""

        opened = 0
        sent = 0

        def __init__(self, *_, **__):
            Bus.opened += 1

        def recv(self, timeout):
            return None

        def send(self, message, timeout):
            if errors:
                raise errors.pop(0)
            Bus.sent += 1

        def shutdown(self):
            pass

    monkeypatch.setattr(can, "Bus", Bus)
    with open_link("can://can0", FLIGHT_SIDE) as link:
        link.write(b"abc\0")
        assert (link.connected, link.ready, link.hang_ups) == (True, False, 0)  # full: it waits
        link.exchange(0.0)
        assert (link.connected, link.hang_ups) == (False, 1)
        exchange_until(link, lambda data: link.connected)
        link.write(b"abc\0")
        assert (Bus.opened, Bus.sent) == (2, 1)


@pytest.mark.skipif(not Path("/proc/net/can").exists(), reason="the kernel has no CAN (modprobe can vcan)")
def test_a_real_virtual_can_interface_carries_packets():
    add = subprocess.run(["ip", "link", "add", "dev", "obbgs0", "type", "vcan"], capture_output=True)
    if add.returncode:
        pytest.skip(f"no virtual CAN interface: {add.stderr.decode().strip()}")
    try:
        subprocess.run(["ip", "link", "set", "obbgs0", "up"], check=True)
        packets = [frame_packet(os.urandom(1000)) for _ in range(5)]
        with open_link("can://obbgs0", FLIGHT_SIDE) as flight, open_link("can://obbgs0", GROUND_SIDE) as own:
            assert pass_packets(flight, own, packets) == b"".join(packets)
    finally:
        subprocess.run(["ip", "link", "del", "obbgs0"], check=True)


def test_a_port_that_is_not_there_yet_is_awaited(terminal, caplog):
    master, _, name = terminal
    url, target = f"serial://{name}", os.readlink(name)
    name.unlink()
    with pytest.raises(LinkError, match="cannot open"):
        open_link(url, FLIGHT_SIDE)
    with open_link(url, FLIGHT_SIDE, must_be_there=False) as link:
        assert link.exchange(0.0) == b"" and not link.ready
        assert caplog.text.count("is awaited") == 1
        name.symlink_to(target)
        exchange_until(link, lambda data: link.connected)
        os.write(master, b"hello")
        assert exchange_until(link, lambda data: data == b"hello") == b"hello"
        assert link.hang_ups == 0


def test_an_interface_that_is_down_is_one_outage_however_long(monkeypatch, caplog):
    """Linux lets a socket bind to a CAN interface that is down; each receive then says ENETDOWN."""
    is_up, now_s = [True], [0.0]

    class Bus:
        def __init__(self, *_, **__): ...
        def shutdown(self) -> None: ...

        def recv(self, timeout=None):
            if not is_up[0]:
                raise can.CanOperationError("Error receiving: Network is down", errno.ENETDOWN)
            return None

        def send(self, *_, **__) -> None:
            self.recv()

    monkeypatch.setattr("can.Bus", Bus)
    monkeypatch.setattr("flightsw.ports.port.time.sleep", lambda _: None)
    link = SocketCanLink("can://can0", FLIGHT_SIDE, clock_s=lambda: now_s[0])
    for expected in (1, 2):
        is_up[0] = False
        for _ in range(500):
            now_s[0] += 0.02
            link.exchange(0.0)
        assert link.hang_ups == expected == caplog.text.count("hung up")
        is_up[0] = True
        for _ in range(100):
            now_s[0] += 0.05
            link.exchange(0.0)
            if link.ready:
                link.write(frame_packet(bytes(7)))
        assert link.bytes_written
    link._drop()


def test_a_serial_line_that_goes_away_is_told_once_in_words(caplog):
    ours, theirs = os.openpty()
    url = f"serial://{os.ttyname(theirs)}"
    os.close(theirs)
    with open_link(url, FLIGHT_SIDE) as link:
        os.close(ours)
        for _ in range(3):
            link.exchange(0.0)
    (why,) = (record.getMessage().partition(" hung up: ")[2] for record in caplog.records)
    assert why in ("the device went away", "Input/output error")  # by the kernel's mood: end of file, or EIO


def test_a_kernel_without_can_is_told_so(monkeypatch):
    def refuse(*_, **__) -> None:
        raise OSError(errno.EAFNOSUPPORT, os.strerror(errno.EAFNOSUPPORT))

    monkeypatch.setattr("can.Bus", refuse)
    with pytest.raises(
        LinkError, match=r"^cannot open can0: this kernel has no CAN \(modprobe can_raw loads it\)$"
    ):
        open_link("can://can0", FLIGHT_SIDE)
