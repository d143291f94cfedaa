"""fsck: whatever is broken in a store is found and repaired, and no good frame is lost by it."""

import json
import os
import shutil
import tty

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from typer.testing import CliRunner

from flightsw.cli import app
from flightsw.errors import StoreError
from flightsw.icd.frame import decode_frame, encode_frame
from flightsw.storage.fsck import fsck
from flightsw.storage.settings import Settings, load_settings, save_settings
from flightsw.storage.store import FrameStore

COUNT = 5


@pytest.fixture
def folder(tmp_path, make_frame):
    store = FrameStore(tmp_path / "store")
    for _ in range(COUNT):
        store.put(make_frame(store.next_frame_id))
    store.mark_delivered(1)
    store.next_transaction()
    return store.folder


def test_a_sound_store_is_left_alone(folder):
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    report = fsck(folder)
    assert (report.frames, report.waiting, report.problems) == (COUNT, COUNT - 1, [])
    assert {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()} == before


def test_a_downlink_that_ends_when_all_is_sent_makes_no_store_of_a_misspelt_name(tmp_path, small_mission):
    ours, theirs = os.openpty()
    tty.setraw(theirs)
    arguments = ["downlink", "--link", f"serial://{os.ttyname(theirs)}", "--exit-when-empty"]
    arguments += ["--mission", str(tmp_path / "small.yaml"), "--store", str(tmp_path / "misspelt")]
    done = CliRunner().invoke(app, arguments)
    os.close(ours)
    os.close(theirs)
    assert isinstance(done.exception, StoreError) and "misspelt is no frame store" in str(done.exception)
    assert not (tmp_path / "misspelt").exists()


def break_temporary(folder):
    (folder / "frames" / "00000009.obf.part").write_bytes(b"half")
    (folder / "transaction.part").write_bytes(b"7")


def break_container(folder):
    path = folder / "frames" / "00000002.obf"
    damaged = bytearray(path.read_bytes())
    damaged[500] ^= 1
    path.write_bytes(damaged)


def break_torn(folder):
    os.truncate(folder / "frames" / "00000004.obf", 700)


def break_name(folder):
    os.rename(folder / "frames" / "00000003.obf", folder / "frames" / "00000008.obf")


def break_missing(folder):
    (folder / "frames" / "00000000.obf").unlink()


def break_index_line(folder):
    index = folder / "index.jsonl"
    lines = index.read_bytes().split(b"\n")
    lines[1] = lines[1][:30]
    index.write_bytes(b"\n".join(lines))


def break_index_end(folder):
    os.truncate(folder / "index.jsonl", (folder / "index.jsonl").stat().st_size - 9)


def break_index_twice(folder):
    index = folder / "index.jsonl"
    index.write_bytes(index.read_bytes() + index.read_bytes().split(b"\n")[0] + b"\n")


def break_index_gone(folder):
    (folder / "index.jsonl").unlink()


def break_digest(folder):
    index = folder / "index.jsonl"
    lines = [json.loads(line) for line in index.read_bytes().splitlines()]
    lines[2]["sha256"] = "0" * 64
    index.write_bytes(b"".join(json.dumps(line).encode() + b"\n" for line in lines))


def break_marker(folder):
    (folder / "outbox" / "00000077").touch()


def break_outbox(folder):
    shutil.rmtree(folder / "outbox")


def break_transaction(folder):
    (folder / "transaction").write_bytes(b"\xff\x00")


BREAKS = {
    break_temporary: (2, 0),  # problems, frames lost
    break_container: (2, 1),
    break_torn: (2, 1),
    break_name: (2, 1),
    break_missing: (1, 1),
    break_index_line: (2, 0),
    break_index_end: (2, 0),
    break_index_twice: (1, 0),
    break_index_gone: (COUNT, 0),
    break_digest: (1, 0),
    break_marker: (1, 0),
    break_outbox: (1, 0),
    break_transaction: (1, 0),
}


@pytest.mark.parametrize("damage", BREAKS, ids=lambda damage: damage.__name__)
def test_damage_is_reported_and_repaired_and_what_is_good_stays(folder, make_frame, damage):
    at_least, lost = BREAKS[damage]
    damage(folder)
    found = fsck(folder, repair=False)
    assert len(found.problems) >= at_least
    report = fsck(folder)
    assert report.problems == found.problems  # the check had changed nothing
    assert report.frames == COUNT - lost
    again = fsck(folder)
    assert again.problems == [] and again.frames == COUNT - lost
    store = FrameStore(folder)
    assert store.next_frame_id == COUNT  # no number is used twice, also not that of a lost frame
    for stored in store.frames:
        assert decode_frame(store.read(stored.frame_id)).frame_id == stored.frame_id
    assert set(store.outbox()) <= {stored.frame_id for stored in store.frames}
    assert store.next_transaction() > 1
    store.put(make_frame(store.next_frame_id))
    assert fsck(folder).problems == []


def test_quarantined_containers_are_kept_and_never_overwritten(folder, make_frame):
    for _ in range(2):
        break_torn(folder)
        fsck(folder)
        whole = encode_frame(make_frame(4))
        (folder / "frames" / "00000004.obf").write_bytes(whole)
        fsck(folder)
    assert len(list((folder / "quarantine").iterdir())) == 2


@pytest.mark.parametrize(("damage", "counts"), [(break_torn, (1, 0)), (break_missing, (0, 1))])
def test_a_frame_is_counted_as_quarantined_or_as_missing_and_never_as_both(folder, damage, counts):
    damage(folder)
    for report in (fsck(folder, repair=False), fsck(folder)):
        assert (report.quarantined, report.missing) == counts


