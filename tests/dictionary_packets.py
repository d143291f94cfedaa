"""Random and extreme packets of the dictionary, and what an XTCE reader must find in each."""

import random
import struct
import sys
from collections.abc import Iterator
from typing import Any

from flightsw.icd.frame import ATTITUDES, HEADER, MAGIC, SOURCES, VERSION
from flightsw.icd.packet import (
    APID_EVENTS,
    APID_FILES,
    APID_FRAME_HEADERS,
    APID_HOUSEKEEPING,
    APID_REPORTS,
    APID_UPLINK_FILES,
    TELEMETRY,
    pack_packet,
)
from flightsw.icd.telemetry import DICTIONARY, NUMBERS, Item, Layout
from ground.link.xtce.document import FRAME_HEADER

SECTIONS = {
    "telemetry": (APID_HOUSEKEEPING, ""),
    "events": (APID_EVENTS, "event_"),
    "reports": (APID_REPORTS, ""),
}
EXTREME_FLOATS = (0.0, -0.0, 5e-324, -2.2e-308, sys.float_info.max, -sys.float_info.max, 0.1, 1e16 + 2, 1 / 3)
LETTERS = "aZ09 ~{}<>&\"'\\é߿€漢𝄞😀"  # one to four bytes in UTF-8, and what XML and JSON escape


def extreme_or_random(rng: random.Random, low: int, high: int) -> int:
    near = (low, high, min(low + 1, high), high // 2, min(high, (1 << 53) + 1), min(high, 1 << 31))
    return rng.choice(near) if rng.random() < 0.5 else rng.randint(low, high)


def some_number(rng: random.Random, code: str) -> Any:
    if code == "d":
        return (
            rng.choice(EXTREME_FLOATS)
            if rng.random() < 0.5
            else rng.gauss(0, 1) * 10.0 ** rng.randint(-300, 300)
        )
    if code == "f":
        return struct.unpack(">f", struct.pack(">f", rng.gauss(0, 1) * 10.0 ** rng.randint(-30, 30)))[0]
    bits = 8 * struct.calcsize(f">{code}")
    return extreme_or_random(
        rng, *((-(1 << bits - 1), (1 << bits - 1) - 1) if code.islower() else (0, (1 << bits) - 1))
    )


def some_text(rng: random.Random, max_bytes: int) -> str:
    text, length = "", rng.choice((0, 1, max_bytes, rng.randint(0, max_bytes)))
    while len((longer := text + rng.choice(LETTERS)).encode()) <= length:
        text = longer
    return text


def some_value(rng: random.Random, item: Item) -> Any:
    if item.states:
        return rng.choice(item.states)[1]
    if item.kind == "bytes":
        return rng.choice((bytes(item.count), b"\xff" * item.count, rng.randbytes(item.count)))
    if item.kind == "text":
        return some_text(rng, item.count)

    def number() -> Any:
        if item.range:
            low, high = item.range
            return (
                rng.uniform(low, high)
                if item.kind == "float64"
                else extreme_or_random(rng, int(low), int(high))
            )
        return some_number(rng, NUMBERS[item.kind])

    if item.type in NUMBERS:
        return number()
    count = rng.choice((1 if item.range else 0, item.count, rng.randint(1, item.count)))
    return tuple(number() for _ in range(count))


def found(prefix: str, item: Item, value: Any) -> dict[str, Any]:
    """Return the XTCE parameters of an item, by the names that ground/link/xtce/document.py promises."""
    name = f"{prefix}_{item.name}"
    if item.kind == "text":
        return {f"{name}_length": len(value.encode()), name: value}
    if item.kind == "float64" and item.type != "float64":
        return {f"{name}_count": len(value)} | {f"{name}_{at}": one for at, one in enumerate(value, 1)}
    return {name: value}


def frame_header(rng: random.Random) -> tuple[bytes, dict[str, Any]]:
    fixed = {"version": VERSION, "header_bytes": HEADER.size}
    values = {
        name: fixed.get(name, some_number(rng, code[-1]))
        for name, code, *_ in FRAME_HEADER
        if name != "magic"
    }
    values = {"magic": MAGIC} | values
    values["pose_source"], values["attitude"] = rng.randrange(len(SOURCES)), rng.randrange(len(ATTITUDES))
    data = HEADER.pack(*values.values())
    values["pose_source"] = SOURCES[values["pose_source"]]
    values["attitude"] = ATTITUDES[values["attitude"]]
    return data, {f"frame_header_{name}": value for name, value in values.items()}


def packets(count: int, seed: int) -> Iterator[tuple[bytes, str, dict[str, Any]]]:
    """Yield packets in turn of each kind that the spacecraft sends: its bytes, its container, its parameters."""
    rng = random.Random(seed)
    kinds = [(section, layout) for section in SECTIONS for layout in getattr(DICTIONARY, section).values()]
    kinds += [("frame", None), ("file_pdu", None), ("uplink_file_pdu", None), kinds[0]]  # housekeeping twice
    for number in range(count):
        section, layout = kinds[number % len(kinds)]
        if isinstance(layout, Layout):
            apid, prefix = SECTIONS[section]
            values = {item.name: some_value(rng, item) for item in layout.items}
            data, container = layout.pack(**values), prefix + layout.name
            parameters = {"dictionary_version": layout.version, "packet_id": layout.id}
            for item in layout.items:
                parameters |= found(container, item, values[item.name])
        elif section == "frame":
            apid, container = APID_FRAME_HEADERS, "frame_header"
            data, parameters = frame_header(rng)
        else:
            apid = APID_FILES if section == "file_pdu" else APID_UPLINK_FILES
            data, container = rng.randbytes(rng.choice((1, 2, rng.randint(3, 1094)))), section
            parameters = {f"{section}_bytes": data}
        header = {"PKT_APID": apid, "SRC_SEQ_CTR": number % (1 << 14), "PKT_LEN": len(data) - 1}
        yield pack_packet(TELEMETRY, apid, header["SRC_SEQ_CTR"], data), container, header | parameters


def exactly(parameters: dict[str, Any]) -> dict[str, Any]:
    """Return values that are equal only if every bit is: 0.0 equals -0.0 otherwise."""
    return {k: struct.pack(">d", v) if isinstance(v, float) else v for k, v in parameters.items()}
