"""What flight refuses with its reason, and what it does when a disk is full or a file is gone."""

import dataclasses
import errno
import json
import math
import os
import socket
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest

from flightsw.capture.sequencer import CaptureCounts
from flightsw.errors import OrbitError, StoreError
from flightsw.icd.codestream import decode_pixels
from flightsw.icd.config import ConfigError, build
from flightsw.icd.mission import load_mission
from flightsw.icd.model_file import MAX_MODEL_BYTES, ModelUnfit, check_for_triage, check_model
from flightsw.icd.packet import PacketError
from flightsw.navigation.orbit import (
    EARTH_RADIUS_M,
    SUN_RADIUS_M,
    propagate,
    sun_position_gcrs,
    sunlit_fraction,
)
from flightsw.run import RunResult
from flightsw.selftest import computer
from flightsw.service import unit
from flightsw.storage.index import entries_of
from flightsw.storage.store import RESERVE, FrameStore
from flightsw.watchdog import notify
from tests.commands import call

MISSION_FILE = Path(__file__).parents[2] / "mission.yaml"
MISSION = load_mission(MISSION_FILE)


@pytest.mark.parametrize(
    ("content", "problem"),
    [
        (bytes(MAX_MODEL_BYTES + 1), f"has {MAX_MODEL_BYTES + 1} bytes; the limit is {MAX_MODEL_BYTES}"),
        (b"\x38\x01", "is not an ONNX file"),  # field 7, the graph, as a number
        (b"\xca\x01\x00", "has functions of its own"),  # field 25
    ],
    ids=["too large", "a number for a message", "functions"],
)
def test_a_file_that_is_no_model_of_ours_is_refused(content, problem):
    """The bytes are ONNX's protobuf: field number times 8 plus the kind, then the value."""
    with pytest.raises(ModelUnfit, match=problem):
        check_model(content)


def test_a_model_that_does_not_say_what_it_renders_is_refused():
    with pytest.raises(ModelUnfit, match=r"is no model\.onnx of a run: it does not say width, height"):
        check_for_triage(b"")


@dataclasses.dataclass(frozen=True)
class Section:
    names: dict[str, str]
    is_on: bool
    since: str
    size_m: float | None = None


GOOD = {"names": {"a": "b"}, "is_on": True, "since": datetime(2026, 7, 21, tzinfo=UTC), "size_m": None}


@pytest.mark.parametrize(
    ("wrong", "problem"),
    [
        ({"names": ["a"]}, r"section\.names: expected a mapping of keys"),
        ({"is_on": 1}, r"section\.is_on: expected true or false"),
        ({"since": 7}, r"section\.since: expected text"),
        ({"size_m": "far"}, r"section\.size_m: expected a number"),
    ],
)
def test_a_section_takes_only_values_of_its_own_kinds(wrong, problem):
    assert build(Section, GOOD, "section") == Section({"a": "b"}, True, "2026-07-21T00:00:00+00:00")
    with pytest.raises(ConfigError, match=problem):
        build(Section, GOOD | wrong, "section")


def test_lines_of_an_index_that_are_no_entries_are_left_out_with_the_reason():
    stored = {"frame_id": 1, "bracket_id": 0, "bracket_index": 1, "sha256": "ab", "size_bytes": 9}
    lines = [stored, 7, stored | {"frame_id": -1}, {"frame_id": 2, "dropped": 3}]
    entries, problems = entries_of(b"".join(json.dumps(line).encode() + b"\n" for line in lines))
    assert [entry.frame_id for entry in entries] == [1]
    assert ["expected an object" in problems[0], *("out of range" in p for p in problems[1:])] == [True] * 3


def test_a_codestream_that_announces_no_size_is_refused():
    with pytest.raises(PacketError, match="the codestream None"):
        decode_pixels(b"\xff\xd8\xff\xe0\x00\x04ab\xff\xd9", (8, 8, 1))


def test_a_service_is_one_line_of_a_program_that_is_there(monkeypatch, tmp_path):
    places = (tmp_path / "mission.yaml", None, "obbgs")
    monkeypatch.setattr("flightsw.service.HIDDEN", ())
    with pytest.raises(ConfigError, match="expected one line"):
        unit("gige://a\nExecStartPre=/bin/false", "serial:///dev/ttyS1", *places)
    monkeypatch.setattr("sys.prefix", str(tmp_path))
    with pytest.raises(ConfigError, match="install the package into this environment"):
        unit("gige://a", "serial:///dev/ttyS1", *places)


