"""Packets over CAN: ISO-TP messages in CAN frames.

Bytes and the time in, frames out and back, no port and no clock. can-isotp does ISO 15765-2 except for its time-outs,
which would also count the time during which this computer did not read its port.
"""

import logging
from collections import deque
from collections.abc import Callable, Iterable
from itertools import groupby
from typing import NamedTuple

import isotp

from flightsw.icd.link.framing import DELIMITER
from flightsw.icd.link.link_url import LinkUrl

# The ground's identifiers are the lower ones and win the bus: flow control and commands pass first.
GROUND_IDS, FLIGHT_IDS = tuple(range(0x0C0, 0x0D0)), tuple(range(0x0D0, 0x0E0))


class CanSide(NamedTuple):
    """One end of the bus: the identifiers of the frames that it sends, and of those that it receives."""

    own_ids: tuple[int, ...]
    other_ids: tuple[int, ...]


FLIGHT_SIDE, GROUND_SIDE = CanSide(FLIGHT_IDS, GROUND_IDS), CanSide(GROUND_IDS, FLIGHT_IDS)
# Some channels wait for their flow control while the data of another are on the bus. There must be enough messages in
# transit to keep the bus busy while the ground stores a frame (8 ms and more): 1100 bytes take 20 ms, on FD 2.5 ms.
# There must not be more than adapter and terminal can buffer while the ground does not read: 16 such messages are 39 kB
# of slcan text.
CLASSIC_CHANNELS, FD_CHANNELS = 8, 16
# Of longer packets fewer are in transit, so that no more has to be buffered.
CHANNEL_BYTES = 1200  # mean length of the messages in transit, at most
MAX_MESSAGE_BYTES = 4200  # the longest packet (4096 bytes) as COBS with its CRC
ANSWER_S = 0.2  # for the other side to answer at all, on a busy computer too
# A computer that does not read its port for a second (it writes to a slow disk) loses nothing. If no flow control comes
# (N_Bs), the first frame of the message is sent again ("offered"), after twice the time but no more than a second: the
# first frame or its answer may be lost, and nothing else was sent. The receiver may wait longer for the rest of a
# message (N_Cr), since the next message of the channel ends the wait as well.
OFFERS, LONGEST_WAIT_S = 5, 1.0
SECOND_ANSWER_S = 0.4  # after the answer to an offer, for the answer to its repetition
REST_S = 2.0
# time between two reads of the port counts for time-outs only up to this: frames may wait unread
LOOK_S = 0.05
FIRST_FRAME, CONSECUTIVE_FRAME, FLOW_CONTROL = 1, 2, 3  # the types in the first half byte, ISO 15765-2
NEVER_MS = 24 * 3600 * 1000

_isotp_log = "isotp.link"
logging.getLogger(_isotp_log).setLevel(logging.CRITICAL)  # a warning a lost frame: they are counted


