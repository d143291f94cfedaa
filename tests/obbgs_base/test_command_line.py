"""What every command says of a value that it does not take: what was expected and what came, in our words."""

import logging

import pytest
import typer

from obbgs_base.command_line import new_app, run
from tests.commands import call


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ("ground reconstruct --quality good", "'good' is not one of 'draft', 'standard', 'best'."),
        ("flightsw capture --count many", "'--count': expected a valid integer, got 'many'"),
        ("hil camera --real-time fast", "'--real-time': expected a valid number, got 'fast'"),
        ("ground uplink ping --timeout 0", "expected a number greater than or equal to 0.1, got '0'"),
        ("flightsw mission new --target-size x", "'--target-size': expected a valid number, got 'x'"),
    ],
)
def test_a_wrong_value_is_refused_in_our_words(words, told):
    tool, *arguments = words.split()
    ended = call(tool, *arguments)
    (said,) = ended.stderr.splitlines()
    assert ended.returncode == 2 and said.startswith(f"{tool}: ") and told in said
    assert "Value error" not in said and "Input should" not in said


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ("ground nope", "ground: No such command 'nope'. See `ground --help`."),
        ("flightsw plan --nope", "flightsw: No such option: --nope. See `flightsw plan --help`."),
        ("ground listen", "ground: Missing option '--link'. See `ground listen --help`."),
        ("ground", None),  # its help is shown
    ],
)
def test_words_that_are_no_command_of_ours_are_told_in_a_line(words, told):
    tool, *arguments = words.split()
    ended = call(tool, *arguments)
    assert ended.returncode == 2 and ended.stderr.splitlines() == ([told] if told else [])


def test_a_warning_begins_with_the_command_and_names_no_module_of_ours(capsys, monkeypatch):
    app = new_app("A tool.")

    @app.command()
    def warn() -> None:
        logging.getLogger("ground.formats.somewhere").warning("nothing states %s", "the times")
        logging.getLogger("a_library.nanny").error("restarted")  # one that no other test configures

    @app.command()
    def other() -> None:
        raise typer.Exit

    monkeypatch.setattr("sys.argv", ["ground", "warn"])
    monkeypatch.setattr(logging.getLogger(), "handlers", [])
    with pytest.raises(SystemExit):
        run(app, "ground")
    assert capsys.readouterr().err.splitlines() == [
        "ground: warning: nothing states the times",
        "ground: error of a_library.nanny: restarted",
    ]
