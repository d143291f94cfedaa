"""Commands on board: nothing without the key, nothing twice, nothing out of range, nothing that was not armed."""

import contextlib
import errno
import hashlib
import os
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from flightsw.downlink.commands import ANSWER_S, DELETE_S, RESERVE_BYTES, Commander, KeyRing, ReplayCounter
from flightsw.icd.command import Command
from flightsw.icd.config import ConfigError
from flightsw.icd.link.auth import MAX_COUNTER, Key, digest, seal, seal_file
from flightsw.icd.telemetry import DICTIONARY
from flightsw.storage.settings import load_settings
from flightsw.storage.store import FrameStore
from ground.link.uplink import make_key, move_counter
from obbgs_base.files import write_whole
from tests.small_disk import fill_disk, small_disk

ANYTHING = settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=80)


class Spacecraft:
    """A commander with its key, store and clock; `send` seals as the ground does."""

    def __init__(self, folder: Path, mission, make_frame, frames: int = 0):
        folder.mkdir(exist_ok=True)
        self.key_file, self.mission = folder / "mission.key", mission
        self.key = make_key(self.key_file)
        self.store = FrameStore(folder / "store")
        for _ in range(frames):
            self.store.put(make_frame(self.store.next_frame_id))
        self.now_s, self.tick_s = 100.0, 0.0  # the time, and what each look at the clock adds
        self.counter = 0
        self.refusals: list[str] = []
        self.restart()

    def restart(self) -> None:
        """Forget everything that is not on the disk."""
        if self.counter:
            self.keys.close()
        self.keys = KeyRing([self.key_file])
        (self.replay,) = self.keys.counters
        self.commander = Commander(
            self.keys, self.store, self.mission, self.refusals.append, self.clock_s, lambda: 5
        )

    def clock_s(self) -> float:
        self.now_s += self.tick_s
        return self.now_s

    def seal(self, name: str, **arguments) -> bytes:
        self.counter += 1
        return seal(self.key, self.counter, Command(name, arguments).pack())

    def send(self, name: str, **arguments) -> list[tuple[str, str]]:
        """Return stage and text of what is reported."""
        self.commander.receive(self.seal(name, **arguments))
        self.commander.poll()
        return self.reports()

    def reports(self) -> list[tuple[str, str]]:
        reports, self.commander.reports[:] = list(self.commander.reports), []
        return [(report.stage, report.text) for report in reports]

    def state(self) -> tuple:
        """Return all that a command can change."""
        files = {path: path.read_bytes() for path in self.store.folder.rglob("*") if path.is_file()}
        return self.commander.settings, self.commander.upload, self.replay.last, files


@pytest.fixture
def spacecraft(tmp_path, small_mission, make_frame):
    made = Spacecraft(tmp_path / "flight", small_mission, make_frame, frames=3)
    yield made
    made.keys.close()


def test_a_command_is_accepted_started_and_completed(spacecraft):
    assert spacecraft.send("ping") == [("accepted", "ping"), ("started", "ping"), ("completed", "alive")]
    assert spacecraft.commander.accepted == 1


@pytest.mark.parametrize(
    ("name", "arguments", "expected"),
    [
        ("bracket", {"exposure_times_ms": (0.02, 0.04)}, {"exposure_times_ms": (0.02, 0.04)}),
        ("near", {"near": 2}, {"max_error_dn": 2}),
        ("priority", {"order": "triage"}, {"priority": "triage"}),
        ("safe", {}, {"safe_mode": True}),
    ],
)
def test_what_is_commanded_survives_a_restart(spacecraft, name, arguments, expected):
    before = spacecraft.commander.settings
    assert spacecraft.send(name, **arguments)[-1][0] == "completed"
    spacecraft.restart()
    assert spacecraft.commander.settings == replace(before, **expected)
    assert load_settings(spacecraft.store.folder, spacecraft.mission) == replace(before, **expected)


