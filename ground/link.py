"""The ground's end of the link: ports that hang up and come back.

The twin of flightsw/link.py, because neither side may import the other; a test holds the two equal.
"""

import contextlib
import errno
import logging
import os
import select
import termios
import time
from collections import deque
from collections.abc import Callable
from typing import Protocol, Self

import can
import serial
from isotp import CanMessage

from flightsw.icd.can import (
    FLIGHT_IDS,
    GROUND_IDS,
    IsoTpChannels,
    SlcanText,
    close_slcan,
    format_slcan,
    open_slcan,
)
from flightsw.icd.link_url import parse_link_url
from obbgs_base.errors import ObbgsError


class LinkError(ObbgsError, RuntimeError):
    """The link's port cannot be opened."""


log = logging.getLogger(__name__)

OWN_IDS, OTHER_IDS = GROUND_IDS, FLIGHT_IDS  # of CAN frames
REOPEN_S = 0.2  # between attempts to open a port that hung up
READ_BYTES = 65_536
CLOSE_S = 1.5  # for what was sent last to reach the other side, when a CAN port is closed
CLOSE_STEP_S = 0.01
ADAPTER_FRAMES = 128  # that an adapter may hold for the bus
SILENT_S = 5.0  # without a byte from an slcan adapter before it is set up again: it may have been reset


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
        """What this wire itself threw away, by kind; the packets in it are counted as missing besides."""
        ...

    def write(self, data: bytes) -> None:
        """Give framed packets to the wire; what it does not take at once goes with the next `exchange`."""
        ...

    def exchange(self, timeout_s: float) -> bytes:
        """Return the bytes that came within `timeout_s`; unsent bytes go out as the wire takes them."""
        ...

    def close(self) -> None: ...

    def __enter__(self) -> Self: ...

    def __exit__(self, *_: object) -> None: ...


def open_link(url: str) -> Link:
    """Return the open link that a URL names: serial:///dev/..., slcan:///dev/... or can://can0.

    Raises:
        ConfigError: the URL is not usable.
        LinkError: the port cannot be opened.
    """
    links = {"serial": SerialLink, "slcan": SlcanLink, "can": SocketCanLink}
    return links[parse_link_url(url).scheme](url)


class _Port:
    """A port that comes back after a hang-up. Packets lost in one are the protocol's to send again.

    Raises:
        ConfigError: the URL is not usable.
        LinkError: the port cannot be opened the first time.
    """

    OPEN_ERRORS = (OSError, ValueError, can.CanError)  # SerialException is an OSError

    def __init__(self, url: str, clock_s: Callable[[], float] = time.monotonic):
        self.url = parse_link_url(url)
        self.baud_rate = self.url.payload_baud_rate
        self.bytes_read = 0
        self.bytes_written = 0
        self.hang_ups = 0
        self._clock_s = clock_s
        self._next_open_s = float("-inf")
        try:
            self._open()
        except self.OPEN_ERRORS as error:
            raise LinkError(f"cannot open {self.url.device}: {error}") from error

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

    def _drop(self) -> None:
        """Give up the port and what it has not sent."""
        raise NotImplementedError

    def _wait_for_port(self, timeout_s: float) -> bool:
        """Tell whether the port is open, after an attempt to open it if one is due."""
        if self.connected:
            return True
        now_s = self._clock_s()
        if now_s >= self._next_open_s:
            self._next_open_s = now_s + REOPEN_S
            with contextlib.suppress(*self.OPEN_ERRORS):
                self._open()
                log.info("%s is open again", self.url.device)
                return True
        time.sleep(min(timeout_s, REOPEN_S))
        return False

    def _hang_up(self, error: Exception) -> None:
        log.warning("%s hung up: %s", self.url.device, error)
        self.hang_ups += 1
        self._drop()


class SerialLink(_Port):
    """A serial port."""

    _port: serial.Serial | None = None
    _unsent = b""

    def close(self) -> None:
        if self._port is not None:
            self._port.close()
            self._port = None

    @property
    def connected(self) -> bool:
        return self._port is not None

    @property
    def ready(self) -> bool:
        return self._port is not None and not self._unsent

    @property
    def losses(self) -> dict[str, int]:
        return {}

    def write(self, data: bytes) -> None:
        self._unsent += data
        self._flush()

    def exchange(self, timeout_s: float) -> bytes:
        if not self._wait_for_port(timeout_s):
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
        self._port = serial.Serial(
            self.url.device, self.url.baud_rate, timeout=0, write_timeout=0, exclusive=True
        )
        self._unsent = b"\0"  # ends whatever half packet the other side still holds

    def _drop(self) -> None:
        self._unsent = b""
        SerialLink.close(self)


class _IsoTpPort(_Port):
    """A port with messages under way, which are finished before it is closed.

    Else the last words would be cut off: the rest of a message goes out only when the other side has answered its first
    frame, and an adapter drops what it has not sent when it is closed.
    """

    _channels: IsoTpChannels
    _last_frame_s = float("-inf")  # when a frame was given to the port

    @property
    def _has_unsent(self) -> bool:
        raise NotImplementedError

    def _finish(self) -> None:
        """Go on until every message is out, or the other side has not answered for too long; count what remains."""
        frame_bytes = 63 if self.url.fd else 7
        quiet_s = 0.02 + ADAPTER_FRAMES * frame_bytes * 10 / self.url.payload_baud_rate
        end_s = time.monotonic() + CLOSE_S + quiet_s
        while self.connected and time.monotonic() < end_s:
            is_out = not self._channels.messages_pending and not self._has_unsent
            if is_out and self._clock_s() - self._last_frame_s > quiet_s:
                break
            self.exchange(CLOSE_STEP_S)
        if count := self._channels.messages_pending:
            log.warning("%s is closed with %d messages that nobody took", self.url.device, count)
        self._channels.abandon()

    def exchange(self, timeout_s: float) -> bytes:
        raise NotImplementedError


