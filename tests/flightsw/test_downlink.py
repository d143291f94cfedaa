"""What the flight side puts on the wire, in which order, without a port: a link of lists and a clock of ours."""

import dataclasses
import hashlib
import logging
import os
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import pytest
from spacepackets.cfdp.pdu import FileDataPdu, MetadataPdu

from flightsw.downlink.commands import KeyRing
from flightsw.downlink.housekeeping import MAX_EVENTS, EventLog, ProcessMeter
from flightsw.downlink.loop import LAST_TELEMETRY_S, RESTARTS, WAIT_S, run_downlink
from flightsw.errors import DownlinkError
from flightsw.icd.command import Command, model_file_name
from flightsw.icd.frame import HEADER, read_header
from flightsw.icd.link.auth import Key, seal, seal_file
from flightsw.icd.link.framing import PacketStream
from flightsw.icd.packet import (
    APID_COMMANDS,
    APID_EVENTS,
    APID_FILES,
    APID_FRAME_HEADERS,
    APID_HOUSEKEEPING,
    APID_REPORTS,
    APID_UPLINK_FILES,
    TELECOMMAND,
)
from flightsw.icd.telemetry import DICTIONARY
from flightsw.icd.transfer import UPLINK, Receiver, Sender, Verdict, answer_key, parse_pdu
from flightsw.icd.transfer.checksum import TYPES
from flightsw.storage.settings import Settings, save_settings
from flightsw.storage.store import FrameStore
from flightsw.triage.worker import ModelProcess
from ground.link.uplink import make_key


class ListLink:
    """Keeps what is written, gives what is laid into `incoming`; each exchange takes its time on our clock."""

    baud_rate = 3_000_000
    bytes_read = bytes_written = hang_ups = 0
    connected = ready = True
    losses: dict[str, int] = {}  # noqa: RUF012

    def __init__(self):
        self.written: list[bytes] = []
        self.incoming: list[bytes] = []
        self.now_s = 0.0

    def write(self, data: bytes) -> None:
        self.written.append(data)

    def exchange(self, timeout_s: float) -> bytes:
        self.now_s += timeout_s + 0.001
        return self.incoming.pop(0) if self.incoming else b""

    def packets(self) -> list[tuple[int, bytes]]:
        return PacketStream(TELECOMMAND, 1100).decode(b"".join(self.written))

    def files(self) -> list[str]:
        """Return the names of the files in the order in which they began."""
        pdus = [parse_pdu(data) for apid, data in self.packets() if apid == APID_FILES]
        return [pdu.dest_file_name for pdu in pdus if isinstance(pdu, MetadataPdu)]

    def unpacked(self, apid: int, section: str) -> list[tuple[str, dict]]:
        unpacked = [DICTIONARY.unpack(section, data) for number, data in self.packets() if number == apid]
        return [(layout.name, values) for layout, values in unpacked]

    def close(self) -> None:
        pass

    def __enter__(self):
        return self

    def __exit__(self, *_: object) -> None:
        pass


def fly(link: ListLink, store: FrameStore, mission, until_s: float, **arguments):
    return run_downlink(
        store,
        link,
        mission,
        should_stop=lambda: link.now_s > until_s,
        clock_s=lambda: link.now_s,
        **arguments,
    )


@pytest.fixture
def store(tmp_path, make_frame) -> FrameStore:
    made = FrameStore(tmp_path / "store")
    for number in range(3):
        made.put(make_frame(number, size_px=200))
    return made


def test_headers_go_at_once_then_thumbnails_then_pictures(store, small_mission):
    link = ListLink()
    fly(link, store, small_mission, 0.5)
    assert link.files()[:6] == [f"{n:08d}.{kind}" for kind in ("obt", "obf") for n in range(3)]
    order = [apid for apid, _ in link.packets()]
    assert order[0] == APID_EVENTS  # that the software has started
    assert max(i for i, apid in enumerate(order) if apid == APID_FRAME_HEADERS) < order.index(APID_FILES)
    headers = [data for apid, data in link.packets() if apid == APID_FRAME_HEADERS]
    assert headers == [store.read(number)[: HEADER.size] for number in range(3)]
    assert [read_header(data)["frame_id"] for data in headers] == [0, 1, 2]


