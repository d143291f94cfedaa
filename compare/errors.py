"""The error of a comparison."""

import re
from collections.abc import Mapping
from typing import Any

from obbgs_base.errors import ObbgsError

CLASS_NAME = re.compile(r"^[A-Z]\w*: ")  # that a row's error begins with, for programs


class CompareError(ObbgsError):
    """A comparison cannot be made as asked; the message says why and what to do."""


def for_people(error: str) -> str:
    """Return the error of a row without the name of its class."""
    return CLASS_NAME.sub("", error)


def cannot_be_made(row: Mapping[str, Any]) -> bool:
    """Return whether a row says that its condition cannot be made of its session, and nothing of its method."""
    return str(row.get("error")).startswith(f"{CompareError.__name__}: ")
