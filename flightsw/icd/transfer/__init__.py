"""Files over packets: CFDP class 2 (CCSDS 727.0-B). Bytes in, bytes out, time passed in.

The side that has a file owns a Sender, the other a Receiver. Both take PDUs with `receive` and give PDUs with
`next_pdu`; they keep no thread, no clock, no port and no disk.
"""

from flightsw.icd.transfer.pdu import DOWNLINK, UPLINK, parse_pdu, timer_s
from flightsw.icd.transfer.receipt import STORE_BYTES, Verdict, answer_key
from flightsw.icd.transfer.receiver import Incoming, Receiver
from flightsw.icd.transfer.sender import Outcome, Sender

__all__ = [
    "DOWNLINK",
    "STORE_BYTES",
    "UPLINK",
    "Incoming",
    "Outcome",
    "Receiver",
    "Sender",
    "Verdict",
    "answer_key",
    "parse_pdu",
    "timer_s",
]
