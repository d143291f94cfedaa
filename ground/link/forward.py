"""Passes telemetry on to another ground system: each packet as it came, one a datagram, by UDP."""

import logging
import socket
from typing import Self
from urllib.parse import urlsplit

from flightsw.icd.config import ConfigError
from flightsw.ports import LinkError
from obbgs_base.errors import reason

log = logging.getLogger(__name__)
EXPECTED = "expected udp://HOST:PORT, such as udp://127.0.0.1:10015"


def parse_target(url: str) -> tuple[str, int]:
    """Return the host and the port that a URL names.

    Raises:
        ConfigError: not udp://HOST:PORT.
    """
    try:
        parts = urlsplit(url)
        host, port = parts.hostname, parts.port
    except ValueError as error:
        raise ConfigError(url, f"{error}: {EXPECTED}") from error
    whole = not (parts.path or parts.query or parts.fragment or parts.username or parts.password)
    if parts.scheme != "udp" or not host or not port or not whole:
        raise ConfigError(url, EXPECTED)
    return host, port


class Forwarder:
    """Sends packets to one address and never waits: what the machine does not take at once is dropped and counted.

    UDP tells nobody what was lost further on; `dropped` counts what this machine did not take, and what a host
    reported as refused because no program has the port.

    Raises:
        ConfigError: the URL is not usable.
        LinkError: the host is not known, or there is no way to it.
    """

    def __init__(self, url: str):
        host, port = parse_target(url)
        self.sent = 0
        self.dropped = 0
        try:
            family, kind, protocol, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
            self._socket = socket.socket(family, kind, protocol)
        except (OSError, UnicodeError) as error:
            raise LinkError(f"cannot forward to {url}: {reason(error)}", "check the host's name") from error
        try:
            self._socket.setblocking(False)
            self._socket.connect(address)  # opens no connection, but lets a refusal be noticed
        except OSError as error:
            self._socket.close()
            raise LinkError(f"cannot forward to {url}: {reason(error)}", "check address and route") from error

    def send(self, packet: bytes) -> None:
        """Send a packet now or drop it."""
        try:
            self._send(packet)
        except ConnectionRefusedError:  # this is about an earlier packet, and this one was not sent
            self.sent -= 1
            self._drop()
            try:
                self._send(packet)
            except OSError:
                self._drop()
        except OSError:  # no room, no route, or a port that may not be used
            self._drop()

    def _send(self, packet: bytes) -> None:
        self._socket.send(packet)
        self.sent += 1

    def _drop(self) -> None:
        self.dropped += 1
        if self.dropped == 1:
            log.warning("a packet could not be forwarded; further ones are counted")

    def close(self) -> None:
        self._socket.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
