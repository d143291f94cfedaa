"""Navigation data messages (CCSDS NDM) as text: both notations, KVN and XML, give the same keys and rows.

Source: CCSDS 502.0-B-3 (orbit data messages), 504.0-B-2 (attitude data messages), 505.0-B-3 (their XML).
"""

import re
import xml.etree.ElementTree as ET
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

from flightsw.icd.config import ConfigError
from obbgs_base.values import names_like

MAX_NDM_BYTES = 64 * 1024 * 1024  # a state each second for a week has some 60 MB
KINDS = ("OEM", "AEM", "OPM", "OMM")
VERSIONS = {
    "OEM": ("1.0", "2.0", "3.0"),
    "AEM": ("1.0", "2.0"),
    "OPM": ("1.0", "2.0", "3.0"),
    "OMM": ("2.0", "3.0"),
}
PAIR = re.compile(r"([A-Z][A-Z0-9_]*)\s*=\s*(.*)", re.ASCII)
WITH_UNIT = re.compile(r"(.*?)\s*\[([^\]]*)\]")
HEADER = {
    "CREATION_DATE": True,
    "ORIGINATOR": True,
    "CLASSIFICATION": False,
    "MESSAGE_ID": False,
}  # whether required
BLOCKS = {"META_START": "META_STOP", "DATA_START": "DATA_STOP", "COVARIANCE_START": "COVARIANCE_STOP"}
ROWS_OF = {
    "stateVector": "OEM",
    "attitudeState": "AEM",
}  # elements of XML that are one row, by the message they are of


@dataclass(frozen=True)
class Value:
    """The text of one value, its unit where one is written, and where it stands."""

    text: str
    where: str
    unit: str = ""

    def number(self, unit: str = "", name: str = "") -> float:
        """Return a finite number, whose unit must be the one given where it is written.

        Raises:
            ConfigError: it is none.
        """
        place = f"{self.where}, {name}" if name else self.where
        if self.unit and unit and self.unit.lower() != unit.lower():
            raise ConfigError(place, f"expected the unit {unit}, got {self.unit}")
        try:
            number = float(self.text)
        except ValueError:
            number = float("nan")
        if not abs(number) < 1e300 or "_" in self.text:
            raise ConfigError(place, f"expected a number, got {self.text[:40]!r}")
        return number


@dataclass(frozen=True)
class Row:
    """One line of numbers after its epoch; in XML each has a name."""

    values: tuple[Value, ...]
    where: str
    names: tuple[str, ...] | None = None

    def numbers(self, units: Mapping[str, str]) -> list[float]:
        """Return the numbers of columns, given by name with their units, in that order; more than these are refused.

        Raises:
            ConfigError: one is missing, or none is a number.
        """
        if self.names is None:
            if len(self.values) != len(units):
                raise ConfigError(
                    self.where,
                    f"expected {len(units)} numbers ({' '.join(units)}), got {len(self.values)}",
                )
            return [v.number(unit, name) for v, (name, unit) in zip(self.values, units.items(), strict=True)]
        found = dict(zip(self.names, self.values, strict=True))
        for name in units:
            if name not in found:
                raise ConfigError(f"{self.where}, {name}", f"is missing; got {' '.join(self.names)}")
        if more := set(found) - set(units):
            raise ConfigError(f"{self.where}, {min(more)}", f"unknown; expected {' '.join(units)}")
        return [found[name].number(unit, name) for name, unit in units.items()]


@dataclass
class Section:
    """Keys with their values, and the rows of numbers below them, each after the text of its epoch."""

    name: str
    where: str
    values: dict[str, Value] = field(default_factory=dict)
    rows: list[tuple[Value, Row]] = field(default_factory=list)

    def put(self, key: str, value: Value) -> None:
        if key.startswith("MAN_"):
            raise ConfigError(f"{value.where}, {key}", "manoeuvres are not computed: send the path as an OEM")
        if key in self.values:
            raise ConfigError(
                f"{value.where}, {key}", f"is written twice, before in {self.values[key].where}"
            )
        self.values[key] = value

    def check(self, keys: Mapping[str, bool]) -> None:
        """Check that keys are known, and that none is missing.

        Args:
            keys: whether each is required.

        Raises:
            ConfigError: names the first that is not.
        """
        for key, value in self.values.items():
            if key not in keys:
                raise ConfigError(
                    f"{value.where}, {key}", f"unknown key in {self.name}; {names_like(key, keys)}"
                )
        for key, required in keys.items():
            if required and key not in self.values:
                raise ConfigError(f"{self.where}, {key}", f"is missing in {self.name}")

    def text(self, key: str, default: str = "") -> str:
        return self.values[key].text if key in self.values else default

    def choice(self, key: str, options: Sequence[str], default: str = "") -> str:
        """Return the value of a key, in capitals, which is one of some.

        Raises:
            ConfigError: it is another.
        """
        if key not in self.values:
            return default
        text = " ".join(self.values[key].text.upper().split())
        if text not in options:
            got = self.values[key].text
            raise ConfigError(
                f"{self.values[key].where}, {key}", f"expected one of {', '.join(options)}, got {got!r}"
            )
        return text


