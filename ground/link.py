"""The ground's end of the link: a serial port that hangs up and comes back.

The twin of flightsw/link.py, because neither side may import the other; a test holds the two equal.
"""

import logging
import os
import select
import termios
import time
from collections.abc import Callable

import serial

from flightsw.icd.link_url import parse_link_url


class LinkError(RuntimeError):
    """The link's port cannot be opened."""


log = logging.getLogger(__name__)

REOPEN_S = 0.2  # between attempts to open a port that hung up
READ_BYTES = 65_536


class SerialLink:
    """A serial port that comes back after a hang-up. Bytes lost in one are the protocol's to send again.

    Raises:
        ConfigError: the URL is not usable.
        LinkError: the port cannot be opened the first time.
    """

    def __init__(self, url: str, clock_s: Callable[[], float] = time.monotonic):
        self.device, self.baud_rate = parse_link_url(url)
        self.bytes_read = 0
        self.bytes_written = 0
        self.hang_ups = 0
        self._clock_s = clock_s
        self._unsent = b""
        self._next_open_s = float("-inf")
        self._port: serial.Serial | None = None
        try:
            self._open()
        except (OSError, ValueError) as error:  # SerialException is an OSError
            raise LinkError(f"cannot open {self.device}: {error}") from error

    def __enter__(self) -> "SerialLink":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        if self._port is not None:
            self._port.close()
            self._port = None

    @property
    def connected(self) -> bool:
        return self._port is not None

    @property
    def ready(self) -> bool:
        """Whether `write` will take bytes: the port is open and has taken all that came before."""
        return self._port is not None and not self._unsent

    def write(self, data: bytes) -> None:
        """Give bytes to the port; what it does not take at once goes with the next `exchange`."""
        self._unsent += data
        self._flush()

    def exchange(self, timeout_s: float) -> bytes:
        """Return the bytes that came within `timeout_s`; unsent bytes go out as the port takes them."""
        if self._port is None and not self._reopen():
            time.sleep(min(timeout_s, REOPEN_S))
            return b""
        assert self._port is not None
        try:
            descriptor = self._port.fileno()
            writers = [descriptor] if self._unsent else []
            readable, writable, _ = select.select([descriptor], writers, [], timeout_s)
            if writable:
                self._flush()
            if not readable or self._port is None:
                return b""
            data = os.read(descriptor, READ_BYTES)
            if not data:
                raise OSError("the port hung up")
        except (OSError, ValueError, termios.error) as error:
            self._hang_up(error)
            return b""
        self.bytes_read += len(data)
        return data

    def _flush(self) -> None:
        if self._port is None or not self._unsent:
            return
        try:
            count = os.write(self._port.fileno(), self._unsent)
        except BlockingIOError:
            return
        except (OSError, ValueError) as error:
            self._hang_up(error)
            return
        self.bytes_written += count
        self._unsent = self._unsent[count:]

    def _open(self) -> None:
        self._port = serial.Serial(self.device, self.baud_rate, timeout=0, write_timeout=0, exclusive=True)
        self._unsent = b"\0"  # ends whatever half packet the other side still holds

    def _reopen(self) -> bool:
        now_s = self._clock_s()
        if now_s < self._next_open_s:
            return False
        self._next_open_s = now_s + REOPEN_S
        try:
            self._open()
        except (OSError, ValueError):
            return False
        log.info("%s is open again", self.device)
        return True

    def _hang_up(self, error: Exception) -> None:
        log.warning("%s hung up: %s", self.device, error)
        self.hang_ups += 1
        self._unsent = b""
        self.close()
