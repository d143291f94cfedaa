"""The base class of every error that is raised on purpose, and what errors of the system say in words."""

import os
import re
from typing import ClassVar

NUMBER = re.compile(r"\s*\[(Errno|Error Code) -?\d+\]:?")
TERMIOS = re.compile(r"\(\d+, '([^']*)'\)")  # how an error of a serial line is told, alone or by pyserial


class ObbgsError(Exception):
    """The world misbehaved: a link, a disk, a camera, frames that allow no model. The message says what to do.

    A caller's mistake is a `ValueError` instead; `flightsw.icd.config.ConfigError` is both.
    """

    exit_code: ClassVar[int] = 1  # of a command that ends in it; 2 is wrong usage


class Interrupted(ObbgsError):
    """Work was asked to stop before its end; the message says what is kept."""


def reason(error: BaseException) -> str:
    """Return what went wrong as one line, of a system's error without number and file: `No such file or directory`."""
    said = str(error)
    if isinstance(error, OSError) and error.strerror:
        said = str(error.strerror)
        if error.errno and NUMBER.search(said):  # pyserial repeats the error that it met, with its file
            said = os.strerror(error.errno)
    said = TERMIOS.sub(r"\1", said)
    words = NUMBER.sub("", " ".join(said.split())).strip()
    return words or type(error).__name__  # a TimeoutError may say nothing


def counted(count: int, thing: str) -> str:
    """Return how many there are of something in words: `1 frame`, `1,200 frames`."""
    return f"{count:,} {thing}{'' if count == 1 else 's'}"


def in_words(error: BaseException) -> str:
    """Return what went wrong as one line, with the file of a system's error before it: `FILE: Permission denied`."""
    file = getattr(error, "filename", None) if isinstance(error, OSError) else None
    return reason(error) if file is None else f"{os.fspath(file)}: {reason(error)}"
