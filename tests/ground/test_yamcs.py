"""The telemetry in a real Yamcs, with the configuration that `ground yamcs` writes."""

import base64
import random
import struct
from pathlib import Path
from typing import Any

import pytest
import yaml

from flightsw.icd.command import Command, Report
from flightsw.icd.config import ConfigError
from flightsw.icd.packet import APID_HOUSEKEEPING, APID_REPORTS, TELEMETRY, pack_packet
from flightsw.icd.telemetry import DICTIONARY, NUMBERS
from ground.link.forward import Forwarder
from ground.link.yamcs import write_yamcs
from tests.dictionary_packets import exactly, packets, some_value
from tests.yamcs import Yamcs, running_yamcs, wait_for

HOUSEKEEPING = DICTIONARY.telemetry["housekeeping"]
LEVELS = {"IN_LIMITS": "green", "WARNING": "yellow", "CRITICAL": "red"}
PACKETS = 500  # of each kind some thirty; ten thousand were compared once, which takes a minute


def able_to_command(folder: Path) -> None:
    """Let Yamcs make commands, which the configuration does not: into a stream that leads nowhere."""
    file = folder / "etc/processor.yaml"
    processors = yaml.safe_load(file.read_text())
    releaser = {"class": "org.yamcs.StreamTcCommandReleaser", "args": {"stream": "tc_realtime"}}
    processors["realtime"]["services"].append(releaser)
    file.write_text(yaml.safe_dump(processors))


@pytest.fixture(scope="module")
def yamcs(tmp_path_factory):
    with running_yamcs(tmp_path_factory.mktemp("yamcs") / "server", able_to_command) as running:
        yield running


def value_of(value: dict[str, Any]) -> Any:
    """Return a value of Yamcs' JSON: whole numbers of 64 bits come as text, bytes as base64."""
    key, content = next((key, content) for key, content in value.items() if key.endswith("Value"))
    if value["type"] == "ENUMERATED":
        return value["stringValue"]
    if key == "binaryValue":
        return base64.b64decode(content)
    if key == "floatValue":
        return struct.unpack(">f", struct.pack(">f", content))[0]
    return int(content) if key in ("uint64Value", "sint64Value") else content


def test_yamcs_reads_every_packet_as_we_do(yamcs: Yamcs):
    expected = {number: packet for number, packet in enumerate(packets(PACKETS, seed=7))}
    yamcs.send([packet for packet, *_ in expected.values()])
    names = sorted({name for _, _, parameters in expected.values() for name in parameters})
    body = {"ids": [{"name": f"/obbgs/{name}"} for name in names]}
    wait_for(lambda: len(yamcs.ask("/archive/obbgs/packets?limit=1000")["packet"]) >= PACKETS, "archived")
    seen = 0
    for answer in yamcs.stream("/stream-archive/obbgs:streamParameterValues", body):
        values = {p["id"]["name"].rpartition("/")[2]: value_of(p["engValue"]) for p in answer["parameter"]}
        _, _, parameters = expected[values["SRC_SEQ_CTR"]]
        assert exactly(values) == exactly(parameters)
        seen += 1
    assert seen == PACKETS


def test_yamcs_raises_the_dictionary_s_alarms(yamcs: Yamcs):
    rng = random.Random(3)
    items = [item for item in HOUSEKEEPING.items if item.yellow or item.red or item.red_states]
    body = {"id": [{"name": f"/obbgs/housekeeping_{item.name}"} for item in items]}
    levels = set()
    for number in range(12):
        values = {item.name: some_value(rng, item) for item in HOUSEKEEPING.items}
        if number == 0:  # all in limits
            values |= {i.name: type(values[i.name])((i.yellow or i.red)[0]) for i in items if not i.states}
        count = 9000 + number
        yamcs.send([pack_packet(TELEMETRY, APID_HOUSEKEEPING, count, HOUSEKEEPING.pack(**values))])
        is_there = lambda count=count: current(yamcs, "SRC_SEQ_CTR") == count  # noqa: E731
        wait_for(is_there, "the packet is decoded")
        answer = yamcs.ask("/processors/obbgs/realtime/parameters:batchGet", body)["value"]
        for item, value in zip(items, answer, strict=True):
            assert LEVELS[value.get("monitoringResult", "IN_LIMITS")] == item.limit(values[item.name]), item
            levels.add(item.limit(values[item.name]))
    assert levels == {"green", "yellow", "red"}