@pytest.mark.parametrize(
    ("name", "arguments", "end"),
    [
        (
            "delete",
            {"first_frame": 2, "last_frame": 1},
            ("refused", "expected the first number before the last, got 2 and 1"),
        ),
        (
            "resend",
            {"first_frame": 2, "last_frame": 1},
            ("refused", "expected the first number before the last, got 2 and 1"),
        ),
        ("delete", {"first_frame": 7, "last_frame": 9}, ("completed", "0 frames deleted")),
        ("resend", {"first_frame": 1, "last_frame": 9}, ("completed", "1 frame put into the outbox again")),
    ],
)
def test_a_range_of_frames_is_taken_as_far_as_they_are_there(spacecraft, name, arguments, end):
    spacecraft.store.mark_delivered(1)  # of three, which all wait
    if name == "delete":
        spacecraft.send("arm", command="delete")
    assert spacecraft.send(name, **arguments)[-1] == end
    assert spacecraft.store.outbox() == ([0, 1, 2] if end[1].startswith("1 frame ") else [0, 2])
    assert len(spacecraft.store.frames) == 3


def test_a_second_check_of_the_store_waits_for_nothing_and_says_which_one_goes_on(spacecraft):
    spacecraft.commander.receive(spacecraft.seal("fsck"))
    assert ("failed", "command 1 checks the store already") in spacecraft.send("fsck")


def test_a_replay_has_no_effect_is_counted_and_answered_with_the_same_reports(spacecraft):
    packet = spacecraft.seal("near", near=2)
    spacecraft.commander.receive(packet)
    first = spacecraft.reports()
    spacecraft.send("near", near=4)
    before = spacecraft.state()
    spacecraft.commander.receive(packet)
    assert spacecraft.reports() == first
    assert spacecraft.state() == before
    assert spacecraft.commander.repeated == 1


def test_a_flood_of_replays_is_counted_but_answered_at_a_walking_pace(spacecraft):
    packet = spacecraft.seal("ping")
    spacecraft.commander.receive(packet)
    answers_once = len(spacecraft.reports())
    for _ in range(1000):
        spacecraft.commander.receive(packet)
    assert spacecraft.commander.repeated == 1000
    assert len(spacecraft.reports()) == answers_once
    spacecraft.now_s += ANSWER_S
    spacecraft.commander.receive(packet)
    assert len(spacecraft.reports()) == answers_once


def test_the_counter_survives_a_restart_and_old_packets_stay_refused(spacecraft):
    packets = [spacecraft.seal("near", near=number) for number in (1, 2)]
    for packet in packets:
        spacecraft.commander.receive(packet)
    spacecraft.restart()
    before = spacecraft.state()
    for packet in packets:
        spacecraft.now_s += ANSWER_S
        spacecraft.commander.receive(packet)
    assert {stage for stage, _ in spacecraft.reports()} == {"refused"}
    assert spacecraft.state() == before
    assert spacecraft.commander.repeated == 2
    assert spacecraft.send("ping")[-1] == ("completed", "alive")


@pytest.mark.parametrize(
    "then", ["the disk heals", "a restart", "a later command", "a restart and a later command"]
)
def test_a_command_whose_counter_cannot_be_kept_is_as_good_as_lost_on_the_link(spacecraft, then):
    block = spacecraft.replay.path.with_name(spacecraft.replay.path.name + ".part")
    block.mkdir()  # as root nothing less makes the disk refuse
    packet = spacecraft.seal("near", near=2)
    before = spacecraft.state()
    for _ in range(2):  # the ground has no answer and sends it again
        spacecraft.commander.receive(packet)
    assert spacecraft.reports() == []  # a report of a refusal would have to stay true after a restart
    assert spacecraft.state() == before and "cannot keep" in spacecraft.refusals[0]
    block.rmdir()
    if "restart" in then:
        spacecraft.restart()
    if "later" in then:
        spacecraft.send("ping")
    spacecraft.commander.receive(packet)
    assert spacecraft.commander.settings.max_error_dn == (0 if "later" in then else 2)
    spacecraft.reports()
    spacecraft.send("near", near=1)
    spacecraft.restart()
    spacecraft.commander.receive(packet)  # taken or overtaken, it is never taken again
    assert [stage for stage, _ in spacecraft.reports()] == ["refused"]
    assert spacecraft.commander.settings.max_error_dn == 1