@dataclass
class Segment:
    """Metadata with what follows them: rows, and covariances, each a section of its own."""

    meta: Section
    data: Section
    covariances: list[Section] = field(default_factory=list)


@dataclass
class Message:
    """One message: what kind it is, its version, its header, its segments (one of OPM and OMM, all keys in `data`)."""

    kind: str
    version: str
    header: Section
    segments: list[Segment]


def is_message(content: bytes) -> bool:
    """Return whether a file begins like a message, in KVN or XML."""
    start = content[:1000].removeprefix(b"\xef\xbb\xbf").lstrip()
    return start.startswith((b"CCSDS_", b"<"))


def read_messages(content: bytes) -> list[Message]:
    """Return the messages in a file: one in KVN, one or several (`<ndm>`) in XML.

    Raises:
        ConfigError: it is no such file; the message names the line or the segment.
    """
    if len(content) > MAX_NDM_BYTES:
        raise ConfigError("message", f"has {len(content)} bytes, at most {MAX_NDM_BYTES} are read")
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ConfigError("message", f"expected KVN or XML as UTF-8: {error.reason}") from error
    messages = _of_xml(text) if text.lstrip().startswith("<") else [_of_kvn(text)]
    for message in messages:
        message.header.check(HEADER)
        if not message.segments:
            raise ConfigError("message", f"an {message.kind} without segments; expected at least one")
    return messages


def _message(kind: str, version: str, where: str) -> Message:
    if kind not in KINDS:
        raise ConfigError(where, f"expected one of the messages {', '.join(KINDS)}, got {kind[:20]!r}")
    if version not in VERSIONS[kind]:
        raise ConfigError(
            f"{where}, CCSDS_{kind}_VERS", f"expected {' or '.join(VERSIONS[kind])}, got {version[:20]!r}"
        )
    return Message(kind, version, Section(f"the header of {kind}", where), [])


# --- KVN ---


def _of_kvn(text: str) -> Message:
    lines = _lines(text)
    where, first = next(lines, ("line 1", ""))
    version = re.fullmatch(r"CCSDS_([A-Z]{3})_VERS\s*=\s*(\S+)", first, re.ASCII)
    if version is None:
        raise ConfigError(
            where, f"expected CCSDS_OEM_VERS = 2.0, or one of AEM, OPM, OMM, got {first[:40]!r}"
        )
    message = _message(version[1], version[2], where)
    if message.kind in ("OPM", "OMM"):
        _read_state(message, lines)
    else:
        _read_segments(message, lines)
    return message


def _lines(text: str) -> Iterator[tuple[str, str]]:
    """Yield the lines that say something, each after where it stands."""
    for number, line in enumerate(text.split("\n"), start=1):
        line = line.strip()
        if line and line.split(maxsplit=1)[0] != "COMMENT":
            yield f"line {number}", line


def _pair(where: str, line: str) -> tuple[str, Value] | None:
    pair = PAIR.fullmatch(line)
    if pair is None:
        return None
    unit = WITH_UNIT.fullmatch(pair[2])
    text, name = (unit[1], unit[2].strip()) if unit else (pair[2], "")
    if not text:
        raise ConfigError(f"{where}, {pair[1]}", "has no value")
    return pair[1], Value(text, where, name)


def _read_state(message: Message, lines: Iterator[tuple[str, str]]) -> None:
    """Read an OPM or an OMM: keys only."""
    data = Section(message.kind, message.header.where)
    for where, line in lines:
        pair = _pair(where, line)
        if pair is None:
            raise ConfigError(where, f"expected KEY = value, got {line[:40]!r}")
        (message.header if pair[0] in HEADER else data).put(*pair)
    message.segments.append(Segment(data, data))


def _read_segments(message: Message, lines: Iterator[tuple[str, str]]) -> None:
    """Read an OEM or an AEM: blocks of metadata, and rows of numbers after each."""
    block, opened = "", ""
    for where, line in lines:
        if line in BLOCKS:
            if block or (line != "META_START" and not message.segments):
                raise ConfigError(where, f"{line} inside {block or 'no segment'}; expected META_START first")
            block, opened = line, where
            if line == "META_START":
                name = f"the metadata of {message.kind}"
                message.segments.append(Segment(Section(name, where), Section("data", where)))
            continue
        if line in BLOCKS.values():
            if BLOCKS.get(block) != line:
                raise ConfigError(where, f"{line} without {line.replace('STOP', 'START')}")
            block = ""
            continue
        section = _section(message, block, where, line)
        if (pair := _pair(where, line)) is not None:
            section.put(*pair)
        else:
            epoch, *numbers = line.split()
            covariance = block == "COVARIANCE_START"
            values = tuple(Value(number, where) for number in (line.split() if covariance else numbers))
            section.rows.append((Value(epoch, where), Row(values, where)))
    if block:
        raise ConfigError(opened, f"{block} without {BLOCKS[block]}; the file may be cut off: copy it again")


