"""Imports of large libraries, made quick."""

import contextlib
import gc
import sys
from collections.abc import Iterator

MANY = 100  # modules


@contextlib.contextmanager
def quick_imports() -> Iterator[None]:
    """Keep the garbage collector out of imports, and what they have made out of later collections.

    PyTorch and what comes with it are half a million objects and hardly any garbage; looking through them again and
    again took a quarter of the processor time of `ground evaluate`.
    """
    modules, was_on = len(sys.modules), gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if (
            len(sys.modules) > modules + MANY
        ):  # else they were there already, and objects of other kinds are, too
            gc.freeze()
        if was_on:
            gc.enable()
