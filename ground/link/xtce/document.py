"""Writes the telemetry and command dictionary as XTCE 1.2, by which other ground systems read our packets.

XTCE (XML Telemetric and Command Exchange) is the format of the Object Management Group, and CCSDS 660.1-B. Names are
flat, because some readers know one space system only: item `mode` of the packet `housekeeping` is the parameter
`housekeeping_mode`. A text is its length, `..._length`, and its characters. XTCE readers disagree on arrays of a
variable number of elements, so such an array is its count, `..._count`, one parameter for each element from `..._1`,
and one container for each count.
"""

import re
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Sequence
from typing import Any

from flightsw.icd.config import ConfigError
from flightsw.icd.frame import ATTITUDES, SOURCES
from flightsw.icd.packet import (
    APID_EVENTS,
    APID_FILES,
    APID_FRAME_HEADERS,
    APID_HOUSEKEEPING,
    APID_REPORTS,
    APID_UPLINK_FILES,
    TELEMETRY,
)
from flightsw.icd.telemetry import DICTIONARY, NUMBERS, Dictionary, Item, Layout
from ground.link.xtce.commands import add_commands
from ground.link.xtce.types import binary_type, element, number_type, text_type, type_of

NAMESPACE = "http://www.omg.org/spec/XTCE/20180204"
SYSTEM = "obbgs"
ROOT_CONTAINER = "CCSDSPacket"
PRIMARY_HEADER = (  # CCSDS 133.0-B, bits; the names are those that XTCE readers commonly expect
    ("VERSION", 3),
    ("TYPE", 1),
    ("SEC_HDR_FLG", 1),
    ("PKT_APID", 11),
    ("SEQ_FLGS", 2),
    ("SRC_SEQ_CTR", 14),
    ("PKT_LEN", 16),
)
NOT_XML = re.compile(r"[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")  # XML 1.0, section 2.2
SECTIONS = (  # of the dictionary: name, APID, what stands before the names of its packets
    ("telemetry", APID_HOUSEKEEPING, ""),
    ("events", APID_EVENTS, "event_"),
    ("reports", APID_REPORTS, ""),
)
FILES = (("file_pdu", APID_FILES), ("uplink_file_pdu", APID_UPLINK_FILES))  # one CFDP PDU each
# The header of a frame container, flightsw/icd/README.md: name, letter of struct, unit, meaning of its values.
FRAME_HEADER: tuple[tuple[str, str, str, tuple[tuple[int, str], ...]], ...] = (
    ("magic", "4s", "", ()),
    ("version", "H", "", ()),
    ("header_bytes", "H", "B", ()),
    ("frame_id", "I", "", ()),
    ("bracket_id", "I", "", ()),
    ("bracket_index", "B", "", ()),
    ("bracket_count", "B", "", ()),
    ("flags", "H", "", ()),
    ("exposure_time_s", "d", "s", ()),
    ("mid_exposure_utc_ns", "q", "ns", ()),
    ("height", "H", "px", ()),
    ("width", "H", "px", ()),
    ("channels", "B", "", ()),
    ("bit_depth", "B", "", ()),
    ("codec", "B", "", ()),
    ("near", "B", "DN", ()),
    ("pose_source", "B", "", tuple(enumerate(SOURCES))),
    ("attitude", "B", "", tuple(enumerate(ATTITUDES))),
    ("black_dn", "f", "DN", ()),
    ("saturated_count", "I", "", ()),
    *((f"quat_body_to_camera_{axis}", "d", "", ()) for axis in "wxyz"),
    *((f"position_body_m_{axis}", "d", "m", ()) for axis in "xyz"),
    *((f"sun_dir_body_{axis}", "d", "", ()) for axis in "xyz"),
    *((f"covariance_{row}_{column}", "d", "", ()) for row in range(6) for column in range(row + 1)),
    *((f"quat_inertial_to_body_{axis}", "d", "", ()) for axis in "wxyz"),
    ("correlation_time_s", "d", "s", ()),
    ("codestream_bytes", "I", "B", ()),
    ("pixel_crc", "I", "", ()),
)


