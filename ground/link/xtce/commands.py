"""The part of the XTCE document that describes commands: their arguments, their bytes, and how they are verified.

The bytes are those of the command itself. On the link it travels sealed (flightsw/icd/link/auth.py), with a key that no
other system has: commands are sent by `ground uplink` only. A report carries the counter of its command, which exists
once the command is sealed; XTCE cannot compare it, so the verifiers take the next report, of whatever command.
"""

import xml.etree.ElementTree as ET

from flightsw.icd.config import ConfigError
from flightsw.icd.telemetry import NUMBERS, Dictionary, Item, Layout
from ground.link.xtce.types import element, number_type, type_of

WINDOW_S = 120  # in which a command is verified: as long as `ground uplink` waits by default
VERIFIERS = (  # in the order of the schema: element, container of the report
    ("AcceptedVerifier", "report_accepted"),
    ("ExecutionVerifier", "report_started"),
    ("CompleteVerifier", "report_completed"),
    ("FailedVerifier", "report_not_completed"),
)


def add_commands(root: ET.Element, dictionary: Dictionary) -> None:
    """Add the commands of a dictionary.

    Raises:
        ConfigError: an argument is a text, or two get the same name.
    """
    meta = element(root, "CommandMetaData")
    types = element(meta, "ArgumentTypeSet")
    commands = element(meta, "MetaCommandSet")
    base = element(commands, "MetaCommand", name="command", abstract="true")
    element(element(base, "CommandContainer", name="any_command"), "EntryList")  # Yamcs expects one
    verifiers = element(base, "VerifierSet")
    for tag, report in VERIFIERS:
        verifier = element(verifiers, tag)
        element(verifier, "ContainerRef", containerRef=report)
        window = {"timeToStopChecking": f"PT{WINDOW_S}S", "timeWindowIsRelativeTo": "commandRelease"}
        element(verifier, "CheckWindow", **window)
    for layout in dictionary.commands.values():
        _add_command(commands, types, layout, dictionary.arm_s)
    if len(types) == 0:
        meta.remove(types)  # the schema allows no empty set


def _add_command(commands: ET.Element, types: ET.Element, layout: Layout, arm_s: int | float) -> None:
    made = element(commands, "MetaCommand", name=layout.name)
    armed = f"refused unless armed at most {arm_s} s before" if layout.armed else ""
    if text := "; ".join(part for part in (layout.text, armed) if part):
        made.set("shortDescription", text)
    element(made, "BaseMetaCommand", metaCommandRef="command")
    arguments = element(made, "ArgumentList")
    container = element(made, "CommandContainer", name=layout.name)
    entries = element(container, "EntryList")
    start = bytes([layout.version, layout.id])
    element(entries, "FixedValueEntry", name="version_and_id", binaryValue=start.hex(), sizeInBits="16")
    for item in layout.items:
        _add_argument(arguments, entries, types, f"{layout.name}_{item.name}", item)
    if len(arguments) == 0:
        made.remove(arguments)
    if layout.armed:
        element(made, "DefaultSignificance", consequenceLevel="critical", reasonForWarning=armed)


def _add_argument(
    arguments: ET.Element, entries: ET.Element, types: ET.Element, name: str, item: Item
) -> None:
    if item.kind == "text":
        raise ConfigError(
            f"commands.{name}", "commands with a text cannot be written as XTCE; use bytes or states"
        )
    made = type_of(item, "Argument", name)
    if any(made.get("name") == other.get("name") for other in types):
        raise ConfigError(name, "two arguments of commands get this name in XTCE; give one another name")
    types.append(made)
    described = {"shortDescription": item.text} if item.text else {}
    if item.kind in NUMBERS and item.type not in NUMBERS:
        count = f"{item.name}_count"
        limits = (1 if item.range else 0, item.count)
        types.append(number_type("Argument", f"{name}_count", 8, bounds=limits))
        element(arguments, "Argument", name=count, argumentTypeRef=f"{name}_count_type")
        element(entries, "ArgumentRefEntry", argumentRef=count)
        _add_array(types, made, name, count)
        made = types[-1]
    element(arguments, "Argument", name=item.name, argumentTypeRef=made.get("name", ""), **described)
    element(entries, "ArgumentRefEntry", argumentRef=item.name)


def _add_array(types: ET.Element, of: ET.Element, name: str, count: str) -> None:
    """Add the type of an array with as many elements as the argument `count` says."""
    array = element(types, "ArrayArgumentType", name=f"{name}_array_type", arrayTypeRef=of.get("name", ""))
    dimension = element(element(array, "DimensionList"), "Dimension")
    element(element(dimension, "StartingIndex"), "FixedValue").text = "0"
    last = element(element(dimension, "EndingIndex"), "DynamicValue")
    element(last, "ArgumentInstanceRef", argumentRef=count)
    element(last, "LinearAdjustment", intercept="-1", slope="1")