def test_a_session_of_the_ground_is_no_frame_store(tmp_path):
    (tmp_path / "frames").mkdir()
    (tmp_path / "session.json").write_text("{}")
    with pytest.raises(StoreError, match="is a session of the ground, no frame store"):
        fsck(tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["frames", "session.json"]


def test_deleted_frames_stay_deleted(folder):
    FrameStore(folder).drop(4)
    break_index_twice(folder)
    fsck(folder)
    store = FrameStore(folder)
    assert store.next_frame_id == COUNT and 4 not in {f.frame_id for f in store.frames}
    assert store.holds(1, 1)  # bracket 1, index 1 was frame 4: it is not taken again


def test_a_running_program_notices_that_the_index_was_written_again(folder, make_frame):
    running = FrameStore(folder)
    break_digest(folder)
    fsck(folder)
    running.put(make_frame(running.next_frame_id))
    assert [f.frame_id for f in running.frames] == list(range(COUNT + 1))
    assert running.used_bytes == sum(f.size_bytes for f in running.frames)


@given(data=st.data())
@settings(max_examples=25, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_any_bytes_of_damage_end_in_a_store_that_opens(folder, tmp_path, data):
    copy = tmp_path / "copy"
    shutil.rmtree(copy, ignore_errors=True)
    shutil.copytree(folder, copy)
    files = sorted(p for p in copy.rglob("*") if p.is_file() and p.name not in ("lock", "reserve"))
    for _ in range(data.draw(st.integers(1, 3))):
        path = data.draw(st.sampled_from(files))
        content = bytearray(path.read_bytes())
        at = data.draw(st.integers(0, len(content)))
        content[at : at + data.draw(st.integers(0, 40))] = data.draw(st.binary(max_size=40))
        path.write_bytes(content)
    fsck(copy)
    assert fsck(copy).problems == []
    store = FrameStore(copy)
    for stored in store.frames:
        store.read(stored.frame_id)
    store.next_transaction()


def test_what_is_no_store_is_refused(tmp_path):
    with pytest.raises(StoreError, match="no frame store"):
        fsck(tmp_path)


def test_of_what_stands_twice_the_good_copy_replaces_the_damaged_one(folder):
    save_settings(folder, Settings("oldest", safe_mode=True))
    path, copy = folder / "settings.json", folder / "settings.json.copy"
    whole = path.read_bytes()
    for damaged in (path, copy):
        damaged.write_bytes(whole.replace(b"true", b"trve"))
        (problem,) = fsck(folder, repair=False).problems
        assert problem.startswith(f"{damaged.name}: ") and damaged.read_bytes() != whole
        assert fsck(folder).problems == [problem]
        assert path.read_bytes() == copy.read_bytes() == whole
    for damaged in (path, copy):
        damaged.write_bytes(b"{}")
    (problem,) = fsck(folder).problems
    assert "so is its copy" in problem and not path.exists() and not copy.exists()
    kept = {found.read_bytes() for found in (folder / "quarantine").iterdir()}
    assert kept == {b"{}"}


def test_settings_that_were_set_aside_mean_safe_mode_until_the_ground_says_otherwise(folder, small_mission):
    save_settings(folder, Settings("oldest", safe_mode=True))
    for damaged in (folder / "settings.json", folder / "settings.json.copy"):
        damaged.write_bytes(b"{}")
    fsck(folder)
    assert load_settings(folder, small_mission).safe_mode
    save_settings(folder, Settings("oldest"))
    assert not load_settings(folder, small_mission).safe_mode


def test_a_container_that_came_back_after_its_frame_was_deleted_goes_again(folder):
    store = FrameStore(folder)
    path = store.path(3)
    container = path.read_bytes()
    store.drop(3)
    path.write_bytes(container)
    assert fsck(folder, repair=False).problems == ["frame 3: was deleted, but its container was still there"]
    assert path.exists()
    fsck(folder)
    assert not path.exists() and 3 not in [frame.frame_id for frame in FrameStore(folder).frames]


def test_a_line_of_a_deleted_frame_that_its_second_copy_lacks_is_added(folder):
    FrameStore(folder).drop(3)
    (folder / "deleted.jsonl").write_bytes(b"")
    assert any("deleted.jsonl does not have" in problem for problem in fsck(folder).problems)
    (folder / "index.jsonl").unlink()  # of the two copies one is enough now
    assert 3 not in [frame.frame_id for frame in FrameStore(folder).frames]
    assert FrameStore(folder).next_frame_id == COUNT


def test_the_command_says_what_it_found_and_ends_with_1_where_something_is_wrong(folder):
    sound = CliRunner().invoke(app, ["fsck", "--store", str(folder), "--json"])
    assert sound.exit_code == 0 and json.loads(sound.stdout)["problems"] == []
    container = bytearray((folder / "frames" / "00000002.obf").read_bytes())
    container[400] ^= 1
    (folder / "frames" / "00000002.obf").write_bytes(container)
    looked = CliRunner().invoke(app, ["fsck", "--store", str(folder), "--check"])
    assert looked.exit_code == 1 and "00000002.obf" in looked.stdout
    repaired = CliRunner().invoke(app, ["fsck", "--store", str(folder)])
    kept = [path.read_bytes() for path in (folder / "quarantine").iterdir()]
    assert repaired.exit_code == 1 and bytes(container) in kept
    again = CliRunner().invoke(app, ["fsck", "--store", str(folder), "--check"])
    assert again.exit_code == 0
