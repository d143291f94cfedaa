"""10 million random and mutated bytes into every parser of the link: python -m tests.benchmarks.fuzz

Guided by coverage through atheris where it is installed (`pip install atheris`), else by our own mutator without
guidance. Each target runs in a process of its own. A row is printed only if nothing raised what it should not,
nothing wrong was accepted, every byte was counted, and the process kept within its memory.
"""

# ruff: noqa: E402 - the coverage hook must be in place before the parsers are imported

import argparse
import json
import os
import random
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

try:
    import atheris
except ImportError:
    atheris = None

finders = sys.meta_path.copy()
hook = None
if atheris is not None and "--inside" in sys.argv:
    # what is imported from here on reports its coverage; atheris cannot look into the editable install's loader
    sys.meta_path[:] = [f for f in finders if type(f).__name__ != "ScikitBuildRedirectingFinder"]
    hook = atheris.instrument_imports(  # type: ignore[attr-defined]
        include=["flightsw", "ground", "cfdppy", "spacepackets", "isotp"]
    )
    hook.__enter__()

import zlib

import isotp

from flightsw.downlink.commands import Commander, KeyRing
from flightsw.icd.command import Command, Report
from flightsw.icd.config import ConfigError
from flightsw.icd.frame import CRC, HEADER, MAX_PIXELS, decode_frame
from flightsw.icd.link.auth import Key, seal, seal_file, unseal, unseal_file
from flightsw.icd.link.can import FLIGHT_IDS, GROUND_IDS, MAX_MESSAGE_BYTES, IsoTpChannels
from flightsw.icd.link.framing import Deframer, PacketStream, frame_packet, max_frame_bytes
from flightsw.icd.link.link_url import parse_link_url
from flightsw.icd.link.slcan import FD_SIZES, SlcanText, format_slcan
from flightsw.icd.mission import load_mission
from flightsw.icd.packet import (
    APID_EVENTS,
    APID_FILES,
    APID_FRAME_HEADERS,
    APID_HOUSEKEEPING,
    APID_REPORTS,
    TELECOMMAND,
    TELEMETRY,
    PacketError,
    unpack_packet,
)
from flightsw.icd.telemetry import DICTIONARY, NUMBERS, Item
from flightsw.icd.transfer import Receiver, Sender, parse_pdu
from flightsw.storage.store import open_store
from ground.link.uplink import Uplinker, parse_command
from ground.session.telemetry import TelemetryLog

if hook is not None:
    hook.__exit__(None, None, None)
    sys.meta_path[:] = finders

from tests.link_trial import noise_containers

MAX_INPUT_BYTES = 4096
MAX_PACKET_BYTES = 300
MAX_GROWTH_MB = 150  # of resident memory after the first tenth; the fuzzer's own corpus is in it
INTERVAL_S = 0.5
URLS = [parse_link_url(f"slcan:///dev/null?fd={fd}") for fd in (0, 1)]


@dataclass
class Target:
    """A parser: inputs that it takes, and a check that raises when it misbehaves."""

    seeds: list[bytes]
    check: Callable[[bytes], None]
    accepted: dict[str, int] = field(default_factory=dict)  # what got through, for the row


def transfer_pdus(files: list[bytes]) -> tuple[list[bytes], list[bytes]]:
    """Return the PDUs of a lossy transfer, down and up, with NAKs and everything."""
    received: dict[str, bytes] = {}
    sender = Sender(MAX_PACKET_BYTES - 6, INTERVAL_S)
    receiver = Receiver(
        MAX_PACKET_BYTES - 6, INTERVAL_S, lambda name, data: received.update({name: data}) is None
    )
    for number, content in enumerate(files):
        sender.put(f"{number:08d}.obf", content, number + 1, 0.0)
    down, up = [], []
    for step in range(3000):
        now_s = step * 0.01
        if (pdu := sender.next_pdu(now_s)) is not None:
            down.append(pdu)
            if len(down) % 7:
                receiver.receive(pdu, now_s)
        if (pdu := receiver.next_pdu(now_s)) is not None:
            up.append(pdu)
            sender.receive(pdu, now_s)
    assert set(received.values()) == set(files)
    return down, up