class _Channel:
    """One ISO-TP channel: a message in transit in each direction, and the deadlines for their next frames."""

    def __init__(self, own_id: int, other_id: int, fd: bool, send_frame: Callable[[isotp.CanMessage], None]):
        self.offers = 0  # how often the first frame of the message in transit was sent
        self.answer_until_s = self.rest_until_s = 0.0
        # A second answer to an offer that was repeated would be taken for that to the channel's next message, which
        # would then overtake others: the channel waits for it before it starts another.
        self._answers_due, self._answers_until_s = 0, 0.0
        self.errors: list[Exception] = []  # since they were last looked at
        self.frames_repeated = 0
        self._has_begun = False  # whether a message has begun since listening did
        self._incoming: deque[isotp.CanMessage] = deque()
        self._message = b""
        self._last_data = b""
        self._answered_s = float("-inf")
        parameters = {
            "blocksize": 0,  # one flow control a message
            "stmin": 0,
            "override_receiver_stmin": 0.0,  # the other side asks for none, and a pause would need a clock
            "tx_data_length": 64 if fd else 8,
            "can_fd": fd,
            "bitrate_switch": fd,
            "max_frame_size": MAX_MESSAGE_BYTES,
            "rx_flowcontrol_timeout": NEVER_MS,
            "rx_consecutive_frame_timeout": NEVER_MS,
            "logger_name": _isotp_log,
            "wait_func": lambda seconds: None,  # the check of these parameters would sleep
        }
        self._layer = isotp.TransportLayerLogic(
            lambda timeout: self._incoming.popleft() if self._incoming else None,
            send_frame,
            isotp.Address(isotp.AddressingMode.Normal_11bits, txid=own_id, rxid=other_id),
            self.errors.append,
            parameters,
        )

    @property
    def is_sending(self) -> bool:
        return self._layer.transmitting()

    def is_free(self, time_s: float) -> bool:
        """Whether another message can start, and no answer that is still due could be taken for one to it."""
        return not self.is_sending and not (self._answers_due and time_s < self._answers_until_s)

    @property
    def is_receiving(self) -> bool:
        return self._layer.is_rx_active()

    @property
    def pending_bytes(self) -> int:
        """Bytes of the message that waits for its flow control."""
        return len(self._message) if self.is_sending else 0

    @property
    def received_bytes(self) -> int:
        """Bytes of the message that is coming in."""
        return len(self._layer.rx_buffer)

    def reset(self) -> None:
        self._layer.reset()
        self._answers_due, self._has_begun = 0, False

    def send(self, message: bytes) -> None:
        self._message, self.offers, self._answers_due = message, 0, 0
        self.offer()

    def offer(self) -> None:
        """Send the first frame of the message in transit, for the first time or again."""
        self.offers += 1
        self._layer.stop_sending()
        self._layer.send(self._message)
        self._layer.process()

    def give_up_sending(self, time_s: float) -> None:
        self._layer.stop_sending()
        self._await_answers(self.offers, time_s)

    def _await_answers(self, count: int, time_s: float) -> None:
        self._answers_due, self._answers_until_s = count, time_s + SECOND_ANSWER_S

    def take_unexpected_answer(self) -> None:
        """Note a flow control that came while no message was waiting for one."""
        self._answers_due = max(self._answers_due - 1, 0)

    def give_up_receiving(self) -> None:
        self._layer.stop_receiving()

    def receive(self, frames: Iterable[isotp.CanMessage], time_s: float) -> bytes:
        """Return the packets, framed, that `frames` complete.

        Consecutive frames that came twice, as they may on a real bus, are left out: ISO-TP would end the message,
        and two in a row are never alike in their sequence numbers. A first frame that comes again is an offer
        repeated. It is answered again, but not soon after an answer that the sender cannot have had yet: an answer too
        many would be taken for that to the next message, which would then overtake others.
        """
        was_sending = self.is_sending
        for frame in frames:
            kind = frame.data[0] >> 4 if frame.data else None
            if kind != FLOW_CONTROL:
                is_repeated, self._last_data = frame.data == self._last_data, frame.data
                if is_repeated and kind == CONSECUTIVE_FRAME:
                    self.frames_repeated += 1
                    continue
                if kind == CONSECUTIVE_FRAME and not self._has_begun:
                    continue  # the rest of a message to someone who listened before
                self._has_begun = True
                if kind == FIRST_FRAME:
                    if is_repeated and time_s - self._answered_s < ANSWER_S:
                        continue
                    if is_repeated:
                        self._process()
                        self._layer.stop_receiving()
                    self._answered_s = time_s
            self._incoming.append(frame)
        self._process()
        if was_sending and not self.is_sending:
            self._await_answers(self.offers - 1, time_s)
        received = bytearray()
        while (message := self._layer.recv()) is not None:
            received += message.rstrip(DELIMITER) + DELIMITER  # without what lengthened it
        return bytes(received)

    def _process(self) -> None:
        self._layer.process()
        while self._incoming:
            self._layer.process()


