"""The dictionary: what it describes survives the wire, all else is refused, and its own file is checked."""

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from flightsw.icd.command import Command, Report
from flightsw.icd.config import ConfigError
from flightsw.icd.packet import HEADER, PacketError
from flightsw.icd.telemetry import DICTIONARY, Item, Layout, parse_dictionary, printable

SECTIONS = ("telemetry", "events", "reports", "commands")
LAYOUTS = [(section, layout) for section in SECTIONS for layout in getattr(DICTIONARY, section).values()]
INTEGER_LIMITS = {
    "uint8": (0, 255),
    "uint16": (0, 65_535),
    "uint32": (0, (1 << 32) - 1),
    "uint64": (0, (1 << 64) - 1),
    "int64": (-(1 << 63), (1 << 63) - 1),
}


def values_of(item: Item) -> st.SearchStrategy:
    """Return what an item may hold, from its description alone."""
    if item.states:
        return st.sampled_from([name for _, name in item.states])
    if item.kind == "bytes":
        return st.binary(min_size=item.count, max_size=item.count)
    if item.kind == "text":
        letters = st.characters(codec="utf-8").filter(str.isprintable)
        return st.text(letters).filter(lambda text: len(text.encode()) <= item.count)
    if item.kind == "float64":
        low, high = item.range or (None, None)
        number = st.floats(low, high, allow_nan=False, allow_infinity=False)
        if item.type == "float64":
            return number
        return st.lists(number, min_size=1 if item.range else 0, max_size=item.count).map(tuple)
    low, high = INTEGER_LIMITS[item.kind]
    return st.integers(*(map(int, item.range) if item.range else (low, high)))


packets = st.sampled_from(LAYOUTS).flatmap(
    lambda entry: st.tuples(
        st.just(entry[0]),
        st.just(entry[1]),
        st.fixed_dictionaries({item.name: values_of(item) for item in entry[1].items}),
    )
)


@given(packets)
def test_every_packet_of_the_dictionary_survives_the_wire(packet):
    section, layout, values = packet
    assert DICTIONARY.unpack(section, layout.pack(**values)) == (layout, values)


@given(packets, st.data())
def test_a_packet_with_bytes_missing_or_left_over_is_refused(packet, data):
    section, layout, values = packet
    packed = layout.pack(**values)
    cut = data.draw(st.integers(0, len(packed) - 1))
    with pytest.raises(PacketError):
        DICTIONARY.unpack(section, packed[:cut])
    with pytest.raises(PacketError):
        DICTIONARY.unpack(section, packed + b"\0")


@given(st.sampled_from(SECTIONS), st.integers(0, 255), st.binary(max_size=400))
def test_any_bytes_are_one_packet_exactly_or_a_packet_error(section, number, rest):
    data = bytes([DICTIONARY.version, number]) + rest
    try:
        layout, values = DICTIONARY.unpack(section, data)
    except PacketError:
        return
    assert layout.pack(**values) == data


def test_bytes_are_those_that_the_file_promises():
    exposures = struct.pack(">BBBdd", DICTIONARY.version, 2, 2, 0.05, 20.0)
    assert Command("bracket", {"exposure_times_ms": (0.05, 20.0)}).pack() == exposures
    report = Report(utc_ns=-2, counter=7, digest=b"packet#7", stage="completed", text="é!")
    assert report.pack() == struct.pack(">BBqQ8sBB3s", 1, 1, -2, 7, b"packet#7", 7, 3, b"\xc3\xa9!")


@pytest.mark.parametrize(
    ("name", "arguments", "problem"),
    [
        ("near", {"near": 17}, "near: expected 0 to 16 DN, got 17"),
        ("near", {"near": 1.5}, "is no uint8"),
        ("near", {"near": True}, "finite number"),
        ("near", {}, "has the items"),
        ("near", {"near": 1, "far": 2}, "has the items"),
        ("bracket", {"exposure_times_ms": ()}, "expected 1 to 16 numbers, got 0"),
        ("bracket", {"exposure_times_ms": (0.1,) * 17}, "expected 1 to 16 numbers, got 17"),
        ("bracket", {"exposure_times_ms": (float("nan"),)}, "finite number"),
        ("bracket", {"exposure_times_ms": (0.0,)}, "expected 0.001 to 60000 ms"),
        ("priority", {"order": "newest"}, "expected one of oldest, triage, thumbnail-first"),
        ("model", {"size_bytes": 5, "sha256": b"short", "file_key": bytes(32)}, "expected 32 bytes, got 5"),
    ],
)
def test_a_command_out_of_range_is_not_packed(name, arguments, problem):
    with pytest.raises(ValueError, match=problem):
        Command(name, arguments).pack()


def test_an_unknown_command_names_the_known_ones():
    with pytest.raises(ValueError, match="no command 'fire'; there are ping, bracket"):
        Command("fire", {})


def test_text_is_cut_between_characters_and_cannot_move_a_cursor():
    item = Item("problem", "text[5]")
    assert item.unpack(item.pack("aaaaé"), 0) == ("aaaa", 5)
    assert item.unpack(item.pack("\x1b[2J"), 0)[0] == "?[2J"
    with pytest.raises(PacketError, match="cannot be printed"):
        item.unpack(b"\x02\x1bc", 0)
    with pytest.raises(PacketError, match="UTF-8"):
        item.unpack(b"\x01\xff", 0)
    assert printable("line\nbreak\u202e") == "line?break?"