def chunks(data: bytes) -> list[bytes]:
    """Return the parts of an input: each has its length in two bytes before it."""
    parts = []
    while len(data) > 2:
        size = int.from_bytes(data[:2], "big") % 1024
        parts.append(data[2 : 2 + size])
        data = data[2 + size :]
    return parts


def joined(parts: list[bytes]) -> bytes:
    return b"".join(len(part).to_bytes(2, "big") + part for part in parts)


def framing(containers: list[bytes]) -> Target:
    stream = PacketStream(TELEMETRY, MAX_PACKET_BYTES)
    target = Target([stream.encode(APID_FILES, bytes(range(n))) * 2 for n in (1, 20, 256)], lambda data: None)

    def check(data: bytes) -> None:
        deframer = Deframer(MAX_PACKET_BYTES)
        for part in (data[:7], data[7:300], data[300:]):
            for packet in deframer.feed(part):
                target.accepted["packets"] = target.accepted.get("packets", 0) + 1
                assert len(packet) <= MAX_PACKET_BYTES + 3 and frame_packet(packet)
                try:
                    header, content = unpack_packet(packet)
                    assert header.data_length + 1 == len(content)
                except PacketError:
                    pass
        assert deframer.pending_bytes <= max_frame_bytes(MAX_PACKET_BYTES)
        counted = (
            deframer.packet_bytes
            + deframer.idle_bytes
            + deframer.joined_bytes
            + deframer.skipped_bytes
            + deframer.pending_bytes
        )
        assert counted == len(data), f"{counted} of {len(data)} bytes counted"

    target.check = check
    return target


def container(containers: list[bytes]) -> Target:
    originals = set(containers)
    target = Target(containers, lambda data: None)

    def check(data: bytes) -> None:
        for candidate in (data, data[: -CRC.size] + CRC.pack(zlib.crc32(data[: -CRC.size]))):
            try:
                frame = decode_frame(candidate)
            except PacketError:
                continue
            target.accepted["frames"] = target.accepted.get("frames", 0) + 1
            assert frame.dn.size <= 3 * MAX_PIXELS
            assert candidate is not data or data in originals, "a frame was accepted that nobody sent"

    target.check = check
    return target


def cfdp(containers: list[bytes]) -> Target:
    down, up = transfer_pdus(containers[:2])
    seeds = [joined(part) for part in (down[:6], down[-8:], up[:6], up[-6:], down[:4] + up[:2])]
    target = Target(seeds, lambda data: None)
    originals = set(containers)

    def accept(name: str, content: bytes) -> bool:
        target.accepted["files"] = target.accepted.get("files", 0) + 1
        try:
            decode_frame(content)
        except PacketError:
            return True
        assert content in originals, "a frame was accepted that nobody sent"
        return True

    def check(data: bytes) -> None:
        receiver = Receiver(MAX_PACKET_BYTES, INTERVAL_S, accept, max_file_bytes=1 << 20, max_open=4)
        sender = Sender(MAX_PACKET_BYTES, INTERVAL_S)
        sender.put("00000000.obf", containers[0], 1, 0.0)
        for number, part in enumerate(chunks(data)):
            try:
                assert parse_pdu(part).packet_len == len(part)
                target.accepted["pdus"] = target.accepted.get("pdus", 0) + 1
            except PacketError:
                pass
            for side in (receiver, sender):
                side.receive(part, number * 0.3)
                for _ in range(20):
                    if side.next_pdu(number * 0.3) is None:
                        break
            assert receiver.open_transactions <= 4

    target.check = check
    return target