@pytest.mark.parametrize("error", [errno.ENOSPC, errno.EDQUOT])
def test_the_counter_is_kept_in_the_reserve_of_a_full_disk_which_is_made_again(
    spacecraft, monkeypatch, error
):
    reserve = spacecraft.replay.path.with_name("mission.key.received.reserve")
    assert reserve.stat().st_size == RESERVE_BYTES
    is_full = True

    def full_disk(path: Path, content: bytes, like: Path | None = None) -> None:
        if is_full and (reserve.exists() or len(content) >= RESERVE_BYTES):
            raise OSError(error, os.strerror(error))
        write_whole(path, content, like)

    monkeypatch.setattr("flightsw.storage.store.write_whole", full_disk)
    assert spacecraft.send("ping")[-1] == ("completed", "alive")
    assert not reserve.exists()
    is_full = False
    assert spacecraft.send("ping")[-1] == ("completed", "alive")
    assert reserve.stat().st_size == RESERVE_BYTES


def test_on_a_disk_that_is_truly_full_safe_mode_is_entered_and_frames_are_deleted(
    tmp_path, small_mission, make_frame
):
    with contextlib.ExitStack() as opened:
        disk = opened.enter_context(small_disk(tmp_path / "disk", "512k"))
        spacecraft = Spacecraft(disk / "flight", small_mission, make_frame, frames=3)
        opened.callback(lambda: spacecraft.replay.close())
        fill_disk(disk / "log")
        packets = [
            spacecraft.seal("safe"),
            spacecraft.seal("arm", command="delete"),
            spacecraft.seal("delete", first_frame=0, last_frame=1),
        ]
        for packet in packets:
            spacecraft.commander.receive(packet)
            spacecraft.commander.poll()
        assert [text for stage, text in spacecraft.reports() if stage not in ("accepted", "started")] == [
            "no exposures until resumed",
            f"delete is armed for {DICTIONARY.arm_s} s",
            "2 frames deleted",
        ]
        spacecraft.restart()
        assert spacecraft.commander.settings.safe_mode
        assert [frame.frame_id for frame in spacecraft.store.frames] == [2]
        for packet in packets:
            spacecraft.commander.receive(packet)
        assert (spacecraft.commander.accepted, spacecraft.commander.repeated) == (0, 3)


@pytest.mark.parametrize("forged", ["no key on board", "wrong key", "cut", "flipped", "noise"])
def test_what_is_not_authentic_is_refused_counted_and_has_no_effect(spacecraft, forged):
    packet = bytearray(spacecraft.seal("near", near=2))
    if forged == "wrong key":
        packet = bytearray(seal(Key(1, bytes(32)), 1, Command("near", {"near": 2}).pack()))
    elif forged == "cut":
        del packet[-1]
    elif forged == "flipped":
        packet[-1] ^= 1
    elif forged == "noise":
        packet = bytearray(range(60))
    elif forged == "no key on board":
        mission, store = spacecraft.mission, spacecraft.store
        spacecraft.commander = Commander(None, store, mission, spacecraft.refusals.append)
    before = spacecraft.state()
    spacecraft.commander.receive(bytes(packet))
    told = spacecraft.commander.reports
    assert [(report.digest, report.stage) for report in told] == [(digest(bytes(packet)), "refused")]
    assert forged == "no key on board" or spacecraft.key.fingerprint in told[0].text
    assert spacecraft.state() == before
    assert spacecraft.commander.refused == len(spacecraft.refusals) == 1


@ANYTHING
@given(data=st.binary(max_size=120))
def test_an_authentic_packet_with_any_content_is_executed_in_range_or_refused(spacecraft, data):
    version = bytes([DICTIONARY.version])
    for content in (data, version + data):
        spacecraft.counter += 1
        spacecraft.commander.receive(seal(spacecraft.key, spacecraft.counter, content))
        stages = [stage for stage, _ in spacecraft.reports()]
        assert stages in (["refused"], ["accepted", "started", "completed"], ["accepted", "started"])
    assert 0 <= spacecraft.commander.settings.max_error_dn <= 16
    assert len(spacecraft.store.frames) == 3  # nothing destructive without arming


@pytest.mark.parametrize(
    "content", [b"\1\3\x11", b"\1\3\xff", b"\1\3", b"\1\3\1\1", b"\2\3\1", b"\1\xc8", b""]
)
def test_an_authentic_command_out_of_range_is_refused_and_has_no_effect(spacecraft, content):
    before = spacecraft.commander.settings
    spacecraft.counter += 1
    spacecraft.commander.receive(seal(spacecraft.key, spacecraft.counter, content))
    assert [stage for stage, _ in spacecraft.reports()] == ["refused"]
    assert (spacecraft.commander.settings, spacecraft.commander.refused) == (before, 1)


