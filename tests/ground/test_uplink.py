"""Commands on the ground: sealed, each with its own counter, repeated until the result is known, executed once."""

import contextlib
import itertools
import json
import math
import os
import random
import socket
import threading
import time
from pathlib import Path

import onnx
import pytest
from typer.testing import CliRunner

from flightsw.downlink.commands import Commander, KeyRing
from flightsw.icd.command import Command, Report
from flightsw.icd.link.auth import Key, digest, unseal, unseal_file
from flightsw.icd.mission import ConfigError
from flightsw.icd.model_file import SENSOR_METADATA
from flightsw.icd.model_file import check_model as check_model_bytes
from flightsw.storage.store import FrameStore
from ground import cli
from ground.commands import uplink as uplink_commands
from ground.link import uplink as uplinking
from ground.link.ingest import listen
from ground.link.uplink import (
    COUNTER_MARGIN,
    EXAMPLES,
    Uplinker,
    check_model,
    in_words,
    is_listening,
    listening,
    make_key,
    move_counter,
    outcome,
    parse_command,
    parse_script,
    submit,
    withdraw,
)
from ground.session.folder import SessionError
from obbgs_base.checked import checked_line, parse_checked_line
from obbgs_base.command_line import USAGE_ERROR

INTERVAL_S = 0.5


@pytest.fixture
def key_file(tmp_path) -> Path:
    make_key(tmp_path / "mission.key")
    return tmp_path / "mission.key"


@pytest.fixture
def session(tmp_path) -> Path:
    (tmp_path / "session").mkdir()
    return tmp_path / "session"


def test_a_key_is_readable_by_its_owner_only_and_never_overwritten(key_file):
    for suffix in ("", ".sent", ".received"):
        assert key_file.with_name(key_file.name + suffix).stat().st_mode & 0o777 == 0o600
    before = key_file.read_text()
    with pytest.raises(ConfigError, match="never overwritten"):
        make_key(key_file)
    assert key_file.read_text() == before


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["ping"], {}),
        (["bracket", "0.05,0.1"], {"exposure_times_ms": (0.05, 0.1)}),
        (["near", "2"], {"near": 2}),
        (["priority", "triage"], {"order": "triage"}),
        (["arm", "delete"], {"command": "delete"}),
        (["delete", "3", "7"], {"first_frame": 3, "last_frame": 7}),
        (["safe"], {}),
        (["resume"], {}),
    ],
)
def test_a_command_line_becomes_a_command(words, expected):
    command, model = parse_command(words[0], words[1:])
    assert (command.name, command.arguments, model) == (words[0], expected, None)
    assert Command.unpack(command.pack()) == command


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ("fire", "`fire`: no command 'fire'; there are "),
        ("ping now", "`ping now`: expected no arguments"),
        ("bracket", "`bracket`: expected `bracket 0.02,0.05,0.1`"),
        ("bracket a,b", "`bracket a,b`: expected a number, got 'a'"),
        ("near x", "`near x`: expected a whole number, got 'x'"),
        ("near 99", "`near 99`: near: expected 0 to 16 DN, got 99"),
        ("delete 3", "`delete 3`: expected `delete 0 39`"),
        ("arm", "`arm`: expected `arm delete` or `arm resume` or `arm retire`"),
        ("resend 3 0", "`resend 3 0`: expected the number of the first frame before that of the last"),
        ("resend x", "`resend x`: expected `resend 0 39` or `resend all`"),
        ("priority newest", "`priority newest`: order: expected one of oldest, triage, thumbnail-first"),
        ("retire 99999", "`retire 99999`: key: expected 1 to 65534, got 99999"),
    ],
)
def test_a_command_line_that_is_none_repeats_what_was_given_and_says_what_is_expected(words, told):
    name, *arguments = words.split()
    with pytest.raises(ValueError) as caught:
        parse_command(name, arguments)
    assert str(caught.value).startswith(told) and "\n" not in str(caught.value)