@pytest.mark.parametrize("files", [1, 2])
def test_no_more_files_are_under_way_than_the_mission_file_allows(store, small_mission, files):
    save_settings(store.folder, Settings("oldest"))
    link = ListLink()
    mission = dataclasses.replace(
        small_mission, link=dataclasses.replace(small_mission.link, files_in_flight=files)
    )
    fly(link, store, mission, 0.5)
    assert len(set(link.files())) == files  # nobody answers, so that none ends


@pytest.mark.parametrize("checksum", ["crc-32", "crc-32c", "modular"])
def test_files_carry_the_checksum_that_the_mission_file_asks_for(store, small_mission, checksum):
    link = ListLink()
    mission = dataclasses.replace(
        small_mission, link=dataclasses.replace(small_mission.link, checksum=checksum)
    )
    fly(link, store, mission, 0.3)
    pdus = [parse_pdu(data) for apid, data in link.packets() if apid == APID_FILES]
    assert {pdu.checksum_type for pdu in pdus if isinstance(pdu, MetadataPdu)} == {TYPES[checksum]}


def test_in_the_order_oldest_there_are_no_thumbnails(store, small_mission):
    save_settings(store.folder, Settings("oldest"))
    link = ListLink()
    fly(link, store, small_mission, 0.5)
    assert link.files()[:3] == ["00000000.obf", "00000001.obf", "00000002.obf"]
    assert not any(name.endswith(".obt") for name in link.files())


def test_little_is_put_ahead_of_the_wire_so_that_the_order_can_still_change(
    tmp_path, small_mission, make_frame
):
    store = FrameStore(tmp_path / "store")
    for number in range(8):
        store.put(make_frame(number))
    save_settings(store.folder, Settings("oldest"))
    link = ListLink()
    link.ready = False  # the wire takes nothing
    progress = fly(link, store, small_mission, 1.0)
    assert (progress.waiting, progress.in_flight) == (8, 2)


def test_housekeeping_comes_in_its_interval_and_says_what_is_so(store, small_mission):
    link = ListLink()
    capture_values = {"camera": "capturing", "frames_failed": 4}
    fly(link, store, small_mission, 5.5, capture_values=lambda: capture_values, boot=7)
    packets = link.unpacked(APID_HOUSEKEEPING, "telemetry")
    assert len(packets) == 7  # at 0, 1, 2, 3, 4, 5 s and at the end
    name, values = packets[-1]
    assert name == "housekeeping"
    assert (values["frames_stored"], values["outbox_frames"], values["delivered"]) == (3, 3, 0)
    assert (values["camera"], values["frames_failed"], values["mode"]) == ("capturing", 4, "normal")
    assert values["exposure_times_ms"] == small_mission.bracket.exposure_times_ms
    assert values["store_bytes"] == sum(frame.size_bytes for frame in store.frames)
    assert values["priority"] == "thumbnail-first" and values["model"] == bytes(4)
    assert (values["uptime_s"], values["boot"], values["restarts"]) == (5, 7, 0)


def test_a_start_tells_what_the_store_holds_although_it_is_opened_later(store, small_mission):
    """As at every start of `flightsw`: the link comes first, and the store is read while telemetry goes on."""
    again, link = FrameStore(store.folder, open_now=False), ListLink()
    fly(link, again, small_mission, 0.5, store_may_open=lambda: link.now_s > 0.2)
    (name, values), *_ = link.unpacked(APID_EVENTS, "events")
    assert (name, values["frames_stored"], values["outbox_frames"]) == ("started", 3, 3)


def test_warnings_of_any_part_become_events_and_the_end_is_told(store, small_mission):
    link = ListLink()

    def warn(_progress) -> None:
        if link.now_s < 0.001:
            logging.getLogger("flightsw.capture.sequencer").warning("bracket %d lost\x1b[2J", 7)

    fly(link, store, small_mission, 0.5, on_progress=warn)
    events = link.unpacked(APID_EVENTS, "events")
    assert [name for name, _ in events] == ["started", "warning", "stopped"]
    assert events[1][1]["problem"] == "bracket 7 lost?[2J"
    assert logging.getLogger("flightsw").handlers == []