def test_exposures_longer_than_the_missions_spacing_are_refused(spacecraft):
    ((stage, text),) = spacecraft.send("bracket", exposure_times_ms=(0.1, 20_000.0))
    assert stage == "refused" and "interval_s: 27.0 s is shorter" in text
    assert spacecraft.commander.settings.exposure_times_ms is None


def test_delete_wants_arming_and_removes_just_the_named_frames(spacecraft):
    ((stage, text),) = spacecraft.send("delete", first_frame=0, last_frame=1)
    assert stage == "refused" and "arm delete" in text
    assert len(spacecraft.store.frames) == 3
    spacecraft.send("arm", command="delete")
    assert spacecraft.send("delete", first_frame=0, last_frame=1)[-1] == ("completed", "2 frames deleted")
    assert [frame.frame_id for frame in spacecraft.store.frames] == spacecraft.store.outbox() == [2]
    assert (
        spacecraft.send("delete", first_frame=2, last_frame=2)[0][0] == "refused"
    )  # armed once, not for ever


@pytest.mark.parametrize("spoiled_by", ["time", "another command", "arming another", "a restart"])
def test_arming_ends(spacecraft, spoiled_by):
    spacecraft.send("arm", command="resume" if spoiled_by == "arming another" else "delete")
    if spoiled_by == "time":
        spacecraft.now_s += DICTIONARY.arm_s + 0.1
    elif spoiled_by == "another command":
        spacecraft.send("ping")
    elif spoiled_by == "a restart":
        spacecraft.restart()
    assert spacecraft.send("delete", first_frame=0, last_frame=2)[0][0] == "refused"
    assert len(spacecraft.store.frames) == 3


def test_safe_mode_is_entered_at_once_and_left_only_when_armed(spacecraft):
    assert spacecraft.send("safe")[-1][0] == "completed"
    assert spacecraft.send("resume")[0][0] == "refused"
    assert spacecraft.commander.settings.safe_mode
    spacecraft.send("arm", command="resume")
    assert spacecraft.send("resume")[-1] == ("completed", "exposures go on")
    assert not spacecraft.commander.settings.safe_mode


def announce(spacecraft: Spacecraft, content: bytes, file_key: bytes = bytes(range(32))) -> str:
    """Announce a model and return the name under which it must come."""
    sha256 = hashlib.sha256(content).digest()
    reports = spacecraft.send("model", size_bytes=len(content), sha256=sha256, file_key=file_key)
    assert [stage for stage, _ in reports] == ["accepted", "started"]  # completed only when it is verified
    assert spacecraft.commander.upload is not None
    return spacecraft.commander.upload.file_name


def test_the_announced_file_is_taken_once_under_a_name_of_ours(spacecraft):
    name = announce(spacecraft, b"a model")
    sealed = seal_file(bytes(range(32)), b"a model")
    path = spacecraft.commander.receive_model(name, sealed)
    assert path == spacecraft.store.folder / f"{name}.received" and path.read_bytes() == b"a model"
    assert spacecraft.commander.receive_model(name, sealed) is None
    spacecraft.commander.end_model(path, None, "in use")
    assert spacecraft.reports() == [("completed", "in use")]


def test_each_model_that_has_come_has_its_own_file_and_its_own_end(spacecraft):
    paths = []
    for content in (b"a model", b"another model"):
        name = announce(spacecraft, content)
        paths.append(spacecraft.commander.receive_model(name, seal_file(bytes(range(32)), content)))
    assert [path.read_bytes() for path in paths] == [b"a model", b"another model"]
    for path, problem in zip(paths, (None, "of another camera"), strict=True):
        spacecraft.commander.end_model(path, problem, "in use")
    ends = [(report.counter, report.stage, report.text) for report in spacecraft.commander.reports]
    assert ends == [(1, "completed", "in use"), (2, "failed", "of another camera")]


