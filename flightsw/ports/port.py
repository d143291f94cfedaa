"""What all ports share: the `Link` that flight and ground use, and opening a port again after it hung up.

The device or the driver slows the writer down; there is no timer here that does.
"""

import contextlib
import logging
import time
from collections.abc import Callable
from typing import Protocol, Self

import can

from flightsw.icd.link.can import IsoTpChannels
from flightsw.icd.link.link_url import parse_link_url
from obbgs_base.errors import ObbgsError, counted, reason

log = logging.getLogger(__name__)

REOPEN_S = 0.2  # between attempts to open a port that hung up
STEADY_S = 1.0  # a port that took bytes for so long after an outage works again
CLOSE_S = 1.5  # for what was sent last to reach the other side, when a CAN port is closed
CLOSE_STEP_S = 0.01
ADAPTER_FRAMES = 128  # that an adapter may hold for the bus


class LinkError(ObbgsError):
    """The link's port cannot be opened: `problem` says why, `remedy` what to do, empty where that is not known."""

    def __init__(self, problem: str, remedy: str = ""):
        super().__init__(f"{problem}; {remedy}" if remedy else problem)
        self.problem, self.remedy = problem, remedy


class Link(Protocol):
    """Framed packets to and from the other side, over whatever wire."""

    baud_rate: int  # of the serial line that is as fast; timers follow it
    bytes_read: int
    bytes_written: int
    hang_ups: int

    @property
    def connected(self) -> bool: ...

    @property
    def ready(self) -> bool:
        """Whether `write` will take a packet: the port is open and has room."""
        ...

    @property
    def losses(self) -> dict[str, int]:
        """What this wire itself dropped, by kind; packets lost that way are counted as missing as well."""
        ...

    def write(self, data: bytes) -> None:
        """Give framed packets to the wire; what it does not take at once is sent by the next `exchange`."""
        ...

    def exchange(self, timeout_s: float) -> bytes:
        """Return the bytes that came within `timeout_s`; unsent bytes go out as the wire takes them."""
        ...

    def close(self) -> None: ...

    def __enter__(self) -> Self: ...

    def __exit__(self, *_: object) -> None: ...


class Port:
    """A port that is opened again after it hung up. CFDP sends again what was lost meanwhile.

    An outage is one hang-up, however often the port can be opened meanwhile: it is over when a byte comes in, or when
    bytes go out for `STEADY_S`.

    Raises:
        ConfigError: the URL is not usable.
        LinkError: the port must be there and cannot be opened the first time.
    """

    OPEN_ERRORS = (OSError, ValueError, can.CanError)  # SerialException is an OSError

    def __init__(self, url: str, clock_s: Callable[[], float] = time.monotonic, must_be_there: bool = True):
        self.url = parse_link_url(url)
        self.baud_rate = self.url.payload_baud_rate
        self.bytes_read = 0
        self.bytes_written = 0
        self.hang_ups = 0
        self._clock_s = clock_s
        self._next_open_s = float("-inf")
        self._opened_s = clock_s()
        self._is_outage = False  # until it is known that the port works again
        self._bytes_at_outage = (0, 0)  # read and written
        try:
            self._open()
        except self.OPEN_ERRORS as error:
            why, remedy = self._why(error)
            if must_be_there:
                raise LinkError(f"cannot open {self.url.device}: {why}", remedy) from error
            self._is_outage = True
            log.warning("%s is awaited: it cannot be opened yet: %s", self.url.device, LinkError(why, remedy))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def connected(self) -> bool:
        raise NotImplementedError

    def close(self) -> None:
        raise NotImplementedError

    def _open(self) -> None:
        raise NotImplementedError

    def _why(self, error: Exception) -> tuple[str, str]:
        """Return why a port cannot be opened and what to do, the second empty where that is not known."""
        return reason(error), ""

    def _drop(self) -> None:
        """Give up the port and what it has not sent."""
        raise NotImplementedError

    def _wait_for_port(self, timeout_s: float) -> bool:
        """Tell whether the port is open, after an attempt to open it if one is due."""
        if self.connected:
            self._note_bytes()
            return True
        now_s = self._clock_s()
        if now_s >= self._next_open_s:
            self._next_open_s = now_s + REOPEN_S
            with contextlib.suppress(*self.OPEN_ERRORS):
                self._open()
                self._opened_s = now_s
                return True
        time.sleep(min(timeout_s, REOPEN_S))
        return False

    def _note_bytes(self) -> None:
        """End an outage once the port works."""
        if not self._is_outage:
            return
        read, written = self._bytes_at_outage
        steady = self.bytes_written > written and self._clock_s() - self._opened_s > STEADY_S
        if self.bytes_read > read or steady:
            self._is_outage = False
            log.info("%s works again", self.url.device)

    def _hang_up(self, error: Exception) -> None:
        self._note_bytes()
        if not self._is_outage:
            log.warning("%s hung up: %s", self.url.device, reason(error))
            self.hang_ups += 1
        self._is_outage = True
        self._bytes_at_outage = (self.bytes_read, self.bytes_written)
        self._drop()


class IsoTpPort(Port):
    """A port with ISO-TP messages in transit, which are finished before it is closed.

    Otherwise the last messages would be cut off: the rest of a message is sent only after the other side has answered
    its first frame, and an adapter that is closed drops what it has not sent.
    """

    _channels: IsoTpChannels
    _last_frame_s = float("-inf")  # when a frame was given to the port, or the adapter took one

    @property
    def _has_unsent(self) -> bool:
        raise NotImplementedError

    def _finish(self) -> None:
        """Send until every message is out or the other side has not answered for too long; count what remains."""
        frame_bytes = 63 if self.url.fd else 7
        quiet_s = 0.02 + ADAPTER_FRAMES * frame_bytes * 10 / self.url.payload_baud_rate
        end_s = time.monotonic() + CLOSE_S + quiet_s
        while self.connected and time.monotonic() < end_s:
            is_out = not self._channels.messages_pending and not self._has_unsent
            if is_out and self._clock_s() - self._last_frame_s > quiet_s:
                break
            self.exchange(CLOSE_STEP_S)
        if count := self._channels.messages_pending:
            log.warning("%s is closed with %s that nobody took", self.url.device, counted(count, "message"))
        self._channels.abandon()

    def exchange(self, timeout_s: float) -> bytes:
        raise NotImplementedError
