"""Settings of a method: frozen dataclasses whose fields carry their range beside their default."""

import dataclasses
import functools
import math
import operator
import typing
from typing import Any, Literal

from obbgs_base.values import as_items, names_like, plain


def number(default: float, least: float = 0.0, most: float = math.inf) -> Any:
    """Return a field for a number from `least` to `most`, both allowed unless infinite."""
    return dataclasses.field(default=default, metadata={"least": least, "most": most})


def at_least_one(default: int) -> Any:
    """Return a field for a whole number of at least 1."""
    return number(default, least=1)


def fraction(default: float | tuple[float, ...]) -> Any:
    """Return a field for one or several numbers from 0 to 1."""
    return dataclasses.field(default=default, metadata={"least": 0, "most": 1})


def check(settings: Any, group: str = "") -> None:
    """Refuse settings that are out of range; numbers without a range of their own must be finite and 0 or more.

    Args:
        settings: an instance of a dataclass; fields that are groups themselves have been checked already.
        group: where it stands in the settings of a method, for messages: `growth` for `growth.interval`.

    Raises:
        ValueError: names the setting, what is expected and what came.
    """
    for f in dataclasses.fields(settings):
        name, value = f"{group}.{f.name}" if group else f.name, getattr(settings, f.name)
        options = _options(type(settings)).get(f.name)
        if options and value not in options:
            raise ValueError(f"{name} must be {', '.join(options[:-1])} or {options[-1]}, got {value!r}")
        least, most = f.metadata.get("least", 0), f.metadata.get("most", math.inf)
        for item in value if isinstance(value, tuple) else (value,):
            if isinstance(item, (int, float)) and not (least <= item <= most and item < math.inf):
                expected = f"{least:g} or more" if most == math.inf else f"from {least:g} to {most:g}"
                if least == 1:
                    expected = "at least 1"
                raise ValueError(f"{name} must be {expected}, got {item}")


@functools.cache
def _options(section: type) -> dict[str, tuple[str, ...]]:
    """Return the values that each field of a dataclass with a fixed choice may take."""
    hints = typing.get_type_hints(section)
    return {name: typing.get_args(h) for name, h in hints.items() if typing.get_origin(h) is Literal}


def changed(settings: Any, changes: dict[str, Any]) -> Any:
    """Return settings with some of them changed, by names such as `steps` or `growth.interval`.

    Raises:
        ValueError: no such setting (the message names the nearest), or a value of the wrong type or out of its range.
    """
    by_group: dict[str, dict[str, Any]] = {}
    for name, value in changes.items():
        group, _, rest = name.partition(".")
        by_group.setdefault(group, {})[rest] = value
    values = {}
    known = known_names(type(settings))
    for group, inner in by_group.items():
        current = getattr(settings, group, None)
        is_group = dataclasses.is_dataclass(current)
        hints = typing.get_type_hints(type(current if is_group else settings))
        for rest, value in inner.items():
            name = f"{group}.{rest}" if rest else group
            if name not in known:
                inside = [other for other in known if other.startswith(f"{group}.")]
                raise ValueError(f"there is no setting {name}; {names_like(name, inside or known)}")
            inner[rest] = _typed(value, hints[rest or group], name)
        values[group] = dataclasses.replace(current, **inner) if is_group else inner[""]  # pyright: ignore
    return dataclasses.replace(settings, **values)


def _typed(value: Any, hint: Any, name: str) -> Any:
    """Return a value as the type of its setting, see `plain`; lists become tuples.

    Raises:
        ValueError: names the setting, what is expected and what came.
    """
    try:
        if typing.get_origin(hint) is not tuple:
            is_nan = hint is float and isinstance(value, float) and math.isnan(value)
            return value if is_nan else plain(value, hint)  # which is out of every range
        items, hints = as_items(value), typing.get_args(hint)
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from None
    if hints[-1] is Ellipsis:
        hints = hints[:1] * len(items)
    if len(items) != len(hints):  # the group itself says how many it wants
        return tuple(items)
    return tuple(
        _typed(item, h, f"{name}[{i}]") for i, (item, h) in enumerate(zip(items, hints, strict=True))
    )


def flat(settings: Any) -> dict[str, Any]:
    """Return all settings by names such as `steps` or `growth.interval`."""
    return {name: operator.attrgetter(name)(settings) for name in known_names(type(settings))}


@functools.cache
def known_names(section: type) -> tuple[str, ...]:
    """Return the names of all settings of a dataclass, those of its groups as `group.name`."""
    hints, names = typing.get_type_hints(section), []
    for f in dataclasses.fields(section):
        hint = hints[f.name]
        if dataclasses.is_dataclass(hint):
            names += [f"{f.name}.{inner}" for inner in known_names(typing.cast(type, hint))]
        else:
            names.append(f.name)
    return tuple(names)