def test_a_model_that_is_announced_in_place_of_another_ends_that_ones_command(spacecraft):
    first = announce(spacecraft, b"a model")
    arguments = {"size_bytes": 3, "sha256": hashlib.sha256(b"new").digest(), "file_key": bytes(32)}
    spacecraft.commander.receive(spacecraft.seal("model", **arguments))
    assert [(report.counter, report.stage, report.text) for report in spacecraft.commander.reports] == [
        (2, "accepted", "model"),
        (2, "started", "model"),
        (1, "failed", "replaced by command 2"),
    ]
    assert spacecraft.commander.receive_model(first, seal_file(bytes(range(32)), b"a model")) is None
    assert spacecraft.commander.receive_model("model-2", seal_file(bytes(32), b"new")) is not None


@pytest.mark.parametrize("name", ["../model-1", "/etc/passwd", "model-2", "model.onnx", "", "model-1\0"])
def test_a_file_under_any_other_name_is_left_alone(spacecraft, name):
    announce(spacecraft, b"a model")
    before = set(spacecraft.store.folder.parent.rglob("*"))
    assert spacecraft.commander.receive_model(name, seal_file(bytes(range(32)), b"a model")) is None
    assert spacecraft.commander.upload is not None  # the right one may still come
    assert set(spacecraft.store.folder.parent.rglob("*")) == before


@pytest.mark.parametrize("content", [b"another", b"a mode", b"a model and more"])
def test_a_file_that_is_not_the_announced_one_is_reported_and_not_kept(spacecraft, content):
    name = announce(spacecraft, b"a model")
    assert spacecraft.commander.receive_model(name, seal_file(bytes(range(32)), content)) is None
    assert [stage for stage, _ in spacecraft.reports()] == ["failed"]
    assert not list(spacecraft.store.folder.glob("model*"))
    name = announce(spacecraft, b"a model")
    assert spacecraft.commander.receive_model(name, seal_file(bytes(32), b"a model")) is None
    assert [stage for stage, _ in spacecraft.reports()] == ["failed"]


@pytest.mark.parametrize("damage", ["no key", "no counter", "another key's counter", "damaged counter"])
def test_without_a_trustworthy_counter_no_command_is_taken_at_all(tmp_path, damage):
    key_file = tmp_path / "mission.key"
    make_key(key_file)
    received = tmp_path / "mission.key.received"
    if damage == "no key":
        key_file.unlink()
    elif damage == "no counter":
        received.unlink()
    else:
        received.write_text(Key(1, bytes(32)).counter_text(3) if damage.startswith("another") else "3\n")
    with pytest.raises(ConfigError, match=r"mission\.key"):
        ReplayCounter(key_file)


def test_two_processes_cannot_share_a_counter(spacecraft):
    with pytest.raises(ConfigError, match="another process takes commands"):
        ReplayCounter(spacecraft.key_file)


def test_frames_are_deleted_some_a_turn_and_the_command_ends_when_all_are(spacecraft, make_frame):
    for _ in range(9):
        spacecraft.store.put(make_frame(spacecraft.store.next_frame_id))
    packets = [
        spacecraft.seal("arm", command="delete"),
        spacecraft.seal("delete", first_frame=0, last_frame=9),
        spacecraft.seal("ping"),
    ]
    for packet in packets:
        spacecraft.commander.receive(packet)
    assert len(spacecraft.store.frames) == 12  # nothing is deleted where packets are received
    spacecraft.store.drop(5)  # meanwhile for another frame's room
    spacecraft.tick_s = DELETE_S / 3
    turns = 0
    while len(spacecraft.store.frames) > 2:
        before = len(spacecraft.store.frames)
        stages = [report.stage for report in spacecraft.commander.reports if report.counter == 2]
        assert stages == ["accepted", "started"]
        spacecraft.commander.poll()
        turns += 1
        assert before - len(spacecraft.store.frames) <= 4
    assert turns >= 3
    spacecraft.commander.poll()
    ends = [(r.counter, r.text) for r in spacecraft.commander.reports if r.stage == "completed"]
    assert ends[1:] == [(3, "alive"), (2, "10 frames deleted")]


