"""The error of a comparison."""

from obbgs_base.errors import ObbgsError


class CompareError(ObbgsError):
    """A comparison cannot be made as asked; the message says why and what to do."""