def test_a_port_that_takes_nothing_does_not_keep_the_software_from_ending(store, small_mission):
    link = ListLink()
    link.ready = False
    fly(link, store, small_mission, 1.0)
    assert link.written == []
    assert link.now_s < 1.0 + LAST_TELEMETRY_S + 3 * WAIT_S


def test_a_flood_of_forged_commands_is_counted_and_does_not_fill_the_downlink(store, small_mission, tmp_path):
    make_key(tmp_path / "k")
    keys = KeyRing([tmp_path / "k"])
    link, ground = ListLink(), PacketStream(TELECOMMAND, 1100)
    link.incoming = [b"".join(ground.encode(APID_COMMANDS, bytes(50)) for _ in range(5)) for _ in range(100)]
    progress = fly(link, store, small_mission, 3.5, keys=keys)
    keys.close()
    assert progress.commands_refused == 500
    refusals = [name for name, _ in link.unpacked(APID_EVENTS, "events") if name == "command_refused"]
    assert 1 <= len(refusals) <= 4
    assert link.unpacked(APID_HOUSEKEEPING, "telemetry")[-1][1]["commands_refused"] == 500


def test_a_file_that_no_command_announced_is_not_even_kept_in_memory(store, small_mission):
    link, ground = ListLink(), PacketStream(TELECOMMAND, 1100)
    sender = Sender(ground.max_data_bytes, 1.0, route=UPLINK)
    sender.put("model-1", bytes(5000), 1, 0.0)
    while (pdu := sender.next_pdu(0.0)) is not None:
        link.incoming.append(ground.encode(APID_UPLINK_FILES, pdu))
    assert len(link.incoming) > 5
    fly(link, store, small_mission, 1.0)
    assert not [apid for apid, _ in link.packets() if apid == APID_UPLINK_FILES]  # not a word of answer
    assert {path.name for path in store.folder.iterdir()} >= {"frames", "outbox"}
    assert not list(store.folder.glob("*model*"))


def model_packets(ground: PacketStream, key: Key, counter: int, content: bytes) -> list[bytes]:
    """Return what the ground sends of a model, on a link that loses nothing: the command, then the sealed file."""
    sha256, file_key = hashlib.sha256(content).digest(), bytes(range(32))
    command = Command("model", {"size_bytes": len(content), "sha256": sha256, "file_key": file_key})
    sender = Sender(ground.max_data_bytes, 1.0, route=UPLINK)
    sender.put(model_file_name(counter), seal_file(file_key, content), counter, 0.0)
    packets = [ground.encode(APID_COMMANDS, seal(key, counter, command.pack()))]
    while (pdu := sender.next_pdu(0.0)) is not None:
        packets.append(ground.encode(APID_UPLINK_FILES, pdu))
    return packets


class HeldTriage:
    """Lets no model be verified before `go` is set, as a slow onnxruntime would."""

    def __init__(self, monkeypatch):
        self.go = threading.Event()

        def begin(process: ModelProcess) -> dict[str, Any]:
            self.go.wait(30)
            return begin_at_once(process)

        begin_at_once = ModelProcess.begin
        monkeypatch.setattr(ModelProcess, "begin", begin)


def ends(link: ListLink) -> dict[int, tuple[str, str]]:
    """Return stage and text of the last report of each command."""
    reports = [values for _, values in link.unpacked(APID_REPORTS, "reports")]
    return {values["counter"]: (values["stage"], values["text"]) for values in reports}


def test_a_model_that_is_verified_late_ends_its_own_command(store, small_mission, tmp_path, monkeypatch):
    held, link, ground = HeldTriage(monkeypatch), ListLink(), PacketStream(TELECOMMAND, 1100)
    key, keys = make_key(tmp_path / "k"), KeyRing([tmp_path / "k"])
    for number in (1, 2):  # the second comes while the first is being verified
        link.incoming += model_packets(ground, key, number, bytes([number]) * 3000)

    def should_stop() -> bool:
        if not link.incoming:
            held.go.set()
        time.sleep(0.001)  # the thread that verifies has a clock of its own
        return link.now_s > 600 or [end[0] for end in ends(link).values()] == ["failed", "failed"]

    run_downlink(store, link, small_mission, should_stop=should_stop, clock_s=lambda: link.now_s, keys=keys)
    keys.close()
    for number, (stage, text) in ends(link).items():
        assert stage == "failed" and f"model-{number}.received is not" in text
    assert not list(store.folder.glob("model*"))


