"""The frame store: nothing half there, nothing numbered twice, whatever moment the power goes."""

import errno
import hashlib
import json
import os
import subprocess
import sys

import pytest

from flightsw.errors import StoreError, StoreFull
from flightsw.icd.frame import decode_frame, encode_frame
from flightsw.storage.fsck import fsck
from flightsw.storage.settings import Settings, load_settings, save_settings
from flightsw.storage.store import RESERVE_BYTES, FrameStore
from obbgs_base.files import write_whole
from tests.small_disk import fill_disk, read_only, small_disk


def fill(store: FrameStore, make_frame, count: int) -> None:
    for _ in range(count):
        store.put(make_frame(store.next_frame_id))


def test_a_stored_frame_comes_back_and_its_index_line_holds_its_digest(tmp_path, make_frame):
    store = FrameStore(tmp_path)
    store.put(make_frame(0))
    container = store.read(0)
    assert (decode_frame(container).dn == make_frame(0).dn).all()
    line = json.loads((tmp_path / "index.jsonl").read_text())
    assert line["sha256"] == hashlib.sha256(container).hexdigest()
    assert line["size_bytes"] == len(container)
    assert store.path(0).name == "00000000.obf"


def test_numbers_outbox_and_frames_survive_a_restart(tmp_path, make_frame):
    fill(FrameStore(tmp_path), make_frame, 3)
    FrameStore(tmp_path).mark_delivered(1)
    store = FrameStore(tmp_path)
    assert store.next_frame_id == 3
    assert [stored.frame_id for stored in store.frames] == [0, 1, 2]
    assert store.outbox() == [0, 2]


def test_a_line_cut_off_in_writing_is_written_again_from_its_container(tmp_path, make_frame):
    fill(FrameStore(tmp_path), make_frame, 3)
    index = tmp_path / "index.jsonl"
    before = index.read_bytes()
    index.write_bytes(before[:-20])
    store = FrameStore(tmp_path)
    assert index.read_bytes() == before
    assert store.outbox() == [0, 1, 2]


def test_a_half_written_container_is_dropped_and_its_number_used_for_the_next(tmp_path, make_frame):
    fill(FrameStore(tmp_path), make_frame, 2)
    whole = encode_frame(make_frame(2))
    (tmp_path / "outbox" / "00000002").touch()
    (tmp_path / "frames" / "00000002.obf.part").write_bytes(whole[:100])
    (tmp_path / "frames" / "00000003.obf").write_bytes(whole[:100])
    store = FrameStore(tmp_path)
    assert store.next_frame_id == 2
    assert store.outbox() == [0, 1]
    assert sorted(path.name for path in (tmp_path / "frames").iterdir()) == ["00000000.obf", "00000001.obf"]


def test_a_number_is_taken_only_once(tmp_path, make_frame):
    store = FrameStore(tmp_path)
    store.put(make_frame(0))
    with pytest.raises(StoreError, match="next free number is 1"):
        store.put(make_frame(0))


def test_one_process_sends_what_another_captures(tmp_path, make_frame):
    sending, capturing = FrameStore(tmp_path), FrameStore(tmp_path)
    fill(capturing, make_frame, 2)
    assert sending.outbox() == [0, 1]
    sending.read(1)
    sending.mark_delivered(0)
    assert capturing.outbox() == [1]


