"""What errors of the system, of pyserial and of python-can say: one line, no number, no name twice."""

import socket
from pathlib import Path

import can
import pytest
import serial

from obbgs_base.errors import in_words, reason
from tests.commands import call


def raised(action) -> Exception:
    with pytest.raises(Exception) as caught:
        action()
    return caught.value


@pytest.mark.parametrize(
    ("action", "words"),
    [
        (lambda: Path("/nowhere/file").read_text(), "No such file or directory"),
        (lambda: serial.Serial("/dev/nowhere"), "No such file or directory"),
        (lambda: socket.create_connection(("127.0.0.1", 1), timeout=5), "Connection refused"),
        (lambda: Path("\0").read_text(), "embedded null byte"),
    ],
)
def test_errors_of_real_libraries_are_one_line_without_number_and_file(action, words):
    assert reason(raised(action)) == words


def test_other_errors_keep_their_words():
    assert reason(can.CanOperationError("Failed to transmit: Network is down", 100)) == (
        "Failed to transmit: Network is down"
    )
    assert reason(TimeoutError()) == "TimeoutError" and reason(ValueError("two\n lines")) == "two lines"
    assert (
        in_words(raised(lambda: Path("/nowhere/file").read_text()))
        == "/nowhere/file: No such file or directory"
    )


@pytest.mark.parametrize(
    ("tool", "arguments", "line"),
    [
        ("flightsw", "downlink --link serial:///dev/nowhere --mission {m} --store {tmp}/s --exit-when-empty",
         "flightsw: cannot open /dev/nowhere: No such file or directory; plug the adapter in, or give the name that "
         "`ls /dev/tty*` shows with it"),
        ("flightsw", "capture --camera hil:///nowhere.sock --mission {m} --store {tmp}/s",
         "flightsw: no camera at hil:///nowhere.sock: No such file or directory; start the camera's server"),
        ("flightsw", "capture --camera hil:///nowhere.sock --mission {m} --start soon",
         "flightsw: --start: expected a time such as 2026-07-21T10:52:30Z, got 'soon'"),
        ("flightsw", "capture --camera hil:///nowhere.sock --mission {m} --count 0",
         "flightsw: --count: expected 1 to 100000, got 0"),
        ("flightsw", "selftest --mission {m} --loopback", "flightsw: --loopback: tests a link: name it with --link"),
        ("flightsw", "plan --mission {tmp}/torn.yaml",
         "flightsw: {tmp}/torn.yaml: mission: is not valid YAML: while parsing a flow sequence at line 1, column 4: "
         "a: [1 ^ expected ',' or ']', but got '<stream end>' at line 1, column 6: a: [1 ^"),
        ("ground", "listen --link serial:///dev/nowhere --mission {m} --session {tmp}/s",
         "ground: cannot open /dev/nowhere: No such file or directory; plug the adapter in, or give the name that "
         "`ls /dev/tty*` shows with it"),
    ],
)  # fmt: skip
def test_what_a_command_says_is_one_line_that_names_each_thing_once(tmp_path, tool, arguments, line, request):
    (tmp_path / "torn.yaml").write_text("a: [1")
    mission = request.config.rootpath / "mission.yaml"
    done = call(tool, *[word.format(m=mission, tmp=tmp_path) for word in arguments.split()])
    assert done.stderr == line.format(tmp=tmp_path) + "\n"