def _section(message: Message, block: str, where: str, line: str) -> Section:
    """Return the section that a line belongs to; in a block of covariances each epoch begins one."""
    is_pair = PAIR.fullmatch(line) is not None
    if not message.segments:
        if not is_pair:
            raise ConfigError(where, f"expected KEY = value or META_START, got {line[:40]!r}")
        return message.header
    segment = message.segments[-1]
    if block == "META_START":
        if not is_pair:
            raise ConfigError(where, f"expected KEY = value or META_STOP, got {line[:40]!r}")
        return segment.meta
    if block == "COVARIANCE_START":
        if line.startswith("EPOCH"):
            segment.covariances.append(Section("a covariance", where))
        if not segment.covariances:
            raise ConfigError(where, f"expected EPOCH = ..., got {line[:40]!r}")
        return segment.covariances[-1]
    if is_pair:
        raise ConfigError(where, f"expected a row of numbers or META_START, got {line[:40]!r}")
    return segment.data


# --- XML ---


def _of_xml(text: str) -> list[Message]:
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise ConfigError("message", "expected XML without a document type, which could stand for anything")
    try:
        root = ET.fromstring(text.lstrip())
    except (ET.ParseError, ValueError) as error:
        raise ConfigError("message", f"is not valid XML: {error}") from error
    found = [root] if _tag(root) != "ndm" else [e for e in root if _tag(e) not in ("COMMENT", "MESSAGE_ID")]
    return [_message_of(element) for element in found]


def _tag(element: ET.Element) -> str:
    return element.tag.rpartition("}")[2]


def _message_of(root: ET.Element) -> Message:
    kind = _tag(root).upper()
    message = _message(kind, root.get("version", ""), f"<{_tag(root)}>")
    for element in _child(root, "header"):
        _put(message.header, element, "the header")
    segments = [e for e in _child(root, "body") if _tag(e) == "segment"]
    for number, element in enumerate(segments, start=1):
        where = f"segment {number}"
        meta = Section(f"the metadata of {kind}", where)
        for leaf in _child(element, "metadata"):
            _put(meta, leaf, where)
        segment = Segment(meta, Section("data", where))
        if kind in ("OPM", "OMM"):
            segment = Segment(meta, meta)
            meta.name = kind
            for leaf in _leaves(_child(element, "data")):
                _put(meta, leaf, where)
        else:
            _read_rows(segment, _child(element, "data"), kind, where)
        message.segments.append(segment)
    return message


def _read_rows(segment: Segment, data: ET.Element, kind: str, where: str) -> None:
    for number, element in enumerate(data, start=1):
        place = f"{where}, {_tag(element)} {number}"
        if _tag(element) == "COMMENT":
            continue
        row = Section("a row", place)
        for leaf in _leaves(element):
            _put(row, leaf, place)
        values = row.values
        if _tag(element) == "covarianceMatrix" and kind == "OEM":
            section = Section("a covariance", place)
            named = {name: v for name, v in values.items() if name not in ("EPOCH", "COV_REF_FRAME")}
            section.values = {name: v for name, v in values.items() if name not in named}
            section.rows = [(Value("", place), Row(tuple(named.values()), place, tuple(named)))]
            segment.covariances.append(section)
        elif ROWS_OF.get(_tag(element)) == kind:
            epoch = values.pop("EPOCH", None)
            if epoch is None:
                raise ConfigError(f"{place}, EPOCH", "is missing")
            segment.data.rows.append((epoch, Row(tuple(values.values()), place, tuple(values))))
        else:
            raise ConfigError(place, f"unknown in the data of an {kind}")


def _child(element: ET.Element, name: str) -> ET.Element:
    found = next((e for e in element if _tag(e) == name), None)
    if found is None:
        raise ConfigError(f"<{_tag(element)}>", f"expected <{name}> in it")
    return found


def _leaves(element: ET.Element) -> Iterator[ET.Element]:
    for child in element:
        if len(child):
            yield from _leaves(child)
        else:
            yield child


def _value(element: ET.Element, where: str) -> Value:
    text = (element.text or "").strip()
    if not text:
        raise ConfigError(f"{where}, {_tag(element)}", "has no value")
    return Value(text, where, element.get("units", ""))


def _put(section: Section, element: ET.Element, where: str) -> None:
    name = _tag(element)
    if name == "USER_DEFINED":
        name = f"USER_DEFINED_{element.get('parameter', '')}"
    if name != "COMMENT":
        section.put(name, _value(element, where))