def pipeline(containers: list[bytes]) -> Target:
    """Everything between the port and the session: what is stored must be what was sent."""
    stream = PacketStream(TELEMETRY, MAX_PACKET_BYTES)
    down, _ = transfer_pdus(containers[:2])
    wire = b"".join(stream.encode(APID_FILES, pdu) for pdu in down)
    target = Target([wire[:MAX_INPUT_BYTES], wire[-MAX_INPUT_BYTES:], wire], lambda data: None)
    originals = set(containers)

    def accept(name: str, content: bytes) -> bool:
        try:
            decode_frame(content)
        except PacketError:
            return True
        target.accepted["frames"] = target.accepted.get("frames", 0) + 1
        assert content in originals, "a frame was accepted that nobody sent"
        return True

    def check(data: bytes) -> None:
        ground = PacketStream(TELECOMMAND, MAX_PACKET_BYTES)
        receiver = Receiver(MAX_PACKET_BYTES, INTERVAL_S, accept, max_file_bytes=1 << 20, max_open=4)
        for number, (apid, content) in enumerate(ground.decode(data)):
            if apid == APID_FILES:
                receiver.receive(content, number * 0.01)
                receiver.next_pdu(number * 0.01)
        d = ground.deframer
        assert d.packet_bytes + d.idle_bytes + d.joined_bytes + d.skipped_bytes + d.pending_bytes == len(data)

    target.check = check
    return target


def slcan(containers: list[bytes]) -> Target:
    frames = [
        isotp.CanMessage(FLIGHT_IDS[0], 8, bytes(range(8))),
        isotp.CanMessage(1 << 28, 0, b"", extended_id=True),
    ]
    frames += [isotp.CanMessage(5, 15, bytes(64), is_fd=True, bitrate_switch=brs) for brs in (False, True)]
    text = [format_slcan(frame) for frame in frames]
    target = Target([*text, b"".join(text) + b"z\r\a\r"], lambda data: None)

    def check(data: bytes) -> None:
        reader = SlcanText()
        for part in (data[:5], data[5:200], data[200:]):
            for frame in reader.feed(part):
                target.accepted["can_frames"] = target.accepted.get("can_frames", 0) + 1
                assert len(frame.data) == FD_SIZES[frame.dlc]
                assert format_slcan(frame).lower() in (b"\r" + data.replace(b"\a", b"")).lower()
        assert reader.pending_bytes <= SlcanText.MAX_LINE_BYTES
        counted = reader.frame_bytes + reader.reply_bytes + reader.skipped_bytes + reader.pending_bytes
        assert counted == len(data), f"{counted} of {len(data)} bytes counted"

    target.check = check
    return target


def iso_tp(containers: list[bytes]) -> Target:
    seeds = []
    for url in URLS:
        flight, ground = (
            IsoTpChannels(FLIGHT_IDS, GROUND_IDS, url),
            IsoTpChannels(GROUND_IDS, FLIGHT_IDS, url),
        )
        flight.write(frame_packet(bytes(range(1, 200))) + frame_packet(b"short"))
        _, sent = flight.exchange([], 0.0)
        parts = []
        while sent:
            parts += [bytes([frame.arbitration_id - FLIGHT_IDS[0]]) + frame.data for frame in sent]
            _, answers = ground.exchange(sent, 0.0)
            _, sent = flight.exchange(answers, 0.0)
        seeds.append(bytes([url.fd]) + joined(parts))
    target = Target(seeds, lambda data: None)

    def check(data: bytes) -> None:
        channels = IsoTpChannels(GROUND_IDS, FLIGHT_IDS, URLS[data[0] & 1 if data else 0])
        channels.write(frame_packet(bytes(range(1, 100))))  # so that flow control has something to control
        carried = yielded = 0
        for part in chunks(data[1:]):
            size = max(size for size in FD_SIZES if size <= max(len(part) - 1, 0))
            number = FLIGHT_IDS[0] + (part[0] % 9 if part else 0)
            packets, _ = channels.exchange(
                [isotp.CanMessage(number, FD_SIZES.index(size), part[1 : 1 + size])], 0.0
            )
            carried, yielded = carried + size, yielded + len(packets) - packets.count(b"\0")
        target.accepted["message_bytes"] = target.accepted.get("message_bytes", 0) + yielded
        assert yielded <= carried
        assert all(channel.received_bytes <= MAX_MESSAGE_BYTES for channel in channels._channels.values())

    target.check = check
    return target


