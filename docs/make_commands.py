"""Write docs/commands.md from the command lines themselves: python docs/make_commands.py"""

import enum
import importlib
import inspect
import math
import re
import typing
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import typer.main
from typer.core import TyperArgument

TOOLS = {
    "flightsw": "in flight",
    "ground": "on the ground",
    "hil": "the simulated world",
}
MEANING = re.compile(r"[.;:]( |$)")  # ends what a name means everywhere; the rest of a help is of its command
HEAD = """# Commands

Made from the command lines by `docs/make_commands.py`; do not edit. Every command has `--help`, and
`--json`, which prints its result as JSON. A name means the same in all commands. Exit codes: 0,
1 (the work failed, or was interrupted), 2 (wrong usage or configuration). Shell completion:
`ground --install-completion`.

Links are `serial:///dev/ttyUSB0?baud=921600`, `slcan:///dev/ttyACM0?bitrate=1000000` or
`can://can0?bitrate=1000000`; cameras are `gige://ID`, or simulated `hil://HOST:PORT` and
`hil:///path/to/socket`. Put a link's URL in quotes: `?` and `&` mean something to a shell. An
option without a default is off, or its text says what holds without it.
"""


def page() -> str:
    """Return the page: a section a tool, a subsection a command, a table of its options."""
    parts = [HEAD]
    for tool, where in TOOLS.items():
        parts.append(f"## {tool}: {where}\n")
        for name, command in commands(tool):
            text = inspect.cleandoc(command.help or "")
            text, _, example = text.partition("Example: ")
            parts.append(f"### {name}\n\n{text.strip()}\n")
            if example:
                parts.append(f"```sh\n{' '.join(example.split())}\n```\n")
            hints = typing.get_type_hints(inspect.unwrap(command.callback))
            rows = [_row(option, hints.get(option.name)) for option in options(command)]
            if rows:
                parts.append("\n".join(["| option | default | |", "| --- | --- | --- |", *rows]) + "\n")
    return "\n".join(parts)


def commands(tool: str) -> Iterator[tuple[str, Any]]:
    """Yield each command of a tool by its words, such as `flightsw mission new`."""

    def below(group: Any, words: str) -> Iterator[tuple[str, Any]]:
        for name, command in group.commands.items():
            if hasattr(command, "commands"):
                yield from below(command, f"{words} {name}")
            else:
                yield f"{words} {name}", command

    yield from below(typer.main.get_command(importlib.import_module(f"{tool}.cli").app), tool)


def options(command: Any) -> list[Any]:
    """Return the options and arguments of a command, without those of all commands (--help, --json)."""
    return [
        option
        for option in command.params
        if option.name != "help" and "--json" not in option.opts and not getattr(option, "hidden", False)
    ]


def meanings() -> dict[str, dict[str, str]]:
    """Return what each name says that it means, by the command that has it."""
    found: dict[str, dict[str, str]] = {}
    for tool in TOOLS:
        for name, command in commands(tool):
            for option in options(command):
                called = _name(option)
                found.setdefault(called, {})[name] = MEANING.split(option.help or "", maxsplit=1)[0]
    return found


def _name(option: Any) -> str:
    """Return an option's names, or an argument's."""
    if isinstance(option, TyperArgument):
        return option.metavar or option.name.upper()
    return ", ".join(f"`{name}`" for name in option.opts)


def _row(option: Any, hint: Any) -> str:
    """Return the row of an option or argument: its names with their choices, its default, its help."""
    names = _name(option)
    for choice in (hint, *typing.get_args(hint)):
        if isinstance(choice, type) and issubclass(choice, enum.Enum):
            names += ": " + ", ".join(str(member.value) for member in choice)
        elif typing.get_origin(choice) is typing.Literal:
            names += ": " + ", ".join(typing.get_args(choice))
    default = getattr(option.default, "value", option.default)
    empty = default in (None, False, "", (), [], math.inf) or callable(default) or not option.show_default
    shown = "required" if option.required else "" if empty else f"`{default}`"
    return f"| {names} | {shown} | {option.help or ''} |"


if __name__ == "__main__":
    target = Path(__file__).with_name("commands.md")
    target.write_text(page())
    print(target)
