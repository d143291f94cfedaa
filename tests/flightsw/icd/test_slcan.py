"""CAN frames as an slcan adapter's text, held to python-can and to hostile bytes."""

import can
import isotp
from can.interfaces.slcan import slcanBus
from hypothesis import given
from hypothesis import strategies as st

from flightsw.icd.link.link_url import parse_link_url
from flightsw.icd.link.slcan import FD_SIZES, SlcanText, format_slcan, open_slcan, parse_slcan


@st.composite
def can_frames(draw) -> isotp.CanMessage:
    extended, fd = draw(st.booleans()), draw(st.booleans())
    code = draw(st.integers(0, 15 if fd else 8))
    data = draw(st.binary(min_size=FD_SIZES[code], max_size=FD_SIZES[code]))
    number = draw(st.integers(0, (1 << (29 if extended else 11)) - 1))
    return isotp.CanMessage(number, code, data, extended, fd, fd and draw(st.booleans()))


def fields(frame: isotp.CanMessage) -> tuple:
    return tuple(getattr(frame, name) for name in isotp.CanMessage.__slots__)


@given(can_frames())
def test_a_frame_survives_the_text(frame):
    text = format_slcan(frame)
    assert fields(parse_slcan(text[:-1])) == fields(frame)


class PythonCan(slcanBus):
    """python-can's slcan without a port: an independent writer and reader of the same text."""

    def __init__(self):
        self.text = ""

    def _write(self, string: str) -> None:
        self.text += string + "\r"

    def _read(self, timeout) -> str:
        return self.text

    def send_text(self, frame: isotp.CanMessage) -> bytes:
        self.serialPortOrig = type("Port", (), {"write_timeout": None})
        self._queue = type("Queue", (), {"qsize": lambda self: 0})()
        self.send(
            can.Message(
                arbitration_id=frame.arbitration_id,
                data=frame.data,
                is_extended_id=frame.is_extended_id,
                is_fd=frame.is_fd,
                bitrate_switch=frame.bitrate_switch,
            )
        )
        return self.text.encode()


@given(can_frames())
def test_python_can_writes_the_same_text_and_reads_the_same_frame(frame):
    theirs = PythonCan()
    assert theirs.send_text(frame) == format_slcan(frame)
    message, _ = theirs._recv_internal(0)
    assert message is not None
    assert (message.arbitration_id, bytes(message.data)) == (frame.arbitration_id, frame.data)
    assert (message.is_extended_id, message.is_fd) == (frame.is_extended_id, frame.is_fd)


def test_python_can_sends_the_same_commands_to_open():
    theirs = PythonCan()
    theirs._listen_only = False
    theirs.set_bitrate(1_000_000, 5_000_000)
    assert open_slcan(parse_link_url("slcan:///dev/null?fd=1")).strip(b"\r") + b"\r" == theirs.text.encode()
    for bitrate, code in slcanBus._BITRATES.items():
        url = parse_link_url(f"slcan:///dev/null?bitrate={bitrate}")
        assert f"\r{code}\r".encode() in open_slcan(url)


@given(st.lists(can_frames(), max_size=6), st.lists(st.integers(1, 60), max_size=30))
def test_any_chunking_of_the_text_yields_the_same_frames(sent, chunk_sizes):
    stream = b"".join(map(format_slcan, sent))
    text, received = SlcanText(), []
    for size in chunk_sizes:
        received += text.feed(stream[:size])
        stream = stream[size:]
    received += text.feed(stream)
    assert list(map(fields, received)) == list(map(fields, sent))
    assert text.skipped_bytes == 0


@given(
    st.lists(st.one_of(st.binary(max_size=300), st.from_regex(rb"[tTdDbBzZ\r\a0-9A-F]{0,200}")), max_size=8)
)
def test_hostile_text_takes_no_memory_and_every_byte_is_counted(chunks):
    text = SlcanText()
    for chunk in chunks:
        for frame in text.feed(chunk):
            assert len(frame.data) in FD_SIZES
        assert text.pending_bytes <= SlcanText.MAX_LINE_BYTES
    counted = text.frame_bytes + text.reply_bytes + text.skipped_bytes + text.pending_bytes
    assert counted == sum(map(len, chunks))


def test_an_adapter_s_answers_are_no_errors_but_its_bell_is():
    text = SlcanText()
    assert text.feed(b"\rz\rZ\r\r") == []
    assert (text.reply_bytes, text.skipped_bytes, text.adapter_errors) == (6, 0, 0)
    text.feed(b"\a")
    assert text.adapter_errors == 1


@given(
    st.lists(st.tuples(can_frames(), st.sampled_from([b"", b"1A2B", b"00C0FFEE"])), max_size=6),
    st.sampled_from([b"\r", b"\r\n"]),
)
def test_frames_are_taken_with_a_time_stamp_behind_them_and_a_line_feed_before_the_next(sent, ending):
    stream = b"".join(format_slcan(frame).removesuffix(b"\r") + stamp + ending for frame, stamp in sent)
    text = SlcanText()
    received = text.feed(stream + b"z\r")
    assert list(map(fields, received)) == [fields(frame) for frame, _ in sent]
    assert text.skipped_bytes == text.adapter_errors == 0


def test_what_is_no_stamp_behind_the_data_is_no_frame():
    for tail in (b"1", b"12", b"123", b"12345", b"12 4", b"12G4"):
        assert parse_slcan(b"t12320102" + tail) is None
