"""Telemetry passed on by UDP: every packet as it came, and a receiver that is absent or slow costs the link nothing."""

import json
import os
import socket
import subprocess
import sys
import threading
import time
import tty

import pytest
from hypothesis import given
from hypothesis import strategies as st

from flightsw.icd.config import ConfigError
from flightsw.icd.link.framing import frame_packet
from flightsw.icd.packet import APID_EVENTS, TELECOMMAND, pack_packet
from flightsw.ports import LinkError
from ground.link.forward import Forwarder, parse_target
from ground.link.ingest import ListenSummary, Status, listen
from tests.dictionary_packets import packets
from tests.yamcs import free_ports


@pytest.fixture
def receiver():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as udp:
        udp.bind(("127.0.0.1", 0))
        udp.settimeout(10)
        yield udp


def url_of(udp: socket.socket) -> str:
    return f"udp://127.0.0.1:{udp.getsockname()[1]}"


def passed(wire: bytes, packets: int, folder, mission, forward: Forwarder) -> ListenSummary:
    """Let `listen` receive these bytes over a pseudo-terminal, until it has so many packets."""
    received: list[int] = []
    is_open = threading.Event()  # opening a port throws away what it holds
    end_s = time.monotonic() + 30
    ours, theirs = os.openpty()
    tty.setraw(theirs)

    def on_status(status: Status) -> None:
        received.append(status.summary.packets_received)
        is_open.set()

    def write() -> None:
        left = wire if is_open.wait(30) else b""
        while left:
            left = left[os.write(ours, left[:1000]) :]

    writing = threading.Thread(target=write)
    try:
        writing.start()
        url = f"serial://{os.ttyname(theirs)}"
        return listen(
            url,
            folder,
            mission,
            should_stop=lambda: packets in received or time.monotonic() > end_s,
            on_status=on_status,
            forward=forward,
        )
    finally:
        writing.join(10)
        os.close(ours)
        os.close(theirs)


def test_every_packet_of_the_spacecraft_is_passed_on_as_it_came(receiver, tmp_path, small_mission):
    sent = [packet for packet, *_ in packets(40, seed=4)]
    echo = pack_packet(TELECOMMAND, APID_EVENTS, 0, b"not the spacecraft's")
    wire = b"\0noise\0" + b"".join(frame_packet(packet) for packet in [echo, *sent])
    with Forwarder(url_of(receiver)) as forward:
        summary = passed(wire, len(sent), tmp_path / "session", small_mission, forward)
    assert (summary.packets_forwarded, summary.packets_not_forwarded) == (len(sent), 0)
    assert [receiver.recv(65_536) for _ in sent] == sent
    receiver.setblocking(False)
    with pytest.raises(BlockingIOError):
        receiver.recv(65_536)  # neither the echo nor the noise


def test_what_an_absent_receiver_misses_is_counted_and_kept_in_the_session(tmp_path, small_mission):
    sent = [packet for packet, *_ in packets(40, seed=4)]
    nobody, _ = free_ports()
    with Forwarder(f"udp://127.0.0.1:{nobody}") as forward:
        wire = b"\0" + b"".join(map(frame_packet, sent))
        summary = passed(wire, len(sent), tmp_path / "session", small_mission, forward)
    assert summary.packets_received == len(sent)  # the link does not suffer
    assert summary.packets_forwarded + summary.packets_not_forwarded == len(sent)
    assert summary.packets_not_forwarded > len(sent) // 2  # the first is refused only after it was sent
    losses = json.loads((tmp_path / "session/session.json").read_text())["losses"]
    assert losses["packets_not_forwarded"] == summary.packets_not_forwarded


def test_a_receiver_that_comes_late_gets_what_is_sent_from_then_on():
    port, _ = free_ports()
    with Forwarder(f"udp://127.0.0.1:{port}") as forward:
        for _ in range(5):
            forward.send(b"lost")
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as udp:
            udp.bind(("127.0.0.1", port))
            udp.settimeout(10)
            forward.send(b"first")
            forward.send(b"second")
            assert {udp.recv(100), udp.recv(100)} == {b"first", b"second"}
        assert forward.sent + forward.dropped == 7


@pytest.mark.parametrize(
    "error", [BlockingIOError(), OSError(113, "No route to host"), OSError(90, "Message too long")]
)
def test_what_the_machine_does_not_take_is_dropped_and_never_waited_for(receiver, error):
    class FullSocket(socket.socket):
        def send(self, *_):
            raise error

    with Forwarder(url_of(receiver)) as forward:
        assert forward._socket.getblocking() is False
        forward._socket.close()
        forward._socket = FullSocket(socket.AF_INET, socket.SOCK_DGRAM)
        forward.send(b"packet")
        assert (forward.sent, forward.dropped) == (0, 1)


@pytest.mark.parametrize(
    "url",
    [
        "",
        "udp://",
        "udp://host",
        "udp://host:",
        "udp://host:0",
        "udp://host:65536",
        "udp://host:-1",
        "udp://host:port",
        "udp://:10015",
        "tcp://host:10015",
        "host:10015",
        "udp://host:10015/path",
        "udp://host:10015?a=b",
        "udp://user:secret@host:10015",
        "udp://[::1:10015",
    ],
)
def test_a_target_that_is_no_host_and_port_is_refused_with_an_example(url):
    with pytest.raises(ConfigError, match="expected udp://HOST:PORT"):
        parse_target(url)


@given(st.text())
def test_any_text_is_a_target_or_a_config_error(text):
    for url in (text, f"udp://{text}", f"udp://{text}:10015"):
        try:
            host, port = parse_target(url)
        except ConfigError:
            continue
        assert host and 0 < port < 65_536


def test_hosts_by_number_and_name_are_understood():
    assert parse_target("udp://[::1]:10015") == ("::1", 10015)
    assert parse_target("udp://yamcs.example.org:1") == ("yamcs.example.org", 1)


@pytest.mark.parametrize("host", ["255.255.255.255", "no-such-host.invalid", "a" * 70, "127.0.0.1.1"])
def test_a_host_that_cannot_be_reached_is_an_error_before_the_pass_begins(host):
    with pytest.raises(LinkError, match="cannot forward to udp://"):
        Forwarder(f"udp://{host}:10015")


def test_a_wrong_target_ends_the_command_before_the_port_is_opened(tmp_path):
    arguments = [
        "--link",
        "serial:///dev/null",
        "--session",
        str(tmp_path / "s"),
        "--forward",
        "udp://nowhere",
    ]
    command = [sys.executable, "-m", "ground.cli", "listen", *arguments]
    ended = subprocess.run(command, capture_output=True, text=True)
    assert ended.returncode == 2, ended.stderr
    assert "udp://nowhere: expected udp://HOST:PORT" in ended.stderr and "Traceback" not in ended.stderr
    assert not (tmp_path / "s").exists()