def current(yamcs: Yamcs, name: str) -> Any:
    return value_of(yamcs.ask(f"/processors/obbgs/realtime/parameters/obbgs/{name}")["engValue"])


def arguments_for(command: Command) -> dict[str, Any]:
    """Return a command's arguments as Yamcs takes them."""
    made: dict[str, Any] = {}
    for item in command.layout.items:
        value = command.arguments[item.name]
        if item.type not in NUMBERS and item.kind in NUMBERS:
            made[f"{item.name}_count"], value = len(value), list(value)
        made[item.name] = value.hex() if isinstance(value, bytes) else value
    return made


def test_yamcs_makes_the_bytes_of_every_command_that_we_seal(yamcs: Yamcs):
    rng = random.Random(5)
    for name, layout in DICTIONARY.commands.items():
        for _ in range(5 if layout.items else 1):
            command = Command(name, {item.name: some_value(rng, item) for item in layout.items})
            body = {"dryRun": True, "args": arguments_for(command)}
            answer = yamcs.ask(f"/processors/obbgs/realtime/commands/obbgs/{name}", body)
            assert base64.b64decode(answer["binary"]) == command.pack(), command


@pytest.mark.parametrize(
    ("stages", "ending"),
    [
        (("accepted", "started", "completed"), {"Accepted": "OK", "Execution": "OK", "Complete": "OK"}),
        (("refused",), {"Failed": "OK", "CommandComplete": "NOK"}),
        (("accepted", "started", "failed"), {"Execution": "OK", "Failed": "OK", "CommandComplete": "NOK"}),
    ],
)
def test_a_command_s_verifiers_follow_our_reports(yamcs: Yamcs, stages, ending):
    issued = yamcs.ask("/processors/obbgs/realtime/commands/obbgs/ping", {"args": {}})
    for number, stage in enumerate(stages):
        report = Report(utc_ns=number, counter=1, digest=bytes(8), stage=stage, text="alive").pack()
        yamcs.send([pack_packet(TELEMETRY, APID_REPORTS, number, report)])

    def history() -> dict[str, Any]:
        entries = yamcs.ask(f"/archive/obbgs/commands/{issued['id']}")["attr"]
        return {entry["name"]: entry["value"].get("stringValue") for entry in entries}

    def has_ended() -> bool:
        return "CommandComplete_Status" in history()

    wait_for(has_ended, "the command ends")
    statuses = {name.removeprefix("Verifier_"): value for name, value in history().items()}
    assert {name: statuses[f"{name}_Status"] for name in ending} == ending


def test_what_is_forwarded_reaches_yamcs(yamcs: Yamcs):
    before = yamcs.packets_received()
    with Forwarder(f"udp://127.0.0.1:{yamcs.telemetry_port}") as forward:
        for packet, *_ in packets(40, seed=9):
            forward.send(packet)
        wait_for(lambda: yamcs.packets_received() == before + 40, "Yamcs receives what is forwarded")
        assert (forward.sent, forward.dropped) == (40, 0)


def test_a_folder_that_is_not_empty_is_left_as_it_is(tmp_path):
    (tmp_path / "mine").write_text("mine")
    with pytest.raises(ConfigError, match="not empty"):
        write_yamcs(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["mine"]


def test_a_folder_that_cannot_be_made_is_an_error_and_leaves_nothing(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match="cannot be written"):
        write_yamcs(tmp_path / "file" / "yamcs")
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_there_is_no_way_for_commands_in_the_configuration_and_only_loopback_sees_its_pages(tmp_path):
    write_yamcs(tmp_path / "yamcs", 1234, 5678)
    instance = yaml.safe_load((tmp_path / "yamcs/etc/yamcs.obbgs.yaml").read_text())
    assert [(link["class"], link["port"]) for link in instance["dataLinks"]] == [
        ("org.yamcs.tctm.UdpTmDataLink", 1234)
    ]
    assert "Releaser" not in (tmp_path / "yamcs/etc/processor.yaml").read_text()
    server = yaml.safe_load((tmp_path / "yamcs/etc/yamcs.yaml").read_text())
    assert server["services"][0]["args"] == {"address": "127.0.0.1", "port": 5678}
    assert (tmp_path / "yamcs/etc/yamcs.yaml").stat().st_mode & 0o077 == 0
