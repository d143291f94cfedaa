"""What a browser may tell the viewer: viser itself would let a message set any property of any control, for everyone,
and one kind of message even asks it to show the page on the internet."""

import math
from typing import Any

import msgspec

FROM_THE_PAGE = (
    "GuiUpdateMessage",
    "ViewerCameraMessage",
    "SceneNodeClickMessage",
    "ScenePointerMessage",
    "GetRenderResponseMessage",
)
LARGEST_NUMBER = 1e12  # far above any that the page sends, and exact in JavaScript
LONGEST_TEXT = 1000


def wrong(data: str | bytes) -> str | None:
    """Return why a message is none that the viewer's page sends, None if it may be one."""
    if isinstance(data, str):
        return "expected a binary message, got text"
    try:
        message = msgspec.msgpack.decode(data)
    except (msgspec.DecodeError, RecursionError, UnicodeDecodeError) as error:
        return f"a message is no MessagePack: {error}"
    kind = message.get("type") if isinstance(message, dict) else None
    if kind not in FROM_THE_PAGE:
        return f"expected one of {', '.join(FROM_THE_PAGE)}, got {str(kind)[:40]!r}"
    if kind == "GuiUpdateMessage":
        updates = message.get("updates")
        if not isinstance(updates, dict) or list(updates) != ["value"]:
            return "a page sets only the value of a control"
        value = updates["value"]
        is_range = (
            isinstance(value, list) and len(value) == 2 and all(type(end) in (int, float) for end in value)
        )
        if not (is_range or isinstance(value, bool | int | float | str)):
            return "the value of a control is a number, a text or two numbers"
    payload = message.pop("payload", b"")  # a picture
    return (
        None if isinstance(payload, bytes) and _is_small(message) else "a message holds values out of range"
    )


def _is_small(value: Any) -> bool:
    """Return whether all numbers are finite and small, and all texts short, in lists and mappings too."""
    if isinstance(value, bool) or value is None:
        return True
    if isinstance(value, int | float):
        return math.isfinite(value) and abs(value) <= LARGEST_NUMBER
    if isinstance(value, str):
        return len(value) <= LONGEST_TEXT
    if isinstance(value, dict):
        return all(_is_small(part) for pair in value.items() for part in pair)
    return isinstance(value, list) and all(map(_is_small, value))
