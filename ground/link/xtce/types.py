"""The types of XTCE parameters and arguments: how a value is encoded, what it may be, and when it is an alarm."""

import math
import struct
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from typing import Literal

from flightsw.icd.telemetry import NUMBERS, Item

Use = Literal["Parameter", "Argument"]


def element(parent: ET.Element, tag: str, **attributes: str) -> ET.Element:
    """Return a new child."""
    return ET.SubElement(parent, tag, attributes)


def type_of(item: Item, use: Use, name: str) -> ET.Element:
    """Return the type of an item that is one number or a fixed number of bytes, or of one element of an array."""
    if item.kind == "bytes":
        return binary_type(use, name, 8 * item.count)
    return number_type(
        use,
        name,
        code=NUMBERS[item.kind],
        unit=item.unit,
        states=item.states,
        bounds=item.range,
        yellow=item.yellow,
        red=item.red,
        red_states=item.red_states,
    )


def number_type(
    use: Use,
    name: str,
    bits: int = 0,
    *,
    code: str = "",
    unit: str = "",
    states: Sequence[tuple[int, str]] = (),
    bounds: Sequence[float] = (),
    yellow: Sequence[float] = (),
    red: Sequence[float] = (),
    red_states: Sequence[str] = (),
) -> ET.Element:
    """Return the type of a number.

    Args:
        bits: of an unsigned number, where no `code` is given.
        code: the letter of `struct` for its encoding, big-endian.
        states: the numbers that it may be, and their names.
    """
    is_float, is_signed = code in ("f", "d"), code.islower()
    bits = bits or 8 * struct.calcsize(f">{code}")
    kind = "Enumerated" if states else "Float" if is_float else "Integer"
    made = ET.Element(f"{kind}{use}Type", name=f"{name}_type")
    if kind != "Enumerated":
        made.set("sizeInBits", str(bits))
    if kind == "Integer":
        made.set("signed", "true" if is_signed else "false")
    _unit(made, unit)
    encoding = element(made, "FloatDataEncoding" if is_float else "IntegerDataEncoding", sizeInBits=str(bits))
    if not is_float:
        encoding.set("encoding", "twosComplement" if is_signed else "unsigned")
    if states:
        listed = element(made, "EnumerationList")
        for number, label in states:
            element(listed, "Enumeration", value=str(number), label=label)
    elif bounds:
        parent = made if use == "Parameter" else element(made, "ValidRangeSet")
        low, high = _whole(bounds, is_signed, bits) if not is_float else (repr(float(b)) for b in bounds)
        element(parent, "ValidRange", minInclusive=low, maxInclusive=high)
    if use == "Parameter":
        _alarms(made, yellow, red, red_states)
    return made


def text_type(name: str, max_bytes: int, length: str) -> ET.Element:
    """Return the type of a text in UTF-8 whose length in bytes is the parameter `length`."""
    made = ET.Element("StringParameterType", name=f"{name}_type")
    encoding = element(made, "StringDataEncoding", encoding="UTF-8")
    _size(element(encoding, "Variable", maxSizeInBits=str(8 * max_bytes)), length, 0)
    return made


def binary_type(use: Use, name: str, bits: int, length: str = "") -> ET.Element:
    """Return the type of so many bits; or, with `length`, of this parameter's value and one more times as many."""
    made = ET.Element(f"Binary{use}Type", name=f"{name}_type")
    size = element(element(made, "BinaryDataEncoding"), "SizeInBits")
    if length:
        _size(size, length, bits)
    else:
        element(size, "FixedValue").text = str(bits)
    return made


def _size(parent: ET.Element, length: str, more_bits: int) -> None:
    """Say that a size is a parameter's value in bytes, and so many bits more."""
    value = element(parent, "DynamicValue")
    element(value, "ParameterInstanceRef", parameterRef=length)
    element(value, "LinearAdjustment", slope="8", intercept=str(more_bits))


def _unit(made: ET.Element, unit: str) -> None:
    if unit:
        element(element(made, "UnitSet"), "Unit").text = unit


def _alarms(
    made: ET.Element, yellow: Sequence[float], red: Sequence[float], red_states: Sequence[str]
) -> None:
    if red_states:
        listed = element(element(made, "DefaultAlarm"), "EnumerationAlarmList")
        for label in red_states:
            element(listed, "EnumerationAlarm", alarmLevel="critical", enumerationLabel=label)
    elif yellow or red:
        ranges = element(element(made, "DefaultAlarm"), "StaticAlarmRanges")
        for tag, bounds in (("WarningRange", yellow), ("CriticalRange", red)):
            if bounds:
                element(ranges, tag, minInclusive=repr(float(bounds[0])), maxInclusive=repr(float(bounds[1])))


def _whole(bounds: Sequence[float], is_signed: bool, bits: int) -> tuple[str, str]:
    """Return the whole numbers inside the bounds that the encoding can hold."""
    lowest, highest = (-(1 << bits - 1), (1 << bits - 1) - 1) if is_signed else (0, (1 << bits) - 1)
    low = lowest if bounds[0] <= lowest else math.ceil(bounds[0])
    high = highest if bounds[1] >= highest else math.floor(bounds[1])
    return str(low), str(high)