def telemetry(containers: list[bytes]) -> Target:
    """Housekeeping, events, commands and reports by the dictionary, and sealed commands."""
    key = Key(7, bytes(range(32)))
    command = Command("ping", {}).pack()
    sealed = seal(key, 7, command)
    target = Target([command, sealed, bytes(200), bytes(range(120))], lambda data: None)
    sections = [partial(DICTIONARY.unpack, name) for name in ("telemetry", "events", "reports", "commands")]
    unpackers = [Command.unpack, Report.unpack, *sections]

    def check(data: bytes) -> None:
        for unpack in unpackers:
            try:
                unpack(data)
                target.accepted["packets"] = target.accepted.get("packets", 0) + 1
            except PacketError:
                pass
        try:
            unseal(key, data)
        except PacketError:
            return
        assert data == sealed, "a sealed command was accepted that nobody sealed"

    target.check = check
    return target


def auth(containers: list[bytes]) -> Target:
    """The texts of a key and its counter, sealed packets and sealed files."""
    key = Key(7, bytes(range(32)))
    sealed, file = seal(key, 7, b"content"), seal_file(key.secret, b"content")
    target = Target([key.text.encode(), key.counter_text(7).encode(), sealed, file], lambda data: None)

    def check(data: bytes) -> None:
        accepted = target.accepted
        text = data.decode("utf-8", "replace")
        try:
            again = Key.parse(text, "key")
            accepted["keys"] = accepted.get("keys", 0) + 1
            assert Key.parse(again.text, "key") == again
        except ConfigError as error:
            assert not any(part in str(error) for part in text.split() if len(part) > 16), (
                "the secret is told"
            )
        try:
            assert 0 <= key.parse_counter(text, "counter") < 1 << 64
            assert key.fingerprint in text, "another key's counter was accepted"
            accepted["counters"] = accepted.get("counters", 0) + 1
        except ConfigError:
            pass
        for opened, original in ((partial(unseal, key), sealed), (partial(unseal_file, key.secret), file)):
            try:
                opened(data)
            except PacketError:
                continue
            assert data == original, "something sealed was accepted that nobody sealed"
            accepted["sealed"] = accepted.get("sealed", 0) + 1

    target.check = check
    return target


def commander(containers: list[bytes]) -> Target:
    """Commands on board: packets from anybody, and nonsense from the one who has the key."""
    folder, key = Path(tempfile.mkdtemp()), Key(7, bytes(range(32)))
    (folder / "key").write_text(key.text)
    (folder / "key.received").write_text(key.counter_text(0))
    mission = load_mission("mission.yaml")
    arguments = [{"exposure_times_ms": (0.1, 0.2)}, {"near": 2}, {"order": "triage"}, {"command": "delete"}]
    names = ["bracket", "near", "priority", "arm"]
    plain = [Command(name, given).pack() for name, given in zip(names, arguments, strict=True)]
    plain += [Command(name, {}).pack() for name in ("ping", "safe", "resume")]
    plain.append(Command("delete", {"first_frame": 0, "last_frame": 5}).pack())
    seeds = [joined(plain[:4]), joined(plain[4:]), *(seal(key, 1 << 40, command) for command in plain)]
    target = Target(seeds, lambda data: None)
    on_board = Commander(KeyRing([folder / "key"]), open_store(folder / "store", mission), mission)

    def check(data: bytes) -> None:
        before = (on_board.last_counter, on_board.settings)
        handled = on_board.refused + on_board.repeated
        on_board.receive(data)
        if data not in seeds:
            assert (on_board.last_counter, on_board.settings) == before, (
                "a command was obeyed that nobody sealed"
            )
            assert on_board.refused + on_board.repeated == handled + 1
        for part in chunks(data)[:8]:
            counted = on_board.accepted + on_board.refused
            on_board.receive(seal(key, on_board.last_counter + 1, part))
            assert on_board.accepted + on_board.refused == counted + 1
        target.accepted = {"commands": on_board.accepted, "refused": on_board.refused}
        on_board.reports.clear()  # as the downlink takes them out

    target.check = check
    return target


def sample(item: Item) -> Any:
    """Return a value that an item of the dictionary may have."""
    if item.states:
        return item.states[0][1]
    number = item.range[0] if item.range else 1
    return {"text": "a", "bytes": bytes(item.count)}.get(
        item.kind, number if item.type in NUMBERS else (number,)
    )


