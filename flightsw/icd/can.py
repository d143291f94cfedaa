"""Packets over CAN: ISO-TP messages in CAN frames, and CAN frames as an slcan adapter's text.

Bytes in, frames out and back, no port. can-isotp does ISO 15765-2; its time-outs read the machine's clock.
python-can's own slcan (4.6.1) is not used: it reads a byte a call, waits two seconds at opening and for each
write, and never gets past a byte that is not ASCII. The tests hold this text to it.
"""

import logging
import re
from collections import deque
from collections.abc import Iterable
from itertools import groupby

import isotp

from flightsw.icd.framing import DELIMITER
from flightsw.icd.link_url import SLCAN_BITRATES, LinkUrl

# The ground's identifiers are the lower ones and win the bus: flow control and commands pass first.
GROUND_IDS, FLIGHT_IDS = tuple(range(0x0C0, 0x0D0)), tuple(range(0x0D0, 0x0E0))
# Some channels wait for their flow control while another's data are on the bus. So many must be under way that
# the bus stays busy while the ground stores a frame (8 ms and more): 1100 bytes take 20 ms, on FD 2.5 ms. And no
# more than adapter and terminal hold for a ground that does not read: 16 such messages are 39 kB of slcan text.
CLASSIC_CHANNELS, FD_CHANNELS = 8, 16
MAX_MESSAGE_BYTES = 4200  # the longest packet (4096 bytes) as COBS with its CRC
ANSWER_S = 0.2  # for the other side to answer at all, on a busy computer too
CONSECUTIVE_FRAME = 2  # the type in its first half byte, ISO 15765-2
FD_SIZES = (0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64)  # bytes by length code, ISO 11898-1

_isotp_log = "isotp.link"
logging.getLogger(_isotp_log).setLevel(logging.CRITICAL)  # a warning a lost frame: they are counted


class IsoTpChannels:
    """Both directions of one side's messages over several ISO-TP channels, in order.

    `write` takes packets framed for a serial line, and `receive` returns them so: each travels as one ISO-TP
    message without its zero byte. ISO-TP repairs nothing; a message that lost a frame is dropped and counted.
    """

    def __init__(self, own_ids: tuple[int, ...], other_ids: tuple[int, ...], url: LinkUrl):
        self.messages_failed = 0  # not sent to the end: no flow control came
        self.frames_discarded = 0  # errors of reception: frames missing, repeated or out of place
        self.frames_repeated = 0  # came twice in a row
        self.frames_foreign = 0  # of other nodes
        self._payload_bytes_per_s = url.payload_baud_rate / 10
        self._channel_count = FD_CHANNELS if url.fd else CLASSIC_CHANNELS
        self._single_bytes = 62 if url.fd else 7  # more needs flow control
        self._waiting: deque[bytes] = deque()
        self._outgoing: list[isotp.CanMessage] = []
        self._incoming: deque[isotp.CanMessage] = deque()  # of the channel that is processed
        self._last_data = dict.fromkeys(other_ids, b"")
        count = self._channel_count
        self._channels = {
            other_id: self._channel(own_id, other_id, url.fd)
            for own_id, other_id in zip(own_ids[:count], other_ids[:count], strict=True)
        }

    def _channel(self, own_id: int, other_id: int, fd: bool) -> isotp.TransportLayerLogic:
        incoming = self._incoming
        parameters = {
            "blocksize": 0,  # one flow control a message
            "stmin": 0,
            "tx_data_length": 64 if fd else 8,
            "can_fd": fd,
            "bitrate_switch": fd,
            "max_frame_size": MAX_MESSAGE_BYTES,
            "rx_consecutive_frame_timeout": self._answer_ms(MAX_MESSAGE_BYTES),  # the others' may come first
            "logger_name": _isotp_log,
            "wait_func": lambda seconds: None,  # the check of these parameters would sleep
        }
        return isotp.TransportLayerLogic(
            lambda timeout: incoming.popleft() if incoming else None,
            self._outgoing.append,
            isotp.Address(isotp.AddressingMode.Normal_11bits, txid=own_id, rxid=other_id),
            self._note_error,
            parameters,
        )

    def _answer_ms(self, message_bytes: int) -> int:
        """Return how long an answer may take behind such messages of all the other channels."""
        queued_s = self._channel_count * message_bytes / self._payload_bytes_per_s
        return int(1000 * (ANSWER_S + 3 * queued_s))

    def _note_error(self, error: Exception) -> None:
        if isinstance(error, isotp.FlowControlTimeoutError | isotp.OverflowError):
            self.messages_failed += 1
        else:
            self.frames_discarded += 1

    @property
    def ready(self) -> bool:
        """Whether another message can start."""
        return not self._waiting and not all(channel.transmitting() for channel in self._channels.values())

    def write(self, framed: bytes) -> None:
        """Take framed packets; each becomes a message as soon as a channel is free."""
        self._waiting.extend(packet for packet in framed.split(DELIMITER) if packet)

    def reset(self) -> None:
        """Forget everything under way: the port was opened anew."""
        self._waiting.clear()
        self._outgoing.clear()
        for channel in self._channels.values():
            channel.reset()

    def exchange(self, frames: Iterable[isotp.CanMessage]) -> tuple[bytes, list[isotp.CanMessage]]:
        """Return the packets that `frames` complete, framed, and the frames to send now."""
        received = bytearray()
        # run by run as they came, not channel by channel: messages stay in order
        for number, run in groupby(frames, lambda frame: frame.arbitration_id | frame.is_extended_id << 29):
            channel = self._channels.get(number)
            if channel is None:
                self.frames_foreign += len(list(run))
                continue
            self._incoming.extend(self._without_repeats(number, run))
            received += self._process(channel)
        for channel in self._channels.values():  # time-outs
            if channel.transmitting() or channel.is_rx_active():
                received += self._process(channel)
        self._start()
        frames_out = self._outgoing.copy()
        self._outgoing.clear()
        return bytes(received), frames_out

    def _without_repeats(self, number: int, run: Iterable[isotp.CanMessage]) -> Iterable[isotp.CanMessage]:
        """Leave out a consecutive frame that came twice, as one may on a real bus; ISO-TP would end the message.

        Two in a row are never alike in their sequence numbers.
        """
        for frame in run:
            if (
                frame.data == self._last_data[number]
                and frame.data[:1]
                and frame.data[0] >> 4 == CONSECUTIVE_FRAME
            ):
                self.frames_repeated += 1
                continue
            self._last_data[number] = frame.data
            yield frame

    def _start(self) -> None:
        """Give waiting messages to free channels."""
        idle = [channel for channel in self._channels.values() if not channel.transmitting()]
        while self._waiting and idle:
            message = self._waiting.popleft()
            if len(idle) < len(self._channels):
                # without flow control it would overtake those under way; COBS leaves no zero byte in a packet
                message = message.ljust(self._single_bytes + 1, DELIMITER)
            channel = idle[0]
            channel.params.set("rx_flowcontrol_timeout", self._answer_ms(len(message)), validate=False)
            channel.send(message)
            channel.process()
            if channel.transmitting():
                idle.remove(channel)

    def _process(self, channel: isotp.TransportLayerLogic) -> bytes:
        received = bytearray()
        channel.process()
        while self._incoming:
            channel.process()
        while (message := channel.recv()) is not None:
            received += message.rstrip(DELIMITER) + DELIMITER  # without what lengthened it
        return bytes(received)