def test_any_flipped_bit_of_the_index_is_mended_from_the_containers_and_told(tmp_path, make_frame, caplog):
    fill(FrameStore(tmp_path), make_frame, 4)
    FrameStore(tmp_path).drop(1)
    FrameStore(tmp_path).mark_delivered(2)
    for name in ("index.jsonl", "deleted.jsonl"):
        path = tmp_path / name
        whole = path.read_bytes()
        for bit in range(0, 8 * len(whole), 41):
            caplog.clear()
            damaged = bytearray(whole)
            damaged[bit // 8] ^= 1 << bit % 8
            path.write_bytes(damaged)
            store = FrameStore(tmp_path)
            assert (
                "is made again from" in caplog.text or bit // 8 == len(whole) - 1
            )  # an unfinished last line
            assert [f.frame_id for f in store.frames] == [0, 2, 3] and store.outbox() == [0, 3]
            assert store.next_frame_id == 4 and store.holds(0, 1)  # that of the deleted frame
            assert fsck(tmp_path, repair=False).problems == []
            path.write_bytes(whole)
    assert len(list((tmp_path / "quarantine").glob("*-index.jsonl"))) > 10


@pytest.mark.parametrize("content", [b"", bytes(300), None], ids=["empty", "zeros", "gone"])
def test_an_index_that_is_lost_is_made_again(tmp_path, make_frame, content):
    running = FrameStore(tmp_path)
    fill(running, make_frame, 5)
    running.drop(4)
    running.path(3).write_bytes(bytes(200))
    index = tmp_path / "index.jsonl"
    index.unlink() if content is None else index.write_bytes(content)
    store = FrameStore(tmp_path)
    assert [f.frame_id for f in store.frames] == [0, 1, 2]
    assert store.next_frame_id == 5  # frame 3 may have been sent under its number
    running.look()
    assert [f.frame_id for f in running.frames] == [0, 1, 2]  # a process that had it open reads it again
    running.put(make_frame(5))
    assert FrameStore(tmp_path).outbox() == [0, 1, 2, 5]


def test_an_index_of_an_earlier_version_is_taken(tmp_path, make_frame):
    fill(FrameStore(tmp_path), make_frame, 3)
    index = tmp_path / "index.jsonl"
    lines = [json.loads(line) for line in index.read_bytes().splitlines()]
    for line in lines:
        del line["crc32"]
    lines += [{"frame_id": 7, "dropped": "oldest"}]
    index.write_text("".join(json.dumps(line) + "\n" for line in lines))
    store = FrameStore(tmp_path)
    assert (store.outbox(), store.next_frame_id, store.dropped_undelivered) == ([0, 1, 2], 8, 1)


def test_a_deletion_that_a_power_cut_interrupted_is_ended(tmp_path, make_frame, monkeypatch):
    store = FrameStore(tmp_path)
    fill(store, make_frame, 3)
    monkeypatch.setattr(
        FrameStore, "_unlink", lambda self, frame_id: (_ for _ in ()).throw(OSError(5, "cut"))
    )
    with pytest.raises(StoreError, match="cut"):
        store.drop(1)
    monkeypatch.undo()
    again = FrameStore(tmp_path)
    assert again.outbox() == [0, 2] and not again.path(1).exists()


def test_a_store_that_cannot_be_written_to_is_sent_from(tmp_path, make_frame, caplog):
    """A file system that is mounted read-only, as the kernel does after errors of a flash card."""
    fill(FrameStore(tmp_path / "store"), make_frame, 3)
    with read_only(tmp_path / "store"):
        store = FrameStore(tmp_path / "store")
        assert store.look() == [0, 1, 2]
        numbers = {store.next_transaction() for _ in range(20)}
        assert len(numbers) == 20 and decode_frame(store.read(0)).frame_id == 0
        store.mark_delivered(0)
        assert (list(store.waiting), store.outbox()) == ([1, 2], [1, 2])
        with pytest.raises(StoreError, match="Read-only"):
            store.put(make_frame(3))
        assert caplog.text.count("the store cannot be written to") == 1
    store.put(make_frame(3))
    assert store.look() == [3]


def test_looks_say_what_came_and_what_went_without_listing_the_outbox(tmp_path, make_frame, monkeypatch):
    capturing, sending = FrameStore(tmp_path), FrameStore(tmp_path)
    fill(capturing, make_frame, 2)
    assert sending.look() == [0, 1]
    monkeypatch.setattr(FrameStore, "_markers", lambda self: pytest.fail("listed"))
    assert sending.look() == []
    fill(capturing, make_frame, 2)
    sending.mark_delivered(1)
    assert sending.look() == [2, 3] and list(sending.waiting) == [0, 2, 3]
    capturing.drop(2)
    assert sending.look() == [] and list(sending.waiting) == [0, 3]


def test_a_container_that_changed_on_the_disk_is_not_sent(tmp_path, make_frame):
    store = FrameStore(tmp_path)
    store.put(make_frame(0))
    damaged = bytearray(store.path(0).read_bytes())
    damaged[400] ^= 1
    store.path(0).write_bytes(damaged)
    with pytest.raises(StoreError, match="changed on the disk"):
        store.read(0)


def test_a_full_disk_leaves_no_half_line(tmp_path, make_frame, monkeypatch):
    store = FrameStore(tmp_path)
    store.put(make_frame(0))
    before = (tmp_path / "index.jsonl").read_bytes()

    def no_space(descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr("flightsw.storage.store.os.fsync", no_space)
        with pytest.raises(StoreError, match="No space left"):
            store.put(make_frame(1))
    assert (tmp_path / "index.jsonl").read_bytes() == before
    store.put(make_frame(1))
    assert FrameStore(tmp_path).outbox() == [0, 1]


def test_transaction_numbers_are_never_given_twice(tmp_path):
    first, *numbers = [FrameStore(tmp_path).next_transaction() for _ in range(3)]
    assert numbers == [first + 1, first + 2]
    given = {first, *numbers}
    whole = (tmp_path / "transaction").read_bytes()
    flipped = [
        whole[:at] + bytes([whole[at] ^ 1 << bit]) + whole[at + 1 :]
        for at in range(len(whole))
        for bit in range(8)
    ]
    for damaged in (b"?", b"\xff\xfe", "²".encode(), b"", bytes(20), *flipped):
        (tmp_path / "transaction").write_bytes(damaged)
        number = FrameStore(tmp_path).next_transaction()
        assert number not in given
        given.add(number)


def test_a_number_of_an_earlier_version_is_gone_on_from(tmp_path):
    FrameStore(tmp_path)
    (tmp_path / "transaction").write_bytes(b"1800000000\n")
    assert FrameStore(tmp_path).next_transaction() == 1_800_000_001


def test_another_store_has_another_identity_and_other_numbers(tmp_path):
    early, late = FrameStore(tmp_path / "early"), FrameStore(tmp_path / "late")
    numbers = {early.next_transaction() for _ in range(100)}
    assert not numbers & {late.next_transaction() for _ in range(100)}
    assert early.identity != late.identity
    assert FrameStore(tmp_path / "early").identity == early.identity
    (tmp_path / "early/store.json").write_bytes(b"?")  # its copy is good
    assert FrameStore(tmp_path / "early").identity == early.identity


def test_what_may_have_arrived_is_not_dropped_for_room(tmp_path, make_frame):
    """A frame in flight may be on the ground already: dropped, it would be counted as lost and as received."""
    room = round(3.5 * container_bytes(make_frame))
    store = FrameStore(tmp_path, room, "drop-oldest")
    fill(store, make_frame, 3)
    store.next_transaction([0, 2])
    killed = FrameStore(tmp_path, room, "drop-oldest")
    killed.put(make_frame(3))
    assert killed.outbox() == [0, 2, 3] and killed.dropped_undelivered == 1
    killed.next_transaction([0, 2, 3])
    with pytest.raises(StoreFull):
        killed.put(make_frame(4))
    killed.mark_delivered(0)
    killed.put(make_frame(4))
    assert killed.outbox() == [2, 3, 4] and killed.dropped_undelivered == 1


@pytest.mark.parametrize("repaired", [False, True])
def test_where_it_cannot_be_read_what_is_in_flight_it_may_be_any_frame_that_waits(
    tmp_path, make_frame, repaired
):
    room = round(3.5 * container_bytes(make_frame))
    store = FrameStore(tmp_path, room, "drop-oldest")
    fill(store, make_frame, 3)
    store.mark_delivered(1)
    store.next_transaction([0, 2])
    content = bytearray((tmp_path / "transaction").read_bytes())
    content[len(content) // 2] ^= 1
    (tmp_path / "transaction").write_bytes(content)
    if repaired:
        assert len(fsck(tmp_path).problems) == 1
    killed = FrameStore(tmp_path, room, "drop-oldest")
    assert killed.in_flight() == {0, 2}
    killed.put(make_frame(3))  # takes the room of frame 1, which the ground has
    if not repaired:
        assert killed.in_flight() == {0, 2, 3}
        with pytest.raises(StoreFull):
            killed.put(make_frame(4))
        killed.next_transaction([0, 2])  # from now on it is known
    killed.put(make_frame(4))
    assert killed.outbox() == [0, 2, 4] and killed.dropped_undelivered == 1


def test_frames_are_put_back_into_the_outbox_and_count_as_delivered_once(tmp_path, make_frame):
    room = round(3.5 * container_bytes(make_frame))
    store = FrameStore(tmp_path, room, "drop-oldest")
    fill(store, make_frame, 3)
    for frame_id in (0, 1):
        store.mark_delivered(frame_id)
    assert store.put_back(1, 2) == 1 and store.outbox() == [1, 2]
    assert store.put_back(0, (1 << 32) - 1) == 1 and store.outbox() == [0, 1, 2]
    store.put(make_frame(3))
    assert store.outbox() == [1, 2, 3] and store.dropped_undelivered == 0


def test_a_store_holds_one_pass(tmp_path, make_frame):
    second_ns = 10**9
    store = FrameStore(tmp_path)
    store.hold_pass(5 * second_ns)
    store.hold_pass(7 * second_ns)  # nothing was taken yet
    fill(store, make_frame, 1)
    FrameStore(tmp_path).hold_pass(7 * second_ns)
    with pytest.raises(
        StoreError, match=r"begins at 1970-01-01T00:00:07.*--start 1970-01-01T00:00:07\+00:00"
    ):
        FrameStore(tmp_path).hold_pass(9 * second_ns)
    (tmp_path / "pass.json").write_text("[")
    FrameStore(tmp_path).hold_pass(7 * second_ns)  # it stands twice
    for damaged in ("pass.json", "pass.json.copy"):
        (tmp_path / damaged).write_text("[")
    FrameStore(tmp_path).hold_pass(9 * second_ns)
    with pytest.raises(StoreError, match="00:00:09"):
        FrameStore(tmp_path).hold_pass(7 * second_ns)


CAPTURE_UNTIL_KILLED = """
import sys
from pathlib import Path
from flightsw.icd.frame import decode_frame
from flightsw.storage.store import FrameStore
import dataclasses
store, frame = FrameStore(Path(sys.argv[1])), decode_frame(Path(sys.argv[2]).read_bytes())
while True:
    store.put(dataclasses.replace(frame, frame_id=store.next_frame_id))
    print(store.next_frame_id, flush=True)
"""


def test_a_kill_at_any_moment_loses_no_stored_frame(tmp_path, make_frame):
    (tmp_path / "frame").write_bytes(encode_frame(make_frame(0)))
    stored = 0
    for kill_after in (1, 4, 7):
        process = subprocess.Popen(
            [sys.executable, "-c", CAPTURE_UNTIL_KILLED, tmp_path / "store", tmp_path / "frame"],
            stdout=subprocess.PIPE,
            text=True,
        )
        assert process.stdout is not None
        for _ in range(kill_after):
            stored = int(process.stdout.readline())
        process.kill()
        process.wait()
        process.stdout.close()
        store = FrameStore(tmp_path / "store")
        assert store.next_frame_id >= stored
        assert (
            store.outbox() == [frame.frame_id for frame in store.frames] == list(range(store.next_frame_id))
        )
        for frame in store.frames:
            assert decode_frame(store.read(frame.frame_id)).frame_id == frame.frame_id


def container_bytes(make_frame) -> int:
    return len(encode_frame(make_frame(0)))


def test_a_full_quota_refuses_new_frames_and_keeps_what_waits(tmp_path, make_frame):
    store = FrameStore(tmp_path, quota_bytes=round(2.5 * container_bytes(make_frame)))
    fill(store, make_frame, 2)
    for _ in range(2):
        with pytest.raises(StoreFull, match="frame 2 refused: the quota"):
            store.put(make_frame(2))
    assert store.refused == 2 and store.outbox() == [0, 1]
    store.mark_delivered(0)  # the ground has it: it makes room
    store.put(make_frame(2))
    assert [f.frame_id for f in store.frames] == [1, 2] == store.outbox()
    assert store.used_bytes <= (store.quota_bytes or 0)
    assert sorted(p.stem for p in (tmp_path / "frames").iterdir()) == ["00000001", "00000002"]


def test_drop_oldest_keeps_the_newest_and_counts_what_it_lost(tmp_path, make_frame, caplog):
    store = FrameStore(tmp_path, round(2.5 * container_bytes(make_frame)), "drop-oldest")
    fill(store, make_frame, 6)
    assert store.outbox() == [4, 5] and store.dropped_undelivered == 4
    assert "frame 0 deleted undelivered for frame 2" in caplog.text
    again = FrameStore(tmp_path, store.quota_bytes, "drop-oldest")
    assert (again.dropped_undelivered, again.next_frame_id) == (4, 6)
    assert again.holds(0, 0)  # what was deleted is not taken once more
    with pytest.raises(StoreError, match=r"next free number is 6"):
        again.put(make_frame(3))


def test_delivered_frames_go_first_under_either_policy(tmp_path, make_frame):
    store = FrameStore(tmp_path, round(3.5 * container_bytes(make_frame)), "drop-oldest")
    fill(store, make_frame, 3)
    store.mark_delivered(2)
    store.put(make_frame(3))
    assert store.outbox() == [0, 1, 3] and store.dropped_undelivered == 0


def test_a_frame_larger_than_the_quota_is_refused_whatever_the_policy(tmp_path, make_frame):
    store = FrameStore(tmp_path, 1000, "drop-oldest")
    with pytest.raises(StoreFull, match="exceed the quota"):
        store.put(make_frame(0))


def test_a_deleted_frame_is_gone_for_every_process_and_its_number_is_not_used_again(tmp_path, make_frame):
    capturing, sending = FrameStore(tmp_path), FrameStore(tmp_path)
    fill(capturing, make_frame, 2)
    assert sending.outbox() == [0, 1]
    sending.drop(1)
    assert sending.outbox() == [0] == capturing.outbox()
    with pytest.raises(StoreError, match="there is no frame 1"):
        capturing.drop(1)
    capturing.put(make_frame(2))
    assert FrameStore(tmp_path).next_frame_id == 3


@pytest.mark.parametrize("policy", ["refuse", "drop-oldest"])
def test_a_full_disk_is_met_by_the_policy_and_heals(tmp_path, make_frame, monkeypatch, policy):
    """The disk is `free` bytes large; writing more is ENOSPC, deleting gives it back."""
    store = FrameStore(tmp_path, when_full=policy)
    size = container_bytes(make_frame)
    free = round(2.2 * size)
    real_write_whole = write_whole

    def small_disk(path, content, like=None):
        used = sum(p.stat().st_size for p in (tmp_path / "frames").iterdir())
        if used + len(content) > free:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        real_write_whole(path, content, like)

    monkeypatch.setattr("flightsw.storage.store.write_whole", small_disk)
    fill(store, make_frame, 2)
    if policy == "refuse":
        with pytest.raises(StoreFull, match="No space left"):
            store.put(make_frame(2))
        assert store.outbox() == [0, 1]
    else:
        store.put(make_frame(2))
        assert store.outbox() == [1, 2]
    assert fsck(tmp_path, repair=False).problems == []
    free = 10 * size
    store.put(make_frame(store.next_frame_id))
    assert FrameStore(tmp_path).outbox() == store.outbox()


def test_frames_do_not_take_the_room_that_is_kept_for_commands(tmp_path, make_frame, small_mission):
    with small_disk(tmp_path / "disk", "512k") as disk:
        store = FrameStore(disk / "store")
        with pytest.raises(StoreFull):
            for _ in range(400):
                store.put(make_frame(store.next_frame_id))
        fill_disk(disk / "foreign")
        save_settings(store.folder, Settings("triage", safe_mode=True))  # in the room of the reserve
        with pytest.raises(StoreFull, match="kept for commands"):
            for _ in range(40):
                store.put(make_frame(store.next_frame_id))
        for policy in ("triage", "oldest") * 10:
            save_settings(store.folder, Settings(policy, safe_mode=True))
        assert load_settings(store.folder, small_mission) == Settings("oldest", safe_mode=True)


def test_on_a_disk_that_is_truly_full_transfers_are_numbered_and_settings_kept(
    tmp_path, make_frame, small_mission
):
    with small_disk(tmp_path / "disk", "256k") as disk:
        store = FrameStore(disk / "store")
        stored = 0
        with pytest.raises(StoreFull, match="No space left"):
            for stored in range(200):  # noqa: B007 (the count is wanted afterwards)
                store.put(make_frame(store.next_frame_id))
        assert stored > 5 and len(store.frames) == stored
        fill_disk(disk / "foreign")
        assert store.next_transaction()
        settings = Settings("triage", safe_mode=True)
        save_settings(store.folder, settings)
        assert load_settings(store.folder, small_mission) == settings
        store.mark_delivered(0)
        store.put(make_frame(store.next_frame_id))
        assert fsck(disk / "store").problems == []
        (disk / "foreign").unlink()
        for frame in store.frames:
            store.drop(frame.frame_id)
        assert (disk / "store" / "reserve").stat().st_size == RESERVE_BYTES