def half_deleted(spacecraft, make_frame) -> bytes:
    """Begin to delete the frames 0 to 9 of six, take one more, and lose the power; return the command's packet."""
    for _ in range(3):
        spacecraft.store.put(make_frame(spacecraft.store.next_frame_id))
    spacecraft.send("arm", command="delete")
    packet = spacecraft.seal("delete", first_frame=0, last_frame=9)
    spacecraft.commander.receive(packet)
    spacecraft.store.put(make_frame(spacecraft.store.next_frame_id))
    spacecraft.tick_s = DELETE_S
    spacecraft.commander.poll()
    spacecraft.tick_s = 0.0
    assert 1 < len(spacecraft.store.frames) < 6
    spacecraft.store = FrameStore(spacecraft.store.folder)
    spacecraft.restart()
    return packet


def test_a_deletion_goes_on_after_a_restart_and_its_command_hears_of_it(spacecraft, make_frame, caplog):
    packet = half_deleted(spacecraft, make_frame)
    spacecraft.commander.poll()
    ((stage, text),) = spacecraft.reports()
    assert (stage, text) == ("completed", "6 frames deleted")
    assert [frame.frame_id for frame in spacecraft.store.frames] == [6]  # taken after the command
    assert "the deletion of command 2 goes on after a restart" in caplog.text
    assert not list(spacecraft.store.folder.glob("deletions*"))
    spacecraft.commander.receive(packet)  # the ground had no answer
    assert spacecraft.reports() == [("completed", "6 frames deleted")]


def test_a_new_deletion_does_not_replace_the_one_of_before_the_restart(spacecraft, make_frame):
    half_deleted(spacecraft, make_frame)
    spacecraft.commander.receive(spacecraft.seal("arm", command="delete"))
    spacecraft.commander.receive(spacecraft.seal("delete", first_frame=6, last_frame=6))
    spacecraft.restart()
    spacecraft.commander.poll()
    assert [end[1] for end in spacecraft.reports()] == ["6 frames deleted", "1 frame deleted"]
    assert not spacecraft.store.frames


def test_a_note_of_a_deletion_that_is_damaged_twice_is_told_and_nothing_is_deleted_by_it(
    spacecraft, make_frame, caplog
):
    half_deleted(spacecraft, make_frame)
    for path in spacecraft.store.folder.glob("deletions*"):
        path.write_bytes(path.read_bytes().replace(b'"last": 5', b'"last": 7'))
    before = spacecraft.store.frames
    for _ in range(2):
        spacecraft.restart()
        spacecraft.commander.poll()
    assert spacecraft.store.frames == before and spacecraft.reports() == []
    assert caplog.text.count("may be left half done, command it again") == 1


@pytest.mark.parametrize("mode", [0o600, 0o640])
def test_what_is_written_of_a_counter_can_be_read_by_those_only_who_can_read_the_key(tmp_path, mode):
    key_file = tmp_path / "k"
    make_key(key_file)
    key_file.chmod(mode)
    move_counter(key_file, 5)
    keys = KeyRing([key_file])
    keys.counters[0].advance(41)
    keys.close()
    (tmp_path / "k.received").unlink()  # of which the copy is left
    ReplayCounter(key_file).close()
    modes = {
        name: (tmp_path / f"k.{name}").stat().st_mode & 0o777
        for name in ("received", "received.copy", "sent.copy")
    }
    assert modes == dict.fromkeys(modes, mode)