class SlcanText:
    """CAN frames from an slcan adapter's bytes (LAWICEL CANUSB, with CANable's d, D, b, B for CAN FD).

    At all times `frame_bytes + reply_bytes + skipped_bytes + pending_bytes` is the number of bytes fed.
    """

    LINE = re.compile(rb"([tdb])([0-7][0-9A-Fa-f]{2})|([TDB])([01][0-9A-Fa-f]{7})")
    MAX_LINE_BYTES = 10 + 2 * 64

    def __init__(self):
        self.frame_bytes = 0
        self.reply_bytes = 0  # the adapter's answers to commands
        self.skipped_bytes = 0  # neither
        self.skipped_lines = 0
        self.adapter_errors = 0  # a bell: the adapter refused a command or a frame
        self._pending = bytearray()
        self._too_long = False

    @property
    def pending_bytes(self) -> int:
        return len(self._pending)

    def feed(self, data: bytes) -> list[isotp.CanMessage]:
        """Return the frames that `data` completes; memory is bounded by the longest line."""
        bells = data.count(b"\a")
        self.adapter_errors += bells
        self.reply_bytes += bells
        *ended, rest = data.replace(b"\a", b"").split(b"\r")
        frames = []
        for part in ended:
            self._collect(part)
            frame = self._end_line()
            if frame is not None:
                frames.append(frame)
        self._collect(rest)
        return frames

    def _collect(self, part: bytes) -> None:
        if self._too_long or len(self._pending) + len(part) > self.MAX_LINE_BYTES:
            self._too_long = True
            self.skipped_bytes += len(self._pending) + len(part)
            self._pending.clear()
        else:
            self._pending += part

    def _end_line(self) -> isotp.CanMessage | None:
        line, too_long = bytes(self._pending), self._too_long
        self._pending.clear()
        self._too_long = False
        frame = None if too_long else parse_slcan(line)
        if frame is not None:
            self.frame_bytes += len(line) + 1
        elif line in (b"", b"z", b"Z") and not too_long:
            self.reply_bytes += len(line) + 1
        else:
            self.skipped_bytes += len(line) + 1
            self.skipped_lines += 1
        return frame


def parse_slcan(line: bytes) -> isotp.CanMessage | None:
    """Return the data frame in a line without its carriage return; None if it is not exactly one."""
    match = SlcanText.LINE.match(line)
    if match is None:
        return None
    kind, digits = (match[1] or match[3]).decode(), match[2] or match[4]
    code, text = line[match.end() : match.end() + 1], line[match.end() + 1 :]
    fd = kind not in "tT"
    if code not in (b"0123456789ABCDEFabcdef" if fd else b"012345678") or not code:
        return None
    size = FD_SIZES[int(code, 16)]
    if len(text) != 2 * size or (size and not text.isalnum()):
        return None
    try:
        data = bytes.fromhex(text.decode())
    except ValueError:
        return None
    return isotp.CanMessage(int(digits, 16), int(code, 16), data, kind.isupper(), fd, kind in "bB")


def format_slcan(frame: isotp.CanMessage) -> bytes:
    """Return a data frame as an slcan line, with its carriage return."""
    kind = ("b" if frame.bitrate_switch else "d") if frame.is_fd else "t"
    head = (
        f"{kind.upper()}{frame.arbitration_id:08X}"
        if frame.is_extended_id
        else f"{kind}{frame.arbitration_id:03X}"
    )
    return f"{head}{FD_SIZES.index(len(frame.data)):X}{frame.data.hex().upper()}\r".encode()


def open_slcan(url: LinkUrl) -> bytes:
    """Return the commands that end a half line, close the adapter's channel, set its rates and open it."""
    code = SLCAN_BITRATES.index(url.bitrate)
    data_phase = "Y5\r" if url.fd else ""
    return f"\r\rC\rS{code}\r{data_phase}O\r".encode()


def close_slcan() -> bytes:
    return b"\rC\r"
