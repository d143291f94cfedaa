"""Links over a CAN interface of the Linux kernel."""

import contextlib
import errno
import time
from collections import deque
from collections.abc import Callable

import can
from isotp import CanMessage

from flightsw.icd.link.can import CanSide, IsoTpChannels
from flightsw.icd.link.link_url import parse_link_url
from flightsw.ports.port import IsoTpPort


class SocketCanLink(IsoTpPort):
    """A CAN interface of the kernel: each packet is one ISO-TP message. Set its bit rates up with `ip link`."""

    _bus: can.BusABC | None = None

    def __init__(
        self,
        url: str,
        side: CanSide,
        clock_s: Callable[[], float] = time.monotonic,
        must_be_there: bool = True,
    ):
        self._channels = IsoTpChannels(*side, parse_link_url(url))
        self._unsent: deque[CanMessage] = deque()
        super().__init__(url, clock_s, must_be_there)

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
        try:
            self._bus = can.Bus(self.url.device, interface="socketcan", fd=self.url.fd)
        except OSError as error:
            if error.errno == errno.EAFNOSUPPORT:
                raise OSError("this kernel has no CAN (modprobe can_raw loads it)") from error
            raise
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
