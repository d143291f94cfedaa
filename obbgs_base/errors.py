"""The base class of every error that is raised on purpose."""

from typing import ClassVar


class ObbgsError(Exception):
    """The world misbehaved: a link, a disk, a camera, frames that allow no model. The message says what to do.

    A caller's mistake is a `ValueError` instead; `flightsw.icd.config.ConfigError` is both.
    """

    exit_code: ClassVar[int] = 1  # of a command that ends in it; 2 is wrong usage


class Interrupted(ObbgsError):
    """Work was asked to stop before its end; the message says what is kept."""