def xtce_document(dictionary: Dictionary = DICTIONARY) -> bytes:
    """Return the XTCE 1.2 document of a dictionary: all packets to the ground, and the commands before sealing.

    Raises:
        ConfigError: XTCE cannot express it: a character that XML forbids, two equal names, or two arrays in a packet.
    """
    root = ET.Element(
        "SpaceSystem",
        {
            "name": SYSTEM,
            "xmlns": NAMESPACE,
            "xmlns:xsi": "http://www.w3.org/2001/XMLSchema-instance",
            "xsi:schemaLocation": f"{NAMESPACE} {NAMESPACE}/SpaceSystem.xsd",
            "shortDescription": "obbgs: written from flightsw/icd/dictionary.yaml; change that file, not this one",
        },
    )
    element(root, "Header", version=str(dictionary.version), validationStatus="Working", date="")
    telemetry = _Telemetry(root)
    for section, apid, prefix in SECTIONS:
        telemetry.section(section, apid, prefix, dictionary)
    telemetry.frame_header()
    for name, apid in FILES:
        telemetry.file_pdu(name, apid)
    add_commands(root, dictionary)
    _check_characters(root)
    ET.indent(root)
    return ET.tostring(root, encoding="utf-8", xml_declaration=True) + b"\n"


def _check_characters(root: ET.Element) -> None:
    """Refuse what XML 1.0 cannot hold; the library would write it, and no reader would take it."""
    for node in root.iter():
        for text in (*node.attrib.values(), node.text or ""):
            if wrong := NOT_XML.search(text):
                where = node.get("name", node.tag)
                raise ConfigError(
                    where, f"the character {wrong[0]!r} cannot stand in XML; take it out of {text!r}"
                )