def test_limits_tell_green_from_yellow_from_red():
    item = Item("disk", "uint32", yellow=(10, 100), red=(5, 1000))
    assert [item.limit(value) for value in (10, 100, 9, 101, 4, 1001)] == [
        *("green", "green", "yellow", "yellow", "red", "red"),
    ]
    mode = DICTIONARY.telemetry["housekeeping"].item("mode")
    assert (mode.limit("normal"), mode.limit("safe")) == ("green", "red")


def test_every_packet_fits_the_smallest_link():
    def most_bytes(layout: Layout) -> int:
        sizes = {"uint8": 1, "uint16": 2, "uint32": 4, "uint64": 8, "int64": 8, "float64": 8}
        return 2 + sum(item.count * sizes.get(item.kind, 1) + ("[" in item.type) for item in layout.items)

    smallest_packet_bytes = 512  # mission.link.max_packet_bytes
    assert max(most_bytes(layout) for _, layout in LAYOUTS) <= smallest_packet_bytes - HEADER.size


def test_what_can_be_armed_is_what_must_be():
    command = DICTIONARY.commands["arm"].item("command")
    armed = {(layout.id, name) for name, layout in DICTIONARY.commands.items() if layout.armed}
    assert set(command.states) == armed == {(7, "delete"), (9, "resume"), (12, "retire")}


def test_every_event_has_a_sentence_of_its_values():
    for layout in DICTIONARY.events.values():
        assert layout.items[0].name == "utc_ns"
        sample = {item.name: b"\xab" * item.count if item.kind == "bytes" else 7 for item in layout.items}
        assert "{" not in layout.sentence(sample) and layout.sentence(sample)


GOOD = """
version: 1
telemetry: {a: {id: 1, items: {x: {type: uint8}}}}
events: {}
reports: {}
commands: {}
arm_s: 30
"""


@pytest.mark.parametrize(
    ("old", "new", "problem"),
    [
        ("version: 1", "version: 256", "version of 0 to 255"),
        ("arm_s: 30", "arm_s: 0", "positive arm_s"),
        ("arm_s: 30", "arm_s: 30\nmore: 1", "expected the keys"),
        ("events: {}", "", "expected the keys"),
        ("events: {}", "events: {}\nevents: {}", "dictionary.events: is written twice"),
        ("events: {}", "events: []", "events: expected a mapping"),
        ("type: uint8", "type: uint9", "expected a type of the dictionary, got 'uint9'"),
        ("type: uint8", "type: 'text[0]'", "expected a type of the dictionary"),
        ("type: uint8", "type: 'text[999]'", "expected a type of the dictionary"),
        ("type: uint8", "type: 'uint8[4]'", "expected a type of the dictionary"),
        ("type: uint8", "kind: uint8", "telemetry.a.x.kind: unknown key"),
        ("type: uint8", "unit: m", "telemetry.a.x.type: is missing"),
        ("type: uint8", "type: uint8, range: [2, 1]", "x.range: expected \\[low, high\\]"),
        ("type: uint8", "type: uint8, yellow: [1]", "x.yellow: expected \\[low, high\\]"),
        ("type: uint8", "type: uint8, states: {no: 1}", "expected whole numbers and their names"),
        ("type: uint8", "type: uint8, states: {1: a, 2: a}", "x.states: expected different names"),
        ("type: uint8", "type: uint8, red_states: [b]", "x.states"),
        ("id: 1", "id: 300", "telemetry.a.id: expected a number of 0 to 255"),
        ("id: 1", "id: one", "telemetry.a.id: expected a whole number"),
        ("id: 1", "id: 1, armed: maybe", "telemetry.a.armed: expected true or false"),
        ("id: 1", "id: 1, severity: dire", "telemetry.a.severity: expected one of info, warning, error"),
        ("uint8}}}}", "uint8}}}, b: {id: 1}}", "telemetry.b.id: expected a number of 0 to 255 of its own"),
        ("version: 1", "version: [", "is not valid YAML"),
        ("{a: {id: 1, items: {x: {type: uint8}}}}", "{a: 7}", "telemetry.a: expected a mapping with an id"),
        ("{type: uint8}", "7", "telemetry.a.x: expected a mapping with a type"),
        ("items: {x:", "items: {X:", "telemetry.a.X: expected a name of lower-case letters"),
        ("{a: {id", "{1a: {id", "telemetry.1a: expected a name of lower-case letters"),
        (
            "type: uint8",
            "type: uint8, states: {256: a}",
            "x.states: expected numbers that a whole-number type holds",
        ),
        (
            "type: uint8",
            "type: float64, states: {1: a}",
            "x.states: expected numbers that a whole-number type holds",
        ),
    ],
)
def test_a_mistake_in_the_dictionary_is_named_by_its_path(old, new, problem):
    assert parse_dictionary(GOOD.encode()).telemetry["a"].pack(x=3) == b"\1\1\3"
    with pytest.raises(ConfigError, match=problem):
        parse_dictionary(GOOD.replace(old, new).encode())


@pytest.mark.parametrize(
    ("item", "data", "problem"),
    [
        (Item("x", "text[4]"), b"\x05abcde", "x: at most 4 are allowed, 5 came"),
        (Item("x", "text[4]"), b"\x02\xff\xff", "x is not UTF-8"),
        (Item("x", "text[4]"), b"\x02a\x07", "x has characters that cannot be printed"),
        (Item("x", "float64[4]", range=(0.0, 1.0)), b"\0", "x: expected at least one number"),
        (Item("x", "uint8", range=(0, 9)), b"\x0a", "x"),
        (Item("x", "uint8", states=((1, "on"),)), b"\x02", "x: 2 is none of"),
    ],
)
def test_a_value_that_the_dictionary_does_not_allow_is_refused(item, data, problem):
    with pytest.raises(PacketError, match=problem):
        item.unpack(data, 0)