def test_what_a_message_expects_is_taken():
    for name, example in EXAMPLES.items():
        for words in example.split("` or `"):
            assert parse_command(name, words.split()[1:])[0].name == name


def test_every_command_has_a_counter_of_its_own_even_when_made_at_once(session, key_file):
    counters: list[int] = []

    def work() -> None:
        counters.extend(submit(session, key_file, Command("ping", {}), None, 60) for _ in range(10))

    threads = [threading.Thread(target=work) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(counters) == list(range(1, 41))
    key = Key.parse(key_file.read_text(), "k")
    jobs = [json.loads(path.read_text()) for path in sorted((session / "uplink").glob("*.json"))]
    assert [unseal(key, bytes.fromhex(job["packet"]))[0] for job in jobs] == list(range(1, 41))


def test_a_command_out_of_range_spends_no_counter(session, key_file):
    with pytest.raises(ValueError, match="near"):
        submit(session, key_file, Command("near", {"near": 99}), None, 60)
    assert submit(session, key_file, Command("ping", {}), None, 60) == 1


def test_a_lost_counter_stops_all_commands(session, key_file):
    key_file.with_name("mission.key.sent").unlink()
    with pytest.raises(ConfigError, match=r"mission\.key\.sent: .*\(No such file or directory\)"):
        submit(session, key_file, Command("ping", {}), None, 60)
    assert not list((session / "uplink").iterdir())


def test_a_model_is_sealed_and_announced_by_size_and_hash(session, key_file, tmp_path):
    (tmp_path / "m.onnx").write_bytes(b"weights" * 100)
    counter = submit(session, key_file, Command("model", {}), tmp_path / "m.onnx", 60)
    job = json.loads((session / "uplink" / f"{counter:020d}.json").read_text())
    sealed = (session / "uplink" / f"{counter:020d}.bin").read_bytes()
    key = Key.parse(key_file.read_text(), "k")
    command = Command.unpack(unseal(key, bytes.fromhex(job["packet"]))[1])
    assert b"weights" not in sealed + json.dumps(job).encode()
    assert unseal_file(command.arguments["file_key"], sealed) == b"weights" * 100
    assert command.arguments["size_bytes"] == 700


@pytest.mark.parametrize("loss", [0.0, 0.3, 0.7])
def test_whatever_is_lost_each_command_is_executed_once_and_its_end_is_known(
    session, key_file, tmp_path, small_mission, loss
):
    draw = random.Random(5).random
    replay = KeyRing([key_file])
    now_s = 0.0
    commander = Commander(replay, FrameStore(tmp_path / "store"), small_mission, clock_s=lambda: now_s)
    uplinker = Uplinker(session, 1000, INTERVAL_S)
    counters = [submit(session, key_file, Command("near", {"near": n}), None, 600) for n in range(6)]
    while now_s < 300 and any(outcome(session, counter) is None for counter in counters):
        now_s += 0.05
        packet = uplinker.next_command(now_s)
        if packet is not None and draw() >= loss:
            commander.receive(packet)
        reports, commander.reports[:] = list(commander.reports), []
        for report in reports:
            if draw() >= loss:
                uplinker.take_report(Report.unpack(report.pack()), now_s)
    replay.close()
    ends = [outcome(session, counter) for counter in counters]
    assert [end["stage"] for end in ends if end] == ["completed"] * 6
    assert (commander.accepted, commander.refused) == (6, 0)
    assert (commander.repeated > 0) == (loss > 0)
    assert commander.settings.max_error_dn == 5
    assert not uplinker.jobs and not list((session / "uplink").glob("*[0-9].json"))


def test_a_listener_that_starts_again_goes_on_with_what_is_left(session, key_file, tmp_path, small_mission):
    replay = KeyRing([key_file])
    commander = Commander(replay, FrameStore(tmp_path / "store"), small_mission)
    counter = submit(session, key_file, Command("near", {"near": 3}), None, 600)
    packet = Uplinker(session, 1000, INTERVAL_S).next_command(0.0)
    assert packet is not None
    commander.receive(packet)
    commander.reports.clear()  # lost; and the listener is killed
    again = Uplinker(session, 1000, INTERVAL_S)
    assert again.next_command(0.0) == packet
    commander.receive(packet)
    for report in commander.reports:
        again.take_report(report, 0.0)
    replay.close()
    end = outcome(session, counter)
    assert end is not None and [report["stage"] for report in end["reports"]] == [
        "accepted",
        "started",
        "completed",
    ]
    assert (commander.accepted, commander.repeated) == (1, 1)


def test_a_command_that_nobody_answers_expires_and_one_that_is_withdrawn_is_not_sent(session, key_file):
    late_ns = 0
    uplinker = Uplinker(
        session, 1000, INTERVAL_S, elapsed_ns=lambda: time.monotonic_ns() + late_ns, utc_ns=lambda: 10**19
    )
    first, second = (submit(session, key_file, Command("ping", {}), None, 600) for _ in range(2))
    withdraw(session, second)
    assert uplinker.next_command(0.0) is not None
    assert uplinker.next_command(0.1) is None  # sent again after an interval, not before
    assert uplinker.next_command(2 * INTERVAL_S) is not None
    late_ns = 601 * 10**9
    assert uplinker.next_command(10.0) is None
    end = outcome(session, first)
    assert end is not None and (end["stage"], end["text"]) == ("failed", "no answer in time")
    assert outcome(session, second) is None


def test_a_model_s_file_that_is_under_way_is_sent_to_its_end(session, key_file, tmp_path, small_mission):
    (tmp_path / "m.onnx").write_bytes(bytes(range(256)) * 40)
    late_ns = 0
    uplinker = Uplinker(session, 200, INTERVAL_S, elapsed_ns=lambda: time.monotonic_ns() + late_ns)
    counter = submit(session, key_file, Command("model", {}), tmp_path / "m.onnx", 600)
    assert uplinker.next_command(0.0) is not None
    mark = digest(uplinker.jobs[counter].packet)
    uplinker.take_report(Report(0, counter, mark, "accepted", ""), 0.1)
    assert uplinker.next_pdu(0.2) is not None
    late_ns = 601 * 10**9
    uplinker.next_command(10.0)
    assert outcome(session, counter) is None and uplinker.next_pdu(10.1) is not None
    uplinker.take_report(Report(0, counter, mark, "completed", "in use"), 11.0)
    end = outcome(session, counter)
    assert end is not None and end["stage"] == "completed"


@pytest.mark.parametrize("expires_s", [math.inf, 1e300])
def test_a_time_without_end_spends_no_counter(session, key_file, expires_s):
    with pytest.raises(OverflowError):
        submit(session, key_file, Command("ping", {}), None, expires_s)
    assert submit(session, key_file, Command("ping", {}), None, 60) == 1


def test_a_new_keys_first_command_is_not_answered_with_the_end_of_an_old_one(session, key_file, tmp_path):
    uplinker = Uplinker(session, 1000, INTERVAL_S)
    counter = submit(session, key_file, Command("ping", {}), None, 600)
    packet = uplinker.next_command(0.0)
    assert packet is not None
    uplinker.take_report(Report(0, counter, digest(packet), "completed", "alive"), 0.0)
    ended = outcome(session, counter)
    assert ended and ended["reports"][0]["digest"] == digest(packet).hex()
    make_key(tmp_path / "new.key")
    waiting = submit(session, tmp_path / "new.key", Command("ping", {}), None, 600)
    third = submit(session, key_file, Command("ping", {}), None, 600)
    assert len({counter, waiting, third}) == 3  # each has files of its own in the session
    assert outcome(session, waiting) is None and outcome(session, counter) == ended


@pytest.mark.parametrize(
    "content",
    [
        '{"packet": "zz"}',
        '{"packet": "00", "command": "ping", "boot": "", "expires_ns": Infinity}',
        "[" * 100_000,
        "7",
    ],
    ids=["hex", "infinity", "deep", "number"],
)
def test_strange_files_in_the_folder_are_left_alone_and_damaged_jobs_removed(session, key_file, content):
    folder = session / "uplink"
    folder.mkdir()
    (folder / "../outside.json").write_text("{}")
    for name in ("notes.txt", "1.json", f"{5:020d}.json.part"):
        (folder / name).write_text("{}")
    (folder / f"{6:020d}.json").write_text(content)
    assert Uplinker(session, 1000, INTERVAL_S).next_command(0.0) is None
    assert {path.name for path in folder.iterdir()} == {"notes.txt", "1.json", f"{5:020d}.json.part"}


def test_reports_of_commands_that_are_not_ours_change_nothing(session, key_file):
    uplinker = Uplinker(session, 1000, INTERVAL_S)
    counter = submit(session, key_file, Command("ping", {}), None, 600)
    packet = uplinker.next_command(0.0)
    assert packet is not None
    uplinker.take_report(Report(0, counter + 1, digest(packet), "completed", "another's"), 0.0)
    uplinker.take_report(Report(0, counter, digest(packet[:-1]), "completed", "on another packet"), 0.0)
    assert outcome(session, counter) is None and outcome(session, counter + 1) is None


def test_a_second_listener_is_refused_before_it_touches_the_session(tmp_path, small_mission):
    folder = tmp_path / "s"
    master, slave = os.openpty()
    try:
        with listening(folder):
            (folder / "frames.jsonl").write_text('{"id": 1, half a line')
            with pytest.raises(SessionError, match="another process listens"):
                listen(f"serial://{os.ttyname(slave)}", folder, small_mission)
            assert (folder / "frames.jsonl").read_text() == '{"id": 1, half a line'
            assert not (folder / "session.json").exists()
    finally:
        os.close(master)
        os.close(slave)


def test_one_process_listens_into_a_session(session):
    assert not is_listening(session)
    with listening(session):
        assert is_listening(session)
        with pytest.raises(SessionError, match="another process listens"), listening(session):
            pass
    assert not is_listening(session)


def test_a_script_is_read_whole_before_anything_is_sent(tmp_path):
    """The second line's time is out of range, the third line's file is not there: neither costs a counter."""
    made = parse_script("# a pass\nbracket 0.05,0.1  # shorter\n\narm delete\ndelete 0 3\n")
    assert [in_words(*each) for each in made] == ["bracket 0.05,0.1", "arm delete", "delete 0 3"]
    for text, told in (
        ("ping\nnear 99", "line 2 of the script"),
        (f"ping\nping\nmodel {tmp_path / 'none.onnx'}", "line 3 of the script: .*is no file"),
        ("fire", "line 1 of the script: `fire`: no command 'fire'"),
        ("bracket '0.05", "line 1 of the script"),
        ("# nothing\n", "holds no command"),
    ):
        with pytest.raises(ValueError, match=told):
            parse_script(text)


def test_a_script_stops_at_the_first_command_that_is_not_completed_and_one_history_tells_all(
    session, key_file, tmp_path, small_mission
):
    """The real command line, listener's side and spacecraft's side, joined without a wire."""
    replay, stop = KeyRing([key_file]), threading.Event()
    commander = Commander(replay, FrameStore(tmp_path / "store"), small_mission)

    def listener() -> None:
        uplinker, now_s = Uplinker(session, 1000, INTERVAL_S), 0.0
        while not stop.wait(0.01):
            now_s += 1.0
            if (packet := uplinker.next_command(now_s)) is not None:
                commander.receive(packet)
            for report in commander.reports:
                uplinker.take_report(report, now_s)
            commander.reports.clear()

    (tmp_path / "script").write_text("near 3\ndelete 0 9  # without arm\nping\n")
    options = ("--session", str(session), "--key", str(key_file))
    with listening(session):
        thread = threading.Thread(target=listener)
        thread.start()
        try:
            ran = CliRunner().invoke(cli.app, ["uplink", "--script", str(tmp_path / "script"), *options])
            alone = CliRunner().invoke(cli.app, ["uplink", "ping", *options])
        finally:
            stop.set()
            thread.join()
            replay.close()
    assert ran.exit_code == 1 and alone.exit_code == 0
    assert "near 3: completed" in ran.output and "delete 0 9: refused" in ran.output
    assert "not sent: 1 more" in ran.output and "ping" not in ran.output
    history = [json.loads(line) for line in (session / "commands.jsonl").read_text().splitlines()]
    assert [(line["given"], line["stage"]) for line in history] == [
        ("near 3", "completed"),
        ("delete 0 9", "refused"),
        ("ping", "completed"),
    ]


class Joined:
    """Both sides of the command path, joined without a wire; each step is half a second."""

    def __init__(self, session: Path, keys: KeyRing, store: Path, mission):
        self.now_s = 0.0
        self.commander = Commander(keys, FrameStore(store), mission, clock_s=lambda: self.now_s)
        self.uplinker = Uplinker(session, 1000, INTERVAL_S)
        self._session = session

    def ask(self, key_file: Path, name: str, **arguments) -> tuple[str, str]:
        """Return how a command ends, within ten seconds."""
        counter = submit(self._session, key_file, Command(name, arguments), None, 600)
        for _ in range(20):
            self.now_s += 0.5
            if (packet := self.uplinker.next_command(self.now_s)) is not None:
                self.commander.receive(packet)
            self.commander.poll()
            for report in self.commander.reports:
                self.uplinker.take_report(Report.unpack(report.pack()), self.now_s)
            self.commander.reports.clear()
            if (end := outcome(self._session, counter)) is not None:
                return end["stage"], end["text"]
        raise AssertionError(f"{name} has no end")


def test_a_counter_from_a_backup_is_told_and_moved_forward(session, key_file, tmp_path, small_mission):
    keys = KeyRing([key_file])
    both = Joined(session, keys, tmp_path / "store", small_mission)
    backup = {path: path.read_bytes() for path in tmp_path.glob("mission.key.sent*")}
    assert both.ask(key_file, "ping") == ("completed", "alive")
    assert both.ask(key_file, "near", near=2)[0] == "completed"
    for path in tmp_path.glob("mission.key.sent*"):
        path.unlink()
    for path, content in backup.items():
        path.write_bytes(content)
    for done in (session / "uplink").iterdir():  # a second station has a session of its own
        done.unlink()
    for number in (1, 2):
        stage, text = both.ask(key_file, "safe")
        assert stage == "refused" and f"counter {number} was used by another command, the last is 2" in text
    assert not both.commander.settings.safe_mode
    moved = CliRunner().invoke(cli.app, ["key", str(key_file), "--counter", "2"])
    assert moved.exit_code == 0 and str(2 + COUNTER_MARGIN + 1) in moved.output
    assert both.ask(key_file, "safe")[0] == "completed" and both.commander.settings.safe_mode
    keys.close()


def test_a_lost_or_damaged_counter_is_made_anew_and_never_goes_back(session, key_file):
    sent = key_file.with_name("mission.key.sent")
    assert submit(session, key_file, Command("ping", {}), None, 60) == 1
    sent.write_bytes(sent.read_bytes().replace(b"1", b"0", 1))  # one of two is enough
    assert submit(session, key_file, Command("ping", {}), None, 60) == 2
    assert move_counter(key_file, 0) == 2 + COUNTER_MARGIN  # a smaller number moves it forward all the same
    for path in (sent, sent.with_name("mission.key.sent.copy")):
        path.write_bytes(b"")
    with pytest.raises(ConfigError, match=r"`ground key .* --counter N` makes it anew"):
        submit(session, key_file, Command("ping", {}), None, 60)
    assert move_counter(key_file, 41) == 41 + COUNTER_MARGIN
    assert submit(session, key_file, Command("ping", {}), None, 60) == 42 + COUNTER_MARGIN
    with pytest.raises(ConfigError, match="expected less than"):
        move_counter(key_file, (1 << 64) - 2)


@pytest.mark.parametrize("spi", [1, 2])
def test_a_wrong_key_is_told_at_the_first_answer(session, key_file, tmp_path, small_mission, spi):
    keys = KeyRing([key_file])
    make_key(tmp_path / "other.key", spi)
    both = Joined(session, keys, tmp_path / "store", small_mission)
    stage, text = both.ask(tmp_path / "other.key", "ping")
    assert stage == "refused" and keys.counters[0].key.fingerprint in text
    assert both.now_s < 2 * INTERVAL_S
    keys.close()


def test_two_keys_command_through_one_session(session, key_file, tmp_path, small_mission):
    new_file = tmp_path / "new.key"
    make_key(new_file, 2)
    keys = KeyRing([key_file, new_file])
    both = Joined(session, keys, tmp_path / "store", small_mission)
    for each in (key_file, new_file, new_file, key_file):
        assert both.ask(each, "ping") == ("completed", "alive")
    keys.close()


@pytest.mark.parametrize("step_s", [-1e9, -600, 600, 1e9])
def test_a_step_of_the_ground_s_clock_ends_no_command(session, key_file, step_s):
    step_ns = 0
    uplinker = Uplinker(session, 1000, INTERVAL_S, utc_ns=lambda: time.time_ns() + step_ns)
    counter = submit(session, key_file, Command("ping", {}), None, 120)
    packet = uplinker.next_command(0.0)
    assert packet is not None
    step_ns = int(step_s * 1e9)
    assert uplinker.next_command(2 * INTERVAL_S) == packet
    assert outcome(session, counter) is None and counter in uplinker.jobs


def test_a_command_from_before_the_computer_started_is_not_sent(session, key_file):
    """Elapsed time begins anew at each start: how long such a command may still be sent is not known."""
    counter = submit(session, key_file, Command("ping", {}), None, 600)
    path = session / "uplink" / f"{counter:020d}.json"
    path.write_bytes(checked_line(parse_checked_line(path.read_bytes()) | {"boot": "another"}))
    assert Uplinker(session, 1000, INTERVAL_S).next_command(0.0) is None
    end = outcome(session, counter)
    assert end is not None and end["stage"] == "failed"


def test_a_folder_that_cannot_be_read_is_told_once_and_the_listener_goes_on(
    session, key_file, monkeypatch, caplog
):
    first = submit(session, key_file, Command("ping", {}), None, 600)
    uplinker = Uplinker(session, 1000, INTERVAL_S)
    packet = uplinker.next_command(0.0)
    real, is_refused = os.listdir, True

    def listdir(path) -> list[str]:  # as root no right is missing: another user's folder refuses so
        if is_refused:
            raise PermissionError(13, "Permission denied", str(path))
        return real(path)

    monkeypatch.setattr("ground.link.uplink.os.listdir", listdir)
    submit(session, key_file, Command("ping", {}), None, 600)
    for step in range(1, 20):
        assert uplinker.next_command(step * INTERVAL_S) in (None, packet)
    assert list(uplinker.jobs) == [first]  # what is known already goes on
    assert len([record for record in caplog.records if "may not look" in record.message]) == 1
    is_refused = False
    uplinker.next_command(99.0)
    assert len(uplinker.jobs) == 2


@pytest.mark.parametrize(
    "kind", ["fifo", "folder", "full folder", "socket", "dangling", "endless", "long packet"]
)
def test_nothing_that_lies_in_the_folder_stops_the_listener(session, key_file, caplog, kind):
    folder = session / "uplink"
    folder.mkdir()
    path = folder / f"{1:020d}.json"
    if kind == "fifo":
        os.mkfifo(path)
    elif "folder" in kind:
        (path / "within").mkdir(parents=True) if "full" in kind else path.mkdir()
    elif kind == "socket":
        with socket.socket(socket.AF_UNIX) as server, contextlib.chdir(folder):
            server.bind(path.name)
    elif kind == "dangling":
        path.symlink_to("nowhere")
    elif kind == "endless":
        path.symlink_to("/dev/zero")
    else:
        path.write_text(json.dumps({"packet": "00" * 5000, "command": "x", "boot": "", "expires_ns": 1}))
    uplinker = Uplinker(session, 1000, INTERVAL_S)
    counter = submit(session, key_file, Command("ping", {}), None, 600)
    for step in range(9):
        uplinker.next_command(step * INTERVAL_S)
    assert list(uplinker.jobs) == [counter]
    assert len(caplog.records) <= 2


def test_a_result_that_cannot_be_written_is_not_sent_for_again(session, key_file, monkeypatch, caplog):
    uplinker = Uplinker(session, 1000, INTERVAL_S)
    counter = submit(session, key_file, Command("ping", {}), None, 600)
    packet = uplinker.next_command(0.0)
    assert packet is not None

    def refuse(*_: object, **__: object) -> None:
        raise PermissionError(13, "Permission denied")

    with monkeypatch.context() as patched:
        patched.setattr("ground.link.uplink.write_whole", refuse)
        patched.setattr(Path, "unlink", refuse)
        uplinker.take_report(Report(0, counter, digest(packet), "completed", "alive"), 0.1)
    assert [uplinker.next_command(step) for step in range(1, 9)] == [None] * 8


def foreign_model(**metadata: str) -> bytes:
    """Return a model of one standard operator, made by the onnx package."""
    port = onnx.helper.make_tensor_value_info("x", onnx.TensorProto.FLOAT, [1])
    out = onnx.helper.make_tensor_value_info("y", onnx.TensorProto.FLOAT, [1])
    graph = onnx.helper.make_graph([onnx.helper.make_node("Abs", ["x"], ["y"])], "g", [port], [out])
    model = onnx.helper.make_model(graph)
    onnx.helper.set_model_props(model, metadata)
    return model.SerializeToString()


def test_metadata_is_read_from_a_model_s_bytes_as_the_onnx_package_wrote_it():
    metadata = {"width": "64", "black_dn": "1.5", "größe": "ä", "empty": ""}
    assert check_model_bytes(foreign_model(**metadata)) == metadata


def test_a_file_that_is_no_model_of_a_run_does_not_go_up(tmp_path):
    """Not even a counter is used, and no listener is asked."""
    model = tmp_path / "model.onnx"
    names = ("width", "height", *SENSOR_METADATA)
    for content, message in (
        (None, "cannot read the model: No such file or directory"),
        (b"width: 256", "expected a run's model.onnx"),
        (foreign_model(), "is no model.onnx of a run: it does not say width, height, black_dn"),
        (foreign_model(**dict.fromkeys(names[1:], "1")), "it does not say width"),
    ):
        if content is not None:
            model.write_bytes(content)
        session = str(tmp_path / "session")
        done = CliRunner().invoke(cli.app, ["uplink", "model", str(model), "--session", session])
        assert isinstance(done.exception, ConfigError) and message in str(done.exception)
        assert done.exception.exit_code == 2 and not (tmp_path / "session").exists()
    model.write_bytes(foreign_model(**dict.fromkeys(names, "1")))
    check_model(model)


def test_a_file_in_the_place_of_a_key_stays_and_no_counters_are_left_beside_it(tmp_path):
    (tmp_path / "key").write_bytes(b"not a key")
    with pytest.raises(ConfigError, match="exists already"):
        make_key(tmp_path / "key")
    assert [path.name for path in tmp_path.iterdir()] == ["key"]


def test_without_a_key_moving_its_counter_leaves_nothing_behind(tmp_path):
    with pytest.raises(ConfigError, match="No such file"):
        move_counter(tmp_path / "nokey", 5)
    assert list(tmp_path.iterdir()) == []


def test_a_script_that_is_no_text_is_wrong_usage(tmp_path):
    (tmp_path / "script").write_bytes(b"\xff\xfe\x00")
    words = ["uplink", "--script", str(tmp_path / "script"), "--session", str(tmp_path)]
    error = CliRunner().invoke(cli.app, words).exception
    assert isinstance(error, ConfigError) and "is no text; a script has a command on each line" in str(error)


def test_a_command_that_was_sent_before_its_listener_ended_is_told_from_one_that_nobody_sent(
    session, key_file
):
    def send_and_end() -> None:
        uplinker, packet = Uplinker(session, 1000, INTERVAL_S), None
        while packet is None:
            packet = uplinker.next_command(time.monotonic())
            time.sleep(0.02)

    command = ["uplink", "ping", "--session", str(session), "--key", str(key_file), "--timeout", "1"]
    with listening(session):
        assert "no process sent it" in CliRunner().invoke(cli.app, command).output
        sender = threading.Thread(target=send_and_end, daemon=True)
        sender.start()
        ended = CliRunner().invoke(cli.app, command)
        sender.join()
    assert ended.exit_code == 1 and "may have been executed" in ended.output
    assert "may have been executed" in (session / "commands.jsonl").read_text()
    assert not list((session / "uplink").glob("*.sent"))


@pytest.mark.parametrize("is_sent", [False, True])
@pytest.mark.parametrize("name", ["ping", "model"])
def test_a_listener_that_is_gone_ends_the_wait_for_a_command(
    session, key_file, tmp_path, monkeypatch, name, is_sent
):
    """With the time-out of a day: without the look at the listener this would wait for ever."""
    monkeypatch.setattr(uplink_commands, "LOOK_S", 0.0)
    monkeypatch.setattr(uplink_commands, "RESTART_S", 0.2)
    monkeypatch.setattr(uplinking, "was_sent", lambda *_: is_sent)
    looks = itertools.chain([True, True, False, True], itertools.repeat(False))  # it starts again once
    monkeypatch.setattr(uplinking, "is_listening", lambda _: next(looks))
    model = tmp_path / "model.onnx"
    model.write_bytes(foreign_model(**dict.fromkeys(("width", "height", *SENSOR_METADATA), "1")))
    words = [name] if name == "ping" else [name, str(model)]
    options = ["--session", str(session), "--key", str(key_file), "--timeout", "86400"]
    ended = CliRunner().invoke(cli.app, ["uplink", *words, *options])
    assert ended.exit_code == 1 and len(ended.output.splitlines()) == 1
    assert f"`ground listen` of {session} has ended: " in ended.output
    assert ("may have been executed" in ended.output) == is_sent
    assert [path.name for path in (session / "uplink").iterdir()] == []


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ("near -3", "`near -3`: near: expected 0 to 16 DN, got -3"),
        ("--timeout 5 resend -1 3", "`resend -1 3`: "),
        ("bracket -0.1,0.2 --json", "`bracket -0.1,0.2`: "),
        ("ping -3", "`ping -3`: expected no arguments"),
        ("near 3 --sesion x", "No such option: --sesion"),
    ],
)
def test_a_negative_number_is_an_argument_out_of_range_and_no_unknown_option(words, told):
    error = CliRunner().invoke(cli.app, ["uplink", *words.split()], standalone_mode=False).exception
    assert isinstance(error, (ValueError, USAGE_ERROR))
    said = getattr(error, "format_message", error.__str__)()
    assert said.startswith(told), said


def test_a_command_that_was_started_and_never_ended_is_told_as_failed(tmp_path, monkeypatch):
    reports = [{"stage": stage, "text": "model"} for stage in ("accepted", "started")]
    text = "still started when its time was up; give more by --timeout"
    result = {"reports": reports, "stage": "failed", "text": text}
    monkeypatch.setattr("ground.commands.uplink._sent", lambda *_: result)
    words = ["uplink", "ping", "--session", str(tmp_path), "--link", "serial:///dev/none", "--key", "none"]
    done = CliRunner().invoke(cli.app, words)
    assert done.exit_code == 1
    assert done.stdout.splitlines() == ["accepted: model", "started: model", f"failed: {text}"]
    reports.append({"stage": "failed", "text": "refused"})
    assert CliRunner().invoke(cli.app, words).stdout.splitlines()[2:] == ["failed: refused"]
