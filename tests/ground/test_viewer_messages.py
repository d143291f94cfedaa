"""What others than the viewer's own page say to its port: the connection ends, and everyone else sees what they saw."""

import math
import time

import msgspec
import pytest
import viser
from hypothesis import given
from hypothesis import strategies as st
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect

from ground.show.viewer.door import POLICY_VIOLATION, opened
from ground.show.viewer.messages import wrong

CAMERA = {
    "type": "ViewerCameraMessage",
    **{"wxyz": [1, 0, 0, 0], "position": [0, 1.5, 0], "look_at": [0, 0, 0], "up_direction": [0, 0, 1]},
    **{"fov": 0.4, "near": 0.1, "far": 100, "image_height": 700, "image_width": 900},
}
CLICK = {"type": "SceneNodeClickMessage", "name": "/a", "instance_index": None, "screen_pos": [0.1, 0.2]}
POINTER = {
    "type": "ScenePointerMessage",
    **{"event_type": "click", "ray_origin": [0, 0, 9], "ray_direction": [0, 0, -1]},
    **{"screen_pos": [[0.5, 0.5]], "modifier": None},
}


def update(**updates) -> dict:
    return {"type": "GuiUpdateMessage", "uuid": "u", "updates": updates}


GOOD = [
    *(update(value=value) for value in (True, 3, 0.05, "misfit", [-1.5, 2])),
    CAMERA,
    CLICK,
    POINTER,
    {"type": "GetRenderResponseMessage", "payload": b"\0" * 100_000, "render_uuid": "r"},
]
BAD = [
    ("text", "expected a binary message"),
    (b"", "no MessagePack"),
    (b"\x93\xff", "no MessagePack"),
    (b"\x91" * 100_000 + b"\0", "no MessagePack"),
    ([1, 2], "expected one of"),
    ({"type": ["GuiUpdateMessage"]}, "expected one of"),
    ({"type": "ShareUrlRequest"}, "got 'ShareUrlRequest'"),  # would show the page on the internet
    ({"type": "FileTransferStartUpload", "size_bytes": 1 << 60}, "got 'FileTransferStartUpload'"),
    (update(value=1, removed=True), "sets only the value"),
    (update(update_cb="x"), "sets only the value"),
    ({"type": "GuiUpdateMessage", "uuid": "u", "updates": []}, "sets only the value"),
    (update(value=[1, 2, 3]), "a number, a text or two numbers"),
    (update(value=[1, "2"]), "a number, a text or two numbers"),
    (update(value=[1, math.nan]), "out of range"),
    (update(value=None), "a number, a text or two numbers"),
    (POINTER | {"ray_origin": [0, 0, math.inf]}, "out of range"),
    (update(value=math.nan), "out of range"),
    (
        update(value=-1e300),
        "out of range",
    ),  # viser could not send it on, to anyone who opens the page from then on
    (update(value="x" * 2000), "out of range"),
    (CAMERA | {"fov": math.inf}, "out of range"),
    (CAMERA | {"position": [0, [1e200], 0]}, "out of range"),
    (CLICK | {"payload": [1]}, "out of range"),
]


def packed(message) -> str | bytes:
    return message if isinstance(message, str | bytes) else msgspec.msgpack.encode(message)


def test_what_the_page_sends_is_let_through():
    assert [wrong(packed(message)) for message in GOOD] == [None] * len(GOOD)


@pytest.mark.parametrize(("message", "told"), BAD, ids=range(len(BAD)))
def test_what_the_page_never_sends_is_named(message, told):
    assert told in str(wrong(packed(message)))


VALUES = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**63), 2**64 - 1) | st.floats() | st.text() | st.binary(),
    lambda parts: st.lists(parts, max_size=3) | st.dictionaries(st.text(), parts, max_size=3),
)


@given(st.binary() | st.text() | VALUES.map(msgspec.msgpack.encode))
def test_any_bytes_are_judged_without_an_error(data):
    assert isinstance(wrong(data), str)


@given(st.booleans() | st.integers(-(10**13), 10**13) | st.floats(-1e13, 1e13) | st.text() | VALUES)
def test_only_values_that_viser_can_send_on_are_let_through(value):
    def is_number(part) -> bool:
        return type(part) in (int, float) and abs(part) <= 1e12

    sendable = isinstance(value, bool | str) or is_number(value)
    sendable |= (
        isinstance(value, list) and len(value) == 2 and all(map(is_number, value))
    )  # the ends of a range
    assert (wrong(packed(update(value=value))) is None) == sendable


def test_a_hostile_client_is_sent_away_and_the_page_stays_as_it_was(caplog):
    server = opened("127.0.0.1", 0)
    try:
        slider = server.gui.add_slider("Frame", min=0, max=9, step=1, initial_value=3)
        for message in (
            b"garbage",
            {"type": "ShareUrlRequest"},
            update(value=-1e300) | {"uuid": slider._impl.uuid},
        ):
            with client_of(server) as hostile:
                hostile.send(packed(message))
                with pytest.raises(ConnectionClosed) as closed:
                    while True:
                        hostile.recv(timeout=20)
                assert closed.value.rcvd is not None and closed.value.rcvd.code == POLICY_VIOLATION
        assert len(caplog.messages) == 3 and "a connection to the page is closed" in caplog.text
        with client_of(server) as honest:  # is sent the controls as they are, and can use them
            assert honest.recv(timeout=20)
            honest.send(packed(update(value=5) | {"uuid": slider._impl.uuid}))
            end_s = time.monotonic() + 20
            while slider.value != 5:
                assert time.monotonic() < end_s
                time.sleep(0.05)
    finally:
        server.stop()


def client_of(server: viser.ViserServer) -> ClientConnection:
    """Connect as the page does."""
    port = server.get_port()
    return connect(
        f"ws://127.0.0.1:{port}",
        origin=f"http://127.0.0.1:{port}",  # pyright: ignore[reportArgumentType]
        subprotocols=[f"viser-v{viser.__version__}"],  # pyright: ignore[reportArgumentType]
        max_size=None,
    )
