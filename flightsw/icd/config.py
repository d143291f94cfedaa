"""Strict reader of the YAML and JSON that a person writes: each file becomes frozen dataclasses, key by key."""

import collections
import contextlib
import dataclasses
import json
import math
import re
import types
import typing
from collections.abc import Iterator
from datetime import datetime
from pathlib import Path
from typing import Any

import yaml

from obbgs_base.errors import ObbgsError
from obbgs_base.values import as_items, names_like, plain, told

# of a file that a person writes; the largest that is shipped has 12 kB, and reading takes some 100 times its size
MAX_YAML_BYTES = 256 * 1024
MAX_JSON_BYTES = 64 * 1024 * 1024  # transforms.json names some 100,000 pictures in so many
MAX_VALUES = 20_000  # of a YAML text with its aliases written out


class ConfigError(ObbgsError, ValueError):
    """A key of a file or an option is missing, unknown, repeated or wrong.

    `path` names the key, `problem` says what is wrong with it, `file` is where it stands, empty if not in a file.
    """

    exit_code = 2

    def __init__(self, path: str, problem: str, file: str = ""):
        problem = " ".join(problem.splitlines())  # what came may hold the ends of lines
        super().__init__(f"{file}: {path}: {problem}" if file else f"{path}: {problem}")
        self.path, self.problem, self.file = path, problem, file


def require(condition: bool, path: str, problem: str) -> None:
    """Raise a ConfigError unless the condition holds."""
    if not condition:
        raise ConfigError(path, problem)


def require_counts(section: object, path: str, **counts: int) -> None:
    """Raise a ConfigError unless a section's values of these names hold so many numbers."""
    for name, count in counts.items():
        got = len(getattr(section, name))
        require(got == count, f"{path}.{name}", f"expected {count} numbers, got {got}")


def require_unit_quaternion(quat: tuple[float, ...], path: str) -> None:
    """Raise a ConfigError unless a quaternion has the length 1."""
    length = math.hypot(*quat)
    require(abs(length - 1) < 1e-6, path, f"expected a unit quaternion, got length {length:.6f}")


@contextlib.contextmanager
def in_file(file: str | Path) -> Iterator[None]:
    """Let every ConfigError raised inside name the file."""
    try:
        yield
    except ConfigError as error:
        raise ConfigError(error.path, error.problem, error.file or str(file)) from error.__cause__


@contextlib.contextmanager
def keys_below(path: str, own_path: str) -> Iterator[None]:
    """Let a ConfigError about `own_path`, as a section calls itself, or a key below it name `path` instead."""
    try:
        yield
    except ConfigError as error:
        if not error.path.startswith((f"{own_path}.", f"{own_path}[")) and error.path != own_path:
            raise
        moved = path + error.path.removeprefix(own_path)
        raise ConfigError(moved, error.problem, error.file) from error.__cause__


class _Loader(yaml.SafeLoader):
    """PyYAML's loader, to which 4.0e7, 2e-3 and 1E5 are numbers as in YAML 1.2; to YAML 1.1 they are text."""


_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)[eE][-+]?[0-9]+$"),
    list("-+.0123456789"),
)


def parse_yaml(content: bytes, path: str) -> Any:
    """Return what a YAML text holds; YAML itself would silently keep the last of two equal keys.

    Numbers with an exponent may be written as everywhere else, such as 4.0e7.

    Raises:
        ConfigError: not YAML, too large, or a key is written twice; the path of the key starts with `path`.
    """
    _refuse_large(content, MAX_YAML_BYTES, path)
    try:
        loader = _Loader(content)
        try:
            node = loader.get_single_node()
            _refuse_repeated_keys(node, path, set())
            values = _count(node, {}) if node is not None else 0
            require(
                values <= MAX_VALUES,
                path,
                f"holds {values:.3g} values with its aliases, at most {MAX_VALUES}",
            )
            return None if node is None else loader.construct_document(node)
        finally:
            loader.dispose()
    except ConfigError:
        raise
    except (yaml.YAMLError, ValueError, RecursionError) as error:  # 2026-13-01 is a ValueError of PyYAML's
        problem = re.sub(r',? in "<byte string>",', " at", " ".join(str(error).split()))
        raise ConfigError(path, f"is not valid YAML: {problem}") from error


def assignment(text: str, option: str = "--set") -> tuple[str, Any]:
    """Return name and value of a text such as `steps=60`; the value is YAML.

    Raises:
        ConfigError: not such a text.
    """
    name, equals, value = text.partition("=")
    if not equals or not name.strip():
        raise ConfigError(option, f"expected NAME=VALUE, got {text!r}")
    return name.strip(), parse_yaml(value.encode(), f"{option} {name.strip()}")


def _refuse_large(content: bytes, most: int, path: str) -> None:
    require(len(content) <= most, path, f"has {len(content)} bytes, at most {most} are read")


