"""The telemetry and command dictionary: packs and unpacks what dictionary.yaml describes, and nothing else."""

import math
import re
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from flightsw.icd.config import ConfigError, build, in_file, keys_below, parse_yaml
from flightsw.icd.packet import PacketError, PacketTooShort

NUMBERS = {"uint8": "B", "uint16": "H", "uint32": "I", "uint64": "Q", "int64": "q", "float64": "d"}
WHOLE = tuple(kind for kind in NUMBERS if "int" in kind)
NAME = re.compile(r"[a-z][a-z0-9_]*", re.ASCII)  # of packets and items: also a name in XTCE, JSON and Python
ARRAY = re.compile(r"(float64|text|bytes)\[(\d{1,3})\]", re.ASCII)
Severity = Literal["info", "warning", "error"]
Limit = Literal["green", "yellow", "red"]


@dataclass(frozen=True)
class Item:
    """One value of a packet. `low` and `high` bound a number; outside `yellow` it warns, outside `red` it alarms."""

    name: str
    type: str
    unit: str = ""
    text: str = ""
    range: tuple[float, ...] = ()
    yellow: tuple[float, ...] = ()
    red: tuple[float, ...] = ()
    red_states: tuple[str, ...] = ()
    states: tuple[tuple[int, str], ...] = ()

    def __post_init__(self):
        if self.type not in NUMBERS and not (ARRAY.fullmatch(self.type) and 0 < self.count < 256):
            raise ConfigError(f"{self.name}.type", f"expected a type of the dictionary, got {self.type!r}")
        for key in ("range", "yellow", "red"):
            bounds = getattr(self, key)
            if bounds and not (len(bounds) == 2 and bounds[0] <= bounds[1]):
                raise ConfigError(f"{self.name}.{key}", f"expected [low, high], got {list(bounds)}")
        names = [name for _, name in self.states]
        if self.states and not (
            self.type in WHOLE and all(_fits(n, NUMBERS[self.type]) for n, _ in self.states)
        ):
            raise ConfigError(
                f"{self.name}.states", f"expected numbers that a whole-number type holds, got {self.type}"
            )
        if len(set(names)) != len(names) or not set(self.red_states) <= set(names):
            raise ConfigError(
                f"{self.name}.states", f"expected different names, red ones among them: {names}"
            )

    @property
    def kind(self) -> str:
        """`text` or `bytes`, or the type of the number or numbers."""
        return self.type.partition("[")[0]

    @property
    def count(self) -> int:
        """The most numbers or bytes; 1 for a single number."""
        match = ARRAY.fullmatch(self.type)
        return int(match[2]) if match else 1

    def pack(self, value: Any) -> bytes:
        """Return a value's bytes.

        Raises:
            ValueError: it is not of the type, or out of range.
        """
        if self.kind == "text":
            content = printable(str(value)).encode()[: self.count]
            content = content.decode(errors="ignore").encode()  # not half a character
            return bytes([len(content)]) + content
        if self.kind == "bytes":
            content = bytes(value)
            if len(content) != self.count:
                raise ValueError(f"{self.name}: expected {self.count} bytes, got {len(content)}")
            return content
        if self.states:
            numbers = {name: number for number, name in self.states}
            if value not in numbers:
                raise ValueError(f"{self.name}: expected one of {', '.join(numbers)}, got {value!r}")
            value = numbers[value]
        values = (value,) if self.type in NUMBERS else tuple(value)
        if len(values) > self.count or (not values and self.range):
            raise ValueError(f"{self.name}: expected 1 to {self.count} numbers, got {len(values)}")
        for number in values:
            self._check(number)
        try:
            packed = struct.pack(f">{len(values)}{NUMBERS[self.kind]}", *values)
        except struct.error as error:
            raise ValueError(f"{self.name}={value!r} is no {self.type}") from error
        return packed if self.type in NUMBERS else bytes([len(values)]) + packed

    def unpack(self, data: bytes, at: int) -> tuple[Any, int]:
        """Return the value at a place, and where the next one starts.

        Raises:
            PacketError: too few bytes, or a value that the dictionary does not allow.
        """
        count = self.count
        if self.type not in NUMBERS and self.kind != "bytes":
            count, at = _taken(data, at, 1)[0], at + 1
            if count > self.count:
                raise PacketError(f"{self.name}: at most {self.count} are allowed, {count} came")
        code = NUMBERS.get(self.kind)
        size = count * struct.calcsize(f">{code}") if code else count
        content = _taken(data, at, size)
        at += size
        if self.kind == "bytes":
            return content, at
        if self.kind == "text":
            try:
                text = content.decode()
            except UnicodeDecodeError as error:
                raise PacketError(f"{self.name} is not UTF-8") from error
            if text != printable(text):
                raise PacketError(f"{self.name} has characters that cannot be printed")
            return text, at
        values = struct.unpack(f">{count}{code}", content)
        try:
            if not values and self.range:
                raise ValueError(f"{self.name}: expected at least one number")
            for number in values:
                self._check(number)
        except ValueError as error:
            raise PacketError(str(error)) from error
        if self.states:
            names = dict(self.states)
            if values[0] not in names:
                raise PacketError(f"{self.name}: {values[0]} is none of {names}")
            return names[values[0]], at
        return (values[0] if self.type in NUMBERS else values), at

    def _check(self, number: Any) -> None:
        if isinstance(number, bool) or not isinstance(number, int | float) or not math.isfinite(number):
            raise ValueError(f"{self.name}: expected a finite number, got {number!r}")
        if self.range and not self.range[0] <= number <= self.range[1]:
            low, high = self.range
            unit = f" {self.unit}" if self.unit else ""
            raise ValueError(f"{self.name}: expected {low:g} to {high:g}{unit}, got {number}")

    def limit(self, value: Any) -> Limit:
        """Tell whether a value is as it should be."""
        if self.states:
            return "red" if value in self.red_states else "green"
        if self.red and not self.red[0] <= value <= self.red[1]:
            return "red"
        return "yellow" if self.yellow and not self.yellow[0] <= value <= self.yellow[1] else "green"