def test_a_model_that_waits_for_its_verification_when_the_downlink_fails_has_an_end(
    store, small_mission, tmp_path, monkeypatch, no_pause
):
    held, link, ground = HeldTriage(monkeypatch), FailingLink(), PacketStream(TELECOMMAND, 1100)
    key, keys = make_key(tmp_path / "k"), KeyRing([tmp_path / "k"])
    link.incoming = model_packets(ground, key, 1, bytes(3000))

    def fail_once(_progress) -> None:
        if (store.folder / "model-1.received").exists() and not held.go.is_set():
            link.failures_s = [link.now_s]
            held.go.set()

    progress = fly(link, store, small_mission, 3.0, on_progress=fail_once, keys=keys)
    keys.close()
    assert progress.restarts == 1
    assert ends(link) == {1: ("failed", "the downlink failed before the model was in use")}
    assert not list(store.folder.glob("model*"))


@pytest.mark.parametrize("order", ["oldest", "thumbnail-first"])
def test_frames_that_are_deleted_while_they_wait_are_not_told_as_unreadable(
    store, small_mission, tmp_path, order
):
    save_settings(store.folder, Settings(order))
    link, ground = ListLink(), PacketStream(TELECOMMAND, 1100)
    key, keys = make_key(tmp_path / "k"), KeyRing([tmp_path / "k"])
    commands = [
        Command("arm", {"command": "delete"}),
        Command("delete", {"first_frame": 0, "last_frame": 2}),
    ]
    for number, command in enumerate(commands, start=1):  # they come before the next look at the outbox
        link.incoming.append(ground.encode(APID_COMMANDS, seal(key, number, command.pack())))
    progress = fly(link, store, small_mission, 0.5, keys=keys)
    keys.close()
    assert store.outbox() == []
    assert (progress.waiting, progress.frames_unreadable, progress.restarts) == (0, 0, 0)


def test_a_frame_that_cannot_be_read_is_counted_once_and_the_others_go_on(store, small_mission):
    save_settings(store.folder, Settings("oldest"))
    store.path(0).write_bytes(b"damaged")
    link = ListLink()
    progress = fly(link, store, small_mission, 2.0)
    assert progress.frames_unreadable == 1
    assert link.files()[:2] == ["00000001.obf", "00000002.obf"]
    data = [parse_pdu(d) for apid, d in link.packets() if apid == APID_FILES]
    assert any(isinstance(pdu, FileDataPdu) for pdu in data)


def test_waiting_events_are_bounded_and_the_lost_ones_told():
    events = EventLog(lambda: 0)
    for number in range(MAX_EVENTS + 5):
        events.add("warning", problem=str(number))
    texts = []
    while (packet := events.take()) is not None:
        texts.append(DICTIONARY.unpack("events", packet)[1]["problem"])
    assert texts[0] == "5" and len(texts) == MAX_EVENTS + 1
    assert texts[-1] == f"lost 5 events: more than {MAX_EVENTS} waited"


def problems(events: EventLog) -> list[str]:
    """Return what is sent now."""
    sent = []
    while (packet := events.take()) is not None:
        sent.append(DICTIONARY.unpack("events", packet)[1]["problem"])
    return sent


def test_events_of_a_cut_link_are_sent_again_once_the_ground_is_heard():
    now_s = 0.0
    events = EventLog(clock_s=lambda: now_s)
    events.add("warning", problem="at the start")
    assert problems(events) == ["at the start"]
    now_s = 50.0
    events.heard()  # for the first time
    assert problems(events) == ["at the start"]
    now_s = 57.0
    events.heard()  # not silent for long: it has what was sent
    assert problems(events) == []
    now_s = 60.0
    events.add("warning", problem="long before the cut")
    assert problems(events) == ["long before the cut"]
    now_s = 64.0
    events.heard()
    for number in range(3):
        now_s = 64.5 + 10 * number
        events.add("warning", problem=f"{number}")
        problems(events)
    events.add("warning", problem="waits")
    now_s = 100.0
    events.heard()
    assert problems(events) == ["0", "1", "2", "waits"]


