"""What one call of a file transfer costs where much is lost: python -m tests.benchmarks.transfer

Sender and receiver as they are, on a clock of ours. Times are processor time of the thread, so that other work on the
machine does not count; what the receiver's owner does with the file (decoding, writing) is not in them.
"""

import argparse
import itertools
import random
import time
from collections.abc import Callable
from typing import Any

from flightsw.icd.transfer import Receiver, Sender
from tests.benchmarks.rows import shown

MAX_PDU_BYTES = 4090
STEP_S = 2e-4  # some 20 MB/s, so that the timers run as they do on a quick link
KEY = bytes(32)  # that authenticates receipts
CALLS = ("put", "next_pdu", "receive")


class Timed:
    """Calls an end's methods and keeps the longest time of each."""

    def __init__(self, end: Sender | Receiver):
        self.longest_ms = dict.fromkeys(CALLS, 0.0)
        self._end = end

    def call(self, name: str, *arguments: Any) -> Any:
        method: Callable[..., Any] = getattr(self._end, name)
        begun_ns = time.thread_time_ns()
        result = method(*arguments)
        self.longest_ms[name] = max(self.longest_ms[name], (time.thread_time_ns() - begun_ns) / 1e6)
        return result


def measure(megabytes: int, loss: float, seed: int) -> dict[str, Any]:
    """Bring one file of noise over, and return the row."""
    content, lost, stored = random.Random(seed).randbytes(megabytes * 1_000_000), random.Random(seed), []
    sender = Sender(MAX_PDU_BYTES, 0.5, store=b"benchmrk", keys=[KEY])
    receiver = Receiver(
        MAX_PDU_BYTES, 0.5, lambda name, data: stored.append(data) or True, len(content), key=KEY
    )
    flight, ground = Timed(sender), Timed(receiver)
    flight.call("put", "00000000.obf", content, 1, 0.0)
    begun_s, outcomes = time.thread_time(), []
    for step in itertools.count(1):
        now_s = step * STEP_S
        down = flight.call("next_pdu", now_s)
        if down is not None and lost.random() > loss:
            ground.call("receive", down, now_s)
        up = ground.call("next_pdu", now_s)
        if up is not None and lost.random() > loss:
            flight.call("receive", up, now_s)
        if outcomes := sender.outcomes():
            break
    assert outcomes[0].delivered and stored == [content]
    return {
        "megabytes": megabytes,
        "loss": loss,
        "seed": seed,
        "longest_call_of_sender_ms": {name: round(ms, 1) for name, ms in flight.longest_ms.items()},
        "longest_call_of_receiver_ms": {
            name: round(ms, 1) for name, ms in ground.longest_ms.items() if ms > 0
        },
        "processor_time_s": round(time.thread_time() - begun_s, 1),
        "segments_resent": sender.segments_resent,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description="The longest calls of a transfer with loss.")
    parser.add_argument("--json", action="store_true", help="one JSON object a row")
    parser.add_argument("--megabytes", type=int, default=50, help="of the file")
    parser.add_argument("--loss", type=float, default=0.3, help="share of packets that is lost each way")
    arguments = parser.parse_args()
    print(shown(measure(arguments.megabytes, arguments.loss, 1), "transfer", arguments.json))


if __name__ == "__main__":
    main()
