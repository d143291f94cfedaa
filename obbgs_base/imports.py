"""Imports of large libraries, made quick, and public names whose modules are imported when they are first used."""

import contextlib
import gc
import importlib
import sys
from collections.abc import Callable, Iterator, Mapping
from typing import Any

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


def lazily(package: str, modules: Mapping[str, str]) -> Callable[[str], Any]:
    """Return the `__getattr__` of a package, which finds each public name in its module.

    Args:
        package: the package's own name.
        modules: public name to the module below the package that defines it.
    """

    def find(name: str) -> Any:
        if name not in modules:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        return getattr(importlib.import_module(f"{package}.{modules[name]}"), name)

    return find