def test_no_more_events_are_kept_for_a_silent_ground_than_may_wait_and_the_others_are_counted():
    now_s = 0.0
    events = EventLog(clock_s=lambda: now_s)
    for number in range(3 * MAX_EVENTS):
        now_s = float(number)
        events.add("warning", problem=f"{number}")
        problems(events)
    events.heard()
    again = problems(events)
    assert again[0] == f"not sent again: {2 * MAX_EVENTS} events of the time without the ground"
    assert again[1:] == [f"{number}" for number in range(2 * MAX_EVENTS, 3 * MAX_EVENTS)]


def test_the_downlink_sends_an_event_of_a_cut_again_byte_for_byte(store, small_mission, tmp_path):
    link = ListLink()
    key, keys = make_key(tmp_path / "k"), KeyRing([tmp_path / "k"])
    ground = PacketStream(TELECOMMAND, 1100)

    def talk(_progress) -> None:
        if link.now_s > 20.0 and not link.incoming and not keys.counters[0].last:
            link.incoming.append(ground.encode(APID_COMMANDS, seal(key, 1, Command("ping", {}).pack())))

    fly(link, store, small_mission, 25.0, on_progress=talk, keys=keys)
    keys.close()
    sent = [data for apid, data in link.packets() if apid == APID_EVENTS]
    assert DICTIONARY.unpack("events", sent[0])[0].name == "started" and sent.count(sent[0]) == 2


def test_the_process_meter_agrees_with_the_kernel():
    meter = ProcessMeter()
    sum(range(300_000))
    values = meter.values()
    status = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
    kilobytes = int(status["VmRSS"].split()[0])
    assert values["rss_bytes"] == pytest.approx(kilobytes * 1024, rel=0.02)
    assert values["uptime_s"] == 0 and values["cpu_percent"] > 0


class FailingLink(ListLink):
    """Its driver has a defect: `exchange` raises what nobody foresaw, once at each of some times."""

    def __init__(self, *failures_s: float):
        super().__init__()
        self.failures_s = list(failures_s)

    def exchange(self, timeout_s: float) -> bytes:
        if self.failures_s and self.now_s >= self.failures_s[0]:
            self.failures_s.pop(0)
            raise ZeroDivisionError("a defect")
        return super().exchange(timeout_s)


@pytest.fixture
def no_pause(monkeypatch):
    monkeypatch.setattr("flightsw.downlink.loop.RESTART_S", 0.0)


def test_a_failure_that_nobody_foresaw_is_told_and_the_downlink_goes_on(store, small_mission, no_pause):
    save_settings(store.folder, Settings("oldest"))
    link = FailingLink(0.4, 0.4)
    progress = fly(link, store, small_mission, 2.0)
    assert progress.restarts == 2
    events = link.unpacked(APID_EVENTS, "events")
    assert [name for name, _ in events] == ["started", "error", "error", "stopped"]
    texts = [values["problem"] for name, values in events if name == "error"]
    assert texts == [
        f"the downlink failed, restart {n}: ZeroDivisionError('a defect')" for n in (1, 2)
    ]  # each with its number: a lost event shows
    assert link.files() == [f"{n:08d}.obf" for n in range(3)] * 2  # what was in flight begins anew
    packets = PacketStream(TELECOMMAND, 1100)
    assert len(packets.decode(b"".join(link.written))) == progress.packets_sent
    assert packets.packets_missing == 0  # the ground sees no gap
    assert progress.segments_sent == sum(
        isinstance(parse_pdu(data), FileDataPdu) for apid, data in link.packets() if apid == APID_FILES
    )


def test_a_downlink_that_fails_at_every_start_ends_with_an_error(store, small_mission, no_pause):
    link = FailingLink(*[0.0] * 100)
    with pytest.raises(
        DownlinkError, match=r"6 times in a row, at last with ZeroDivisionError\('a defect'\)"
    ):
        fly(link, store, small_mission, 60.0)
    assert len(link.failures_s) == 100 - (1 + RESTARTS)