def ground_telemetry(containers: list[bytes]) -> Target:
    """What the ground writes down of telemetry: every line must be JSON that can be read again."""
    folder = Path(tempfile.mkdtemp())
    apids = [APID_HOUSEKEEPING, APID_EVENTS, APID_REPORTS, APID_FRAME_HEADERS, 0x7FF]
    report = Report(1, 7, bytes(8), "accepted", "ping").pack()
    event = DICTIONARY.events["transfer_failed"].pack(utc_ns=5, file="a", reason="b")
    values = {item.name: sample(item) for item in DICTIONARY.telemetry["housekeeping"].items}
    housekeeping = DICTIONARY.telemetry["housekeeping"].pack(**values)
    seeds = [bytes([number]) + data for number, data in enumerate((housekeeping, event, report))]
    seeds.append(bytes([3]) + containers[0][: HEADER.size])
    target = Target(seeds, lambda data: None)

    def check(data: bytes) -> None:
        uplinker = Uplinker(folder, MAX_PACKET_BYTES, INTERVAL_S)
        heard = []
        log = TelemetryLog(folder, heard.append, lambda report: uplinker.take_report(report, 0.0))
        for apid in (apids[data[0] % len(apids)], *apids) if data else ():
            log.add(apid, data[1:])
        lines = 0
        for path in folder.glob("*.jsonl"):
            content = path.read_bytes()
            path.unlink()
            lines += len([json.loads(line) for line in content.splitlines()])
        assert log.write_failures == 0
        assert lines + log.refused == (1 + len(apids) if data else 0), "a packet was neither kept nor counted"
        assert len(heard) == len(log.events)
        target.accepted["packets"] = target.accepted.get("packets", 0) + lines

    target.check = check
    return target


def uplink(containers: list[bytes]) -> Target:
    """The operator's command line, and the files that `ground uplink` leaves for the listener."""
    session = Path(tempfile.mkdtemp())
    job = session / "uplink" / f"{7:020d}.json"
    job.parent.mkdir()
    text = json.dumps(
        {"packet": bytes(60).hex(), "command": "ping", "boot": "", "expires_ns": 1 << 62}
    ).encode()
    words = [
        "ping",
        "bracket\0000.05,0.1",
        "near\0002",
        "priority\000triage",
        "arm\000delete",
        "delete\0001\0002",
    ]
    hostile = [text.replace(str(1 << 62).encode(), b"Infinity"), b"[" * MAX_INPUT_BYTES]
    target = Target([text, *hostile, *(word.encode() for word in words)], lambda data: None)

    def check(data: bytes) -> None:
        name, *arguments = data.decode("utf-8", "replace").split("\0")
        try:
            command, _ = parse_command(name, arguments)
            if name != "model":  # its arguments come from the file
                packed = command.pack()
                assert Command.unpack(packed).pack() == packed
            target.accepted["command_lines"] = target.accepted.get("command_lines", 0) + 1
        except ValueError:
            pass
        job.write_bytes(data)
        uplinker = Uplinker(session, MAX_PACKET_BYTES, INTERVAL_S, utc_ns=lambda: 0)
        packet = uplinker.next_command(0.0)
        assert packet is not None or not job.exists() or uplinker.jobs == {}
        if packet is not None:
            assert json.loads(data)["packet"].lower().replace(" ", "") == packet.hex()
            target.accepted["jobs"] = target.accepted.get("jobs", 0) + 1

    target.check = check
    return target


PARSERS = (
    framing,
    container,
    cfdp,
    pipeline,
    slcan,
    iso_tp,
    telemetry,
    auth,
    commander,
    ground_telemetry,
    uplink,
)
TARGETS = {f.__name__: f for f in PARSERS}