class _Telemetry:
    """The part of the document that describes packets to the ground, while it is built."""

    def __init__(self, root: ET.Element):
        meta = element(root, "TelemetryMetaData")
        self._types = element(meta, "ParameterTypeSet")
        self._parameters = element(meta, "ParameterSet")
        self._containers = element(meta, "ContainerSet")
        self._names: set[str] = set()
        entries = self._container(ROOT_CONTAINER, abstract=True)
        for name, bits in PRIMARY_HEADER:
            self._parameter(entries, name, number_type("Parameter", name, bits))
        self._parameter(None, "dictionary_version", number_type("Parameter", "dictionary_version", 8))
        self._parameter(None, "packet_id", number_type("Parameter", "packet_id", 8))

    def section(self, section: str, apid: int, prefix: str, dictionary: Dictionary) -> None:
        """Add the packets of a section of the dictionary."""
        entries = self._container(section, ROOT_CONTAINER, _to_ground(apid), abstract=True)
        for name in ("dictionary_version", "packet_id"):
            element(entries, "ParameterRefEntry", parameterRef=name)
        for layout in getattr(dictionary, section).values():
            self._packet(section, prefix + layout.name, layout)
        if section == "reports":
            self._stages(dictionary)

    def _packet(self, section: str, name: str, layout: Layout) -> None:
        arrays = [item for item in layout.items if _is_array(item)]
        if len(arrays) > 1:
            problem = (
                "XTCE is written for one array of numbers in a packet; send the others in one of their own"
            )
            raise ConfigError(f"{section}.{layout.name}.{arrays[1].name}", problem)
        text = layout.text if section != "events" else f"{layout.severity}: {layout.text}"
        this = (("dictionary_version", layout.version), ("packet_id", layout.id))
        entries = self._container(name, section, this, abstract=bool(arrays), text=text, partition=True)
        for at, item in enumerate(layout.items):
            if _is_array(item):
                self._array(entries, name, item, layout.items[at + 1 :])
                return
            self._item(entries, name, item)

    def _array(self, entries: ET.Element, packet: str, item: Item, rest: Sequence[Item]) -> None:
        """Add an array's count, a container for each count, and a container of what follows, which those share."""
        count = f"{packet}_{item.name}_count"
        self._parameter(entries, count, number_type("Parameter", count, 8))
        names = [f"{packet}_{item.name}_{number}" for number in range(1, item.count + 1)]
        for name in names:
            self._parameter(None, name, type_of(item, "Parameter", name), item.text)
        if rest:
            after = self._container(f"{packet}_rest")
            for following in rest:
                self._item(after, packet, following)
        for number in range(1 if item.range else 0, item.count + 1):
            these = self._container(f"{packet}_{number}", packet, [(count, number)])
            for name in names[:number]:
                element(these, "ParameterRefEntry", parameterRef=name)
            if rest:
                element(these, "ContainerRefEntry", containerRef=f"{packet}_rest")

    def _item(self, entries: ET.Element, packet: str, item: Item) -> None:
        name = f"{packet}_{item.name}"
        if item.kind == "text":
            self._parameter(
                entries, f"{name}_length", number_type("Parameter", f"{name}_length", 8, unit="B")
            )
            self._parameter(entries, name, text_type(name, item.count, f"{name}_length"), item.text)
        else:
            self._parameter(entries, name, type_of(item, "Parameter", name), item.text)

    def _stages(self, dictionary: Dictionary) -> None:
        """Add the containers of the reports that the commands' verifiers wait for."""
        report = dictionary.reports.get("report")
        items = [item for item in report.items if item.name == "stage"] if report else []
        stages = {name: number for item in items for number, name in item.states}
        for name, wanted in STAGES.items():
            numbers = [stages[stage] for stage in wanted if stage in stages]
            if len(numbers) != len(wanted):
                raise ConfigError("reports.report.stage", f"expected the states {', '.join(wanted)}")
            self._container(
                f"report_{name}", "report", [("report_stage", number) for number in numbers], any_of=True
            )

    def frame_header(self) -> None:
        """Add the header of a frame container."""
        entries = self._container(
            "frame_header", ROOT_CONTAINER, _to_ground(APID_FRAME_HEADERS), partition=True
        )
        for field, code, unit, states in FRAME_HEADER:
            name = f"frame_header_{field}"
            if code.endswith("s"):
                made = binary_type("Parameter", name, 8 * int(code[:-1]))
            else:
                made = number_type("Parameter", name, code=code, unit=unit, states=states)
            self._parameter(entries, name, made)

    def file_pdu(self, name: str, apid: int) -> None:
        """Add the packets of file transfers: the PDU as it is."""
        text = "one PDU of a file transfer (CFDP)"
        entries = self._container(name, ROOT_CONTAINER, _to_ground(apid), text=text, partition=True)
        self._parameter(entries, f"{name}_bytes", binary_type("Parameter", f"{name}_bytes", 8, "PKT_LEN"))

    def _parameter(self, entries: ET.Element | None, name: str, type_: ET.Element, text: str = "") -> None:
        """Add a parameter and its type; and, where `entries` are given, its place in a container."""
        self._claim(name)
        self._types.append(type_)
        described = {"shortDescription": text} if text else {}
        element(self._parameters, "Parameter", name=name, parameterTypeRef=type_.get("name", ""), **described)
        if entries is not None:
            element(entries, "ParameterRefEntry", parameterRef=name)

    def _container(
        self,
        name: str,
        base: str = "",
        where: Iterable[tuple[str, int]] = (),
        *,
        any_of: bool = False,
        abstract: bool = False,
        text: str = "",
        partition: bool = False,
    ) -> ET.Element:
        """Return the entry list of a new container, which is its base with these parameters at these values.

        Args:
            any_of: one of the values is enough.
            partition: Yamcs keeps these packets apart in its archive.
        """
        self._claim(f"container {name}")
        attributes: dict[str, Any] = {"name": name} | ({"shortDescription": text} if text else {})
        made = element(self._containers, "SequenceContainer", **attributes)
        if abstract:
            made.set("abstract", "true")
        if partition:
            data = element(element(made, "AncillaryDataSet"), "AncillaryData", name="Yamcs")
            data.text = "UseAsArchivingPartition"
        entries = element(made, "EntryList")
        if base:
            criteria = element(element(made, "BaseContainer", containerRef=base), "RestrictionCriteria")
            _compare(criteria, list(where), any_of)
        return entries

    def _claim(self, name: str) -> None:
        if name in self._names:
            raise ConfigError(
                name, "two items of the dictionary get this name in XTCE; give one another name"
            )
        self._names.add(name)


STAGES = {  # containers of reports by which a verifier knows what became of a command, and their stages
    "accepted": ("accepted",),
    "started": ("started",),
    "completed": ("completed",),
    "not_completed": ("refused", "failed"),
}


def _compare(criteria: ET.Element, where: list[tuple[str, int]], any_of: bool) -> None:
    if any_of and len(where) > 1:
        conditions = element(element(criteria, "BooleanExpression"), "ORedConditions")
        for name, value in where:
            condition = element(conditions, "Condition")
            element(condition, "ParameterInstanceRef", parameterRef=name, useCalibratedValue="false")
            element(condition, "ComparisonOperator").text = "=="
            element(condition, "Value").text = str(value)
        return
    comparisons = element(criteria, "ComparisonList")
    for name, value in where:
        element(comparisons, "Comparison", parameterRef=name, value=str(value), useCalibratedValue="false")


def _to_ground(apid: int) -> tuple[tuple[str, int], ...]:
    return ("TYPE", TELEMETRY), ("PKT_APID", apid)


def _is_array(item: Item) -> bool:
    return item.kind in NUMBERS and item.type not in NUMBERS