def test_rare_failures_never_end_the_downlink(store, small_mission, no_pause, monkeypatch):
    monkeypatch.setattr("flightsw.downlink.loop.SOUND_S", 1.0)
    link = FailingLink(*(1.5 * number for number in range(1, RESTARTS + 3)))
    assert fly(link, store, small_mission, 1.5 * (RESTARTS + 3)).restarts == RESTARTS + 2


def test_without_a_store_that_can_be_read_commands_are_obeyed_and_it_is_told_why(
    tmp_path, make_frame, small_mission
):
    (tmp_path / "store").write_text("no folder")
    key, keys = make_key(tmp_path / "k"), KeyRing([tmp_path / "k"])
    link, ground = ListLink(), PacketStream(TELECOMMAND, 1100)
    for number, command in enumerate([Command("ping", {}), Command("fsck", {})], start=1):
        link.incoming.append(ground.encode(APID_COMMANDS, seal(key, number, command.pack())))

    def mount(_progress) -> None:
        if link.now_s > 20 and (tmp_path / "store").is_file():
            (tmp_path / "store").unlink()
            FrameStore(tmp_path / "store").put(make_frame(0))

    store = FrameStore(tmp_path / "store", open_now=False)
    progress = fly(link, store, small_mission, 30.0, on_progress=mount, keys=keys)
    keys.close()
    assert ends(link)[1] == ("completed", "alive")
    assert ends(link)[2][0] == "failed" and "no frame store" in ends(link)[2][1]
    errors = [values["problem"] for name, values in link.unpacked(APID_EVENTS, "events") if name == "error"]
    assert sum("cannot open the store" in problem for problem in errors) == 1  # once, not at each attempt
    assert progress.restarts == 0 and link.files()[-1] == "00000000.obf"  # it is sent once it can be read
    housekeeping = [values for _, values in link.unpacked(APID_HOUSEKEEPING, "telemetry")]
    assert (housekeeping[0]["frames_stored"], housekeeping[-1]["frames_stored"]) == (0, 1)


def test_the_first_frame_goes_out_as_soon_as_another_thread_lets_the_store_be_opened(store, small_mission):
    link, begins_s = ListLink(), []

    def should_stop() -> bool:
        if not begins_s and link.files():
            begins_s.append(link.now_s)
        return link.now_s > 1.0

    run_downlink(
        FrameStore(store.folder, open_now=False),
        link,
        small_mission,
        should_stop=should_stop,
        clock_s=lambda: link.now_s,
        store_may_open=lambda: link.now_s >= 0.05,  # between two looks at the outbox
    )
    assert begins_s and begins_s[0] < 0.05 + 3 * WAIT_S


def test_containers_that_read_as_zeros_cost_these_frames_alone(store, small_mission):
    """As after a power cut on XFS, or ext4 with data=writeback: index and outbox have them."""
    store.path(0).write_bytes(bytes(store.path(0).stat().st_size))
    store.path(1).write_bytes(b"")
    link = ListLink()
    progress = fly(link, store, small_mission, 2.0)
    assert (progress.restarts, progress.frames_unreadable) == (0, 2)
    assert link.files() == ["00000002.obt", "00000002.obf"]
    headers = [read_header(data) for apid, data in link.packets() if apid == APID_FRAME_HEADERS]
    assert [header["frame_id"] for header in headers] == [2]


def test_fsck_by_command_repairs_the_store_while_flight_goes_on(store, small_mission, tmp_path):
    save_settings(store.folder, Settings("oldest"))
    store.path(1).write_bytes(b"damaged")
    key, keys = make_key(tmp_path / "k"), KeyRing([tmp_path / "k"])
    link, ground = ListLink(), PacketStream(TELECOMMAND, 1100)
    link.incoming.append(ground.encode(APID_COMMANDS, seal(key, 1, Command("fsck", {}).pack())))

    def should_stop() -> bool:
        time.sleep(0.001)  # the check has a thread and a clock of its own
        return link.now_s > 600 or (1 in ends(link) and len(store.waiting) < 3)

    progress = run_downlink(
        store, link, small_mission, should_stop=should_stop, clock_s=lambda: link.now_s, keys=keys
    )
    keys.close()
    stage, text = ends(link)[1]
    assert stage == "completed" and text.startswith("2 good frames, 2 to be delivered, 1 quarantined")
    assert progress.waiting == 2 and store.outbox() == [0, 2]
    assert not store.path(1).exists() and (store.next_frame_id, store.holds(0, 1)) == (3, True)