def _count(node: yaml.Node, counts: dict[int, float]) -> float:
    """Return how many values a node holds when its aliases are written out; infinity for one that holds itself.

    A few hundred bytes of aliases to aliases can stand for billions of values, which would be visited one by one.
    """
    if id(node) not in counts:
        counts[id(node)] = float("inf")  # while it is being counted: who meets it now is inside of it
        inner: list[yaml.Node] = []
        if isinstance(node, yaml.MappingNode):
            inner = [part for pair in node.value for part in pair]
        elif isinstance(node, yaml.SequenceNode):
            inner = node.value
        counts[id(node)] = 1 + sum(_count(part, counts) for part in inner)
    return counts[id(node)]


def _refuse_repeated_keys(node: yaml.Node | None, path: str, seen: set[int]) -> None:
    if id(node) in seen:  # an alias: it may lead back to itself
        return
    seen.add(id(node))
    if isinstance(node, yaml.MappingNode):
        lines: dict[str, int] = {}
        for key, value in node.value:
            name, line = str(key.value), key.start_mark.line + 1
            if name in lines:
                raise ConfigError(f"{path}.{name}", f"is written twice, in lines {lines[name]} and {line}")
            lines[name] = line
            _refuse_repeated_keys(value, f"{path}.{name}", seen)
    elif isinstance(node, yaml.SequenceNode):
        for index, item in enumerate(node.value):
            _refuse_repeated_keys(item, f"{path}[{index}]", seen)


def parse_json(content: bytes, path: str) -> Any:
    """Return what a JSON text holds.

    Raises:
        ConfigError: not JSON, too large, or a key is written twice; the path of the key starts with `path`.
    """
    _refuse_large(content, MAX_JSON_BYTES, path)
    repeated: list[tuple[dict, str]] = []  # an object and a key that it has twice, inner objects first

    def collect(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        tree = dict(pairs)
        if len(tree) < len(pairs):
            counts = collections.Counter(name for name, _ in pairs)
            repeated.extend((tree, name) for name in tree if counts[name] > 1)
        return tree

    try:
        tree = json.loads(content, object_pairs_hook=collect)
        if repeated:
            holder, name = repeated[-1]  # no object around it repeats a key, so that it is still in the tree
            raise ConfigError(f"{_path_to(holder, tree, path)}.{name}", "is written twice")
    except ConfigError:
        raise
    except (ValueError, RecursionError) as error:
        raise ConfigError(path, f"is not JSON: {error}") from error
    return tree


def _path_to(wanted: dict, tree: Any, path: str) -> str | None:
    if tree is wanted:
        return path
    children = [(f"{path}.{name}", child) for name, child in tree.items()] if isinstance(tree, dict) else []
    if isinstance(tree, list):
        children = [(f"{path}[{index}]", child) for index, child in enumerate(tree)]
    found = (_path_to(wanted, child, below) for below, child in children)
    return next((place for place in found if place is not None), None)


def build(section: type, tree: Any, path: str, **given: Any) -> Any:
    """Return the frozen dataclass `section` made from a YAML mapping; `given` fields do not come from the file.

    Raises:
        ConfigError: names the path of the first key that is wrong.
    """
    require(isinstance(tree, dict), path, f"expected a mapping of keys, got {told(tree)}")
    fields = {f.name: f for f in dataclasses.fields(section) if f.name not in given}
    for key in tree:
        require(key in fields, f"{path}.{key}", f"unknown key; {names_like(str(key), fields)}")
    hints = typing.get_type_hints(section)
    values = dict(given)
    for name, f in fields.items():
        if name in tree:
            values[name] = _convert(tree[name], hints[name], f"{path}.{name}")
        elif f.default is dataclasses.MISSING and f.default_factory is dataclasses.MISSING:
            raise ConfigError(f"{path}.{name}", "is missing")
    return section(**values)


def _convert(value: Any, hint: Any, path: str) -> Any:
    """Return `value` as the type of a field; no silent conversion but int to float and datetime to ISO text."""
    if dataclasses.is_dataclass(hint):
        return build(typing.cast(type, hint), value, path)
    origin = typing.get_origin(hint)
    if origin is dict:
        require(isinstance(value, dict), path, f"expected a mapping of keys, got {told(value)}")
        return value
    if origin in (typing.Union, types.UnionType):
        wanted_list = isinstance(value, list)
        branches = typing.get_args(hint)
        if value is None and type(None) in branches:
            return None
        return _convert(value, branches[-1] if wanted_list else branches[0], path)
    if hint is str and isinstance(value, datetime):  # YAML reads an unquoted time stamp as a datetime
        return value.isoformat()
    try:
        if origin is not tuple:
            return plain(value, hint)
        items = as_items(value)
    except ValueError as error:
        raise ConfigError(path, str(error)) from None
    item_hint = typing.get_args(hint)[0]
    return tuple(_convert(item, item_hint, f"{path}[{i}]") for i, item in enumerate(items))
