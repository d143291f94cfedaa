"""The error of a comparison."""

import re

from obbgs_base.errors import ObbgsError

CLASS_NAME = re.compile(r"^[A-Z]\w*: ")  # that a row's error begins with, for programs


class CompareError(ObbgsError):
    """A comparison cannot be made as asked; the message says why and what to do."""


def for_people(error: str) -> str:
    """Return the error of a row without the name of its class."""
    return CLASS_NAME.sub("", error)