@dataclass(frozen=True)
class Layout:
    """One packet of the dictionary."""

    name: str
    id: int
    version: int
    items: tuple[Item, ...] = ()
    text: str = ""
    severity: Severity = "info"
    armed: bool = False

    def pack(self, **values: Any) -> bytes:
        """Return a packet's data.

        Raises:
            ValueError: a value is missing, unknown, of another type or out of range.
        """
        names = [item.name for item in self.items]
        if sorted(values) != sorted(names):
            raise ValueError(f"{self.name} has the items {names}, got {sorted(values)}")
        return bytes([self.version, self.id]) + b"".join(item.pack(values[item.name]) for item in self.items)

    def unpack(self, data: bytes) -> dict[str, Any]:
        """Return the values in a packet's data, which must be exactly one such packet.

        Raises:
            PacketError: another packet, too few or too many bytes, or a value that is not allowed.
        """
        if data[:2] != bytes([self.version, self.id]):
            raise PacketError(f"expected version {self.version}, id {self.id}, got {data[:2].hex(' ')}")
        values, at = {}, 2
        for item in self.items:
            values[item.name], at = item.unpack(data, at)
        if at != len(data):
            raise PacketError(f"{self.name} has {at} bytes, {len(data)} came")
        return values

    def sentence(self, values: dict[str, Any]) -> str:
        """Return the text with its values in place; bytes in hexadecimal."""
        return self.text.format(**{k: v.hex() if isinstance(v, bytes) else v for k, v in values.items()})

    def item(self, name: str) -> Item:
        return next(item for item in self.items if item.name == name)