def test_a_dead_downlink_is_no_success_of_the_program(tmp_path, small_mission):
    """`flightsw downlink` as a process whose port driver has a defect."""
    code = """
import sys, flightsw.downlink.loop, flightsw.ports
def exchange(self, timeout_s): raise ZeroDivisionError("a defect")
flightsw.ports.SerialLink.exchange = exchange
flightsw.downlink.loop.RESTART_S = 0.0
from flightsw.cli import main
main()
"""
    flight, ground = os.openpty()
    arguments = ["downlink", "--link", f"serial://{os.ttyname(ground)}?baud=9600", "--json"]
    arguments += ["--mission", str(tmp_path / "small.yaml"), "--store", str(tmp_path / "store")]
    done = subprocess.run(
        [sys.executable, "-c", code, *arguments], capture_output=True, text=True, timeout=60
    )
    os.close(flight)
    os.close(ground)
    assert done.returncode == 1, done.stderr
    assert "flightsw: the downlink failed 6 times in a row" in done.stderr


class AnsweringLink(ListLink):
    """Has the ground at its other end, which stores every file and answers with a key."""

    def __init__(self, key: Key):
        super().__init__()
        self.ground = PacketStream(TELECOMMAND, 1100)
        self._receiver = Receiver(
            self.ground.max_data_bytes, 1.0, lambda name, content: Verdict.STORED, key=answer_key(key)
        )

    def write(self, data: bytes) -> None:
        super().write(data)
        for apid, content in self.ground.decode(data):
            if apid == APID_FILES:
                self._receiver.receive(content, self.now_s)
                while (answer := self._receiver.next_pdu(self.now_s)) is not None:
                    self.incoming.append(self.ground.encode(APID_FILES, answer))


@pytest.mark.parametrize("is_retired", [False, True])
def test_a_retired_key_makes_no_receipts_any_more_from_that_moment(
    store, small_mission, tmp_path, is_retired
):
    save_settings(store.folder, Settings("oldest"))
    old, new = make_key(tmp_path / "old"), make_key(tmp_path / "new", 2)
    keys, link = KeyRing([tmp_path / "old", tmp_path / "new"]), AnsweringLink(old)
    commands = [Command("arm", {"command": "retire"}), Command("retire", {"key": 1})]
    if is_retired:  # the commands come before the first answer
        for number, command in enumerate(commands, start=1):
            link.incoming.append(link.ground.encode(APID_COMMANDS, seal(new, number, command.pack())))
    progress = fly(link, store, small_mission, 20.0, keys=keys)
    keys.close()
    assert progress.delivered == (0 if is_retired else 3)
    assert len(store.outbox()) == 3 - progress.delivered


@pytest.mark.parametrize("damage", [b"", b"41", None], ids=["empty", "cut off", "gone"])
@pytest.mark.parametrize("is_owner", [True, False])
def test_without_a_usable_counter_it_is_told_and_frames_go_down_against_authentic_receipts(
    store, small_mission, tmp_path, damage, is_owner
):
    save_settings(store.folder, Settings("oldest"))
    own, other = make_key(tmp_path / "key"), make_key(tmp_path / "other")
    for name in ("key.received", "key.received.copy"):
        (tmp_path / name).unlink(missing_ok=True)
        if damage is not None:
            (tmp_path / name).write_bytes(damage)
    keys, link = KeyRing([tmp_path / "key"]), AnsweringLink(own if is_owner else other)
    link.incoming.append(link.ground.encode(APID_COMMANDS, seal(own, 42, Command("ping", {}).pack())))
    progress = fly(link, store, small_mission, 20.0, keys=keys)
    keys.close()
    told = [values["problem"] for name, values in link.unpacked(APID_EVENTS, "events") if name == "error"]
    assert "no command is taken with a key" in told[0] and "neither the counter nor its copy" in told[0]
    ((_, refused),) = link.unpacked(APID_REPORTS, "reports")
    assert refused["stage"] == "refused" and "neither the counter nor its copy" in refused["text"]
    assert progress.delivered == (3 if is_owner else 0)