@pytest.mark.parametrize("suffix", ["", ".copy"])
def test_no_flipped_bit_of_a_counter_file_takes_a_command_away_or_lets_one_in_again(tmp_path, suffix):
    key_file = tmp_path / "k"
    key = make_key(key_file)
    keys = KeyRing([key_file])
    keys.counters[0].advance(41)
    keys.close()
    damaged = tmp_path / f"k.received{suffix}"
    good = damaged.read_bytes()
    contents = [good[:size] for size in range(0, len(good), 7)]
    for bit in range(8 * len(good)):
        content = bytearray(good)
        content[bit // 8] ^= 1 << bit % 8
        contents.append(bytes(content))
    for content in contents:
        damaged.write_bytes(content)
        counter = ReplayCounter(key_file)
        counter.close()
        assert counter.last == 41 and damaged.read_bytes() == good, content
    damaged.unlink()
    counter = ReplayCounter(key_file)
    counter.close()
    assert counter.last == 41 and damaged.read_bytes() == good
    damaged.write_text(key.counter_text(40))  # the power went between the two, or one is from a backup
    counter = ReplayCounter(key_file)
    counter.close()
    assert counter.last == 41 and damaged.read_bytes() == good


def test_a_counter_file_of_an_earlier_version_is_taken_over(tmp_path):
    key = make_key(tmp_path / "k")
    (tmp_path / "k.received").write_text(f"41 {key.fingerprint}\n")
    counter = ReplayCounter(tmp_path / "k")
    counter.close()
    assert counter.last == 41
    assert (tmp_path / "k.received").read_text() == key.counter_text(41)


def test_without_a_usable_counter_every_command_is_refused_with_the_reason(spacecraft):
    spacecraft.keys.close()
    packet = spacecraft.seal("ping")
    for name in ("mission.key.received", "mission.key.received.copy"):
        spacecraft.key_file.with_name(name).write_bytes(b"")
    keys = KeyRing([spacecraft.key_file])
    spacecraft.keys = keys
    commander = Commander(keys, spacecraft.store, spacecraft.mission, spacecraft.refusals.append)
    commander.receive(packet)
    ((report,), (refusal,)) = commander.reports, spacecraft.refusals
    assert "neither the counter nor its copy can be used" in keys.problems[0]
    assert report.text == refusal == keys.problems[0] and report.stage == "refused"


def test_a_packet_with_a_used_counter_is_never_answered_with_the_end_of_another(spacecraft):
    assert spacecraft.send("near", near=1)[-1] == ("completed", "NEAR 1")
    spacecraft.send("ping")
    spacecraft.now_s += ANSWER_S
    spacecraft.counter = 0  # the ground's counter comes from a backup
    ((stage, text),) = spacecraft.send("safe")
    assert stage == "refused" and "counter 1 was used by another command, the last is 2" in text
    assert "--counter 2" in text and not spacecraft.commander.settings.safe_mode


def test_a_key_takes_the_place_of_another_which_is_then_retired(spacecraft):
    old, new_file = spacecraft.key, spacecraft.key_file.with_name("new.key")
    new = make_key(new_file, spi=2)
    spacecraft.keys.close()
    restart = [spacecraft.key_file, new_file]
    spacecraft.keys = KeyRing(restart)

    def commander() -> Commander:
        return Commander(spacecraft.keys, spacecraft.store, spacecraft.mission, clock_s=lambda: 1e3)

    def send(on_board: Commander, sealing: Key, counter: int, name: str, **arguments) -> tuple[str, str]:
        on_board.receive(seal(sealing, counter, Command(name, arguments).pack()))
        reports, on_board.reports[:] = list(on_board.reports), []
        return reports[-1].stage, reports[-1].text

    on_board = commander()
    assert send(on_board, old, 1, "ping") == ("completed", "alive")
    assert send(on_board, new, 1, "ping") == ("completed", "alive")  # each key has a counter of its own
    assert send(on_board, new, 2, "retire", key=1)[0] == "refused"  # not armed
    for counter, key, problem in ((3, 2, "would retire itself"), (5, 9, "there is no key 9 on board")):
        send(on_board, new, counter, "arm", command="retire")
        stage, text = send(on_board, new, counter + 1, "retire", key=key)
        assert stage == "refused" and problem in text
    send(on_board, new, 7, "arm", command="retire")
    stage, text = send(on_board, new, 8, "retire", key=1)
    assert stage == "completed" and old.fingerprint in text
    spacecraft.keys.close()
    spacecraft.keys = KeyRing(restart)
    assert not spacecraft.keys.problems
    assert send(commander(), old, 2, "safe") == ("refused", "key 1 is retired")
    assert send(commander(), old, MAX_COUNTER, "safe") == ("refused", "key 1 is retired")
    assert send(commander(), new, 9, "ping") == ("completed", "alive")


def test_two_keys_of_one_number_are_told_and_the_first_counts(tmp_path):
    for name in ("a", "b"):
        make_key(tmp_path / name)
    keys = KeyRing([tmp_path / "a", tmp_path / "b", tmp_path / "none"])
    keys.close()
    assert [counter.path.name for counter in keys.counters] == ["a.received"]
    assert "another key has the number 1 already" in keys.problems[0] and "none" in keys.problems[1]
