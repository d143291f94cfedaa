"""Values and names that a person gives: their types checked against the fields of dataclasses, and told in messages."""

import difflib
import numbers
import reprlib
import typing
from collections.abc import Iterable
from typing import Any, Literal

FEW_NAMES = 10  # that a message lists; of more it tells the nearest
LARGEST = 1e300  # a number of a file, so that sums and squares of a few are finite or seen not to be

_SHORT = reprlib.Repr()  # without writing all of a large value first
_SHORT.maxlevel = 3
_SHORT.maxlist = _SHORT.maxtuple = _SHORT.maxdict = 12
_SHORT.maxstring = _SHORT.maxother = _SHORT.maxlong = 200


def told(value: Any) -> str:
    """Return a value as messages show it, at most 80 characters."""
    return "nothing" if value is None else _SHORT.repr(value)[:80]


def names_like(given: str, known: Iterable[str]) -> str:
    """Return what a wrong name could have been: `expected` with all names where they are few, else the nearest."""
    names = list(known)
    if len(names) <= FEW_NAMES:
        return f"expected one of {', '.join(names)}"
    nearest = difflib.get_close_matches(given, names, n=3, cutoff=0.5)
    nearest += [name for name in names if name.endswith(f".{given}") and name not in nearest]
    like = f"nearest to it: {', '.join(nearest)}" if nearest else f"such as {', '.join(names[:3])}"
    return f"expected one of {len(names)} names, {like}"


def plain(value: Any, hint: Any) -> Any:
    """Return a value as the type of a field that holds one choice, number, truth value or text; only int becomes float.

    Args:
        hint: a `Literal`, float, bool, int or str.

    Raises:
        ValueError: a value of another type; says what was expected and what came.
    """
    if typing.get_origin(hint) is Literal:
        options = typing.get_args(hint)
        _expect(value in options, f"one of {', '.join(map(str, options))}", value)
        return value
    if hint is bool:
        _expect(isinstance(value, bool), "true or false", value)
        return value
    truth = isinstance(value, bool)  # which Python counts as a number
    if hint is float:
        number: Any = value
        if isinstance(value, numbers.Real) and not isinstance(value, int):
            number = float(value)
        _expect(isinstance(number, (int, float)) and not truth and abs(number) < LARGEST, "a number", value)
        return float(number)
    if hint is int:
        _expect(isinstance(value, numbers.Integral) and not truth, "a whole number", value)
        return int(value)
    _expect(isinstance(value, str), "text", value)
    return value


def as_items(value: Any) -> Any:
    """Return a list or tuple.

    Raises:
        ValueError: something else; shows how a list of it is written.
    """
    single = isinstance(value, (str, int, float)) and not isinstance(value, bool) and len(str(value)) <= 60
    like = f" such as [{value}]" if single else ""
    _expect(isinstance(value, (list, tuple)), f"a list{like}", value)
    return value


def _expect(condition: bool, expected: str, value: Any) -> None:
    if not condition:
        raise ValueError(f"expected {expected}, got {told(value)}")
