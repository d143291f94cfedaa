"""Commands on the ground: sealed, each with its own counter, repeated until the result is known, executed once."""

import json
import math
import os
import random
import threading
from pathlib import Path

import pytest
from typer.testing import CliRunner

from flightsw.commands import Commander, ReplayCounter
from flightsw.icd.auth import Key, unseal, unseal_file
from flightsw.icd.command import Command, Report
from flightsw.icd.mission import ConfigError
from flightsw.store import FrameStore
from ground import cli
from ground.ingest import listen
from ground.session import SessionError
from ground.uplink import (
    Uplinker,
    in_words,
    is_listening,
    listening,
    make_key,
    outcome,
    parse_command,
    parse_script,
    submit,
    withdraw,
)

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
    "words", [["fire"], ["ping", "now"], ["bracket"], ["bracket", "a,b"], ["near", "2.5"], ["delete", "3"]]
)
def test_a_command_line_that_is_none_says_so(words):
    with pytest.raises(ValueError, match=r"not a command|expected a number"):
        parse_command(words[0], words[1:])


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
    with pytest.raises(ConfigError, match=r"mission\.key"):
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
    replay = ReplayCounter(key_file)
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
    replay = ReplayCounter(key_file)
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
    utc_ns = [10**18]
    uplinker = Uplinker(session, 1000, INTERVAL_S, utc_ns=lambda: utc_ns[0])
    first, second = (submit(session, key_file, Command("ping", {}), None, 600) for _ in range(2))
    withdraw(session, second)
    assert uplinker.next_command(0.0) is not None
    assert uplinker.next_command(0.1) is None  # sent again after an interval, not before
    assert uplinker.next_command(2 * INTERVAL_S) is not None
    utc_ns[0] = 10**19
    assert uplinker.next_command(10.0) is None
    end = outcome(session, first)
    assert end is not None and (end["stage"], end["text"]) == ("failed", "no answer in time")
    assert outcome(session, second) is None


def test_a_model_s_file_that_is_under_way_is_sent_to_its_end(session, key_file, tmp_path, small_mission):
    (tmp_path / "m.onnx").write_bytes(bytes(range(256)) * 40)
    utc_ns = [10**18]
    uplinker = Uplinker(session, 200, INTERVAL_S, utc_ns=lambda: utc_ns[0])
    counter = submit(session, key_file, Command("model", {}), tmp_path / "m.onnx", 600)
    assert uplinker.next_command(0.0) is not None
    uplinker.take_report(Report(0, counter, "accepted", ""), 0.1)
    assert uplinker.next_pdu(0.2) is not None
    utc_ns[0] = 10**19
    uplinker.next_command(10.0)
    assert outcome(session, counter) is None and uplinker.next_pdu(10.1) is not None
    uplinker.take_report(Report(0, counter, "completed", "in use"), 11.0)
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
    uplinker.next_command(0.0)
    uplinker.take_report(Report(0, counter, "completed", "alive"), 0.0)
    assert outcome(session, counter)
    make_key(tmp_path / "new.key")
    assert submit(session, tmp_path / "new.key", Command("ping", {}), None, 600) == counter
    assert outcome(session, counter) is None


@pytest.mark.parametrize(
    "content",
    [
        '{"packet": "zz"}',
        '{"packet": "00", "command": "ping", "expires_utc_ns": Infinity}',
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
    uplinker.next_command(0.0)
    uplinker.take_report(Report(0, counter + 1, "completed", "forged"), 0.0)
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
        ("fire", "line 1 of the script: not a command"),
        ("bracket '0.05", "line 1 of the script"),
        ("# nothing\n", "holds no command"),
    ):
        with pytest.raises(ValueError, match=told):
            parse_script(text)


def test_a_script_stops_at_the_first_command_that_is_not_completed_and_one_history_tells_all(
    session, key_file, tmp_path, small_mission
):
    """The real command line, listener's side and spacecraft's side, joined without a wire."""
    replay, stop = ReplayCounter(key_file), threading.Event()
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
