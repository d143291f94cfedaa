"""The XTCE document: valid by the schema of the Object Management Group, and read by others as we read packets."""

import io
import random
import re
import struct
import subprocess
import sys
import warnings
import xml.etree.ElementTree as ET

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from space_packet_parser.xtce.definitions import XtcePacketDefinition
from space_packet_parser.xtce.validation import validate_xtce
from typer.testing import CliRunner

from flightsw.icd import telemetry
from flightsw.icd.config import ConfigError
from flightsw.icd.frame import HEADER, read_header
from flightsw.icd.packet import APID_HOUSEKEEPING, TELEMETRY, pack_packet
from flightsw.icd.telemetry import DICTIONARY, parse_dictionary
from ground.cli import app
from ground.link.xtce.document import FRAME_HEADER, NAMESPACE, xtce_document
from tests.dictionary_packets import exactly, frame_header, packets

PACKETS = 10_000


@pytest.fixture(scope="module")
def reader(tmp_path_factory):
    """space_packet_parser, with our document."""
    file = tmp_path_factory.mktemp("xtce") / "obbgs.xml"
    file.write_bytes(xtce_document())
    return XtcePacketDefinition.from_xtce(file)


def assert_valid(document: bytes, tmp_path) -> None:
    file = tmp_path / "document.xml"
    file.write_bytes(document)
    result = validate_xtce(file, raise_on_error=False)  # the schema comes with the library
    assert result, [str(error) for error in result.errors]


def test_the_document_is_valid_by_the_schema_of_xtce_1_2(tmp_path):
    assert_valid(xtce_document(), tmp_path)


def test_ten_thousand_random_and_extreme_packets_are_read_as_we_read_them(reader):
    header = {"VERSION", "TYPE", "SEC_HDR_FLG", "SEQ_FLGS"}
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # it only warns of bytes left over
        for packet, _, parameters in packets(PACKETS, seed=1):
            found = reader.parse_bytes(packet)
            values = {name: value for name, value in found.items() if name not in header}
            assert exactly(values) == exactly(parameters)


def test_a_packet_of_another_version_or_number_is_none_of_ours_for_others_too(reader):
    from space_packet_parser.exceptions import UnrecognizedPacketTypeError

    layout = DICTIONARY.events["stopped"]
    for start in (bytes([layout.version + 1, layout.id]), bytes([layout.version, 99])):
        with pytest.raises(UnrecognizedPacketTypeError):
            reader.parse_bytes(pack_packet(TELEMETRY, APID_HOUSEKEEPING + 1, 0, start + bytes(8)))


def test_the_frame_header_is_that_of_the_container():
    letters = "".join(code for _, code, *_ in FRAME_HEADER)
    assert struct.calcsize(f">{letters}") == HEADER.size
    unrolled = "".join(
        letter * int(count or 1) for count, letter in re.findall(r"(\d*)([a-zA-Z])", HEADER.format)
    )
    assert letters.replace("4s", "ssss") == unrolled
    data, values = frame_header(random.Random(2))
    for name, value in read_header(data).items():
        if isinstance(value, list):
            assert [v for k, v in values.items() if k.startswith(f"frame_header_{name}_")] == value
        else:
            assert values[f"frame_header_{name}"] == value


def test_every_unit_limit_state_severity_and_range_is_in_the_document():
    root = ET.fromstring(xtce_document())
    ns = {"x": NAMESPACE}
    types = {node.get("name"): node for node in root.iterfind("x:TelemetryMetaData/x:ParameterTypeSet/*", ns)}
    for item in DICTIONARY.telemetry["housekeeping"].items:
        node = types.get(f"housekeeping_{item.name}_type", types.get(f"housekeeping_{item.name}_1_type"))
        assert node is not None, item.name
        assert node.findtext(".//x:Unit", "", ns) == item.unit
        states = [(int(e.get("value", "")), e.get("label")) for e in node.iterfind(".//x:Enumeration", ns)]
        assert states == list(item.states)
        for tag, bounds in (("WarningRange", item.yellow), ("CriticalRange", item.red)):
            found = [
                (float(r.get("minInclusive", "")), float(r.get("maxInclusive", "")))
                for r in node.iterfind(f".//x:{tag}", ns)
            ]
            assert found == ([bounds] if bounds else [])
        red = {e.get("enumerationLabel") for e in node.iterfind(".//x:EnumerationAlarm", ns)}
        assert red == set(item.red_states)
    containers = {node.get("name"): node for node in root.iterfind(".//x:SequenceContainer", ns)}
    for layout in DICTIONARY.events.values():
        assert (
            containers[f"event_{layout.name}"].get("shortDescription") == f"{layout.severity}: {layout.text}"
        )
    commands = {node.get("name"): node for node in root.iterfind(".//x:MetaCommand", ns)}
    assert set(commands) == set(DICTIONARY.commands) | {"command"}
    for layout in DICTIONARY.commands.values():
        assert (commands[layout.name].find("x:DefaultSignificance", ns) is not None) == layout.armed
    arguments = {node.get("name"): node for node in root.iterfind(".//x:ArgumentTypeSet/*", ns)}
    valid = arguments["near_near_type"].find(".//x:ValidRange", ns)
    assert valid is not None and valid.attrib == {"minInclusive": "0", "maxInclusive": "16"}


