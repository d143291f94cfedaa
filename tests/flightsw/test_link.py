"""The serial port of either side: URLs, hang-up and return, back-pressure. Both ports do the same."""

import os
import time
import tty

import pytest

import flightsw.link
import ground.link
from flightsw.errors import LinkError
from flightsw.icd.link_url import parse_link_url
from flightsw.icd.mission import ConfigError

BOTH_SIDES = pytest.mark.parametrize("side", [flightsw.link, ground.link])


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


def test_url_gives_device_and_baud_rate():
    assert parse_link_url("serial:///dev/ttyUSB0?baud=115200") == ("/dev/ttyUSB0", 115_200)
    assert parse_link_url("serial:///dev/pts/3") == ("/dev/pts/3", 921_600)


@pytest.mark.parametrize(
    ("url", "problem"),
    [
        ("slcan:///dev/ttyACM0?bitrate=1000000", "CAN links are not built yet"),
        ("can://can0", "CAN links are not built yet"),
        ("/dev/ttyUSB0", "expected serial:///dev"),
        ("serial://ttyUSB0", "expected serial:///dev"),
        ("serial:///dev/ttyUSB0?baud=fast", "got 'fast'"),
        ("serial:///dev/ttyUSB0?baud=50", "got '50'"),
        ("serial:///dev/ttyUSB0?parity=even", "unknown option parity"),
        ("serial://[", "not a URL"),
    ],
)
def test_an_unusable_url_says_what_is_wrong(url, problem):
    with pytest.raises(ConfigError, match=problem):
        parse_link_url(url)


@BOTH_SIDES
def test_a_port_that_is_not_there_is_a_link_error(side, tmp_path):
    with pytest.raises(side.LinkError, match=f"cannot open {tmp_path}/none"):
        side.SerialLink(f"serial://{tmp_path}/none")
    assert flightsw.link.LinkError is LinkError


@BOTH_SIDES
def test_bytes_pass_unchanged_both_ways(side, terminal):
    master, _, name = terminal
    every_byte = bytes(range(256))
    with side.SerialLink(f"serial://{name}") as link:
        os.write(master, every_byte)
        assert exchange_until(link, lambda data: len(data) >= 256) == every_byte
        link.write(every_byte)
        link.exchange(0.05)
        assert os.read(master, 1000) == b"\0" + every_byte  # the zero ends what may lie unfinished
        assert (link.bytes_read, link.bytes_written) == (256, 257)


@BOTH_SIDES
def test_the_port_makes_the_writer_wait_and_nothing_is_lost(side, terminal):
    master, _, name = terminal
    with side.SerialLink(f"serial://{name}") as link:
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


@BOTH_SIDES
def test_a_port_that_hung_up_is_opened_again_under_the_same_name(side, terminal):
    master, slave, name = terminal
    with side.SerialLink(f"serial://{name}") as link:
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
