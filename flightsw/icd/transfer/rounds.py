"""The rounds of a transfer: which bytes each NAK sequence asks for again, and how long segments should be after it.

A file is sent whole in the first round. Each NAK sequence of the receiver ends a round; the bytes that it asks for
are the next one. State diagram: README.md, "Rounds of a transfer".
"""

FIT_SEGMENTS = 8  # how many must have been sent before their loss says anything
MIN_SEGMENT_BYTES = 32  # a packet needs 27 bytes more


class NakRounds:
    """The bytes of one file that were sent in this round, and those that the receiver asks for in the next.

    One NAK PDU holds few ranges, so that a receiver may need several, whose scopes follow each other up to the end of
    the file: a sequence. A NAK whose scope starts before the end of the last one begins the sequence anew.
    """

    def __init__(self, size_bytes: int):
        self.sent_bytes = size_bytes  # in this round
        self._size_bytes = size_bytes
        self._asked_bytes = 0  # by this sequence so far
        self._scope_end = 0  # of the last NAK, 0 before the first

    def is_repeated(self, start_of_scope: int) -> bool:
        """Tell whether a NAK asks again for what an earlier one has asked for."""
        return start_of_scope < self._scope_end

    def take_nak(
        self, start_of_scope: int, end_of_scope: int, ranges: list[tuple[int, int]]
    ) -> tuple[int, int] | None:
        """Add a NAK's ranges to the next round.

        Returns:
            The bytes that were sent and those that were lost in the round that this NAK ends; None if its sequence
            goes on.
        """
        if self.is_repeated(start_of_scope):
            self._asked_bytes = 0
        self._scope_end = end_of_scope
        self._asked_bytes += sum(end - start for start, end in ranges)
        if end_of_scope < self._size_bytes:
            return None
        ended = self.sent_bytes, self._asked_bytes
        self.sent_bytes, self._asked_bytes = self._asked_bytes, 0
        return ended


class SegmentLength:
    """How long the segments of all files are: halved while most bytes are lost, doubled while few are.

    Where single CAN frames are lost, most long messages are lost and few short ones. On a serial line the length does
    not matter, and segments stay as long as a packet allows.
    """

    def __init__(self, max_bytes: int, interval_s: float):
        self.length_bytes = max_bytes
        self._max_bytes, self._interval_s = max_bytes, interval_s
        self._sent_bytes = self._lost_bytes = 0  # since the length was last decided
        self._next_cut_s = float("-inf")

    def adapt(self, sent_bytes: int, lost_bytes: int, now_s: float) -> None:
        """Take account of a round that has ended."""
        self._sent_bytes += sent_bytes
        self._lost_bytes += lost_bytes
        if self._sent_bytes < FIT_SEGMENTS * self.length_bytes:
            return
        share = self._lost_bytes / self._sent_bytes
        if share > 1 / 2 and now_s >= self._next_cut_s:
            self._next_cut_s = now_s + self._interval_s  # once for all files that an interruption has hit
            self.length_bytes = max(self.length_bytes // 2, MIN_SEGMENT_BYTES)
        elif share < 1 / 4:
            self.length_bytes = min(2 * self.length_bytes, self._max_bytes)
        self._sent_bytes = self._lost_bytes = 0


def merged_ranges(requests: list[tuple[int, int]], size_bytes: int) -> list[tuple[int, int]]:
    """Return a NAK's ranges inside the file, sorted and without overlap: no NAK asks for more than the file."""
    merged: list[tuple[int, int]] = []
    for start, end in sorted(requests):
        end = min(end, size_bytes)
        if merged and merged[-1] != (0, 0) and start <= merged[-1][1]:
            merged[-1] = (merged[-1][0], max(merged[-1][1], end))
        elif start < end or ((start, end) == (0, 0) and not merged):
            merged.append((start, end))
    return merged
