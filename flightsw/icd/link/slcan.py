"""CAN frames as the text of an slcan adapter on a serial port.

python-can's own slcan (4.6.1) is not used: it reads a byte a call, waits two seconds at opening and for each
write, and never gets past a byte that is not ASCII. The tests hold this text to it.
"""

import re

import isotp

from flightsw.icd.link.framing import DelimitedBytes
from flightsw.icd.link.link_url import SLCAN_BITRATES, LinkUrl

FD_SIZES = (0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64)  # bytes by length code, ISO 11898-1

# of a time stamp after a frame's data: none, milliseconds (LAWICEL's Z1), microseconds (Z2 of newer firmware)
STAMP_DIGITS = (0, 4, 8)


class SlcanText(DelimitedBytes):
    """CAN frames from an slcan adapter's bytes (LAWICEL CANUSB, with CANable's d, D, b, B for CAN FD).

    Lines may end with CR or CR LF, and a time stamp may follow a frame's data: adapters keep in their memory what an
    earlier program has switched on.

    At all times `frame_bytes + reply_bytes + skipped_bytes + pending_bytes` is the number of bytes fed.
    """

    LINE = re.compile(rb"([tdb])([0-7][0-9A-Fa-f]{2})|([TDB])([01][0-9A-Fa-f]{7})")
    MAX_LINE_BYTES = 1 + 10 + 2 * 64 + max(STAMP_DIGITS)

    def __init__(self):
        super().__init__(b"\r", self.MAX_LINE_BYTES)
        self.frame_bytes = 0
        self.reply_bytes = 0  # the adapter's answers to commands and frames
        self.frames_accepted = 0  # of those given to the adapter, where it says so
        self.skipped_lines = 0
        self.adapter_errors = 0  # a bell: the adapter refused a command or a frame

    def feed(self, data: bytes) -> list[isotp.CanMessage]:
        """Return the frames that `data` completes; memory is bounded by the longest line."""
        bells = data.count(b"\a")
        self.adapter_errors += bells
        self.reply_bytes += bells
        frames = map(self._frame_of, self.split(data.replace(b"\a", b"")))
        return [frame for frame in frames if frame is not None]

    def _frame_of(self, line: bytes | None) -> isotp.CanMessage | None:
        size_bytes = len(line or b"") + 1
        line = line and line.removeprefix(b"\n")  # of the line before
        frame = None if line is None else parse_slcan(line)
        if frame is not None:
            self.frame_bytes += size_bytes
        elif line in (b"", b"z", b"Z"):
            self.frames_accepted += bool(line)
            self.reply_bytes += size_bytes
        else:
            self.skipped_bytes += size_bytes
            self.skipped_lines += 1
        return frame


def parse_slcan(line: bytes) -> isotp.CanMessage | None:
    """Return the data frame in a line, before a time stamp if there is one; None if the line is anything else."""
    match = SlcanText.LINE.match(line)
    if match is None:
        return None
    kind, digits = (match[1] or match[3]).decode(), match[2] or match[4]
    code, text = line[match.end() : match.end() + 1], line[match.end() + 1 :]
    fd = kind not in "tT"
    if code not in (b"0123456789ABCDEFabcdef" if fd else b"012345678") or not code:
        return None
    size = FD_SIZES[int(code, 16)]
    if len(text) - 2 * size not in STAMP_DIGITS or (text and not text.isalnum()):
        return None
    try:
        data = bytes.fromhex(text.decode())[:size]
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