class SlcanLink(SerialLink, _IsoTpPort):
    """A CAN bus behind an slcan adapter on a serial port: each packet is one ISO-TP message."""

    def __init__(self, url: str, clock_s: Callable[[], float] = time.monotonic):
        self._channels = IsoTpChannels(OWN_IDS, OTHER_IDS, parse_link_url(url))
        self._text = SlcanText()
        self._last_byte_s = clock_s()
        super().__init__(url, clock_s)

    def close(self) -> None:
        self._finish()
        if self._port is not None:
            super().write(close_slcan())
        super().close()

    @property
    def _has_unsent(self) -> bool:
        return bool(self._unsent)

    @property
    def ready(self) -> bool:
        return super().ready and self._channels.ready

    @property
    def losses(self) -> dict[str, int]:
        return {
            "adapter_lines_skipped": self._text.skipped_lines,
            "adapter_errors": self._text.adapter_errors,
            "can_frames_discarded": self._channels.frames_discarded,
            "can_frames_repeated": self._channels.frames_repeated,
            "messages_failed": self._channels.messages_failed,
        }

    def write(self, data: bytes) -> None:
        self._channels.write(data)
        self._send(self._channels.exchange([], self._clock_s())[1])

    def exchange(self, timeout_s: float) -> bytes:
        text = super().exchange(timeout_s)
        now_s = self._clock_s()
        packets, frames = self._channels.exchange(self._text.feed(text), now_s)
        self._send(frames)
        if text:
            self._last_byte_s = now_s
        elif self.connected and now_s - self._last_byte_s > SILENT_S:
            self._last_byte_s = now_s
            super().write(open_slcan(self.url))
        return packets

    def _send(self, frames: list[CanMessage]) -> None:
        if frames:
            self._last_frame_s = self._clock_s()
            super().write(b"".join(map(format_slcan, frames)))

    def _open(self) -> None:
        super()._open()
        self._channels.abandon()
        self._unsent = open_slcan(self.url)


class SocketCanLink(_IsoTpPort):
    """A CAN interface of the kernel: each packet is one ISO-TP message. Set its bit rates up with `ip link`."""

    _bus: can.BusABC | None = None

    def __init__(self, url: str, clock_s: Callable[[], float] = time.monotonic):
        self._channels = IsoTpChannels(OWN_IDS, OTHER_IDS, parse_link_url(url))
        self._unsent: deque[CanMessage] = deque()
        super().__init__(url, clock_s)

    def close(self) -> None:
        self._finish()
        if self._bus is not None:
            self._bus.shutdown()
            self._bus = None

    @property
    def _has_unsent(self) -> bool:
        return bool(self._unsent)

    @property
    def connected(self) -> bool:
        return self._bus is not None

    @property
    def ready(self) -> bool:
        return self._bus is not None and not self._unsent and self._channels.ready

    @property
    def losses(self) -> dict[str, int]:
        return {
            "can_frames_discarded": self._channels.frames_discarded,
            "can_frames_repeated": self._channels.frames_repeated,
            "messages_failed": self._channels.messages_failed,
        }

    def write(self, data: bytes) -> None:
        self._channels.write(data)
        self._unsent.extend(self._channels.exchange([], self._clock_s())[1])
        self._flush()

    def exchange(self, timeout_s: float) -> bytes:
        if not self._wait_for_port(timeout_s):
            return b""
        frames = []
        try:
            assert self._bus is not None
            message = self._bus.recv(min(timeout_s, 0.001) if self._unsent else timeout_s)
            while message is not None:
                if not message.is_error_frame and not message.is_remote_frame:
                    self.bytes_read += len(message.data)
                    frames.append(_frame_of(message))
                message = self._bus.recv(0)
        except (OSError, can.CanError) as error:
            self._hang_up(error)
        packets, frames_out = self._channels.exchange(frames, self._clock_s())
        self._unsent.extend(frames_out)
        self._flush()
        return packets

    def _flush(self) -> None:
        while self._bus is not None and self._unsent:
            frame = self._unsent[0]
            try:
                self._bus.send(_message_of(frame), timeout=0)
            except can.CanOperationError as error:
                if error.error_code in (None, errno.ENOBUFS):  # the queue is full: the bus is the brake
                    return
                self._hang_up(error)
                return
            self.bytes_written += len(frame.data)
            self._last_frame_s = self._clock_s()
            self._unsent.popleft()

    def _open(self) -> None:
        self._bus = can.Bus(self.url.device, interface="socketcan", fd=self.url.fd)
        self._channels.abandon()
        self._unsent.clear()

    def _drop(self) -> None:
        self._unsent.clear()
        bus, self._bus = self._bus, None
        if bus is not None:
            with contextlib.suppress(OSError, can.CanError):
                bus.shutdown()


def _frame_of(message: can.Message) -> CanMessage:
    return CanMessage(
        message.arbitration_id,
        message.dlc,
        bytes(message.data),
        message.is_extended_id,
        message.is_fd,
        message.bitrate_switch,
    )


def _message_of(frame: CanMessage) -> can.Message:
    return can.Message(
        arbitration_id=frame.arbitration_id,
        data=frame.data,
        is_extended_id=frame.is_extended_id,
        is_fd=frame.is_fd,
        bitrate_switch=frame.bitrate_switch,
    )