def mutated(seeds: list[bytes], source: random.Random) -> bytes:
    """Return a seed with a few random changes, or random bytes."""
    if source.random() < 0.1:
        return source.randbytes(source.randrange(1, 400))
    data = bytearray(source.choice(seeds))
    for _ in range(source.choice((1, 1, 2, 4, 16))):
        at = source.randrange(len(data) + 1)
        action = source.randrange(6)
        if action == 0 and data:
            data[at % len(data)] ^= 1 << source.randrange(8)
        elif action == 1 and data:
            data[at % len(data)] = source.choice((0, 1, 0x7F, 0x80, 0xFF, 13))
        elif action == 2:
            data[at:at] = source.randbytes(source.randrange(1, 9))
        elif action == 3:
            del data[at : at + source.randrange(1, 40)]
        elif action == 4:
            other = source.choice(seeds)
            data[at:] = other[source.randrange(len(other)) :]
        else:
            data[at:at] = data[at : at + source.randrange(1, 60)]
    return bytes(data[:MAX_INPUT_BYTES])


def rss_mb() -> float:
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize() / 2**20


def run_target(name: str, total_bytes: int, guided: bool) -> None:
    """Feed one parser until `total_bytes` have gone in, print its row and end the process."""
    target = TARGETS[name](noise_containers(3, 16))
    state = {"bytes": 0, "inputs": 0, "before_mb": 0.0}
    began_s = time.monotonic()

    def feed(data: bytes) -> None:
        target.check(data)
        state["bytes"] += len(data)
        state["inputs"] += 1
        if not state["before_mb"] and state["bytes"] > total_bytes / 10:
            state["before_mb"] = rss_mb()
        if state["bytes"] >= total_bytes:
            growth_mb = rss_mb() - state["before_mb"]
            assert growth_mb < MAX_GROWTH_MB, f"memory grew by {growth_mb:.0f} MB"
            row = {
                "parser": name,
                "guided": guided,
                "inputs": state["inputs"],
                "bytes": state["bytes"],
                "accepted": target.accepted,
                "crashes": 0,
                "memory_growth_mb": round(growth_mb, 1),
                "seconds": round(time.monotonic() - began_s, 1),
            }
            print("ROW " + json.dumps(row), flush=True)
            os._exit(0)  # atheris has no other end

    for seed in target.seeds:
        target.check(seed)
    if guided:
        assert atheris is not None
        with tempfile.TemporaryDirectory() as corpus:
            for number, seed in enumerate(target.seeds):
                (Path(corpus) / str(number)).write_bytes(seed)
            arguments = [
                sys.argv[0],
                corpus,
                f"-max_len={MAX_INPUT_BYTES}",
                "-seed=1",
                "-len_control=0",
                "-verbosity=0",
                "-rss_limit_mb=2048",
            ]
            atheris.Setup(arguments, feed)
            atheris.Fuzz()
    source = random.Random(1)
    while True:
        feed(mutated(target.seeds, source))


def main() -> int:
    parser = argparse.ArgumentParser(description="Random and mutated bytes into every parser of the link.")
    parser.add_argument("--json", action="store_true", help="one JSON object a row")
    parser.add_argument("--bytes", type=int, default=10_000_000, help="into each parser")
    parser.add_argument("--target", choices=TARGETS, help="only this parser")
    parser.add_argument(
        "--unguided", action="store_true", help="our own mutator although atheris is installed"
    )
    parser.add_argument("--inside", action="store_true", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    guided = atheris is not None and not arguments.unguided
    if arguments.inside:
        run_target(arguments.target, arguments.bytes, guided)
    failed = 0
    for name in [arguments.target] if arguments.target else TARGETS:
        command = [sys.executable, "-m", "tests.benchmarks.fuzz", "--inside", "--target", name]
        command += ["--bytes", str(arguments.bytes)] + ["--unguided"] * (not guided)
        with tempfile.TemporaryDirectory(dir="/dev/shm" if os.path.isdir("/dev/shm") else None) as scratch:
            environment = os.environ | {"TMPDIR": scratch}
            done = subprocess.run(command, capture_output=True, text=True, errors="replace", env=environment)
        rows = [line[4:] for line in done.stdout.splitlines() if line.startswith("ROW ")]
        if not rows:
            failed += 1
            print(f"{name}: failed\n{done.stdout[-3000:]}\n{done.stderr[-3000:]}", file=sys.stderr)
            continue
        row = json.loads(rows[0])
        print(rows[0] if arguments.json else "  ".join(f"{k} {v}" for k, v in row.items()), flush=True)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
