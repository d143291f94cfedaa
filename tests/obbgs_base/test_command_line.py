"""What every command says of a value that it does not take: what was expected and what came, in our words."""

import re

import pytest

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
    said = " ".join(re.sub("[│╭╮╰╯─]", " ", ended.stderr).split())  # without the box around it
    assert ended.returncode == 2 and told in said
    assert "Value error" not in said and "Input should" not in said