class IsoTpChannels:
    """Both directions of one side's messages over several ISO-TP channels, in order.

    `write` takes packets framed for a serial line, and `exchange` returns them so: each travels as one ISO-TP
    message without its zero byte. ISO-TP repairs nothing; a message that lost a frame is dropped and counted. A
    message without an answer is offered again a few times.
    """

    def __init__(self, own_ids: tuple[int, ...], other_ids: tuple[int, ...], url: LinkUrl):
        self.messages_failed = 0  # not sent: no flow control came, or it refused
        self.frames_discarded = 0  # errors of reception: frames missing or out of place
        self.frames_foreign = 0  # of other nodes
        self._payload_bytes_per_s = url.payload_baud_rate / 10
        self._single_bytes = 62 if url.fd else 7  # more needs flow control
        self._time_s = 0.0  # as it counts for time-outs
        self._then_s: float | None = None
        self._waiting: deque[bytes] = deque()
        self._outgoing: list[isotp.CanMessage] = []
        count = FD_CHANNELS if url.fd else CLASSIC_CHANNELS
        self._channels = {
            other_id: _Channel(own_id, other_id, url.fd, self._outgoing.append)
            for own_id, other_id in zip(own_ids[:count], other_ids[:count], strict=True)
        }

    @property
    def frames_repeated(self) -> int:
        """Consecutive frames that came twice in a row."""
        return sum(channel.frames_repeated for channel in self._channels.values())

    @property
    def ready(self) -> bool:
        """Whether another message can start."""
        return not self._waiting and any(channel.is_free(self._time_s) for channel in self._channels.values())

    @property
    def messages_pending(self) -> int:
        """How many messages wait for a channel or for their flow control."""
        return len(self._waiting) + sum(channel.is_sending for channel in self._channels.values())

    def write(self, framed: bytes) -> None:
        """Take framed packets; each becomes a message as soon as a channel is free."""
        self._waiting.extend(packet for packet in framed.split(DELIMITER) if packet)

    def abandon(self) -> None:
        """Drop all messages in transit and count those not sent; for a port that is closed or opened again."""
        self.messages_failed += self.messages_pending
        self._waiting.clear()
        self._outgoing.clear()
        for channel in self._channels.values():
            channel.reset()

    def exchange(
        self, frames: Iterable[isotp.CanMessage], now_s: float
    ) -> tuple[bytes, list[isotp.CanMessage]]:
        """Return the packets that `frames` complete, framed, and the frames to send now.

        Args:
            now_s: of any clock that never goes back.
        """
        if self._then_s is not None:
            self._time_s += min(now_s - self._then_s, LOOK_S)
        self._then_s = now_s
        received = bytearray()
        # run by run as they came, not channel by channel: messages stay in order
        for number, run in groupby(frames, lambda frame: frame.arbitration_id | frame.is_extended_id << 29):
            channel = self._channels.get(number)
            if channel is None:
                self.frames_foreign += len(list(run))
                continue
            received += channel.receive(run, self._time_s)
            channel.rest_until_s = self._time_s + REST_S + self._queued_s(MAX_MESSAGE_BYTES)
            self._count_errors(channel)
        for channel in self._channels.values():
            self._expire(channel)
        self._start()
        frames_out = self._outgoing.copy()
        self._outgoing.clear()
        return bytes(received), frames_out

    def _queued_s(self, message_bytes: int) -> float:
        """Return how long an answer may take behind such messages of all the other channels."""
        return 3 * len(self._channels) * message_bytes / self._payload_bytes_per_s

    def _count_errors(self, channel: _Channel) -> None:
        for error in channel.errors:
            if isinstance(error, isotp.OverflowError):
                self.messages_failed += 1
            elif isinstance(error, isotp.UnexpectedFlowControlError):  # the answer to an offer repeated
                channel.take_unexpected_answer()
            else:
                self.frames_discarded += 1
        channel.errors.clear()

    def _expire(self, channel: _Channel) -> None:
        """Offer a message again, or give it up, when it is time."""
        if channel.is_receiving and self._time_s > channel.rest_until_s:
            channel.give_up_receiving()
            self.frames_discarded += 1
        if channel.is_sending and self._time_s > channel.answer_until_s:
            if channel.offers == OFFERS:
                channel.give_up_sending(self._time_s)
                self.messages_failed += 1
            else:
                channel.offer()
                self._wait_for_answer(channel)

    def _wait_for_answer(self, channel: _Channel) -> None:
        first_s = ANSWER_S + self._queued_s(channel.pending_bytes)
        wait_s = min(first_s * 2 ** (channel.offers - 1), max(first_s, LONGEST_WAIT_S))
        channel.answer_until_s = self._time_s + wait_s

    def _start(self) -> None:
        """Give waiting messages to free channels."""
        if not self._waiting:
            return
        idle = [channel for channel in self._channels.values() if channel.is_free(self._time_s)]
        pending_bytes = sum(channel.pending_bytes for channel in self._channels.values())
        while self._waiting and idle:
            message = self._waiting[0]
            if pending_bytes and pending_bytes + len(message) > CHANNEL_BYTES * len(self._channels):
                return
            self._waiting.popleft()
            if len(idle) < len(self._channels):
                # without flow control it would overtake those in transit; COBS leaves no zero byte in a packet
                message = message.ljust(self._single_bytes + 1, DELIMITER)
            channel = idle[0]
            channel.send(message)
            if channel.is_sending:
                idle.remove(channel)
                pending_bytes += len(message)
                self._wait_for_answer(channel)