MINIMAL = {"version": 1, "arm_s": 1, "telemetry": {}, "events": {}, "reports": {}, "commands": {}}
REPORT = yaml.safe_load(telemetry._FILE.read_text())["reports"]


def made(**sections) -> bytes:
    return yaml.safe_dump(MINIMAL | {"reports": REPORT} | sections).encode()


def packet(**items) -> dict:
    return {"one": {"id": 1, "items": items}}


NUMBER = {"type": "uint8"}
EQUAL_NAMES = {"a": {"id": 1, "items": {"b_c": NUMBER}}, "a_b": {"id": 2, "items": {"c": NUMBER}}}


@pytest.mark.parametrize(
    ("content", "problem"),
    [
        (made(telemetry=packet(a={"type": "float64[2]"}, b={"type": "float64[2]"})), r"one\.b: .*one array"),
        (made(telemetry=packet(a={"type": "uint8", "text": "bell \a"})), "cannot stand in XML"),
        (made(telemetry=packet(a={"type": "uint8", "unit": "\ufffe"})), "cannot stand in XML"),
        (made(telemetry=packet(a={"type": "text[5]"}, a_length={"type": "uint8"})), "two items"),
        (made(telemetry=EQUAL_NAMES), "two items"),
        (made(commands=packet(a={"type": "text[5]"})), "with a text"),
        (made(reports={}), "expected the states"),
        (made(telemetry={"a.b": {"id": 1}}), "expected a name"),
        (made(telemetry={7: {"id": 1}}), "expected a name"),
        (made(telemetry=packet(**{"a b": {"type": "uint8"}})), "expected a name"),
        (made(telemetry=packet(a={"type": "uint8", "states": {256: "on"}})), "whole-number type"),
        (made(telemetry=packet(a={"type": "float64", "states": {1: "on"}})), "whole-number type"),
    ],
)
def test_a_dictionary_that_xtce_cannot_express_is_refused_by_name(content, problem):
    with pytest.raises(ConfigError, match=problem):
        xtce_document(parse_dictionary(content))


def test_huge_limits_and_those_between_whole_numbers_are_valid(tmp_path):
    items = {
        "a": {"type": "float64", "yellow": [-1e299, 3.5], "red": [-1e299, 1e299]},
        "b": {"type": "uint8", "range": [0.5, 1e9]},
        "c": {"type": "int64", "range": [-1e299, 2.5]},
        "d": {"type": "float64[2]", "range": [0, 1]},
    }
    document = xtce_document(parse_dictionary(made(telemetry=packet(**items))))
    assert_valid(document, tmp_path)
    ranges = [node.attrib for node in ET.fromstring(document).iter(f"{{{NAMESPACE}}}ValidRange")]
    assert ranges[:2] == [
        {"minInclusive": "1", "maxInclusive": "255"},
        {"minInclusive": str(-(1 << 63)), "maxInclusive": "2"},
    ]


@settings(max_examples=100, deadline=None)
@given(data=st.data())
def test_a_damaged_dictionary_gives_a_document_that_others_read_or_an_error_that_says_why(data):
    content = telemetry._FILE.read_bytes()
    lines = content.splitlines(keepends=True)
    match data.draw(st.sampled_from(["cut", "line", "byte"])):
        case "cut":
            content = content[: data.draw(st.integers(0, len(content)))]
        case "line":
            del lines[data.draw(st.integers(0, len(lines) - 1))]
            content = b"".join(lines)
        case "byte":
            at = data.draw(st.integers(0, len(content) - 1))
            content = content[:at] + data.draw(st.binary(min_size=1, max_size=3)) + content[at + 1 :]
    try:
        document = xtce_document(parse_dictionary(content))
    except ConfigError:
        return
    XtcePacketDefinition.from_xtce(io.BytesIO(document))


def test_the_command_writes_the_document(tmp_path):
    file = tmp_path / "obbgs.xml"
    result = CliRunner().invoke(app, ["dictionary", "--out", str(file)])
    assert result.exit_code == 0, result.output
    assert file.read_bytes() == xtce_document()
    assert f"{len(DICTIONARY.commands)} commands" in result.output


def test_a_damaged_dictionary_ends_the_command_with_one_line(tmp_path):
    """The file is part of the package; here a copy of the package holds a damaged one."""
    code = (
        "import pathlib, sys, flightsw.icd.config as config\n"
        "read = pathlib.Path.read_bytes\n"
        "pathlib.Path.read_bytes = lambda p: b'version: [' if p.name == 'dictionary.yaml' else read(p)\n"
        f"sys.argv = ['ground', 'dictionary', '--out', {str(tmp_path / 'x.xml')!r}]\n"
        "import ground.cli\n"
        "ground.cli.main()\n"
    )
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert ended.returncode == 2
    assert "dictionary.yaml" in ended.stderr and "Traceback" not in ended.stderr
    assert not (tmp_path / "x.xml").exists()
