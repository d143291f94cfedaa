"""Links over a CAN bus behind an slcan adapter."""

import time
from collections.abc import Callable

from isotp import CanMessage

from flightsw.icd.link.can import CanSide, IsoTpChannels
from flightsw.icd.link.link_url import parse_link_url
from flightsw.icd.link.slcan import SlcanText, close_slcan, format_slcan, open_slcan
from flightsw.ports.port import IsoTpPort
from flightsw.ports.serial_port import SerialLink

SILENT_S = 5.0  # without a byte from the adapter before it is set up again: it may have been reset


class SlcanLink(SerialLink, IsoTpPort):
    """A CAN bus behind an slcan adapter on a serial port: each packet is one ISO-TP message."""

    def __init__(
        self,
        url: str,
        side: CanSide,
        clock_s: Callable[[], float] = time.monotonic,
        must_be_there: bool = True,
    ):
        self._channels = IsoTpChannels(*side, parse_link_url(url))
        self._text = SlcanText()
        self._frames_given = 0
        self._last_byte_s = clock_s()
        super().__init__(url, clock_s, must_be_there)

    def close(self) -> None:
        self._finish()
        if self._port is not None:
            super().write(close_slcan())
        super().close()

    @property
    def _has_unsent(self) -> bool:
        """Whether text has not gone out, or is still on its way to an adapter that acknowledges frames."""
        return bool(self._unsent) or 0 < self._text.frames_accepted < self._frames_given

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
        accepted_before = self._text.frames_accepted
        packets, frames = self._channels.exchange(self._text.feed(text), now_s)
        if self._text.frames_accepted > accepted_before:
            self._last_frame_s = now_s
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
            self._frames_given += len(frames)
            super().write(b"".join(map(format_slcan, frames)))

    def _open(self) -> None:
        super()._open()
        self._channels.abandon()
        self._unsent = open_slcan(self.url)
        self._frames_given = self._text.frames_accepted = 0