def test_far_behind_the_earth_the_sun_is_a_ring_of_light():
    """The light that is left is the part of the Sun's disc that the Earth's, which looks smaller, does not cover."""
    now_ns = MISSION.orbit.start_utc_ns
    sun_m = sun_position_gcrs(now_ns)
    behind_m = -4e9 * sun_m / np.linalg.norm(sun_m)
    earth_rad = math.asin(EARTH_RADIUS_M / 4e9)
    sun_rad = math.asin(SUN_RADIUS_M / (np.linalg.norm(sun_m) + 4e9))
    assert sunlit_fraction(behind_m, now_ns) == pytest.approx(1 - (earth_rad / sun_rad) ** 2, rel=1e-6)
    assert 0.5 < sunlit_fraction(behind_m, now_ns) < 1


def test_elements_with_a_field_that_is_no_number_are_refused():
    first, second = MISSION.orbit.target_tle
    with pytest.raises(OrbitError, match=r"unreadable|cannot be"):
        propagate((first, f"{second[:8]}   nan {second[16:]}"), MISSION.orbit.start_utc_ns)


def test_a_computer_that_is_too_slow_or_small_or_a_disk_that_forgets_fails(tmp_path, monkeypatch):
    monkeypatch.setattr(computer, "MEMORY_BYTES", 1 << 60)
    assert "too little memory" in computer.check_computer(MISSION)[0].found
    hasty = dataclasses.replace(MISSION.bracket)
    object.__setattr__(hasty, "interval_s", 1e-9)  # shorter than the mission file may say
    assert "too slow" in computer.check_computer(dataclasses.replace(MISSION, bracket=hasty))[0].found
    monkeypatch.setattr(computer, "write_whole", lambda path, content: path.write_bytes(content[:-1]))
    (found,) = computer.check_disk(MISSION, tmp_path)
    assert "returned other bytes than were written" in found.found and not any(tmp_path.iterdir())


def test_the_plan_is_printed_as_json():
    planned = call("flightsw", "plan", "--mission", MISSION_FILE, "--json")
    assert planned.returncode == 0 and len(json.loads(planned.stdout)) > 1


def test_a_result_says_nothing_of_what_was_not_asked_for():
    assert RunResult(3, 1).tree() == {"frames_stored": 3, "outbox": 1}
    counts = CaptureCounts()
    assert RunResult(3, 1, counts, 2).tree()["capture"] == vars(counts) | {"camera_losses": 2}


def test_a_service_manager_at_an_abstract_address_hears_us(monkeypatch):
    """systemd writes the leading null byte of such an address as @ (sd_notify(3))."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        name = f"obbgs-test-{os.getpid()}"
        manager.bind(f"\0{name}")
        manager.settimeout(5)
        monkeypatch.setenv("NOTIFY_SOCKET", f"@{name}")
        notify("READY=1")
        assert manager.recv(100) == b"READY=1"


def fill(store: FrameStore, make_frame, count: int) -> None:
    for _ in range(count):
        store.put(make_frame(store.next_frame_id))


def test_a_store_that_is_not_open_says_so(tmp_path):
    with pytest.raises(StoreError, match="not open"):
        _ = FrameStore(tmp_path, open_now=False).frames


def test_a_frame_that_another_process_stored_meanwhile_is_read(tmp_path, make_frame):
    ours, other = FrameStore(tmp_path), FrameStore(tmp_path)
    fill(other, make_frame, 1)
    assert ours.read(0) == other.path(0).read_bytes()


@pytest.mark.parametrize("gives_room", [RESERVE, "00000001.obf"])
def test_on_a_disk_without_room_a_frame_is_deleted_for_good_all_the_same(
    tmp_path, make_frame, monkeypatch, gives_room
):
    """No line fits until the reserve, or the frame itself, has made room."""
    from flightsw.storage import store as module

    store = FrameStore(tmp_path)
    fill(store, make_frame, 3)
    append, full = module.append_line, [path for path in tmp_path.rglob(gives_room)]

    def on_a_full_disk(path, line):
        if any(path.exists() for path in full):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        append(path, line)

    monkeypatch.setattr(module, "append_line", on_a_full_disk)
    store.drop(1)
    monkeypatch.undo()
    again = FrameStore(tmp_path)
    assert [frame.frame_id for frame in again.frames] == [0, 2] and again.next_frame_id == 3
    assert (tmp_path / RESERVE).exists()  # kept again from the next start on


def test_of_an_index_that_is_made_again_a_frame_that_is_gone_is_told_and_its_number_stays_used(
    tmp_path, make_frame, caplog
):
    fill(FrameStore(tmp_path), make_frame, 3)
    (tmp_path / "frames" / "00000002.obf").unlink()
    lines = (tmp_path / "index.jsonl").read_bytes().splitlines(keepends=True)
    (tmp_path / "index.jsonl").write_bytes(lines[0].replace(b"0", b"1") + b"".join(lines[1:]))
    store = FrameStore(tmp_path)
    assert [frame.frame_id for frame in store.frames] == [0, 1] and store.next_frame_id == 3
    assert "frame 2 is gone from the disk" in caplog.text