@dataclass(frozen=True)
class Dictionary:
    """All packets, by section and name."""

    version: int
    arm_s: float
    telemetry: dict[str, Layout]
    events: dict[str, Layout]
    reports: dict[str, Layout]
    commands: dict[str, Layout]

    def unpack(self, section: str, data: bytes) -> tuple[Layout, dict[str, Any]]:
        """Return the layout and the values of a packet of a section.

        Raises:
            PacketError: not one of the section's packets, or damaged.
        """
        if len(data) < 2:
            raise PacketTooShort(f"a packet of the dictionary has at least 2 bytes, got {len(data)}")
        for layout in getattr(self, section).values():
            if layout.id == data[1]:
                return layout, layout.unpack(data)
        raise PacketError(f"no packet with id {data[1]} among the {section}")


def parse_dictionary(content: bytes) -> Dictionary:
    """Return the dictionary in a YAML text.

    Raises:
        ConfigError: a key is unknown, missing or wrong; the message starts with its path.
    """
    tree = parse_yaml(content, "dictionary")
    sections = ("telemetry", "events", "reports", "commands")
    if not isinstance(tree, dict) or set(tree) != {"version", "arm_s", *sections}:
        raise ConfigError("dictionary", f"expected the keys version, arm_s, {', '.join(sections)}")
    version, arm_s = tree["version"], tree["arm_s"]
    if not (type(version) is int and 0 <= version < 256 and type(arm_s) is int and arm_s > 0):
        raise ConfigError("dictionary", "expected a version of 0 to 255 and a positive arm_s")
    return Dictionary(version, arm_s, *(dict(_layouts(tree[s], s, version)) for s in sections))


def _layouts(tree: Any, section: str, version: int) -> Iterator[tuple[str, Layout]]:
    if not isinstance(tree, dict):
        raise ConfigError(section, "expected a mapping of packets")
    seen = set()
    for name, packet in tree.items():
        path = f"{section}.{name}"
        _require_name(name, path)
        if not isinstance(packet, dict) or not isinstance(packet.get("items", {}), dict):
            raise ConfigError(path, "expected a mapping with an id and items")
        items = tuple(_item(key, item, f"{path}.{key}") for key, item in packet.get("items", {}).items())
        given = {"name": name, "version": version, "items": items, "armed": packet.get("armed", False)}
        if type(given["armed"]) is not bool:
            raise ConfigError(f"{path}.armed", "expected true or false")
        rest = {key: value for key, value in packet.items() if key not in ("items", "armed")}
        layout = build(Layout, rest, path, **given)
        if not 0 <= layout.id < 256 or layout.id in seen:
            raise ConfigError(f"{path}.id", f"expected a number of 0 to 255 of its own, got {layout.id}")
        seen.add(layout.id)
        yield name, layout


def _item(name: Any, tree: Any, path: str) -> Item:
    _require_name(name, path)
    if not isinstance(tree, dict) or not isinstance(tree.get("states", {}), dict):
        raise ConfigError(path, "expected a mapping with a type")
    states = tuple(tree.get("states", {}).items())
    if not all(type(number) is int and isinstance(label, str) for number, label in states):
        raise ConfigError(f"{path}.states", "expected whole numbers and their names")
    rest = {key: value for key, value in tree.items() if key != "states"}
    with keys_below(path, name):
        return build(Item, rest, path, name=name, states=states)


def _require_name(name: Any, path: str) -> None:
    if not (isinstance(name, str) and NAME.fullmatch(name)):
        raise ConfigError(
            path, "expected a name of lower-case letters, digits and _ that begins with a letter"
        )


def _fits(number: int, code: str) -> bool:
    try:
        struct.pack(f">{code}", number)
    except struct.error:
        return False
    return True


def _taken(data: bytes, at: int, size: int) -> bytes:
    if at + size > len(data):
        raise PacketTooShort(f"{size} bytes expected at byte {at}, {len(data) - at} are there")
    return data[at : at + size]


def printable(text: str) -> str:
    """Return the text with everything that a terminal would act on replaced."""
    return "".join(c if c.isprintable() else "?" for c in text)


_FILE = Path(__file__).with_name("dictionary.yaml")
with in_file(_FILE):
    DICTIONARY = parse_dictionary(_FILE.read_bytes())
